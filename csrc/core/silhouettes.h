// The soft visual hull: at a point, the least of the masks of the cameras that see it.
#pragma once

#include "pack.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// A camera sees a point in front of it that falls inside its picture. The mask is read bilinearly between pixel centres
// and constant beyond the outermost ones.
template <class Real> SURFCAP_HD Real soft_hull_point(const Silhouettes<Real>& s, const Real* point, int32_t& votes) {
  Real least = Real(1);
  votes = 0;
  for (int64_t v = 0; v < s.views; ++v) {
    const Real* m = s.projections + 12 * v;
    Real h[3];
    for (int r = 0; r < 3; ++r)
      h[r] = m[4 * r] * point[0] + m[4 * r + 1] * point[1] + m[4 * r + 2] * point[2] + m[4 * r + 3];
    const int64_t width = s.sizes[2 * v], height = s.sizes[2 * v + 1];
    const Real x = h[0] / h[2], y = h[1] / h[2];
    if (!(h[2] > Real(0) && x >= Real(0) && y >= Real(0) && x <= Real(width) && y <= Real(height))) continue;
    ++votes;
    const Real px = clamped(x - Real(0.5), Real(0), Real(width - 1)),
               py = clamped(y - Real(0.5), Real(0), Real(height - 1));
    const int64_t x0 = int64_t(px), y0 = int64_t(py);
    const int64_t right = x0 + 1 < width ? 1 : 0, below = y0 + 1 < height ? width : 0;
    const Real fx = px - Real(x0), fy = py - Real(y0);
    const Real* mask = s.masks + s.offsets[v] + y0 * width + x0;
    const Real top = mask[0] + fx * (mask[right] - mask[0]);
    const Real bottom = mask[below] + fx * (mask[below + right] - mask[below]);
    least = smaller(least, top + fy * (bottom - top));
  }
  return votes > 0 ? least : Real(0);
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
