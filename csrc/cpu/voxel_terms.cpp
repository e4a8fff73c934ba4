// voxel_terms on the CPU.
#include "../drivers/voxel_terms.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real, class Stored, class Sum>
  void voxel_terms(const Field<Real, Stored>& field, const int32_t* coordinates, const VoxelTerms<Real>& terms,
                   const Tensor& losses, Sum* gradient) const {
    // A fixed number of blocks, each with its own sums, so that the values do not depend on the threads.
    constexpr int64_t kBlocks = 64;
    double by_block[kBlocks][kVoxelTerms] = {};
    parallel_ranges(kBlocks, 1, [&](int64_t first, int64_t last) {
      for (int64_t b = first; b < last; ++b)
        fit_kernels<FitTypes<Real, Stored, Sum>>().voxel_terms(field, coordinates, terms, b * field.tiles / kBlocks,
                                                               (b + 1) * field.tiles / kBlocks, by_block[b], gradient);
    });
    double* const total = losses.template mutable_data_ptr<double>();
    for (const auto& block : by_block)
      for (int i = 0; i < kVoxelTerms; ++i) total[i] += block[i];
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("voxel_terms", TORCH_BOX(&voxel_terms<Cpu>)); }

}  // namespace surfcap
