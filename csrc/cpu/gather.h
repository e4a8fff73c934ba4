// The gathered gradient on a CPU: one thread takes a tile, lists what its voxels read from a camera, asks for it, and
// then reads it.
#pragma once

#include "../core/slots.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// The gradient of one tile's voxels, all cameras in their order. Memory rule: writes `gradient` [4, 4, 4, pitch].
template <class Real, int Degree, class Slot>
SURFCAP_HD void gather_tile(const Grid<Real>& field, const int32_t* coordinate, const SlotCameras<Real>& cameras,
                            const SlotRows<Real>& rows, const Slot* slots, Real* gradient) {
  using R = Record<Degree>;
  Stand<Real> stands[kTileVoxels / kLanes];
  Share<Real> shares[4 * kTileVoxels + 1];
  int voxels[4 * kTileVoxels + 1];  // whose they are
  Pack<Real, 4> read[kTileVoxels];
  for (int i = 0; i < kTileVoxels * R::kPitch; ++i) gradient[i] = Real(0);
  for (int64_t v = 0; v < cameras.views; ++v) {
    const int64_t width = cameras.windows[4 * v + 2];
    if (width == 0) continue;
    int count = 0;
    for (int first = 0; first < kTileVoxels; first += kLanes) {
      Stand<Real>& stand = stands[first / kLanes];
      find_stand(field, coordinate, first, cameras, v, stand);
      const int before = count;
      for (int l = 0; l < kLanes; ++l) {
        if (!within_reach(stand, l)) continue;
        for (int c = 0; c < 4; ++c) {
          voxels[count] = first + l;
          count += find_share(stand, l, c, width, rows, shares[count]);  // without a branch: every other one misses
        }
      }
      for (int s = before; s < count; ++s) __builtin_prefetch(slots + 4 * shares[s].before);
    }
    if (count == 0) continue;
    for (int i = 0; i < kTileVoxels; ++i) read[i] = zero_pack<Real, 4>();
    for (int s = 0; s < count; ++s) read[voxels[s]] += read_share(shares[s], slots);
    for (int i = 0; i < kTileVoxels; ++i) {
      const Coefficients<Real, Degree> found = by_record<Real, Degree>(stands[i / kLanes], i % kLanes, rows, read[i]);
      Real* const to = gradient + i * R::kPitch;
      for (int p = 0; p < R::kParts; ++p)
        store<Real, R::kPart>(to + p * R::kPart, load<Real, R::kPart>(to + p * R::kPart) + found.part[p]);
    }
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
