// integration_ranges: the stretches of rays that pass non-empty cells.
#include <tuple>

#include "parallel.h"

namespace surfcap {

template <class Real>
std::tuple<Tensor, Tensor> integration_ranges_typed(const Tensor& voxels, const Tensor& table,
                                                    const std::vector<double>& frame, const Tensor& origins,
                                                    const Tensor& directions) {
  const FieldArgument<Real> field(voxels, table, frame);
  const Input<Real> from("origins", origins, {kAny, 3}), along("directions", directions, {origins.size(0), 3});
  Rays<Real> rays{from.data(), along.data(), nullptr, nullptr, origins.size(0), nullptr, nullptr};
  const Tensor offsets = torch::stable::new_zeros(origins, {rays.count + 1}, ScalarType::Long);
  int64_t* const starts = offsets.template mutable_data_ptr<int64_t>();
  const auto for_rays = [&](int64_t* counts, Real* ranges) {
    parallel_ranges(rays.count, kChunk, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().integration_ranges(field.view, rays, begin, end, counts, ranges);
    });
  };
  for_rays(starts + 1, nullptr);
  for (int64_t i = 0; i < rays.count; ++i) starts[i + 1] += starts[i];
  rays.range_offsets = starts;
  const Tensor ranges = torch::stable::new_empty(origins, {starts[rays.count], 2});
  for_rays(nullptr, ranges.template mutable_data_ptr<Real>());
  return {offsets, ranges};
}

std::tuple<Tensor, Tensor> integration_ranges(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                                              Tensor directions) {
  return SURFCAP_BY_TYPE(voxels, integration_ranges_typed, voxels, table, frame, origins, directions);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("integration_ranges", TORCH_BOX(&integration_ranges)); }

}  // namespace surfcap
