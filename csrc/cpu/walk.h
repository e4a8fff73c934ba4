// Rays on a CPU: one thread walks a ray with kLanes samples set up at a time, and has a bundle of rays in flight, so
// that the waits for memory overlap. A ray's samples and where they read are remembered for the walk back.
#pragma once

#include "../core/rays.h"
#include "../core/slots.h"
#include "footprints.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kBundle = 8;  // rays in flight

// Room for the samples of a ray. The caller gives the memory: `capacity` samples, a multiple of kLanes.
template <class Real, class Opacity> struct Trace {
  Sample<Real, Opacity>* samples;
  Footprints<Real>* footprints;  // capacity / kLanes
  int64_t capacity;
};

// The most samples of a ray, rounded up to whole groups of lanes, and one group to spare.
template <class Real> int64_t trace_capacity(const Grid<Real>& grid, Real step) {
  return (most_samples(grid, step) / kLanes + 2) * kLanes;
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
    ray.samples = 0;
    set_up(field);
  }

  // `gradient`, where given, is what the walk back will add to: it is fetched meanwhile.
  template <class Stored, class Sum>
  SURFCAP_HD void finish(const Field<Real, Stored>& field, const Code<Real, Degree, Stored>& code, Real stop,
                         const Opacity& opacity, const Sum* gradient) {
    Compositor<Real, Opacity> front(opacity);
    while (count > 0) {
      const Footprints<Real>& at = trace.footprints[front.ray.samples / kLanes];
      int l = 0;
      for (bool alive = true; alive && l < count; ++l) {
        const Pack<Real, 4> color = fold<Real, Degree>(interpolate(field, code, at, l), weights);
        front.add(color, k[l], t[l], trace.samples[front.ray.samples]);
        alive = !(front.ray.transmittance < stop);
      }
      if (gradient) prefetch<Degree>(gradient, at, l);
      ray = front.ray;
      if (l < kLanes || ray.transmittance < stop) return;
      set_up(field);
    }
    ray = front.ray;
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

// Leaves the samples' gradients in the rows of their rays. Memory rule: writes.
template <class Real, class Slot> struct ToSlots {
  const SlotRows<Real>& rows;
  Slot* slots;  // [S, 4]

  static constexpr const Real* prefetched() { return nullptr; }

  template <class Walk> SURFCAP_HD auto sink(const Walk&, int64_t ray) const {
    const SlotRow<Real, Slot> row(rows, slots, ray);
    for (int64_t i = 0; i < 4 * row.count; ++i) row.row[i] = Slot(0);
    return [row](int, const auto& sample, const Pack<Real, 4>& g) { row.put(sample.k, g); };
  }
};

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
    walk.start(field, lattice_of(field, rays, settings.step, i), rays.directions + 3 * i,
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

  // The walk back of ray i, whose gradient goes `to` the voxels or to slots, as rays.h asks for it.
  template <class To> SURFCAP_HD auto back(const Walk& walk, int64_t i, const To& to) const {
    return [this, &walk, sink = to.sink(walk, i)](Real r_inf, const auto& term) {
      walk_back<Real>(walk.trace.samples, walk.ray.samples, opacity, r_inf, term, sink);
    };
  }
};

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
    for (int r = 0; r < count; ++r)
      photometric_ray(walks[r].ray, rays, seen, loss, first + r, losses, out, march.back(walks[r], first + r, to));
  }
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
