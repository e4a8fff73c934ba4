// The sparse field as the kernels see it: 4x4x4 tiles behind a table of tile indices, trilinear in between.
//
// Positions are in voxel-centre units, u = (x - origin)/voxel - 1/2, where origin is the low corner of the table. The
// table's outermost tiles are outside, so a read never needs a bounds check once its base voxel is clamped.
#pragma once

#include "code.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kTile = 4;                            // voxels along a tile's edge
constexpr int kTileVoxels = kTile * kTile * kTile;  // [x][y][z], z fastest
constexpr int kInside = -1;                         // table entry: solid, no tile
constexpr int kOutside = -2;  // table entry: empty, no tile; kOutside - d: and so is every cell nearer than d cells

// Samples set up together by one thread.
#if defined(SURFCAP_CUDA)
constexpr int kLanes = 1;
#else
constexpr int kLanes = 8;
#endif

// What kLanes points, at the positions u[axis], read: a 2 x 2 x 2 block of voxels each. Corner c is the upper one along
// x where c has bit 2, along y where it has bit 1, along z where it has bit 0.
template <class Real> struct Corners {
  using Index = Pack<int32_t, kLanes>;
  using Number = Pack<Real, kLanes>;
  Index tile[3][2], local[3][2];  // of the lower and the upper voxels along each axis
  Number weight[3][2];

  SURFCAP_HD Corners(const Grid<Real>& grid, const Number (&u)[3]) {
    const int32_t stride[3] = {grid.n[1] * grid.n[2], grid.n[2], 1};
    const int32_t inner[3] = {kTile * kTile, kTile, 1};
    const Index none = fill_pack<int32_t, kLanes>(0);
    const Number zero = zero_pack<Real, kLanes>(), one = fill_pack<Real, kLanes>(Real(1));
    for (int axis = 0; axis < 3; ++axis) {
      const Index last = fill_pack<int32_t, kLanes>(kTile * (grid.n[axis] - 1) - 1);
      Index base = convert_pack<int32_t, kLanes, Real>(u[axis]);
      base = smaller_pack<int32_t, kLanes>(larger_pack<int32_t, kLanes>(base, none), last);
      const Number f = u[axis] - convert_pack<Real, kLanes, int32_t>(base);
      weight[axis][1] = smaller_pack<Real, kLanes>(larger_pack<Real, kLanes>(f, zero), one);
      weight[axis][0] = one - weight[axis][1];
      for (int side = 0; side < 2; ++side) {
        tile[axis][side] = ((base + side) >> 2) * stride[axis];
        local[axis][side] = ((base + side) & 3) * inner[axis];
      }
    }
  }

  // The voxel's index at corner c, or, where it has no tile, the entry of the table; this one in `entry` in any case.
  SURFCAP_HD Index voxel(const Grid<Real>& grid, int c, Index& entry) const {
    entry = look_up<kLanes>(grid.table,
                            at<int32_t>(tile[0], c >> 2) + at<int32_t>(tile[1], c >> 1) + at<int32_t>(tile[2], c));
    // A stored tile has voxel >= entry, a missing one (entry < 0) voxel <= entry: the greater is what is wanted.
    const Index index = entry * kTileVoxels +
                        (at<int32_t>(local[0], c >> 2) + at<int32_t>(local[1], c >> 1) + at<int32_t>(local[2], c));
    return larger_pack<int32_t, kLanes>(entry, index);
  }

  // The trilinear weight of corner c.
  SURFCAP_HD Number share(int c) const {
    return at<Real>(weight[0], c >> 2) * at<Real>(weight[1], c >> 1) * at<Real>(weight[2], c);
  }

 private:
  template <class T> SURFCAP_HD static Pack<T, kLanes> at(const Pack<T, kLanes> (&pair)[2], int bit) {
    return choose_pack<T, kLanes>(bit & 1, pair[1], pair[0]);
  }
};

// A world position in voxel-centre units.
template <class Real, class Number> SURFCAP_HD Number in_voxels(const Grid<Real>& grid, int axis, const Number& x) {
  return (x - grid.origin[axis]) * grid.per_unit - Real(0.5);
}

// The world position of voxel v of a tile, along one axis.
template <class Real> SURFCAP_HD Real center_of(const Grid<Real>& grid, const int32_t* tile, int v, int axis) {
  const int place = (v >> (4 - 2 * axis)) & 3;
  return grid.origin[axis] + (Real(kTile * tile[axis] + place) + Real(0.5)) / grid.per_unit;
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
