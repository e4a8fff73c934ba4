// What is known only when an op is called, handed on as types.
#pragma once

#include "harmonics.h"
#include "opacity.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

template <int N> struct Constant {
  static constexpr int value = N;
};

// Calls f with the spherical harmonics' degree as a constant.
template <class F> void with_degree(int32_t pitch, const F& f) {
  if (pitch == Record<0>::kPitch) f(Constant<0>{});
  if (pitch == Record<1>::kPitch) f(Constant<1>{});
  if (pitch == Record<2>::kPitch) f(Constant<2>{});
}

// Calls f with what the field's value means.
template <class Real, class F> void with_opacity(const RaySettings<Real>& settings, const F& f) {
  if (settings.opacity == 0)
    f(Transparency<Real>{});
  else
    f(SignedDistance<Real>{settings.slope});
}

// Calls f with the slots as what they are.
template <class Real, class F> void with_slots(bool narrow, const void* slots, const F& f) {
  if (narrow)
    f(static_cast<const uint8_t*>(slots));
  else
    f(static_cast<const Real*>(slots));
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
