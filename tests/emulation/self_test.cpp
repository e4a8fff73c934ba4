// The emulation of CUDA itself: what must work, and what must be reported rather than hang.
#undef NDEBUG
#include <cuda_runtime.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cassert>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>

namespace {

constexpr int kBlocks = 3, kBlock = 128, kTeam = 8, kBins = 7;

__device__ int sum_of_team(unsigned mask, int value) {
  for (int bits = kTeam / 2; bits > 0; bits /= 2) value += __shfl_xor_sync(mask, value, bits, kTeam);
  return value;
}

// Every team sums a number of rows of its own, so that the teams of a warp part.
__global__ void __launch_bounds__(kBlock) team_sums(int* __restrict__ sums) {
  const int thread = int(blockIdx.x * blockDim.x + threadIdx.x), team = thread / kTeam;
  const unsigned mask = 0xffu << (emulated_lane() & -kTeam);
  int sum = 0;
  for (int row = 0; row < team % 5 + 1; ++row) sum += sum_of_team(mask, thread + row);
  assert(__all_sync(mask, sum >= 0) && !__any_sync(mask, sum < 0));
  assert(__ballot_sync(mask, thread % 2) == (mask & 0xaaaaaaaau));
  assert(__shfl_sync(mask, double(thread), 3, kTeam) == team * kTeam + 3);
  if (thread % kTeam == 0) sums[team] = sum;
}

__global__ void block_sums(const float* x, float* sums, double* total) {
  float* const row = static_cast<float*>(emulated_shared_memory());
  __shared__ __align__(16) float first;
  const unsigned i = threadIdx.y * blockDim.x + threadIdx.x, threads = blockDim.x * blockDim.y;
  assert(row[i] != row[i]);
  row[i] = __ldg(x + blockIdx.x * threads + i);
  for (unsigned half = threads / 2; half >= warpSize; half /= 2) {
    __syncthreads();
    if (i < half) row[i] += row[i + half];
  }
  if (i < warpSize) {
    __syncwarp();
    float sum = row[i];
    for (int delta = warpSize / 2; delta > 0; delta /= 2) sum += __shfl_down_sync(~0u, sum, delta);
    if (i == 0) first = sum;
  }
  __syncthreads();
  if (i == threads - 1) sums[blockIdx.x] = first;
  if (i == 0) atomicAdd(total, double(first));
}

__global__ void histogram(int* bins, unsigned* most, unsigned* least, unsigned short* rounds, int* lock, int* locked) {
  const unsigned thread = blockIdx.x * blockDim.x + threadIdx.x;
  atomicAdd(bins + thread % kBins, 1);
  atomicMax(most, thread);
  atomicMin(least, thread);
  for (unsigned short old = *rounds, seen;; old = seen)
    if ((seen = atomicCAS(rounds, old, (unsigned short)(old + 1))) == old) break;
  while (atomicExch(lock, 1) != 0) {}
  const int count = *locked;
  __threadfence();
  *locked = count + 1;
  atomicExch(lock, 0);
}

// Lacks a barrier, which even one warp must show.
__global__ void no_barrier(int* wrong) {
  int* const row = static_cast<int*>(emulated_shared_memory());
  const int i = int(threadIdx.x), beside = (i + 1) % int(blockDim.x);
  row[i] = i;
  if (row[beside] != beside) atomicAdd(wrong, 1);
}

// A partial warp, and a block of more than one dimension.
__global__ void places(uint3* to) {
  const unsigned i = (threadIdx.z * blockDim.y + threadIdx.y) * blockDim.x + threadIdx.x;
  __syncwarp();
  to[i] = {threadIdx.x, threadIdx.y, threadIdx.z};
}

__global__ void lanes_finish() {
  if (threadIdx.x == 5) return;
  __shfl_sync(~0u, 1, 0);
}
__global__ void lanes_differ() {
  if (threadIdx.x % 2 != 0)
    __syncwarp();
  else
    __any_sync(~0u, 1);
}
__global__ void masks_differ() { __syncwarp(threadIdx.x == 0 ? 0xffu : ~0u); }
__global__ void barrier_missed() {
  if (threadIdx.x != 33) __syncthreads();
}
__global__ void reads_others() { __shfl_xor_sync(0xffu << (threadIdx.x & 24), 1, 8); }
__global__ void reads_beyond() { __shfl_sync(~0u, 1, 8, 8); }
__global__ void not_a_member() { __syncwarp(1); }
__global__ void waits_for_ever(int* flag) {
  while (atomicAdd(flag, 0) == 0) {}
}
__global__ void writes_beyond() { static_cast<char*>(emulated_shared_memory())[16] = 0; }

// Runs what must fail in a process of its own, and returns what that says. The alarm ends one that hangs.
template <class F> std::string message_of(const F& run) {
  int ends[2], status;
  assert(pipe(ends) == 0);
  const pid_t child = fork();
  assert(child >= 0);
  if (child == 0) {
    dup2(ends[1], STDERR_FILENO);
    alarm(20);
    run();
    _exit(0);
  }
  close(ends[1]);
  std::string message;
  char part[256];
  for (ssize_t n; (n = read(ends[0], part, sizeof(part))) > 0;) message.append(part, size_t(n));
  close(ends[0]);
  assert(waitpid(child, &status, 0) == child && WIFSIGNALED(status) && WTERMSIG(status) == SIGABRT);
  std::fputs(message.c_str(), stdout);
  return message;
}

template <class... P, class... A>
void expect(const char* part, const char* place, void (*kernel)(P...), A... arguments) {
  const std::string message = message_of([&] { emulated_launch(kernel, 2, 64, 16, arguments...); });
  assert(message.find("block (0, 0, 0)") != message.npos);
  assert(message.find(part) != message.npos && message.find(place) != message.npos);
}

void check_results() {
  constexpr int kThreads = kBlocks * kBlock;
  std::vector<int> team(kThreads / kTeam);
  emulated_launch(team_sums, kBlocks, kBlock, 0, team.data());
  for (int t = 0; t < int(team.size()); ++t) {
    int sum = 0;
    for (int row = 0; row < t % 5 + 1; ++row)
      for (int i = 0; i < kTeam; ++i) sum += t * kTeam + i + row;
    assert(team[t] == sum);
  }

  std::vector<float> x(kThreads), sums(kBlocks);
  double total = 0;
  for (int i = 0; i < kThreads; ++i) x[i] = float(i);
  emulated_launch(block_sums, kBlocks, dim3(kBlock / 4, 4), kBlock * sizeof(float), x.data(), sums.data(), &total);
  for (int b = 0; b < kBlocks; ++b) assert(sums[b] == kBlock * (b * kBlock + (kBlock - 1) / 2.0f));
  assert(total == kThreads * (kThreads - 1) / 2);

  int bins[kBins] = {}, lock = 0, locked = 0;
  unsigned most = 0, least = ~0u;
  unsigned short rounds = 0;
  emulated_launch(histogram, kBlocks, kBlock, 0, bins, &most, &least, &rounds, &lock, &locked);
  for (int b = 0; b < kBins; ++b) assert(bins[b] == (kThreads - b + kBins - 1) / kBins);
  assert(most == kThreads - 1 && least == 0 && rounds == kThreads && locked == kThreads);

  int wrong = 0;
  emulated_launch(no_barrier, 1, warpSize, warpSize * sizeof(int), &wrong);
  assert(wrong > 0);

  uint3 at[5 * 3 * 3] = {};
  emulated_launch(places, 1, dim3(5, 3, 3), 0, at);
  for (unsigned i = 0; i < 5 * 3 * 3; ++i) assert(at[i].x == i % 5 && at[i].y == i / 5 % 3 && at[i].z == i / 15);
}

// The order in which threads run, seen through an atomic.
std::vector<int> order(const char* seed) {
  setenv("SURFCAP_EMULATION_SEED", seed, 1);
  std::vector<int> to(kBlock);
  int count = 0;
  void (*const kernel)(int*, int*) = [](int* to, int* count) { to[atomicAdd(count, 1)] = int(threadIdx.x); };
  emulated_launch(kernel, 1, kBlock, 0, to.data(), &count);
  return to;
}

void check_host() {
  emulated_launch(lanes_finish, 0, 32, 0);
  assert(cudaGetLastError() == cudaErrorInvalidConfiguration && cudaGetLastError() == cudaSuccess);
  emulated_launch(lanes_finish, 1, dim3(512, 4), 0);
  assert(cudaGetLastError() == cudaErrorInvalidConfiguration);

  assert(__popc(0xf0u) == 4 && __ffs(8) == 4 && __ffs(0) == 0 && __clz(1) == 31 && __clz(0) == 32);
  assert(__uint_as_float(__float_as_uint(1.5f)) == 1.5f && __float_as_int(1.0f) == 0x3f800000);
}

}  // namespace

int main() {
  for (const char* seed : {"1", "2", "3"}) {
    setenv("SURFCAP_EMULATION_SEED", seed, 1);
    check_results();
  }
  std::thread(check_results).join();  // the fibers are those of all threads of the system
  assert(order("1") == order("1") && order("1") != order("2"));
  check_host();

  int flag = 0;
  expect("deadlock", "thread (5, 0, 0) in its end", lanes_finish);
  expect("deadlock", "thread (1, 0, 0) in __syncwarp", lanes_differ);
  expect("deadlock", "thread (1, 0, 0) in __syncwarp of lanes 0xffffffff", masks_differ);
  expect("deadlock", "thread (33, 0, 0) in its end", barrier_missed);
  expect("not among those", "__shfl_xor_sync", reads_others);
  expect("outside its group", "__shfl_sync", reads_beyond);
  expect("not among the lanes", "__syncwarp of lanes 0x00000001", not_a_member);
  expect("for ever", "an atomic", waits_for_ever, &flag);
  expect("beyond the dynamic shared memory", "", writes_beyond);
}
