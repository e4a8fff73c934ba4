// CUDA's execution model on a machine without a GPU, as far as our kernels use it: a .cu file compiled as plain C++
// with this folder among its include paths, and linked with emulation.cpp, runs its kernels on the CPU. Every thread
// of a block is a fiber, and the next one to run is drawn at random, so that what relies on warps in lockstep, or on
// an order of threads, gives wrong results here too. What is undefined on the GPU, or hangs there, aborts with a
// message. Blocks run one after the other. It is there to prove kernels right; of their speed it says nothing. With
// -fsanitize=address --param asan-stack=0 it finds what lies outside of arrays, too.
#pragma once

#include <bit>
#include <concepts>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <tuple>
#include <type_traits>
#include <utility>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __grid_constant__
#define __align__(n) __attribute__((aligned(n)))  // alignas would have to stand before __shared__
#define __shared__ static  // one block at a time, and all its threads in one thread of the system

struct uint3 {
  unsigned x, y, z;
};

struct dim3 {
  unsigned x, y, z;
  constexpr dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};

struct EmulatedPlace {
  uint3 thread, block;
  dim3 block_size, grid_size;
};
extern EmulatedPlace emulated_place;  // of the thread that runs
inline const uint3 &threadIdx = emulated_place.thread, &blockIdx = emulated_place.block;
inline const dim3 &blockDim = emulated_place.block_size, &gridDim = emulated_place.grid_size;
constexpr int warpSize = 32;

// Where a thread gives way to others.
enum class EmulatedStop { Atomic, SyncThreads, SyncWarp, Shuffle, ShuffleXor, ShuffleDown, Ballot, Any, All, Finished };

void emulated_blocks(dim3 grid, dim3 block, size_t shared_bytes, void (*thread)(void*), void* arguments);
uint64_t emulated_collective(EmulatedStop stop, unsigned mask, uint64_t value, int source, int width);
void emulated_yield();  // now and then, to another thread
void* emulated_shared_memory();

// kernel<<<grid, block, shared_bytes>>>(arguments...), done when it returns. SURFCAP_EMULATION_SEED seeds the order of
// threads, of each launch anew. Like the runtime it leaves a launch that is too large to cudaGetLastError.
template <class... P, class... A>
void emulated_launch(void (*kernel)(P...), dim3 grid, dim3 block, size_t shared_bytes, A&&... arguments) {
  static_assert(!(std::is_reference_v<P> || ...), "a kernel takes its arguments by value");
  std::tuple<P...> copies(std::forward<A>(arguments)...);
  auto thread = [&] { std::apply(kernel, std::as_const(copies)); };
  emulated_blocks(grid, block, shared_bytes, [](void* of) { (*static_cast<decltype(thread)*>(of))(); }, &thread);
}

// Collectives wait for every thread of the block or lane of the mask, finished ones too, which the GPU lets off. Lanes
// that the block's last warp does not have are let off here as well.
void __syncthreads();

inline int emulated_lane() {
  return int(((threadIdx.z * blockDim.y + threadIdx.y) * blockDim.x + threadIdx.x) % warpSize);
}
inline uint64_t emulated_vote(EmulatedStop stop, unsigned mask, bool vote) {
  return emulated_collective(stop, mask, vote, emulated_lane(), warpSize);
}
inline void __syncwarp(unsigned mask = ~0u) { emulated_vote(EmulatedStop::SyncWarp, mask, false); }
inline unsigned __ballot_sync(unsigned mask, int vote) { return emulated_vote(EmulatedStop::Ballot, mask, vote != 0); }
inline int __any_sync(unsigned mask, int vote) { return emulated_vote(EmulatedStop::Any, mask, vote != 0) != 0; }
inline int __all_sync(unsigned mask, int vote) { return emulated_vote(EmulatedStop::All, mask, vote == 0) == 0; }

