// What photometric_step and photometric_lattice share: losses and what the rays see, over fixed groups of rays.
#pragma once

#include <tuple>

#include "parallel.h"

namespace surfcap {

using StepResult = std::tuple<Tensor, Tensor, Tensor, Tensor>;  // losses, colour, transmittance, depth

// Calls work(begin, end, losses, rendering, buffer) for chunks of the rays, with the partial gradients that
// `grouped` hands out, and a sum of losses per group.
template <class Real, class Stored, class Sum, class Work, class Combine>
StepResult photometric(const PhotometricArgument<Real, Stored>& step, int64_t groups, int64_t size, Sum* total,
                       const Work& work, const Combine& combine) {
  const Tensor& like = step.rays.origins.tensor();
  const int64_t count = step.rays.view.count;
  const NewRendering<Real> out(like, count);
  const Tensor losses = torch::stable::new_zeros(like, {3}, ScalarType::Double);
  std::vector<double> by_group(size_t(groups) * 3, 0.0);
  const auto chunk = [&](int64_t begin, int64_t end, Sum* buffer, int64_t group) {
    work(begin, end, by_group.data() + 3 * group, out.view, buffer);
  };
  grouped(count, groups, size, total, total + size, chunk, combine);
  double* const sum = losses.template mutable_data_ptr<double>();
  for (size_t i = 0; i < by_group.size(); ++i) sum[i % 3] += by_group[i];
  return {losses, out.color, out.transmittance, out.depth};
}

}  // namespace surfcap
