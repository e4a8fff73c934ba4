// adam_step: one step of Adam on all tiles, with the clamp of each coefficient.
#include <cmath>

#include "parallel.h"

namespace surfcap {

template <class Types>
void adam_step_typed(const Tensor& voxels, const Tensor& gradient, const Tensor& first, const Tensor& second,
                     const Tensor& rate, const Tensor& low, const Tensor& high, double beta1, double beta2,
                     double epsilon, int64_t t, int64_t seed, bool stochastic) {
  using Real = typename Types::Real;
  using Number = MomentOf<typename Types::Stored>;
  const int64_t pitch = voxels.dim() == 5 ? voxels.size(4) : 0;
  STD_TORCH_CHECK(pitch == 4 || pitch == 16 || pitch == 32, "voxels: expected [tiles, 4, 4, 4, 4 | 16 | 32], got ",
                  shape_of(voxels));
  STD_TORCH_CHECK(t >= 1, "t: expected a step counted from 1, got ", t);
  const Shape shape = {voxels.size(0), kTileSide, kTileSide, kTileSide, pitch};
  auto* const value = output<typename Types::Stored>("voxels", voxels, shape);
  Number *const m = output<Number>("first", first, shape), *const v = output<Number>("second", second, shape);
  const Input<typename Types::Sum> g("gradient", gradient, shape);
  const Input<Real> rates("rate", rate, {pitch}), lows("low", low, {pitch}), highs("high", high, {pitch});
  const AdamSettings<Real> adam{Real(beta1),
                                Real(beta2),
                                Real(epsilon),
                                Real(1 / (1 - std::pow(beta1, double(t)))),
                                Real(1 / (1 - std::pow(beta2, double(t)))),
                                rates.data(),
                                lows.data(),
                                highs.data(),
                                uint32_t(seed) * 0x85ebca6bu + uint32_t(t) * 0xc2b2ae35u,
                                stochastic};
  parallel_ranges(voxels.size(0), 64, [&](int64_t begin, int64_t end) {
    fit_kernels<Types>().adam_step(value, g.data(), m, v, int32_t(pitch), begin, end, adam);
  });
}

void adam_step(Tensor voxels, Tensor gradient, Tensor first, Tensor second, Tensor rate, Tensor low, Tensor high,
               double beta1, double beta2, double epsilon, int64_t t, int64_t seed, bool stochastic) {
  by_storage(voxels, gradient.scalar_type(), [&](auto types) {
    adam_step_typed<decltype(types)>(voxels, gradient, first, second, rate, low, high, beta1, beta2, epsilon, t, seed,
                                     stochastic);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("adam_step", TORCH_BOX(&adam_step)); }

}  // namespace surfcap
