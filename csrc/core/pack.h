// A pack is a short row of numbers handled as one: the coefficients of one voxel, or the (opacity, r, g, b) of one
// sample. On the CPU it is a vector register through the compiler's vector extension, on CUDA a small array that lives
// in registers. Everything here sits in a namespace named after the instruction set it is compiled for, so that the
// linker never merges code of one set with code of another.
#pragma once

#include "views.h"

#if defined(__CUDACC__)
#define SURFCAP_HD __host__ __device__ __forceinline__
#else
#define SURFCAP_HD inline __attribute__((always_inline))
#endif

#ifndef SURFCAP_ISA
#define SURFCAP_ISA generic
#endif

namespace surfcap {
inline namespace SURFCAP_ISA {

#if defined(__CUDACC__)
template <class Real, int N> struct PackStruct {
  Real lane[N];
  SURFCAP_HD Real& operator[](int i) { return lane[i]; }
  SURFCAP_HD Real operator[](int i) const { return lane[i]; }
#define SURFCAP_PACK_OPERATOR(op)                                                                                      \
  friend SURFCAP_HD PackStruct operator op(const PackStruct& a, const PackStruct& b) {                                 \
    PackStruct r;                                                                                                      \
    for (int i = 0; i < N; ++i) r.lane[i] = a.lane[i] op b.lane[i];                                                    \
    return r;                                                                                                          \
  }                                                                                                                    \
  friend SURFCAP_HD PackStruct operator op(Real a, const PackStruct& b) {                                              \
    PackStruct r;                                                                                                      \
    for (int i = 0; i < N; ++i) r.lane[i] = a op b.lane[i];                                                            \
    return r;                                                                                                          \
  }                                                                                                                    \
  SURFCAP_HD PackStruct& operator op##=(const PackStruct& b) { return *this = *this op b; }
  SURFCAP_PACK_OPERATOR(+)
  SURFCAP_PACK_OPERATOR(-)
  SURFCAP_PACK_OPERATOR(*)
#undef SURFCAP_PACK_OPERATOR
};
template <class Real, int N> struct PackOf { using type = PackStruct<Real, N>; };
#else
template <class Real, int N> struct PackOf { typedef Real type __attribute__((vector_size(N * sizeof(Real)))); };
#endif

template <class Real, int N> using Pack = typename PackOf<Real, N>::type;

template <class Real, int N> SURFCAP_HD Pack<Real, N> zero_pack() {
  Pack<Real, N> p;
  for (int i = 0; i < N; ++i) p[i] = Real(0);
  return p;
}

// Unaligned load and store of N consecutive numbers. memcpy of a whole register compiles to one move.
template <class Real, int N> SURFCAP_HD Pack<Real, N> load(const Real* from) {
  Pack<Real, N> p;
  __builtin_memcpy(&p, from, sizeof(p));
  return p;
}

template <class Real, int N> SURFCAP_HD void store(Real* to, const Pack<Real, N>& p) {
  __builtin_memcpy(to, &p, sizeof(p));
}

template <class Real> SURFCAP_HD Real smaller(Real a, Real b) { return a < b ? a : b; }
template <class Real> SURFCAP_HD Real larger(Real a, Real b) { return a > b ? a : b; }
template <class Real> SURFCAP_HD Real clamped(Real x, Real low, Real high) { return smaller(larger(x, low), high); }

}  // namespace SURFCAP_ISA
}  // namespace surfcap
