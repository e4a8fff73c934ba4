// The samples of a ray: t_k = (k + 1/2 + shift) * step from its origin, those in empty cells left out.
#pragma once

#include <cmath>

#include "field.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// A ray in voxel-centre units: u(t) = origin + t * direction with t in world units.
template <class Real> struct Line {
  Real origin[3], direction[3];

  SURFCAP_HD Line(const Field<Real>& field, const Real* o, const Real* d) {
    for (int i = 0; i < 3; ++i) {
      origin[i] = (o[i] - field.origin[i]) * field.per_unit - Real(0.5);
      direction[i] = d[i] * field.per_unit;
    }
  }
  SURFCAP_HD Real at(int axis, Real t) const { return origin[axis] + t * direction[axis]; }
};

// Walks the lattice from front to back and hands out the indices k of the samples in non-empty cells.
template <class Real> class Lattice {
 public:
  SURFCAP_HD Lattice(const Field<Real>& field, const Line<Real>& line, Real step, Real shift)
      : field_(field), line_(line), step_(step), offset_(Real(0.5) + shift) {
    Real near = Real(0), far = Real(3.0e38);
    for (int axis = 0; axis < 3; ++axis) {
      inverse_[axis] = Real(1) / line.direction[axis];
      const Real high = Real(kTile * (field.n[axis] - 1));
      if (line.direction[axis] == Real(0)) {
        if (!(line.origin[axis] >= Real(0) && line.origin[axis] < high)) far = Real(-1);
        continue;
      }
      const Real a = -line.origin[axis] * inverse_[axis], b = (high - line.origin[axis]) * inverse_[axis];
      near = larger(near, smaller(a, b));
      far = smaller(far, larger(a, b));
    }
    k_ = near < far ? index_after(near) : 0;
    end_ = near < far ? index_after(far) : 0;
    k_ = k_ < 0 ? 0 : k_;
    known_until_ = k_;
  }

  SURFCAP_HD Real distance(int k) const { return (Real(k) + offset_) * step_; }

  // Writes up to `capacity` indices of samples in non-empty cells; fewer mean that the ray has left the table.
  SURFCAP_HD int next(int* k_out, int capacity) {
    int count = 0;
    while (count < capacity && k_ < end_) {
      if (k_ >= known_until_) {
        const int depth = look();
        if (depth > 0) continue;
      }
      const int until = known_until_ < k_ + capacity - count ? known_until_ : k_ + capacity - count;
      while (k_ < until) k_out[count++] = k_++;
    }
    return count;
  }

 private:
  // Smallest k with t_k >= t, held to a range that an int can count.
  SURFCAP_HD int index_after(Real t) const {
    return int(std::ceil(smaller(t / step_ - offset_, Real(1 << 30))));
  }

  // Reads the cell of sample k. In an empty cell jumps to the first sample beyond the empty neighbourhood and returns
  // its size, in a non-empty one notes how far the cell reaches and returns 0.
  SURFCAP_HD int look() {
    const Real t = distance(k_);
    int cell[3];
    for (int axis = 0; axis < 3; ++axis) {
      const int c = int(line_.at(axis, t)) >> 2;
      const int last = field_.n[axis] - 2;
      cell[axis] = c < 0 ? 0 : c > last ? last : c;
    }
    const int entry = field_.table[(cell[0] * field_.n[1] + cell[1]) * field_.n[2] + cell[2]];
    const int depth = entry < kOutside ? kOutside - entry : 0;
    const int reach = depth > 0 ? depth - 1 : 0;
    Real leave = Real(3.0e38);
    for (int axis = 0; axis < 3; ++axis) {
      const int border = line_.direction[axis] > 0 ? cell[axis] + reach + 1 : cell[axis] - reach;
      const Real t_border = (Real(kTile * border) - line_.origin[axis]) * inverse_[axis];
      leave = line_.direction[axis] == Real(0) ? leave : smaller(leave, t_border);
    }
    int next = index_after(leave);
    next = next > k_ ? next : k_ + 1;
    next = next < end_ ? next : end_;
    (depth > 0 ? k_ : known_until_) = next;
    if (depth > 0) known_until_ = k_;
    return depth;
  }

  const Field<Real>& field_;
  const Line<Real>& line_;
  Real inverse_[3];
  Real step_, offset_;
  int k_, end_, known_until_;
};

}  // namespace SURFCAP_ISA
}  // namespace surfcap
