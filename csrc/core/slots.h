// The gathered gradient (paper, section 3.3 and eq. 19): the rays of a camera leave the gradient by what each of their
// samples read in a slot, and every voxel reads, from each camera, the 8 slots around it. Nothing adds to memory that
// another thread writes, so no order of the sums is left to chance.
//
// All rays of a camera take their samples at the same distances t_k. On its lattice (u, v, k) a voxel at the distance d
// stands at its own pixel position and k = d/step - 1/2 - shift. The samples of a pixel grid fill space with
//   det(K) d / (z^3 step)
// samples per volume (z the depth along the optical axis; on it, focal^2/(d^2 step)), so with lerp over 4 pixels x 2 k
//   dL/db_lm  ~  sum over cameras of  Y_lm(camera -> voxel) * (voxel^3 * samples per volume) * lerp(dL/dc),
// and the same without Y for the opacity value. It is the exact gradient, sum over samples of their trilinear weight at
// the voxel times dL/dc, for a field of dL/dc that is smooth over voxels and samples.
#pragma once

#include <climits>

#include "march.h"
#include "minifloat.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

template <class Real> SURFCAP_HD void store_slot(Real* slot, const Pack<Real, 4>& g) {
  store_aligned<Real, 4>(slot, g);
}
template <class Real> SURFCAP_HD void store_slot(uint8_t* slot, const Pack<Real, 4>& g) {
  Pack<uint8_t, 4> bytes;
  for (int i = 0; i < 4; ++i) bytes[i] = nearest_e5m2(float(g[i]));
  store_aligned<uint8_t, 4>(slot, bytes);
}
template <class Real> SURFCAP_HD Pack<Real, 4> load_slot(const Real* slot) { return load_aligned<Real, 4>(slot); }
template <class Real> SURFCAP_HD Pack<Real, 4> load_slot(const uint8_t* slot) {
  return convert_pack<Real, 4, float>(decode_e5m2<4>(slot));
}

// One ray's row. Memory rule: writes; it is cleared first, for a ray may end before its row does.
template <class Real, class Slot> struct SlotRow {
  Slot* row;  // [count, 4]
  int64_t count;
  int32_t first;
  Real scale;

  SURFCAP_HD SlotRow(const SlotRows<Real>& rows, Slot* slots, int64_t ray)
      : row(slots + 4 * rows.starts[ray]),
        count(rows.starts[ray + 1] - rows.starts[ray]),
        first(rows.first[ray]),
        scale(rows.scale) {}

  SURFCAP_HD void put(int32_t k, const Pack<Real, 4>& g) const {
    const int64_t at = int64_t(k) - first;
    if (at >= 0 && at < count) store_slot<Real>(row + 4 * at, scale * g);
  }
};

// Where the voxels of a tile stand on one camera's lattice, kLanes voxels at a time: what they read and how.
template <class Real> struct Stand {
  const int32_t* corner[kLanes];                    // the upper left pixel's ray, in the camera's window
  const int32_t* reach[kLanes];                     // of the rays around: least and one more than greatest k
  Real right[kLanes], down[kLanes], after[kLanes];  // place between this pixel and its neighbours, between two samples
  int32_t k[kLanes];                                // the sample before
  Real way[3][kLanes], distance[kLanes];            // from the camera's centre
  Real samples[kLanes];                             // per voxel; 0 where the voxel is behind the camera
};

template <class Real>
SURFCAP_HD void find_stand(const Grid<Real>& field, const int32_t* coordinate, int first,
                           const SlotCameras<Real>& cameras, int64_t v, Stand<Real>& out) {
  using Number = Pack<Real, kLanes>;
  using Index = Pack<int32_t, kLanes>;
  const int64_t *const window = cameras.windows + 4 * v, width = window[2], height = window[3];
  const Real *const m = cameras.matrices + 9 * v, *const center = cameras.centers + 3 * v;
  const Real voxel = Real(1) / field.per_unit;
  const Real determinant =
      m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
  Number way[3], h[3];
  for (int axis = 0; axis < 3; ++axis) {
    Real place[kLanes];
    for (int l = 0; l < kLanes; ++l)
      place[l] = Real(kTile * coordinate[axis] + (((first + l) >> (4 - 2 * axis)) & 3)) + Real(0.5);
    way[axis] = voxel * load<Real, kLanes>(place) + (field.origin[axis] - center[axis]);
    store<Real, kLanes>(out.way[axis], way[axis]);
  }
  for (int r = 0; r < 3; ++r) h[r] = m[3 * r] * way[0] + m[3 * r + 1] * way[1] + m[3 * r + 2] * way[2];
  // Beyond the window's border a place is held to the border, whose pixels have no ray.
  const auto along = [&](const Number& homogeneous, int64_t low, int64_t size, Real* fraction) {
    const Number at = homogeneous / h[2] - Real(low) - Real(0.5);
    const Number held = smaller_pack<Real, kLanes>(larger_pack<Real, kLanes>(at, zero_pack<Real, kLanes>()),
                                                   fill_pack<Real, kLanes>(Real(size - 1)));
    const Index base = smaller_pack<int32_t, kLanes>(convert_pack<int32_t, kLanes, Real>(held),
                                                     fill_pack<int32_t, kLanes>(int32_t(size) - 2));
    store<Real, kLanes>(fraction, held - convert_pack<Real, kLanes, int32_t>(base));
    return base;
  };
  const Index column = along(h[0], window[0], width, out.right), row = along(h[1], window[1], height, out.down);
  const Number squared = way[0] * way[0] + way[1] * way[1] + way[2] * way[2];
  const Real filling = determinant * voxel * voxel * voxel / cameras.step;
  const int64_t blocks = blocks_along(width);
  for (int l = 0; l < kLanes; ++l) {
    const Real distance = std::sqrt(squared[l]), depth = h[2][l];
    const Real k = larger(distance / cameras.step - Real(0.5) - cameras.shift[v], Real(0));
    out.k[l] = int32_t(k);
    out.after[l] = k - Real(out.k[l]);
    out.distance[l] = distance;
    out.samples[l] = depth > Real(0) ? filling * distance / (depth * depth * depth) : Real(0);
    out.corner[l] = cameras.rays + cameras.offsets[v] + row[l] * width + column[l];
    const int64_t block = (row[l] >> kReachBits) * blocks + (column[l] >> kReachBits);
    out.reach[l] = cameras.reach + 2 * (cameras.reach_offsets[v] + block);
  }
}

