// A pack is a short row of numbers handled as one: the coefficients of one voxel, or the (opacity, r, g, b) of one
// sample. On the CPU it is a vector register through the compiler's vector extension, on CUDA a small array that lives
// in registers. Everything here sits in a namespace named after the instruction set it is compiled for, so that the
// linker never merges code of one set with code of another.
#pragma once

#include "views.h"

#if defined(SURFCAP_CUDA)
#include <cuda_runtime.h>
#define SURFCAP_HD __host__ __device__ __forceinline__
#define SURFCAP_ISA cuda
#else
#if defined(__x86_64__)
#include <immintrin.h>
#endif
#define SURFCAP_HD inline __attribute__((always_inline))
#endif

#ifndef SURFCAP_ISA
#define SURFCAP_ISA generic
#endif

namespace surfcap {
inline namespace SURFCAP_ISA {

#if defined(SURFCAP_CUDA)
// As aligned as the widest load of its size, so that `load_aligned` is one instruction.
template <class Real, int N> struct alignas(N * sizeof(Real) > 16 ? 16 : N * sizeof(Real)) PackStruct {
  Real lane[N];
  SURFCAP_HD Real& operator[](int i) { return lane[i]; }
  SURFCAP_HD Real operator[](int i) const { return lane[i]; }
#define SURFCAP_PACK_OPERATOR(op)                                                      \
  friend SURFCAP_HD PackStruct operator op(const PackStruct& a, const PackStruct& b) { \
    PackStruct r;                                                                      \
    for (int i = 0; i < N; ++i) r.lane[i] = a.lane[i] op b.lane[i];                    \
    return r;                                                                          \
  }                                                                                    \
  friend SURFCAP_HD PackStruct operator op(Real a, const PackStruct& b) {              \
    PackStruct r;                                                                      \
    for (int i = 0; i < N; ++i) r.lane[i] = a op b.lane[i];                            \
    return r;                                                                          \
  }                                                                                    \
  friend SURFCAP_HD PackStruct operator op(const PackStruct& a, Real b) {              \
    PackStruct r;                                                                      \
    for (int i = 0; i < N; ++i) r.lane[i] = a.lane[i] op b;                            \
    return r;                                                                          \
  }                                                                                    \
  SURFCAP_HD PackStruct& operator op## = (const PackStruct& b) { return *this = *this op b; }
  SURFCAP_PACK_OPERATOR(+)
  SURFCAP_PACK_OPERATOR(-)
  SURFCAP_PACK_OPERATOR(*)
  SURFCAP_PACK_OPERATOR(/)
#undef SURFCAP_PACK_OPERATOR
  friend SURFCAP_HD PackStruct operator>>(PackStruct a, int bits) {
    for (int i = 0; i < N; ++i) a.lane[i] >>= bits;
    return a;
  }
  friend SURFCAP_HD PackStruct operator&(PackStruct a, Real bits) {
    for (int i = 0; i < N; ++i) a.lane[i] &= bits;
    return a;
  }
};
template <class Real, int N> struct PackOf {
  using type = PackStruct<Real, N>;
};
#else
template <class Real, int N> struct PackOf {
  typedef Real type __attribute__((vector_size(N * sizeof(Real))));
};
#endif

template <class Real, int N> using Pack = typename PackOf<Real, N>::type;

template <class Real, int N> SURFCAP_HD Pack<Real, N> fill_pack(Real x) {
  Pack<Real, N> p;
  for (int i = 0; i < N; ++i) p[i] = x;
  return p;
}

template <class Real, int N> SURFCAP_HD Pack<Real, N> zero_pack() { return fill_pack<Real, N>(Real(0)); }

// Unaligned load and store of N consecutive numbers. On the CPU memcpy of a whole register compiles to one move.
template <class Real, int N> SURFCAP_HD Pack<Real, N> load(const Real* from) {
  Pack<Real, N> p;
  __builtin_memcpy(&p, from, sizeof(p));
  return p;
}

template <class Real, int N> SURFCAP_HD void store(Real* to, const Pack<Real, N>& p) {
  __builtin_memcpy(to, &p, sizeof(p));
}

// The same of memory as aligned as the pack, which records are.
template <class Real, int N> SURFCAP_HD Pack<Real, N> load_aligned(const Real* from) {
#if defined(SURFCAP_CUDA)
  return *reinterpret_cast<const Pack<Real, N>*>(from);
#else
  return load<Real, N>(from);
#endif
}

template <class Real, int N> SURFCAP_HD void store_aligned(Real* to, const Pack<Real, N>& p) {
#if defined(SURFCAP_CUDA)
  *reinterpret_cast<Pack<Real, N>*>(to) = p;
#else
  store<Real, N>(to, p);
#endif
}

// Lane by lane: truncation to integers, integers to numbers, the lesser and the greater of two packs.
template <class To, int N, class From> SURFCAP_HD Pack<To, N> convert_pack(const Pack<From, N>& from) {
#if defined(SURFCAP_CUDA)
  Pack<To, N> to;
  for (int i = 0; i < N; ++i) to[i] = To(from[i]);
  return to;
#else
  return __builtin_convertvector(from, Pack<To, N>);
#endif
}

template <class T, int N> SURFCAP_HD Pack<T, N> smaller_pack(const Pack<T, N>& a, const Pack<T, N>& b) {
#if defined(SURFCAP_CUDA)
  Pack<T, N> r;
  for (int i = 0; i < N; ++i) r[i] = a[i] < b[i] ? a[i] : b[i];
  return r;
#else
  return a < b ? a : b;
#endif
}

template <class T, int N> SURFCAP_HD Pack<T, N> larger_pack(const Pack<T, N>& a, const Pack<T, N>& b) {
#if defined(SURFCAP_CUDA)
  Pack<T, N> r;
  for (int i = 0; i < N; ++i) r[i] = a[i] > b[i] ? a[i] : b[i];
  return r;
#else
  return a > b ? a : b;
#endif
}

// One of two packs. On CUDA number by number, never by address: an array that is indexed leaves the registers.
template <class T, int N> SURFCAP_HD Pack<T, N> choose_pack(bool first, const Pack<T, N>& a, const Pack<T, N>& b) {
#if defined(SURFCAP_CUDA)
  Pack<T, N> r;
  for (int i = 0; i < N; ++i) {
    const T x = a[i], y = b[i];
    r[i] = first ? x : y;
  }
  return r;
#else
  return first ? a : b;
#endif
}

// table[index] for every lane.
template <int N> SURFCAP_HD Pack<int32_t, N> look_up(const int32_t* table, const Pack<int32_t, N>& index) {
#if defined(__AVX512F__)
  if constexpr (N == 16) return Pack<int32_t, N>(_mm512_i32gather_epi32(__m512i(index), table, 4));
#endif
#if defined(__AVX2__)
  if constexpr (N == 8) return Pack<int32_t, N>(_mm256_i32gather_epi32(table, __m256i(index), 4));
#endif
  Pack<int32_t, N> r;
  for (int i = 0; i < N; ++i) r[i] = table[index[i]];
  return r;
}

template <class Real> SURFCAP_HD Real smaller(Real a, Real b) { return a < b ? a : b; }
template <class Real> SURFCAP_HD Real larger(Real a, Real b) { return a > b ? a : b; }
template <class Real> SURFCAP_HD Real clamped(Real x, Real low, Real high) { return smaller(larger(x, low), high); }

// Huber's norm, x^2/2 below eps and eps (|x| - eps/2) above, and its derivative; both without a branch.
template <class Real> SURFCAP_HD Real huber(Real x, Real eps, Real& derivative) {
  derivative = clamped(x, -eps, eps);
  return derivative * (x - Real(0.5) * derivative);
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
