// Inside of the CUDA rasterizer: gradients of entries summed up by their owners and taken through colour and
// projection. One thread owns a row, for all images and in their order.
#pragma once

#include "gsim3d/raster/raster_blend_vjp.cuh"

namespace gsim3d::raster {

constexpr int kViewmatParts = 16;  // blocks that share the rows of an image

// Sums of a pair's slots, over all groups that had some of them; false when it has none. All lanes of a warp take part:
// a lane sums up few slots alone, one after the other; many are shared by the warp, in a fixed tree.
template <typename T>
__device__ bool sum_slots(const Job<T>& job, const Group& group, int64_t row, const PixelRect& bounds,
                          uint32_t slot_begin, const Slots<T>& slots, SlotSums<T>& sums, T* features) {
  constexpr int kAtOnce = 4, kAlone = 32;
  const bool seen = bounds.x0 < bounds.x1;
  const int n = seen ? group.n_slots(squares_of(bounds, kTile), squares_of(bounds, kQuarter)) : 0;
  const int lane = threadIdx.x % kWarp;
  const int64_t n_features = slots.n_columns;
  const unsigned char* live = slots.live + slot_begin;
  bool any = seen && group.resumed;
  sums = any ? slots.unfinished[row] : SlotSums<T>{};
  for (int i = 0; i < n && n <= kAlone; i += kAtOnce) {
    bool used[kAtOnce];
    SlotSums<T> some[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) used[k] = i + k < n && live[i + k];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) some[k] = used[k] ? slots.sums[int64_t{slot_begin} + i + k] : SlotSums<T>{};
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      any |= used[k];
      for (int c = 0; c < kSlotValues; ++c) sums.value[c] += some[k].value[c];
      for (int64_t c = 0; used[k] && features && c < n_features; ++c)
        features[c] += slots.features[(int64_t{slot_begin} + i + k) * n_features + c];
    }
  }
  for (unsigned owners = __ballot_sync(kFullWarp, n > kAlone); owners; owners &= owners - 1) {
    const int owner = __ffs(owners) - 1, n_shared = __shfl_sync(kFullWarp, n, owner);
    const int64_t begin = __shfl_sync(kFullWarp, slot_begin, owner);
    SlotSums<T> part{};
    bool some = false;
    for (int i = lane; i < n_shared; i += kWarp) {
      if (!slots.live[begin + i]) continue;
      some = true;
      const SlotSums<T> slot = slots.sums[begin + i];
      for (int c = 0; c < kSlotValues; ++c) part.value[c] += slot.value[c];
    }
    for (int step = kWarp / 2; step > 0; step /= 2)
      for (int c = 0; c < kSlotValues; ++c) part.value[c] += __shfl_xor_sync(kFullWarp, part.value[c], step);
    some = __any_sync(kFullWarp, some);
    if (lane == owner) {
      any |= some;
      for (int c = 0; c < kSlotValues; ++c) sums.value[c] += part.value[c];
    }
    T* const to = reinterpret_cast<T*>(__shfl_sync(kFullWarp, reinterpret_cast<unsigned long long>(features), owner));
    for (int64_t c = lane; to && some && c < n_features; c += kWarp)
      for (int i = 0; i < n_shared; ++i)
        if (slots.live[begin + i]) to[c] += slots.features[(begin + i) * n_features + c];
  }
  return seen && (any || !group.finished);
}

// Gradients of one row but its colour, summed over images one after the other. Those of the exponent and the axes
// become gradients of opacity, quaternion and scale at the end.
template <typename T>
struct RowGrad {
  T mean[3], quat[4], scale[3], opacity;
  T exponent;  // alpha = opacity e^exponent
  T axes[9];

  __device__ void load(const RasterSceneGrads<T>& from, int64_t row) {
    for (int i = 0; i < 3; ++i) mean[i] = from.means[3 * row + i], scale[i] = from.scales[3 * row + i];
    for (int i = 0; i < 4; ++i) quat[i] = from.quats[4 * row + i];
    opacity = from.opacities[row];
  }
  __device__ void finish(const Gaussian<T>& gaussian) {
    T grad_quat[4], grad_scale[3];
    axes_vjp(gaussian.axes, gaussian.scale, axes, grad_quat, grad_scale);
    for (int i = 0; i < 4; ++i) quat[i] += grad_quat[i];
    for (int i = 0; i < 3; ++i) scale[i] += grad_scale[i];
    opacity += exponent / gaussian.opacity;
  }
  __device__ void store(const RasterSceneGrads<T>& to, int64_t row) const {
    for (int i = 0; i < 3; ++i) to.means[3 * row + i] = mean[i], to.scales[3 * row + i] = scale[i];
    for (int i = 0; i < 4; ++i) to.quats[4 * row + i] = quat[i];
    to.opacities[row] = opacity;
  }
};

