// upscale: the values of finer tiles, read trilinearly from a coarser field at the fine voxels' centres.
#include "parallel.h"

namespace surfcap {

template <class Real>
Tensor upscale_typed(const Tensor& voxels, const Tensor& table, const std::vector<double>& frame,
                     const Tensor& fine_coordinates, const std::vector<double>& fine_frame) {
  const FieldArgument<Real> coarse(voxels, table, frame);
  const Input<int32_t> places("fine_coordinates", fine_coordinates, {kAny, 3});
  Field<Real> fine = field_view<Real>(coarse.voxels, coarse.table, fine_frame);  // only its frame is read
  const int64_t tiles = fine_coordinates.size(0);
  const Tensor out = torch::stable::new_empty(voxels, {tiles, kTileSide, kTileSide, kTileSide, coarse.view.pitch});
  Real* const values = out.template mutable_data_ptr<Real>();
  advise_large_pages(values, out.numel() * int64_t(sizeof(Real)));
  parallel_ranges(tiles, 16, [&](int64_t begin, int64_t end) {
    best_kernels<Real>().upscale(coarse.view, fine, places.data(), begin, end, values);
  });
  return out;
}

Tensor upscale(Tensor voxels, Tensor table, std::vector<double> frame, Tensor fine_coordinates,
               std::vector<double> fine_frame) {
  return SURFCAP_BY_TYPE(voxels, upscale_typed, voxels, table, frame, fine_coordinates, fine_frame);
}

STABLE_TORCH_LIBRARY_IMPL(torch_surfcap, CPU, m) { m.impl("upscale", TORCH_BOX(&upscale)); }

}  // namespace surfcap
