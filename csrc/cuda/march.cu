// march_forward, march_backward on CUDA: a team of threads to a ray. Memory rule: backward adds atomically.
#include "../drivers/march.h"

#include "walk.cuh"

namespace surfcap {
namespace {

template <class Walking, class Real>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    render_rays(const __grid_constant__ Walking walking, Rendering<Real> out) {
  walking.for_each_ray(
      [&](const auto& walk, const auto&, int64_t i) { write_ray(walk.ray, walking.rays.background, i, out); });
}

template <class Walking, class Real>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    render_rays_backward(const __grid_constant__ Walking walking, const Real* grad_color,
                         const Real* grad_transmittance, const Real* grad_depth, Real* gradient) {
  walking.for_each_ray([&](const auto& walk, const auto&, int64_t i) {
    const auto sink = walk.to_voxels(gradient);
    adjoint_ray(walk.ray, walking.rays, i, grad_color, grad_transmittance, grad_depth, walk.back(sink));
  });
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void march_forward(const Field<Real>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                     const Rendering<Real>& out, const Tensor& like) const {
    const auto kernel = [](const auto& walking) { return render_rays<std::decay_t<decltype(walking)>, Real>; };
    with_walking(*this, like, field, rays, settings, kernel, [&](const auto& walking, int64_t blocks) {
      launch("march_forward", kernel(walking), blocks, kThreads, walking, out);
    });
  }

  template <class Real>
  void march_backward(const Field<Real>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                      const Real* grad_color, const Real* grad_transmittance, const Real* grad_depth, int64_t,
                      const Tensor& gradient) const {
    Real* const to = gradient.template mutable_data_ptr<Real>();
    clear(to, gradient.numel());
    const auto kernel = [](const auto& walking) { return render_rays_backward<std::decay_t<decltype(walking)>, Real>; };
    with_walking(*this, gradient, field, rays, settings, kernel, [&](const auto& walking, int64_t blocks) {
      launch("march_backward", kernel(walking), blocks, kThreads, walking, grad_color, grad_transmittance, grad_depth,
             to);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) {
  m.impl("march_forward", TORCH_BOX(&march_forward<Cuda>));
  m.impl("march_backward", TORCH_BOX(&march_backward<Cuda>));
}

}  // namespace surfcap
