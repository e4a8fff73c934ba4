// sample_forward, sample_backward: the trilinear read of the tiles at points, and its adjoint.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device> Tensor sample_forward(Tensor voxels, Tensor table, std::vector<double> frame, Tensor points) {
  const Device device(SURFCAP_NAMED(voxels, table, points));
  return by_real(voxels, [&]<class Real>(Real) {
    const FieldArgument<Real> field(voxels, table, frame);
    const Input<Real> at("points", points, {kAny, 3});
    const Tensor values = torch::stable::new_empty(voxels, {points.size(0), field.view.pitch});
    device.sample_forward(field.view, at.data(), points.size(0), values.template mutable_data_ptr<Real>());
    return values;
  });
}

template <class Device>
Tensor sample_backward(Tensor grad_values, Tensor voxels, Tensor table, std::vector<double> frame, Tensor points,
                       int64_t groups) {
  const Device device(SURFCAP_NAMED(voxels, grad_values, table, points));
  return by_real(voxels, [&]<class Real>(Real) {
    const FieldArgument<Real> field(voxels, table, frame);
    const Input<Real> at("points", points, {kAny, 3});
    const Input<Real> by_values("grad_values", grad_values, {points.size(0), field.view.pitch});
    check_aligned("grad_values", by_values.tensor());
    const Tensor gradient = torch::stable::empty_like(field.voxels.tensor());
    device.sample_backward(field.view, at.data(), by_values.data(), points.size(0), groups, gradient);
    return gradient;
  });
}

}  // namespace surfcap
