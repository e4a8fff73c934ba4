// rasterize on CUDA: a thread to a face, then one to a pixel. Memory rule: atomic maxima, so the order does not matter.
#include "../drivers/rasterize.h"

#include "../core/raster.h"
#include "gpu.cuh"

namespace surfcap {
namespace {

template <class Real>
__global__ void __launch_bounds__(kThreads) cover_pixels(const Real* corners, const int32_t* faces, int64_t count,
                                                         int64_t height, int64_t width, Covered* pixels) {
  for (int64_t face = first_item(); face < count; face += stride())
    cover(corners, faces, face, height, width,
          [&](int64_t pixel, Covered covered) { atomicMax(pixels + pixel, covered); });
}

__global__ void __launch_bounds__(kThreads) name_faces(const Covered* pixels, int64_t count, int32_t* seen) {
  for (int64_t i = first_item(); i < count; i += stride()) seen[i] = face_of(pixels[i]);
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void rasterize(const Real* corners, const int32_t* faces, int64_t count, int64_t height, int64_t width,
                 const Tensor& seen) const {
    const Tensor buffer = torch::stable::new_zeros(seen, {height, width}, ScalarType::Long);
    auto* const pixels = static_cast<Covered*>(buffer.mutable_data_ptr());
    launch("rasterize", cover_pixels<Real>, blocks(count), kThreads, corners, faces, count, height, width, pixels);
    launch("rasterize", name_faces, blocks(height * width), kThreads, pixels, height * width,
           seen.template mutable_data_ptr<int32_t>());
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) { m.impl("rasterize", TORCH_BOX(&rasterize<Cuda>)); }

}  // namespace surfcap
