// gather_gradient: the voxels' gradient (paper, eq. 19), read from the slots that photometric_lattice has filled.
#include "parallel.h"

namespace surfcap {

// The cameras, their windows checked: reads stay inside the map and the rows.
template <class Real> struct SlotCamerasArgument {
  Input<Real> matrices, centers, shift;
  Input<int64_t> windows;
  Input<int32_t> rays;
  std::vector<int64_t> offsets, reach_offsets;
  std::vector<int32_t> reach;
  SlotCameras<Real> view;

  SlotCamerasArgument(const Tensor& m, const Tensor& c, const Tensor& w, const Tensor& r, const Tensor& s, double step,
                      const SlotRowsArgument<Real>& rows)
      : matrices("matrices", m, {kAny, 3, 3}),
        centers("centers", c, {m.size(0), 3}),
        shift("shift", s, {m.size(0)}),
        windows("windows", w, {m.size(0), 4}),
        rays("window_rays", r, {kAny}) {
    const int64_t ray_count = rows.first.tensor().size(0);
    int64_t pixels = 0, blocks = 0;
    for (int64_t v = 0; v < m.size(0); ++v) {
      const int64_t width = windows.data()[4 * v + 2], height = windows.data()[4 * v + 3];
      STD_TORCH_CHECK((width == 0 && height == 0) || (width >= 2 && height >= 2),
                      "windows: expected none or at least 2 x 2 pixels a camera, got ", width, " x ", height);
      offsets.push_back(pixels);
      pixels += width * height;
      reach_offsets.push_back(blocks);
      if (width > 0) blocks += (((width - 1) >> kReachBits) + 1) * (((height - 1) >> kReachBits) + 1);
    }
    STD_TORCH_CHECK(pixels == r.numel(), "window_rays: expected ", pixels, " pixels, as windows say, got ", r.numel());
    const auto [least, most] = std::minmax_element(rays.data(), rays.data() + pixels);
    STD_TORCH_CHECK(pixels == 0 || (*least >= -1 && *most < ray_count),
                    "window_rays: expected -1 to less than the number of rays, ", ray_count);
    STD_TORCH_CHECK(step > 0, "step: expected a positive length, got ", step);
    reach.resize(2 * blocks);
    view = {matrices.data(), centers.data(), shift.data(),         windows.data(), offsets.data(),
            rays.data(),     reach.data(),   reach_offsets.data(), m.size(0),      Real(step)};
    parallel_ranges(m.size(0), 1, [&](int64_t begin, int64_t end) {
      for (int64_t v = begin; v < end; ++v)
        if (windows.data()[4 * v + 2] > 0)
          best_kernels<Real>().find_reach(view, rows.view, v, reach.data() + 2 * reach_offsets[v]);
    });
  }
};

template <class Types>
void gather_gradient_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                           const Tensor& coordinates, const Tensor& matrices, const Tensor& centers,
                           const Tensor& windows, const Tensor& window_rays, const Tensor& shift, double step,
                           const Tensor& starts, const Tensor& first, int64_t exponent, const Tensor& slots,
                           const Tensor& gradient) {
  using Real = typename Types::Real;
  const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
  const int64_t tiles = field.view.tiles;
  const Input<int32_t> places = tile_places(coordinates, tiles, field.view.n);
  const SlotRowsArgument<Real> rows(starts, first, exponent, slots, kAny);
  const SlotCamerasArgument<Real> cameras(matrices, centers, windows, window_rays, shift, step, rows);
  Real* const to = output<Real>("gradient", gradient, {tiles, kTileSide, kTileSide, kTileSide, field.view.pitch});
  const void* const from = slots.const_data_ptr();
  parallel_ranges(tiles, 1, [&](int64_t begin, int64_t end) {
    best_kernels<Real>().gather_gradient(field.view, places.data(), cameras.view, rows.view, rows.narrow, from, begin,
                                         end, to);
  });
}

void gather_gradient(Tensor voxels, Tensor table, std::vector<double> frame, Tensor coordinates, Tensor matrices,
                     Tensor centers, Tensor windows, Tensor window_rays, Tensor shift, double step, Tensor starts,
                     Tensor first, int64_t exponent, Tensor slots, Tensor gradient) {
  by_storage(voxels, gradient.scalar_type(), [&](auto types) {
    gather_gradient_typed<decltype(types)>(voxels, table, frame, coordinates, matrices, centers, windows, window_rays,
                                           shift, step, starts, first, exponent, slots, gradient);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("gather_gradient", TORCH_BOX(&gather_gradient)); }

}  // namespace surfcap
