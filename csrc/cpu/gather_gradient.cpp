// gather_gradient on the CPU.
#include "../drivers/gather_gradient.h"

#include "parallel.h"

namespace surfcap {
namespace {

// The cameras' windows, checked so that reads stay inside the map and the rows, and their reach.
template <class Real> struct WindowMap {
  std::vector<int64_t> offsets, reach_offsets;
  std::vector<int32_t> reach;
  SlotCameras<Real> cameras;

  WindowMap(const SlotCamerasArgument<Real>& given, const SlotRowsArgument<Real>& rows) : cameras(given.view) {
    const int64_t ray_count = rows.first.tensor().size(0), mapped = given.rays.tensor().numel();
    int64_t pixels = 0, blocks = 0;
    for (int64_t v = 0; v < cameras.views; ++v) {
      const int64_t width = cameras.windows[4 * v + 2], height = cameras.windows[4 * v + 3];
      STD_TORCH_CHECK((width == 0 && height == 0) || (width >= 2 && height >= 2),
                      "windows: expected none or at least 2 x 2 pixels a camera, got ", width, " x ", height);
      offsets.push_back(pixels);
      pixels += width * height;
      reach_offsets.push_back(blocks);
      blocks += blocks_along(width) * blocks_along(height);
    }
    STD_TORCH_CHECK(pixels == mapped, "window_rays: expected ", pixels, " pixels, as windows say, got ", mapped);
    const auto [least, most] = std::minmax_element(cameras.rays, cameras.rays + pixels);
    STD_TORCH_CHECK(pixels == 0 || (*least >= -1 && *most < ray_count),
                    "window_rays: expected -1 to less than the number of rays, ", ray_count);
    reach.resize(2 * blocks);
    cameras.offsets = offsets.data();
    cameras.reach = reach.data();
    cameras.reach_offsets = reach_offsets.data();
    parallel_ranges(cameras.views, 1, [&](int64_t begin, int64_t end) {
      for (int64_t v = begin; v < end; ++v)
        best_kernels<Real>().reach_of_view(cameras, rows.view, v, reach.data() + 2 * reach_offsets[v]);
    });
  }
};

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void gather_gradient(const Grid<Real>& field, const int32_t* coordinates, const SlotCamerasArgument<Real>& given,
                       const SlotRowsArgument<Real>& rows, const void* slots, Real* gradient) const {
    const WindowMap<Real> map(given, rows);
    parallel_ranges(field.tiles, 1, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().gather_gradient(field, coordinates, map.cameras, rows.view, rows.narrow, slots, begin, end,
                                           gradient);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("gather_gradient", TORCH_BOX(&gather_gradient<Cpu>)); }

}  // namespace surfcap
