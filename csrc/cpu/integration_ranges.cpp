// integration_ranges on the CPU.
#include "../drivers/integration_ranges.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real, class Stored>
  Tensor integration_ranges(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                            Real quiet, const Tensor& like, const Tensor& offsets) const {
    int64_t* const starts = offsets.template mutable_data_ptr<int64_t>();
    // One walk: every block of rays collects its ranges, which are then laid end to end.
    const int64_t blocks = (rays.count + kChunk - 1) / kChunk;
    std::vector<std::vector<Real>> found(blocks);
    parallel_ranges(blocks, 1, [&](int64_t first, int64_t last) {
      for (int64_t b = first; b < last; ++b)
        fit_kernels<FitTypes<Real, Stored, Real>>().integration_ranges(
            field, rays, settings, quiet, b * kChunk, std::min(rays.count, (b + 1) * kChunk), starts + 1, found[b]);
    });
    for (int64_t i = 0; i < rays.count; ++i) starts[i + 1] += starts[i];
    const Tensor ranges = torch::stable::new_empty(like, {starts[rays.count], 2});
    Real* to = ranges.template mutable_data_ptr<Real>();
    for (const auto& block : found) to = std::copy(block.begin(), block.end(), to);
    return ranges;
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("integration_ranges", TORCH_BOX(&integration_ranges<Cpu>)); }

}  // namespace surfcap
