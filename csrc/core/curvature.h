// The curvature of the opacity value: Huber's norm of the 7-point Laplacian, over the voxels where it is known, namely
// where the voxel and its 6 neighbours lie strictly between the two boundary values. Missing voxels never do, nor do
// clamped distances. A signed distance has no second derivative along its normal, so its Laplacian is the sum of the
// surface's curvatures: unlike total variation the term neither pulls a plane nor shrinks a ball to first order, it
// costs bending. Huber's norm spares edges and thin parts.
#pragma once

#include "field.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kHalo = 2, kHaloSide = kTile + 2 * kHalo;         // a tile with a neighbour's neighbours around it
constexpr int kHaloVoxels = kHaloSide * kHaloSide * kHaloSide;  // [x][y][z], z fastest
#if defined(SURFCAP_CUDA)
constexpr int kRun = 1;  // voxels along z that a thread takes at once
#else
constexpr int kRun = kHaloSide;
#endif

// The opacity value at (x, y, z) of the halo of the tile that stands at `cell` of the table.
template <class Real, class Stored>
SURFCAP_HD Real halo_value(const Field<Real, Stored>& field, int64_t cell, int x, int y, int z) {
  const int32_t entry =
      field.table[cell + (((x + kHalo) / kTile - 1) * field.n[1] + (y + kHalo) / kTile - 1) * int64_t(field.n[2]) +
                  (z + kHalo) / kTile - 1];
  const int local = ((x + kHalo) % kTile * kTile + (y + kHalo) % kTile) * kTile + (z + kHalo) % kTile;
  return entry < 0 ? field.missing[entry == kInside] : opacity_value(field, int64_t(entry) * kTileVoxels + local);
}

// The 7-point Laplacian of kRun cells of the halo; those around them must be there, too.
template <class Real> SURFCAP_HD Pack<Real, kRun> laplacian(const Real* at) {
  const int along[3] = {kHaloSide * kHaloSide, kHaloSide, 1};
  Pack<Real, kRun> sum = zero_pack<Real, kRun>();
  for (int axis = 0; axis < 3; ++axis) sum += load<Real, kRun>(at - along[axis]) + load<Real, kRun>(at + along[axis]);
  return sum - Real(6) * load<Real, kRun>(at);
}

// Where the curvature is known: strictly between the boundary values. Of codes, less than half a step inside: what a
// bound decodes to may be off by rounding.
template <class Real, class Stored> struct Known {
  Real low, high;

  SURFCAP_HD explicit Known(const Grid<Real>& grid) {
    low = smaller(grid.missing[0], grid.missing[1]);
    high = larger(grid.missing[0], grid.missing[1]);
    const Real hair = kSteps<Stored> > 0 ? Real(0.25) / kSteps<Stored> * (high - low) : Real(0);
    low += hair;
    high -= hair;
  }

  // The norm's derivative by the Laplacian at kRun cells from number `first` on, x and y within 1..6; returns the sum
  // of the norms of those that are the tile's own.
  SURFCAP_HD Real bend(const Real* value, int first, Real eps, Real* bend) const {
    using Run = Pack<Real, kRun>;
    const Real* const at = value + first;
    const Run here = load<Real, kRun>(at), difference = laplacian(at);
    Run least = here, most = here;
    const int along[3] = {kHaloSide * kHaloSide, kHaloSide, 1};
    for (int axis = 0; axis < 3; ++axis) {
      for (int side = -1; side <= 1; side += 2) {
        const Run other = load<Real, kRun>(at + side * along[axis]);
        least = smaller_pack<Real, kRun>(least, other);
        most = larger_pack<Real, kRun>(most, other);
      }
    }
    const auto own = [](int i) { return i >= kHalo && i < kHalo + kTile; };
    Real loss = Real(0);
    for (int i = 0; i < kRun; ++i) {
      const int cell = first + i, x = cell / (kHaloSide * kHaloSide), y = cell / kHaloSide % kHaloSide;
      const int z = cell % kHaloSide;
      const bool known = z > 0 && z < kHaloSide - 1 && least[i] > low && most[i] < high;
      const Real norm = huber(known ? difference[i] : Real(0), eps, bend[cell]);
      if (own(x) && own(y) && own(z)) loss += norm;
    }
    return loss;
  }
};

// The number in the halo of the tile's voxel v.
SURFCAP_HD int in_halo(int v) {
  return ((v / (kTile * kTile) + kHalo) * kHaloSide + v / kTile % kTile + kHalo) * kHaloSide + v % kTile + kHalo;
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
