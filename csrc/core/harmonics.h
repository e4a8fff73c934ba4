// Real spherical harmonics up to degree 2 in the plain basis 1, y, z, x, xy, yz, (3z^2 - 1)/2, xz, (x^2 - y^2)/2, and
// the step between a voxel's coefficients and one sample's (opacity, r, g, b).
//
// A voxel's record is [opacity, b00 r g b, b1 r g b, ...], padded to 4, 16 or 32 numbers for degree 0, 1, 2. Along one
// ray the basis is constant, so it is laid out once in the order of the record ("weights" below) and colour is a
// product followed by a fold of the channels.
#pragma once

#include "pack.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

template <int Degree> struct Record {
  static constexpr int kBasis = (Degree + 1) * (Degree + 1);
  static constexpr int kCoefficients = 1 + 3 * kBasis;
  static constexpr int kPitch = Degree == 0 ? 4 : Degree == 1 ? 16 : 32;
#if defined(SURFCAP_CUDA)
  static constexpr int kPart = 4;  // numbers per pack: what a thread loads at once
#else
  static constexpr int kPart = kPitch < 16 ? kPitch : 16;  // numbers per pack
#endif
  static constexpr int kParts = kPitch / kPart;
};

template <class Real, int Degree> struct Coefficients {
  Pack<Real, Record<Degree>::kPart> part[Record<Degree>::kParts];
};

template <class Real, int Degree> SURFCAP_HD void basis(const Real* v, Real* y) {
  y[0] = Real(1);
  if constexpr (Degree >= 1) {
    y[1] = v[1];
    y[2] = v[2];
    y[3] = v[0];
  }
  if constexpr (Degree >= 2) {
    y[4] = v[0] * v[1];
    y[5] = v[1] * v[2];
    y[6] = Real(0.5) * (Real(3) * v[2] * v[2] - Real(1));
    y[7] = v[0] * v[2];
    y[8] = Real(0.5) * (v[0] * v[0] - v[1] * v[1]);
  }
}

// The basis in the order of a record: [1, Y0 Y0 Y0, Y1 Y1 Y1, ..., 0 0 0].
template <class Real, int Degree> SURFCAP_HD Coefficients<Real, Degree> basis_weights(const Real* direction) {
  using R = Record<Degree>;
  Real y[R::kBasis];
  basis<Real, Degree>(direction, y);
  Real row[R::kPitch];
  row[0] = Real(1);
  for (int i = 1; i < R::kPitch; ++i) row[i] = i < R::kCoefficients ? y[(i - 1) / 3] : Real(0);
  Coefficients<Real, Degree> w;
  for (int p = 0; p < R::kParts; ++p) w.part[p] = load<Real, R::kPart>(row + p * R::kPart);
  return w;
}

#if defined(SURFCAP_CUDA)
// The four numbers of part p stand, from p = 1 on, for the channels p + 2, p, p + 1, p + 2 (mod 3, r = 0), those of
// part 0 for opacity, r, g, b. Their sum by channel:
template <class Real> SURFCAP_HD Pack<Real, 4> fold_part(const Pack<Real, 4>& v, int p) {
  const Real x = v[1], y = v[2], z = p == 0 ? v[3] : v[3] + v[0];  // channels p, p + 1, p + 2
  const int turn = p % 3;
  Pack<Real, 4> sum;
  sum[0] = p == 0 ? v[0] : Real(0);
  sum[1] = turn == 0 ? x : turn == 1 ? z : y;
  sum[2] = turn == 0 ? y : turn == 1 ? x : z;
  sum[3] = turn == 0 ? z : turn == 1 ? y : x;
  return sum;
}

