// How CUDA's threads read the field: eight as a team, for a ray or a point.
//
// Each thread of a team locates one of the 8 corners. Then the records are read: one of 4, 16 or 32 numbers is a part
// of 4 for each of 1, 4 or 8 threads, so that a team reads 8, 2 or 1 corners at a time, and a warp's four teams whole
// lines of memory, whatever the degree. Sums over the threads with the same part, and over the parts, are butterflies.
//
// The rays of a batch stand in blocks of 8 x 8 pixels, so a block of threads, 32 teams, takes 8 x 4 neighbouring
// pixels.
#pragma once

#include "../core/choices.h"
#include "../core/rays.h"
#include "gpu.cuh"

#if defined(__CUDACC__)
#include <cuda_fp16.h>
#endif

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int kTeam = 8;
constexpr int kTeamsPerBlock = kThreads / kTeam;

struct Team {
  int lane;
  unsigned mask;  // of its threads within the warp

  __device__ __forceinline__ Team() : lane(threadIdx.x % kTeam), mask(0xffu << (threadIdx.x % 32 / kTeam * kTeam)) {}

  // What another thread of the team holds.
  template <class T> __device__ __forceinline__ T from(T x, int other) const {
    return __shfl_sync(mask, x, other, kTeam);
  }

  // Sums over the threads whose numbers differ in the bits of [first, last).
  template <class Real> __device__ __forceinline__ Pack<Real, 4> sum(Pack<Real, 4> x, int first, int last) const {
    for (int bit = first; bit < last; bit *= 2)
      for (int i = 0; i < 4; ++i) x[i] += __shfl_xor_sync(mask, x[i], bit, kTeam);
    return x;
  }

  // What the threads wrote before is seen by all of them after.
  __device__ __forceinline__ void sync() const { __syncwarp(mask); }
};

// The team's number, and how many there are.
__device__ __forceinline__ int64_t first_team() { return first_item() / kTeam; }
__device__ __forceinline__ int64_t team_stride() { return stride() / kTeam; }

__device__ __forceinline__ void add_atomically(Half* to, float x) {
  auto* const bits = reinterpret_cast<unsigned short*>(to);
  unsigned short before = *bits, found;
  while ((found = atomicCAS(bits, before, to_half(from_half({before}) + x).bits)) != before) before = found;
}
__device__ __forceinline__ void add_atomically(float* to, float x) { atomicAdd(to, x); }
__device__ __forceinline__ void add_atomically(double* to, double x) { atomicAdd(to, x); }

// Adds to four consecutive sums. Memory rule: adds, atomically. Halves are rounded before they are added, too.
template <class Real, class Sum> __device__ __forceinline__ void add_four(Sum* to, const Pack<Real, 4>& x) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  if constexpr (std::is_same_v<Sum, float>) {
    atomicAdd(reinterpret_cast<float4*>(to), make_float4(x[0], x[1], x[2], x[3]));
    return;
  }
#endif
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<Sum, Half>) {
    Pack<float, 4> held;
    for (int i = 0; i < 4; ++i) held[i] = clamped(x[i], -kMostHalf, kMostHalf);
    auto* const pairs = reinterpret_cast<__half2*>(to);
    atomicAdd(pairs, __floats2half2_rn(held[0], held[1]));
    atomicAdd(pairs + 1, __floats2half2_rn(held[2], held[3]));
    return;
  }
#endif
  for (int i = 0; i < 4; ++i) add_atomically(to + i, x[i]);
}

// The code of one part of the records, for a thread that has no other.
template <class Real, int Degree, class Stored> struct PartCode {
  using R = Record<Degree>;
  Pack<Real, 4> low, scale;
  Pack<Stored, 4> outside;  // what a missing tile holds there
  Stored inside;            // the same inside, where it differs: in the first number

  __device__ __forceinline__ PartCode(const Grid<Real>& grid, int part) {
    const Code<Real, Degree, Stored> code(grid);
#pragma unroll
    for (int p = 0; p < R::kParts; ++p) {  // a choice, so that `code` stays in registers
      if (p != part) continue;
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        low[i] = code.kNarrow ? code.low[4 * p + i] : Real(0);
        scale[i] = code.kNarrow ? code.scale[4 * p + i] : Real(1);
        outside[i] = code.missing[4 * p + i];
      }
    }
    inside = part == 0 ? code.missing[R::kPitch] : outside[0];
  }

  // Of this part, or of a mean of them.
  __device__ __forceinline__ Pack<Real, 4> decode(const Pack<Real, 4>& codes, int) const {
    if constexpr (Code<Real, Degree, Stored>::kNarrow)
      return low + codes * scale;
    else
      return codes;
  }
};

