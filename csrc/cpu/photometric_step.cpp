// photometric_step: photometric, sample and mask loss of many rays, and the gradient of their weighted sum, in one
// call. The caller gives the memory for the partial gradients, because a fit uses the same in every iteration; fresh
// pages would cost a third of the step.
#include "photometric.h"

namespace surfcap {

template <class Types, class... Common>
StepResult photometric_step_typed(const Tensor& gradients, const Common&... common) {
  using Real = typename Types::Real;
  using Sum = typename Types::Sum;
  const PhotometricArgument<Real, typename Types::Stored> step(common...);
  const auto& field = step.field.view;
  const int64_t groups = gradients.dim() > 0 ? gradients.size(0) : 0, size = step.field.voxels.tensor().numel();
  STD_TORCH_CHECK(groups >= 1, "gradients: expected [groups, *voxels.shape] with at least one group, got ",
                  shape_of(gradients));
  Sum* const total =
      output<Sum>("gradients", gradients, {groups, field.tiles, kTileSide, kTileSide, kTileSide, field.pitch});
  advise_large_pages(total, groups * size * int64_t(sizeof(Sum)));
  const auto work = [&](int64_t begin, int64_t end, double* losses, const Rendering<Real>& out, Sum* buffer) {
    fit_kernels<Types>().photometric_step(field, step.rays.view, step.settings, step.seen, step.loss, begin, end,
                                          losses, out, buffer);
  };
  return photometric(step, groups, size, total, work, fit_kernels<Types>().add_sums);
}

StepResult photometric_step(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins, Tensor directions,
                            Tensor shift, Tensor background, Tensor target, Tensor mask, Tensor weight,
                            std::optional<Tensor> range_offsets, std::optional<Tensor> ranges, int64_t bundle,
                            int64_t opacity, double slope, double step, double stop, double huber,
                            std::vector<double> weights, bool detach_sample, bool rendered_sample, Tensor gradients) {
  return by_storage(voxels, gradients.scalar_type(), [&](auto types) {
    return photometric_step_typed<decltype(types)>(
        gradients, voxels, table, frame, origins, directions, shift, background, target, mask, weight, range_offsets,
        ranges, bundle, opacity, slope, step, stop, huber, weights, detach_sample, rendered_sample);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("photometric_step", TORCH_BOX(&photometric_step)); }

}  // namespace surfcap
