// soft_hull: at points, the least of the masks of the cameras that see them.
#include <tuple>

#include "parallel.h"

namespace surfcap {

template <class Real>
std::tuple<Tensor, Tensor> soft_hull_typed(const Tensor& points, const Tensor& projections, const Tensor& masks,
                                           const Tensor& sizes) {
  const Input<Real> at("points", points, {kAny, 3});
  const int64_t views = projections.size(0);
  const Input<Real> matrices("projections", projections, {kAny, 3, 4});
  const Input<Real> pictures("masks", masks, {kAny});
  const Input<int64_t> extent("sizes", sizes, {views, 2});
  std::vector<int64_t> offsets;
  int64_t total = 0;
  for (int64_t v = 0; v < views; ++v) {
    offsets.push_back(total);
    total += extent.data()[2 * v] * extent.data()[2 * v + 1];
  }
  STD_TORCH_CHECK(total == masks.numel(), "masks: expected ", total, " pixels, as sizes say, got ", masks.numel());
  const Silhouettes<Real> silhouettes{matrices.data(), pictures.data(), offsets.data(), extent.data(), views};
  const Tensor value = torch::stable::new_empty(points, {points.size(0)});
  const Tensor votes = torch::stable::new_empty(points, {points.size(0)}, ScalarType::Int);
  Real* const least = value.template mutable_data_ptr<Real>();
  int32_t* const seen = votes.template mutable_data_ptr<int32_t>();
  parallel_ranges(points.size(0), 1024, [&](int64_t begin, int64_t end) {
    best_kernels<Real>().soft_hull(silhouettes, at.data(), begin, end, least, seen);
  });
  return {value, votes};
}

std::tuple<Tensor, Tensor> soft_hull(Tensor points, Tensor projections, Tensor masks, Tensor sizes) {
  return SURFCAP_BY_TYPE(points, soft_hull_typed, points, projections, masks, sizes);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("soft_hull", TORCH_BOX(&soft_hull)); }

}  // namespace surfcap
