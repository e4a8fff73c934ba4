// The schemas of all ops. What each does is said once, in torch_surfcap/ops; core/, drivers/NAME.h, cpu/NAME.cpp and
// cuda/NAME.cu implement it.
#include <torch/csrc/stable/library.h>

// The arguments that describe a field, a bundle of rays and the march stand at the beginning of most schemas.
#define FIELD "Tensor voxels, Tensor table, float[] frame"
#define RAYS "Tensor origins, Tensor directions, Tensor shift, Tensor background"
#define MARCH "int opacity, float slope, float step, float stop"
#define PHOTOMETRIC                                                                                              \
  FIELD ", " RAYS                                                                                                \
        ", Tensor target, Tensor mask, Tensor weight, Tensor? range_offsets, Tensor? ranges, int bundle, " MARCH \
        ", float huber, float[] weights, bool detach_sample, bool rendered_sample"
#define SLOTS "Tensor starts, Tensor first, int exponent"

STABLE_TORCH_LIBRARY(torch_surfcap, m) {
  m.def("sample_forward(" FIELD ", Tensor points) -> Tensor");
  m.def("sample_backward(Tensor grad_values, " FIELD ", Tensor points, int groups) -> Tensor");
  m.def("shade_forward(" FIELD ", Tensor points, Tensor directions) -> Tensor");
  m.def("shade_backward(Tensor grad_values, " FIELD ", Tensor points, Tensor directions, int groups) -> Tensor");
  m.def("march_forward(" FIELD ", " RAYS ", " MARCH ") -> (Tensor, Tensor, Tensor)");
  m.def("march_backward(Tensor grad_color, Tensor grad_transmittance, Tensor grad_depth, " FIELD ", " RAYS ", " MARCH
        ", int groups) -> Tensor");
  m.def("photometric_step(" PHOTOMETRIC ", Tensor(a!) gradients) -> (Tensor, Tensor, Tensor, Tensor)");
  m.def("photometric_lattice(" PHOTOMETRIC ", " SLOTS ", Tensor(a!) slots) -> (Tensor, Tensor, Tensor, Tensor)");
  m.def("gather_gradient(" FIELD
        ", Tensor coordinates, Tensor matrices, Tensor centers, Tensor windows, Tensor window_rays, Tensor shift, "
        "float step, " SLOTS ", Tensor slots, Tensor(a!) gradient) -> ()");
  m.def("integration_ranges(" FIELD ", Tensor origins, Tensor directions, Tensor shift, " MARCH
        ", float quiet) -> (Tensor, Tensor)");
  m.def("visibility(" FIELD ", Tensor origins, Tensor directions, Tensor shift, " MARCH ", int groups) -> Tensor");
  m.def("voxel_terms(" FIELD
        ", Tensor coordinates, float[] weights, float huber, float bend, Tensor(a!) gradient) -> Tensor");
  m.def(
      "adam_step(Tensor(a!) voxels, Tensor gradient, Tensor(b!) first, Tensor(c!) second, Tensor rate, Tensor low, "
      "Tensor high, float beta1, float beta2, float epsilon, int t, int seed, bool stochastic) -> ()");
  m.def("soft_hull(Tensor points, Tensor projections, Tensor masks, Tensor sizes) -> (Tensor, Tensor)");
  m.def("rasterize(Tensor corners, Tensor faces, int height, int width) -> Tensor");
  m.def("upscale(" FIELD ", Tensor fine_coordinates, float[] fine_frame) -> Tensor");
}
