// From tensors to the views of core/views.h. Every check names the argument, what was expected and what came.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "core/views.h"

namespace surfcap {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using Shape = std::initializer_list<int64_t>;

// What a tensor holds is looked at here only where that costs next to nothing: on a device it would stop the host until
// the device has caught up. There the caller (TileGrid.check, gather_rays, ...) vouches for it.
inline bool on_host(const Tensor& t) {
#if defined(SURFCAP_CUDA_EMULATION)
  return false;
#else
  return t.is_cpu();
#endif
}

constexpr int64_t kAny = -1;  // a size that any number satisfies
constexpr int64_t kTileSide = 4, kVoxelsPerTile = 64;

inline std::string shape_of(const Tensor& t) {
  std::string text = "[";
  for (int64_t i = 0; i < t.dim(); ++i) text += (i ? ", " : "") + std::to_string(t.size(i));
  return text + "]";
}

inline void check_shape(const char* name, const Tensor& t, Shape expected) {
  bool fits = t.dim() == int64_t(expected.size());
  std::string text;
  int64_t i = 0;
  for (int64_t size : expected) {
    fits = fits && (size == kAny || t.size(i) == size);
    text += (i++ ? ", " : "") + (size == kAny ? std::string("*") : std::to_string(size));
  }
  STD_TORCH_CHECK(fits, name, ": expected shape [", text, "], got ", shape_of(t));
}

template <class Number> struct TypeOf;
template <> struct TypeOf<float> {
  static constexpr auto value = ScalarType::Float;
  static constexpr const char* name = "float32";
};
template <> struct TypeOf<double> {
  static constexpr auto value = ScalarType::Double;
  static constexpr const char* name = "float64";
};
template <> struct TypeOf<int32_t> {
  static constexpr auto value = ScalarType::Int;
  static constexpr const char* name = "int32";
};
template <> struct TypeOf<int64_t> {
  static constexpr auto value = ScalarType::Long;
  static constexpr const char* name = "int64";
};
template <> struct TypeOf<uint8_t> {
  static constexpr auto value = ScalarType::Byte;
  static constexpr const char* name = "uint8";
};
template <> struct TypeOf<uint16_t> {
  static constexpr auto value = ScalarType::UInt16;
  static constexpr const char* name = "uint16";
};
template <> struct TypeOf<Half> {
  static constexpr auto value = ScalarType::Half;
  static constexpr const char* name = "float16";
};

// Tensors with their names, "a, b, c": what a device is made from, to check that all of a call's are on it.
#define SURFCAP_NAMED(...) \
  #__VA_ARGS__, { __VA_ARGS__ }

// A contiguous tensor of the right type, kept alive as long as the pointer is used.
template <class Number> class Input {
 public:
  Input(const char* name, const Tensor& t, Shape shape)
      : tensor_(t.is_contiguous() ? t : torch::stable::contiguous(t)) {
    check_shape(name, t, shape);
    STD_TORCH_CHECK(t.scalar_type() == TypeOf<Number>::value, name, ": expected ", TypeOf<Number>::name,
                    ", as the other arguments are, got another type");
  }
  const Number* data() const { return static_cast<const Number*>(tensor_.const_data_ptr()); }
  const Tensor& tensor() const { return tensor_; }

 private:
  Tensor tensor_;
};

// A device reads and writes records in vectors: their memory must begin where one can.
inline void check_aligned(const char* name, const Tensor& t) {
  constexpr uintptr_t kVector = 16;
  STD_TORCH_CHECK(on_host(t) || reinterpret_cast<uintptr_t>(t.const_data_ptr()) % kVector == 0, name,
                  ": expected memory that begins at a multiple of ", kVector, " bytes, got a view into a record");
}

// A tensor that an op writes into: no copy may stand between.
template <class Number> Number* output(const char* name, const Tensor& t, Shape shape) {
  check_shape(name, t, shape);
  STD_TORCH_CHECK(t.scalar_type() == TypeOf<Number>::value, name, ": expected ", TypeOf<Number>::name);
  STD_TORCH_CHECK(t.is_contiguous(), name, ": is written in place and must be contiguous");
  check_aligned(name, t);
  return static_cast<Number*>(t.mutable_data_ptr());
}

// frame = [origin x, y, z, voxel size, opacity value outside, inside]
template <class Real, class Stored>
Field<Real, Stored> field_view(const Input<Stored>& voxels, const Input<int32_t>& table,
                               const std::vector<double>& frame) {
  STD_TORCH_CHECK(frame.size() == 6, "frame: expected [origin x, y, z, voxel size, outside, inside], got ",
                  frame.size(), " numbers");
  STD_TORCH_CHECK(frame[3] > 0, "frame: expected a positive voxel size, got ", frame[3]);
  const int64_t pitch = voxels.tensor().size(4);
  STD_TORCH_CHECK(pitch == 4 || pitch == 16 || pitch == 32,
                  "voxels: expected 4, 16 or 32 numbers per voxel (SH degree 0, 1, 2, padded), got ", pitch);
  STD_TORCH_CHECK(voxels.tensor().size(0) < (int64_t(1) << 31) / kVoxelsPerTile,
                  "voxels: expected fewer than 33554432 tiles, got ", voxels.tensor().size(0));
  check_aligned("voxels", voxels.tensor());
  Field<Real, Stored> field;
  field.voxels = voxels.data();
  field.table = table.data();
  for (int i = 0; i < 3; ++i) {
    STD_TORCH_CHECK(table.tensor().size(i) >= 2, "table: expected at least 2 tiles a side, got ",
                    shape_of(table.tensor()));
    field.n[i] = int32_t(table.tensor().size(i));
    field.origin[i] = Real(frame[i]);
  }
  field.per_unit = Real(1.0 / frame[3]);
  field.missing[0] = Real(frame[4]);
  field.missing[1] = Real(frame[5]);
  field.tiles = voxels.tensor().size(0);
  field.pitch = int32_t(pitch);
  return field;
}

template <class Real, class Stored = Real> struct FieldArgument {
  Input<Stored> voxels;
  Input<int32_t> table;
  Field<Real, Stored> view;

  FieldArgument(const Tensor& v, const Tensor& t, const std::vector<double>& frame)
      : voxels("voxels", v, {kAny, kTileSide, kTileSide, kTileSide, kAny}),
        table("table", t, {kAny, kAny, kAny}),
        view(field_view<Real>(voxels, table, frame)) {
    if (!on_host(t)) return;
    // An index beyond the tiles would read foreign memory; one pass over the table costs little beside any op.
    const auto [least, most] = std::minmax_element(table.data(), table.data() + t.numel());
    STD_TORCH_CHECK(*most < view.tiles && *least > -(1 << 20), "table: expected entries from ", -(1 << 20),
                    " to the number of tiles, ", view.tiles, ", got ", *least, " to ", *most);
  }
};

template <class Real> struct RaysArgument {
  Input<Real> origins, directions, shift, background;
  Rays<Real> view;

  RaysArgument(const Tensor& o, const Tensor& d, const Tensor& s, const Tensor& b)
      : origins("origins", o, {kAny, 3}),
        directions("directions", d, {o.size(0), 3}),
        shift("shift", s, {o.size(0)}),
        background("background", b, {o.size(0), 3}),
        view{origins.data(), directions.data(), shift.data(), background.data(), o.size(0), nullptr, nullptr, 1} {}
};

// What rays see, in fresh tensors.
template <class Real> struct NewRendering {
  Tensor color, transmittance, depth;
  Rendering<Real> view;

  NewRendering(const Tensor& like, int64_t rays)
      : color(torch::stable::new_empty(like, {rays, 3})),
        transmittance(torch::stable::new_empty(like, {rays})),
        depth(torch::stable::new_empty(like, {rays})),
        view{color.template mutable_data_ptr<Real>(), transmittance.template mutable_data_ptr<Real>(),
             depth.template mutable_data_ptr<Real>()} {}
};

// The integration ranges of rays, where the caller has them.
template <class Real> struct RangesArgument {
  std::optional<Input<int64_t>> offsets;
  std::optional<Input<Real>> ranges;

  RangesArgument(const std::optional<Tensor>& o, const std::optional<Tensor>& r, int64_t bundle, Rays<Real>& rays) {
    STD_TORCH_CHECK(bundle >= 1, "bundle: expected at least 1 ray, got ", bundle);
    STD_TORCH_CHECK(o.has_value() == r.has_value(), "range_offsets, ranges: expected both or neither");
    if (!o) return;
    const int64_t lists = (rays.count + bundle - 1) / bundle;
    offsets.emplace("range_offsets", *o, Shape{lists + 1});
    ranges.emplace("ranges", *r, Shape{kAny, 2});
    if (on_host(*o)) {
      const int64_t *const begin = offsets->data(), *const end = begin + lists;
      STD_TORCH_CHECK(*end == r->size(0), "range_offsets: expected to end with ", r->size(0),
                      ", the number of ranges, got ", *end);
      STD_TORCH_CHECK(*begin == 0 && std::is_sorted(begin, end + 1),
                      "range_offsets: expected numbers that begin with 0 and do not fall");
    }
    rays.range_offsets = offsets->data();
    rays.ranges = ranges->data();
    rays.bundle = bundle;
  }
};

template <class Real> RaySettings<Real> ray_settings(int64_t opacity, double slope, double step, double stop) {
  STD_TORCH_CHECK(opacity == 0 || opacity == 1, "opacity: expected 0 (transparency) or 1 (distance), got ", opacity);
  STD_TORCH_CHECK(step > 0, "step: expected a positive length, got ", step);
  return {Real(step), Real(stop), Real(slope), int32_t(opacity)};
}

// Everything that the photometric loss of many rays is computed from.
template <class Real, class Stored> struct PhotometricArgument {
  FieldArgument<Real, Stored> field;
  RaysArgument<Real> rays;
  RangesArgument<Real> stretches;
  RaySettings<Real> settings;
  Input<Real> target, mask, weight;
  Observation<Real> seen;
  PhotometricSettings<Real> loss;

  PhotometricArgument(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                      const Tensor& origins, const Tensor& directions, const Tensor& shift, const Tensor& background,
                      const Tensor& photograph, const Tensor& silhouette, const Tensor& importance,
                      const std::optional<Tensor>& range_offsets, const std::optional<Tensor>& ranges, int64_t bundle,
                      int64_t opacity, double slope, double step, double stop, double huber,
                      const std::vector<double>& weights, bool detach_sample, bool rendered_sample)
      : field(voxels, table, frame),
        rays(origins, directions, shift, background),
        stretches(range_offsets, ranges, bundle, rays.view),
        settings(ray_settings<Real>(opacity, slope, step, stop)),
        target("target", photograph, {rays.view.count, 3}),
        mask("mask", silhouette, {rays.view.count}),
        weight("weight", importance, {rays.view.count}),
        seen{target.data(), mask.data(), weight.data()} {
    STD_TORCH_CHECK(weights.size() == 3, "weights: expected [photo, sample, mask], got ", weights.size(), " numbers");
    loss = {Real(huber), Real(weights[0]), Real(weights[1]), Real(weights[2]), detach_sample, rendered_sample};
  }
};

// The places of the field's tiles in its table.
inline Input<int32_t> tile_places(const Tensor& coordinates, int64_t tiles, const int32_t (&n)[3]) {
  Input<int32_t> places("coordinates", coordinates, {tiles, 3});
  for (int64_t i = 0; on_host(coordinates) && i < 3 * tiles; ++i)
    STD_TORCH_CHECK(places.data()[i] > 0 && places.data()[i] < n[i % 3] - 1,
                    "coordinates: expected every tile inside the table's border");
  return places;
}

// The layout of slots, for `rays` rays or, where these are told by it, kAny.
template <class Real> struct SlotRowsArgument {
  Input<int64_t> starts;
  Input<int32_t> first;
  bool narrow;
  SlotRows<Real> view;

  SlotRowsArgument(const Tensor& s, const Tensor& f, int64_t exponent, const Tensor& slots, int64_t rays)
      : starts("starts", s, {rays == kAny ? f.size(0) + 1 : rays + 1}),
        first("first", f, {rays}),
        narrow(slots.scalar_type() == ScalarType::Byte),
        view{starts.data(), first.data(), Real(std::ldexp(1.0, int(exponent)))} {
    const int64_t* const end = starts.data() + starts.tensor().size(0);
    check_shape("slots", slots, {kAny, 4});
    STD_TORCH_CHECK(narrow || slots.scalar_type() == TypeOf<Real>::value, "slots: expected uint8 or ",
                    TypeOf<Real>::name);
    STD_TORCH_CHECK(slots.is_contiguous(), "slots: expected contiguous memory");
    check_aligned("slots", slots);
    STD_TORCH_CHECK(exponent >= -100 && exponent <= 100, "exponent: expected -100 to 100, got ", exponent);
    if (!on_host(slots)) return;
    STD_TORCH_CHECK(*starts.data() == 0 && end[-1] == slots.size(0) && std::is_sorted(starts.data(), end),
                    "starts: expected numbers that begin with 0, do not fall and end with the number of slots, ",
                    slots.size(0));
  }
};

// Runs f(Real(0)), Real being float or double, by the type of `t`.
template <class F> auto by_real(const Tensor& t, const F& f) {
  return t.scalar_type() == ScalarType::Double ? f(0.0) : f(0.0f);
}

// Runs f(types) by how a field is stored and gradients are summed: numbers of 32 or 64 bits in their own type, codes of
// 8 and 16 bits computed with in float.
template <class R, class St, class Su> struct FitTypes {
  using Real = R;
  using Stored = St;
  using Sum = Su;
};
template <class F> auto by_storage(const Tensor& voxels, ScalarType sums, const F& f) {
  const bool half = sums == ScalarType::Half;
  switch (voxels.scalar_type()) {
    case ScalarType::Double:
      return f(FitTypes<double, double, double>{});
    case ScalarType::Byte:
      return half ? f(FitTypes<float, uint8_t, Half>{}) : f(FitTypes<float, uint8_t, float>{});
    case ScalarType::UInt16:
      return half ? f(FitTypes<float, uint16_t, Half>{}) : f(FitTypes<float, uint16_t, float>{});
    default:
      return f(FitTypes<float, float, float>{});
  }
}

}  // namespace surfcap
