// Triangles in a picture: which pixel centres each covers, and how near it is there.
#pragma once

#include <cmath>

#include "pack.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// What a pixel keeps of the triangles over it: the nearness, 1/depth, of the nearest one in the upper half (positive
// floats have the order of their bits), and below it the face, inverted: of two as near the first wins. 0: none.
using Covered = unsigned long long;
constexpr Covered kFaceBits = 0xffffffffu;

SURFCAP_HD Covered covered_by(float nearness, int64_t face) {
  uint32_t bits;
  __builtin_memcpy(&bits, &nearness, sizeof(bits));
  return Covered(bits) << 32 | (kFaceBits - Covered(face));
}
SURFCAP_HD int32_t face_of(Covered covered) { return covered == 0 ? -1 : int32_t(kFaceBits - (covered & kFaceBits)); }

// Twice the area of (a, b, p), in the picture's axes. The side that two triangles share must give both the same number
// but for the sign, or rounding leaves holes along it: it is taken in one order whichever of them asks, and
// rounded in one way.
template <class Real> SURFCAP_HD Real edge(const Real* a, const Real* b, Real x, Real y) {
  const bool turned = a[0] > b[0] || (a[0] == b[0] && a[1] > b[1]);
  const Real *const from = turned ? b : a, *const to = turned ? a : b;
  const Real twice = std::fma(to[0] - from[0], y - from[1], -((to[1] - from[1]) * (x - from[0])));
  return turned ? -twice : twice;
}

// Calls put(pixel, covered) for the pixels, numbered row by row, whose centres a face covers. Its corners are (x, y) in
// pixels, (0, 0) being the outer corner of the first one, and their depths. Faces with a corner that is not in front of
// the camera are left out. 1/depth is linear in the picture.
template <class Real, class Put>
SURFCAP_HD void cover(const Real* corners, const int32_t* faces, int64_t face, int64_t height, int64_t width,
                      const Put& put) {
  const Real* const c[3] = {corners + 3 * faces[3 * face], corners + 3 * faces[3 * face + 1],
                            corners + 3 * faces[3 * face + 2]};
  if (!(c[0][2] > Real(0) && c[1][2] > Real(0) && c[2][2] > Real(0))) return;
  const Real area = edge(c[0], c[1], c[2][0], c[2][1]);
  if (area == Real(0)) return;
  const auto first_center = [&](int axis, int64_t size) {
    const Real low = smaller(smaller(c[0][axis], c[1][axis]), c[2][axis]) - Real(0.5);
    return int64_t(std::ceil(clamped(low, Real(0), Real(size))));
  };
  const auto end_center = [&](int axis, int64_t size) {
    const Real high = larger(larger(c[0][axis], c[1][axis]), c[2][axis]) - Real(0.5);
    return int64_t(std::floor(clamped(high, Real(-1), Real(size - 1)))) + 1;
  };
  const Real sign = area > Real(0) ? Real(1) : Real(-1);
  const int64_t left = first_center(0, width), right = end_center(0, width), bottom = end_center(1, height);
  for (int64_t v = first_center(1, height); v < bottom; ++v) {
    for (int64_t u = left; u < right; ++u) {
      const Real x = Real(u) + Real(0.5), y = Real(v) + Real(0.5);
      const Real a = sign * edge(c[1], c[2], x, y), b = sign * edge(c[2], c[0], x, y),
                 d = sign * edge(c[0], c[1], x, y);
      if (!(a >= Real(0) && b >= Real(0) && d >= Real(0))) continue;
      const Real nearness = (a / c[0][2] + b / c[1][2] + d / c[2][2]) / (a + b + d);
      if (nearness > Real(0)) put(v * width + u, covered_by(float(nearness), face));
    }
  }
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
