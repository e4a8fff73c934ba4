// integration_ranges on CUDA: a team of threads to a ray, which is walked twice, to count its ranges and, their places
// known, to write them. The size of what is returned is the one thing that the host has to wait for.
#include "../drivers/integration_ranges.h"

#include "walk.cuh"

namespace surfcap {
namespace {

template <class Walking>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    count_ranges(const __grid_constant__ Walking walking, double quiet, int64_t* counts) {
  walking.for_each_ray([&](const auto& walk, const auto& reader, int64_t i) {
    using Real = std::decay_t<decltype(walk.ray.opacity)>;
    const int count = ray_ranges(walk, walk.ray.samples, walking.settings.step, Real(quiet), [](int, Real, Real) {});
    if (reader.team.lane == 0) counts[i] = count;
  });
}

template <class Walking, class Real>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    write_ranges(const __grid_constant__ Walking walking, Real quiet, const int64_t* starts, Real* ranges) {
  walking.for_each_ray([&](const auto& walk, const auto& reader, int64_t i) {
    Real* const to = ranges + 2 * starts[i];
    ray_ranges(walk, walk.ray.samples, walking.settings.step, quiet, [&](int n, Real begin, Real end) {
      if (reader.team.lane != 0) return;
      to[2 * n] = begin;
      to[2 * n + 1] = end;
    });
  });
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real, class Stored>
  Tensor integration_ranges(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                            Real quiet, const Tensor& like, const Tensor& offsets) const {
    int64_t* const starts = offsets.template mutable_data_ptr<int64_t>();
    Tensor ranges = torch::stable::new_empty(like, {0, 2});
    const auto count = [](const auto& walking) { return count_ranges<std::decay_t<decltype(walking)>>; };
    with_walking(*this, like, field, rays, settings, count, [&](const auto& walking, int64_t blocks) {
      launch("integration_ranges", count(walking), blocks, kThreads, walking, double(quiet), starts + 1);
      add_up(offsets);
      ranges = torch::stable::new_empty(like, {fetch(starts + rays.count), 2});
      launch("integration_ranges", write_ranges<std::decay_t<decltype(walking)>, Real>, blocks, kThreads, walking,
             quiet, starts, ranges.template mutable_data_ptr<Real>());
    });
    return ranges;
  }

  // Every number becomes the sum of those up to it.
  static void add_up(const Tensor& numbers) {
    using torch::stable::detail::from;
    std::array<StableIValue, 3> stack{from(numbers), from(int64_t(0)), from(std::nullopt)};
    TORCH_ERROR_CODE_CHECK(torch_call_dispatcher("aten::cumsum_", "", stack.data(), TORCH_ABI_VERSION));
    torch::stable::detail::to<Tensor>(stack[0]);  // owns what was returned
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) {
  m.impl("integration_ranges", TORCH_BOX(&integration_ranges<Cuda>));
}

}  // namespace surfcap
