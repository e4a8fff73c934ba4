// photometric_step and photometric_lattice on the CPU. The losses are sums over a fixed number of groups of rays, so
// that they do not depend on the threads.
#include "../drivers/photometric.h"

#include "parallel.h"

namespace surfcap {
namespace {

// Sums of the three losses per group of rays.
class GroupedLosses {
 public:
  explicit GroupedLosses(int64_t groups) : sums_(3 * groups, 0.0) {}
  double* of(int64_t group) { return sums_.data() + 3 * group; }
  void add_to(const Tensor& losses) const {
    double* const total = losses.template mutable_data_ptr<double>();
    for (size_t i = 0; i < sums_.size(); ++i) total[i % 3] += sums_[i];
  }

 private:
  std::vector<double> sums_;
};

struct Cpu : Host {
  using Host::Host;

  template <class Real, class Stored, class Sum>
  void photometric_step(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                        const Observation<Real>& seen, const PhotometricSettings<Real>& loss,
                        const Rendering<Real>& out, const Tensor& losses, int64_t groups, Sum* gradients) const {
    const int64_t size = field.tiles * kVoxelsPerTile * field.pitch;
    advise_large_pages(gradients, groups * size * int64_t(sizeof(Sum)));
    const auto& kernels = fit_kernels<FitTypes<Real, Stored, Sum>>();
    GroupedLosses sums(groups);
    const auto chunk = [&](int64_t begin, int64_t end, Sum* buffer, int64_t group) {
      kernels.photometric_step(field, rays, settings, seen, loss, begin, end, sums.of(group), out, buffer);
    };
    grouped(rays.count, groups, size, gradients, gradients + size, chunk, kernels.add_sums);
    sums.add_to(losses);
  }

  template <class Real, class Stored>
  void photometric_lattice(const Field<Real, Stored>& field, const Rays<Real>& rays, const RaySettings<Real>& settings,
                           const Observation<Real>& seen, const PhotometricSettings<Real>& loss,
                           const Rendering<Real>& out, const Tensor& losses, const SlotRows<Real>& rows, bool narrow,
                           void* slots) const {
    // Every ray owns its row, so the rays need neither atomics nor buffers of their own.
    constexpr int64_t kLossGroups = 64;
    GroupedLosses sums(kLossGroups);
    const auto& kernels = fit_kernels<FitTypes<Real, Stored, Real>>();
    const auto chunk = [&](int64_t begin, int64_t end, Real*, int64_t group) {
      kernels.photometric_lattice(field, rays, settings, seen, loss, rows, narrow, begin, end, sums.of(group), out,
                                  slots);
    };
    const auto nothing = [](Real*, const Real*, int64_t, int64_t) {};
    grouped(rays.count, kLossGroups, 0, static_cast<Real*>(nullptr), static_cast<Real*>(nullptr), chunk, nothing);
    sums.add_to(losses);
  }
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) {
  m.impl("photometric_step", TORCH_BOX(&photometric_step<Cpu>));
  m.impl("photometric_lattice", TORCH_BOX(&photometric_lattice<Cpu>));
}

}  // namespace surfcap
