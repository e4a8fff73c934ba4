// Sums over all threads, always in the same order: within a block as a tree, then over the blocks.
#pragma once

#include "gpu.cuh"

namespace surfcap {

// Writes to row [N] what a block's kThreads threads hold in x. All of them must come here.
template <int N> __device__ void sum_block(const double (&x)[N], double* row) {
  __shared__ double held[kThreads];
  for (int n = 0; n < N; ++n) {
    held[threadIdx.x] = x[n];
    __syncthreads();
    for (int half = kThreads / 2; half > 0; half /= 2) {
      if (int(threadIdx.x) < half) held[threadIdx.x] += held[threadIdx.x + half];
      __syncthreads();
    }
    if (threadIdx.x == 0) row[n] = held[0];
    __syncthreads();
  }
}

// total [N] = sum over rows [count, N]; one block.
template <int N>
__global__ void __launch_bounds__(kThreads) sum_rows(const double* rows, int64_t count, double* total) {
  double x[N] = {};
  for (int64_t i = threadIdx.x; i < count; i += kThreads)
    for (int n = 0; n < N; ++n) x[n] += rows[i * N + n];
  sum_block(x, total);
}

// A row of N sums for each block of a kernel, and their total.
template <int N> class BlockSums {
 public:
  BlockSums(const Gpu& gpu, const Tensor& like, int64_t blocks)
      : gpu_(gpu), blocks_(blocks), rows_(torch::stable::new_empty(like, {blocks, N}, ScalarType::Double)) {}
  double* rows() const { return rows_.template mutable_data_ptr<double>(); }
  void total(const Tensor& to) const {
    gpu_.launch("sum_rows", sum_rows<N>, 1, kThreads, rows(), blocks_, to.template mutable_data_ptr<double>());
  }

 private:
  const Gpu& gpu_;
  int64_t blocks_;
  Tensor rows_;
};

}  // namespace surfcap
