// The body of the kernel tables, compiled once per instruction set by isa_*.cpp, which set SURFCAP_ISA and the target.
#include "../core/adam.h"
#include "../core/choices.h"
#include "../core/silhouettes.h"
#include "../core/voxels.h"
#include "gather.h"
#include "kernels.h"
#include "points.h"
#include "walk.h"

namespace surfcap {
inline namespace SURFCAP_ISA {

// Memory that a thread keeps between calls, aligned to a cache line.
class Workspace {
 public:
  ~Workspace() { std::free(memory_); }
  char* reserve(size_t bytes) {
    if (bytes > size_) {
      std::free(memory_);
      size_ = (bytes + 4095) / 4096 * 4096;
      memory_ = static_cast<char*>(std::aligned_alloc(64, size_));
      if (!memory_) throw std::bad_alloc();
    }
    return memory_;
  }

 private:
  char* memory_ = nullptr;
  size_t size_ = 0;
};

static thread_local Workspace workspace;

// Calls f(marcher) with the degree and the opacity's kind resolved and room for a bundle of the longest rays.
template <class Real, class Stored, class F>
void with_marcher(const Field<Real, Stored>& field, const RaySettings<Real>& settings, const F& f) {
  const int64_t capacity = trace_capacity(field, settings.step);
  with_opacity(settings, [&](const auto& opacity) {
    using Opacity = std::decay_t<decltype(opacity)>;
    const size_t room = capacity * kBundle, sample_bytes = room * sizeof(Sample<Real, Opacity>);
    char* memory = workspace.reserve(sample_bytes + room / kLanes * sizeof(Footprints<Real>) + 64);
    const Trace<Real, Opacity> trace{reinterpret_cast<Sample<Real, Opacity>*>(memory),
                                     reinterpret_cast<Footprints<Real>*>(memory + (sample_bytes + 63) / 64 * 64),
                                     capacity};
    with_degree(field.pitch, [&](auto degree) {
      f(Marcher<Real, decltype(degree)::value, Opacity, Stored>(field, settings, opacity, trace));
    });
  });
}

template <class Real>
void march_forward(const Field<Real>& field, const Rays<Real>& rays, const RaySettings<Real>& settings, int64_t begin,
                   int64_t end, const Rendering<Real>& out) {
  with_marcher(field, settings, [&](const auto& march) {
    typename std::decay_t<decltype(march)>::Walk walk;
    for (int64_t i = begin; i < end; ++i) {
      march.walk(walk, rays, i);
      write_ray(walk.ray, rays.background, i, out);
    }
  });
}

template <class Real>
void march_backward(const Field<Real>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                    const Real* grad_color, const Real* grad_transmittance, const Real* grad_depth, int64_t begin,
                    int64_t end, Real* gradient) {
  Real spare[32] = {};
  with_marcher(field, settings, [&]<int Degree, class Opacity>(const Marcher<Real, Degree, Opacity>& march) {
    const ToVoxels<Real, Degree> to{gradient, spare};
    typename Marcher<Real, Degree, Opacity>::Walk walk;
    for (int64_t i = begin; i < end; ++i) {
      march.walk(walk, rays, i, to.prefetched());
      adjoint_ray(walk.ray, rays, i, grad_color, grad_transmittance, grad_depth, march.back(walk, i, to));
    }
  });
}

template <class Real, class Stored, class Sum>
void photometric_step(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                      const Observation<Real>& seen, const PhotometricSettings<Real>& loss, int64_t begin, int64_t end,
                      double* losses, const Rendering<Real>& out, Sum* gradient) {
  Sum spare[32] = {};
  with_marcher(field, settings, [&]<int Degree, class Opacity>(const Marcher<Real, Degree, Opacity, Stored>& march) {
    const ToVoxels<Real, Degree, Sum> to{gradient, spare};
    photometric_rays(march, rays, seen, loss, begin, end, losses, out, to);
  });
}

template <class Real, class Stored>
void photometric_lattice(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                         const Observation<Real>& seen, const PhotometricSettings<Real>& loss,
                         const SlotRows<Real>& rows, bool narrow, int64_t begin, int64_t end, double* losses,
                         const Rendering<Real>& out, void* slots) {
  with_slots<Real>(narrow, slots, [&]<class Slot>(const Slot*) {
    const ToSlots<Real, Slot> to{rows, static_cast<Slot*>(slots)};
    with_marcher(field, settings,
                 [&](const auto& march) { photometric_rays(march, rays, seen, loss, begin, end, losses, out, to); });
  });
}

template <class Real>
void reach_of_view(const SlotCameras<Real>& cameras, const SlotRows<Real>& rows, int64_t view, int32_t* reach) {
  const int64_t blocks = blocks_along(cameras.windows[4 * view + 2]) * blocks_along(cameras.windows[4 * view + 3]);
  for (int64_t b = 0; b < blocks; ++b) find_reach(cameras, rows, view, b, reach + 2 * b);
}

template <class Real>
void gather_gradient(const Grid<Real>& field, const int32_t* coordinates, const SlotCameras<Real>& cameras,
                     const SlotRows<Real>& rows, bool narrow, const void* slots, int64_t begin, int64_t end,
                     Real* gradient) {
  with_slots<Real>(narrow, slots, [&]<class Slot>(const Slot* typed) {
    with_degree(field.pitch, [&](auto degree) {
      for (int64_t t = begin; t < end; ++t)
        gather_tile<Real, decltype(degree)::value>(field, coordinates + 3 * t, cameras, rows, typed,
                                                   gradient + t * kTileVoxels * field.pitch);
    });
  });
}

template <class Sum> void add_sums(Sum* total, const Sum* more, int64_t begin, int64_t end) {
  constexpr int kRow = 16;  // records of whole tiles are whole rows
  for (int64_t i = begin; i < end; i += kRow) {
    if constexpr (std::is_same_v<Sum, Half>)
      add_to<float, kRow>(total + i, from_halves<kRow>(more + i));
    else
      add_to<Sum, kRow>(total + i, load<Sum, kRow>(more + i));
  }
}

template <class Real, class Stored>
void integration_ranges(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                        Real quiet, int64_t begin, int64_t end, int64_t* counts, std::vector<Real>& ranges) {
  with_marcher(field, settings, [&](const auto& march) {
    typename std::decay_t<decltype(march)>::Walk walk;
    for (int64_t i = begin; i < end; ++i) {
      march.walk(walk, rays, i);
      const size_t before = ranges.size();
      const auto to = [&](int n, Real from, Real until) {
        ranges.resize(before + 2 * n);
        ranges.insert(ranges.end(), {from, until});
      };
      counts[i] = ray_ranges(walk.trace.samples, walk.ray.samples, settings.step, quiet, to);
    }
  });
}

template <class Real, class Stored>
void visibility(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                int64_t begin, int64_t end, Real* seen) {
  with_marcher(field, settings, [&](const auto& march) {
    for (int64_t i = begin; i < end; ++i) visibility_ray(march, rays, i, seen);
  });
}

// Adds the gradient of the curvature term to the opacity values of a tile, and returns the term's share of its voxels.
template <class Real, class Stored, class Sum>
Real curvature_tile(const Field<Real, Stored>& field, int64_t cell, int64_t tile, Real weight, Real eps,
                    Sum* gradient) {
  Real value[kHaloVoxels], bend[kHaloVoxels];
  for (int x = 0; x < kHaloSide; ++x)
    for (int y = 0; y < kHaloSide; ++y)
      for (int z = 0; z < kHaloSide; ++z) value[(x * kHaloSide + y) * kHaloSide + z] = halo_value(field, cell, x, y, z);
  const Known<Real, Stored> known(field);
  Real loss = Real(0);
  for (int x = 1; x < kHaloSide - 1; ++x)
    for (int y = 1; y < kHaloSide - 1; ++y) loss += known.bend(value, (x * kHaloSide + y) * kHaloSide, eps, bend);
  for (int v = 0; v < kTileVoxels; v += kTile) {
    const Pack<Real, kRun> by_value = Real(kSumScale<Sum>) * weight * laplacian(bend + in_halo(v) - kHalo);
    for (int z = 0; z < kTile; ++z) add_to(gradient + (tile * kTileVoxels + v + z) * field.pitch, by_value[z + kHalo]);
  }
  return loss;
}

template <class Real, class Stored, class Sum>
void voxel_terms(const Field<Real, Stored>& field, const int32_t* coordinates, const VoxelTerms<Real>& terms,
                 int64_t begin, int64_t end, double* losses, Sum* gradient) {
  with_degree(field.pitch, [&](auto degree) {
    constexpr int D = decltype(degree)::value;
    const Code<Real, D, Stored> code(field);
    for (int64_t t = begin; t < end; ++t) {
      const int64_t cell = cell_of(field, coordinates + 3 * t);
      for (int p = 0; p < Record<D>::kParts; ++p) {
        TermSums<D, Real> sums(terms, p);
        for (int v = 0; v < kTileVoxels; ++v) sums.add(field, code, cell, terms, t, v, gradient);
        sums.add_to_losses(losses);
      }
      if (terms.curvature != Real(0))
        losses[4] += double(curvature_tile(field, cell, t, terms.curvature, terms.bend, gradient));
    }
  });
}

// On the tiles begin .. end.
template <class Real, class Stored, class Sum>
void adam_step(Stored* value, const Sum* gradient, MomentOf<Stored>* first, MomentOf<Stored>* second, int32_t pitch,
               int64_t begin, int64_t end, const AdamSettings<Real>& adam) {
  const int64_t tile = int64_t(kTileVoxels) * pitch, from = begin * tile, to = end * tile;
  with_degree(pitch, [&](auto degree) {
    constexpr int kPitch = Record<decltype(degree)::value>::kPitch;
    if constexpr (std::is_same_v<Stored, Real>) {
      for (int64_t record = from; record < to; record += kPitch)
        for (int i = 0; i < kPitch; ++i)
          adam_number(value[record + i], gradient[record + i], first[record + i], second[record + i], adam.rate[i],
                      adam.low[i], adam.high[i], adam);
    } else {
      constexpr int kRow = 16, kPeriod = kPitch < kRow ? kRow : kPitch;
      float rates[kPeriod];
      for (int i = 0; i < kPeriod; ++i) rates[i] = code_rate<Stored>(adam, i % kPitch);
      for (int64_t at = from; at < to; at += kRow)
        adam_codes<kRow>(value, gradient, first, second, at, load<float, kRow>(rates + at % kPeriod), adam);
    }
  });
}

template <class Real>
void soft_hull(const Silhouettes<Real>& silhouettes, const Real* points, int64_t begin, int64_t end, Real* value,
               int32_t* votes) {
  for (int64_t i = begin; i < end; ++i) value[i] = soft_hull_point(silhouettes, points + 3 * i, votes[i]);
}

// One initialiser per kind of table.
template <class Table> struct Filled;
template <class Real> struct Filled<Kernels<Real>> {
  static constexpr Kernels<Real> table{SURFCAP_ISA_NAME,     sample_forward<Real>, sample_backward<Real>,
                                       shade_forward<Real>,  shade_backward<Real>, march_forward<Real>,
                                       march_backward<Real>, reach_of_view<Real>,  gather_gradient<Real>,
                                       soft_hull<Real>,      upscale<Real>};
};
template <class Real, class Stored, class Sum> struct Filled<FitKernels<Real, Stored, Sum>> {
  static constexpr FitKernels<Real, Stored, Sum> table{
      photometric_step<Real, Stored, Sum>, photometric_lattice<Real, Stored>, add_sums<Sum>,
      integration_ranges<Real, Stored>,    visibility<Real, Stored>,          voxel_terms<Real, Stored, Sum>,
      adam_step<Real, Stored, Sum>};
};

}  // namespace SURFCAP_ISA

namespace SURFCAP_ISA {
template <class Table> const Table& kernels() { return Filled<Table>::table; }
#define SURFCAP_KERNELS(...) template const __VA_ARGS__& kernels<__VA_ARGS__>()
SURFCAP_ALL_TABLES(SURFCAP_KERNELS);
}  // namespace SURFCAP_ISA
}  // namespace surfcap
