// sample_forward, sample_backward on CUDA: a team of threads to a point. Memory rule: backward adds atomically.
#include "../drivers/sample.h"

#include "team.cuh"

namespace surfcap {
namespace {

template <int Degree, class Real>
__global__ void __launch_bounds__(kThreads)
    sample_points(const __grid_constant__ Field<Real> field, const Real* points, int64_t count, Real* values) {
  const TeamField<Real, Degree, Real> reader(field);
  for (int64_t i = first_team(); i < count; i += team_stride()) {
    const auto record = reader.read(reader.fetch(reader.locate(points + 3 * i)));
    if (reader.leads()) store_aligned<Real, 4>(values + i * reader.kPitch + 4 * reader.part(), record);
  }
}

template <int Degree, class Real>
__global__ void __launch_bounds__(kThreads)
    scatter_points(const __grid_constant__ Field<Real> field, const Real* points, const Real* grad_values,
                   int64_t count, Real* gradient) {
  const TeamField<Real, Degree, Real> reader(field);
  for (int64_t i = first_team(); i < count; i += team_stride())
    reader.scatter(gradient, reader.locate(points + 3 * i),
                   load_aligned<Real, 4>(grad_values + i * reader.kPitch + 4 * reader.part()));
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void sample_forward(const Field<Real>& field, const Real* points, int64_t count, Real* values) const {
    with_degree(field.pitch, [&](auto degree) {
      launch("sample_forward", sample_points<decltype(degree)::value, Real>, blocks(count, kTeamsPerBlock), kThreads,
             field, points, count, values);
    });
  }

  template <class Real>
  void sample_backward(const Field<Real>& field, const Real* points, const Real* grad_values, int64_t count, int64_t,
                       const Tensor& gradient) const {
    Real* const to = gradient.template mutable_data_ptr<Real>();
    clear(to, gradient.numel());
    with_degree(field.pitch, [&](auto degree) {
      launch("sample_backward", scatter_points<decltype(degree)::value, Real>, blocks(count, kTeamsPerBlock), kThreads,
             field, points, grad_values, count, to);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) {
  m.impl("sample_forward", TORCH_BOX(&sample_forward<Cuda>));
  m.impl("sample_backward", TORCH_BOX(&sample_backward<Cuda>));
}

}  // namespace surfcap
