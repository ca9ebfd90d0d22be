// Inside of the CUDA rasterizer: blending of one quarter of a tile, 8 x 8 pixels, by one warp.
//
// The warp takes the quarter's list in batches of 32. Lane by entry, it finds which of the
// 64 pixels each Gaussian may reach, as words of bits; transposed, they tell each pixel its Gaussians. Lane by
// pixel, it then visits those only. In the backward pass each entry's lane then sums over the pixels, so no value is
// ever added up across lanes.
#pragma once

#include <algorithm>
#include <type_traits>

#include "gsim3d/raster/raster_project.cuh"

namespace gsim3d::raster {

constexpr int kWarps = kBlock / kWarp;
constexpr int kPixels = 2;    // of a lane
constexpr int kFeatures = 8;  // channels blended in one pass over a list

// Bit b of the result of lane l is bit l of the value of lane b.
__device__ inline uint32_t transpose_bits(uint32_t value, int lane) {
  uint32_t keep = 0x0000ffffu;
#pragma unroll
  for (int step = 16; step > 0; step /= 2, keep ^= keep << step) {
    const uint32_t other = __shfl_xor_sync(kFullWarp, value, step);
    value = lane & step ? (value & ~keep) | ((other >> step) & keep) : (value & keep) | ((other << step) & ~keep);
  }
  return value;
}

// A warp's part of the images.
struct Quarter {
  int64_t image, index;  // index: of the quarter in all images
  int32_t n;             // length of its list
  int x0, y0;

  template <typename T>
  __device__ Quarter(const Job<T>& job, int64_t number) : index(number) {
    const int part = static_cast<int>(index % kQuarters);
    const int64_t tile = index / kQuarters;
    image = tile / job.n_tiles;
    const int64_t place = tile - image * job.n_tiles;
    n = static_cast<int32_t>(job.lists[index].n);
    x0 = static_cast<int>(place % job.tiles_x) * kTile + part % 2 * kQuarter;
    y0 = static_cast<int>(place / job.tiles_x) * kTile + part / 2 * kQuarter;
  }
};

// The quarters of the group that fall to the calling warp: for (WarpQuarters q(job); q.more(); q.next()).
template <typename T>
class WarpQuarters {
 public:
  __device__ explicit WarpQuarters(const Job<T>& job)
      : order_(job.order), first_(job.group->tile_begin), n_((job.group->tile_end - first_) * kQuarters) {
    const int64_t warps = blockDim.x / kWarp;
    i_ = blockIdx.x * warps + threadIdx.x / kWarp, step_ = gridDim.x * warps;
  }
  __device__ bool more() const { return i_ < n_; }
  __device__ void next() {
    i_ += step_;
    __syncwarp();
  }
  // In all images.
  __device__ int64_t index() const { return (first_ + order_[i_ / kQuarters]) * kQuarters + i_ % kQuarters; }

