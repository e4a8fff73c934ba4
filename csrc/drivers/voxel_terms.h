// voxel_terms: total variation, parsimony, ballooning and curvature of all voxels; their gradient is added to
// `gradient`.
#pragma once

#include "../arguments.h"

namespace surfcap {

constexpr int kVoxelTerms = 5;

template <class Device>
Tensor voxel_terms(Tensor voxels, Tensor table, std::vector<double> frame, Tensor coordinates,
                   std::vector<double> weights, double huber, double bend, Tensor gradient) {
  const Device device(SURFCAP_NAMED(voxels, table, coordinates, gradient));
  return by_storage(voxels, gradient.scalar_type(), [&]<class Types>(Types) {
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
    const Tensor losses = torch::stable::new_zeros(gradient, {kVoxelTerms}, ScalarType::Double);
    device.voxel_terms(field.view, places.data(), terms, losses, to);
    return losses;
  });
}

}  // namespace surfcap
