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

// Room for the samples of a ray. The caller gives the memory: `capacity` samples, a multiple of kLanes.
template <class Real, class Opacity> struct Trace {
  Sample<Real, Opacity>* samples;
  Footprints<Real>* footprints;  // capacity / kLanes
  int64_t capacity;
};

// The most samples a ray can have in this field, rounded up to whole groups of lanes, and one group to spare.
template <class Real> SURFCAP_HD int64_t trace_capacity(const Grid<Real>& grid, Real step) {
  Real squared = Real(0);
  for (int i = 0; i < 3; ++i) squared += Real(kTile * grid.n[i]) * Real(kTile * grid.n[i]);
  const int64_t longest = int64_t(std::ceil(std::sqrt(squared) / (step * grid.per_unit))) + 2;
  return (longest / kLanes + 2) * kLanes;
}

// The walk forward. It comes in two parts so that several rays can be in flight: `start` finds the first samples and
// asks for what they read, `finish` goes through all samples.
template <class Real, int Degree, class Opacity> struct Walk {
  Lattice<Real> lattice;
  Coefficients<Real, Degree> weights;
  Trace<Real, Opacity> trace;
  RayResult<Real> ray;
  int32_t k[kLanes];
  Pack<Real, kLanes> t;
  int count;  // samples set up and not yet gone through

  template <class Stored>
  SURFCAP_HD void start(const Field<Real, Stored>& field, const Lattice<Real>& samples, const Real* direction,
                        const Trace<Real, Opacity>& room) {
    lattice = samples;
    weights = basis_weights<Real, Degree>(direction);
    trace = room;
    ray = {zero_pack<Real, 4>(), Real(1), Real(0), 0};
    set_up(field);
  }

  // `gradient`, where given, is what the walk back will add to: it is fetched meanwhile.
  template <class Stored, class Sum>
  SURFCAP_HD void finish(const Field<Real, Stored>& field, const Code<Real, Degree, Stored>& code, Real stop,
                         const Opacity& opacity, const Sum* gradient) {
    typename Opacity::State before = opacity.outside();
    Pack<Real, 4> color_before = zero_pack<Real, 4>();
    int k_before = -2;
    while (count > 0) {
      const Footprints<Real>& at = trace.footprints[ray.samples / kLanes];
      int l = 0;
      for (bool alive = true; alive && l < count; ++l) {
        Pack<Real, 4> color = fold<Real, Degree>(interpolate(field, code, at, l), weights);
        Sample<Real, Opacity>& sample = trace.samples[ray.samples++];
        sample.starts_run = k[l] != k_before + 1;
        k_before = k[l];
        sample.before = sample.starts_run ? opacity.outside() : before;
        sample.now = before = opacity.prepare(color[0]);
        sample.a = opacity.transparency(sample.before, sample.now);
        sample.t = t[l];
        sample.k = k[l];
        sample.transmittance = ray.transmittance;
        if constexpr (Opacity::kMidpointColor) {
          const Pack<Real, 4> here = color;
          if (!sample.starts_run) color = Real(0.5) * (here + color_before);
          color[0] = here[0];
          color_before = here;
        }
        sample.color = color;
        const Real w = (Real(1) - sample.a) * ray.transmittance;
        color[0] = t[l];  // the sum's first lane is the depth's
        ray.sum += w * color;
        ray.opacity += w;
        ray.transmittance *= sample.a;
        alive = !(ray.transmittance < stop);
      }
      if (gradient) prefetch<Degree>(gradient, at, l);
      if (l < kLanes || ray.transmittance < stop) break;
      set_up(field);
    }
  }

 private:
  template <class Stored> SURFCAP_HD void set_up(const Field<Real, Stored>& field) {
    // A ray of unit direction never fills its room; another one ends there.
    count = ray.samples + kLanes <= trace.capacity ? lattice.next(k, kLanes) : 0;
    if (count == 0) return;
    for (int l = count; l < kLanes; ++l) k[l] = k[count - 1];
    Pack<Real, kLanes> u[3];
    lattice.place(k, t, u);
    Footprints<Real>& at = trace.footprints[ray.samples / kLanes];
    locate(field, u, at);
    prefetch<Degree>(field.voxels, at, count);
  }
};

// Adds the samples' gradients to the voxels that they read. Memory rule: adds.
template <class Real, int Degree, class Sum = Real> struct ToVoxels {
  Sum* gradient;  // [tiles, 4, 4, 4, pitch]
  Sum* spare;

  // What the walk back will add to: it is fetched meanwhile.
  const Sum* prefetched() const { return gradient; }

  template <class Walk> SURFCAP_HD auto sink(const Walk& walk, int64_t) const {
    return [this, &walk](int i, const auto&, const Pack<Real, 4>& g) {
      scatter(gradient, spare, walk.trace.footprints[i / kLanes], i % kLanes, unfold<Real, Degree>(g, walk.weights));
    };
  }
};

// `term(sample, dc)` returns a sample's r_k and sets lanes 1..3 of dc to the loss's derivative by its colour per unit
// of weight w_k (what is left out of r_k does not move the weights). `sink(i, sample, g)` takes the derivative g by
// what sample i read, (opacity, r, g, b), from the last sample to the first.
template <class Real, class Opacity, class Term, class Sink>
SURFCAP_HD void walk_back(const Trace<Real, Opacity>& trace, int samples, const Opacity& opacity, Real r_inf,
                          const Term& term, const Sink& sink) {
  Real behind = r_inf;
  Pack<Real, 4> carried = zero_pack<Real, 4>();  // what the sample behind says about this sample's value and colour
  for (int i = samples - 1; i >= 0; --i) {
    const Sample<Real, Opacity>& sample = trace.samples[i];
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
