// upscale on CUDA: a team of threads to a fine voxel. Memory rule: writes.
#include "../drivers/upscale.h"

#include "team.cuh"

namespace surfcap {
namespace {

template <int Degree, class Real>
__global__ void __launch_bounds__(kThreads)
    read_centers(const __grid_constant__ Field<Real> coarse, const __grid_constant__ Field<Real> fine,
                 const int32_t* coordinates, int64_t count, Real* voxels) {
  const TeamField<Real, Degree, Real> reader(coarse);
  for (int64_t i = first_team(); i < count; i += team_stride()) {
    Real center[3];
    for (int axis = 0; axis < 3; ++axis)
      center[axis] = center_of(static_cast<const Grid<Real>&>(fine), coordinates + i / kTileVoxels * 3,
                               int(i % kTileVoxels), axis);
    const auto record = reader.read(reader.fetch(reader.locate(center)));
    if (reader.leads()) store_aligned<Real, 4>(voxels + i * reader.kPitch + 4 * reader.part(), record);
  }
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void upscale(const Field<Real>& coarse, const Field<Real>& fine, const int32_t* coordinates, int64_t tiles,
               Real* voxels) const {
    const int64_t count = tiles * kTileVoxels;
    with_degree(coarse.pitch, [&](auto degree) {
      launch("upscale", read_centers<decltype(degree)::value, Real>, blocks(count, kTeamsPerBlock), kThreads, coarse,
             fine, coordinates, count, voxels);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) { m.impl("upscale", TORCH_BOX(&upscale<Cuda>)); }

}  // namespace surfcap
