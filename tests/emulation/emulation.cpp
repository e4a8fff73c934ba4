// The scheduler of the emulated threads: see cuda_runtime.h.
#undef _FORTIFY_SOURCE  // its longjmp takes a jump to another stack for an error
#include <setjmp.h>
#include <sys/mman.h>
#include <ucontext.h>
#include <unistd.h>
#include "cuda_runtime.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <mutex>

EmulatedPlace emulated_place;

namespace {

constexpr unsigned kMostThreads = 1024;
constexpr size_t kStack = 64 << 10, kMostShared = 48 << 10, kFence = 64;
constexpr unsigned char kUnwritten = 0xff;  // floats of it are no numbers
constexpr int kOneInYields = 8, kMostYields = 1 << 24;
const char* const kStops[] = {"an atomic",        "__syncthreads", "__syncwarp", "__shfl_sync", "__shfl_xor_sync",
                              "__shfl_down_sync", "__ballot_sync", "__any_sync", "__all_sync",  "its end"};

struct Fiber {
  jmp_buf registers;
  bool has_stack = false;
  int index;
  uint3 thread;
  EmulatedStop stop;  // the last one, by the lanes of `mask`
  unsigned mask;
  bool waits;      // for others, at `stop`
  uint64_t value;  // given to a collective, and then its result
  int source;
};

Fiber fibers[kMostThreads], host;
Fiber* running = &host;
Fiber* ready[kMostThreads];
int ready_count;
int threads, finished, arrived;  // in the block, at their end, at __syncthreads
int yields;                      // since a thread last got anywhere
void (*run_thread)(void*);
void* run_arguments;
alignas(128) unsigned char shared[kMostShared + kFence];
unsigned long long seed, random_state;
cudaError_t last_error = cudaSuccess;

int random_below(int n) {
  random_state ^= random_state << 13;
  random_state ^= random_state >> 7;
  random_state ^= random_state << 17;
  return int((random_state >> 32) * uint64_t(n) >> 32);
}

// Says what is wrong and where the threads from..to are, the first of those at the same place and how many they are.
[[noreturn]] void fail(const char* what, int from, int to) {
  const uint3& block = emulated_place.block;
  std::fprintf(stderr, "CUDA emulation, seed %llu, block (%u, %u, %u): %s\n", seed, block.x, block.y, block.z, what);
  const Fiber *const first = fibers + from, *const end = fibers + to;
  for (const Fiber* fiber = first; fiber != end; ++fiber) {
    const auto beside = [&](const Fiber& other) { return fiber->stop == other.stop && fiber->mask == other.mask; };
    if (std::any_of(first, fiber, beside)) continue;
    const uint3& at = fiber->thread;
    std::fprintf(stderr, "  thread (%u, %u, %u) in %s", at.x, at.y, at.z, kStops[int(fiber->stop)]);
    if (fiber->mask != 0) std::fprintf(stderr, " of lanes 0x%08x", fiber->mask);
    std::fprintf(stderr, ", %d in all\n", int(std::count_if(fiber, end, beside)));
  }
  std::abort();
}

[[noreturn]] void fail(const char* what) { fail(what, running->index, running->index + 1); }

void make_ready(Fiber& fiber) {
  fiber.waits = false;
  ready[ready_count++] = &fiber;
}

Fiber& next_fiber() {
  if (ready_count == 0 && finished < threads) fail("deadlock, no thread can go on", 0, threads);
  if (ready_count == 0) return host;
  std::swap(ready[random_below(ready_count)], ready[ready_count - 1]);
  return *ready[--ready_count];
}

void fiber_main();

// Contexts switch the signal mask with a system call, jumps do not: a context only starts a fiber, once for ever.
[[noreturn]] void start(Fiber& fiber) {
  const size_t page = size_t(sysconf(_SC_PAGESIZE)), bytes = page + kStack;
  void* const memory = mmap(nullptr, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (memory == MAP_FAILED || mprotect(memory, page, PROT_NONE) != 0) fail("no memory for a stack");
  fiber.has_stack = true;
  ucontext_t context;
  getcontext(&context);
  context.uc_link = nullptr;
  context.uc_stack.ss_sp = memory;
  context.uc_stack.ss_size = bytes;
  makecontext(&context, fiber_main, 0);
  setcontext(&context);
  std::abort();
}

// From the running fiber, which is in `ready` or waits to be put there, to the next one.
void leave() {
  Fiber &from = *running, &to = next_fiber();
  if (&from == &to || _setjmp(from.registers) != 0) return;
  running = &to;
  emulated_place.thread = to.thread;
  if (&to != &host && !to.has_stack) start(to);
  _longjmp(to.registers, 1);
}

void stop_at(EmulatedStop stop, unsigned mask) {
  running->stop = stop;
  running->mask = mask;
  running->waits = true;
  if (stop != EmulatedStop::Atomic) yields = 0;
}

// One fiber serves the threads of its index in all blocks of all launches.
void fiber_main() {
  for (;;) {
    [&]() noexcept { run_thread(run_arguments); }();
    stop_at(EmulatedStop::Finished, 0);
    ++finished;
    leave();
  }
}

// Hands out a collective's results, before any of its lanes moves on to the next.
void finish(EmulatedStop stop, Fiber* warp, unsigned lanes) {
  const bool shuffles = stop >= EmulatedStop::Shuffle && stop <= EmulatedStop::ShuffleDown;
  uint64_t given[warpSize], votes = 0;
  for (int lane = 0; lane < warpSize; ++lane)
    if (lanes >> lane & 1) votes |= uint64_t((given[lane] = warp[lane].value) != 0) << lane;
  for (int lane = 0; lane < warpSize; ++lane) {
    if ((lanes >> lane & 1) == 0) continue;
    warp[lane].value = shuffles ? given[warp[lane].source] : votes;
    make_ready(warp[lane]);
  }
}

void run_block(size_t shared_bytes) {
  unsigned char* const fence = shared + shared_bytes;
  std::fill(shared, fence + kFence, kUnwritten);
  ready_count = finished = arrived = yields = 0;
  for (int i = 0; i < threads; ++i) make_ready(fibers[i]);
  leave();
  if (std::any_of(fence, fence + kFence, [](unsigned char c) { return c != kUnwritten; }))
    fail("a thread has written beyond the dynamic shared memory", 0, 0);
}

}  // namespace

void emulated_blocks(dim3 grid, dim3 block, size_t shared_bytes, void (*thread)(void*), void* arguments) {
  static std::mutex one_launch;
  const std::lock_guard lock(one_launch);
  const uint64_t size = uint64_t(block.x) * block.y * block.z;
  if (uint64_t(grid.x) * grid.y * grid.z == 0 || grid.x > 0x7fffffff || grid.y > 0xffff || grid.z > 0xffff ||
      size == 0 || size > kMostThreads || shared_bytes > kMostShared) {
    last_error = cudaErrorInvalidConfiguration;
    return;
  }
  const char* const asked = std::getenv("SURFCAP_EMULATION_SEED");
  seed = asked ? std::strtoull(asked, nullptr, 10) : 1;
  random_state = (seed + 1) * 0x9e3779b97f4a7c15 | 1;
  emulated_place = {{}, {}, block, grid};
  run_thread = thread;
  run_arguments = arguments;
  threads = int(size);
  for (int i = 0; i < threads; ++i) {
    fibers[i].index = i;
    fibers[i].thread = {i % block.x, i / block.x % block.y, i / block.x / block.y};
  }
  uint3& at = emulated_place.block;
  for (at.z = 0; at.z < grid.z; ++at.z)
    for (at.y = 0; at.y < grid.y; ++at.y)
      for (at.x = 0; at.x < grid.x; ++at.x) run_block(shared_bytes);
}

uint64_t emulated_collective(EmulatedStop stop, unsigned mask, uint64_t value, int source, int width) {
  Fiber& self = *running;
  const int lane = self.index % warpSize, first = self.index - lane;
  const unsigned lanes = mask & ~0u >> std::max(first + warpSize - threads, 0);  // but those that the warp lacks
  stop_at(stop, mask);
  if (width < 1 || width > warpSize || !std::has_single_bit(unsigned(width)))
    fail("a width that is no power of 2 to 32");
  if ((lanes >> lane & 1) == 0) fail("a thread is not among the lanes that it names");
  if (((source ^ lane) & -width) != 0) fail("a thread reads a lane outside its group");
  if ((lanes >> source & 1) == 0) fail("a thread reads a lane that is not among those it names");
  self.value = value;
  self.source = source;
  const auto absent = [&](const Fiber& f) { return !f.waits || f.stop != stop || f.mask != mask; };
  unsigned left = lanes;
  while (left != 0 && !absent(fibers[first + std::countr_zero(left)])) left &= left - 1;
  if (left == 0) finish(stop, fibers + first, lanes);
  leave();
  return self.value;
}

void __syncthreads() {
  stop_at(EmulatedStop::SyncThreads, 0);
  if (++arrived == threads) {
    arrived = 0;
    for (int i = 0; i < threads; ++i) make_ready(fibers[i]);
  }
  leave();
}

void emulated_yield() {
  if (running == &host || random_below(kOneInYields) != 0) return;
  stop_at(EmulatedStop::Atomic, 0);
  if (++yields > kMostYields) fail("a thread waits for ever");
  make_ready(*running);
  leave();
}

void* emulated_shared_memory() { return shared; }

cudaError_t cudaGetLastError() { return std::exchange(last_error, cudaSuccess); }

const char* cudaGetErrorString(cudaError_t error) {
  if (error == cudaErrorInvalidValue) return "invalid argument";
  return error == cudaSuccess ? "no error" : "invalid configuration argument";
}
