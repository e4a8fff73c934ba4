// soft_hull: at points, the least of the masks of the cameras that see them.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
std::tuple<Tensor, Tensor> soft_hull(Tensor points, Tensor projections, Tensor masks, Tensor sizes) {
  const Device device(SURFCAP_NAMED(points, projections, masks, sizes));
  return by_real(points, [&]<class Real>(Real) -> std::tuple<Tensor, Tensor> {
    const Input<Real> at("points", points, {kAny, 3});
    const Input<Real> matrices("projections", projections, {kAny, 3, 4});
    const Input<Real> pictures("masks", masks, {kAny});
    const Input<int64_t> extent("sizes", sizes, {projections.size(0), 2});
    const Tensor value = torch::stable::new_empty(points, {points.size(0)});
    const Tensor votes = torch::stable::new_empty(points, {points.size(0)}, ScalarType::Int);
    const Silhouettes<Real> silhouettes{matrices.data(), pictures.data(), nullptr, extent.data(), projections.size(0)};
    device.soft_hull(silhouettes, masks.numel(), at, value.template mutable_data_ptr<Real>(),
                     votes.template mutable_data_ptr<int32_t>());
    return {value, votes};
  });
}

}  // namespace surfcap
