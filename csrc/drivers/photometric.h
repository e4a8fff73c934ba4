// photometric_step: value and gradient of the photometric, sample and mask losses in one walk there and back per ray,
// with the last colours, transmittances and depths for what wants to look at them. photometric_lattice: the same up to
// the gradients of the samples, which it leaves in the slots of their rays (see core/slots.h).
#pragma once

#include "../arguments.h"

namespace surfcap {

using StepResult = std::tuple<Tensor, Tensor, Tensor, Tensor>;  // losses, colour, transmittance, depth

// Runs work(step, rendering, losses) for the arguments that both ops have in common.
template <class Types, class Work, class... Common> StepResult photometric(const Work& work, const Common&... common) {
  using Real = typename Types::Real;
  const PhotometricArgument<Real, typename Types::Stored> step(common...);
  const Tensor& like = step.rays.origins.tensor();
  const NewRendering<Real> out(like, step.rays.view.count);
  const Tensor losses = torch::stable::new_zeros(like, {3}, ScalarType::Double);
  work(step, out.view, losses);
  return {losses, out.color, out.transmittance, out.depth};
}

template <class Device>
StepResult photometric_step(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins, Tensor directions,
                            Tensor shift, Tensor background, Tensor target, Tensor mask, Tensor weight,
                            std::optional<Tensor> range_offsets, std::optional<Tensor> ranges, int64_t bundle,
                            int64_t opacity, double slope, double step, double stop, double huber,
                            std::vector<double> weights, bool detach_sample, bool rendered_sample, Tensor gradients) {
  const Device device(SURFCAP_NAMED(voxels, table, origins, directions, shift, background, target, mask, weight,
                                    range_offsets.value_or(voxels), ranges.value_or(voxels), gradients));
  return by_storage(voxels, gradients.scalar_type(), [&]<class Types>(Types) {
    const auto work = [&](const auto& step, const auto& out, const Tensor& losses) {
      const auto& field = step.field.view;
      const int64_t groups = gradients.dim() > 0 ? gradients.size(0) : 0;
      STD_TORCH_CHECK(groups >= 1, "gradients: expected [groups, *voxels.shape] with at least one group, got ",
                      shape_of(gradients));
      const Shape shape = {groups, field.tiles, kTileSide, kTileSide, kTileSide, field.pitch};
      device.photometric_step(field, step.rays.view, step.settings, step.seen, step.loss, out, losses, groups,
                              output<typename Types::Sum>("gradients", gradients, shape));
    };
    return photometric<Types>(work, voxels, table, frame, origins, directions, shift, background, target, mask, weight,
                              range_offsets, ranges, bundle, opacity, slope, step, stop, huber, weights, detach_sample,
                              rendered_sample);
  });
}

template <class Device>
StepResult photometric_lattice(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                               Tensor directions, Tensor shift, Tensor background, Tensor target, Tensor mask,
                               Tensor weight, std::optional<Tensor> range_offsets, std::optional<Tensor> ranges,
                               int64_t bundle, int64_t opacity, double slope, double step, double stop, double huber,
                               std::vector<double> weights, bool detach_sample, bool rendered_sample, Tensor starts,
                               Tensor first, int64_t exponent, Tensor slots) {
  const Device device(SURFCAP_NAMED(voxels, table, origins, directions, shift, background, target, mask, weight,
                                    range_offsets.value_or(voxels), ranges.value_or(voxels), starts, first, slots));
  return by_storage(voxels, origins.scalar_type(), [&]<class Types>(Types) {
    const auto work = [&](const auto& step, const auto& out, const Tensor& losses) {
      using Real = typename Types::Real;
      const SlotRowsArgument<Real> rows(starts, first, exponent, slots, step.rays.view.count);
      device.photometric_lattice(step.field.view, step.rays.view, step.settings, step.seen, step.loss, out, losses,
                                 rows.view, rows.narrow, slots.mutable_data_ptr());
    };
    return photometric<Types>(work, voxels, table, frame, origins, directions, shift, background, target, mask, weight,
                              range_offsets, ranges, bundle, opacity, slope, step, stop, huber, weights, detach_sample,
                              rendered_sample);
  });
}

}  // namespace surfcap
