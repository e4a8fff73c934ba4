// What is done with one ray: rendering, its adjoint, the fused photometric step, and the visibility of voxels.
#pragma once

#include "slots.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kBundle = 8;  // rays in flight

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

// Marches rays through a field. `room` is that of the first of kBundle rays; the others' follow it.
template <class Real, int Degree, class Opacity, class Stored = Real> struct Marcher {
  using Walk = surfcap::Walk<Real, Degree, Opacity>;
  const Field<Real, Stored>& field;
  const RaySettings<Real>& settings;
  const Opacity& opacity;
  Trace<Real, Opacity> room;
  Code<Real, Degree, Stored> code;

  SURFCAP_HD Marcher(const Field<Real, Stored>& f, const RaySettings<Real>& s, const Opacity& o,
                     const Trace<Real, Opacity>& r)
      : field(f), settings(s), opacity(o), room(r), code(f) {}

  // Begins ray i in the `slot`-th room.
  SURFCAP_HD void start(Walk& walk, const Rays<Real>& rays, int64_t i, int slot = 0) const {
    const Cells<Real> cells(field, Line<Real>(field, rays.origins + 3 * i, rays.directions + 3 * i));
    const bool known = rays.range_offsets != nullptr;
    const int64_t list = i / rays.bundle, first = known ? rays.range_offsets[list] : 0;
    const Lattice<Real> lattice(cells, settings.step, rays.shift[i], rays.ranges + (known ? 2 * first : 0),
                                known ? int32_t(rays.range_offsets[list + 1] - first) : kUnknown);
    walk.start(field, lattice, rays.directions + 3 * i,
               {room.samples + slot * room.capacity, room.footprints + slot * room.capacity / kLanes, room.capacity});
  }

  template <class Sum = Real> SURFCAP_HD void finish(Walk& walk, const Sum* gradient = nullptr) const {
    walk.finish(field, code, settings.stop, opacity, gradient);
  }

  // Both, for a ray on its own.
  SURFCAP_HD void walk(Walk& walk, const Rays<Real>& rays, int64_t i, const Real* gradient = nullptr) const {
    start(walk, rays, i);
    finish(walk, gradient);
  }

  // The walk back of ray i, whose gradient goes `to` the voxels or to slots.
  template <class Term, class To>
  SURFCAP_HD void back(const Walk& walk, int64_t i, Real r_inf, const Term& term, const To& to) const {
    walk_back<Real, Opacity>(walk.trace, walk.ray.samples, opacity, r_inf, term, to.sink(walk, i));
  }
};

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

template <class Real, int Degree, class Opacity>
SURFCAP_HD void render_ray(const Marcher<Real, Degree, Opacity>& march, const Rays<Real>& rays, int64_t i,
                           const Rendering<Real>& out) {
  typename Marcher<Real, Degree, Opacity>::Walk walk;
  march.walk(walk, rays, i);
  write_ray(walk.ray, rays.background, i, out);
}

// The adjoint of render_ray by the voxels.
template <class Real, int Degree, class Opacity>
SURFCAP_HD void render_ray_backward(const Marcher<Real, Degree, Opacity>& march, const Rays<Real>& rays, int64_t i,
                                    const Real* grad_color, const Real* grad_transmittance, const Real* grad_depth,
                                    const ToVoxels<Real, Degree>& to) {
  typename Marcher<Real, Degree, Opacity>::Walk walk;
  march.walk(walk, rays, i, to.prefetched());
  const RayResult<Real>& ray = walk.ray;
  // depth D = S/O with S = sum w t and O = sum w: dD = (t - D)/O per unit of w. Empty rays have no depth to pull on.
  const bool solid = ray.opacity > kNothing<Real>;
  const Real by_depth = solid ? grad_depth[i] / ray.opacity : Real(0);
  const Real depth = solid ? ray.sum[0] / ray.opacity : Real(0);
  const Pack<Real, 4> by_color = color_of(grad_color + 3 * i);
  const Real r_inf = dot_color<Real>(by_color, color_of(rays.background + 3 * i)) + grad_transmittance[i];
  const auto term = [&](const Sample<Real, Opacity>& sample, Pack<Real, 4>& dc) {
    dc = by_color;
    return dot_color<Real>(by_color, sample.color) + by_depth * (sample.t - depth);
  };
  march.back(walk, i, r_inf, term, to);
}

