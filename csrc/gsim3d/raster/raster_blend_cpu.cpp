// Blending of one tile at a time. A typical Gaussian is a few pixels wide, so a tile visits, for each splat, only the
// rows and the vectors of pixels within its bounds, not all of its 256 pixels.
#include <algorithm>
#include <cmath>
#include <memory>
#include <type_traits>
#include <utility>

#include "gsim3d/raster/raster_tiles.h"

namespace gsim3d::raster {
namespace {

constexpr int kPixels = kTile * kTile;
// How often a tile asks whether any pixel still takes light: rarely enough to cost nothing.
constexpr int64_t kLiveInterval = 16;
constexpr int64_t kInsertionSort = 32;
constexpr int64_t kPrefetch = 6;

// A tile's list in order of depth; `place` is the position in the tile's part of the instances, ascending with the row.
template <typename T>
struct Entry {
  typename KeyOf<T>::Type key;
  uint32_t place;
};

// Stable: equal depths keep the order of rows. Returns where the sorted list is: `entries` or `other`.
template <typename T>
Entry<T>* sort_by_depth(Entry<T>* entries, Entry<T>* other, int64_t n) {
  if (n <= kInsertionSort) {
    for (int64_t i = 1; i < n; ++i) {
      const Entry<T> entry = entries[i];
      int64_t j = i;
      for (; j > 0 && entries[j - 1].key > entry.key; --j) entries[j] = entries[j - 1];
      entries[j] = entry;
    }
    return entries;
  }
  constexpr int kDigits = sizeof(entries->key);
  int64_t counts[kDigits][256] = {};
  for (int64_t i = 0; i < n; ++i)
    for (int digit = 0; digit < kDigits; ++digit) ++counts[digit][(entries[i].key >> (8 * digit)) & 255];
  for (int digit = 0; digit < kDigits; ++digit) {
    const int shift = 8 * digit;
    int64_t* count = counts[digit];
    if (count[(entries[0].key >> shift) & 255] == n) continue;
    int64_t position = 0;
    for (int value = 0; value < 256; ++value) position += std::exchange(count[value], position);
    for (int64_t i = 0; i < n; ++i) other[count[(entries[i].key >> shift) & 255]++] = entries[i];
    std::swap(entries, other);
  }
  return entries;
}

// The tasks of a group: one tile each.
template <typename T>
class Tile {
 public:
  Tile(const RasterScene<T>& scene, const Group<T>& group, int64_t task)
      : n_tiles_(group.n_tiles()),
        image(group.first + task / n_tiles_),
        begin(group.tile_begin[task]),
        n(group.tile_begin[task + 1] - begin),
        x0(static_cast<int>(task % n_tiles_ % group.tiles_x) * kTile),
        y0(static_cast<int>(task % n_tiles_ / group.tiles_x) * kTile),
        columns(static_cast<int>(std::min<int64_t>(kTile, scene.width - x0))),
        rows(static_cast<int>(std::min<int64_t>(kTile, scene.height - y0))),
        memory_(new Entry<T>[2 * static_cast<size_t>(n)]),
        instances_(group.instances + begin),
        splats_(group.splats + group.image_pair[image - group.first]) {
    for (int64_t i = 0; i < n; ++i) memory_[i] = {instances_[i].key, static_cast<uint32_t>(i)};
    entries_ = sort_by_depth(memory_.get(), memory_.get() + n, n);
    first_row_ = scene.cu_rows[scene.image_cloud[image]];
  }

  int64_t place(int64_t i) const { return entries_[i].place; }
  const Splat<T>& splat(int64_t i) const { return splats_[instances_[entries_[i].place].row]; }
  // Sorted by depth, splats lie anywhere: fetch the one that is needed a few steps later.
  void prefetch(int64_t i) const {
    if (i >= 0 && i < n) __builtin_prefetch(&splat(i));
  }
  int64_t row(int64_t i) const { return first_row_ + instances_[entries_[i].place].row; }

  // Calls f(pixel of the tile, pixel of all images) for the pixels inside the image.
  template <typename F>
  void for_pixels(const RasterScene<T>& scene, const F& f) const {
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < columns; ++x)
        f(y * kTile + x, (image * scene.height + y0 + y) * scene.width + x0 + x);
  }

 private:
  int64_t n_tiles_;

 public:
  int64_t image, begin, n;
  int x0, y0, columns, rows;

