// The device that the drivers run on where their tensors are on a GPU, and how kernels are launched there.
//
// Nothing here waits for the GPU but `fetch`; every kernel runs in the current stream of the tensors' device.
#pragma once

#include <cuda_runtime.h>

#include <optional>

#include "../arguments.h"
#include "../core/pack.h"

#if defined(SURFCAP_CUDA_EMULATION)
#define SURFCAP_GPU CPU  // the dispatch key: emulated threads work on the host's tensors
#else
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#define SURFCAP_GPU CUDA
#endif

namespace surfcap {

constexpr int kThreads = 256;       // of a block
constexpr int kBlocksPerCore = 16;  // multiprocessor: a grid this large leaves none idle

inline void check_cuda(cudaError_t error, const char* what) {
  STD_TORCH_CHECK(error == cudaSuccess, what, ": CUDA reports ", cudaGetErrorString(error));
}

class Gpu {
 public:
  // Makes the first tensor's device current until destruction. All must be on it.
  Gpu(const char* names, std::initializer_list<Tensor> tensors) {
    const Tensor& first = *tensors.begin();
    std::string rest = names;
    const std::string leader = next_name(rest);
    for (const Tensor* t = &first + 1; t != tensors.end(); ++t) {
      const std::string name = next_name(rest);
      STD_TORCH_CHECK(t->is_cuda() == first.is_cuda() && t->get_device_index() == first.get_device_index(), name,
                      ": expected on the same device as ", leader);
    }
#if !defined(SURFCAP_CUDA_EMULATION)
    guard_.emplace(first.get_device_index());
    void* stream = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(first.get_device_index(), &stream));
    stream_ = static_cast<cudaStream_t>(stream);
#endif
    int device = 0;
    check_cuda(cudaGetDevice(&device), "device");
    check_cuda(cudaDeviceGetAttribute(&cores_, cudaDevAttrMultiProcessorCount, device), "device");
  }

  // Runs a kernel; its name is said where the launch fails.
  template <class... P, class... A>
  void launch(const char* name, void (*kernel)(P...), int64_t blocks, int threads, const A&... arguments) const {
    if (blocks == 0) return;
#if defined(SURFCAP_CUDA_EMULATION)
    emulated_launch(kernel, dim3(unsigned(blocks)), dim3(unsigned(threads)), 0, arguments...);
#else
    kernel<<<unsigned(blocks), unsigned(threads), 0, stream_>>>(arguments...);
#endif
    check_cuda(cudaGetLastError(), name);
  }

  // Blocks for `count` items, `each` to a block, that go round where there are more than fill the device.
  int64_t blocks(int64_t count, int64_t each = kThreads) const {
    return std::min((count + each - 1) / each, int64_t(cores_) * kBlocksPerCore);
  }

  // Blocks of a kernel that the device holds at a time.
  template <class... P> int64_t resident(void (*kernel)(P...)) const {
    int per_core = 0;
    check_cuda(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&per_core, kernel, kThreads, 0), "occupancy");
    return int64_t(std::max(per_core, 1)) * cores_;
  }

  template <class Number> void clear(Number* data, int64_t count) const {
    if (count > 0) check_cuda(cudaMemsetAsync(data, 0, count * sizeof(Number), stream_), "clear");
  }

  // A number from the device; waits for everything before it.
  template <class Number> Number fetch(const Number* from) const {
    Number value;
    check_cuda(cudaMemcpyAsync(&value, from, sizeof(Number), cudaMemcpyDeviceToHost, stream_), "fetch");
    check_cuda(cudaStreamSynchronize(stream_), "fetch");
    return value;
  }

 private:
  // Cuts the first of "a, b, c" off.
  static std::string next_name(std::string& names) {
    const size_t end = std::min(names.find(", "), names.size());
    const std::string name = names.substr(0, end);
    names.erase(0, end + 2);
    return name;
  }

#if !defined(SURFCAP_CUDA_EMULATION)
  std::optional<torch::stable::accelerator::DeviceGuard> guard_;
#endif
  cudaStream_t stream_ = nullptr;
  int cores_ = 0;
};

// The item that a thread begins with, and how far it is to its next one.
__device__ __forceinline__ int64_t first_item() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ __forceinline__ int64_t stride() { return int64_t(gridDim.x) * blockDim.x; }

}  // namespace surfcap
