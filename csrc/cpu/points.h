// Points read on a CPU, kLanes of them at a time: sample, shade and upscale.
#pragma once

#include "../core/choices.h"
#include "footprints.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// The i-th of an array of points, as for_points asks for it.
template <class Real> auto listed(const Real* points) {
  return [points](int64_t i, Real* x) {
    for (int axis = 0; axis < 3; ++axis) x[axis] = points[3 * i + axis];
  };
}

// Calls f(footprints, count, first) for every kLanes of the points begin..end, given by point(i, xyz).
template <class Real, class Point, class F>
void for_points(const Field<Real>& field, int64_t begin, int64_t end, const Point& point, const F& f) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    Real x[3][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      Real at[3];
      point(first + (l < count ? l : 0), at);
      for (int axis = 0; axis < 3; ++axis) x[axis][l] = at[axis];
    }
    Pack<Real, kLanes> u[3];
    for (int axis = 0; axis < 3; ++axis) u[axis] = in_voxels(field, axis, load<Real, kLanes>(x[axis]));
    Footprints<Real> at;
    locate(field, u, at);
    f(at, count, first);
  }
}

template <class Real, class Point>
void read_points(const Field<Real>& field, int64_t begin, int64_t end, const Point& point, Real* values) {
  with_degree(field.pitch, [&](auto degree) {
    using R = Record<decltype(degree)::value>;
    const Code<Real, decltype(degree)::value, Real> code(field);
    for_points(field, begin, end, point, [&](const Footprints<Real>& at, int count, int64_t first) {
      for (int l = 0; l < count; ++l) {
        const auto record = interpolate(field, code, at, l);
        for (int p = 0; p < R::kParts; ++p)
          store<Real, R::kPart>(values + (first + l) * R::kPitch + p * R::kPart, record.part[p]);
      }
    });
  });
}

template <class Real>
void sample_forward(const Field<Real>& field, const Real* points, int64_t begin, int64_t end, Real* values) {
  read_points(field, begin, end, listed(points), values);
}

template <class Real>
void sample_backward(const Field<Real>& field, const Real* points, const Real* grad_values, int64_t begin, int64_t end,
                     Real* gradient) {
  Real spare[32] = {};
  with_degree(field.pitch, [&](auto degree) {
    constexpr int D = decltype(degree)::value;
    using R = Record<D>;
    for_points(field, begin, end, listed(points), [&](const Footprints<Real>& at, int count, int64_t first) {
      for (int l = 0; l < count; ++l) {
        Coefficients<Real, D> g;
        for (int p = 0; p < R::kParts; ++p)
          g.part[p] = load<Real, R::kPart>(grad_values + (first + l) * R::kPitch + p * R::kPart);
        scatter<Real, D>(gradient, spare, at, l, g);
      }
    });
  });
}

// (opacity value, r, g, b) at points seen along directions.
template <class Real>
void shade_forward(const Field<Real>& field, const Real* points, const Real* directions, int64_t begin, int64_t end,
                   Real* values) {
  with_degree(field.pitch, [&](auto degree) {
    constexpr int D = decltype(degree)::value;
    const Code<Real, D, Real> code(field);
    for_points(field, begin, end, listed(points), [&](const Footprints<Real>& at, int count, int64_t first) {
      prefetch<D>(field.voxels, at, count);
      for (int l = 0; l < count; ++l) {
        const auto weights = basis_weights<Real, D>(directions + 3 * (first + l));
        store<Real, 4>(values + 4 * (first + l), fold<Real, D>(interpolate(field, code, at, l), weights));
      }
    });
  });
}

template <class Real>
void shade_backward(const Field<Real>& field, const Real* points, const Real* directions, const Real* grad_values,
                    int64_t begin, int64_t end, Real* gradient) {
  Real spare[32] = {};
  with_degree(field.pitch, [&](auto degree) {
    constexpr int D = decltype(degree)::value;
    for_points(field, begin, end, listed(points), [&](const Footprints<Real>& at, int count, int64_t first) {
      prefetch<D>(gradient, at, count);
      for (int l = 0; l < count; ++l) {
        const auto weights = basis_weights<Real, D>(directions + 3 * (first + l));
        const auto by_value = load<Real, 4>(grad_values + 4 * (first + l));
        scatter<Real, D>(gradient, spare, at, l, unfold<Real, D>(by_value, weights));
      }
    });
  });
}

// The values of the fine tiles begin..end, read from the coarse field at the fine voxels' centres.
template <class Real>
void upscale(const Field<Real>& coarse, const Field<Real>& fine, const int32_t* coordinates, int64_t begin, int64_t end,
             Real* voxels) {
  const auto center = [&](int64_t i, Real* x) {
    for (int axis = 0; axis < 3; ++axis)
      x[axis] = center_of(fine, coordinates + i / kTileVoxels * 3, int(i % kTileVoxels), axis);
  };
  read_points(coarse, begin * kTileVoxels, end * kTileVoxels, center, voxels);
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
