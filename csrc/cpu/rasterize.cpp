// rasterize on the CPU: the threads share the faces, and pixels keep the greatest of what they are offered, in any
// order.
#include "../drivers/rasterize.h"

#include <atomic>
#include <cmath>

#include "../core/raster.h"
#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void rasterize(const Real* corners, const int32_t* faces, int64_t count, int64_t height, int64_t width,
                 const Tensor& seen) const {
    std::vector<Covered> pixels(height * width, 0);
    parallel_ranges(count, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t face = begin; face < end; ++face)
        cover(corners, faces, face, height, width, [&](int64_t pixel, Covered covered) {
          std::atomic_ref<Covered> kept(pixels[pixel]);
          for (Covered before = kept.load(std::memory_order_relaxed);
               before < covered && !kept.compare_exchange_weak(before, covered, std::memory_order_relaxed);) {}
        });
    });
    std::transform(pixels.begin(), pixels.end(), seen.template mutable_data_ptr<int32_t>(), face_of);
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("rasterize", TORCH_BOX(&rasterize<Cpu>)); }

}  // namespace surfcap
