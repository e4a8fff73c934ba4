// Floating point in 16 and 8 bits. All formats have the exponent of IEEE's half, 5 bits with bias 15:
//   half  1-5-10
//   e5m2  1-5-2   signed:    a half without its lower 8 bits
//   u5.3  0-5-3   unsigned:  a half without its sign and its lower 7 bits
// so that a narrow one is a half cut off: uniform noise is added below the cut, and rounds up with the probability of
// what is cut. The mean of many roundings is then the number itself, and changes far smaller than the format's spacing
// still move it, where rounding to the nearest would leave it for ever. What is too large becomes the largest number.
#pragma once

#include "pack.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kCutE5m2 = 8, kCutU53 = 7;
constexpr float kMostHalf = 65504, kMostE5m2 = 57344, kMostU53 = 61440;

// Uniform 32 bits for (index, key): counter-based, so that they depend neither on threads nor on order.
SURFCAP_HD uint32_t noise_of(uint32_t index, uint32_t key) {
  uint32_t x = index * 0x9e3779b9u + key;
  x = (x ^ (x >> 16)) * 0x21f0aaadu;
  x = (x ^ (x >> 15)) * 0x735a2d97u;
  return x ^ (x >> 15);
}

// To the nearest half, ties to even.
SURFCAP_HD Half to_half(float x) {
  x = clamped(x, -kMostHalf, kMostHalf);
#if defined(SURFCAP_AVX2)
  return {uint16_t(_cvtss_sh(x, _MM_FROUND_TO_NEAREST_INT))};
#else
  uint32_t bits;
  __builtin_memcpy(&bits, &x, sizeof(bits));
  const uint32_t sign = bits >> 31 << 15;
  float size = x < 0 ? -x : x;
  const bool normal = size >= 1.0f / (1 << 14);
  if (!normal) size += 0.5f;  // just above 1/2 floats have the spacing that halves have below 2^-14
  __builtin_memcpy(&bits, &size, sizeof(bits));
  if (normal)
    bits = ((bits + 0xfff + (bits >> 13 & 1)) >> 13) - ((127 - 15) << 10);  // the biases differ
  else
    bits -= uint32_t(126) << 23;
  return {uint16_t(sign | bits)};
#endif
}

SURFCAP_HD float from_half(Half h) {
#if defined(SURFCAP_AVX2)
  return _cvtsh_ss(h.bits);
#else
  constexpr float kBias = 0x1p112f;  // 2 to the difference of the biases
  const uint32_t bits = uint32_t(h.bits & 0x7fff) << 13;
  float size;
  __builtin_memcpy(&size, &bits, sizeof(size));
  return (h.bits >> 15 ? -kBias : kBias) * size;
#endif
}

// Rows of N numbers, N a multiple of 4.
template <int N> SURFCAP_HD void to_halves(const Pack<float, N>& x, Half* to) {
#if defined(SURFCAP_AVX2)
  const Pack<float, N> most = fill_pack<float, N>(kMostHalf);
  const Pack<float, N> held = smaller_pack<float, N>(larger_pack<float, N>(x, zero_pack<float, N>() - most), most);
#if defined(SURFCAP_AVX512)
  if constexpr (N == 16) {
    _mm256_storeu_si256((__m256i_u*)to, _mm512_maskz_cvtps_ph(0xffff, __m512(held), _MM_FROUND_TO_NEAREST_INT));
    return;
  }
#endif
  float row[N];
  store<float, N>(row, held);
  for (int i = 0; i < N; i += 4)
    _mm_storel_epi64((__m128i*)(to + i), _mm_cvtps_ph(_mm_loadu_ps(row + i), _MM_FROUND_TO_NEAREST_INT));
#else
  for (int i = 0; i < N; ++i) to[i] = to_half(x[i]);
#endif
}

