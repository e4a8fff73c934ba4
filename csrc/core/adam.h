// The step of Adam (Kingma and Ba 2015) and the clamp of each coefficient, on numbers and on codes.
#pragma once

#include <cmath>

#include "code.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// On one number.
template <class Real>
SURFCAP_HD void adam_number(Real& value, Real g, Real& first, Real& second, Real rate, Real low, Real high,
                            const AdamSettings<Real>& adam) {
  first = adam.beta1 * first + (Real(1) - adam.beta1) * g;
  second = adam.beta2 * second + (Real(1) - adam.beta2) * g * g;
  const Real step = first * adam.correction1 / (std::sqrt(second * adam.correction2) + adam.epsilon);
  value = clamped(value - rate * step, low, high);
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

// What coefficient i moves by when the moments agree, in codes.
template <class Stored> SURFCAP_HD float code_rate(const AdamSettings<float>& adam, int i) {
  const float span = adam.high[i] - adam.low[i];
  return span > 0 ? adam.rate[i] * adam.correction1 * kSteps<Stored> / span : 0.0f;
}

// On the N codes from `at` on. Gradient and moments are in the scale of narrow sums, steps in units of a code.
template <int N, class Stored, class Sum>
SURFCAP_HD void adam_codes(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second,
                           int64_t at, const Pack<float, N>& rates, const AdamSettings<float>& adam) {
  constexpr float kTop = kSteps<Stored>, kScale = float(kSumScale<Half> / kSumScale<Sum>);
  const float correction2 = std::sqrt(adam.correction2), epsilon = adam.epsilon * float(kSumScale<Half>);
  Pack<float, N> g;
  if constexpr (std::is_same_v<Sum, Half>)
    g = from_halves<N>(gradient + at);
  else
    g = kScale * load<float, N>(gradient + at);
  const Pack<float, N> old = root_moment<N>(second + at);
  const Pack<float, N> m = adam.beta1 * first_moment<N>(first + at) + (1 - adam.beta1) * g;
  const Pack<float, N> v = adam.beta2 * old * old + (1 - adam.beta2) * g * g;
  float root[N];
  uint32_t noise[N];
  int32_t code[N];
  store<int32_t, N>(code, widened<N>(value + at));
  for (int i = 0; i < N; ++i) {
    noise[i] = noise_of(uint32_t(at + i), adam.key);
    root[i] = std::sqrt(v[i]);
    const float step = clamped(rates[i] * m[i] / (root[i] * correction2 + epsilon), -kTop, kTop);
    const float up = adam.stochastic ? float(int32_t(noise[i] >> 16)) * 0x1p-16f : 0.5f;
    code[i] = clamped<int32_t>(code[i] + int32_t(std::floor(up - step)), 0, int32_t(kTop));
  }
  for (int i = 0; i < N; ++i) value[at + i] = Stored(code[i]);
  keep_moments<N>(m, load<float, N>(root), noise, first + at, second + at);
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