// Its transpose.
template <class Real> SURFCAP_HD Pack<Real, 4> unfold_part(const Pack<Real, 4>& g, int p) {
  const int turn = p % 3;
  Pack<Real, 4> v;
  v[1] = turn == 0 ? g[1] : turn == 1 ? g[2] : g[3];
  v[2] = turn == 0 ? g[2] : turn == 1 ? g[3] : g[1];
  v[3] = turn == 0 ? g[3] : turn == 1 ? g[1] : g[2];
  v[0] = p == 0 ? g[0] : v[3];
  return v;
}

template <class Real, int Degree>
SURFCAP_HD Pack<Real, 4> fold(const Coefficients<Real, Degree>& c, const Coefficients<Real, Degree>& w) {
  Pack<Real, 4> sum = zero_pack<Real, 4>();
  for (int p = 0; p < Record<Degree>::kParts; ++p) sum += fold_part<Real>(c.part[p] * w.part[p], p);
  return sum;
}

template <class Real, int Degree>
SURFCAP_HD Coefficients<Real, Degree> unfold(const Pack<Real, 4>& g, const Coefficients<Real, Degree>& w) {
  Coefficients<Real, Degree> r;
  for (int p = 0; p < Record<Degree>::kParts; ++p) r.part[p] = w.part[p] * unfold_part<Real>(g, p);
  return r;
}
#else
// Adds the four quarters of a pack of 16.
template <class Real> SURFCAP_HD Pack<Real, 4> add_quarters(const Pack<Real, 16>& v) {
  const Pack<Real, 8> half = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) +
                             __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
  return __builtin_shufflevector(half, half, 0, 1, 2, 3) + __builtin_shufflevector(half, half, 4, 5, 6, 7);
}

// (opacity, r, g, b) = sum over the record of coefficient times weight, channel by channel. The permutations move the
// record's period of three to a period of four, whose first lane holds the opacity once and a padding zero elsewhere.
template <class Real, int Degree>
SURFCAP_HD Pack<Real, 4> fold(const Coefficients<Real, Degree>& c, const Coefficients<Real, Degree>& w) {
  if constexpr (Degree == 0) {
    return c.part[0];
  } else if constexpr (Degree == 1) {
    const Pack<Real, 16> v = c.part[0] * w.part[0];
    return add_quarters<Real>(__builtin_shufflevector(v, v, 0, 1, 2, 3, 13, 4, 5, 6, 13, 7, 8, 9, 13, 10, 11, 12));
  } else {
    const Pack<Real, 16> lo = c.part[0] * w.part[0], hi = c.part[1] * w.part[1];
    const Pack<Real, 16> first = __builtin_shufflevector(lo, hi, 0, 1, 2, 3, 28, 4, 5, 6, 28, 7, 8, 9, 28, 10, 11, 12);
    const Pack<Real, 16> second =
        __builtin_shufflevector(lo, hi, 28, 13, 14, 15, 28, 16, 17, 18, 28, 19, 20, 21, 28, 22, 23, 24);
    const Pack<Real, 4> last = __builtin_shufflevector(hi, hi, 12, 9, 10, 11);
    return add_quarters<Real>(first + second) + last;
  }
}

// The transpose of fold: (opacity, r, g, b) spread over the record, each channel times its weight.
template <class Real, int Degree>
SURFCAP_HD Coefficients<Real, Degree> unfold(const Pack<Real, 4>& g, const Coefficients<Real, Degree>& w) {
  Coefficients<Real, Degree> r;
  if constexpr (Degree == 0) {
    r.part[0] = g;
  } else {
    r.part[0] = w.part[0] * __builtin_shufflevector(g, g, 0, 1, 2, 3, 1, 2, 3, 1, 2, 3, 1, 2, 3, 1, 2, 3);
    if constexpr (Degree == 2)
      r.part[1] = w.part[1] * __builtin_shufflevector(g, g, 1, 2, 3, 1, 2, 3, 1, 2, 3, 1, 2, 3, 0, 0, 0, 0);
  }
  return r;
}
#endif

}  // namespace SURFCAP_ISA
}  // namespace surfcap
