// integration_ranges: the stretches of rays that are worth sampling.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
std::tuple<Tensor, Tensor> integration_ranges(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                                              Tensor directions, Tensor shift, int64_t opacity, double slope,
                                              double step, double stop, double quiet) {
  const Device device(SURFCAP_NAMED(voxels, table, origins, directions, shift));
  return by_storage(voxels, origins.scalar_type(), [&]<class Types>(Types) -> std::tuple<Tensor, Tensor> {
    using Real = typename Types::Real;
    const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
    const RaysArgument<Real> rays(origins, directions, shift, origins);  // no background is read
    const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
    const Tensor offsets = torch::stable::new_zeros(origins, {rays.view.count + 1}, ScalarType::Long);
    const Tensor ranges = device.integration_ranges(field.view, rays.view, settings, Real(quiet), origins, offsets);
    return {offsets, ranges};
  });
}

}  // namespace surfcap