// The same of a row that is projected already, and that one image shows.
template <typename T>
struct FlatGrad {
  T mean[2], conic[3], depth, opacity;

  __device__ void load(const RasterSceneGrads<T>& from, int64_t row) {
    for (int i = 0; i < 2; ++i) mean[i] = from.means2d[2 * row + i];
    for (int i = 0; i < 3; ++i) conic[i] = from.conics[3 * row + i];
    depth = from.depths[row], opacity = from.opacities[row];
  }
  __device__ void finish(const FlatGaussian<T>&) {}
  __device__ void store(const RasterSceneGrads<T>& to, int64_t row) const {
    for (int i = 0; i < 2; ++i) to.means2d[2 * row + i] = mean[i];
    for (int i = 0; i < 3; ++i) to.conics[3 * row + i] = conic[i];
    to.depths[row] = depth, to.opacities[row] = opacity;
  }
};

template <typename T, int kTerms>
using RowGradOf = std::conditional_t<kTerms == kProjected, FlatGrad<T>, RowGrad<T>>;

template <typename T, int kTerms>
__device__ void project_vjp_of(const Camera<T>&, const FlatGaussian<T>& gaussian, const T*, const SlotSums<T>& slot,
                               FlatGrad<T>& row, T* grad_color, T (&)[12]) {
  const T *sums = slot.value, *conic = gaussian.conic;
  T grad_mean[2], grad_conic[3];
  conic_vjp(footprint_of_conic(conic[0], conic[1], conic[2]), Moments<T>{sums[0], sums[1], sums[2], sums[3], sums[4]},
            grad_mean, grad_conic);
  for (int i = 0; i < 2; ++i) row.mean[i] += grad_mean[i];
  for (int i = 0; i < 3; ++i) row.conic[i] += grad_conic[i], grad_color[i] += sums[6 + i];
  row.opacity += sums[5] / gaussian.opacity;
  row.depth += sums[9];
}

// Adds the gradients of a row in one image to `row`, `grad_color` (unless null) and `viewmat`.
template <typename T, int kTerms>
__device__ void project_vjp_of(const Camera<T>& camera, const Gaussian<T>& gaussian, const T* coefficients,
                               const SlotSums<T>& slot, RowGrad<T>& row, T* grad_color, T (&viewmat)[12]) {
  const T* sums = slot.value;
  const Projection<T> p = project(camera, gaussian.mean, gaussian.axes);
  ProjectionGrad<T> grad{};
  footprint_vjp(footprint_of(p.xy, p.yy, p.determinant), Moments<T>{sums[0], sums[1], sums[2], sums[3], sums[4]}, grad);
  grad.z = sums[9];
  row.exponent += sums[5];
  if constexpr (kTerms > 0) {
    const Direction<T> direction = view_direction(camera, p.point);
    T basis[kTerms], grad_basis[kTerms], grad_coefficients[kTerms * 3], color[3], grad_unit[3];
    sh_basis<kTerms>(direction.unit, basis);
    sh_color<kTerms>(basis, coefficients, color);
    sh_color_vjp<kTerms>(basis, coefficients, color, sums + 6, grad_basis, grad_coefficients);
    for (int i = 0; i < kTerms * 3 && grad_color; ++i) grad_color[i] += grad_coefficients[i];
    if constexpr (kTerms > 1) {
      sh_basis_vjp<kTerms>(direction.unit, grad_basis, grad_unit);
      view_direction_vjp(camera, p.point, direction, grad_unit, grad.point, viewmat);
    }
  } else {
    for (int c = 0; c < 3 && grad_color; ++c) grad_color[c] += sums[6 + c];
  }
  T grad_mean[3], grad_axes[9];
  project_vjp(camera, gaussian.mean, gaussian.axes, p, grad, grad_mean, grad_axes, viewmat);
  for (int i = 0; i < 3; ++i) row.mean[i] += grad_mean[i];
  for (int i = 0; i < 9; ++i) row.axes[i] += grad_axes[i];
}

