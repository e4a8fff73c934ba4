// gather_gradient: the voxels' gradient (paper, eq. 19), read from the slots that photometric_lattice has filled.
#pragma once

#include "../arguments.h"

namespace surfcap {

// The cameras as they are given; where their windows' pixels begin, and the reach of these, is the device's to find.
template <class Real> struct SlotCamerasArgument {
  Input<Real> matrices, centers, shift;
  Input<int64_t> windows;
  Input<int32_t> rays;
  SlotCameras<Real> view;

  SlotCamerasArgument(const Tensor& m, const Tensor& c, const Tensor& w, const Tensor& r, const Tensor& s, double step)
      : matrices("matrices", m, {kAny, 3, 3}),
        centers("centers", c, {m.size(0), 3}),
        shift("shift", s, {m.size(0)}),
        windows("windows", w, {m.size(0), 4}),
        rays("window_rays", r, {kAny}),
        view{matrices.data(), centers.data(), shift.data(), windows.data(), nullptr,
             rays.data(),     nullptr,        nullptr,      m.size(0),      Real(step)} {
    STD_TORCH_CHECK(step > 0, "step: expected a positive length, got ", step);
  }
};

template <class Device>
void gather_gradient(Tensor voxels, Tensor table, std::vector<double> frame, Tensor coordinates, Tensor matrices,
                     Tensor centers, Tensor windows, Tensor window_rays, Tensor shift, double step, Tensor starts,
                     Tensor first, int64_t exponent, Tensor slots, Tensor gradient) {
  const Device device(SURFCAP_NAMED(voxels, table, coordinates, matrices, centers, windows, window_rays, shift, starts,
                                    first, slots, gradient));
  by_storage(voxels, gradient.scalar_type(), [&]<class Types>(Types) {
    using Real = typename Types::Real;
    const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
    const int64_t tiles = field.view.tiles;
    const Input<int32_t> places = tile_places(coordinates, tiles, field.view.n);
    const SlotRowsArgument<Real> rows(starts, first, exponent, slots, kAny);
    const SlotCamerasArgument<Real> cameras(matrices, centers, windows, window_rays, shift, step);
    Real* const to = output<Real>("gradient", gradient, {tiles, kTileSide, kTileSide, kTileSide, field.view.pitch});
    device.gather_gradient(static_cast<const Grid<Real>&>(field.view), places.data(), cameras, rows,
                           slots.const_data_ptr(), to);
  });
}

}  // namespace surfcap
