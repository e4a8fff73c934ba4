// visibility: per voxel the largest transmittance and the largest weight of the samples that read it.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
Tensor visibility(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins, Tensor directions,
                  Tensor shift, int64_t opacity, double slope, double step, double stop, int64_t groups) {
  const Device device(SURFCAP_NAMED(voxels, table, origins, directions, shift));
  return by_storage(voxels, origins.scalar_type(), [&]<class Types>(Types) {
    using Real = typename Types::Real;
    const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
    const RaysArgument<Real> rays(origins, directions, shift, origins);  // no background is read
    const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
    const int64_t tiles = field.view.tiles;
    const Tensor seen = torch::stable::new_empty(origins, {tiles, kTileSide, kTileSide, kTileSide, 2});
    device.visibility(field.view, rays.view, settings, groups, seen);
    return seen;
  });
}

}  // namespace surfcap
