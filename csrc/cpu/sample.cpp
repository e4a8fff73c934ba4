// sample_forward, sample_backward: the trilinear read of the tiles at points, and its adjoint.
#include "parallel.h"

namespace surfcap {

template <class Real>
Tensor sample_forward_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                            const Tensor& points) {
  const FieldArgument<Real> field(voxels, table, frame);
  const Input<Real> at("points", points, {kAny, 3});
  const Tensor values = torch::stable::new_empty(voxels, {points.size(0), field.view.pitch});
  Real* const out = values.template mutable_data_ptr<Real>();
  parallel_ranges(points.size(0), 1024, [&](int64_t begin, int64_t end) {
    best_kernels<Real>().sample_forward(field.view, at.data(), begin, end, out);
  });
  return values;
}

template <class Real>
Tensor sample_backward_typed(const Tensor& grad_values, const Tensor& voxels, const Tensor& table,
                             const std::vector<double>& frame, const Tensor& points, int64_t groups) {
  const FieldArgument<Real> field(voxels, table, frame);
  const Input<Real> at("points", points, {kAny, 3});
  const Input<Real> by_values("grad_values", grad_values, {points.size(0), field.view.pitch});
  const Tensor gradient = torch::stable::empty_like(field.voxels.tensor());
  grouped_sum<Real>(voxels, points.size(0), groups, gradient.numel(), gradient.template mutable_data_ptr<Real>(),
                    [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
                      best_kernels<Real>().sample_backward(field.view, at.data(), by_values.data(), begin, end, buffer);
                    });
  return gradient;
}

Tensor sample_forward(Tensor voxels, Tensor table, std::vector<double> frame, Tensor points) {
  return SURFCAP_BY_TYPE(voxels, sample_forward_typed, voxels, table, frame, points);
}

Tensor sample_backward(Tensor grad_values, Tensor voxels, Tensor table, std::vector<double> frame, Tensor points,
                       int64_t groups) {
  return SURFCAP_BY_TYPE(voxels, sample_backward_typed, grad_values, voxels, table, frame, points, groups);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("sample_forward", TORCH_BOX(&sample_forward));
  m.impl("sample_backward", TORCH_BOX(&sample_backward));
}

}  // namespace surfcap
