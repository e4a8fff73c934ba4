// upscale on the CPU.
#include "../drivers/upscale.h"

#include "parallel.h"

namespace surfcap {
namespace {

struct Cpu : Host {
  using Host::Host;

  template <class Real>
  void upscale(const Field<Real>& coarse, const Field<Real>& fine, const int32_t* coordinates, int64_t tiles,
               Real* voxels) const {
    advise_large_pages(voxels, tiles * kVoxelsPerTile * coarse.pitch * int64_t(sizeof(Real)));
    parallel_ranges(tiles, 16, [&](int64_t begin, int64_t end) {
      best_kernels<Real>().upscale(coarse, fine, coordinates, begin, end, voxels);
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("upscale", TORCH_BOX(&upscale<Cpu>)); }

}  // namespace surfcap
