// The kernels for x86-64 with AVX-512. Standard headers come first: code of theirs must stay
// fit for every processor.
#if defined(__x86_64__)
#include <immintrin.h>

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <type_traits>
#include <vector>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,bmi,bmi2,f16c"))), \
                             apply_to = function)
#else
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,bmi,bmi2,f16c")
#endif
#define SURFCAP_AVX2  // __AVX2__ and its like do not follow the pragma in every compiler
#define SURFCAP_AVX512
#define SURFCAP_ISA avx512
#define SURFCAP_ISA_NAME "avx512"
#include "kernels_isa.h"
#if defined(__clang__)
#pragma clang attribute pop
#endif
#endif
