// How the drivers spread work over threads.
//
// Sums must not depend on the number of threads. Whatever adds into a common gradient is therefore split into a fixed
// number of groups, each with a buffer of its own, and the buffers are added in a fixed order.
#pragma once

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <algorithm>

#include "../arguments.h"
#include "kernels.h"

namespace surfcap {

// The device that the drivers run on: the tensors of a call need no look, for the dispatcher comes here only with those
// of the host. Ops add what they run to it.
struct Host {
  Host(const char*, std::initializer_list<Tensor>) {}
};

constexpr int64_t kChunk = 256;  // rays or points that one group takes at a time, to even out the load

// Asks for large pages under a large buffer, before it is first touched: the march reads and writes it at random, and
// would otherwise wait for address translation more than for data.
inline void advise_large_pages(void* data, int64_t bytes) {
#if defined(__linux__)
  constexpr uintptr_t kPage = uintptr_t(2) << 20;
  const uintptr_t begin = (uintptr_t(data) + kPage - 1) / kPage * kPage,
                  end = (uintptr_t(data) + bytes) / kPage * kPage;
  if (begin < end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
}

template <class F> void parallel_ranges(int64_t count, int64_t grain, const F& f) {
  if (count > 0) torch::stable::parallel_for(0, count, grain, [&](int64_t begin, int64_t end) { f(begin, end); });
}

// Calls work(begin, end, buffer, group) for all chunks of 0..count, chunk c in group c mod groups, each group with its
// own zeroed buffer of `size` numbers, the first being `total` and the others following one another in `rest`; then
// combines the buffers into `total` group by group: combine(total, buffer, begin, end), tile by tile.
template <class Number, class Work, class Combine>
void grouped(int64_t count, int64_t groups, int64_t size, Number* total, Number* rest, const Work& work,
             const Combine& combine) {
  const int64_t chunks = (count + kChunk - 1) / kChunk;
  parallel_ranges(groups, 1, [&](int64_t first, int64_t last) {
    for (int64_t g = first; g < last; ++g) {
      Number* const buffer = g == 0 ? total : rest + (g - 1) * size;
      std::fill(buffer, buffer + size, Number{});
      for (int64_t c = g; c < chunks; c += groups) work(c * kChunk, std::min(count, (c + 1) * kChunk), buffer, g);
    }
  });
  parallel_ranges(size / kVoxelsPerTile, 1 << 8, [&](int64_t begin, int64_t end) {
    for (int64_t g = 1; g < groups; ++g)
      combine(total, rest + (g - 1) * size, begin * kVoxelsPerTile, end * kVoxelsPerTile);
  });
}

// The same into a tensor, with buffers of its own for all groups but the first; no more groups than chunks.
template <class Real, class Work, class Combine>
void grouped(int64_t count, int64_t groups, const Tensor& total, const Work& work, const Combine& combine) {
  STD_TORCH_CHECK(groups >= 1, "groups: expected at least 1, got ", groups);
  groups = std::max<int64_t>(1, std::min(groups, (count + kChunk - 1) / kChunk));
  const int64_t size = total.numel();
  const Tensor rest = torch::stable::new_empty(total, {groups - 1, size});
  Real *const first = total.template mutable_data_ptr<Real>(), *const others = rest.template mutable_data_ptr<Real>();
  advise_large_pages(first, size * int64_t(sizeof(Real)));
  advise_large_pages(others, (groups - 1) * size * int64_t(sizeof(Real)));
  grouped(count, groups, size, first, others, work, combine);
}

template <class Real, class Work>
void grouped_sum(int64_t count, int64_t groups, const Tensor& total, const Work& work) {
  grouped<Real>(count, groups, total, work, best<FitKernels<Real, Real, Real>>().add_sums);
}

}  // namespace surfcap
