// visibility: per voxel the largest transmittance and the largest weight of the samples that read it.
#include "parallel.h"

namespace surfcap {

template <class Types>
Tensor visibility_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                        const Tensor& origins, const Tensor& directions, const Tensor& shift, int64_t opacity,
                        double slope, double step, double stop, int64_t groups) {
  using Real = typename Types::Real;
  const FieldArgument<Real, typename Types::Stored> field(voxels, table, frame);
  const RaysArgument<Real> rays(origins, directions, shift, origins);  // no background is read
  const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
  const Tensor seen = torch::stable::new_empty(origins, {field.view.tiles, kTileSide, kTileSide, kTileSide, 2});
  grouped(
      origins, rays.view.count, groups, seen.numel(), seen.template mutable_data_ptr<Real>(),
      [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
        fit_kernels<Types>().visibility(field.view, rays.view, settings, begin, end, buffer);
      },
      [](Real* most, const Real* other, int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) most[i] = std::max(most[i], other[i]);
      });
  return seen;
}

Tensor visibility(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins, Tensor directions,
                  Tensor shift, int64_t opacity, double slope, double step, double stop, int64_t groups) {
  return by_storage(voxels, origins.scalar_type(), [&](auto types) {
    return visibility_typed<decltype(types)>(voxels, table, frame, origins, directions, shift, opacity, slope, step,
                                             stop, groups);
  });
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("visibility", TORCH_BOX(&visibility)); }

}  // namespace surfcap