 private:
  const uint32_t* order_;
  int64_t first_, n_, i_, step_;
};

// Index of a pixel of the quarter in the images, or -1 outside of them.
template <typename T>
__device__ int64_t pixel_of(const RasterScene<T>& s, const Quarter& quarter, int column, int row) {
  const int x = quarter.x0 + column, y = quarter.y0 + row;
  return x < s.width && y < s.height ? (quarter.image * s.height + y) * s.width + x : -1;
}

// Values of the batch, by entry, four of them in one load. With x, y counted from the first pixel's centre,
// alpha = 2^(strength - u^2 - v^2), u = ux x + uy y + u0, v = vy y + v0.
template <typename V>
struct Batch {
  static constexpr size_t kAligned = std::min(4 * sizeof(V), size_t{32});  // as far as dynamic_memory is
  struct alignas(kAligned) Shape {
    V ux, uy, u0, vy;
  } shapes[kWarp];
  struct alignas(kAligned) Value {
    V red, green, blue, depth;
  } values[kWarp];
  struct alignas(2 * sizeof(V)) Rest {
    V v0, strength;
  } rests[kWarp];
};

template <typename V>
__device__ void put(const Record<V>& r, const Quarter& quarter, int lane, Batch<V>& batch) {
  using T = PlainOf<V>;
  const V x = r.x - (T(quarter.x0) + T(0.5)), y = r.y - (T(quarter.y0) + T(0.5));
  const V uy = -r.tight * r.slope;
  batch.shapes[lane] = {r.tight, uy, -(r.tight * x + uy * y), r.loose};
  batch.values[lane] = {r.red, r.green, r.blue, r.z};
  batch.rests[lane] = {-r.loose * y, r.strength};
}

// The same value, which the compiler would otherwise find anew for every entry. All lanes take part.
template <typename T>
__device__ __forceinline__ T in_register(T value) {
  return __shfl_sync(kFullWarp, value, threadIdx.x % kWarp);
}

// alpha of entry j at (x, y) before it is cut.
template <typename V, typename T>
__device__ __forceinline__ V alpha_at(const Batch<V>& batch, int j, T x, T y) {
  const auto shape = batch.shapes[j];
  const auto rest = batch.rests[j];
  const V u = shape.ux * x + (shape.uy * y + shape.u0), v = shape.vy * y + rest.v0;
  return fast_exp2(rest.strength - u * u - v * v);
}

// Pixels of the quarter that the record may reach, for each row the bits of its columns. May err outwards only. The
// record's bounds say no more: within a quarter, what they leave out is out of reach.
template <typename V>
__device__ void cover(const Record<V>& r, const Quarter& quarter, uint32_t (&spans)[kQuarter]) {
  using T = PlainOf<V>;
  constexpr double kLog2MaxRatio = 7.994353436858858;  // log2(255)
  const T x = plain(r.x) - (T(quarter.x0) + T(0.5)), y = plain(r.y) - (T(quarter.y0) + T(0.5));
  const T slope = plain(r.slope), width = fast_reciprocal(plain(r.tight));
  const T most = (plain(r.strength) + T(kLog2MaxRatio + kLevelSlack)) * width * width;
  const T decay = plain(r.loose) * width, first_decay = -decay * y, first_centre = x - slope * y;
#pragma unroll
  for (int row = 0; row < kQuarter; ++row) {
    const T centre = first_centre + slope * T(row), lost = first_decay + decay * T(row);
    const T reach = fast_sqrt(max_of(most - lost * lost, T(0)));
    const uint32_t from = min(ceil_to_whole(centre - T(kPixelSlack) - reach), uint32_t{kQuarter});
    const uint32_t to = min(floor_to_whole(centre + T(1 + kPixelSlack) + reach), uint32_t{kQuarter});
    spans[row] = (1u << to) - (1u << from);
  }
}

template <typename V, typename T>
__device__ inline V background_of(const RasterScene<T>& s, int64_t image, int channel, const T* tangents = nullptr) {
  const V value = argument<V>(s.background, tangents, 3 * image + channel);
  return usable(plain(value)) ? value : V(0);
}

// Place of the features of a pair.
template <typename T>
__device__ inline int64_t features_of(const Job<T>& job, int64_t image, uint32_t pair) {
  const int64_t row = job.views[image].row_begin + pair - job.pair_begin[image];
  return row * job.scene.n_features;
}

// What the pixels of a group see of its rows: T, or Dual<T> along the tangents.
template <typename V>
struct Seen {
  const Record<V>* records;  // [pairs]
  RasterTangents<PlainOf<V>> tangents;
};

template <typename V, bool kWithFeatures>
struct BlendShared {
  Batch<V> batch;
  Record<V> records[kWarp];  // of the next batch; a lane reads its own
  uint32_t pairs[kWarp];     // of the batch after it, the same
  V features[kWithFeatures ? kFeatures : 1][kWarp];
};

// A pixel on its way through the list.
template <typename V>
struct Light {
  V rest;            // transmittance
  PlainOf<V> floor;  // alpha that counts: kMinAlpha, or kClosed when the pixel has ended
  V sums[4];         // colour, depth
  int32_t last;  // entries of the list in front of the pixel's end
};
constexpr double kClosed = 2;

// One pass over the list: colour and depth, or (kPass = true) the features from `channel` on. A lane has two pixels,
// one above the other, and visits the entries that either of them sees.
template <bool kFade, bool kPass, typename T, typename V, bool kWithFeatures>
__device__ void blend_quarter(const Job<T>& job, const Seen<V>& seen, const RasterImages<T>& images, int64_t index,
                              int64_t channel, BlendShared<V, kWithFeatures>& shared) {
  const RasterScene<T>& s = job.scene;
  const int lane = threadIdx.x % kWarp, column = lane % kQuarter, row = lane / kQuarter * kPixels;
  const Quarter quarter(job, index);
  const uint32_t* pairs = job.listed + job.lists[quarter.index].begin;
  const int n_channels = kPass ? static_cast<int>(min(s.n_features - channel, int64_t{kFeatures})) : 0;
  Light<V> light[kPixels];
  V features[kPixels][kFeatures];
#pragma unroll
  for (int k = 0; k < kPixels; ++k) {
    light[k] = {T(1), T(pixel_of(s, quarter, column, row + k) < 0 ? kClosed : kMinAlpha), {}, quarter.n};
    for (int c = 0; c < kFeatures; ++c) features[k][c] = V(0);
  }

  // The records of a batch are fetched while the batch before is blended, their numbers another batch earlier. The
  // first entry goes to the last lane: the highest bit is the one that is found fastest.
  const int place = kWarp - 1 - lane;
  const auto number = [&](int32_t base) { return pairs + min(base + place, quarter.n - 1); };
  const auto fetch = [&](uint32_t pair, int32_t base) {
    start_copy(seen.records + pair, shared.records + lane);
    start_copy(number(base + kWarp), shared.pairs + lane);
  };
  uint32_t next_pair = 0;
  if (quarter.n > 0) next_pair = *number(0), fetch(next_pair, 0);
  const T x = in_register(T(column)), y[kPixels] = {in_register(T(row)), in_register(T(row + 1))};
  for (int32_t base = 0; base < quarter.n; base += kWarp) {
    const bool closed = light[0].floor > 1 && light[1].floor > 1;
    if (__all_sync(kFullWarp, closed)) break;
    wait_copies();
    const uint32_t pair = next_pair;
    Record<V> record;
    load_record(shared.records + lane, record);
    next_pair = shared.pairs[lane];
    uint32_t bits = 0;
    __syncwarp();
    if (base + place < quarter.n) {
      put(record, quarter, lane, shared.batch);
      uint32_t spans[kQuarter];
      cover(record, quarter, spans);
#pragma unroll
      for (int row = 0; row < kQuarter; ++row) bits |= spans[row] << (row / kPixels * kQuarter);
      if constexpr (kPass) {
        const int64_t at = features_of(job, quarter.image, pair) + channel;
        for (int c = 0; c < kFeatures; ++c)
          shared.features[c][lane] = c < n_channels ? argument<V>(s.features, seen.tangents.features, at + c) : V(0);
      }
    }
    __syncwarp();
    if (base + kWarp < quarter.n) fetch(next_pair, base + kWarp);
    uint32_t mine = transpose_bits(bits, lane);
    if (closed) mine = 0;
    while (mine) {
      const int j = kWarp - 1 - __clz(mine);
      mine ^= 1u << j;
      const Batch<V>& batch = shared.batch;
      V weight[kPixels], left[kPixels];
      bool ends = false;
#pragma unroll
      for (int k = 0; k < kPixels; ++k) {
        const V raw = min_of(alpha_at(batch, j, x, y[k]), V(kMaxAlpha));
        const V alpha = kFade ? fade(raw) : raw;
        weight[k] = (kFade ? light[k].floor < 1 : plain(raw) >= light[k].floor) ? alpha * light[k].rest : V(0);
        left[k] = light[k].rest - weight[k];
        ends |= plain(left[k]) < T(kMinTransmittance);
      }
      if (ends) {
#pragma unroll
        for (int k = 0; k < kPixels; ++k) {
          if (plain(left[k]) >= T(kMinTransmittance)) continue;
          light[k].floor = kClosed, light[k].last = base + kWarp - 1 - j, weight[k] = V(0), left[k] = light[k].rest;
        }
        if (light[0].floor > 1 && light[1].floor > 1) mine = 0;
      }
#pragma unroll
      for (int k = 0; k < kPixels; ++k) {
        light[k].rest = left[k];
        if constexpr (kPass) {
          for (int c = 0; c < kFeatures; ++c) features[k][c] += weight[k] * shared.features[c][j];
        } else {
          const auto value = batch.values[j];
          V(&sums)[4] = light[k].sums;
          sums[0] += weight[k] * value.red, sums[1] += weight[k] * value.green;
          sums[2] += weight[k] * value.blue, sums[3] += weight[k] * value.depth;
        }
      }
    }
  }

#pragma unroll
  for (int k = 0; k < kPixels; ++k) {
    const int64_t pixel = pixel_of(s, quarter, column, row + k);
    if (pixel < 0) continue;
    if constexpr (kPass) {
      T* to = images.features + pixel * s.n_features + channel;
      for (int c = 0; c < kFeatures; ++c)
        if (c < n_channels) to[c] = shown(features[k][c]);
    } else {
      const Light<V>& at = light[k];
      for (int c = 0; c < 3; ++c)
        images.color[3 * pixel + c] =
            shown(at.sums[c] + at.rest * background_of<V>(s, quarter.image, c, seen.tangents.background));
      images.alpha[pixel] = shown(V(1) - at.rest);
      images.depth[pixel] = shown(at.sums[3]);
      if constexpr (std::is_same_v<V, T>) {
        images.transmittance[pixel] = at.rest;
        images.last[pixel] = at.last;
      }
    }
  }
  wait_copies();  // those of a list that was left before its end: the memory is used again
}

template <bool kFade, typename T, typename V, bool kWithFeatures>
__device__ void blend_tiles(const Job<T>& job, const Seen<V>& seen, const RasterImages<T>& images,
                            BlendShared<V, kWithFeatures>& shared) {
  for (WarpQuarters quarters(job); quarters.more(); quarters.next()) {
    blend_quarter<kFade, false>(job, seen, images, quarters.index(), 0, shared);
    if constexpr (kWithFeatures) {
      for (int64_t channel = 0; channel < job.scene.n_features; channel += kFeatures) {
        __syncwarp();
        blend_quarter<kFade, true>(job, seen, images, quarters.index(), channel, shared);
      }
    }
  }
}

}  // namespace gsim3d::raster