 private:
  std::unique_ptr<Entry<T>[]> memory_;
  const Entry<T>* entries_;
  const Instance<T>* instances_;
  const Splat<T>* splats_;
  int64_t first_row_;
};

// Calls f(offset, u, dy, exponent) for the vectors of pixels of the tile that may see the splat: offset of the first
// pixel in the tile, u = dx - slope dy, and alpha = opacity 2^exponent. Every pixel within the splat's bounds is in
// one vector.
template <typename T, typename F>
void for_vectors(const Splat<T>& splat, int tile_x, int tile_y, const F& f) {
  using V = Simd<T>;
  constexpr int kL = kLanes<T>;
  static_assert(kTile % kL == 0);
  alignas(32) T lane_centres[kL];
  for (int lane = 0; lane < kL; ++lane) lane_centres[lane] = T(lane) + T(0.5);
  const V centres = load<V>(lane_centres);
  const int x0 = std::max(splat.bounds.x0 - tile_x, 0), x1 = std::min(splat.bounds.x1 - tile_x, kTile);
  const int y0 = std::max(splat.bounds.y0 - tile_y, 0), y1 = std::min(splat.bounds.y1 - tile_y, kTile);
  for (int y = y0; y < y1; ++y) {
    const T dy = (T(tile_y + y) + T(0.5)) - splat.y;
    const T shift = splat.slope * dy, base = splat.loose * dy * dy;
    int from = x0, to = x1;
    if (x1 - x0 > kL) {
      const T square = (splat.level - base) / splat.tight;
      if (!(square >= 0)) continue;
      const T centre = splat.x + shift - T(tile_x) - T(0.5), reach = std::sqrt(square) + T(0.01);
      from = static_cast<int>(std::ceil(std::clamp(centre - reach, T(x0), T(x1))));
      to = static_cast<int>(std::floor(std::clamp(centre + reach, T(x0) - 1, T(x1) - 1))) + 1;
    }
    const int n = (to - from + kL - 1) / kL;
    const int start = std::min(from, kTile - n * kL);
    for (int i = 0; i < n; ++i) {
      const int x = start + i * kL;
      const V u = ((centres + T(tile_x + x)) - splat.x) - shift;
      f(y * kTile + x, u, dy, -fma(u * splat.tight, u, V{} + base));
    }
  }
}

template <typename T, bool kFade>
void blend_tile(const RasterScene<T>& scene, const Group<T>& group, const RasterImages<T>& images, int64_t task) {
  using V = Simd<T>;
  constexpr int kL = kLanes<T>;
  const Tile<T> tile(scene, group, task);
  const int64_t n_features = scene.n_features;

  // Transmittance is 0 where a pixel has ended; what it had reached is in `ended`, and after how many entries in
  // `last`.
  alignas(32) T transmittance[kPixels] = {}, ended[kPixels], sums[4][kPixels] = {};
  int32_t last[kPixels];
  std::vector<T> feature_sums(static_cast<size_t>(n_features) * kPixels, T(0));
  std::fill_n(last, kPixels, static_cast<int32_t>(tile.n));
  tile.for_pixels(scene, [&](int pixel, int64_t) { transmittance[pixel] = 1; });

  for (int64_t k = 0; k < tile.n; ++k) {
    if (k % kLiveInterval == 0) {
      V live = V{};
      for (int i = 0; i < kPixels; i += kL) live += load<V>(transmittance + i);
      if (!any(live > V{})) break;
    }
    tile.prefetch(k + kPrefetch);
    const Splat<T>& splat = tile.splat(k);
    const T* feature = scene.features + tile.row(k) * n_features;
    const T values[4] = {splat.color[0], splat.color[1], splat.color[2], splat.z};
    for_vectors(splat, tile.x0, tile.y0, [&](int pixel, V, T, V exponent) {
      V alpha = min_of(exp2_of(exponent) * splat.opacity, V{} + T(kMaxAlpha));
      if constexpr (kFade)
        alpha = fade(alpha);
      else
        alpha = alpha >= V{} + T(kMinAlpha) ? alpha : V{};
      const V light = load<V>(transmittance + pixel);
      V weight = alpha * light, rest = light - weight;
      const auto ends = (rest < V{} + T(kMinTransmittance)) & (light > V{});
      if (any(ends)) [[unlikely]] {
        for (int lane = 0; lane < kL; ++lane)
          if (ends[lane]) ended[pixel + lane] = light[lane], last[pixel + lane] = static_cast<int32_t>(k);
        weight = ends ? V{} : weight;
        rest = ends ? V{} : rest;
      }
      store(transmittance + pixel, rest);
      for (int c = 0; c < 4; ++c) store(sums[c] + pixel, fma(weight, V{} + values[c], load<V>(sums[c] + pixel)));
      for (int64_t c = 0; c < n_features; ++c) {
        T* sum = feature_sums.data() + c * kPixels + pixel;
        store(sum, fma(weight, V{} + feature[c], load<V>(sum)));
      }
    });
  }

  const T* background = scene.background + 3 * tile.image;
  tile.for_pixels(scene, [&](int pixel, int64_t to) {
    const T rest = transmittance[pixel] > 0 ? transmittance[pixel] : ended[pixel];
    for (int c = 0; c < 3; ++c) images.color[3 * to + c] = sums[c][pixel] + rest * background[c];
    images.alpha[to] = 1 - rest;
    images.depth[to] = sums[3][pixel];
    for (int64_t c = 0; c < n_features; ++c) images.features[to * n_features + c] = feature_sums[c * kPixels + pixel];
    images.transmittance[to] = rest;
    images.last[to] = last[pixel];
  });
}

// From back to front. With s = <grad, values of the splat> at a pixel and S the same sum over all that lies behind it,
// weighted: grad_alpha = T s - S / (1 - alpha). T before a splat is T behind it / (1 - alpha).
template <typename T, bool kFade, bool kAbsolute>
void blend_tile_vjp(const RasterScene<T>& scene, const Group<T>& group, const RasterImageGrads<T>& grads, int64_t task,
                    T* slots, T* tile_background) {
  using V = Simd<T>;
  using Int = IntOf<T>;
  const Tile<T> tile(scene, group, task);
  const int64_t n_features = scene.n_features, slot_width = kSlotFixed + n_features + (kAbsolute ? 2 : 0);
  const T* background = scene.background + 3 * tile.image;

  alignas(32) T light_behind[kPixels] = {}, behind[kPixels] = {}, grad[4][kPixels] = {};
  alignas(32) Int last[kPixels] = {};
  std::vector<T> feature_grad(static_cast<size_t>(n_features) * kPixels, T(0));
  std::vector<V> feature_sums(static_cast<size_t>(n_features));
  T background_sum[3] = {};
  int64_t n_used = 0;
  tile.for_pixels(scene, [&](int pixel, int64_t from) {
    const T rest = grads.transmittance[from];
    light_behind[pixel] = rest;
    last[pixel] = grads.last[from];
    n_used = std::max<int64_t>(n_used, grads.last[from]);
    T seen = -value_or_zero(grads.alpha, from);
    for (int c = 0; c < 3; ++c) {
      grad[c][pixel] = value_or_zero(grads.color, 3 * from + c);
      seen += grad[c][pixel] * background[c];
      background_sum[c] += grad[c][pixel] * rest;
    }
    grad[3][pixel] = value_or_zero(grads.depth, from);
    behind[pixel] = rest * seen;
    for (int64_t c = 0; c < n_features; ++c)
      feature_grad[c * kPixels + pixel] = value_or_zero(grads.features, from * n_features + c);
  });
  std::copy_n(background_sum, 3, tile_background);
  n_used = std::min(n_used, tile.n);
  for (int64_t k = n_used; k < tile.n; ++k)
    std::fill_n(slots + (tile.begin + tile.place(k)) * slot_width, slot_width, T(0));

  for (int64_t k = n_used - 1; k >= 0; --k) {
    tile.prefetch(k - kPrefetch);
    const Splat<T>& splat = tile.splat(k);
    const T* feature = scene.features + tile.row(k) * n_features;
    const T values[4] = {splat.color[0], splat.color[1], splat.color[2], splat.z};
    const SimdMask<T> index = SimdMask<T>{} + static_cast<Int>(k);
    V sums[kSlotFixed] = {}, absolute[2] = {};
    std::fill(feature_sums.begin(), feature_sums.end(), V{});
    for_vectors(splat, tile.x0, tile.y0, [&](int pixel, V u, T dy, V exponent) {
      const V raw = exp2_of(exponent) * splat.opacity;
      V alpha = min_of(raw, V{} + T(kMaxAlpha));
      V slope = raw <= V{} + T(kMaxAlpha) ? raw : V{};
      auto seen = load<SimdMask<T>>(last + pixel) > index;
      if constexpr (kFade)
        slope *= fade_slope(alpha), alpha = fade(alpha);
      else
        seen &= alpha >= V{} + T(kMinAlpha);
      alpha = seen ? alpha : V{};
      const V inverse = T(1) / (T(1) - alpha);
      const V light = load<V>(light_behind + pixel) * inverse, weight = alpha * light;
      V total = V{};
      for (int c = 0; c < 4; ++c) {
        const V g = load<V>(grad[c] + pixel);
        total = fma(g, V{} + values[c], total);
        sums[6 + c] = fma(weight, g, sums[6 + c]);
      }
      for (int64_t c = 0; c < n_features; ++c) {
        const V g = load<V>(feature_grad.data() + c * kPixels + pixel);
        total = fma(g, V{} + feature[c], total);
        feature_sums[c] = fma(weight, g, feature_sums[c]);
      }
      const V rest = load<V>(behind + pixel);
      const V grad_alpha = light * total - rest * inverse;
      store(light_behind + pixel, light);
      store(behind + pixel, fma(weight, total, rest));
      const V v = seen ? grad_alpha * slope : V{}, vu = v * u;
      sums[0] += vu;
      sums[1] += v * dy;
      sums[2] = fma(vu, u, sums[2]);
      sums[3] += vu * dy;
      sums[4] += v * (dy * dy);
      sums[5] += v;
      if constexpr (kAbsolute) {
        const V by_u = vu * splat.tight;
        absolute[0] += abs_of(by_u), absolute[1] += abs_of(v * (splat.loose * dy) - by_u * splat.slope);
      }
    });
    T* slot = slots + (tile.begin + tile.place(k)) * slot_width;
    for (int c = 0; c < kSlotFixed; ++c) slot[c] = sum_lanes(sums[c]);
    for (int64_t c = 0; c < n_features; ++c) slot[kSlotFixed + c] = sum_lanes(feature_sums[c]);
    for (int c = 0; c < 2 && kAbsolute; ++c)
      slot[kSlotFixed + n_features + c] = sum_lanes(absolute[c]) * T(1 / kLog2eHalf);
  }
}

// Tiles with long lists lie side by side. Pools that hand out runs of tasks get them mixed by this step.
int64_t mixed(int64_t task, int64_t n) {
  constexpr int64_t kStep = 1000003;  // prime
  return n % kStep ? task * kStep % n : task;
}

}  // namespace

