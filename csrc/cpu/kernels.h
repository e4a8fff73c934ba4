// The CPU kernels behind one table per instruction set. A kernel works on a range of rays, points, tiles or records;
// the drivers beside this file split the work over threads.
#pragma once

#include <vector>

#include "../core/views.h"

namespace surfcap {

template <class Real> struct Kernels {
  const char* name;
  void (*sample_forward)(const Field<Real>&, const Real* points, int64_t begin, int64_t end, Real* values);
  void (*sample_backward)(const Field<Real>&, const Real* points, const Real* grad_values, int64_t begin, int64_t end,
                          Real* gradient);
  void (*march_forward)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, int64_t begin, int64_t end,
                        Real* color, Real* transmittance, Real* depth);
  void (*march_backward)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, const Real* grad_color,
                         const Real* grad_transmittance, const Real* grad_depth, int64_t begin, int64_t end,
                         Real* gradient);
  void (*photometric_step)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, const Observation<Real>&,
                           const PhotometricSettings<Real>&, int64_t begin, int64_t end, double* losses, Real* color,
                           Real* transmittance, Real* gradient);
  // The slots are Real or, where `narrow`, 8-bit floats.
  void (*photometric_lattice)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, const Observation<Real>&,
                              const PhotometricSettings<Real>&, const SlotRows<Real>&, bool narrow, int64_t begin,
                              int64_t end, double* losses, Real* color, Real* transmittance, void* slots);
  void (*find_reach)(const SlotCameras<Real>&, const SlotRows<Real>&, int64_t view, int32_t* reach);
  void (*gather_gradient)(const Field<Real>&, const int32_t* coordinates, const SlotCameras<Real>&,
                          const SlotRows<Real>&, bool narrow, const void* slots, int64_t begin, int64_t end,
                          Real* gradient);
  // Appends the ranges of each ray to `ranges` and writes their number to counts[ray].
  void (*integration_ranges)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, Real quiet, int64_t begin,
                             int64_t end, int64_t* counts, std::vector<Real>& ranges);
  void (*visibility)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, int64_t begin, int64_t end,
                     Real* seen);
  void (*voxel_terms)(const Field<Real>&, const int32_t* coordinates, const VoxelTerms<Real>&, int64_t begin,
                      int64_t end, double* losses, Real* gradient);
  void (*adam_step)(Real* value, const Real* gradient, Real* first, Real* second, int32_t pitch, int64_t begin,
                    int64_t end, const AdamSettings<Real>&);
  void (*soft_hull)(const Silhouettes<Real>&, const Real* points, int64_t begin, int64_t end, Real* value,
                    int32_t* votes);
  void (*upscale)(const Field<Real>& coarse, const Field<Real>& fine, const int32_t* coordinates, int64_t begin,
                  int64_t end, Real* voxels);
};

namespace baseline {
template <class Real> const Kernels<Real>& kernels();
}
#if defined(__x86_64__)
namespace avx2 {
template <class Real> const Kernels<Real>& kernels();
}
namespace avx512 {
template <class Real> const Kernels<Real>& kernels();
}
#endif

// The best table this processor runs; TORCH_SURFCAP_ISA=baseline|avx2|avx512 asks for a lesser one.
template <class Real> const Kernels<Real>& best_kernels();

}  // namespace surfcap
