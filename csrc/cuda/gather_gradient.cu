// gather_gradient on CUDA: a thread to a voxel, which reads from all cameras in their order: no atomics, and the same
// bits in every run. Memory rule: writes.
#include "../drivers/gather_gradient.h"

#include "../core/choices.h"
#include "../core/slots.h"
#include "gpu.cuh"

namespace surfcap {
namespace {

constexpr int kVoxels = 128;  // of a block: two tiles

// Where each camera's window begins among the pixels and among the blocks of pixels: there are some hundreds at most.
__global__ void lay_out(const int64_t* windows, int64_t views, int64_t* offsets, int64_t* reach_offsets) {
  int64_t pixels = 0, blocks = 0;
  for (int64_t v = 0; v < views; ++v) {
    const int64_t width = windows[4 * v + 2], height = windows[4 * v + 3];
    offsets[v] = pixels;
    pixels += width * height;
    reach_offsets[v] = blocks;
    blocks += blocks_along(width) * blocks_along(height);
  }
}

// A row of blocks of threads to a camera.
template <class Real>
__global__ void __launch_bounds__(kThreads)
    reach_blocks(const __grid_constant__ SlotCameras<Real> cameras, const __grid_constant__ SlotRows<Real> rows,
                 int64_t per_view, int32_t* reach) {
  const int64_t v = blockIdx.x / per_view;
  const int64_t blocks = blocks_along(cameras.windows[4 * v + 2]) * blocks_along(cameras.windows[4 * v + 3]);
  for (int64_t b = blockIdx.x % per_view * kThreads + threadIdx.x; b < blocks; b += per_view * kThreads)
    find_reach(cameras, rows, v, b, reach + 2 * (cameras.reach_offsets[v] + b));
}

template <int Degree, class Real, class Slot>
__global__ void __launch_bounds__(kVoxels)
    gather_voxels(const __grid_constant__ Grid<Real> field, const int32_t* coordinates,
                  const __grid_constant__ SlotCameras<Real> cameras, const __grid_constant__ SlotRows<Real> rows,
                  const Slot* slots, Real* gradient) {
  using R = Record<Degree>;
  for (int64_t voxel = first_item(); voxel < field.tiles * kTileVoxels; voxel += stride()) {
    const int32_t* const coordinate = coordinates + voxel / kTileVoxels * 3;
    Coefficients<Real, Degree> sum;
    for (int p = 0; p < R::kParts; ++p) sum.part[p] = zero_pack<Real, 4>();
    for (int64_t v = 0; v < cameras.views; ++v) {
      const int64_t width = cameras.windows[4 * v + 2];
      if (width == 0) continue;
      Stand<Real> stand;
      find_stand(field, coordinate, int(voxel % kTileVoxels), cameras, v, stand);
      if (!within_reach(stand, 0) || !(stand.samples[0] > Real(0))) continue;
      Pack<Real, 4> read = zero_pack<Real, 4>();
      for (int c = 0; c < 4; ++c) {
        Share<Real> share;
        if (find_share(stand, 0, c, width, rows, share)) read += read_share(share, slots);
      }
      const Coefficients<Real, Degree> found = by_record<Real, Degree>(stand, 0, rows, read);
      for (int p = 0; p < R::kParts; ++p) sum.part[p] += found.part[p];
    }
    for (int p = 0; p < R::kParts; ++p) store_aligned<Real, 4>(gradient + voxel * R::kPitch + 4 * p, sum.part[p]);
  }
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void gather_gradient(const Grid<Real>& field, const int32_t* coordinates, const SlotCamerasArgument<Real>& given,
                       const SlotRowsArgument<Real>& rows, const void* slots, Real* gradient) const {
    SlotCameras<Real> cameras = given.view;
    const Tensor& windows = given.windows.tensor();
    // A block of pixels has at least a quarter of a window of 2 x 2: more there cannot be, and nobody need count them.
    const int64_t most = given.rays.tensor().numel() / 4, views = cameras.views;
    const Tensor offsets = torch::stable::new_empty(windows, {2, views});
    const Tensor reach = torch::stable::new_empty(windows, {most, 2}, ScalarType::Int);
    int64_t* const begin = offsets.template mutable_data_ptr<int64_t>();
    cameras.offsets = begin;
    cameras.reach_offsets = begin + views;
    cameras.reach = reach.template mutable_data_ptr<int32_t>();
    launch("gather_gradient", lay_out, 1, 1, cameras.windows, views, begin, begin + views);
    constexpr int64_t kPerView = 4;
    launch("gather_gradient", reach_blocks<Real>, views * kPerView, kThreads, cameras, rows.view, kPerView,
           reach.template mutable_data_ptr<int32_t>());
    with_slots<Real>(rows.narrow, slots, [&]<class Slot>(const Slot* typed) {
      with_degree(field.pitch, [&](auto degree) {
        const int64_t count = (field.tiles * kTileVoxels + kVoxels - 1) / kVoxels;
        launch("gather_gradient", gather_voxels<decltype(degree)::value, Real, Slot>, count, kVoxels, field,
               coordinates, cameras, rows.view, typed, gradient);
      });
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) {
  m.impl("gather_gradient", TORCH_BOX(&gather_gradient<Cuda>));
}

}  // namespace surfcap
