// soft_hull on CUDA: a thread to a point. Memory rule: writes.
#include "../drivers/soft_hull.h"

#include "../core/silhouettes.h"
#include "team.cuh"

namespace surfcap {
namespace {

// Where each picture begins when they lie end to end: there are some hundreds at most.
__global__ void lay_out(const int64_t* sizes, int64_t views, int64_t* offsets) {
  int64_t at = 0;
  for (int64_t v = 0; v < views; ++v) {
    offsets[v] = at;
    at += sizes[2 * v] * sizes[2 * v + 1];
  }
}

template <class Real>
__global__ void __launch_bounds__(kThreads)
    look_up_hull(Silhouettes<Real> silhouettes, const Real* points, int64_t count, Real* value, int32_t* votes) {
  for (int64_t i = first_item(); i < count; i += stride())
    value[i] = soft_hull_point(silhouettes, points + 3 * i, votes[i]);
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real>
  void soft_hull(Silhouettes<Real> silhouettes, int64_t, const Input<Real>& points, Real* value, int32_t* votes) const {
    const int64_t views = silhouettes.views;
    const Tensor offsets = torch::stable::new_empty(points.tensor(), {views}, ScalarType::Long);
    int64_t* const begin = offsets.template mutable_data_ptr<int64_t>();
    silhouettes.offsets = begin;
    launch("soft_hull", lay_out, 1, 1, silhouettes.sizes, views, begin);
    const int64_t count = points.tensor().size(0);
    launch("soft_hull", look_up_hull<Real>, blocks(count), kThreads, silhouettes, points.data(), count, value, votes);
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) { m.impl("soft_hull", TORCH_BOX(&soft_hull<Cuda>)); }

}  // namespace surfcap