template <class T> T emulated_shuffle(EmulatedStop stop, unsigned mask, T value, int source, int width) {
  static_assert(std::is_arithmetic_v<T> && sizeof(T) >= 4 && sizeof(T) <= 8);
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof(T));
  bits = emulated_collective(stop, mask, bits, source, width);
  std::memcpy(&value, &bits, sizeof(T));
  return value;
}
// On the GPU a lane beyond the group is another one of the group; here it is an error, except where shuffles down run
// over the end, as the last lanes of every reduction do: they get their own value back.
template <class T> T __shfl_sync(unsigned mask, T value, int lane, int width = warpSize) {
  const int first = emulated_lane() & -width;
  return emulated_shuffle(EmulatedStop::Shuffle, mask, value, lane < 0 ? lane : first + lane, width);
}
template <class T> T __shfl_xor_sync(unsigned mask, T value, int bits, int width = warpSize) {
  return emulated_shuffle(EmulatedStop::ShuffleXor, mask, value, emulated_lane() ^ bits, width);
}
template <class T> T __shfl_down_sync(unsigned mask, T value, unsigned delta, int width = warpSize) {
  const int lane = emulated_lane();
  const bool inside = delta < unsigned(width - (lane & (width - 1)));
  return emulated_shuffle(EmulatedStop::ShuffleDown, mask, value, inside ? lane + int(delta) : lane, width);
}

// Atomics, for the types that CUDA has them for: uint64_t is not among them.
template <class T, class... Types>
concept EmulatedOneOf = (std::same_as<T, Types> || ...);
template <class T> using EmulatedValue = std::type_identity_t<T>;  // converted to what the pointer points to

template <class T, class F> T emulated_update(T* at, const F& updated) {
  emulated_yield();
  const T old = *at;
  *at = updated(old);
  return old;
}
template <EmulatedOneOf<float, double, int, unsigned, unsigned long long> T>
T atomicAdd(T* at, EmulatedValue<T> value) {
  return emulated_update(at, [=](T old) { return T(old + value); });
}
template <EmulatedOneOf<int, unsigned, unsigned long long> T> T atomicMax(T* at, EmulatedValue<T> value) {
  return emulated_update(at, [=](T old) { return old < value ? value : old; });
}
template <EmulatedOneOf<int, unsigned, unsigned long long> T> T atomicMin(T* at, EmulatedValue<T> value) {
  return emulated_update(at, [=](T old) { return value < old ? value : old; });
}
template <EmulatedOneOf<unsigned short, int, unsigned, unsigned long long> T>
T atomicCAS(T* at, EmulatedValue<T> expected, EmulatedValue<T> value) {
  return emulated_update(at, [=](T old) { return old == expected ? value : old; });
}
template <EmulatedOneOf<float, int, unsigned, unsigned long long> T> T atomicExch(T* at, EmulatedValue<T> value) {
  return emulated_update(at, [=](T) { return value; });
}
inline void __threadfence() { emulated_yield(); }  // stands in loops that wait for others

template <class T> T __ldg(const T* at) { return *at; }
inline int __float_as_int(float x) { return std::bit_cast<int>(x); }
inline float __int_as_float(int x) { return std::bit_cast<float>(x); }
inline unsigned __float_as_uint(float x) { return std::bit_cast<unsigned>(x); }
inline float __uint_as_float(unsigned x) { return std::bit_cast<float>(x); }
inline long long __double_as_longlong(double x) { return std::bit_cast<long long>(x); }
inline double __longlong_as_double(long long x) { return std::bit_cast<double>(x); }
inline int __popc(unsigned x) { return std::popcount(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __clz(int x) { return std::countl_zero(unsigned(x)); }

// The runtime. Everything is done in order, at once.
using cudaStream_t = struct CUstream_st*;
enum cudaError_t { cudaSuccess = 0, cudaErrorInvalidValue = 1, cudaErrorInvalidConfiguration = 9 };
enum cudaMemcpyKind { cudaMemcpyHostToDevice = 1, cudaMemcpyDeviceToHost, cudaMemcpyDeviceToDevice };
enum cudaDeviceAttr { cudaDevAttrMultiProcessorCount = 16 };

cudaError_t cudaGetLastError();
const char* cudaGetErrorString(cudaError_t error);

inline cudaError_t cudaMemsetAsync(void* to, int value, size_t bytes, cudaStream_t = nullptr) {
  if (bytes > 0) std::memset(to, value, bytes);
  return cudaSuccess;
}
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, size_t bytes, cudaMemcpyKind, cudaStream_t = nullptr) {
  if (bytes > 0) std::memcpy(to, from, bytes);
  return cudaSuccess;
}
inline cudaError_t cudaStreamSynchronize(cudaStream_t) { return cudaSuccess; }
inline cudaError_t cudaGetDevice(int* device) { return *device = 0, cudaSuccess; }
inline cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr, int) { return *value = 2, cudaSuccess; }
template <class Kernel> cudaError_t cudaOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, Kernel, int, size_t) {
  return *blocks = 2, cudaSuccess;
}
