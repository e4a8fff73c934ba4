// march_forward, march_backward: the ray integral (paper eq. 4 to 6) and its adjoint (eq. 17, division-free).
#include <tuple>

#include "parallel.h"

namespace surfcap {

template <class Real>
std::tuple<Tensor, Tensor, Tensor> march_forward_typed(const Tensor& voxels, const Tensor& table,
                                                       const std::vector<double>& frame, const Tensor& origins,
                                                       const Tensor& directions, const Tensor& shift,
                                                       const Tensor& background, int64_t opacity, double slope,
                                                       double step, double stop) {
  const FieldArgument<Real> field(voxels, table, frame);
  const RaysArgument<Real> rays(origins, directions, shift, background);
  const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
  const int64_t count = rays.view.count;
  const NewRendering<Real> out(voxels, count);
  parallel_ranges(count, kChunk, [&](int64_t begin, int64_t end) {
    best_kernels<Real>().march_forward(field.view, rays.view, settings, begin, end, out.view);
  });
  return {out.color, out.transmittance, out.depth};
}

template <class Real>
Tensor march_backward_typed(const Tensor& grad_color, const Tensor& grad_transmittance, const Tensor& grad_depth,
                            const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                            const Tensor& origins, const Tensor& directions, const Tensor& shift,
                            const Tensor& background, int64_t opacity, double slope, double step, double stop,
                            int64_t groups) {
  const FieldArgument<Real> field(voxels, table, frame);
  const RaysArgument<Real> rays(origins, directions, shift, background);
  const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
  const int64_t count = rays.view.count;
  const Input<Real> by_color("grad_color", grad_color, {count, 3});
  const Input<Real> by_transmittance("grad_transmittance", grad_transmittance, {count});
  const Input<Real> by_depth("grad_depth", grad_depth, {count});
  const Tensor gradient = torch::stable::empty_like(field.voxels.tensor());
  grouped_sum<Real>(voxels, count, groups, gradient.numel(), gradient.template mutable_data_ptr<Real>(),
                    [&](int64_t begin, int64_t end, Real* buffer, int64_t) {
                      best_kernels<Real>().march_backward(field.view, rays.view, settings, by_color.data(),
                                                          by_transmittance.data(), by_depth.data(), begin, end, buffer);
                    });
  return gradient;
}

std::tuple<Tensor, Tensor, Tensor> march_forward(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                                                 Tensor directions, Tensor shift, Tensor background, int64_t opacity,
                                                 double slope, double step, double stop) {
  return SURFCAP_BY_TYPE(voxels, march_forward_typed, voxels, table, frame, origins, directions, shift, background,
                         opacity, slope, step, stop);
}

Tensor march_backward(Tensor grad_color, Tensor grad_transmittance, Tensor grad_depth, Tensor voxels, Tensor table,
                      std::vector<double> frame, Tensor origins, Tensor directions, Tensor shift, Tensor background,
                      int64_t opacity, double slope, double step, double stop, int64_t groups) {
  return SURFCAP_BY_TYPE(voxels, march_backward_typed, grad_color, grad_transmittance, grad_depth, voxels, table, frame,
                         origins, directions, shift, background, opacity, slope, step, stop, groups);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("march_forward", TORCH_BOX(&march_forward));
  m.impl("march_backward", TORCH_BOX(&march_backward));
}

}  // namespace surfcap
