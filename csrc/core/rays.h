// What is done with one ray once it is composited: its picture, the adjoint, the fused photometric step, its ranges.
// Wherever `back` is taken, back(r_inf, term) walks the ray back (see walk_back) and sends the gradient to its place.
#pragma once

#include "march.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// The lattice of ray i's samples.
template <class Real>
SURFCAP_HD Lattice<Real> lattice_of(const Grid<Real>& field, const Rays<Real>& rays, Real step, int64_t i) {
  const Cells<Real> cells(field, Line<Real>(field, rays.origins + 3 * i, rays.directions + 3 * i));
  const bool known = rays.range_offsets != nullptr;
  const int64_t list = i / rays.bundle, first = known ? rays.range_offsets[list] : 0;
  return Lattice<Real>(cells, step, rays.shift[i], rays.ranges + (known ? 2 * first : 0),
                       known ? int32_t(rays.range_offsets[list + 1] - first) : kUnknown);
}

template <class Real> SURFCAP_HD Pack<Real, 4> color_of(const Real* rgb) {
  Pack<Real, 4> p = zero_pack<Real, 4>();
  for (int i = 0; i < 3; ++i) p[i + 1] = rgb[i];
  return p;
}

template <class Real> SURFCAP_HD Real dot_color(const Pack<Real, 4>& a, const Pack<Real, 4>& b) {
  const Pack<Real, 4> p = a * b;
  return p[1] + p[2] + p[3];
}

// Sum of weights up to which a ray has met nothing: such a sum can be all rounding.
template <class Real> constexpr Real kNothing = Real(sizeof(Real) == 4 ? 1e-6 : 1e-12);

// Writes what ray i sees before its background, and returns its colour in lanes 1..3.
template <class Real>
SURFCAP_HD Pack<Real, 4> write_ray(const RayResult<Real>& ray, const Real* background, int64_t i,
                                   const Rendering<Real>& out) {
  const Pack<Real, 4> color = ray.sum + ray.transmittance * color_of(background + 3 * i);
  for (int c = 0; c < 3; ++c) out.color[3 * i + c] = color[c + 1];
  out.transmittance[i] = ray.transmittance;
  out.depth[i] = ray.opacity > kNothing<Real> ? ray.sum[0] / ray.opacity : Real(__builtin_nan(""));
  return color;
}

// The adjoint of what write_ray writes.
template <class Real, class Back>
SURFCAP_HD void adjoint_ray(const RayResult<Real>& ray, const Rays<Real>& rays, int64_t i, const Real* grad_color,
                            const Real* grad_transmittance, const Real* grad_depth, const Back& back) {
  // depth D = S/O with S = sum w t and O = sum w: dD = (t - D)/O per unit of w. Empty rays have no depth to pull on.
  const bool solid = ray.opacity > kNothing<Real>;
  const Real by_depth = solid ? grad_depth[i] / ray.opacity : Real(0);
  const Real depth = solid ? ray.sum[0] / ray.opacity : Real(0);
  const Pack<Real, 4> by_color = color_of(grad_color + 3 * i);
  const Real r_inf = dot_color<Real>(by_color, color_of(rays.background + 3 * i)) + grad_transmittance[i];
  const auto term = [&](const auto& sample, Pack<Real, 4>& dc) {
    dc = by_color;
    return dot_color<Real>(by_color, sample.color) + by_depth * (sample.t - depth);
  };
  back(r_inf, term);
}

// The fused step: adds (photo, sample, mask), each times the ray's weight, to `losses`, sends the gradient of their
// weighted sum back, and writes what the ray sees.
template <class Real, class Back>
SURFCAP_HD void photometric_ray(const RayResult<Real>& ray, const Rays<Real>& rays, const Observation<Real>& seen,
                                const PhotometricSettings<Real>& loss, int64_t i, double* losses,
                                const Rendering<Real>& out, const Back& back) {
  const Pack<Real, 4> target = color_of(seen.target + 3 * i), background = color_of(rays.background + 3 * i);
  const Pack<Real, 4> rendered = write_ray(ray, rays.background, i, out);
  const Real weight = seen.weight[i];
  Pack<Real, 4> by_color = zero_pack<Real, 4>();
  Real photo = Real(0);
  for (int c = 1; c < 4; ++c) {
    Real derivative;
    photo += huber(rendered[c] - target[c], loss.huber, derivative);
    by_color[c] = weight * loss.photo * derivative;
  }
  const Real excess = ray.transmittance - Real(1) + seen.mask[i];
  const Real r_inf = dot_color<Real>(by_color, background) + Real(2) * weight * loss.mask * excess;
  const Real sample_weight = weight * loss.sample;
  const Pack<Real, 4> own_target = loss.rendered_sample ? rendered : target;
  Real sample_loss = Real(0);
  const auto term = [&](const auto& sample, Pack<Real, 4>& dc) {
    Real distance = Real(0);
    for (int c = 1; c < 4; ++c) {
      Real derivative;
      distance += huber(sample.color[c] - own_target[c], loss.huber, derivative);
      dc[c] = by_color[c] + sample_weight * derivative;
    }
    sample_loss += (Real(1) - sample.a) * sample.transmittance * distance;
    return dot_color<Real>(by_color, sample.color) + (loss.detach_sample ? Real(0) : sample_weight * distance);
  };
  back(r_inf, term);
  losses[0] += double(weight * photo);
  losses[1] += double(weight * sample_loss);
  losses[2] += double(weight * excess * excess);
}

// Integration ranges (paper, section 4.1) of a ray: the stretches [begin, end) of distance that are not as good as
// empty, a step wider on either side than the samples whose value is under `quiet`, and two steps beyond where the ray
// ends. Calls to(n, begin, end) for
// the n-th of them, and again where it turns out to be longer; returns their number.
template <class Real, class Samples, class To>
SURFCAP_HD int ray_ranges(const Samples& samples, int sample_count, Real step, Real quiet, const To& to) {
  int count = 0;
  Real begin = Real(0), end = Real(0);
  for (int k = 0; k < sample_count; ++k) {
    const auto& sample = samples[k];
    if (!(sample.color[0] < quiet)) continue;
    if (count == 0 || sample.t - step > end) {
      begin = sample.t - step;
      ++count;
    }
    end = sample.t + (k + 1 < sample_count ? Real(1) : Real(3)) * step;
    to(count - 1, begin, end);
  }
  return count;
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