// A field as one thread of a team reads it.
template <class Real, int Degree, class Stored> class TeamField {
 public:
  static constexpr int kPitch = Record<Degree>::kPitch, kParts = Record<Degree>::kParts;
  static constexpr int kAtOnce = kTeam / kParts;  // corners
  using Part = Pack<Real, 4>;

  // This thread's corner.
  struct Corner {
    int32_t voxel;  // negative where there is no tile
    Real weight;
  };
  // Its parts of the 8 records, as they are stored.
  struct Fetched {
    Pack<Stored, 4> record[kParts];
    Real weight[kParts];
  };

  __device__ __forceinline__ explicit TeamField(const Field<Real, Stored>& field)
      : field_(field), part_(team.lane % kParts), code_(field, part_) {}

  __device__ __forceinline__ Corner locate(const Pack<Real, 1> (&u)[3]) const {
    const Corners<Real> corners(field_, u);
    Pack<int32_t, 1> entry;
    const int32_t voxel = corners.voxel(field_, team.lane, entry)[0];
    return {voxel, corners.share(team.lane)[0]};
  }
  // The same at a point in the world.
  __device__ __forceinline__ Corner locate(const Real* point) const {
    Pack<Real, 1> u[3];
    for (int axis = 0; axis < 3; ++axis)
      u[axis][0] = in_voxels(static_cast<const Grid<Real>&>(field_), axis, point[axis]);
    return locate(u);
  }

  __device__ __forceinline__ Fetched fetch(const Corner& corner) const {
    Fetched found;
    for (int n = 0; n < kParts; ++n) {
      const Corner c = of(corner, n);
      found.weight[n] = c.weight;
      found.record[n] = code_.outside;
      if (c.voxel == kInside) found.record[n][0] = code_.inside;
      if (c.voxel >= 0)
        found.record[n] = load_aligned<Stored, 4>(field_.voxels + int64_t(c.voxel) * kPitch + 4 * part_);
    }
    return found;
  }

  // The trilinear read: this thread's part of the record.
  __device__ __forceinline__ Part read(const Fetched& found) const {
    Part sum = zero_pack<Real, 4>();
    for (int n = 0; n < kParts; ++n) sum += found.weight[n] * convert_pack<Real, 4, Stored>(found.record[n]);
    return code_.decode(team.sum<Real>(sum, kParts, kTeam), part_);
  }

  // This thread's part of the basis in a direction, and (opacity, r, g, b) with it, the same in all threads.
  __device__ __forceinline__ Part weights(const Real* direction) const {
    const Coefficients<Real, Degree> all = basis_weights<Real, Degree>(direction);
    Part mine = all.part[0];
    for (int p = 1; p < kParts; ++p)
      if (p == part_) mine = all.part[p];
    return mine;
  }
  __device__ __forceinline__ Part color(const Fetched& found, const Part& weights) const {
    return team.sum<Real>(fold_part<Real>(read(found) * weights, part_), 1, kParts);
  }

  // The adjoint of read: adds `part`, this thread's part of a gradient, to the records of the 8 corners.
  template <class Sum>
  __device__ __forceinline__ void scatter(Sum* gradient, const Corner& corner, const Part& part) const {
    const Part g = Real(kSumScale<Sum>) * part;
    Corner all[kParts];  // a branch between the shuffles would make the team meet anew for each
    for (int n = 0; n < kParts; ++n) all[n] = of(corner, n);
    for (int n = 0; n < kParts; ++n)
      if (all[n].voxel >= 0) add_four<Real>(gradient + int64_t(all[n].voxel) * kPitch + 4 * part_, all[n].weight * g);
  }
  // The same for a gradient by (opacity, r, g, b).
  template <class Sum>
  __device__ __forceinline__ void scatter(Sum* gradient, const Corner& corner, const Part& by_color,
                                          const Part& weights) const {
    scatter(gradient, corner, weights * unfold_part<Real>(by_color, part_));
  }

  __device__ __forceinline__ int part() const { return part_; }
  // Whether this thread is the first of those with its part.
  __device__ __forceinline__ bool leads() const { return team.lane < kParts; }

  Team team;

 private:
  // The corner whose record this thread reads in the n-th round.
  __device__ __forceinline__ Corner of(const Corner& own, int n) const {
    if constexpr (kParts == 1) return own;
    const int c = n * kAtOnce + team.lane / kParts;
    return {team.from(own.voxel, c), team.from(own.weight, c)};
  }

  const Field<Real, Stored>& field_;
  int part_;
  PartCode<Real, Degree, Stored> code_;
};

}  // namespace SURFCAP_ISA
}  // namespace surfcap
