// visibility on CUDA: a team of threads to a ray, each thread with its own corner. Memory rule: atomic maxima, so the
// result does not depend on the order.
#include "../drivers/visibility.h"

#include "walk.cuh"

namespace surfcap {
namespace {

// Numbers that are not negative have the order of their bits.
__device__ __forceinline__ void raise(float* to, float x) { atomicMax(reinterpret_cast<int*>(to), __float_as_int(x)); }
__device__ __forceinline__ void raise(double* to, double x) {
  atomicMax(reinterpret_cast<unsigned long long*>(to), static_cast<unsigned long long>(__double_as_longlong(x)));
}

template <class Walking, class Real>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    see_voxels(const __grid_constant__ Walking walking, Real* seen) {
  walking.for_each_ray([&](const auto& walk, const auto&, int64_t) {
    for (int n = 0; n < walk.ray.samples; ++n) {
      const auto sample = walk[n];
      const auto corner = walk.corner_of(sample.k);
      if (corner.voxel < 0 || !(corner.weight > Real(0))) continue;
      raise(seen + 2 * int64_t(corner.voxel), larger(sample.transmittance, Real(0)));
      raise(seen + 2 * int64_t(corner.voxel) + 1, larger((Real(1) - sample.a) * sample.transmittance, Real(0)));
    }
  });
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real, class Stored>
  void visibility(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings, int64_t,
                  const Tensor& seen) const {
    Real* const to = seen.template mutable_data_ptr<Real>();
    clear(to, seen.numel());
    const auto kernel = [](const auto& walking) { return see_voxels<std::decay_t<decltype(walking)>, Real>; };
    with_walking(*this, seen, field, rays, settings, kernel, [&](const auto& walking, int64_t blocks) {
      launch("visibility", kernel(walking), blocks, kThreads, walking, to);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) { m.impl("visibility", TORCH_BOX(&visibility<Cuda>)); }

}  // namespace surfcap
