// The sparse field as the kernels see it: 4x4x4 tiles behind a table of tile indices, trilinear in between.
//
// Positions are in voxel-centre units, u = (x - origin)/voxel - 1/2, where origin is the low corner of the table. The
// table's outermost tiles are outside, so a read never needs a bounds check once its base voxel is clamped.
#pragma once

#include "code.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kTile = 4;                            // voxels along a tile's edge
constexpr int kTileVoxels = kTile * kTile * kTile;  // [x][y][z], z fastest
constexpr int kInside = -1;                         // table entry: solid, no tile
constexpr int kOutside = -2;  // table entry: empty, no tile; kOutside - d: and so is every cell nearer than d cells

constexpr int kLanes = 8;  // samples set up together

// Where kLanes points read the store: for each of the 8 corners (bit 2 = x, bit 1 = y, bit 0 = z) a voxel's index,
// negative where there is no tile, and its trilinear weight.
template <class Real> struct Footprints {
  int32_t voxel[8][kLanes];
  Real weight[8][kLanes];
  int32_t least[kLanes];  // of the 8 indices: not negative where every corner is stored
};

// Positions u[axis] of kLanes points -> footprints.
template <class Real>
SURFCAP_HD void locate(const Grid<Real>& grid, const Pack<Real, kLanes> (&u)[3], Footprints<Real>& out) {
  using Index = Pack<int32_t, kLanes>;
  using Number = Pack<Real, kLanes>;
  const int32_t stride[3] = {grid.n[1] * grid.n[2], grid.n[2], 1};
  const int32_t inner[3] = {kTile * kTile, kTile, 1};
  const Index none = fill_pack<int32_t, kLanes>(0);
  const Number zero = zero_pack<Real, kLanes>(), one = fill_pack<Real, kLanes>(Real(1));
  Index tile[3][2], local[3][2];  // of the lower and the upper corner along each axis
  Number weight[3][2];
  for (int axis = 0; axis < 3; ++axis) {
    const Index last = fill_pack<int32_t, kLanes>(kTile * (grid.n[axis] - 1) - 1);
    Index base = convert_pack<int32_t, kLanes, Real>(u[axis]);
    base = smaller_pack<int32_t, kLanes>(larger_pack<int32_t, kLanes>(base, none), last);
    const Number f = u[axis] - convert_pack<Real, kLanes, int32_t>(base);
    weight[axis][1] = smaller_pack<Real, kLanes>(larger_pack<Real, kLanes>(f, zero), one);
    weight[axis][0] = one - weight[axis][1];
    for (int side = 0; side < 2; ++side) {
      tile[axis][side] = ((base + side) >> 2) * stride[axis];
      local[axis][side] = ((base + side) & 3) * inner[axis];
    }
  }
  Index least = fill_pack<int32_t, kLanes>(0);
  for (int c = 0; c < 8; ++c) {
    const int cx = c >> 2, cy = (c >> 1) & 1, cz = c & 1;
    const Index t = look_up<kLanes>(grid.table, tile[0][cx] + tile[1][cy] + tile[2][cz]);
    // A stored tile has voxel >= t, a missing one (t < 0) voxel <= t: the greater is the index, or t's own meaning.
    const Index voxel = t * kTileVoxels + (local[0][cx] + local[1][cy] + local[2][cz]);
    store<int32_t, kLanes>(out.voxel[c], larger_pack<int32_t, kLanes>(t, voxel));
    least = smaller_pack<int32_t, kLanes>(least, t);
    store<Real, kLanes>(out.weight[c], weight[0][cx] * weight[1][cy] * weight[2][cz]);
  }
  store<int32_t, kLanes>(out.least, least);
}

// Asks for the records that the first `count` lanes will read from, or add to, `records`. On CUDA the many threads of a
// multiprocessor hide the wait instead.
template <int Degree, class Number, class Real>
SURFCAP_HD void prefetch(const Number* records, const Footprints<Real>& at, int count) {
#if !defined(__CUDACC__)
  using R = Record<Degree>;
  constexpr int kLine = 64 / sizeof(Number);
  // Small records of one column along z share a cache line most of the time.
  constexpr int kStride = R::kPitch * 2 <= kLine ? 2 : 1;
  for (int l = 0; l < count; ++l)
    for (int c = 0; c < 8; c += kStride)  // a negative index asks for a line before the records: a hint, no access
      for (int i = 0; i < R::kPitch; i += kLine) __builtin_prefetch(records + int64_t(at.voxel[c][l]) * R::kPitch + i);
#endif
}

// The trilinear read of lane l: sum of weight times record over the 8 corners. A missing corner is black and has the
// boundary's opacity value: it reads a constant record instead.
template <class Real, int Degree, class Stored>
SURFCAP_HD Coefficients<Real, Degree> interpolate(const Field<Real, Stored>& field,
                                                  const Code<Real, Degree, Stored>& code, const Footprints<Real>& at,
                                                  int l) {
  using R = Record<Degree>;
  Coefficients<Real, Degree> sum;
  for (int p = 0; p < R::kParts; ++p) sum.part[p] = zero_pack<Real, R::kPart>();
  const auto add = [&](const Stored* record, Real weight) {
    for (int p = 0; p < R::kParts; ++p) sum.part[p] += weight * load_as<Real, R::kPart>(record + p * R::kPart);
  };
  if (at.least[l] >= 0) {
    for (int c = 0; c < 8; ++c) add(field.voxels + int64_t(at.voxel[c][l]) * R::kPitch, at.weight[c][l]);
  } else {
    for (int c = 0; c < 8; ++c) {
      const int32_t voxel = at.voxel[c][l];
      add(voxel >= 0 ? field.voxels + int64_t(voxel) * R::kPitch : code.missing + (voxel == kInside ? R::kPitch : 0),
          at.weight[c][l]);
    }
  }
  for (int p = 0; p < R::kParts; ++p) sum.part[p] = code.decode(sum.part[p], p);
  return sum;
}

// The adjoint of interpolate: adds weight times gradient to the 8 corners' records; missing corners have no gradient
// and are sent to a spare record.
template <class Real, int Degree, class Sum>
SURFCAP_HD void scatter(Sum* gradient, Sum* spare, const Footprints<Real>& at, int l, Coefficients<Real, Degree> g) {
  using R = Record<Degree>;
  for (int p = 0; p < R::kParts; ++p) g.part[p] = Real(kSumScale<Sum>) * g.part[p];
  const auto add = [&](Sum* record, Real weight) {
    for (int p = 0; p < R::kParts; ++p) add_to<Real, R::kPart>(record + p * R::kPart, weight * g.part[p]);
  };
  if (at.least[l] >= 0) {
    for (int c = 0; c < 8; ++c) add(gradient + int64_t(at.voxel[c][l]) * R::kPitch, at.weight[c][l]);
  } else {
    for (int c = 0; c < 8; ++c) {
      const int32_t voxel = at.voxel[c][l];
      add(voxel >= 0 ? gradient + int64_t(voxel) * R::kPitch : spare, at.weight[c][l]);
    }
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
