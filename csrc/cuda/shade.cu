// shade_forward, shade_backward on CUDA: a team of threads to a point. Memory rule: backward adds atomically.
#include "../drivers/shade.h"

#include "team.cuh"

namespace surfcap {
namespace {

template <int Degree, class Real>
__global__ void __launch_bounds__(kThreads) shade_points(const __grid_constant__ Field<Real> field, const Real* points,
                                                         const Real* directions, int64_t count, Real* values) {
  const TeamField<Real, Degree, Real> reader(field);
  for (int64_t i = first_team(); i < count; i += team_stride()) {
    const auto found = reader.fetch(reader.locate(points + 3 * i));
    const auto color = reader.color(found, reader.weights(directions + 3 * i));
    if (reader.team.lane == 0) store_aligned<Real, 4>(values + 4 * i, color);
  }
}

template <int Degree, class Real>
__global__ void __launch_bounds__(kThreads)
    scatter_colors(const __grid_constant__ Field<Real> field, const Real* points, const Real* directions,
                   const Real* grad_values, int64_t count, Real* gradient) {
  const TeamField<Real, Degree, Real> reader(field);
  for (int64_t i = first_team(); i < count; i += team_stride())
    reader.scatter(gradient, reader.locate(points + 3 * i), load_aligned<Real, 4>(grad_values + 4 * i),
                   reader.weights(directions + 3 * i));
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void shade_forward(const Field<Real>& field, const Real* points, const Real* directions, int64_t count,
                     Real* values) const {
    with_degree(field.pitch, [&](auto degree) {
      launch("shade_forward", shade_points<decltype(degree)::value, Real>, blocks(count, kTeamsPerBlock), kThreads,
             field, points, directions, count, values);
    });
  }

  template <class Real>
  void shade_backward(const Field<Real>& field, const Real* points, const Real* directions, const Real* grad_values,
                      int64_t count, int64_t, const Tensor& gradient) const {
    Real* const to = gradient.template mutable_data_ptr<Real>();
    clear(to, gradient.numel());
    with_degree(field.pitch, [&](auto degree) {
      launch("shade_backward", scatter_colors<decltype(degree)::value, Real>, blocks(count, kTeamsPerBlock), kThreads,
             field, points, directions, grad_values, count, to);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) {
  m.impl("shade_forward", TORCH_BOX(&shade_forward<Cuda>));
  m.impl("shade_backward", TORCH_BOX(&shade_backward<Cuda>));
}

}  // namespace surfcap
