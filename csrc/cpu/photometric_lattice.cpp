// photometric_lattice: photometric_step up to the gradients of the samples, which it leaves in the slots of their rays
// (see core/slots.h). Every ray owns its row, so the rays need neither atomics nor buffers of their own.
#include "photometric.h"

namespace surfcap {

constexpr int64_t kLossGroups = 64;  // sums of losses, so that the values do not depend on the threads

template <class Types, class... Common>
StepResult photometric_lattice_typed(const Tensor& starts, const Tensor& first, int64_t exponent, const Tensor& slots,
                                     const Common&... common) {
  using Real = typename Types::Real;
  const PhotometricArgument<Real, typename Types::Stored> step(common...);
  const SlotRowsArgument<Real> rows(starts, first, exponent, slots, step.rays.view.count);
  void* const to = slots.mutable_data_ptr();
  const auto work = [&](int64_t begin, int64_t end, double* losses, const Rendering<Real>& out, Real*) {
    fit_kernels<Types>().photometric_lattice(step.field.view, step.rays.view, step.settings, step.seen, step.loss,
                                             rows.view, rows.narrow, begin, end, losses, out, to);
  };
  const auto nothing = [](Real*, const Real*, int64_t, int64_t) {};
  return photometric(step, kLossGroups, 0, static_cast<Real*>(nullptr), work, nothing);
}

StepResult photometric_lattice(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                               Tensor directions, Tensor shift, Tensor background, Tensor target, Tensor mask,
                               Tensor weight, std::optional<Tensor> range_offsets, std::optional<Tensor> ranges,
                               int64_t bundle, int64_t opacity, double slope, double step, double stop, double huber,
                               std::vector<double> weights, bool detach_sample, bool rendered_sample, Tensor starts,
                               Tensor first, int64_t exponent, Tensor slots) {
  return by_storage(voxels, origins.scalar_type(), [&](auto types) {
    return photometric_lattice_typed<decltype(types)>(starts, first, exponent, slots, voxels, table, frame, origins,
                                                      directions, shift, background, target, mask, weight,
                                                      range_offsets, ranges, bundle, opacity, slope, step, stop, huber,
                                                      weights, detach_sample, rendered_sample);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("photometric_lattice", TORCH_BOX(&photometric_lattice)); }

}  // namespace surfcap
