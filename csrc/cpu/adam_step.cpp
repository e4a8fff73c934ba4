// adam_step on the CPU.
#include "../drivers/adam_step.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real, class Stored, class Sum>
  void adam_step(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second, int32_t pitch,
                 int64_t tiles, const AdamSettings<Real>& adam) const {
    parallel_ranges(tiles, 64, [&](int64_t begin, int64_t end) {
      fit_kernels<FitTypes<Real, Stored, Sum>>().adam_step(value, gradient, first, second, pitch, begin, end, adam);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("adam_step", TORCH_BOX(&adam_step<Cpu>)); }

}  // namespace surfcap