template <int N> SURFCAP_HD Pack<float, N> from_halves(const Half* from) {
#if defined(SURFCAP_AVX512)
  if constexpr (N == 16)
    return Pack<float, N>(_mm512_maskz_cvtph_ps(0xffff, _mm256_loadu_si256((const __m256i_u*)from)));
#endif
  float row[N];
#if defined(SURFCAP_AVX2)
  for (int i = 0; i < N; i += 4) _mm_storeu_ps(row + i, _mm_cvtph_ps(_mm_loadl_epi64((const __m128i*)(from + i))));
#else
  for (int i = 0; i < N; ++i) row[i] = from_half(from[i]);
#endif
  return load<float, N>(row);
}

// Rows of the narrow formats: the upper bits of a row of halves, rounded by the lower bits of `noise`; |x| <=
// kMostE5m2, 0 <= x <= kMostU53.
template <int Cut, int N> SURFCAP_HD void cut_halves(const Pack<float, N>& x, const uint32_t* noise, uint8_t* to) {
  Half row[N];
  to_halves<N>(x, row);
#if defined(SURFCAP_CUDA)
  Pack<uint8_t, N> bytes;  // in one access
  for (int i = 0; i < N; ++i) bytes[i] = uint8_t((row[i].bits + (noise[i] & ((1 << Cut) - 1))) >> Cut);
  store_aligned<uint8_t, N>(to, bytes);
#else
  for (int i = 0; i < N; ++i) to[i] = uint8_t((row[i].bits + (noise[i] & ((1 << Cut) - 1))) >> Cut);
#endif
}

template <int Cut, int N> SURFCAP_HD Pack<float, N> uncut_halves(const uint8_t* from) {
  Half row[N];
#if defined(SURFCAP_CUDA)
  const Pack<uint8_t, N> bytes = load_aligned<uint8_t, N>(from);  // in one access
  for (int i = 0; i < N; ++i) row[i].bits = uint16_t(bytes[i] << Cut);
#else
  for (int i = 0; i < N; ++i) row[i].bits = uint16_t(from[i] << Cut);
#endif
  return from_halves<N>(row);
}

template <int N> SURFCAP_HD void encode_e5m2(const Pack<float, N>& x, const uint32_t* noise, uint8_t* to) {
  const Pack<float, N> most = fill_pack<float, N>(kMostE5m2);
  cut_halves<kCutE5m2, N>(smaller_pack<float, N>(larger_pack<float, N>(x, zero_pack<float, N>() - most), most), noise,
                          to);
}

// The nearest e5m2, the even one of two; what is too large becomes the largest.
SURFCAP_HD uint8_t nearest_e5m2(float x) {
  constexpr float kLeastNormal = 0x1p-14f, kInteger = 0x1p23f;  // a float of 2^23 and more has no fraction
  constexpr uint32_t kDropped = 21, kRebias = (127 - 15) << 2;
  const float least = x < 0.0f ? -x : x, size = least < kMostE5m2 ? least : kMostE5m2;
  const float rounded = size * 0x1p16f + kInteger;
  uint32_t bits, steps, sign;
  __builtin_memcpy(&sign, &x, sizeof(sign));
  __builtin_memcpy(&bits, &size, sizeof(bits));
  __builtin_memcpy(&steps, &rounded, sizeof(steps));
  bits = ((bits + (1u << (kDropped - 1)) - 1 + ((bits >> kDropped) & 1)) >> kDropped) - kRebias;
  return uint8_t((size < kLeastNormal ? steps & 0xff : bits) | (sign >> 24 & 0x80));
}

template <int N> SURFCAP_HD Pack<float, N> decode_e5m2(const uint8_t* from) { return uncut_halves<kCutE5m2, N>(from); }

template <int N> SURFCAP_HD void encode_u53(const Pack<float, N>& x, const uint32_t* noise, uint8_t* to) {
  cut_halves<kCutU53, N>(smaller_pack<float, N>(x, fill_pack<float, N>(kMostU53)), noise, to);
}

template <int N> SURFCAP_HD Pack<float, N> decode_u53(const uint8_t* from) { return uncut_halves<kCutU53, N>(from); }

}  // namespace SURFCAP_ISA
}  // namespace surfcap
