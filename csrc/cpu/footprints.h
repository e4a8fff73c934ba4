// How one thread of a CPU reads the field: kLanes points are located together, then each reads its 8 records in turn.
#pragma once

#include "../core/field.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// Where kLanes points read the store: for each of the 8 corners a voxel's index, negative where there is no tile, and
// its trilinear weight.
template <class Real> struct Footprints {
  int32_t voxel[8][kLanes];
  Real weight[8][kLanes];
  int32_t least[kLanes];  // of the 8 indices: not negative where every corner is stored
};

// Positions u[axis] of kLanes points -> footprints.
template <class Real>
SURFCAP_HD void locate(const Grid<Real>& grid, const Pack<Real, kLanes> (&u)[3], Footprints<Real>& out) {
  const Corners<Real> corners(grid, u);
  Pack<int32_t, kLanes> least = fill_pack<int32_t, kLanes>(0), entry;
  for (int c = 0; c < 8; ++c) {
    store<int32_t, kLanes>(out.voxel[c], corners.voxel(grid, c, entry));
    least = smaller_pack<int32_t, kLanes>(least, entry);
    store<Real, kLanes>(out.weight[c], corners.share(c));
  }
  store<int32_t, kLanes>(out.least, least);
}

// Asks for the records that the first `count` lanes will read from, or add to, `records`.
template <int Degree, class Number, class Real>
SURFCAP_HD void prefetch(const Number* records, const Footprints<Real>& at, int count) {
  using R = Record<Degree>;
  constexpr int kLine = 64 / sizeof(Number);
  // Small records of one column along z share a cache line most of the time.
  constexpr int kStride = R::kPitch * 2 <= kLine ? 2 : 1;
  for (int l = 0; l < count; ++l)
    for (int c = 0; c < 8; c += kStride)  // a negative index asks for a line before the records: a hint, no access
      for (int i = 0; i < R::kPitch; i += kLine) __builtin_prefetch(records + int64_t(at.voxel[c][l]) * R::kPitch + i);
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
