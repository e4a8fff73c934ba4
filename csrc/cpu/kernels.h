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
  void (*shade_forward)(const Field<Real>&, const Real* points, const Real* directions, int64_t begin, int64_t end,
                        Real* values);
  void (*shade_backward)(const Field<Real>&, const Real* points, const Real* directions, const Real* grad_values,
                         int64_t begin, int64_t end, Real* gradient);
  void (*march_forward)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, int64_t begin, int64_t end,
                        const Rendering<Real>& out);
  void (*march_backward)(const Field<Real>&, const Rays<Real>&, const RaySettings<Real>&, const Real* grad_color,
                         const Real* grad_transmittance, const Real* grad_depth, int64_t begin, int64_t end,
                         Real* gradient);
  void (*reach_of_view)(const SlotCameras<Real>&, const SlotRows<Real>&, int64_t view, int32_t* reach);
  // The slots are Real or, where `narrow`, 8-bit floats.
  void (*gather_gradient)(const Grid<Real>&, const int32_t* coordinates, const SlotCameras<Real>&,
                          const SlotRows<Real>&, bool narrow, const void* slots, int64_t begin, int64_t end,
                          Real* gradient);
  void (*soft_hull)(const Silhouettes<Real>&, const Real* points, int64_t begin, int64_t end, Real* value,
                    int32_t* votes);
  void (*upscale)(const Field<Real>& coarse, const Field<Real>& fine, const int32_t* coordinates, int64_t begin,
                  int64_t end, Real* voxels);
};

// What an iteration of a fit runs, by the type that values are stored as and the type that gradients are summed in.
template <class Real, class Stored, class Sum> struct FitKernels {
  void (*photometric_step)(const Field<Real, Stored>&, const Rays<Real>&, const RaySettings<Real>&,
                           const Observation<Real>&, const PhotometricSettings<Real>&, int64_t begin, int64_t end,
                           double* losses, const Rendering<Real>& out, Sum* gradient);
  // The slots are Real or, where `narrow`, 8-bit floats.
  void (*photometric_lattice)(const Field<Real, Stored>&, const Rays<Real>&, const RaySettings<Real>&,
                              const Observation<Real>&, const PhotometricSettings<Real>&, const SlotRows<Real>&,
                              bool narrow, int64_t begin, int64_t end, double* losses, const Rendering<Real>& out,
                              void* slots);
  void (*add_sums)(Sum* total, const Sum* more, int64_t begin, int64_t end);
  // Appends the ranges of each ray to `ranges` and writes their number to counts[ray].
  void (*integration_ranges)(const Field<Real, Stored>&, const Rays<Real>&, const RaySettings<Real>&, Real quiet,
                             int64_t begin, int64_t end, int64_t* counts, std::vector<Real>& ranges);
  void (*visibility)(const Field<Real, Stored>&, const Rays<Real>&, const RaySettings<Real>&, int64_t begin,
                     int64_t end, Real* seen);
  void (*voxel_terms)(const Field<Real, Stored>&, const int32_t* coordinates, const VoxelTerms<Real>&, int64_t begin,
                      int64_t end, double* losses, Sum* gradient);
  void (*adam_step)(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second,
                    int32_t pitch, int64_t begin, int64_t end, const AdamSettings<Real>&);
};

namespace baseline {
template <class Table> const Table& kernels();
}
#if defined(__x86_64__)
namespace avx2 {
template <class Table> const Table& kernels();
}
namespace avx512 {
template <class Table> const Table& kernels();
}
#endif

// The best table this processor runs; TORCH_SURFCAP_ISA=baseline|avx2|avx512 asks for a lesser one.
template <class Table> const Table& best();

template <class Real> const Kernels<Real>& best_kernels() { return best<Kernels<Real>>(); }
template <class Types> const auto& fit_kernels() {
  return best<FitKernels<typename Types::Real, typename Types::Stored, typename Types::Sum>>();
}

// Calls with(table) for every table there is.
#define SURFCAP_ALL_TABLES(with)            \
  with(Kernels<float>);                     \
  with(Kernels<double>);                    \
  with(FitKernels<float, float, float>);    \
  with(FitKernels<double, double, double>); \
  with(FitKernels<float, uint8_t, float>);  \
  with(FitKernels<float, uint8_t, Half>);   \
  with(FitKernels<float, uint16_t, float>); \
  with(FitKernels<float, uint16_t, Half>)

}  // namespace surfcap
