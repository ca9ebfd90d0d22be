// Inside of the CUDA rasterizer: gradients of entries summed up by their owners and taken through colour and
// projection. One thread owns a row, for all images and in their order.
#pragma once

#include "gsim3d/raster/raster_blend_vjp.cuh"

namespace gsim3d::raster {

constexpr int kViewmatParts = 16;  // blocks that share the rows of an image

// Sums of a pair's slots in their order, over all groups that had some of them; false when it has none.
template <typename T>
__device__ bool sum_slots(const Job<T>& job, const Group& group, int64_t row, const PixelRect& bounds,
                          int64_t slot_begin, const Slots<T>& slots, SlotSums<T>& sums, T* features) {
  if (bounds.x0 >= bounds.x1) return false;
  const int n = group.n_slots(squares_of(bounds, kTile), squares_of(bounds, kQuarter));
  const int64_t n_features = features ? job.scene.n_features : 0;
  bool any = group.resumed;
  sums = group.resumed ? slots.unfinished[row] : SlotSums<T>{};
  constexpr int kAtOnce = 4;
  for (int i = 0; i < n; i += kAtOnce) {
    bool live[kAtOnce];
    SlotSums<T> some[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) live[k] = i + k < n && slots.live[slot_begin + i + k];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) some[k] = live[k] ? slots.sums[slot_begin + i + k] : SlotSums<T>{};
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      any |= live[k];
      for (int c = 0; c < kSlotValues; ++c) sums.value[c] += some[k].value[c];
      for (int64_t c = 0; live[k] && c < n_features; ++c)
        features[c] += slots.features[(slot_begin + i + k) * n_features + c];
    }
  }
  return any || !group.finished;
}

// Gradients of one row, summed over images one after the other.
template <typename T, int kColumns>
struct RowGrad {
  T mean[3], quat[4], scale[3], opacity, color[kColumns];

  __device__ void load(const RasterSceneGrads<T>& from, int64_t row) {
    for (int i = 0; i < 3; ++i) mean[i] = from.means[3 * row + i], scale[i] = from.scales[3 * row + i];
    for (int i = 0; i < 4; ++i) quat[i] = from.quats[4 * row + i];
    opacity = from.opacities[row];
    for (int i = 0; i < kColumns; ++i) color[i] = from.color[row * kColumns + i];
  }
  __device__ void store(const RasterSceneGrads<T>& to, int64_t row) const {
    for (int i = 0; i < 3; ++i) to.means[3 * row + i] = mean[i], to.scales[3 * row + i] = scale[i];
    for (int i = 0; i < 4; ++i) to.quats[4 * row + i] = quat[i];
    to.opacities[row] = opacity;
  }
};

// Adds the gradients of a row in one image; `viewmat` is added to.
template <typename T, int kTerms, int kColumns>
__device__ void project_vjp_of(const Camera<T>& camera, const Gaussian<T>& gaussian, const T* coefficients,
                               const SlotSums<T>& slot, RowGrad<T, kColumns>& row, T (&viewmat)[12]) {
  const T* sums = slot.value;
  const Projection<T> p = project(camera, gaussian.mean, gaussian.quat, gaussian.scale);
  ProjectionGrad<T> grad{};
  footprint_vjp(footprint_of(p.xy, p.yy, p.determinant), Moments<T>{sums[0], sums[1], sums[2], sums[3], sums[4]}, grad);
  grad.z = sums[9];
  // alpha = opacity e^exponent: its gradient is that of the exponent over the opacity.
  row.opacity += sums[5] / gaussian.opacity;
  if constexpr (kTerms > 0) {
    const Direction<T> direction = view_direction(camera, p.point);
    T basis[kTerms], grad_basis[kTerms], grad_coefficients[kTerms * 3], color[3], grad_unit[3];
    sh_basis<kTerms>(direction.unit, basis);
    sh_color<kTerms>(basis, coefficients, color);
    sh_color_vjp<kTerms>(basis, coefficients, color, sums + 6, grad_basis, grad_coefficients);
    for (int i = 0; i < kColumns; ++i) row.color[i] += grad_coefficients[i];
    if constexpr (kTerms > 1) {
      sh_basis_vjp<kTerms>(direction.unit, grad_basis, grad_unit);
      view_direction_vjp(camera, p.point, direction, grad_unit, grad.point, viewmat);
    }
  } else {
    for (int c = 0; c < 3; ++c) row.color[c] += sums[6 + c];
  }
  T grad_mean[3], grad_quat[4], grad_scale[3];
  project_vjp(camera, gaussian.mean, gaussian.scale, p, grad, grad_mean, grad_quat, grad_scale, viewmat);
  for (int i = 0; i < 3; ++i) row.mean[i] += grad_mean[i], row.scale[i] += grad_scale[i];
  for (int i = 0; i < 4; ++i) row.quat[i] += grad_quat[i];
}

