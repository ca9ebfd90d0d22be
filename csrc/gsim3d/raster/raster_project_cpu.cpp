// Projection of Gaussians into splats, and the lists of splats of every tile.
#include <algorithm>
#include <cmath>
#include <limits>

#include "gsim3d/raster/raster_check.h"
#include "gsim3d/raster/raster_tiles.h"

namespace gsim3d::raster {
namespace {

// Splats of one group should stay in the caches shared by the cores (64 bytes each in float32).
constexpr int64_t kPairsPerGroup = 1 << 18;
constexpr int64_t kRowsPerChunk = 2048;
// A list of a tile is counted in 32 bits; an image with more is left out.
constexpr int64_t kMaxInstances = std::numeric_limits<int32_t>::max();
// Bounds the memory of groups of several images: at 16 bytes an instance, and 40 more in the backward pass.
constexpr int64_t kInstancesPerGroup = 1 << 26;

bool all_finite(const auto* values, int64_t count) {
  return std::all_of(values, values + count, [](auto value) { return std::isfinite(value); });
}

bool all_usable(const auto* values, int64_t count) {
  return std::all_of(values, values + count, [](auto value) { return usable(value); });
}

// Counts the bad rows of a block; called only when there is one.
template <typename T>
void note_faults(const RasterScene<T>& scene, const int64_t* rows, int n, const Projection<Simd<T>>& p,
                 Unusable& unusable) {
  const int64_t color_width = std::max<int64_t>(1, scene.sh_terms) * 3;
  for (int lane = 0; lane < n; ++lane) {
    const int64_t row = rows[lane];
    const T* scales = scene.scales + row * 3;
    int64_t faults = 0;
    if (!all_usable(scene.means + row * 3, 3)) faults |= kFaultMeans;
    if (!all_finite(scene.quats + row * 4, 4)) faults |= kFaultQuats;
    if (!all_usable(scales, 3) || std::any_of(scales, scales + 3, [](T x) { return x < 0; })) faults |= kFaultScales;
    if (!(scene.opacities[row] >= 0 && scene.opacities[row] <= 1)) faults |= kFaultOpacities;
    if (!all_usable(scene.color + row * color_width, color_width)) faults |= kFaultColor;
    if (!all_usable(scene.features + row * scene.n_features, scene.n_features)) faults |= kFaultFeatures;
    if (!faults && p.z[lane] > scene.near_plane && !std::isfinite(p.determinant[lane])) faults |= kFaultProjection;
    if (!faults) continue;
    if (unusable.count++ == 0) unusable.first = row << kFaultBits | faults;
  }
}

template <typename T, int kTerms>
Unusable project_chunk(const RasterScene<T>& scene, const Camera<T>& camera, const Chunk& chunk, Splat<T>* splats) {
  using V = Simd<T>;
  Unusable unusable;
  const T log2e_half = T(kLog2eHalf);
  for_row_blocks<T>(chunk.begin, chunk.end, [&](const int64_t* rows, int n) {
    V mean[3], quat[4], scale[3];
    for (int i = 0; i < 3; ++i) mean[i] = gather(scene.means, rows, 3, i);
    for (int i = 0; i < 4; ++i) quat[i] = gather(scene.quats, rows, 4, i);
    for (int i = 0; i < 3; ++i) scale[i] = gather(scene.scales, rows, 3, i);
    const V opacity = gather(scene.opacities, rows, 1, 0);
    const Projection<V> p = project(camera, mean, axes_of(quat, scale));
    const auto in_front = p.z > V{} + camera.near_plane;

    constexpr int kColumns = std::max(1, kTerms) * 3;
    V coefficients[kColumns], color[3];
    for (int i = 0; i < kColumns; ++i) coefficients[i] = gather(scene.color, rows, kColumns, i);
    if constexpr (kTerms > 0) {
      V basis[kTerms];
      if constexpr (kTerms > 1) {
        sh_basis<kTerms>(view_direction(camera, p.point).unit, basis);
      } else {
        sh_basis<kTerms>(mean, basis);  // the constant, whatever the direction
      }
      sh_color<kTerms>(basis, coefficients, color);
    } else {
      for (int c = 0; c < 3; ++c) color[c] = coefficients[c];
    }

    auto good = (opacity >= V{}) & (opacity <= V{} + T(1));
    const auto want_usable = [&](V value) { good &= abs_of(value) <= V{} + T(kLargest); };
    for (int i = 0; i < 3; ++i) want_usable(mean[i]), want_usable(scale[i]), good &= scale[i] >= V{};
    // x - x is 0 for a finite x only. Quaternions are scaled before they are squared: any length will do.
    for (int i = 0; i < 4; ++i) good &= quat[i] - quat[i] == V{};
    for (int i = 0; i < kColumns; ++i) want_usable(coefficients[i]);
    for (int64_t i = 0; i < scene.n_features; ++i) want_usable(gather(scene.features, rows, scene.n_features, i));
    good &= (in_front ? p.determinant - p.determinant : V{}) == V{};
    if (any(~good)) note_faults(scene, rows, n, p, unusable);

    const Footprint<V> shape = footprint_of(p.xy, p.yy, p.determinant);
    for (int lane = 0; lane < n; ++lane) {
      Splat<T>& splat = splats[rows[lane] - chunk.begin];
      splat.bounds = {};
      if (!good[lane] || !in_front[lane] || !(opacity[lane] >= T(kMinAlpha))) continue;
      splat.x = p.x[lane], splat.y = p.y[lane], splat.z = p.z[lane];
      splat.slope = shape.slope[lane], splat.tight = shape.tight[lane] * log2e_half;
      splat.loose = shape.loose[lane] * log2e_half;
      splat.opacity = opacity[lane];
      splat.level = level_of(opacity[lane]);
      for (int c = 0; c < 3; ++c) splat.color[c] = color[c][lane];
      splat.bounds = pixel_bounds(splat.x, splat.y, p.xx[lane], p.yy[lane], p.determinant[lane], splat.level,
                                  scene.width, scene.height, scene.cutoff == RasterCutoff::kTile3Sigma);
    }
  });
  return unusable;
}

// Splats of rows that are projected already.
template <typename T>
void read_chunk(const RasterScene<T>& scene, const Chunk& chunk, Splat<T>* splats) {
  const T log2e_half = T(kLog2eHalf);
  for (int64_t row = chunk.begin; row < chunk.end; ++row) {
    Splat<T>& splat = splats[row - chunk.begin];
    splat.bounds = {};
    const T *mean = scene.means2d + 2 * row, *conic = scene.conics + 3 * row, *color = scene.color + 3 * row;
    const T z = scene.depths[row], opacity = scene.opacities[row];
    if (!conic_is_good(conic[0], conic[1], conic[2]) || !all_usable(mean, 2) || !usable(z) || !(z > 0)) continue;
    if (!(opacity >= T(kMinAlpha) && opacity <= 1) || !all_usable(color, 3)) continue;
    if (!all_usable(scene.features + row * scene.n_features, scene.n_features)) continue;
    const Footprint<T> shape = footprint_of_conic(conic[0], conic[1], conic[2]);
    const Covariance<T> covariance = covariance_of_conic(conic[0], conic[1], conic[2]);
    if (!std::isfinite(covariance.determinant) || !(shape.loose > 0)) continue;
    splat.x = mean[0], splat.y = mean[1], splat.z = z;
    splat.slope = shape.slope, splat.tight = shape.tight * log2e_half, splat.loose = shape.loose * log2e_half;
    splat.opacity = opacity, splat.level = level_of(opacity);
    for (int c = 0; c < 3; ++c) splat.color[c] = color[c];
    splat.bounds = pixel_bounds(splat.x, splat.y, covariance.xx, covariance.yy, covariance.determinant, splat.level,
                                scene.width, scene.height, false);
  }
}

// Calls f(tile) for every active tile with a pixel that may see the splat, row by row. A row of tiles is cut to the
// columns between the leftmost and the rightmost point of the ellipse within it. `active`: of the image, or null.
template <typename T, typename F>
void for_tiles(const Splat<T>& splat, int64_t tiles_x, const bool* active, const F& visit) {
  if (splat.bounds.x0 >= splat.bounds.x1) return;
  const auto f = [&](int64_t tile) {
    if (!active || active[tile]) visit(tile);
  };
  const int64_t tx0 = splat.bounds.x0 / kTile, tx1 = (splat.bounds.x1 - 1) / kTile;
  const int64_t ty0 = splat.bounds.y0 / kTile, ty1 = (splat.bounds.y1 - 1) / kTile;
  if (tx0 == tx1 || ty0 == ty1) {
    for (int64_t ty = ty0; ty <= ty1; ++ty)
      for (int64_t tx = tx0; tx <= tx1; ++tx) f(ty * tiles_x + tx);
    return;
  }
  // Height above the centre of the rightmost point: Sigma_xy sqrt(spread / Sigma_xx).
  const T variance_x = 1 / splat.tight + splat.slope * splat.slope / splat.loose;
  const T rightmost = splat.slope / splat.loose * std::sqrt(splat.level / variance_x);
  const auto half_width = [&](T dy) {
    return std::sqrt(std::max(T(0), (splat.level - splat.loose * dy * dy) / splat.tight));
  };
  for (int64_t ty = ty0; ty <= ty1; ++ty) {
    const T low = T(std::max<int64_t>(splat.bounds.y0, ty * kTile)) + T(0.5) - splat.y;
    const T high = T(std::min<int64_t>(splat.bounds.y1, (ty + 1) * kTile)) - T(0.5) - splat.y;
    const T at_right = std::clamp(rightmost, low, high), at_left = std::clamp(-rightmost, low, high);
    const T left = splat.x + splat.slope * at_left - half_width(at_left);
    const T right = splat.x + splat.slope * at_right + half_width(at_right);
    uint16_t begin, end;
    pixel_range(left, right, splat.bounds.x1, begin, end);
    begin = std::max(begin, splat.bounds.x0);
    if (begin >= end) continue;
    for (int64_t tx = begin / kTile; tx <= (end - 1) / kTile; ++tx) f(ty * tiles_x + tx);
  }
}

template <typename T>
const bool* active_tiles(const RasterScene<T>& scene, const Group<T>& group, int64_t image) {
  return scene.active ? scene.active + image * group.n_tiles() : nullptr;
}

template <typename T>
void choose_images(const RasterScene<T>& scene, Group<T>& group) {
  group.first = group.last;
  group.image_pair.assign(1, 0);
  group.image_chunk.assign(1, 0);
  group.chunks.clear();
  group.cameras.clear();
  // A chunk counts its splats in every tile, so it should hold at least as many rows as there are tiles.
  const int64_t rows_per_chunk = std::max(kRowsPerChunk, group.n_tiles());
  for (int64_t image = group.first; image < scene.n_images; ++image) {
    const int64_t begin = scene.cu_rows[scene.image_cloud[image]], end = scene.cu_rows[scene.image_cloud[image] + 1];
    const int64_t pairs = group.image_pair.back();
    if (image > group.first && pairs + end - begin > kPairsPerGroup) break;
    for (int64_t row = begin; row < end; row += rows_per_chunk)
      group.chunks.push_back({image, row, std::min(end, row + rows_per_chunk), pairs + row - begin});
    group.image_pair.push_back(pairs + end - begin);
    group.image_chunk.push_back(static_cast<int64_t>(group.chunks.size()));
    if (scene.sh_terms == kProjected)
      group.cameras.emplace_back();
    else
      group.cameras.push_back(make_camera(scene.viewmats + 16 * image, scene.Ks + 9 * image, scene.width, scene.height,
                                          scene.near_plane, scene.jacobian == RasterJacobian::kClamped));
    group.last = image + 1;
  }
}

// Draws nothing into an image of the group.
template <typename T>
void leave_out(Group<T>& group, int64_t image, bool backward) {
  for (int64_t pair = group.image_pair[image]; pair < group.image_pair[image + 1]; ++pair) {
    group.splats[pair].bounds = {};
    if (backward) group.pair_begin[pair + 1] = 0;
  }
}

}  // namespace

template <typename T>
bool next_group(const RasterScene<T>& scene, bool backward, Scratch& scratch, const Parallel& parallel,
                Group<T>& group) {
  if (group.last >= scene.n_images) return false;
  group.tiles_x = (scene.width + kTile - 1) / kTile, group.tiles_y = (scene.height + kTile - 1) / kTile;
  choose_images(scene, group);
  const int64_t n_images = group.last - group.first, n_tiles = group.n_tiles();
  const int64_t n_chunks = static_cast<int64_t>(group.chunks.size());
  group.splats = scratch.take<Splat<T>>(kSplats, group.n_pairs());
  group.cursor = scratch.take<int64_t>(kCursor, n_chunks * n_tiles);
  group.tile_begin = scratch.take<int64_t>(kTileBegin, n_images * n_tiles + 1);
  if (backward) group.pair_begin = scratch.take<int64_t>(kPairBegin, group.n_pairs() + 1);

  std::vector<Unusable> unusable(static_cast<size_t>(n_chunks));
  parallel.chunks(n_chunks, [&](int64_t c) {
    const Chunk& chunk = group.chunks[c];
    Splat<T>* splats = group.splats + chunk.pair;
    dispatch_sh(scene.sh_terms, [&](auto terms) {
      constexpr int kTerms = decltype(terms)::value;
      if constexpr (kTerms == kProjected)
        read_chunk(scene, chunk, splats);
      else
        unusable[c] = project_chunk<T, kTerms>(scene, group.cameras[chunk.image - group.first], chunk, splats);
    });
    int64_t* counts = group.cursor + c * n_tiles;
    std::fill_n(counts, n_tiles, int64_t{0});
    for (int64_t i = 0; i < chunk.end - chunk.begin; ++i) {
      int64_t count = 0;
      for_tiles(splats[i], group.tiles_x, active_tiles(scene, group, chunk.image), [&](int64_t tile) { ++counts[tile], ++count; });
      if (backward) group.pair_begin[chunk.pair + i + 1] = count;
    }
  });

  group.unusable.assign(static_cast<size_t>(n_images), {});
  int64_t total = 0;
  for (int64_t image = 0; image < group.last - group.first; ++image) {
    const int64_t begin = total;
    for (int64_t tile = 0; tile < n_tiles; ++tile) {
      group.tile_begin[image * n_tiles + tile] = total;
      for (int64_t c = group.image_chunk[image]; c < group.image_chunk[image + 1]; ++c) {
        const int64_t count = group.cursor[c * n_tiles + tile];
        group.cursor[c * n_tiles + tile] = total;
        total += count;
      }
    }
    Unusable& of_image = group.unusable[image];
    for (int64_t c = group.image_chunk[image]; c < group.image_chunk[image + 1]; ++c) {
      if (of_image.count == 0) of_image.first = unusable[c].first;
      of_image.count += unusable[c].count;
    }
    if (total - begin > kMaxInstances) {
      of_image = {total - begin, kFaultTiles};
      leave_out(group, image, backward);
      std::fill_n(group.tile_begin + image * n_tiles, n_tiles, begin);
      total = begin;
    } else if (image > 0 && total > kInstancesPerGroup) {
      group.cut(image);
      total = begin;
    }
  }
  group.tile_begin[(group.last - group.first) * n_tiles] = group.n_instances = total;
  group.instances = scratch.take<Instance<T>>(kInstances, total);
  if (backward) {
    group.positions = scratch.take<int64_t>(kPositions, total);
    group.pair_begin[0] = 0;
    for (int64_t pair = 0; pair < group.n_pairs(); ++pair) group.pair_begin[pair + 1] += group.pair_begin[pair];
  }

  parallel.chunks(static_cast<int64_t>(group.chunks.size()), [&](int64_t c) {
    const Chunk& chunk = group.chunks[c];
    int64_t* cursor = group.cursor + c * n_tiles;
    const int64_t first_pair = group.image_pair[chunk.image - group.first];
    for (int64_t pair = chunk.pair; pair < chunk.pair + chunk.end - chunk.begin; ++pair) {
      const Splat<T>& splat = group.splats[pair];
      Instance<T> instance{0, static_cast<uint32_t>(pair - first_pair)};
      std::memcpy(&instance.key, &splat.z, sizeof(T));
      int64_t* positions = backward ? group.positions + group.pair_begin[pair] : nullptr;
      for_tiles(splat, group.tiles_x, active_tiles(scene, group, chunk.image), [&](int64_t tile) {
        if (positions) *positions++ = cursor[tile];
        group.instances[cursor[tile]++] = instance;
      });
    }
  });
  return true;
}

#define GSIM3D_INSTANTIATE(T) \
  template bool next_group<T>(const RasterScene<T>&, bool, Scratch&, const Parallel&, Group<T>&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::raster
