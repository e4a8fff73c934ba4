// The sparse field as the kernels see it: 4x4x4 tiles behind a table of tile indices, trilinear in between.
//
// Positions are in voxel-centre units, u = (x - origin)/voxel - 1/2, where origin is the low corner of the table. The
// table's outermost tiles are outside, so a read never needs a bounds check once its base voxel is clamped.
#pragma once

#include "harmonics.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kTile = 4;                            // voxels along a tile's edge
constexpr int kTileVoxels = kTile * kTile * kTile;  // [x][y][z], z fastest
constexpr int kInside = -1;                         // table entry: solid, no tile
constexpr int kOutside = -2;  // table entry: empty, no tile; kOutside - d: and so is every cell nearer than d cells

#if defined(__AVX512F__) || !defined(__AVX2__)
constexpr int kLanes = 16;  // samples set up together
#else
constexpr int kLanes = 8;
#endif

// Where kLanes points read the store: for each of the 8 corners (bit 2 = x, bit 1 = y, bit 0 = z) a voxel's index,
// negative where there is no tile, and its trilinear weight.
template <class Real> struct Footprints {
  int32_t voxel[8][kLanes];
  Real weight[8][kLanes];
};

// u[axis][lane] -> footprints. Written as plain loops over the lanes, which the compiler turns into vector code.
template <class Real>
SURFCAP_HD void locate(const Field<Real>& field, const Real (&u)[3][kLanes], Footprints<Real>& out) {
  const int32_t stride[3] = {field.n[1] * field.n[2], field.n[2], 1};
  const int32_t inner[3] = {kTile * kTile, kTile, 1};
  int32_t tile[3][2][kLanes], local[3][2][kLanes];
  Real weight[3][2][kLanes];
  for (int axis = 0; axis < 3; ++axis) {
    const int32_t last = kTile * (field.n[axis] - 1) - 1;
    for (int l = 0; l < kLanes; ++l) {
      int32_t base = int32_t(u[axis][l]);
      base = base < 0 ? 0 : base;
      base = base > last ? last : base;
      const Real f = clamped(u[axis][l] - Real(base), Real(0), Real(1));
      weight[axis][0][l] = Real(1) - f;
      weight[axis][1][l] = f;
      tile[axis][0][l] = (base >> 2) * stride[axis];
      tile[axis][1][l] = ((base + 1) >> 2) * stride[axis];
      local[axis][0][l] = (base & 3) * inner[axis];
      local[axis][1][l] = ((base + 1) & 3) * inner[axis];
    }
  }
  for (int c = 0; c < 8; ++c) {
    const int cx = c >> 2, cy = (c >> 1) & 1, cz = c & 1;
    for (int l = 0; l < kLanes; ++l) {
      const int32_t t = field.table[tile[0][cx][l] + tile[1][cy][l] + tile[2][cz][l]];
      const int32_t voxel = t * kTileVoxels + local[0][cx][l] + local[1][cy][l] + local[2][cz][l];
      out.voxel[c][l] = t < 0 ? t : voxel;
      out.weight[c][l] = weight[0][cx][l] * weight[1][cy][l] * weight[2][cz][l];
    }
  }
}

// The trilinear read of lane l: sum of weight times record over the 8 corners. A missing corner is black and has the
// boundary's opacity value; it reads a constant record instead, so that the loop has no branch on the data.
template <class Real, int Degree>
SURFCAP_HD Coefficients<Real, Degree> interpolate(const Field<Real>& field, const Real* missing_records,
                                                  const Footprints<Real>& at, int l) {
  using R = Record<Degree>;
  Coefficients<Real, Degree> sum;
  for (int p = 0; p < R::kParts; ++p) sum.part[p] = zero_pack<Real, R::kPart>();
  for (int c = 0; c < 8; ++c) {
    const int32_t voxel = at.voxel[c][l];
    const Real* record = voxel >= 0 ? field.voxels + int64_t(voxel) * R::kPitch
                                    : missing_records + (voxel == kInside ? R::kPitch : 0);
    for (int p = 0; p < R::kParts; ++p)
      sum.part[p] += at.weight[c][l] * load<Real, R::kPart>(record + p * R::kPart);
  }
  return sum;
}

// The records that missing tiles read: outside, then inside.
template <class Real, int Degree> SURFCAP_HD void fill_missing(const Field<Real>& field, Real* records) {
  for (int i = 0; i < 2 * Record<Degree>::kPitch; ++i) records[i] = Real(0);
  records[0] = field.missing[0];
  records[Record<Degree>::kPitch] = field.missing[1];
}

// The adjoint of interpolate: adds weight times gradient to the 8 corners' records; missing corners have no gradient
// and are sent to a spare record.
template <class Real, int Degree>
SURFCAP_HD void scatter(Real* gradient, Real* spare, const Footprints<Real>& at, int l,
                        const Coefficients<Real, Degree>& g) {
  using R = Record<Degree>;
  for (int c = 0; c < 8; ++c) {
    const int32_t voxel = at.voxel[c][l];
    Real* record = voxel >= 0 ? gradient + int64_t(voxel) * R::kPitch : spare;
    for (int p = 0; p < R::kParts; ++p) {
      Real* to = record + p * R::kPart;
      store<Real, R::kPart>(to, load<Real, R::kPart>(to) + at.weight[c][l] * g.part[p]);
    }
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