// Writes the gradients of the rows in the first group, and adds to them in later ones. `memory`: SharedRows of the
// colours.
template <typename T, int kTerms>
__device__ void gather_rows(const Job<T>& job, const Slots<T>& slots, const RasterSceneGrads<T>& grads,
                            unsigned char* memory) {
  const RasterScene<T>& s = job.scene;
  const Group group = *job.group;
  const bool is_first = group.tile_begin == 0;
  constexpr int kColumns = kColorColumns<kTerms>;
  const SharedRows<T, kColumns> colors(memory);
  if (!group.rows_are_good) {
    const RowGrad<T, kColumns> none{};
    for (int64_t row = int64_t{blockIdx.x} * kBlock + threadIdx.x; row < s.n_rows; row += int64_t{gridDim.x} * kBlock) {
      none.store(grads, row);
      for (int i = 0; i < kColumns; ++i) grads.color[row * kColumns + i] = 0;
    }
    return;
  }
  const int64_t n_chunks = count_chunks(job);
  for (int64_t chunk = blockIdx.x; chunk < n_chunks; chunk += gridDim.x) {
    const Rows rows(job, chunk);
    if (rows.first_image >= group.last && !is_first) continue;
    colors.load(s.color + rows.begin * kColumns, rows.count);
    const int64_t row = rows.inside ? rows.row : rows.begin;
    const Gaussian<T> gaussian(s, row);
    RowGrad<T, kColumns> grad{};
    if (!is_first) grad.load(grads, row);
    // What tells where an image's slots are is fetched while the image before is in work.
    int64_t next = rows.inside ? rows.first_image : kNoImage;
    PixelRect next_bounds{};
    uint32_t next_slot = 0;
    const auto fetch = [&] {
      if (next >= group.last) return;
      const int64_t pair = job.pair_begin[next] + row - job.views[next].row_begin;
      next_bounds = job.bounds[pair], next_slot = job.slot_begin[pair];
    };
    fetch();
    while (next < group.last) {
      const View<T>& view = job.views[next];
      const PixelRect bounds = next_bounds;
      const uint32_t slot_begin = next_slot;
      next = view.next;
      fetch();
      SlotSums<T> sums;
      T viewmat[12] = {};
      if (!sum_slots(job, group, row, bounds, slot_begin, slots, sums, grads.features + row * s.n_features)) continue;
      if (group.finished)
        project_vjp_of<T, kTerms>(view.camera, gaussian, colors.mine(), sums, grad, viewmat);
      else
        slots.unfinished[row] = sums;
    }
    if (rows.inside) grad.store(grads, row);
    for (int i = 0; i < kColumns; ++i) colors.mine()[i] = grad.color[i];
    colors.store(grads.color + rows.begin * kColumns, rows.count);
  }
}

// Sum over the threads of a block, in a fixed order; for thread 0.
template <typename T, int kValues>
__device__ void reduce_block(T (&values)[kValues], T (&shared)[kWarps][kValues]) {
  for (int i = 0; i < kValues; ++i)
    for (int step = kWarp / 2; step > 0; step /= 2) values[i] += __shfl_down_sync(kFullWarp, values[i], step);
  __syncthreads();
  if (threadIdx.x % kWarp == 0)
    for (int i = 0; i < kValues; ++i) shared[threadIdx.x / kWarp][i] = values[i];
  __syncthreads();
  if (threadIdx.x == 0)
    for (int i = 0; i < kValues; ++i)
      for (int w = 1; w < kWarps; ++w) values[i] += shared[w][i];
}

// Gradients of the viewmats of the images that the group completes, one part of the rows a block.
template <typename T, int kTerms>
__device__ void gather_viewmats(const Job<T>& job, const Slots<T>& slots) {
  __shared__ T shared[kWarps][12];
  const RasterScene<T>& s = job.scene;
  const Group group = *job.group;
  if (!group.finished) return;
  constexpr int kColumns = kTerms > 0 ? kTerms * 3 : 3;
  const int64_t end = group.last * kViewmatParts;
  for (int64_t task = group.first * kViewmatParts + blockIdx.x; task < end; task += gridDim.x) {
    const int64_t image = task / kViewmatParts;
    const View<T>& view = job.views[image];
    const int64_t first_pair = job.pair_begin[image];
    T viewmat[12] = {};
    for (int64_t row = view.row_begin + (task % kViewmatParts) * kBlock + threadIdx.x; row < view.row_end;
         row += kViewmatParts * kBlock) {
      const int64_t pair = first_pair + row - view.row_begin;
      SlotSums<T> sums;
      if (!sum_slots<T>(job, group, row, job.bounds[pair], job.slot_begin[pair], slots, sums, nullptr)) continue;
      RowGrad<T, kColumns> unused{};
      project_vjp_of<T, kTerms>(view.camera, Gaussian<T>(s, row), s.color + row * kColumns, sums, unused, viewmat);
    }
    reduce_block(viewmat, shared);
    if (threadIdx.x == 0)
      for (int i = 0; i < 12; ++i) slots.viewmats[12 * task + i] = viewmat[i];
  }
}

// Gradients that belong to images: of the background from the parts of the tiles, of the viewmats from those of the
// rows.
template <typename T>
__device__ void gather_images(const Job<T>& job, const Slots<T>& slots, const RasterSceneGrads<T>& grads) {
  __shared__ T shared[kWarps][3];
  if (!job.group->finished) return;
  for (int64_t image = job.group->first + blockIdx.x; image < job.group->last; image += gridDim.x) {
    T sums[3] = {};
    const int64_t n = job.n_tiles * kQuarters;
    for (int64_t i = threadIdx.x; i < n; i += kBlock)
      for (int c = 0; c < 3; ++c) sums[c] += slots.backgrounds[3 * (image * n + i) + c];
    reduce_block(sums, shared);
    if (threadIdx.x == 0)
      for (int c = 0; c < 3; ++c)
        grads.background[3 * image + c] = isfinite(job.scene.background[3 * image + c]) ? sums[c] : T(0);
    if (slots.viewmats == nullptr || threadIdx.x >= 16) continue;
    T sum = 0;
    for (int part = 0; part < kViewmatParts && threadIdx.x < 12; ++part)
      sum += slots.viewmats[12 * (image * kViewmatParts + part) + threadIdx.x];
    grads.viewmats[16 * image + threadIdx.x] = sum;
  }
}

}  // namespace gsim3d::raster
