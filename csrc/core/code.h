// How fields and gradients narrower than a float are read and written.
//
// A code q of 8 or 16 bits stands for low + q (high - low)/steps. An opacity value lies between the two boundary
// values, a constant colour in [0, 1], any other coefficient in [-1, 1]; one code is left unused, so that steps is even
// and zero has a code wherever the range is symmetric. Since the weights of a trilinear read sum to one, it reads codes
// and decodes their mean.
#pragma once

#include <type_traits>

#include "harmonics.h"
#include "minifloat.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

template <class Stored> constexpr float kSteps = 0;  // numbers are no codes
template <> constexpr float kSteps<uint8_t> = 254;
template <> constexpr float kSteps<uint16_t> = 65534;
template <class Sum> constexpr int kSumScale = 1;  // what sums are multiplied with
template <> constexpr int kSumScale<Half> = 1024;  // a fit's gradients lie under 1 and matter above 1e-8

template <int N> SURFCAP_HD Pack<int32_t, N> widened(const uint16_t* from) {
  return convert_pack<int32_t, N, uint16_t>(load_aligned<uint16_t, N>(from));
}
template <int N> SURFCAP_HD Pack<int32_t, N> widened(const uint8_t* from) {
#if defined(SURFCAP_AVX512)
  if constexpr (N == 16)
    return Pack<int32_t, N>(_mm512_maskz_cvtepu8_epi32(0xffff, _mm_loadu_si128((const __m128i_u*)from)));
#endif
#if defined(SURFCAP_AVX2)
  if constexpr (N == 4) return Pack<int32_t, N>(_mm_cvtepu8_epi32(_mm_loadu_si32(from)));
#endif
  return convert_pack<int32_t, N, uint16_t>(convert_pack<uint16_t, N, uint8_t>(load_aligned<uint8_t, N>(from)));
}

// N consecutive stored numbers as what one computes with, not yet decoded.
template <class Real, int N, class Stored> SURFCAP_HD Pack<Real, N> load_as(const Stored* from) {
  if constexpr (std::is_same_v<Stored, Real>)
    return load_aligned<Real, N>(from);
  else
    return convert_pack<Real, N, int32_t>(widened<N>(from));
}

// Adds to N consecutive sums, in their scale; those of 16 bits are rounded to the nearest.
template <class Real, int N, class Sum> SURFCAP_HD void add_to(Sum* to, const Pack<Real, N>& x) {
  if constexpr (std::is_same_v<Sum, Real>)
    store_aligned<Real, N>(to, load_aligned<Real, N>(to) + x);
  else
    to_halves<N>(from_halves<N>(to) + x, to);
}

template <class Real, class Sum> SURFCAP_HD void add_to(Sum* to, Real x) {
  if constexpr (std::is_same_v<Sum, Real>)
    *to += x;
  else
    *to = to_half(from_half(*to) + x);
}

// The code of the records of one field: value = low + code * scale. `missing` are the records that missing tiles read,
// outside, then inside: black.
template <class Real, int Degree, class Stored> struct Code {
  using R = Record<Degree>;
  static constexpr bool kNarrow = !std::is_same_v<Stored, Real>;
  Real low[R::kPitch], scale[R::kPitch];
  Stored missing[2 * R::kPitch];

  SURFCAP_HD explicit Code(const Grid<Real>& grid) {
    for (int i = 0; i < R::kPitch; ++i) {
      const bool opacity = i == 0, colored = i < R::kCoefficients, symmetric = colored && i > 3;
      missing[i] = missing[R::kPitch + i] = Stored(0);
      if constexpr (kNarrow) {
        low[i] = opacity ? grid.missing[1] : symmetric ? Real(-1) : Real(0);
        scale[i] = ((opacity ? grid.missing[0] : colored ? Real(1) : Real(0)) - low[i]) / kSteps<Stored>;
        if (symmetric) missing[i] = missing[R::kPitch + i] = Stored(kSteps<Stored> / 2);
      }
    }
    missing[0] = kNarrow ? Stored(kSteps<Stored>) : Stored(grid.missing[0]);
    missing[R::kPitch] = kNarrow ? Stored(0) : Stored(grid.missing[1]);
  }

  // Numbers p * kPart .. of a record, or of a mean of records.
  SURFCAP_HD Pack<Real, R::kPart> decode(const Pack<Real, R::kPart>& codes, int p) const {
    if constexpr (kNarrow)
      return load<Real, R::kPart>(low + p * R::kPart) + codes * load<Real, R::kPart>(scale + p * R::kPart);
    else
      return codes;
  }
};

// The opacity value of a voxel alone.
template <class Real, class Stored> SURFCAP_HD Real opacity_value(const Field<Real, Stored>& field, int64_t voxel) {
  const Stored stored = field.voxels[voxel * field.pitch];
  if constexpr (std::is_same_v<Stored, Real>)
    return stored;
  else
    return field.missing[1] + Real(stored) * ((field.missing[0] - field.missing[1]) / kSteps<Stored>);
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
