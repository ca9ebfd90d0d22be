// Derivatives of the rasterizer along a direction: of its images, and of its gradients. The formulas of raster_math.h
// on numbers that carry their derivative; pixel by pixel, so it is for second derivatives and forward mode, not for
// speed.
#include <algorithm>
#include <cmath>
#include <vector>

#include "gsim3d/raster/raster_check.h"
#include "gsim3d/raster/raster_jet.h"
#include "gsim3d/raster/raster_tiles.h"

namespace gsim3d::cpu {
namespace {

using namespace raster;  // NOLINT: this is its other half

template <typename T>
Dual<T> exponential(const Dual<T>& x) {
  Dual<T> out(std::exp(x.value));
  out.along[0] = out.value * x.along[0];
  return out;
}

// What a tile needs of one row in one image.
template <typename T>
struct DualSplat {
  Dual<T> x, y, z, slope, tight, loose, opacity, color[3];
};

template <typename T>
struct DualCall {
  const RasterScene<T>& scene;
  const RasterTangents<T>& tangents;
  const RasterImageGrads<T>& grads;
  const RasterImages<T>& images;
  const bool with_grads;
  std::vector<Dual<T>> slots;        // [n_instances, kSlotFixed + n_features]
  std::vector<DualSplat<T>> splats;  // [n_pairs]
};

// Row in all clouds, splat and bounds of the entries of a tile, in order of depth.
template <typename T>
struct DualEntry {
  int64_t row, instance;
  const DualSplat<T>* splat;
  PixelRect bounds;
};

template <typename T>
std::vector<DualEntry<T>> entries_of(const DualCall<T>& call, const Group<T>& group, int64_t task, int64_t image) {
  const int64_t begin = group.tile_begin[task], end = group.tile_begin[task + 1];
  std::vector<int64_t> order(static_cast<size_t>(end - begin));
  for (int64_t i = begin; i < end; ++i) order[i - begin] = i;
  std::stable_sort(order.begin(), order.end(),
                   [&](int64_t a, int64_t b) { return group.instances[a].key < group.instances[b].key; });
  const int64_t first_pair = group.image_pair[image - group.first];
  const int64_t first_row = call.scene.cu_rows[call.scene.image_cloud[image]];
  std::vector<DualEntry<T>> entries;
  for (int64_t i : order) {
    const int64_t row = group.instances[i].row;
    entries.push_back({first_row + row, i, &call.splats[first_pair + row], group.splats[first_pair + row].bounds});
  }
  return entries;
}

// Both passes over one pixel; `background_grad` is added to.
template <typename T>
void blend_pixel(DualCall<T>& call, const std::vector<DualEntry<T>>& entries, int64_t image, int64_t x, int64_t y,
                 Dual<T> background_grad[3]) {
  using D = Dual<T>;
  const RasterScene<T>& s = call.scene;
  const RasterTangents<T>& t = call.tangents;
  const int64_t n_features = s.n_features, pixel = (image * s.height + y) * s.width + x;
  const bool fades = s.cutoff == RasterCutoff::kSmooth;
  const auto value_of = [&](const DualEntry<T>& entry, int64_t c) {
    if (c < 4) return c < 3 ? entry.splat->color[c] : entry.splat->z;
    return dual(s.features, t.features, entry.row * n_features + c - 4);
  };
  struct Seen {
    int64_t entry;
    D u, dy, alpha, slope;  // slope: of alpha along the exponent
  };
  std::vector<Seen> seen;
  std::vector<D> sums(static_cast<size_t>(4 + n_features));
  D light(T(1));
  for (size_t k = 0; k < entries.size(); ++k) {
    const PixelRect& bounds = entries[k].bounds;
    if (x < bounds.x0 || x >= bounds.x1 || y < bounds.y0 || y >= bounds.y1) continue;
    const DualSplat<T>& splat = *entries[k].splat;
    const D dy = D(T(y) + T(0.5)) - splat.y, u = D(T(x) + T(0.5)) - splat.x - splat.slope * dy;
    const D raw = splat.opacity * exponential(D(T(-0.5)) * (splat.tight * u * u + splat.loose * dy * dy));
    D alpha = min_of(raw, D(kMaxAlpha)), slope = raw.value <= T(kMaxAlpha) ? raw : D(T(0));
    if (fades) slope = slope * fade_slope(alpha), alpha = fade(alpha);
    if (alpha.value < (fades ? T(0) : T(kMinAlpha))) continue;
    const D weight = alpha * light, rest = light - weight;
    if (rest.value < T(kMinTransmittance)) break;
    for (int64_t c = 0; c < 4 + n_features; ++c) sums[c] += weight * value_of(entries[k], c);
    light = rest;
    seen.push_back({static_cast<int64_t>(k), u, dy, alpha, slope});
  }
  D background[3];
  for (int c = 0; c < 3; ++c) {
    background[c] = dual(s.background, t.background, 3 * image + c);
    call.images.color[3 * pixel + c] = (sums[c] + light * background[c]).along[0];
  }
  call.images.alpha[pixel] = -light.along[0], call.images.depth[pixel] = sums[3].along[0];
  for (int64_t c = 0; c < n_features; ++c) call.images.features[pixel * n_features + c] = sums[4 + c].along[0];
  if (!call.with_grads) return;

  // As blend_tile_vjp of raster_blend_cpu.cpp.
  const RasterImageGrads<T>& grads = call.grads;
  const auto grad_of = [&](int64_t c) {
    return c < 3 ? grads.color[3 * pixel + c] : c < 4 ? grads.depth[pixel] : grads.features[pixel * n_features + c - 4];
  };
  D behind = light * D(-grads.alpha[pixel]);
  for (int c = 0; c < 3; ++c) {
    behind += light * background[c] * D(grad_of(c));
    background_grad[c] += light * D(grad_of(c));
  }
  for (auto at = seen.rbegin(); at != seen.rend(); ++at) {
    const DualEntry<T>& entry = entries[at->entry];
    D* slot = call.slots.data() + entry.instance * (kSlotFixed + n_features);
    const D inverse = D(T(1)) / (D(T(1)) - at->alpha), weight = at->alpha * light * inverse;
    light = light * inverse;
    D total(T(0));
    for (int64_t c = 0; c < 4 + n_features; ++c) {
      total += value_of(entry, c) * D(grad_of(c));
      slot[6 + c] += weight * D(grad_of(c));
    }
    const D v = (light * total - behind * inverse) * at->slope;
    behind += weight * total;
    slot[0] += v * at->u, slot[1] += v * at->dy, slot[2] += v * at->u * at->u, slot[3] += v * at->u * at->dy;
    slot[4] += v * at->dy * at->dy, slot[5] += v;
  }
}

// As project_chunk_vjp of raster_cpu.cpp.
template <typename T, int kTerms>
void gather_row(const DualCall<T>& call, const Group<T>& group, const Camera<Dual<T>>& camera, int64_t pair,
                int64_t row, const RasterSceneGrads<T>& grads, Dual<T> viewmat[12]) {
  using D = Dual<T>;
  const int64_t n_features = call.scene.n_features;
  if (group.pair_begin[pair] == group.pair_begin[pair + 1]) return;
  std::vector<D> sum(static_cast<size_t>(kSlotFixed + n_features));
  for (int64_t i = group.pair_begin[pair]; i < group.pair_begin[pair + 1]; ++i)
    for (int64_t c = 0; c < kSlotFixed + n_features; ++c)
      sum[c] += call.slots[group.positions[i] * (kSlotFixed + n_features) + c];
  const DualRow<T, kTerms> of(call.scene, call.tangents, camera, row);
  ProjectionGrad<D> grad{};
  footprint_vjp(of.shape, Moments<D>{sum[0], sum[1], sum[2], sum[3], sum[4]}, grad);
  grad.z = sum[9];
  const auto add = [](T* to, int64_t at, const D& value) { to[at] += value.along[0]; };
  add(grads.opacities, row, sum[5] / of.opacity);
  if constexpr (kTerms > 0) {
    D grad_basis[kTerms], grad_coefficients[kTerms * 3], grad_unit[3];
    sh_color_vjp<kTerms>(of.basis, of.coefficients, of.color, sum.data() + 6, grad_basis, grad_coefficients);
    if constexpr (kTerms > 1) {
      sh_basis_vjp<kTerms>(of.direction.unit, grad_basis, grad_unit);
      view_direction_vjp(camera, of.projection.point, of.direction, grad_unit, grad.point, viewmat);
    }
    for (int i = 0; i < kTerms * 3; ++i) add(grads.color, row * kTerms * 3 + i, grad_coefficients[i]);
  } else {
    for (int c = 0; c < 3; ++c) add(grads.color, 3 * row + c, sum[6 + c]);
  }
  D grad_mean[3], grad_axes[9], grad_quat[4], grad_scale[3];
  project_vjp(camera, of.mean, of.axes, of.projection, grad, grad_mean, grad_axes, viewmat);
  axes_vjp(of.axes, of.scale, grad_axes, grad_quat, grad_scale);
  for (int i = 0; i < 3; ++i) add(grads.means, 3 * row + i, grad_mean[i]);
  for (int i = 0; i < 3; ++i) add(grads.scales, 3 * row + i, grad_scale[i]);
  for (int i = 0; i < 4; ++i) add(grads.quats, 4 * row + i, grad_quat[i]);
  for (int64_t c = 0; c < n_features; ++c) add(grads.features, row * n_features + c, sum[kSlotFixed + c]);
}

template <typename T, int kTerms>
void one_group(DualCall<T>& call, const Group<T>& group, const RasterSceneGrads<T>* grads, const Parallel& parallel) {
  using D = Dual<T>;
  const RasterScene<T>& s = call.scene;
  const auto n_chunks = static_cast<int64_t>(group.chunks.size());
  parallel.chunks(n_chunks, [&](int64_t c) {
    const Chunk& chunk = group.chunks[c];
    const Camera<D> camera = dual_camera(s, call.tangents, chunk.image);
    for (int64_t row = chunk.begin; row < chunk.end; ++row) {
      const int64_t pair = chunk.pair + row - chunk.begin;
      if (group.splats[pair].bounds.x0 >= group.splats[pair].bounds.x1) continue;
      const DualRow<T, kTerms> of(s, call.tangents, camera, row);
      const Projection<D>& p = of.projection;
      call.splats[pair] = {p.x, p.y, p.z, of.shape.slope, of.shape.tight, of.shape.loose, of.opacity,
                           {of.color[0], of.color[1], of.color[2]}};
    }
  });
  const int64_t n_tiles = group.n_tiles(), n_tasks = (group.last - group.first) * n_tiles;
  std::vector<D> backgrounds(static_cast<size_t>(n_tasks * 3));
  parallel.chunks(n_tasks, [&](int64_t task) {
    const int64_t image = group.first + task / n_tiles, tile = task % n_tiles;
    const int64_t x0 = tile % group.tiles_x * kTile, y0 = tile / group.tiles_x * kTile;
    const auto entries = entries_of(call, group, task, image);
    for (int64_t y = y0; y < std::min(s.height, y0 + kTile); ++y)
      for (int64_t x = x0; x < std::min(s.width, x0 + kTile); ++x)
        blend_pixel(call, entries, image, x, y, backgrounds.data() + 3 * task);
  });
  if (!grads) return;
  for (int64_t task = 0; task < n_tasks; ++task)
    for (int c = 0; c < 3; ++c)
      grads->background[3 * (group.first + task / n_tiles) + c] += backgrounds[3 * task + c].along[0];
  for (const Chunk& chunk : group.chunks) {  // one after the other: images add to the same rows
    D viewmat[12] = {};
    const Camera<D> camera = dual_camera(s, call.tangents, chunk.image);
    for (int64_t row = chunk.begin; row < chunk.end; ++row)
      gather_row<T, kTerms>(call, group, camera, chunk.pair + row - chunk.begin, row, *grads, viewmat);
    for (int i = 0; i < 12; ++i) grads->viewmats[16 * chunk.image + i] += viewmat[i].along[0];
  }
}

}  // namespace

template <typename T>
void raster_tangent(const RasterScene<T>& scene, const RasterTangents<T>& tangents,
                    const RasterImageGrads<T>& image_grads, const RasterImages<T>& images,
                    const RasterSceneGrads<T>* grads, const Workspace& workspace, const Parallel& parallel) {
  check_scene(scene);
  if (grads) clear_grads(scene, *grads);
  Scratch scratch(workspace);
  Group<T> group;
  while (next_group(scene, true, scratch, parallel, group)) {
    DualCall<T> call{scene, tangents, image_grads, images, grads != nullptr, {}, {}};
    call.splats.resize(static_cast<size_t>(group.n_pairs()));
    if (grads) call.slots.resize(static_cast<size_t>(group.n_instances * (kSlotFixed + scene.n_features)));
    dispatch_sh(scene.sh_terms, [&](auto terms) {
      constexpr int kTerms = decltype(terms)::value;
      if constexpr (kTerms >= 0) one_group<T, kTerms>(call, group, grads, parallel);
    });
  }
}

#define GSIM3D_INSTANTIATE(T)                                                                                   \
  template void raster_tangent<T>(const RasterScene<T>&, const RasterTangents<T>&, const RasterImageGrads<T>&,  \
                                  const RasterImages<T>&, const RasterSceneGrads<T>*, const Workspace&,         \
                                  const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