// One ray of the fused step, its walk forward done: adds (photo, sample, mask), each times the ray's weight, to
// `losses`, sends the gradient of their weighted sum `to` the voxels or to slots, and writes what the ray sees.
template <class Real, int Degree, class Opacity, class Stored, class To>
SURFCAP_HD void photometric_ray(const Marcher<Real, Degree, Opacity, Stored>& march,
                                const Walk<Real, Degree, Opacity>& walk, const Rays<Real>& rays,
                                const Observation<Real>& seen, const PhotometricSettings<Real>& loss, int64_t i,
                                double* losses, const Rendering<Real>& out, const To& to) {
  const RayResult<Real>& ray = walk.ray;
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
  const auto term = [&](const Sample<Real, Opacity>& sample, Pack<Real, 4>& dc) {
    Real distance = Real(0);
    for (int c = 1; c < 4; ++c) {
      Real derivative;
      distance += huber(sample.color[c] - own_target[c], loss.huber, derivative);
      dc[c] = by_color[c] + sample_weight * derivative;
    }
    sample_loss += (Real(1) - sample.a) * sample.transmittance * distance;
    return dot_color<Real>(by_color, sample.color) + (loss.detach_sample ? Real(0) : sample_weight * distance);
  };
  march.back(walk, i, r_inf, term, to);
  losses[0] += double(weight * photo);
  losses[1] += double(weight * sample_loss);
  losses[2] += double(weight * excess * excess);
}

// The rays begin..end of the fused step, a bundle at a time: all its rays are started before the first is gone through,
// and all are gone through before the first walk back, so that the waits for memory overlap.
template <class Real, int Degree, class Opacity, class Stored, class To>
SURFCAP_HD void photometric_rays(const Marcher<Real, Degree, Opacity, Stored>& march, const Rays<Real>& rays,
                                 const Observation<Real>& seen, const PhotometricSettings<Real>& loss, int64_t begin,
                                 int64_t end, double* losses, const Rendering<Real>& out, const To& to) {
  typename Marcher<Real, Degree, Opacity, Stored>::Walk walks[kBundle];
  for (int64_t first = begin; first < end; first += kBundle) {
    const int count = int(smaller<int64_t>(kBundle, end - first));
    for (int r = 0; r < count; ++r) march.start(walks[r], rays, first + r, r);
    for (int r = 0; r < count; ++r) march.finish(walks[r], to.prefetched());
    for (int r = 0; r < count; ++r) photometric_ray(march, walks[r], rays, seen, loss, first + r, losses, out, to);
  }
}

// Integration ranges (paper, section 4.1) of ray i: the stretches [begin, end) of distance that are not as good as
// empty, a step wider on either side than the samples whose value is under `quiet`, and two steps beyond where the ray
// ends. Writes them to `out`, which has room for one per sample, and returns their number.
template <class Real, int Degree, class Opacity, class Stored>
SURFCAP_HD int ray_ranges(const Marcher<Real, Degree, Opacity, Stored>& march, const Rays<Real>& rays, int64_t i,
                          Real quiet, Real* out) {
  typename Marcher<Real, Degree, Opacity, Stored>::Walk walk;
  march.walk(walk, rays, i);
  const RayResult<Real>& ray = walk.ray;
  const Real step = march.settings.step;
  int count = 0;
  Real end = Real(0);
  for (int k = 0; k < ray.samples; ++k) {
    const Sample<Real, Opacity>& sample = walk.trace.samples[k];
    if (!(sample.color[0] < quiet)) continue;
    if (count == 0 || sample.t - step > end) {
      out[2 * count] = sample.t - step;
      ++count;
    }
    end = sample.t + (k + 1 < ray.samples ? Real(1) : Real(3)) * step;
    out[2 * count - 1] = end;
  }
  return count;
}

// Raises, at every voxel that a sample of ray i reads with a positive weight, seen[0] to T_k and seen[1] to w_k.
template <class Real, int Degree, class Opacity, class Stored>
SURFCAP_HD void visibility_ray(const Marcher<Real, Degree, Opacity, Stored>& march, const Rays<Real>& rays, int64_t i,
                               Real* seen) {
  typename Marcher<Real, Degree, Opacity, Stored>::Walk walk;
  march.walk(walk, rays, i);
  const RayResult<Real>& ray = walk.ray;
  for (int k = 0; k < ray.samples; ++k) {
    const Sample<Real, Opacity>& sample = walk.trace.samples[k];
    const Footprints<Real>& at = walk.trace.footprints[k / kLanes];
    for (int c = 0; c < 8; ++c) {
      const int64_t voxel = at.voxel[c][k % kLanes];
      if (voxel < 0 || !(at.weight[c][k % kLanes] > Real(0))) continue;
      seen[2 * voxel] = larger(seen[2 * voxel], sample.transmittance);
      seen[2 * voxel + 1] = larger(seen[2 * voxel + 1], (Real(1) - sample.a) * sample.transmittance);
    }
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