// Writes the gradients of the rows in the first group, and adds to them in later ones. `memory`: SharedRows of the
// colours and of their gradients.
template <typename T, int kTerms>
__device__ void gather_rows(const Job<T>& job, const Slots<T>& slots, const RasterSceneGrads<T>& grads,
                            unsigned char* memory) {
  const RasterScene<T>& s = job.scene;
  const Group group = *job.group;
  const bool is_first = group.tile_begin == 0;
  constexpr int kColumns = kColorColumns<kTerms>;
  const SharedRows<T, kColumns> colors(memory), grad_colors(memory + SharedRows<T, kColumns>::kBytes);
  if (!group.rows_are_good) {
    const RowGradOf<T, kTerms> none{};
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
    const GaussianOf<T, kTerms> gaussian(s, row);
    RowGradOf<T, kTerms> grad{};
    T* grad_color = grad_colors.mine();
    if (is_first)
      for (int i = 0; i < kColumns; ++i) grad_color[i] = 0;
    else
      grad.load(grads, row), grad_colors.load(grads.color + rows.begin * kColumns, rows.count);
    // What tells where an image's slots are is fetched while the image before is in work.
    int64_t next = rows.first_image;
    bool shown = false;
    PixelRect next_bounds{};
    uint32_t next_slot = 0;
    const auto fetch = [&] {
      if (next >= group.last || !rows.inside) return;
      const int64_t pair = job.pair_begin[next] + row - job.views[next].row_begin;
      next_bounds = job.bounds[pair], next_slot = job.slot_begin[pair];
    };
    fetch();
    while (next < group.last) {
      const View<T>& view = job.views[next];
      const PixelRect bounds = next_bounds;
      const uint32_t slot_begin = bounds.x0 < bounds.x1 ? next_slot : 0;
      next = view.next;
      fetch();
      SlotSums<T> sums;
      T viewmat[12] = {};
      T* const features = grads.features + row * slots.n_columns;
      if (!sum_slots(job, group, row, bounds, slot_begin, slots, sums, features)) continue;
      if (group.finished)
        project_vjp_of<T, kTerms>(view.camera, gaussian, colors.mine(), sums, grad, grad_color, viewmat), shown = true;
      else
        slots.unfinished[row] = sums;
    }
    if (shown) grad.finish(gaussian);
    if (rows.inside) grad.store(grads, row);
    grad_colors.store(grads.color + rows.begin * kColumns, rows.count);
  }
}

// Sum over the threads of a block, in a fixed order; for thread 0.
template <typename T, int kValues>
__device__ void reduce_block(T (&values)[kValues], T (&shared)[kWarp][kValues]) {
  for (int i = 0; i < kValues; ++i)
    for (int step = kWarp / 2; step > 0; step /= 2) values[i] += __shfl_down_sync(kFullWarp, values[i], step);
  __syncthreads();
  if (threadIdx.x % kWarp == 0)
    for (int i = 0; i < kValues; ++i) shared[threadIdx.x / kWarp][i] = values[i];
  __syncthreads();
  if (threadIdx.x == 0)
    for (int i = 0; i < kValues; ++i)
      for (int w = 1; w < static_cast<int>(blockDim.x) / kWarp; ++w) values[i] += shared[w][i];
}

// Gradients of the viewmats of the images that the group completes, one part of the rows a block.
template <typename T, int kTerms>
__device__ void gather_viewmats(const Job<T>& job, const Slots<T>& slots) {
  __shared__ T shared[kWarp][12];
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
    for (int64_t begin = view.row_begin + task % kViewmatParts * kBlock; begin < view.row_end;
         begin += kViewmatParts * kBlock) {
      const int64_t row = begin + threadIdx.x, pair = first_pair + row - view.row_begin;
      PixelRect bounds{};
      if (row < view.row_end) bounds = job.bounds[pair];
      const uint32_t slot_begin = bounds.x0 < bounds.x1 ? job.slot_begin[pair] : 0;
      SlotSums<T> sums;
      if (!sum_slots<T>(job, group, row, bounds, slot_begin, slots, sums, nullptr)) continue;
      RowGrad<T> unused{};
      project_vjp_of<T, kTerms>(view.camera, Gaussian<T>(s, row), s.color + row * kColumns, sums, unused,
                                static_cast<T*>(nullptr), viewmat);
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
  __shared__ T shared[kWarp][3];
  if (!job.group->finished) return;
  for (int64_t image = job.group->first + blockIdx.x; image < job.group->last; image += gridDim.x) {
    T sums[3] = {};
    const int64_t n = job.n_tiles * kQuarters;
    for (int64_t i = threadIdx.x; i < n; i += blockDim.x)
      for (int c = 0; c < 3; ++c) sums[c] += slots.backgrounds[3 * (image * n + i) + c];
    reduce_block(sums, shared);
    if (threadIdx.x == 0 && grads.background)
      for (int c = 0; c < 3; ++c)
        grads.background[3 * image + c] = usable(job.scene.background[3 * image + c]) ? sums[c] : T(0);
    if (slots.viewmats == nullptr || threadIdx.x >= 16) continue;
    T sum = 0;
    for (int part = 0; part < kViewmatParts && threadIdx.x < 12; ++part)
      sum += slots.viewmats[12 * (image * kViewmatParts + part) + threadIdx.x];
    grads.viewmats[16 * image + threadIdx.x] = sum;
  }
}

}  // namespace gsim3d::raster