// One pixel's share in what a voxel reads: two samples of its ray, or one at the end of the row.
template <class Real> struct Share {
  int64_t before, after;  // slots
  Real weight_before, weight_after;
};

// What a voxel reads by it.
template <class Real, class Slot> SURFCAP_HD Pack<Real, 4> read_share(const Share<Real>& share, const Slot* slots) {
  return share.weight_before * load_slot<Real>(slots + 4 * share.before) +
         share.weight_after * load_slot<Real>(slots + 4 * share.after);
}

// The share of the stand's voxel l in the c-th pixel around it (bit 1 below, bit 0 to the right); false where it has
// none.
template <class Real>
SURFCAP_HD bool find_share(const Stand<Real>& stand, int l, int c, int64_t width, const SlotRows<Real>& rows,
                           Share<Real>& share) {
  const int32_t ray = stand.corner[l][(c & 1) + (c >> 1) * width];
  if (ray < 0) return false;
  const int64_t start = rows.starts[ray], count = rows.starts[ray + 1] - start;
  const int64_t at = int64_t(stand.k[l]) - rows.first[ray];
  const Real weight =
      (c & 1 ? stand.right[l] : Real(1) - stand.right[l]) * (c >> 1 ? stand.down[l] : Real(1) - stand.down[l]);
  share.before = start + larger<int64_t>(at, 0);
  share.after = start + smaller<int64_t>(at + 1, count - 1);
  share.weight_before = at >= 0 ? weight * (Real(1) - stand.after[l]) : Real(0);
  share.weight_after = at + 1 < count ? weight * stand.after[l] : Real(0);
  return at >= -1 && at < count;
}

// Whether any ray around the stand's voxel l has samples there.
template <class Real> SURFCAP_HD bool within_reach(const Stand<Real>& stand, int l) {
  return stand.k[l] + 1 >= stand.reach[l][0] && stand.k[l] < stand.reach[l][1];
}

// The gradient of the record of the stand's voxel l, which has read `read` from one camera's slots.
template <class Real, int Degree>
SURFCAP_HD Coefficients<Real, Degree> by_record(const Stand<Real>& stand, int l, const SlotRows<Real>& rows,
                                                const Pack<Real, 4>& read) {
  const Real nearness = Real(1) / stand.distance[l];
  const Real direction[3] = {stand.way[0][l] * nearness, stand.way[1][l] * nearness, stand.way[2][l] * nearness};
  return unfold<Real, Degree>(stand.samples[l] / rows.scale * read, basis_weights<Real, Degree>(direction));
}

// The reach of the b-th block of camera v's window.
template <class Real>
SURFCAP_HD void find_reach(const SlotCameras<Real>& cameras, const SlotRows<Real>& rows, int64_t v, int64_t b,
                           int32_t* reach) {
  const int64_t width = cameras.windows[4 * v + 2], height = cameras.windows[4 * v + 3];
  const int32_t* const rays = cameras.rays + cameras.offsets[v];
  const int64_t wide = blocks_along(width), side = (1 << kReachBits) + 1;
  const int64_t left = (b % wide) << kReachBits, top = (b / wide) << kReachBits;
  int32_t least = INT_MAX, most = INT_MIN;
  for (int64_t y = top; y < smaller(top + side, height); ++y)
    for (int64_t x = left; x < smaller(left + side, width); ++x) {
      const int32_t ray = rays[y * width + x];
      if (ray < 0 || rows.starts[ray] == rows.starts[ray + 1]) continue;
      least = smaller(least, rows.first[ray]);
      most = larger(most, int32_t(rows.first[ray] + rows.starts[ray + 1] - rows.starts[ray]));
    }
  reach[0] = least;
  reach[1] = most;
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
