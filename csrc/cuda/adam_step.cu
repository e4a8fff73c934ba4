// adam_step on CUDA: a thread to four numbers of a record. Memory rule: writes in place.
#include "../drivers/adam_step.h"

#include "../core/adam.h"
#include "gpu.cuh"

namespace surfcap {
namespace {

template <class Real, class Stored, class Sum>
__global__ void __launch_bounds__(kThreads)
    step_records(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second, int pitch,
                 int64_t parts, AdamSettings<Real> adam) {
  for (int64_t part = first_item(); part < parts; part += stride()) {
    const int64_t at = 4 * part;
    const int place = int(at % pitch);
    if constexpr (std::is_same_v<Stored, Real>) {
      using Four = Pack<Real, 4>;
      const Four g = load_aligned<Real, 4>(gradient + at);
      Four x = load_aligned<Real, 4>(value + at), m = load_aligned<Real, 4>(first + at),
           v = load_aligned<Real, 4>(second + at);
      for (int i = 0; i < 4; ++i)
        adam_number(x[i], g[i], m[i], v[i], adam.rate[place + i], adam.low[place + i], adam.high[place + i], adam);
      store_aligned<Real, 4>(value + at, x);
      store_aligned<Real, 4>(first + at, m);
      store_aligned<Real, 4>(second + at, v);
    } else {
      Pack<float, 4> rates;
      for (int i = 0; i < 4; ++i) rates[i] = code_rate<Stored>(adam, place + i);
      adam_codes<4>(value, gradient, first, second, at, rates, adam);
    }
  }
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real, class Stored, class Sum>
  void adam_step(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second, int32_t pitch,
                 int64_t tiles, const AdamSettings<Real>& adam) const {
    const int64_t parts = tiles * kVoxelsPerTile * pitch / 4;
    launch("adam_step", step_records<Real, Stored, Sum>, blocks(parts), kThreads, value, gradient, first, second,
           int(pitch), parts, adam);
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) { m.impl("adam_step", TORCH_BOX(&adam_step<Cuda>)); }

}  // namespace surfcap
