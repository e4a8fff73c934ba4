// upscale: the values of finer tiles, read trilinearly from a coarser field at the fine voxels' centres.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
Tensor upscale(Tensor voxels, Tensor table, std::vector<double> frame, Tensor fine_coordinates,
               std::vector<double> fine_frame) {
  const Device device(SURFCAP_NAMED(voxels, table, fine_coordinates));
  return by_real(voxels, [&]<class Real>(Real) {
    const FieldArgument<Real> coarse(voxels, table, frame);
    const Input<int32_t> places("fine_coordinates", fine_coordinates, {kAny, 3});
    const Field<Real> fine = field_view<Real>(coarse.voxels, coarse.table, fine_frame);  // only its frame is read
    const int64_t tiles = fine_coordinates.size(0), pitch = coarse.view.pitch;
    const Tensor out = torch::stable::new_empty(voxels, {tiles, kTileSide, kTileSide, kTileSide, pitch});
    device.upscale(coarse.view, fine, places.data(), tiles, out.template mutable_data_ptr<Real>());
    return out;
  });
}

}  // namespace surfcap
