// shade_forward, shade_backward on the CPU.
#include "../drivers/shade.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void shade_forward(const Field<Real>& field, const Real* points, const Real* directions, int64_t count,
                     Real* values) const {
    parallel_ranges(count, kChunk, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().shade_forward(field, points, directions, begin, end, values);
    });
  }

  template <class Real>
  void shade_backward(const Field<Real>& field, const Real* points, const Real* directions, const Real* grad_values,
                      int64_t count, int64_t groups, const Tensor& gradient) const {
    grouped_sum<Real>(count, groups, gradient, [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
      best_kernels<Real>().shade_backward(field, points, directions, grad_values, begin, end, buffer);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("shade_forward", TORCH_BOX(&shade_forward<Cpu>));
  m.impl("shade_backward", TORCH_BOX(&shade_backward<Cpu>));
}

}  // namespace surfcap
