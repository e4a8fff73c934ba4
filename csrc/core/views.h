// What the drivers hand to the mathematics: plain views of tensors and plain settings, so that they are the
// same types for every instruction set. Pointers are row-major and contiguous.
#pragma once

#include <cstdint>

// SURFCAP_CUDA: this is compiled for CUDA's threads, by nvcc or, in the tests, by a C++ compiler that emulates them.
#if defined(__CUDACC__) || defined(SURFCAP_CUDA_EMULATION)
#define SURFCAP_CUDA
#endif

namespace surfcap {

// A number of IEEE's 16-bit format.
struct Half {
  uint16_t bits;
};

// Where the voxels of a sparse field lie: 4x4x4 of them to a tile, a table of tile indices.
template <class Real> struct Grid {
  const int32_t* table;  // [n0, n1, n2], its outermost tiles outside
  int32_t n[3];
  Real origin[3];   // low corner of the table, world
  Real per_unit;    // voxels per world unit
  Real missing[2];  // opacity value where there is no tile: outside, inside
  int64_t tiles;
  int32_t pitch;  // 4, 16 or 32 for spherical harmonics of degree 0, 1 or 2
};

// The field: a record of `pitch` numbers per voxel, of the type that one computes with, or codes of 8 or 16 bits.
template <class Real, class Stored = Real> struct Field : Grid<Real> {
  const Stored* voxels;  // [tiles, 4, 4, 4, pitch]
};

// What Adam's moments are kept in beside values of a type.
template <class Stored> struct Moment {
  using type = Stored;
};
template <> struct Moment<uint16_t> {
  using type = Half;
};
template <class Stored> using MomentOf = typename Moment<Stored>::type;

template <class Real> struct Rays {
  const Real* origins;     // [R, 3] world
  const Real* directions;  // [R, 3] world, unit
  const Real* shift;       // [R] displacement of the lattice in steps
  const Real* background;  // [R, 3]
  int64_t count;
  const int64_t* range_offsets;  // [bundles + 1] or null: where each bundle's ranges begin
  const Real* ranges;            // [M, 2] or null: the stretches of the rays to sample
  int64_t bundle;                // consecutive rays that share a list of ranges
};

// Where what rays see is written.
template <class Real> struct Rendering {
  Real* color;          // [R, 3]
  Real* transmittance;  // [R]
  Real* depth;          // [R] sum of w t / sum of w, world units; NaN where a ray meets nothing
};

template <class Real> struct RaySettings {
  Real step;        // distance between samples, world units
  Real stop;        // the ray ends when its transmittance has fallen below this; 0: never
  Real slope;       // of the signed distance's logistic, per voxel
  int32_t opacity;  // 0: the value is a transparency, 1: a signed distance
};

template <class Real> struct Observation {
  const Real* target;  // [R, 3] the photograph
  const Real* mask;    // [R] 1 = subject
  const Real* weight;  // [R] of the ray in every loss
};

template <class Real> struct PhotometricSettings {
  Real huber;                // where Huber's norm turns linear
  Real photo, sample, mask;  // weights of the losses
  bool detach_sample;        // the weights w_k of the sample loss carry no gradient
  bool rendered_sample;      // the sample loss compares with the rendered colour instead of the photograph's
};

// Where the samples' gradients are kept: a row of slots per ray, each of four numbers (opacity, r, g, b).
template <class Real> struct SlotRows {
  const int64_t* starts;  // [R + 1] where each ray's row begins
  const int32_t* first;   // [R] the sample index k of its first slot
  Real scale;             // a slot holds this many times the gradient: a power of two
};

// The cameras whose rays the rows belong to.
template <class Real> struct SlotCameras {
  const Real* matrices;  // [V, 3, 3] K R: from the way to a point to its homogeneous pixel
  const Real* centers;   // [V, 3] world
  const Real* shift;     // [V] displacement of the lattice in steps
  const int64_t*
      windows;  // [V, 4] left, top, width, height: the pixels that have rays, and a border of some that have none
  const int64_t* offsets;  // [V] where each window's pixels begin
  const int32_t* rays;     // number of each pixel's ray, -1: none
  // Per block of 2^kReachBits pixels a side, or fewer at a window's end: the least and one more than the greatest k
  // that a row of these pixels, or of their neighbours to the right and below, has.
  const int32_t* reach;
  const int64_t* reach_offsets;  // [V] where each window's blocks begin
  int64_t views;
  Real step;  // distance between samples, world units
};

constexpr int kReachBits = 3;

// Blocks along a window's side of so many pixels.
constexpr int64_t blocks_along(int64_t size) { return size > 0 ? ((size - 1) >> kReachBits) + 1 : 0; }

template <class Real> struct VoxelTerms {
  Real tv_opacity, tv_color, parsimony, ballooning, curvature;  // weights
  Real huber, bend;  // where the parsimony's and the curvature's norm turn linear
};

template <class Real> struct AdamSettings {
  Real beta1, beta2, epsilon;
  Real correction1, correction2;  // 1/(1 - beta^t)
  const Real *rate, *low, *high;  // [pitch] per coefficient
  uint32_t key;                   // of the noise that rounds codes
  bool stochastic;                // whether codes are rounded by noise, or to the nearest
};

template <class Real> struct Silhouettes {
  const Real* projections;  // [V, 3, 4] world to pixels, pixel (0, 0) centred at (1/2, 1/2)
  const Real* masks;        // all masks end to end
  const int64_t* offsets;   // [V] where each begins
  const int64_t* sizes;     // [V, 2] width, height
  int64_t views;
};

}  // namespace surfcap
