// voxel_terms on CUDA: a thread to a voxel's part of 4 numbers, then, for the curvature, a block to a tile with its
// halo in shared memory. Memory rule: adds to each voxel's own record, without atomics.
#include "../drivers/voxel_terms.h"

#include "../core/voxels.h"
#include "sums.cuh"
#include "team.cuh"

namespace surfcap {
namespace {

constexpr int kCurvature = kVoxelTerms - 1;

template <int Degree, class Real, class Stored, class Sum>
__global__ void __launch_bounds__(kThreads)
    add_terms(const __grid_constant__ Field<Real, Stored> field, const int32_t* coordinates, VoxelTerms<Real> terms,
              double* rows, Sum* gradient) {
  using R = Record<Degree>;
  const int p = int(threadIdx.x % R::kParts);  // the same in every turn: a stride is whole records
  const PartCode<Real, Degree, Stored> code(field, p);
  double losses[kVoxelTerms] = {};
  for (int64_t i = first_item(); i < field.tiles * kTileVoxels * R::kParts; i += stride()) {
    const int64_t voxel = i / R::kParts, tile = voxel / kTileVoxels;
    TermSums<Degree, Real> sums(terms, p);
    sums.add(field, code, cell_of(field, coordinates + 3 * tile), terms, tile, int(voxel % kTileVoxels), gradient);
    sums.add_to_losses(losses);
  }
  sum_block(losses, rows + int64_t(blockIdx.x) * kVoxelTerms);
}

template <class Real, class Stored, class Sum>
__global__ void __launch_bounds__(kThreads)
    add_curvature(const __grid_constant__ Field<Real, Stored> field, const int32_t* coordinates, Real weight, Real eps,
                  double* rows, Sum* gradient) {
  __shared__ Real value[kHaloVoxels], bend[kHaloVoxels];
  const Known<Real, Stored> known(field);
  double loss[1] = {};
  for (int64_t tile = blockIdx.x; tile < field.tiles; tile += gridDim.x) {
    const int64_t cell = cell_of(field, coordinates + 3 * tile);
    for (int i = threadIdx.x; i < kHaloVoxels; i += kThreads)
      value[i] = halo_value(field, cell, i / (kHaloSide * kHaloSide), i / kHaloSide % kHaloSide, i % kHaloSide);
    __syncthreads();
    constexpr int kInner = kHaloSide - 2;  // the halo's outermost voxels have neighbours beyond it
    for (int i = threadIdx.x; i < kInner * kInner * kInner; i += kThreads) {
      const int x = i / (kInner * kInner) + 1, y = i / kInner % kInner + 1, z = i % kInner + 1;
      loss[0] += double(known.bend(value, (x * kHaloSide + y) * kHaloSide + z, eps, bend));
    }
    __syncthreads();
    for (int v = threadIdx.x; v < kTileVoxels; v += kThreads)
      add_to(gradient + (tile * kTileVoxels + v) * field.pitch,
             Real(kSumScale<Sum>) * weight * laplacian(bend + in_halo(v))[0]);
    __syncthreads();
  }
  sum_block(loss, rows + blockIdx.x);
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real, class Stored, class Sum>
  void voxel_terms(const Field<Real, Stored>& field, const int32_t* coordinates, const VoxelTerms<Real>& terms,
                   const Tensor& losses, Sum* gradient) const {
    if (field.tiles == 0) return;
    with_degree(field.pitch, [&](auto degree) {
      constexpr int kDegree = decltype(degree)::value;
      const int64_t count = blocks(field.tiles * kTileVoxels * Record<kDegree>::kParts);
      const BlockSums<kVoxelTerms> sums(*this, losses, count);
      launch("voxel_terms", add_terms<kDegree, Real, Stored, Sum>, count, kThreads, field, coordinates, terms,
             sums.rows(), gradient);
      sums.total(losses);
    });
    if (terms.curvature == Real(0)) return;
    const int64_t count = blocks(field.tiles, 1);
    const BlockSums<1> sums(*this, losses, count);
    launch("voxel_terms", add_curvature<Real, Stored, Sum>, count, kThreads, field, coordinates, terms.curvature,
           terms.bend, sums.rows(), gradient);
    Tensor all = losses;
    sums.total(torch::stable::narrow(all, 0, kCurvature, 1));
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) { m.impl("voxel_terms", TORCH_BOX(&voxel_terms<Cuda>)); }

}  // namespace surfcap
