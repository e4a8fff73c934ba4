// photometric_step: photometric, sample and mask loss of many rays, and the gradient of their weighted sum, in one
// call. The caller gives the memory for the partial gradients, because a fit uses the same in every iteration; fresh
// pages would cost a third of the step.
#include <tuple>

#include "parallel.h"

namespace surfcap {

using StepResult = std::tuple<Tensor, Tensor, Tensor>;  // losses, colour, transmittance

template <class Types>
StepResult photometric_step_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                                  const Tensor& origins, const Tensor& directions, const Tensor& shift,
                                  const Tensor& background, const Tensor& target, const Tensor& mask,
                                  const Tensor& weight, const std::optional<Tensor>& range_offsets,
                                  const std::optional<Tensor>& ranges, int64_t opacity, double slope, double step,
                                  double stop, double huber, const std::vector<double>& weights, bool detach_sample,
                                  const Tensor& gradients) {
  using Real = typename Types::Real;
  using Sum = typename Types::Sum;
  const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
  RaysArgument<Real> rays(origins, directions, shift, background);
  const RangesArgument<Real> stretches(range_offsets, ranges, rays.view);
  const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
  const int64_t count = rays.view.count;
  const Input<Real> photograph("target", target, {count, 3});
  const Input<Real> silhouette("mask", mask, {count});
  const Input<Real> importance("weight", weight, {count});
  STD_TORCH_CHECK(weights.size() == 3, "weights: expected [photo, sample, mask], got ", weights.size(), " numbers");
  const Observation<Real> seen{photograph.data(), silhouette.data(), importance.data()};
  const PhotometricSettings<Real> loss{Real(huber), Real(weights[0]), Real(weights[1]), Real(weights[2]),
                                       detach_sample};

  const int64_t groups = gradients.dim() > 0 ? gradients.size(0) : 0, size = field.voxels.tensor().numel();
  STD_TORCH_CHECK(groups >= 1, "gradients: expected [groups, *voxels.shape] with at least one group, got ",
                  shape_of(gradients));
  Sum* const total = output<Sum>("gradients", gradients,
                                 {groups, field.view.tiles, kTileSide, kTileSide, kTileSide, field.view.pitch});
  const Tensor color = torch::stable::new_empty(origins, {count, 3});
  const Tensor transmittance = torch::stable::new_empty(origins, {count});
  const Tensor losses = torch::stable::new_zeros(origins, {3}, ScalarType::Double);
  advise_large_pages(total, groups * size * int64_t(sizeof(Sum)));
  Real *const c = color.template mutable_data_ptr<Real>(), *const t = transmittance.template mutable_data_ptr<Real>();
  std::vector<double> by_group(size_t(groups) * 3, 0.0);
  const auto work = [&](int64_t begin, int64_t end, Sum* buffer, int64_t group) {
    fit_kernels<Types>().photometric_step(field.view, rays.view, settings, seen, loss, begin, end,
                                          by_group.data() + 3 * group, c, t, buffer);
  };
  grouped(count, groups, size, total, total + size, work, fit_kernels<Types>().add_sums);
  double* const sum = losses.template mutable_data_ptr<double>();
  for (size_t i = 0; i < by_group.size(); ++i) sum[i % 3] += by_group[i];
  return {losses, color, transmittance};
}

StepResult photometric_step(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins, Tensor directions,
                            Tensor shift, Tensor background, Tensor target, Tensor mask, Tensor weight,
                            std::optional<Tensor> range_offsets, std::optional<Tensor> ranges, int64_t opacity,
                            double slope, double step, double stop, double huber, std::vector<double> weights,
                            bool detach_sample, Tensor gradients) {
  return by_storage(voxels, gradients.scalar_type(), [&](auto types) {
    return photometric_step_typed<decltype(types)>(voxels, table, frame, origins, directions, shift, background, target,
                                                   mask, weight, range_offsets, ranges, opacity, slope, step, stop,
                                                   huber, weights, detach_sample, gradients);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("photometric_step", TORCH_BOX(&photometric_step)); }

}  // namespace surfcap
