// The two entry points: checks, groups of images, and the gradient of the projection.
#include <algorithm>
#include <cmath>

#include "gsim3d/raster/raster_check.h"
#include "gsim3d/raster/raster_tiles.h"

namespace gsim3d::raster {

constexpr const char* kOp = "rasterize_gaussians";

template <typename T>
void check_scene(const RasterScene<T>& s) {
  check_options(s);
  check(s.cu_rows[0] == 0 && s.cu_rows[s.n_clouds] == s.n_rows, kOp, ": cu_rows must run from 0 to N=", s.n_rows,
        "; got ", s.cu_rows[0], " .. ", s.cu_rows[s.n_clouds]);
  for (int64_t q = 0; q < s.n_clouds; ++q) {
    check(s.cu_rows[q] <= s.cu_rows[q + 1], kOp, ": cu_rows must not descend; got ", s.cu_rows[q], " then ",
          s.cu_rows[q + 1], " at ", q);
    check(s.cu_rows[q + 1] - s.cu_rows[q] <= INT32_MAX, kOp, ": a cloud must have fewer than 2^31 rows; cloud ", q);
  }
  for (int64_t i = 0; i < s.n_images; ++i) {
    check(s.image_cloud[i] >= 0 && s.image_cloud[i] < s.n_clouds, kOp,
          ": image_cloud must be in [0, Q) with Q=", s.n_clouds, "; got ", s.image_cloud[i], " for image ", i);
    for (int c = 0; c < 3; ++c)
      check(usable(s.background[3 * i + c]), kOp, ": background must be finite and at most 1e15; got ",
            s.background[3 * i + c], " for image ", i);
    if (s.sh_terms == kProjected) continue;
    for (int j = 0; j < 12; ++j)
      check(usable(s.viewmats[16 * i + j]), kOp, ": viewmats must be finite and at most 1e15; got ",
            s.viewmats[16 * i + j], " for image ", i);
    const T* K = s.Ks + 9 * i;
    for (int j = 0; j < 9; ++j)
      check(usable(K[j]), kOp, ": Ks must be finite and at most 1e15; got ", K[j], " for image ", i);
    check(K[0] > 0 && K[4] > 0, kOp, ": focal lengths in Ks must be positive; got ", K[0], " and ", K[4],
          " for image ", i);
    check(K[3] == 0 && K[6] == 0 && K[7] == 0 && K[8] == 1, kOp,
          ": Ks must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]; got another pattern for image ", i);
  }
}

template <typename T>
void clear_grads(const RasterScene<T>& scene, const RasterSceneGrads<T>& grads) {
  const int64_t n = scene.n_rows, n_columns = grads.feature_columns(scene.n_features);
  if (scene.sh_terms == kProjected) {
    std::fill_n(grads.means2d, n * 2, T(0));
    std::fill_n(grads.conics, n * 3, T(0));
    std::fill_n(grads.depths, n, T(0));
  } else {
    std::fill_n(grads.means, n * 3, T(0));
    std::fill_n(grads.quats, n * 4, T(0));
    std::fill_n(grads.scales, n * 3, T(0));
  }
  std::fill_n(grads.opacities, n, T(0));
  std::fill_n(grads.color, n * std::max<int64_t>(1, scene.sh_terms) * 3, T(0));
  std::fill_n(grads.features, n * n_columns, T(0));
  if (grads.background) std::fill_n(grads.background, scene.n_images * 3, T(0));
  if (grads.viewmats) std::fill_n(grads.viewmats, scene.n_images * 16, T(0));
}

#define GSIM3D_INSTANTIATE(T)                     \
  template void check_scene(const RasterScene<T>&); \
  template void clear_grads(const RasterScene<T>&, const RasterSceneGrads<T>&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::raster

namespace gsim3d::cpu {
namespace {

using namespace raster;  // NOLINT: this file is its other half

// Adds lanes [0, n) of `value` to column `column` of the listed rows.
template <typename T>
void scatter_add(Simd<T> value, const int64_t* rows, int n, int64_t width, int64_t column, T* matrix) {
  for (int lane = 0; lane < n; ++lane) matrix[rows[lane] * width + column] += value[lane];
}

// Sums the slots of a chunk's splats and takes them through colour and projection; viewmat gradients go to
// `grad_viewmat`.
template <typename T, int kTerms>
void project_chunk_vjp(const RasterScene<T>& scene, const Group<T>& group, const Chunk& chunk, const T* slots,
                       const RasterSceneGrads<T>& grads, T grad_viewmat[12]) {
  using V = Simd<T>;
  const Camera<T>& camera = group.cameras[chunk.image - group.first];
  const int64_t slot_width = kSlotFixed + scene.n_features;
  V viewmat_sums[12] = {};
  for_row_blocks<T>(chunk.begin, chunk.end, [&](const int64_t* rows, int n) {
    alignas(32) T sums[kSlotFixed][kLanes<T>] = {};
    // Rows with a gradient; where there is none, another that has: a bad row's numbers stay out.
    int64_t seen[kLanes<T>];
    std::fill_n(seen, kLanes<T>, int64_t{-1});
    int64_t any_seen = -1;
    for (int lane = 0; lane < n; ++lane) {
      const int64_t pair = chunk.pair + rows[lane] - chunk.begin;
      for (int64_t i = group.pair_begin[pair]; i < group.pair_begin[pair + 1]; ++i) {
        const T* slot = slots + group.positions[i] * slot_width;
        for (int c = 0; c < kSlotFixed; ++c) sums[c][lane] += slot[c];
        for (int64_t c = 0; c < scene.n_features; ++c)
          grads.features[rows[lane] * scene.n_features + c] += slot[kSlotFixed + c];
        seen[lane] = any_seen = rows[lane];
      }
    }
    if (any_seen < 0) return;
    std::replace(seen, seen + kLanes<T>, int64_t{-1}, any_seen);
    V sum[kSlotFixed];
    for (int c = 0; c < kSlotFixed; ++c) sum[c] = load<V>(sums[c]);

    V mean[3], quat[4], scale[3];
    for (int i = 0; i < 3; ++i) mean[i] = gather(scene.means, seen, 3, i);
    for (int i = 0; i < 4; ++i) quat[i] = gather(scene.quats, seen, 4, i);
    for (int i = 0; i < 3; ++i) scale[i] = gather(scene.scales, seen, 3, i);
    const V opacity = gather(scene.opacities, seen, 1, 0);
    const Axes<V> axes = axes_of(quat, scale);
    const Projection<V> p = project(camera, mean, axes);
    ProjectionGrad<V> grad{};
    footprint_vjp(footprint_of(p.xy, p.yy, p.determinant), Moments<V>{sum[0], sum[1], sum[2], sum[3], sum[4]}, grad);
    grad.z = sum[9];
    // alpha = opacity e^exponent: its gradient is that of the exponent over the opacity.
    scatter_add<T>(sum[5] / opacity, rows, n, 1, 0, grads.opacities);

    if constexpr (kTerms > 0) {
      V coefficients[kTerms * 3], grad_coefficients[kTerms * 3], color[3];
      V basis[kTerms], grad_basis[kTerms];
      for (int i = 0; i < kTerms * 3; ++i) coefficients[i] = gather(scene.color, seen, kTerms * 3, i);
      const auto through_color = [&](const V direction[3]) {
        sh_basis<kTerms>(direction, basis);
        sh_color<kTerms>(basis, coefficients, color);
        sh_color_vjp<kTerms>(basis, coefficients, color, sum + 6, grad_basis, grad_coefficients);
      };
      if constexpr (kTerms > 1) {
        const Direction<V> direction = view_direction(camera, p.point);
        V grad_unit[3];
        through_color(direction.unit);
        sh_basis_vjp<kTerms>(direction.unit, grad_basis, grad_unit);
        view_direction_vjp(camera, p.point, direction, grad_unit, grad.point, viewmat_sums);
      } else {
        through_color(mean);  // the constant, whatever the direction
      }
      for (int i = 0; i < kTerms * 3; ++i) scatter_add<T>(grad_coefficients[i], rows, n, kTerms * 3, i, grads.color);
    } else {
      for (int c = 0; c < 3; ++c) scatter_add<T>(sum[6 + c], rows, n, 3, c, grads.color);
    }
    V grad_mean[3], grad_axes[9], grad_quat[4], grad_scale[3];
    project_vjp(camera, mean, axes, p, grad, grad_mean, grad_axes, viewmat_sums);
    axes_vjp(axes, scale, grad_axes, grad_quat, grad_scale);
    for (int i = 0; i < 3; ++i) scatter_add<T>(grad_mean[i], rows, n, 3, i, grads.means);
    for (int i = 0; i < 4; ++i) scatter_add<T>(grad_quat[i], rows, n, 4, i, grads.quats);
    for (int i = 0; i < 3; ++i) scatter_add<T>(grad_scale[i], rows, n, 3, i, grads.scales);
  });
  for (int i = 0; i < 12; ++i) grad_viewmat[i] = sum_lanes(viewmat_sums[i]);
}

// The same of rows that are projected already.
template <typename T>
void read_chunk_vjp(const RasterScene<T>& scene, const Group<T>& group, const Chunk& chunk, const T* slots,
                    const RasterSceneGrads<T>& grads) {
  const int64_t n_columns = grads.feature_columns(scene.n_features), slot_width = kSlotFixed + n_columns;
  for (int64_t row = chunk.begin; row < chunk.end; ++row) {
    const int64_t pair = chunk.pair + row - chunk.begin;
    if (group.pair_begin[pair] == group.pair_begin[pair + 1]) continue;
    T sum[kSlotFixed] = {};
    for (int64_t i = group.pair_begin[pair]; i < group.pair_begin[pair + 1]; ++i) {
      const T* slot = slots + group.positions[i] * slot_width;
      for (int c = 0; c < kSlotFixed; ++c) sum[c] += slot[c];
      for (int64_t c = 0; c < n_columns; ++c) grads.features[row * n_columns + c] += slot[kSlotFixed + c];
    }
    const T* conic = scene.conics + 3 * row;
    conic_vjp(footprint_of_conic(conic[0], conic[1], conic[2]), Moments<T>{sum[0], sum[1], sum[2], sum[3], sum[4]},
              grads.means2d + 2 * row, grads.conics + 3 * row);
    grads.opacities[row] = sum[5] / scene.opacities[row];
    for (int c = 0; c < 3; ++c) grads.color[3 * row + c] = sum[6 + c];
    grads.depths[row] = sum[9];
  }
}

// Runs of rows of one cloud: their chunks in all images of the group, in order of images. One task owns the rows'
// gradients.
template <typename T>
std::vector<std::vector<int64_t>> chunks_by_rows(const RasterScene<T>& scene, const Group<T>& group) {
  std::vector<std::vector<int64_t>> tasks;
  std::vector<int64_t> first_task(static_cast<size_t>(scene.n_clouds), -1);
  for (int64_t image = group.first; image < group.last; ++image) {
    const int64_t begin = group.image_chunk[image - group.first], end = group.image_chunk[image - group.first + 1];
    int64_t& task = first_task[scene.image_cloud[image]];
    if (task < 0) {
      task = static_cast<int64_t>(tasks.size());
      tasks.resize(tasks.size() + end - begin);
    }
    for (int64_t c = begin; c < end; ++c) tasks[task + c - begin].push_back(c);
  }
  return tasks;
}

}  // namespace

template <typename T>
void raster_forward(const RasterScene<T>& scene, const RasterImages<T>& images, const Workspace& workspace,
                    const Parallel& parallel) {
  check_scene(scene);
  Scratch scratch(workspace);
  Group<T> group;
  while (next_group(scene, false, scratch, parallel, group)) {
    blend_group(scene, group, images, parallel);
    for (int64_t image = group.first; image < group.last && images.unusable; ++image) {
      const Unusable& unusable = group.unusable[image - group.first];
      images.unusable[2 * image] = unusable.count, images.unusable[2 * image + 1] = unusable.first;
    }
  }
}

template <typename T>
void raster_backward(const RasterScene<T>& scene, const RasterImageGrads<T>& image_grads,
                     const RasterSceneGrads<T>& grads, const Workspace& workspace, const Parallel& parallel) {
  check_scene(scene);
  clear_grads(scene, grads);
  const int64_t n_columns = grads.feature_columns(scene.n_features);
  Scratch scratch(workspace);
  Group<T> group;
  while (next_group(scene, true, scratch, parallel, group)) {
    T* slots = scratch.take<T>(kSlots, group.n_instances * (kSlotFixed + n_columns));
    T* tile_background = scratch.take<T>(kBackground, (group.last - group.first) * group.n_tiles() * 3);
    blend_group_vjp(scene, group, image_grads, slots, tile_background, grads.background, grads.absolute, parallel);

    T* viewmats = scratch.take<T>(kViewmats, static_cast<int64_t>(group.chunks.size()) * 12);
    const auto tasks = chunks_by_rows(scene, group);
    parallel.chunks(static_cast<int64_t>(tasks.size()), [&](int64_t task) {
      for (int64_t c : tasks[task])
        dispatch_sh(scene.sh_terms, [&](auto terms) {
          constexpr int kTerms = decltype(terms)::value;
          if constexpr (kTerms == kProjected)
            read_chunk_vjp(scene, group, group.chunks[c], slots, grads);
          else
            project_chunk_vjp<T, kTerms>(scene, group, group.chunks[c], slots, grads, viewmats + 12 * c);
        });
    });
    for (size_t c = 0; c < group.chunks.size() && grads.viewmats; ++c)
      for (int i = 0; i < 12; ++i) grads.viewmats[16 * group.chunks[c].image + i] += viewmats[12 * c + i];
  }
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template void raster_forward<T>(const RasterScene<T>&, const RasterImages<T>&, const Workspace&, const Parallel&);  \
  template void raster_backward<T>(const RasterScene<T>&, const RasterImageGrads<T>&, const RasterSceneGrads<T>&,     \
                                   const Workspace&, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
