// The samples of a ray: t_k = (k + 1/2 + shift) * step from its origin, without those that nothing can be at.
#pragma once

#include "field.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// A ray in voxel-centre units: u(t) = origin + t * direction with t in world units; lane 3 is idle. A direction along
// an axis gets a hair of slope, so that no case needs a test for zero.
template <class Real> struct Line {
  Pack<Real, 4> origin, direction;

  Line() = default;
  SURFCAP_HD Line(const Grid<Real>& grid, const Real* o, const Real* d) {
    constexpr Real kHair = Real(1e-20);
    origin = zero_pack<Real, 4>();
    direction = fill_pack<Real, 4>(Real(1));
    for (int i = 0; i < 3; ++i) {
      origin[i] = in_voxels(grid, i, o[i]);
      const Real slope = d[i] * grid.per_unit;
      direction[i] = slope < kHair && slope > -kHair ? kHair : slope;
    }
  }
};

// The cells of the table that a ray passes, from front to back; empty neighbourhoods are left in one stride.
template <class Real> class Cells {
 public:
  Cells() = default;
  SURFCAP_HD Cells(const Grid<Real>& grid, const Line<Real>& ray) : line(ray), table_(grid.table) {
    inverse_ = fill_pack<Real, 4>(Real(1)) / line.direction;
    for (int axis = 0; axis < 2; ++axis) stride_[axis] = grid.n[axis + 1];
    Pack<Real, 4> high = zero_pack<Real, 4>();
    last_cell_ = forward_ = fill_pack<int32_t, 4>(0);
    for (int axis = 0; axis < 3; ++axis) {
      high[axis] = Real(kTile * (grid.n[axis] - 1));
      last_cell_[axis] = grid.n[axis] - 2;
      forward_[axis] = line.direction[axis] > Real(0);
    }
    const Pack<Real, 4> a = zero_pack<Real, 4>() - line.origin * inverse_, b = (high - line.origin) * inverse_;
    const Pack<Real, 4> first = smaller_pack<Real, 4>(a, b), last = larger_pack<Real, 4>(a, b);
    near = larger(larger(first[0], first[1]), larger(first[2], Real(0)));
    far = smaller(smaller(last[0], last[1]), last[2]);
  }

  // Looks at the cell at distance t, says in `leave` where the ray leaves it, or the empty neighbourhood it is the
  // middle of, and returns whether it is empty.
  SURFCAP_HD bool empty(Real t, Real& leave) const {
    using Index = Pack<int32_t, 4>;
    Index cell = convert_pack<int32_t, 4, Real>(line.origin + t * line.direction) >> 2;
    cell = smaller_pack<int32_t, 4>(larger_pack<int32_t, 4>(cell, fill_pack<int32_t, 4>(0)), last_cell_);
    const int32_t entry = table_[(cell[0] * stride_[0] + cell[1]) * stride_[1] + cell[2]];
    const bool is_empty = entry < kOutside;
    const int32_t reach = is_empty ? kOutside - entry - 1 : 0;  // cells around this one that are empty too
    const Index border = (cell + forward_ * (2 * reach + 1) - reach) * kTile;
    const Pack<Real, 4> at = (convert_pack<Real, 4, int32_t>(border) - line.origin) * inverse_;
    leave = smaller(smaller(at[0], at[1]), at[2]);
    return is_empty;
  }

  Line<Real> line;
  Real near, far;  // where the ray enters and leaves the table; near >= far: it misses

 private:
  const int32_t* table_;
  int32_t stride_[2];  // cells along y and z
  Pack<Real, 4> inverse_;
  Pack<int32_t, 4> last_cell_, forward_;  // forward: 1 where the ray runs up the axis
};

constexpr int32_t kUnknown = -1;  // instead of a number of ranges

// Hands out, front to back, the indices k of the samples worth taking: those in non-empty cells, found cell by cell, or
// those within the ray's integration ranges where these are known.
template <class Real> class Lattice {
 public:
  Lattice() = default;
  SURFCAP_HD Lattice(const Cells<Real>& cells, Real step, Real shift, const Real* ranges, int32_t range_count)
      : cells_(cells),
        ranges_(ranges),
        left_(range_count),
        step_(step),
        per_step_(Real(1) / step),
        offset_(Real(0.5) + shift) {
    const bool hit = cells.near < cells.far;
    k_ = hit ? larger(index_after(cells.near), 0) : 0;
    end_ = hit ? index_after(cells.far) : 0;
    known_until_ = k_;
  }

  // Positions u and distances t of the samples with indices k.
  SURFCAP_HD void place(const int32_t* k, Pack<Real, kLanes>& t, Pack<Real, kLanes> (&u)[3]) const {
    t = (convert_pack<Real, kLanes, int32_t>(load<int32_t, kLanes>(k)) + offset_) * step_;
    for (int axis = 0; axis < 3; ++axis) u[axis] = cells_.line.origin[axis] + t * cells_.line.direction[axis];
  }

  // Writes up to `capacity` indices; fewer mean that the ray is at its end.
  SURFCAP_HD int next(int32_t* k_out, int capacity) {
    int count = 0;
    while (count < capacity && k_ < end_) {
      if (k_ >= known_until_ && (left_ == kUnknown ? skip() : !next_range())) continue;
      const int until = smaller(known_until_, k_ + capacity - count);
      while (k_ < until) k_out[count++] = k_++;
    }
    return count;
  }

  // The same for one index; false: the ray is at its end.
  SURFCAP_HD bool next(int32_t& k) {
    while (k_ < end_) {
      if (k_ >= known_until_ && (left_ == kUnknown ? skip() : !next_range())) continue;
      k = k_++;
      return true;
    }
    return false;
  }

 private:
  // Smallest k with t_k >= t, held to a range that an int can count.
  SURFCAP_HD int index_after(Real t) const {
    const Real x = clamped(t * per_step_ - offset_, Real(-1), Real(1 << 30));
    const int k = int(x);
    return k + (Real(k) < x);
  }

  // In an empty cell jumps past it and returns true; in another notes how far it reaches and returns false.
  SURFCAP_HD bool skip() {
    Real leave;
    const bool empty = cells_.empty((Real(k_) + offset_) * step_, leave);
    known_until_ = smaller(larger(index_after(leave), k_ + 1), end_);
    if (empty) k_ = known_until_;
    return empty;
  }

  SURFCAP_HD bool next_range() {
    if (left_ == 0) {
      k_ = end_;
      return false;
    }
    --left_;
    k_ = larger(k_, index_after(ranges_[0]));
    known_until_ = smaller(index_after(ranges_[1]), end_);
    ranges_ += 2;
    return k_ < known_until_;
  }

  Cells<Real> cells_;
  const Real* ranges_;
  int32_t left_;
  Real step_, per_step_, offset_;
  int k_, end_, known_until_;
};

}  // namespace SURFCAP_ISA
}  // namespace surfcap
