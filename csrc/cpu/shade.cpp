// shade_forward, shade_backward: what points look like from given directions, and the adjoint by the voxels.
#include "parallel.h"

namespace surfcap {

template <class Real>
Tensor shade_forward_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                           const Tensor& points, const Tensor& directions) {
  const FieldArgument<Real> field(voxels, table, frame);
  const Input<Real> at("points", points, {kAny, 3}), along("directions", directions, {points.size(0), 3});
  const Tensor values = torch::stable::new_empty(voxels, {points.size(0), 4});
  Real* const out = values.template mutable_data_ptr<Real>();
  parallel_ranges(points.size(0), kChunk, [&](int64_t begin, int64_t end) {
    best_kernels<Real>().shade_forward(field.view, at.data(), along.data(), begin, end, out);
  });
  return values;
}

template <class Real>
Tensor shade_backward_typed(const Tensor& grad_values, const Tensor& voxels, const Tensor& table,
                            const std::vector<double>& frame, const Tensor& points, const Tensor& directions,
                            int64_t groups) {
  const FieldArgument<Real> field(voxels, table, frame);
  const Input<Real> at("points", points, {kAny, 3}), along("directions", directions, {points.size(0), 3});
  const Input<Real> by_values("grad_values", grad_values, {points.size(0), 4});
  const Tensor gradient = torch::stable::empty_like(field.voxels.tensor());
  grouped_sum<Real>(voxels, points.size(0), groups, gradient.numel(), gradient.template mutable_data_ptr<Real>(),
                    [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
                      best_kernels<Real>().shade_backward(field.view, at.data(), along.data(), by_values.data(), begin,
                                                          end, buffer);
                    });
  return gradient;
}

Tensor shade_forward(Tensor voxels, Tensor table, std::vector<double> frame, Tensor points, Tensor directions) {
  return SURFCAP_BY_TYPE(voxels, shade_forward_typed, voxels, table, frame, points, directions);
}

Tensor shade_backward(Tensor grad_values, Tensor voxels, Tensor table, std::vector<double> frame, Tensor points,
                      Tensor directions, int64_t groups) {
  return SURFCAP_BY_TYPE(voxels, shade_backward_typed, grad_values, voxels, table, frame, points, directions, groups);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("shade_forward", TORCH_BOX(&shade_forward));
  m.impl("shade_backward", TORCH_BOX(&shade_backward));
}

}  // namespace surfcap
