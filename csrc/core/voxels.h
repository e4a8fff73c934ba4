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
// losses: tv opacity, tv colour, parsimony, ballooning, curvature, unweighted.
template <int Degree, class Real, class Stored, class Sum>
SURFCAP_HD void voxel_terms_tile(const Field<Real, Stored>& field, const Code<Real, Degree, Stored>& code,
                                 const int32_t* coordinate, const VoxelTerms<Real>& terms, int64_t tile, double* losses,
                                 Sum* gradient) {
  using R = Record<Degree>;
  using P = Pack<Real, R::kPart>;
  const int32_t stride[3] = {field.n[1] * field.n[2], field.n[2], 1};
  const int32_t inner[3] = {kTile * kTile, kTile, 1};
  const int64_t cell = int64_t(coordinate[0]) * stride[0] + int64_t(coordinate[1]) * stride[1] + coordinate[2];
  int32_t neighbour[3][2];
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) neighbour[axis][side] = field.table[cell + (side ? 1 : -1) * stride[axis]];

  // Weights in the order of the record. Pairs of stored voxels are met from both sides, so each side takes half.
  Real tv_row[R::kPitch], is_color[R::kPitch], parsimony_row[R::kPitch];
  for (int i = 0; i < R::kPitch; ++i) {
    is_color[i] = i > 0 && i < R::kCoefficients ? Real(1) : Real(0);
    tv_row[i] = i == 0 ? terms.tv_opacity : is_color[i] * terms.tv_color;
    parsimony_row[i] = i > 3 && i < R::kCoefficients ? Real(1) : Real(0);
  }
  const auto read = [&](int64_t voxel, int p) {
    return code.decode(load_as<Real, R::kPart>(field.voxels + voxel * R::kPitch + p * R::kPart), p);
  };
  P squares[R::kParts];  // over the pairs met; a pair of two stored voxels is met from both
  for (int p = 0; p < R::kParts; ++p) squares[p] = zero_pack<Real, R::kPart>();
  Real parsimony = Real(0), ballooning = Real(0), boundary = Real(0);

  for (int v = 0; v < kTileVoxels; ++v) {
    const int64_t voxel = tile * kTileVoxels + v;
    P record[R::kParts];
    for (int p = 0; p < R::kParts; ++p) record[p] = read(voxel, p);
    const Real value = record[0][0];
    const int place[3] = {v / inner[0], (v / inner[1]) & 3, v & 3};
    P sum[R::kParts];
    for (int p = 0; p < R::kParts; ++p) sum[p] = zero_pack<Real, R::kPart>();
    Real to_boundary = Real(0);
    for (int axis = 0; axis < 3; ++axis) {
      for (int side = 0; side < 2; ++side) {
        const bool within = side ? place[axis] < kTile - 1 : place[axis] > 0;
        const int32_t other = within ? int32_t(tile) : neighbour[axis][side];
        if (other < 0) {
          const Real d = value - field.missing[other == kInside];
          to_boundary += d;
          boundary += d * d;
          continue;
        }
        const int step = (side ? 1 : -1) * inner[axis];
        const int64_t at = int64_t(other) * kTileVoxels + (within ? v + step : v - (kTile - 1) * step);
        for (int p = 0; p < R::kParts; ++p) {
          const P d = record[p] - read(at, p);
          sum[p] += d;
          squares[p] += d * d;
        }
      }
    }
    Sum* const to = gradient + voxel * R::kPitch;
    for (int p = 0; p < R::kParts; ++p) {
      P g = (Real(2) * load<Real, R::kPart>(tv_row + p * R::kPart)) * sum[p];
      if constexpr (Degree > 0) {
        for (int i = 0; i < R::kPart; ++i) {
          Real derivative;
          const Real norm = huber(record[p][i], terms.huber, derivative);
          parsimony += parsimony_row[p * R::kPart + i] * norm;
          g[i] += terms.parsimony * parsimony_row[p * R::kPart + i] * derivative;
        }
      }
      if (p == 0) g[0] += Real(2) * (terms.tv_opacity * to_boundary + terms.ballooning * value);
      add_to<Real, R::kPart>(to + p * R::kPart, Real(kSumScale<Sum>) * g);
    }
    ballooning += value * value;
  }
  Real tv_color = Real(0);
  for (int p = 0; p < R::kParts; ++p)
    for (int i = 0; i < R::kPart; ++i) tv_color += is_color[p * R::kPart + i] * squares[p][i];
  losses[0] += double(Real(0.5) * squares[0][0] + boundary);
  losses[1] += double(Real(0.5) * tv_color);
  losses[2] += double(parsimony);
  losses[3] += double(ballooning);
  if (terms.curvature != Real(0))
    losses[4] += double(curvature_tile(field, cell, tile, terms.curvature, terms.bend, gradient));
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
