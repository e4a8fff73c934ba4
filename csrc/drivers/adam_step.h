// adam_step: one step of Adam on all tiles, with the clamp of each coefficient.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
void adam_step(Tensor voxels, Tensor gradient, Tensor first, Tensor second, Tensor rate, Tensor low, Tensor high,
               double beta1, double beta2, double epsilon, int64_t t, int64_t seed, bool stochastic) {
  const Device device(SURFCAP_NAMED(voxels, gradient, first, second, rate, low, high));
  by_storage(voxels, gradient.scalar_type(), [&]<class Types>(Types) {
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
    check_aligned("gradient", g.tensor());
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
    device.adam_step(value, g.data(), m, v, int32_t(pitch), voxels.size(0), adam);
  });
}

}  // namespace surfcap
