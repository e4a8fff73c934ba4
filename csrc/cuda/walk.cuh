// A ray on CUDA: a team of threads (see team.cuh) walks it, all of them with the same state, and remembers its samples
// for the walk back.
//
// The grid is as large as the device holds, and its teams go round over the rays, so that the memory for the samples
// depends on the device and the longest ray, and what is in use of it stays in the cache. While the records of a sample
// are on their way, the next sample is found and located.
#pragma once

#include "sums.cuh"
#include "team.cuh"

namespace surfcap {
inline namespace SURFCAP_ISA {

constexpr int64_t kTraceBytes = int64_t(1)
                                << 30;  // memory for samples: where rays are long, fewer of them are in flight
constexpr int kWords = 8;               // numbers that a sample is remembered by

// store_aligned, where the compiler would take the pack apart.
template <class Real> __device__ __forceinline__ void store_once(Real* to, const Pack<Real, 4>& x) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    asm volatile("st.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(to), "f"(x[0]), "f"(x[1]), "f"(x[2]), "f"(x[3]) : "memory");
    return;
  }
#endif
  store_aligned<Real, 4>(to, x);
}

// A ray walked forward; then `ray` is its result and (*this)[i] its i-th sample. Nothing in here points to another part
// of it: all of it is to live in registers.
template <class Real, int Degree, class Opacity, class Stored> class TeamWalk {
  using Reader = TeamField<Real, Degree, Stored>;

 public:
  RayResult<Real> ray;

  // `words` has room for `capacity` samples.
  __device__ __forceinline__ TeamWalk(const Reader& reader, const Field<Real, Stored>& field,
                                      const RaySettings<Real>& settings, const Opacity& opacity, const Rays<Real>& rays,
                                      int64_t i, Real* words, int64_t capacity)
      : reader_(reader),
        opacity_(opacity),
        words_(words),
        lattice_(lattice_of(field, rays, settings.step, i)),
        weights_(reader.weights(rays.directions + 3 * i)) {
    Compositor<Real, Opacity> front(opacity);
    int32_t k = 0;
    typename Reader::Corner corner{};
    bool more = next(k, corner);
    while (more) {
      const typename Reader::Fetched found = reader_.fetch(corner);
      int32_t k_next = 0;
      more = next(k_next, corner);
      Sample<Real, Opacity> sample;
      front.add(reader_.color(found, weights_), k, time_of(k), sample);
      remember(front.ray.samples - 1, sample);
      more = more && !(front.ray.transmittance < settings.stop) && front.ray.samples < capacity;
      k = k_next;
    }
    ray = front.ray;
    reader_.team.sync();
  }

  __device__ __forceinline__ Sample<Real, Opacity> operator[](int i) const {
    const Real* const words = words_ + int64_t(i) * kWords;
    Pack<Real, 4> rest = load_aligned<Real, 4>(words + 4);
    Sample<Real, Opacity> sample;
    sample.color = load_aligned<Real, 4>(words);
    sample.a = rest[0];
    sample.transmittance = rest[1];
    __builtin_memcpy(&sample.now, &rest[2], sizeof(Real));
    __builtin_memcpy(&sample.k, &rest[3], sizeof(sample.k));
    sample.starts_run = sample.k < 0;
    if (sample.starts_run) {
      sample.k = ~sample.k;
      sample.before = opacity_.outside();
    } else {
      const Real before = words[6 - kWords];
      __builtin_memcpy(&sample.before, &before, sizeof(Real));
    }
    sample.t = time_of(sample.k);
    return sample;
  }

  // The corner that this thread has read of the sample with the index k.
  __device__ __forceinline__ typename Reader::Corner corner_of(int32_t k) const {
    Pack<Real, 1> t, u[3];
    lattice_.place(&k, t, u);
    return reader_.locate(u);
  }

  // What rays.h asks to walk back with; `sink(i, sample, g)` as walk_back does.
  template <class Sink> __device__ __forceinline__ auto back(const Sink& sink) const {
    return [this, &sink](Real r_inf, const auto& term) {
      walk_back<Real>(*this, ray.samples, opacity_, r_inf, term, sink);
    };
  }
  // The sink that adds to the voxels.
  template <class Sum> __device__ __forceinline__ auto to_voxels(Sum* gradient) const {
    return [this, gradient](int, const auto& sample, const Pack<Real, 4>& g) {
      reader_.scatter(gradient, corner_of(sample.k), g, weights_);
    };
  }

 private:
  __device__ __forceinline__ bool next(int32_t& k, typename Reader::Corner& corner) {
    if (!lattice_.next(k)) return false;
    corner = corner_of(k);
    return true;
  }
  __device__ __forceinline__ Real time_of(int32_t k) const {
    Pack<Real, 1> t, u[3];
    lattice_.place(&k, t, u);
    return t[0];
  }

  // A sample as (value, r, g, b), then a, T, the opacity's state, and the index k, inverted where a run starts: the
  // team's first two threads write a half each.
  __device__ __forceinline__ void remember(int i, const Sample<Real, Opacity>& sample) const {
    Pack<Real, 4> half = sample.color;
    if (reader_.team.lane == 1) {
      half[0] = sample.a;
      half[1] = sample.transmittance;
      __builtin_memcpy(&half[2], &sample.now, sizeof(Real));
      const int32_t k = sample.starts_run ? ~sample.k : sample.k;
      half[3] = Real(0);
      __builtin_memcpy(&half[3], &k, sizeof(k));
    }
    if (reader_.team.lane < 2) store_once(words_ + i * kWords + 4 * reader_.team.lane, half);
  }

  const Reader& reader_;
  const Opacity& opacity_;
  Real* words_;
  Lattice<Real> lattice_;
  typename Reader::Part weights_;
};

// What every kernel that walks rays is given.
template <class Real, int Degree, class Opacity, class Stored> struct Walking {
  // Blocks to a multiprocessor that the registers must do for: in float 64 or 128 a thread, in double 255.
  static constexpr int kResident = sizeof(Real) != 4 ? 1 : Degree == 0 ? 4 : 2;

  Field<Real, Stored> field;
  Rays<Real> rays;
  RaySettings<Real> settings;
  Opacity opacity;
  Real* words;
  int64_t capacity;

  // Calls f(walk, reader, i) for every ray that falls to this team.
  template <class F> __device__ __forceinline__ void for_each_ray(const F& f) const {
    const TeamField<Real, Degree, Stored> reader(field);
    Real* const mine = words + first_team() * capacity * kWords;
    for (int64_t i = first_team(); i < rays.count; i += team_stride()) {
      const TeamWalk<Real, Degree, Opacity, Stored> walk(reader, field, settings, opacity, rays, i, mine, capacity);
      f(walk, reader, i);
      reader.team.sync();  // before the memory of the samples is another ray's
    }
  }
};

// Calls f(walking, blocks) with what is known of the field as types and room for the samples; kernel(walking) is what
// shall run.
template <class Real, class Stored, class Kernel, class F>
void with_walking(const Gpu& gpu, const Tensor& like, const Field<Real, Stored>& field, const Rays<Real>& rays,
                  const RaySettings<Real>& settings, const Kernel& kernel, const F& f) {
  if (rays.count == 0) return;
  // Odd, so that teams do not stand powers of two apart.
  const int64_t capacity = most_samples(static_cast<const Grid<Real>&>(field), settings.step) | 1;
  const int64_t block_bytes = kTeamsPerBlock * capacity * kWords * int64_t(sizeof(Real));
  with_opacity(settings, [&]<class Opacity>(const Opacity& opacity) {
    with_degree(field.pitch, [&](auto degree) {
      Walking<Real, decltype(degree)::value, Opacity, Stored> walking{field,   rays,    settings,
                                                                      opacity, nullptr, capacity};
      const int64_t needed = (rays.count + kTeamsPerBlock - 1) / kTeamsPerBlock;
      const int64_t room = std::max<int64_t>(1, kTraceBytes / block_bytes);
      const int64_t blocks = std::min({needed, room, gpu.resident(kernel(walking))});
      const Tensor words = torch::stable::new_empty(like, {blocks * block_bytes}, ScalarType::Byte);
      walking.words = static_cast<Real*>(words.mutable_data_ptr());
      f(walking, blocks);
    });
  });
}

// What sum_block does for numbers that all threads of a team hold alike.
template <int N> __device__ void sum_teams(double (&x)[N], double* rows) {
  for (int n = 0; n < N; ++n) x[n] = threadIdx.x % kTeam == 0 ? x[n] : 0.0;
  sum_block(x, rows + int64_t(blockIdx.x) * N);
}

}  // namespace SURFCAP_ISA
}  // namespace surfcap
