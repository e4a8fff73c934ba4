// integration_ranges: the stretches of rays that are worth sampling.
#include <tuple>

#include "parallel.h"

namespace surfcap {

template <class Types>
std::tuple<Tensor, Tensor> integration_ranges_typed(const Tensor& voxels, const Tensor& table,
                                                    const std::vector<double>& frame, const Tensor& origins,
                                                    const Tensor& directions, const Tensor& shift, int64_t opacity,
                                                    double slope, double step, double stop, double quiet) {
  using Real = typename Types::Real;
  const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
  const RaysArgument<Real> rays(origins, directions, shift, origins);  // no background is read
  const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
  const int64_t count = rays.view.count;
  const Tensor offsets = torch::stable::new_zeros(origins, {count + 1}, ScalarType::Long);
  int64_t* const starts = offsets.template mutable_data_ptr<int64_t>();
  // One walk: every block of rays collects its ranges, which are then laid end to end.
  const int64_t blocks = (count + kChunk - 1) / kChunk;
  std::vector<std::vector<Real>> found(blocks);
  parallel_ranges(blocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t b = first; b < last; ++b)
      fit_kernels<Types>().integration_ranges(field.view, rays.view, settings, Real(quiet), b * kChunk,
                                              std::min(count, (b + 1) * kChunk), starts + 1, found[b]);
  });
  for (int64_t i = 0; i < count; ++i) starts[i + 1] += starts[i];
  const Tensor ranges = torch::stable::new_empty(origins, {starts[count], 2});
  Real* to = ranges.template mutable_data_ptr<Real>();
  for (const auto& block : found) to = std::copy(block.begin(), block.end(), to);
  return {offsets, ranges};
}

std::tuple<Tensor, Tensor> integration_ranges(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                                              Tensor directions, Tensor shift, int64_t opacity, double slope,
                                              double step, double stop, double quiet) {
  return by_storage(voxels, origins.scalar_type(), [&](auto types) {
    return integration_ranges_typed<decltype(types)>(voxels, table, frame, origins, directions, shift, opacity, slope,
                                                     step, stop, quiet);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("integration_ranges", TORCH_BOX(&integration_ranges)); }

}  // namespace surfcap
