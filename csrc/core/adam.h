// The step of Adam (Kingma and Ba 2015) and the clamp of each coefficient, on numbers and on codes.
#pragma once

#include <cmath>

#include "code.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// On records of numbers.
template <class Real, int Pitch>
SURFCAP_HD void adam_records(Real* value, const Real* gradient, Real* first, Real* second, int64_t records,
                             const AdamSettings<Real>& adam) {
  for (int64_t r = 0; r < records; ++r) {
    for (int i = 0; i < Pitch; ++i) {
      const int64_t at = r * Pitch + i;
      const Real g = gradient[at];
      first[at] = adam.beta1 * first[at] + (Real(1) - adam.beta1) * g;
      second[at] = adam.beta2 * second[at] + (Real(1) - adam.beta2) * g * g;
      const Real step = first[at] * adam.correction1 / (std::sqrt(second[at] * adam.correction2) + adam.epsilon);
      value[at] = clamped(value[at] - adam.rate[i] * step, adam.low[i], adam.high[i]);
    }
  }
}

// The moments beside codes: e5m2 and u5.3 beside codes of 8 bits, halves beside those of 16. The second moment is kept
// as its square root, which needs half its range.
template <int N> SURFCAP_HD Pack<float, N> first_moment(const uint8_t* from) { return decode_e5m2<N>(from); }
template <int N> SURFCAP_HD Pack<float, N> root_moment(const uint8_t* from) { return decode_u53<N>(from); }
template <int N> SURFCAP_HD Pack<float, N> first_moment(const Half* from) { return from_halves<N>(from); }
template <int N> SURFCAP_HD Pack<float, N> root_moment(const Half* from) { return from_halves<N>(from); }
template <int N>
SURFCAP_HD void keep_moments(const Pack<float, N>& m, const Pack<float, N>& root, const uint32_t* noise, uint8_t* first,
                             uint8_t* second) {
  uint32_t other[N];  // of the 32 bits the value takes the upper half, each moment a quarter
  for (int i = 0; i < N; ++i) other[i] = noise[i] >> 8;
  encode_e5m2<N>(m, noise, first);
  encode_u53<N>(root, other, second);
}
template <int N>
SURFCAP_HD void keep_moments(const Pack<float, N>& m, const Pack<float, N>& root, const uint32_t*, Half* first,
                             Half* second) {
  to_halves<N>(m, first);
  to_halves<N>(root, second);
}

// On the codes begin .. end, rows of 16 of whole records. Gradient and moments are in the scale of narrow sums, steps
// in units of a code.
template <int Pitch, class Stored, class Sum>
SURFCAP_HD void adam_codes(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second,
                           int64_t begin, int64_t end, const AdamSettings<float>& adam) {
  constexpr int kRow = 16, kPeriod = Pitch < kRow ? kRow : Pitch;
  constexpr float kTop = kSteps<Stored>, kScale = float(kSumScale<Half> / kSumScale<Sum>);
  using Row = Pack<float, kRow>;
  float rate[kPeriod];  // codes
  for (int i = 0; i < kPeriod; ++i) {
    const float span = adam.high[i % Pitch] - adam.low[i % Pitch];
    rate[i] = span > 0 ? adam.rate[i % Pitch] * adam.correction1 * kTop / span : 0.0f;
  }
  const float correction2 = std::sqrt(adam.correction2), epsilon = adam.epsilon * float(kSumScale<Half>);
  const bool stochastic = adam.stochastic;
  const uint32_t key = adam.key;
  for (int64_t at = begin; at < end; at += kRow) {
    Row g;
    if constexpr (std::is_same_v<Sum, Half>)
      g = from_halves<kRow>(gradient + at);
    else
      g = kScale * load<float, kRow>(gradient + at);
    const Row old = root_moment<kRow>(second + at);
    const Row m = adam.beta1 * first_moment<kRow>(first + at) + (1 - adam.beta1) * g;
    const Row v = adam.beta2 * old * old + (1 - adam.beta2) * g * g;
    const Row rates = load<float, kRow>(rate + at % kPeriod);
    float root[kRow];
    uint32_t noise[kRow];
    int32_t code[kRow];
    store<int32_t, kRow>(code, widened<kRow>(value + at));
    for (int i = 0; i < kRow; ++i) {
      noise[i] = noise_of(uint32_t(at + i), key);
      root[i] = std::sqrt(v[i]);
      const float step = clamped(rates[i] * m[i] / (root[i] * correction2 + epsilon), -kTop, kTop);
      const float up = stochastic ? float(int32_t(noise[i] >> 16)) * 0x1p-16f : 0.5f;
      code[i] = clamped<int32_t>(code[i] + int32_t(std::floor(up - step)), 0, int32_t(kTop));
    }
    for (int i = 0; i < kRow; ++i) value[at + i] = Stored(code[i]);
    keep_moments<kRow>(m, load<float, kRow>(root), noise, first + at, second + at);
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
