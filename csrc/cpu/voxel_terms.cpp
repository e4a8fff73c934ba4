// voxel_terms: total variation, parsimony, ballooning and curvature of all voxels; their gradient is added to
// `gradient`.
#include "parallel.h"

namespace surfcap {

constexpr int kVoxelTerms = 5;

template <class Types>
Tensor voxel_terms_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                         const Tensor& coordinates, const std::vector<double>& weights, double huber, double bend,
                         const Tensor& gradient) {
  using Real = typename Types::Real;
  using Sum = typename Types::Sum;
  const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
  const int64_t tiles = field.view.tiles;
  const Input<int32_t> places = tile_places(coordinates, tiles, field.view.n);
  STD_TORCH_CHECK(weights.size() == kVoxelTerms,
                  "weights: expected [tv_opacity, tv_color, parsimony, ballooning, curvature], got ", weights.size(),
                  " numbers");
  const VoxelTerms<Real> terms{Real(weights[0]), Real(weights[1]), Real(weights[2]), Real(weights[3]),
                               Real(weights[4]), Real(huber),      Real(bend)};
  Sum* const to = output<Sum>("gradient", gradient, {tiles, kTileSide, kTileSide, kTileSide, field.view.pitch});

  // A fixed number of blocks, each with its own sums, so that the values do not depend on the threads.
  constexpr int64_t kBlocks = 64;
  double by_block[kBlocks][kVoxelTerms] = {};
  parallel_ranges(kBlocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t b = first; b < last; ++b)
      fit_kernels<Types>().voxel_terms(field.view, places.data(), terms, b * tiles / kBlocks, (b + 1) * tiles / kBlocks,
                                       by_block[b], to);
  });
  const Tensor losses = torch::stable::new_zeros(gradient, {kVoxelTerms}, ScalarType::Double);
  double* const sum = losses.template mutable_data_ptr<double>();
  for (const auto& block : by_block)
    for (int i = 0; i < kVoxelTerms; ++i) sum[i] += block[i];
  return losses;
}

Tensor voxel_terms(Tensor voxels, Tensor table, std::vector<double> frame, Tensor coordinates,
                   std::vector<double> weights, double huber, double bend, Tensor gradient) {
  return by_storage(voxels, gradient.scalar_type(), [&](auto types) {
    return voxel_terms_typed<decltype(types)>(voxels, table, frame, coordinates, weights, huber, bend, gradient);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("voxel_terms", TORCH_BOX(&voxel_terms)); }

}  // namespace surfcap
