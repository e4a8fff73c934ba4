// The 8-bit float 1-5-2 (float8_e5m2): sign, five bits of exponent with bias 15, two of fraction. Normal numbers from
// 2^-14 to 1.75 * 2^15 with a relative error of at most 1/8, below them steps of 2^-16.
#pragma once

#include "pack.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr float kLargestE5m2 = 57344.0f;

// The nearest number, the even one of two; what is too large becomes the largest.
SURFCAP_HD uint8_t encode_e5m2(float x) {
  constexpr float kLeastNormal = 0x1p-14f, kInteger = 0x1p23f;  // a float of 2^23 and more has no fraction
  constexpr uint32_t kDropped = 21, kRebias = (127 - 15) << 2;
  const float least = x < 0.0f ? -x : x, size = least < kLargestE5m2 ? least : kLargestE5m2;
  const float rounded = size * 0x1p16f + kInteger;
  uint32_t bits, steps, sign;
  __builtin_memcpy(&sign, &x, sizeof(sign));
  __builtin_memcpy(&bits, &size, sizeof(bits));
  __builtin_memcpy(&steps, &rounded, sizeof(steps));
  bits = ((bits + (1u << (kDropped - 1)) - 1 + ((bits >> kDropped) & 1)) >> kDropped) - kRebias;
  return uint8_t((size < kLeastNormal ? steps & 0xff : bits) | (sign >> 24 & 0x80));
}

SURFCAP_HD float decode_e5m2(uint8_t code) {
  const uint32_t size = code & 0x7f, bits = (size << 21) + ((127u - 15u) << 23);
  float normal;
  __builtin_memcpy(&normal, &bits, sizeof(normal));
  const float x = size < 4 ? float(size) * 0x1p-16f : normal;
  return code & 0x80 ? -x : x;
}

// Four of them at once. They are the upper halves of 16-bit floats, which processors know.
SURFCAP_HD Pack<float, 4> decode_e5m2(const uint8_t* codes) {
#if defined(SURFCAP_F16C)
  int32_t four;
  __builtin_memcpy(&four, codes, sizeof(four));
  const __m128i halves = _mm_unpacklo_epi8(_mm_setzero_si128(), _mm_cvtsi32_si128(four));
  return Pack<float, 4>(_mm_cvtph_ps(halves));
#else
  Pack<float, 4> x;
  for (int i = 0; i < 4; ++i) x[i] = decode_e5m2(codes[i]);
  return x;
#endif
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
