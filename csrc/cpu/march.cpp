// march_forward, march_backward on the CPU.
#include "../drivers/march.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void march_forward(const Field<Real>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                     const Rendering<Real>& out, const Tensor&) const {
    parallel_ranges(rays.count, kChunk, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().march_forward(field, rays, settings, begin, end, out);
    });
  }

  template <class Real>
  void march_backward(const Field<Real>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                      const Real* grad_color, const Real* grad_transmittance, const Real* grad_depth, int64_t groups,
                      const Tensor& gradient) const {
    grouped_sum<Real>(rays.count, groups, gradient, [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
      best_kernels<Real>().march_backward(field, rays, settings, grad_color, grad_transmittance, grad_depth, begin, end,
                                          buffer);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("march_forward", TORCH_BOX(&march_forward<Cpu>));
  m.impl("march_backward", TORCH_BOX(&march_backward<Cpu>));
}

}  // namespace surfcap
