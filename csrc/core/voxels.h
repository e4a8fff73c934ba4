// The terms of the loss that one tile has by itself.
#pragma once

#include "curvature.h"
#include "rays.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// Voxel terms of one tile, and their gradient added to the tile's own voxels:
//   total variation  sum over unordered pairs of 6-neighbours (x_i - x_j)^2   (each voxel takes its own side of a pair)
//   parsimony (eq. 11)  sum of Huber(b_lm), l > 0          ballooning (eq. 12)  sum of the opacity value squared
//   curvature of the opacity value, see there; left out where its weight is 0
// A missing neighbour counts with its boundary value for the opacity and not at all for colour: black would bleed in.
// Losses: tv opacity, tv colour, parsimony, ballooning, curvature, unweighted.
// Here for part p of the record of voxel v, whose tile stands at `cell` of the table. Memory rule: adds to its own
// record.
template <int Degree, class Real> struct TermSums {
  using R = Record<Degree>;
  using P = Pack<Real, R::kPart>;
  int p;
  P tv, is_color, is_view;  // weight of the total variation; 1 for coefficients, 1 for those with l > 0
  P squares;                // a pair of two stored voxels is met from both
  Real parsimony, ballooning, boundary;

  SURFCAP_HD TermSums(const VoxelTerms<Real>& terms, int part)
      : p(part), squares(zero_pack<Real, R::kPart>()), parsimony(Real(0)), ballooning(Real(0)), boundary(Real(0)) {
    Real weights[R::kPart], color[R::kPart], view[R::kPart];
    for (int j = 0; j < R::kPart; ++j) {
      const int i = p * R::kPart + j;
      color[j] = i > 0 && i < R::kCoefficients ? Real(1) : Real(0);
      view[j] = i > 3 && i < R::kCoefficients ? Real(1) : Real(0);
      weights[j] = i == 0 ? terms.tv_opacity : color[j] * terms.tv_color;
    }
    tv = load<Real, R::kPart>(weights);
    is_color = load<Real, R::kPart>(color);
    is_view = load<Real, R::kPart>(view);
  }

  template <class Stored, class Coding, class Sum>
  SURFCAP_HD void add(const Field<Real, Stored>& field, const Coding& code, int64_t cell, const VoxelTerms<Real>& terms,
                      int64_t tile, int v, Sum* gradient) {
    const int32_t stride[3] = {field.n[1] * field.n[2], field.n[2], 1};
    const int32_t inner[3] = {kTile * kTile, kTile, 1};
    const auto read = [&](int64_t voxel) {
      return code.decode(load_as<Real, R::kPart>(field.voxels + voxel * R::kPitch + p * R::kPart), p);
    };
    const int64_t voxel = tile * kTileVoxels + v;
    const P record = read(voxel);
    const Real value = record[0];  // the opacity's, in part 0
    const int place[3] = {v / inner[0], (v / inner[1]) & 3, v & 3};
    P sum = zero_pack<Real, R::kPart>();
    Real to_boundary = Real(0);
    for (int axis = 0; axis < 3; ++axis) {
      for (int side = 0; side < 2; ++side) {
        const bool within = side ? place[axis] < kTile - 1 : place[axis] > 0;
        const int32_t other = within ? int32_t(tile) : field.table[cell + (side ? 1 : -1) * stride[axis]];
        if (other < 0) {
          const Real d = value - field.missing[other == kInside];
          to_boundary += d;
          boundary += d * d;
          continue;
        }
        const int step = (side ? 1 : -1) * inner[axis];
        const P d = record - read(int64_t(other) * kTileVoxels + (within ? v + step : v - (kTile - 1) * step));
        sum += d;
        squares += d * d;
      }
    }
    P g = (Real(2) * tv) * sum;  // pairs of stored voxels are met from both sides, so each side takes half
    if constexpr (Degree > 0) {
      for (int j = 0; j < R::kPart; ++j) {
        Real derivative;
        parsimony += is_view[j] * huber(record[j], terms.huber, derivative);
        g[j] += terms.parsimony * is_view[j] * derivative;
      }
    }
    if (p == 0) {
      g[0] += Real(2) * (terms.tv_opacity * to_boundary + terms.ballooning * value);
      ballooning += value * value;
    }
    add_to<Real, R::kPart>(gradient + voxel * R::kPitch + p * R::kPart, Real(kSumScale<Sum>) * g);
  }

  // Adds the part's terms to `losses`.
  SURFCAP_HD void add_to_losses(double* losses) const {
    Real tv_color = Real(0);
    for (int j = 0; j < R::kPart; ++j) tv_color += is_color[j] * squares[j];
    if (p == 0) losses[0] += double(Real(0.5) * squares[0] + boundary);
    losses[1] += double(Real(0.5) * tv_color);
    losses[2] += double(parsimony);
    losses[3] += double(ballooning);
  }
};

// Where a tile stands in the table.
template <class Real> SURFCAP_HD int64_t cell_of(const Grid<Real>& grid, const int32_t* coordinate) {
  return (int64_t(coordinate[0]) * grid.n[1] + coordinate[1]) * grid.n[2] + coordinate[2];
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
