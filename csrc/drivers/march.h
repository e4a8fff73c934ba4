// march_forward, march_backward: the ray integral (paper eq. 4 to 6) and its adjoint (eq. 17, division-free).
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device>
std::tuple<Tensor, Tensor, Tensor> march_forward(Tensor voxels, Tensor table, std::vector<double> frame, Tensor origins,
                                                 Tensor directions, Tensor shift, Tensor background, int64_t opacity,
                                                 double slope, double step, double stop) {
  const Device device(SURFCAP_NAMED(voxels, table, origins, directions, shift, background));
  return by_real(voxels, [&]<class Real>(Real) -> std::tuple<Tensor, Tensor, Tensor> {
    const FieldArgument<Real> field(voxels, table, frame);
    const RaysArgument<Real> rays(origins, directions, shift, background);
    const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
    const NewRendering<Real> out(voxels, rays.view.count);
    device.march_forward(field.view, rays.view, settings, out.view, voxels);
    return {out.color, out.transmittance, out.depth};
  });
}

template <class Device>
Tensor march_backward(Tensor grad_color, Tensor grad_transmittance, Tensor grad_depth, Tensor voxels, Tensor table,
                      std::vector<double> frame, Tensor origins, Tensor directions, Tensor shift, Tensor background,
                      int64_t opacity, double slope, double step, double stop, int64_t groups) {
  const Device device(
      SURFCAP_NAMED(voxels, grad_color, grad_transmittance, grad_depth, table, origins, directions, shift, background));
  return by_real(voxels, [&]<class Real>(Real) {
    const FieldArgument<Real> field(voxels, table, frame);
    const RaysArgument<Real> rays(origins, directions, shift, background);
    const RaySettings<Real> settings = ray_settings<Real>(opacity, slope, step, stop);
    const int64_t count = rays.view.count;
    const Input<Real> by_color("grad_color", grad_color, {count, 3});
    const Input<Real> by_transmittance("grad_transmittance", grad_transmittance, {count});
    const Input<Real> by_depth("grad_depth", grad_depth, {count});
    const Tensor gradient = torch::stable::empty_like(field.voxels.tensor());
    device.march_backward(field.view, rays.view, settings, by_color.data(), by_transmittance.data(), by_depth.data(),
                          groups, gradient);
    return gradient;
  });
}

}  // namespace surfcap
