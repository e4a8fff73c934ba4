// photometric_step and photometric_lattice on CUDA: a team of threads to a ray. Memory rule: the step adds atomically
// to the first partial gradient, whose order of sums is left to chance; the lattice writes each ray's own row.
#include "../drivers/photometric.h"

#include "../core/slots.h"
#include "sums.cuh"
#include "walk.cuh"

namespace surfcap {
namespace {

template <class Walking, class Real, class Sum>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    step_rays(const __grid_constant__ Walking walking, Observation<Real> seen, PhotometricSettings<Real> loss,
              Rendering<Real> out, double* rows, Sum* gradient) {
  double losses[3] = {};
  walking.for_each_ray([&](const auto& walk, const auto&, int64_t i) {
    const auto sink = walk.to_voxels(gradient);
    photometric_ray(walk.ray, walking.rays, seen, loss, i, losses, out, walk.back(sink));
  });
  sum_teams(losses, rows);
}

template <class Walking, class Real, class Slot>
__global__ void __launch_bounds__(kThreads, Walking::kResident)
    lattice_rays(const __grid_constant__ Walking walking, Observation<Real> seen, PhotometricSettings<Real> loss,
                 Rendering<Real> out, double* rows, SlotRows<Real> slot_rows, Slot* slots) {
  double losses[3] = {};
  walking.for_each_ray([&](const auto& walk, const auto& reader, int64_t i) {
    const SlotRow<Real, Slot> row(slot_rows, slots, i);
    for (int64_t n = reader.team.lane; n < row.count; n += kTeam)
      store_slot<Real>(row.row + 4 * n, zero_pack<Real, 4>());
    reader.team.sync();
    const auto sink = [&](int, const auto& sample, const Pack<Real, 4>& g) {
      if (reader.team.lane == 0) row.put(sample.k, g);
    };
    photometric_ray(walk.ray, walking.rays, seen, loss, i, losses, out, walk.back(sink));
  });
  sum_teams(losses, rows);
}

struct Cuda : Gpu {
  using Gpu::Gpu;

  template <class Real, class Stored, class Sum>
  void photometric_step(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                        const Observation<Real>& seen, const PhotometricSettings<Real>& loss,
                        const Rendering<Real>& out, const Tensor& losses, int64_t, Sum* gradients) const {
    clear(gradients, field.tiles * kVoxelsPerTile * field.pitch);
    const auto kernel = [](const auto& walking) { return step_rays<std::decay_t<decltype(walking)>, Real, Sum>; };
    with_walking(*this, losses, field, rays, settings, kernel, [&](const auto& walking, int64_t blocks) {
      const BlockSums<3> sums(*this, losses, blocks);
      launch("photometric_step", kernel(walking), blocks, kThreads, walking, seen, loss, out, sums.rows(), gradients);
      sums.total(losses);
    });
  }

  template <class Real, class Stored>
  void photometric_lattice(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                           const Observation<Real>& seen, const PhotometricSettings<Real>& loss,
                           const Rendering<Real>& out, const Tensor& losses, const SlotRows<Real>& rows, bool narrow,
                           void* slots) const {
    with_slots<Real>(narrow, slots, [&]<class Slot>(const Slot*) {
      const auto kernel = [](const auto& walking) { return lattice_rays<std::decay_t<decltype(walking)>, Real, Slot>; };
      with_walking(*this, losses, field, rays, settings, kernel, [&](const auto& walking, int64_t blocks) {
        const BlockSums<3> sums(*this, losses, blocks);
        launch("photometric_lattice", kernel(walking), blocks, kThreads, walking, seen, loss, out, sums.rows(), rows,
               static_cast<Slot*>(slots));
        sums.total(losses);
      });
    });
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, SURFCAP_GPU, m) {
  m.impl("photometric_step", TORCH_BOX(&photometric_step<Cuda>));
  m.impl("photometric_lattice", TORCH_BOX(&photometric_lattice<Cuda>));
}

}  // namespace surfcap
