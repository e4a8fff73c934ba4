// rasterize: the face that each pixel's centre sees, by a z-buffer.
#pragma once

#include "../arguments.h"

namespace surfcap {

template <class Device> Tensor rasterize(Tensor corners, Tensor faces, int64_t height, int64_t width) {
  const Device device(SURFCAP_NAMED(corners, faces));
  STD_TORCH_CHECK(height >= 0 && width >= 0, "height, width: expected no negative size, got ", height, " x ", width);
  return by_real(corners, [&]<class Real>(Real) {
    const Input<Real> at("corners", corners, {kAny, 3});
    const Input<int32_t> triangles("faces", faces, {kAny, 3});
    if (on_host(faces) && faces.numel() > 0) {
      const auto [least, most] = std::minmax_element(triangles.data(), triangles.data() + faces.numel());
      STD_TORCH_CHECK(*least >= 0 && *most < corners.size(0), "faces: expected 0 to less than the number of corners, ",
                      corners.size(0), ", got ", *least, " to ", *most);
    }
    const Tensor seen = torch::stable::new_empty(corners, {height, width}, ScalarType::Int);
    device.rasterize(at.data(), triangles.data(), faces.size(0), height, width, seen);
    return seen;
  });
}

}  // namespace surfcap
