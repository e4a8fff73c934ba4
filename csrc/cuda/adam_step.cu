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
  using Four = Pack<Real, 4>;
  const int place = int(4 * threadIdx.x) & (pitch - 1);  // the same in every turn: a stride is whole records
  const Four rate = load<Real, 4>(adam.rate + place), low = load<Real, 4>(adam.low + place),
             high = load<Real, 4>(adam.high + place);
  Four rates = zero_pack<Real, 4>();
  if constexpr (!std::is_same_v<Stored, Real>)
    for (int i = 0; i < 4; ++i) rates[i] = code_rate<Stored>(adam, place + i);
  for (int64_t part = first_item(); part < parts; part += stride()) {
    const int64_t at = 4 * part;
    if constexpr (std::is_same_v<Stored, Real>) {
      const Four g = load_aligned<Real, 4>(gradient + at);
      Four x = load_aligned<Real, 4>(value + at), m = load_aligned<Real, 4>(first + at),
           v = load_aligned<Real, 4>(second + at);
      for (int i = 0; i < 4; ++i) adam_number(x[i], g[i], m[i], v[i], rate[i], low[i], high[i], adam);
      store_aligned<Real, 4>(value + at, x);
      store_aligned<Real, 4>(first + at, m);
      store_aligned<Real, 4>(second + at, v);
    } else {
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
