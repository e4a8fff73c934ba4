// Which kernel table runs.
#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace surfcap {

template <class Table> const Table& best() {
  static const Table& table = []() -> const Table& {
#if defined(__x86_64__)
    const char* asked = std::getenv("TORCH_SURFCAP_ISA");
    const auto allowed = [&](const char* name) { return !asked || std::strcmp(asked, name) == 0; };
    const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool has_avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                            __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
    if (has_avx512 && allowed("avx512")) return avx512::kernels<Table>();
    if (has_avx2 && allowed("avx2")) return avx2::kernels<Table>();
#endif
    return baseline::kernels<Table>();
  }();
  return table;
}

#define SURFCAP_BEST(...) template const __VA_ARGS__& best<__VA_ARGS__>()
SURFCAP_ALL_TABLES(SURFCAP_BEST);

}  // namespace surfcap
