// The curvature of the opacity value: Huber's norm of the 7-point Laplacian, over the voxels where it is known, namely
// where the voxel and its 6 neighbours lie strictly between the two boundary values. Missing voxels never do, nor do
// clamped distances. A signed distance has no second derivative along its normal, so its Laplacian is the sum of the
// surface's curvatures: unlike total variation the term neither pulls a plane nor shrinks a ball to first order, it
// costs bending. Huber's norm spares edges and thin parts.
#pragma once

#include "field.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// Adds the gradient of `weight` times the term to the opacity values of a tile, and returns the term's share of the
// tile's own voxels. `cell` is the tile's place in the table.
template <class Real, class Stored, class Sum>
SURFCAP_HD Real curvature_tile(const Field<Real, Stored>& field, int64_t cell, int64_t tile, Real weight, Real eps,
                               Sum* gradient) {
  constexpr int kSide = 2 * kTile, kHalo = 2;  // the tile with two voxels around it: a neighbour's neighbours
  using Row = Pack<Real, kSide>;
  const int32_t stride[3] = {field.n[1] * field.n[2], field.n[2], 1};
  // Of codes, less than half a step inside: what a bound decodes to may be off by rounding.
  const Real low_bound = smaller(field.missing[0], field.missing[1]),
             high_bound = larger(field.missing[0], field.missing[1]);
  const Real hair = kSteps<Stored> > 0 ? Real(0.25) / kSteps<Stored> * (high_bound - low_bound) : Real(0);
  const Real low = low_bound + hair, high = high_bound - hair;

  // bend: the norm's derivative by the Laplacian. Only rows with x and y in 1..6 are read with those around them, so
  // the shifted rows along z never leave the arrays.
  Real value[kSide * kSide * kSide], bend[kSide * kSide * kSide];
  for (int x = 0; x < kSide; ++x) {
    for (int y = 0; y < kSide; ++y) {
      const int64_t column = cell + ((x + kHalo) / kTile - 1) * stride[0] + ((y + kHalo) / kTile - 1) * stride[1];
      const int local = ((x + kHalo) % kTile * kTile + (y + kHalo) % kTile) * kTile;
      for (int z = 0; z < kSide; ++z) {
        const int32_t entry = field.table[column + (z + kHalo) / kTile - 1];
        const int64_t voxel = int64_t(entry) * kTileVoxels + local + (z + kHalo) % kTile;
        value[(x * kSide + y) * kSide + z] = entry < 0 ? field.missing[entry == kInside] : opacity_value(field, voxel);
      }
    }
  }

  Real loss = Real(0);
  const int along[3] = {kSide * kSide, kSide, 1};
  const auto sum_of_neighbours = [&](const Real* at) {
    Row sum = zero_pack<Real, kSide>();
    for (int axis = 0; axis < 3; ++axis)
      sum += load<Real, kSide>(at - along[axis]) + load<Real, kSide>(at + along[axis]);
    return sum;
  };
  for (int x = 1; x < kSide - 1; ++x) {
    for (int y = 1; y < kSide - 1; ++y) {
      const int row = (x * kSide + y) * kSide;
      const Row here = load<Real, kSide>(value + row);
      Row least = here, most = here;
      for (int axis = 0; axis < 3; ++axis) {
        for (int side = -1; side <= 1; side += 2) {
          const Row other = load<Real, kSide>(value + row + side * along[axis]);
          least = smaller_pack<Real, kSide>(least, other);
          most = larger_pack<Real, kSide>(most, other);
        }
      }
      const Row difference = sum_of_neighbours(value + row) - Real(2 * 3) * here;
      for (int z = 0; z < kSide; ++z) {
        const bool known = z > 0 && z < kSide - 1 && least[z] > low && most[z] < high;
        const Real norm = huber(known ? difference[z] : Real(0), eps, bend[row + z]);
        if (x >= kHalo && x < kHalo + kTile && y >= kHalo && y < kHalo + kTile && z >= kHalo && z < kHalo + kTile)
          loss += norm;
      }
    }
  }

  for (int v = 0; v < kTileVoxels / kTile; ++v) {  // rows of the tile
    const int row = ((v / kTile + kHalo) * kSide + v % kTile + kHalo) * kSide;
    const Row here = load<Real, kSide>(bend + row);
    const Row by_value = Real(kSumScale<Sum>) * weight * (sum_of_neighbours(bend + row) - Real(2 * 3) * here);
    for (int z = 0; z < kTile; ++z)
      add_to(gradient + (tile * kTileVoxels + v * kTile + z) * field.pitch, by_value[z + kHalo]);
  }
  return loss;
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
