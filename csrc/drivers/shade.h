// shade_forward, shade_backward: what points look like from given directions, and the adjoint by the voxels.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
Tensor shade_forward(Tensor voxels, Tensor table, std::vector<double> frame, Tensor points, Tensor directions) {
  const Device device(SURFCAP_NAMED(voxels, table, points, directions));
  return by_real(voxels, [&]<class Real>(Real) {
    const FieldArgument<Real> field(voxels, table, frame);
    const Input<Real> at("points", points, {kAny, 3}), along("directions", directions, {points.size(0), 3});
    const Tensor values = torch::stable::new_empty(voxels, {points.size(0), 4});
    device.shade_forward(field.view, at.data(), along.data(), points.size(0), values.template mutable_data_ptr<Real>());
    return values;
  });
}

template <class Device>
Tensor shade_backward(Tensor grad_values, Tensor voxels, Tensor table, std::vector<double> frame, Tensor points,
                      Tensor directions, int64_t groups) {
  const Device device(SURFCAP_NAMED(voxels, grad_values, table, points, directions));
  return by_real(voxels, [&]<class Real>(Real) {
    const FieldArgument<Real> field(voxels, table, frame);
    const Input<Real> at("points", points, {kAny, 3}), along("directions", directions, {points.size(0), 3});
    const Input<Real> by_values("grad_values", grad_values, {points.size(0), 4});
    check_aligned("grad_values", by_values.tensor());
    const Tensor gradient = torch::stable::empty_like(field.voxels.tensor());
    device.shade_backward(field.view, at.data(), along.data(), by_values.data(), points.size(0), groups, gradient);
    return gradient;
  });
}

}  // namespace surfcap
