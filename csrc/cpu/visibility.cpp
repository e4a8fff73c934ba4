// visibility on the CPU.
#include "../drivers/visibility.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real, class Stored>
  void visibility(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                  int64_t groups, const Tensor& seen) const {
    const auto walk = [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
      fit_kernels<FitTypes<Real, Stored, Real>>().visibility(field, rays, settings, begin, end, buffer);
    };
    grouped<Real>(rays.count, groups, seen, walk, [](Real* most, const Real* other, int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) most[i] = std::max(most[i], other[i]);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("visibility", TORCH_BOX(&visibility<Cpu>)); }

}  // namespace surfcap
