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

#include "march.h"
#include "minifloat.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

template <class Real> SURFCAP_HD void store_slot(Real* slot, const Pack<Real, 4>& g) { store<Real, 4>(slot, g); }
template <class Real> SURFCAP_HD void store_slot(uint8_t* slot, const Pack<Real, 4>& g) {
  for (int i = 0; i < 4; ++i) slot[i] = encode_e5m2(float(g[i]));
}
template <class Real> SURFCAP_HD Pack<Real, 4> load_slot(const Real* slot) { return load<Real, 4>(slot); }
template <class Real> SURFCAP_HD Pack<Real, 4> load_slot(const uint8_t* slot) {
  Pack<Real, 4> g;
  for (int i = 0; i < 4; ++i) g[i] = Real(decode_e5m2(slot[i]));
  return g;
}

// Writes the samples' gradients into their rays' rows, which are cleared first: a ray may end before its row does.
// Memory rule: writes.
template <class Real, class Slot> struct ToSlots {
  const SlotRows<Real>& rows;
  Slot* slots;  // [S, 4]

  static constexpr const Real* prefetched() { return nullptr; }

  template <class Walk> SURFCAP_HD auto sink(const Walk&, int64_t ray) const {
    Slot* const row = slots + 4 * rows.starts[ray];
    const int64_t count = rows.starts[ray + 1] - rows.starts[ray];
    const int32_t first = rows.first[ray];
    const Real scale = rows.scale;
    for (int64_t i = 0; i < 4 * count; ++i) row[i] = Slot(0);
    return [=](int, const auto& sample, const Pack<Real, 4>& g) {
      const int64_t at = int64_t(sample.k) - first;
      if (at >= 0 && at < count) store_slot<Real>(row + 4 * at, scale * g);
    };
  }
};

// lerp(dL/dc) of one camera at one voxel: (opacity, r, g, b). `corner` is the upper left pixel in the camera's window,
// right and down the voxel's place between it and its neighbours, k and after its place between two samples.
template <class Real, class Slot>
SURFCAP_HD Pack<Real, 4> read_slots(const SlotRows<Real>& rows, const Slot* slots, const int32_t* corner, int64_t width,
                                    Real right, Real down, int32_t k, Real after) {
  Pack<Real, 4> sum = zero_pack<Real, 4>();
  for (int c = 0; c < 4; ++c) {
    const int32_t ray = corner[(c & 1) + (c >> 1) * width];
    if (ray < 0) continue;
    const int64_t start = rows.starts[ray], count = rows.starts[ray + 1] - start, at = int64_t(k) - rows.first[ray];
    const Slot* const slot = slots + 4 * (start + at);
    const Real weight = (c & 1 ? right : Real(1) - right) * (c >> 1 ? down : Real(1) - down);
    if (at >= 0 && at < count) sum += (weight * (Real(1) - after)) * load_slot<Real>(slot);
    if (at >= -1 && at < count - 1) sum += (weight * after) * load_slot<Real>(slot + 4);
  }
  return sum;
}

// The gradient of one tile's voxels, all cameras in their order. Memory rule: writes `gradient` [4, 4, 4, pitch].
template <class Real, int Degree, class Slot>
SURFCAP_HD void gather_tile(const Field<Real>& field, const int32_t* coordinate, const SlotCameras<Real>& cameras,
                            const SlotRows<Real>& rows, const Slot* slots, Real* gradient) {
  using R = Record<Degree>;
  using Number = Pack<Real, kLanes>;
  using Index = Pack<int32_t, kLanes>;
  const Real voxel = Real(1) / field.per_unit;
  for (int i = 0; i < kTileVoxels * R::kPitch; ++i) gradient[i] = Real(0);
  for (int64_t v = 0; v < cameras.views; ++v) {
    const int64_t *const window = cameras.windows + 4 * v, width = window[2], height = window[3];
    if (width == 0) continue;
    const int32_t* const pixels = cameras.rays + cameras.offsets[v];
    const Real *const m = cameras.matrices + 9 * v, *const center = cameras.centers + 3 * v;
    const Real determinant =
        m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
    const Real filling = determinant * voxel * voxel * voxel / (cameras.step * rows.scale);
    for (int first = 0; first < kTileVoxels; first += kLanes) {
      Number away[3], h[3];  // from the camera's centre; homogeneous pixel
      for (int axis = 0; axis < 3; ++axis) {
        Real place[kLanes];
        for (int l = 0; l < kLanes; ++l)
          place[l] = Real(kTile * coordinate[axis] + (((first + l) >> (4 - 2 * axis)) & 3)) + Real(0.5);
        away[axis] = voxel * load<Real, kLanes>(place) + (field.origin[axis] - center[axis]);
      }
      for (int r = 0; r < 3; ++r) h[r] = m[3 * r] * away[0] + m[3 * r + 1] * away[1] + m[3 * r + 2] * away[2];
      // Beyond the window's border a place is held to the border, whose pixels have no ray.
      const auto along = [&](const Number& homogeneous, int64_t low, int64_t size, Index& base, Number& fraction) {
        const Number at = homogeneous / h[2] - Real(low) - Real(0.5);
        const Number held = smaller_pack<Real, kLanes>(larger_pack<Real, kLanes>(at, zero_pack<Real, kLanes>()),
                                                       fill_pack<Real, kLanes>(Real(size - 1)));
        base = smaller_pack<int32_t, kLanes>(convert_pack<int32_t, kLanes, Real>(held),
                                             fill_pack<int32_t, kLanes>(int32_t(size) - 2));
        fraction = held - convert_pack<Real, kLanes, int32_t>(base);
      };
      Index column, row;
      Number right, down;
      along(h[0], window[0], width, column, right);
      along(h[1], window[1], height, row, down);
      const Number squared = away[0] * away[0] + away[1] * away[1] + away[2] * away[2];
      for (int l = 0; l < kLanes; ++l) {
        if (!(h[2][l] > Real(0))) continue;
        const Real distance = std::sqrt(squared[l]);
        const Real k = larger(distance / cameras.step - Real(0.5) - cameras.shift[v], Real(0));
        const Pack<Real, 4> g = read_slots<Real>(rows, slots, pixels + row[l] * width + column[l], width, right[l],
                                                 down[l], int32_t(k), k - Real(int32_t(k)));
        const Real direction[3] = {away[0][l] / distance, away[1][l] / distance, away[2][l] / distance};
        const Real density = filling * distance / (h[2][l] * h[2][l] * h[2][l]);
        const Coefficients<Real, Degree> by_record =
            unfold<Real, Degree>(density * g, basis_weights<Real, Degree>(direction));
        Real* const to = gradient + (first + l) * R::kPitch;
        for (int p = 0; p < R::kParts; ++p)
          store<Real, R::kPart>(to + p * R::kPart, load<Real, R::kPart>(to + p * R::kPart) + by_record.part[p]);
      }
    }
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