template <typename T>
void blend_group(const RasterScene<T>& scene, const Group<T>& group, const RasterImages<T>& images,
                 const Parallel& parallel) {
  const int64_t n = (group.last - group.first) * group.n_tiles();
  parallel.chunks(n, [&](int64_t task) {
    if (scene.cutoff == RasterCutoff::kSmooth)
      blend_tile<T, true>(scene, group, images, mixed(task, n));
    else
      blend_tile<T, false>(scene, group, images, mixed(task, n));
  });
}

template <typename T>
void blend_group_vjp(const RasterScene<T>& scene, const Group<T>& group, const RasterImageGrads<T>& image_grads,
                     T* slots, T* tile_background, T* grad_background, bool absolute, const Parallel& parallel) {
  const int64_t n_tiles = group.n_tiles(), n = (group.last - group.first) * n_tiles;
  parallel.chunks(n, [&](int64_t i) {
    const int64_t task = mixed(i, n);
    const auto blend = [&](auto fade, auto with_absolute) {
      blend_tile_vjp<T, decltype(fade)::value, decltype(with_absolute)::value>(scene, group, image_grads, task, slots,
                                                                               tile_background + 3 * task);
    };
    const auto with = [&](auto fade) { absolute ? blend(fade, std::true_type{}) : blend(fade, std::false_type{}); };
    scene.cutoff == RasterCutoff::kSmooth ? with(std::true_type{}) : with(std::false_type{});
  });
  for (int64_t task = 0; task < n && grad_background; ++task) {
    T* grad = grad_background + 3 * (group.first + task / n_tiles);
    for (int c = 0; c < 3; ++c) grad[c] += tile_background[3 * task + c];
  }
}

#define GSIM3D_INSTANTIATE(T)                                                                                          \
  template void blend_group<T>(const RasterScene<T>&, const Group<T>&, const RasterImages<T>&, const Parallel&);       \
  template void blend_group_vjp<T>(const RasterScene<T>&, const Group<T>&, const RasterImageGrads<T>&, T*, T*, T*,     \
                                   bool, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::raster
