// soft_hull on the CPU.
#include "../drivers/soft_hull.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void soft_hull(Silhouettes<Real> silhouettes, int64_t pixels, const Input<Real>& points, Real* value,
                 int32_t* votes) const {
    std::vector<int64_t> offsets;
    int64_t total = 0;
    for (int64_t v = 0; v < silhouettes.views; ++v) {
      offsets.push_back(total);
      total += silhouettes.sizes[2 * v] * silhouettes.sizes[2 * v + 1];
    }
    STD_TORCH_CHECK(total == pixels, "masks: expected ", total, " pixels, as sizes say, got ", pixels);
    silhouettes.offsets = offsets.data();
    parallel_ranges(points.tensor().size(0), 1024, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().soft_hull(silhouettes, points.data(), begin, end, value, votes);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("soft_hull", TORCH_BOX(&soft_hull<Cpu>)); }

}  // namespace surfcap
