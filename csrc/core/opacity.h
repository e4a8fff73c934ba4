// From the field's value to a sample's transparency. A functor sees the previous and the current value of its run (a
// maximal row of consecutive samples in non-empty cells) and gives the transparency and its derivatives by both; the
// march knows nothing else of what the field stores.
#pragma once

#include <cmath>

#include "pack.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// The paper's field: the value is the transparency.
template <class Real> struct Transparency {
  static constexpr bool kMidpointColor = false;  // the colour of a sample is read at the sample

  struct State {
    Real value;
  };
  SURFCAP_HD State prepare(Real value) const { return {value}; }
  SURFCAP_HD State outside() const { return {Real(1)}; }
  SURFCAP_HD Real transparency(const State&, const State& now) const { return now.value; }
  // da/d(previous value), da/d(current value)
  SURFCAP_HD void derivatives(const State&, const State&, Real, Real& by_previous, Real& by_current) const {
    by_previous = Real(0);
    by_current = Real(1);
  }
};

// A signed distance s in voxels, positive outside. With the logistic Phi(s) = 1/(1 + E), E = exp(-slope s), the
// interval between two samples lets a = min(1, Phi_k / Phi_{k-1}) = min(1, (1 + E_{k-1}) / (1 + E_k)) through, and has
// the mean of their colours. Before a run's first sample E = 0.
template <class Real> struct SignedDistance {
  static constexpr bool kMidpointColor = true;
  Real slope;

  struct State {
    Real e;
  };
  SURFCAP_HD State prepare(Real value) const { return {std::exp(smaller(-slope * value, Real(60)))}; }
  SURFCAP_HD State outside() const { return {Real(0)}; }
  SURFCAP_HD Real transparency(const State& before, const State& now) const {
    return smaller(Real(1), (Real(1) + before.e) / (Real(1) + now.e));
  }
  SURFCAP_HD void derivatives(const State& before, const State& now, Real a, Real& by_previous,
                              Real& by_current) const {
    const Real scale = now.e > before.e ? slope * a : Real(0);  // nothing moves where the minimum is 1
    by_previous = -scale * before.e / (Real(1) + before.e);
    by_current = scale * now.e / (Real(1) + now.e);
  }
};

}  // namespace SURFCAP_ISA
}  // namespace surfcap
