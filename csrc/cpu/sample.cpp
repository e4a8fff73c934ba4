// sample_forward, sample_backward on the CPU.
#include "../drivers/sample.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void sample_forward(const Field<Real>& field, const Real* points, int64_t count, Real* values) const {
    parallel_ranges(count, 1024, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().sample_forward(field, points, begin, end, values);
    });
  }

  template <class Real>
  void sample_backward(const Field<Real>& field, const Real* points, const Real* grad_values, int64_t count,
                       int64_t groups, const Tensor& gradient) const {
    grouped_sum<Real>(count, groups, gradient, [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
      best_kernels<Real>().sample_backward(field, points, grad_values, begin, end, buffer);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("sample_forward", TORCH_BOX(&sample_forward<Cpu>));
  m.impl("sample_backward", TORCH_BOX(&sample_backward<Cpu>));
}

}  // namespace surfcap
