// visibility: per voxel the largest transmittance and the largest weight of the samples that read it.
#include "parallel.h"

namespace surfcap {

template <class Real>
Tensor visibility_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                        const Tensor& origins, const Tensor& directions, const Tensor& shift, int64_t opacity,
                        double slope, double step, double stop, int64_t groups) {
  const FieldArgument<Real> field(voxels, table, frame);
  const RaysArgument<Real> rays(origins, directions, shift, origins);  // no background is read
  const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
  const Tensor seen = torch::stable::new_empty(voxels, {field.view.tiles, kTileSide, kTileSide, kTileSide, 2});
  grouped(
      voxels, rays.view.count, groups, seen.numel(), seen.template mutable_data_ptr<Real>(),
      [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
        best_kernels<Real>().visibility(field.view, rays.view, settings, begin, end, buffer);
      },
      [](Real a, Real b) { return std::max(a, b); });
  return seen;
}

Tensor visibility(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins, Tensor directions,
                  Tensor shift, int64_t opacity, double slope, double step, double stop, int64_t groups) {
  return SURFCAP_BY_TYPE(voxels, visibility_typed, voxels, table, frame, origins, directions, shift, opacity, slope,
                         step, stop, groups);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("visibility", TORCH_BOX(&visibility)); }

}  // namespace surfcap
