// One ray through the field, there and back.
//
// Forward (front to back), T_0 = 1:   T_{k+1} = a_k T_k,  w_k = (1 - a_k) T_k,  C = sum w_k c_k + T_K C_bg.
// Any loss that is linear in the weights, sum_k w_k r_k + T_K r_inf, has by a_k the derivative T_k (R_k - r_k) with
//   R_{K-1} = r_inf,   R_k = (1 - a_{k+1}) r_{k+1} + a_{k+1} R_{k+1},
// so one walk from back to front over the remembered (a_k, c_k, T_k) gives every gradient, without the division by a_k
// of the paper's eq. 17.
#pragma once

#include "lattice.h"
#include "opacity.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// What the walk back needs of a sample.
template <class Real, class Opacity> struct Sample {
  Pack<Real, 4> color;  // the field's opacity value here, then r, g, b as composited
  Real t, a, transmittance;
  typename Opacity::State before, now;
  int32_t k;  // its index on the lattice
  bool starts_run;
};

template <class Real> struct RayResult {
  Pack<Real, 4> sum;   // lane 0: sum of w t, then sum of w c
  Real transmittance;  // T_K
  Real opacity;        // sum of w, not 1 - T_K: no cancellation
  int samples;
};

// Composites the samples of a ray from front to back.
template <class Real, class Opacity> struct Compositor {
  RayResult<Real> ray;

  SURFCAP_HD explicit Compositor(const Opacity& o)
      : ray{zero_pack<Real, 4>(), Real(1), Real(0), 0},
        opacity_(o),
        before_(o.outside()),
        color_before_(zero_pack<Real, 4>()),
        k_before_(-2) {}

  // The next sample, with the index k and at the distance t, where the field is `color`: (opacity value, r, g, b).
  SURFCAP_HD void add(Pack<Real, 4> color, int32_t k, Real t, Sample<Real, Opacity>& sample) {
    sample.starts_run = k != k_before_ + 1;
    k_before_ = k;
    sample.before = sample.starts_run ? opacity_.outside() : before_;
    sample.now = before_ = opacity_.prepare(color[0]);
    sample.a = opacity_.transparency(sample.before, sample.now);
    sample.t = t;
    sample.k = k;
    sample.transmittance = ray.transmittance;
    if constexpr (Opacity::kMidpointColor) {
      const Pack<Real, 4> here = color;
      if (!sample.starts_run) color = Real(0.5) * (here + color_before_);
      color[0] = here[0];
      color_before_ = here;
    }
    sample.color = color;
    const Real w = (Real(1) - sample.a) * ray.transmittance;
    color[0] = t;  // the sum's first lane is the depth's
    ray.sum += w * color;
    ray.opacity += w;
    ray.transmittance *= sample.a;
    ++ray.samples;
  }

 private:
  const Opacity& opacity_;
  typename Opacity::State before_;
  Pack<Real, 4> color_before_;
  int32_t k_before_;
};

// The most samples a ray can have in this field.
template <class Real> SURFCAP_HD int64_t most_samples(const Grid<Real>& grid, Real step) {
  Real squared = Real(0);
  for (int i = 0; i < 3; ++i) squared += Real(kTile * grid.n[i]) * Real(kTile * grid.n[i]);
  return int64_t(std::ceil(std::sqrt(squared) / (step * grid.per_unit))) + 2;
}

// `term(sample, dc)` returns a sample's r_k and sets lanes 1..3 of dc to the loss's derivative by its colour per unit
// of weight w_k (what is left out of r_k does not move the weights). `sink(i, sample, g)` takes the derivative g by
// what sample i read, (opacity, r, g, b), from the last sample to the first. `samples[i]` is the i-th of `count`.
template <class Real, class Opacity, class Samples, class Term, class Sink>
SURFCAP_HD void walk_back(const Samples& samples, int count, const Opacity& opacity, Real r_inf, const Term& term,
                          const Sink& sink) {
  Real behind = r_inf;
  Pack<Real, 4> carried = zero_pack<Real, 4>();  // what the sample behind says about this sample's value and colour
  for (int i = count - 1; i >= 0; --i) {
    const Sample<Real, Opacity>& sample = samples[i];
    const Real a = sample.a, T = sample.transmittance;
    Pack<Real, 4> g = zero_pack<Real, 4>();
    const Real r = term(sample, g);
    const Real by_a = T * (behind - r);
    behind = (Real(1) - a) * r + a * behind;
    Real by_previous, by_current;
    opacity.derivatives(sample.before, sample.now, a, by_previous, by_current);
    g = ((Real(1) - a) * T) * g;
    Pack<Real, 4> to_previous = zero_pack<Real, 4>();
    if constexpr (Opacity::kMidpointColor) {
      if (!sample.starts_run) to_previous = g = Real(0.5) * g;
    }
    to_previous[0] = by_a * by_previous;
    g[0] = by_a * by_current;
    g += carried;
    carried = to_previous;
    sink(i, sample, g);
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
