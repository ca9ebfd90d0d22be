// Inside of the CUDA rasterizer: blending of one tile of 8 x 8 pixels by one warp.
//
// The list is taken in batches of 32 entries. Lane by entry, the warp finds which of the 64 pixels each Gaussian may
// reach, as two words of bits; transposed, they tell each pixel its Gaussians. Lane by pixel, it then visits those
// only. The backward pass transposes once more: lane by entry, each Gaussian sums over its own pixels, so no value is
// ever added up across lanes.
#pragma once

#include "gsim3d/raster/raster_lists.cuh"

namespace gsim3d::raster {

constexpr int kWarps = kBlock / kWarp;
constexpr int kHalves = kSpot * kSpot / kWarp;  // pixels of a lane: rows 0 to 3 of the tile, and rows 4 to 7
constexpr int kFeatures = 8;                    // channels blended in one pass over a list
constexpr int kSlotFixed = 10;                  // gradients of an entry: Moments (5), sum v, colour (3), depth; features

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

// Values of the batch, by entry.
enum Field { kX, kY, kSlope, kTight, kLoose, kOpacity, kRed, kGreen, kBlue, kDepth, kFields };

template <typename T>
using Batch = T[kFields][kWarp];

__device__ inline float exp2_of(float x) { return exp2f(x); }
__device__ inline double exp2_of(double x) { return exp2(x); }

template <typename T>
__device__ void put(const Record<T>& r, int lane, Batch<T>& batch) {
  batch[kX][lane] = r.x, batch[kY][lane] = r.y, batch[kSlope][lane] = r.slope, batch[kTight][lane] = r.tight;
  batch[kLoose][lane] = r.loose, batch[kOpacity][lane] = r.opacity, batch[kDepth][lane] = r.z;
  batch[kRed][lane] = r.red, batch[kGreen][lane] = r.green, batch[kBlue][lane] = r.blue;
}

// Pixels of the tile that the record may reach: bit 8 * row + column of the two halves. May err outwards only.
template <typename T>
__device__ void cover(const Record<T>& r, int tile_x, int tile_y, uint32_t (&bits)[kHalves]) {
  const int x0 = max(r.x0 - tile_x, 0), x1 = min(r.x1 - tile_x, kSpot);
  const int y0 = max(r.y0 - tile_y, 0), y1 = min(r.y1 - tile_y, kSpot);
  const T level = level_of(r.opacity), inverse = T(1) / r.tight;
  bits[0] = bits[1] = 0;
#pragma unroll
  for (int y = 0; y < kSpot; ++y) {
    const T dy = (T(tile_y + y) + T(0.5)) - r.y;
    const T square = (level - r.loose * dy * dy) * inverse;
    if (y < y0 || y >= y1 || !(square >= 0)) continue;
    const T centre = r.x + r.slope * dy - T(tile_x) - T(0.5), reach = sqrt(square) + T(kPixelSlack);
    const int from = static_cast<int>(ceil(min_of(max_of(centre - reach, T(x0)), T(x1))));
    const int to = static_cast<int>(floor(min_of(max_of(centre + reach, T(x0 - 1)), T(x1 - 1)))) + 1;
    if (from < to) bits[y / 4] |= ((1u << to) - (1u << from)) << (8 * (y % 4));
  }
}

// Where one record stands at one pixel.
template <typename T>
struct Sight {
  T u, dy, raw;  // dx - slope dy; alpha before it is cut

  __device__ Sight(const Batch<T>& batch, int j, T x, T y) {
    dy = y - batch[kY][j];
    u = (x - batch[kX][j]) - batch[kSlope][j] * dy;
    raw = exp2_of(-(batch[kTight][j] * u * u + batch[kLoose][j] * dy * dy)) * batch[kOpacity][j];
  }
};

// A warp's tile.
struct Spot {
  int64_t image, begin;
  int64_t n;
  int x0, y0;

  template <typename T>
  __device__ Spot(const Job<T>& job, int64_t task)
      : image(task / job.n_spots), begin(job.spot_begin[task]), n(job.spot_begin[task + 1] - begin) {
    const int64_t place = task - image * job.n_spots;
    y0 = static_cast<int>(place / job.spots_x) * kSpot;
    x0 = static_cast<int>(place % job.spots_x) * kSpot;
  }
};

// The pixel of a lane in one half of the tile.
template <typename T>
struct Pixel {
  T x, y;
  int64_t index;  // in the images
  bool inside;

  __device__ Pixel(const RasterScene<T>& s, const Spot& spot, int half, int lane) {
    const int column = spot.x0 + lane % kSpot, row = spot.y0 + lane / kSpot + half * (kWarp / kSpot);
    x = T(column) + T(0.5), y = T(row) + T(0.5);
    inside = column < s.width && row < s.height;
    index = (spot.image * s.height + row) * s.width + column;
  }
};

template <typename T>
__device__ inline T background_of(const RasterScene<T>& s, int64_t image, int channel) {
  const T value = s.background[3 * image + channel];
  return isfinite(value) ? value : T(0);
}

// Row of the features of a pair.
template <typename T>
__device__ inline const T* features_of(const Job<T>& job, int64_t image, uint32_t pair) {
  const int64_t row = job.views[image].row_begin + pair - job.pair_begin[image];
  return job.scene.features + row * job.scene.n_features;
}

// ---- forward ------------------------------------------------------------------------------------------------------

template <typename T>
struct BlendShared {
  Batch<T> batch;
  T features[kFeatures][kWarp];
};

template <typename T>
struct Light {
  T rest;           // transmittance
  T sums[4];        // colour, depth
  int32_t last;     // entries in front of the pixel's end
  bool ended;
};

// One pass over the list: colour and depth, or (kPass = true) the features from `channel` on.
template <typename T, bool kFade, bool kPass>
__device__ void blend_spot(const Job<T>& job, const RasterImages<T>& images, int64_t task, int64_t channel,
                           BlendShared<T>& shared) {
  const RasterScene<T>& s = job.scene;
  const int lane = threadIdx.x % kWarp;
  const Spot spot(job, task);
  const int n_channels = kPass ? static_cast<int>(min(s.n_features - channel, int64_t{kFeatures})) : 0;
  Light<T> light[kHalves];
  T features[kHalves][kFeatures];
#pragma unroll
  for (int half = 0; half < kHalves; ++half) {
    light[half] = {T(1), {}, static_cast<int32_t>(spot.n), !Pixel<T>(s, spot, half, lane).inside};
    for (int c = 0; c < kFeatures; ++c) features[half][c] = 0;
  }

  for (int64_t base = 0; base < spot.n; base += kWarp) {
    if (__all_sync(kFullWarp, light[0].ended && light[1].ended)) break;
    uint32_t bits[kHalves] = {};
    __syncwarp();
    if (base + lane < spot.n) {
      const uint32_t pair = job.entries[spot.begin + base + lane].pair();
      const Record<T> record = job.records[pair];
      put(record, lane, shared.batch);
      cover(record, spot.x0, spot.y0, bits);
      if constexpr (kPass) {
        const T* row = features_of(job, spot.image, pair) + channel;
        for (int c = 0; c < kFeatures; ++c) shared.features[c][lane] = c < n_channels ? row[c] : T(0);
      }
    }
    __syncwarp();
#pragma unroll
    for (int half = 0; half < kHalves; ++half) {
      const Pixel<T> pixel(s, spot, half, lane);
      Light<T>& at = light[half];
      uint32_t mine = transpose_bits(bits[half], lane);
      if (at.ended) mine = 0;
      while (mine) {
        const int j = __ffs(mine) - 1;
        mine &= mine - 1;
        const Sight<T> sight(shared.batch, j, pixel.x, pixel.y);
        T alpha = min_of(sight.raw, T(kMaxAlpha));
        if constexpr (kFade)
          alpha = fade(alpha);
        else if (!(alpha >= T(kMinAlpha)))
          continue;
        const T weight = alpha * at.rest, rest = at.rest - weight;
        if (rest < T(kMinTransmittance)) {
          at.ended = true, at.last = static_cast<int32_t>(base) + j;
          break;
        }
        at.rest = rest;
        if constexpr (kPass) {
          for (int c = 0; c < kFeatures; ++c) features[half][c] += weight * shared.features[c][j];
        } else {
          for (int c = 0; c < 3; ++c) at.sums[c] += weight * shared.batch[kRed + c][j];
          at.sums[3] += weight * shared.batch[kDepth][j];
        }
      }
    }
  }

#pragma unroll
  for (int half = 0; half < kHalves; ++half) {
    const Pixel<T> pixel(s, spot, half, lane);
    if (!pixel.inside) continue;
    if constexpr (kPass) {
      T* to = images.features + pixel.index * s.n_features + channel;
      for (int c = 0; c < kFeatures; ++c)
        if (c < n_channels) to[c] = features[half][c];
    } else {
      const Light<T>& at = light[half];
      for (int c = 0; c < 3; ++c)
        images.color[3 * pixel.index + c] = at.sums[c] + at.rest * background_of(s, spot.image, c);
      images.alpha[pixel.index] = 1 - at.rest;
      images.depth[pixel.index] = at.sums[3];
      images.transmittance[pixel.index] = at.rest;
      images.last[pixel.index] = at.last;
    }
  }
}

template <typename T, bool kFade>
__device__ void blend_spots(const Job<T>& job, const RasterImages<T>& images, BlendShared<T>& shared) {
  const int64_t end = job.group->spot_end;
  for (int64_t task = job.group->spot_begin + int64_t{blockIdx.x} * kWarps + threadIdx.x / kWarp; task < end;
       task += int64_t{gridDim.x} * kWarps) {
    blend_spot<T, kFade, false>(job, images, task, 0, shared);
    for (int64_t channel = 0; channel < job.scene.n_features; channel += kFeatures)
      blend_spot<T, kFade, true>(job, images, task, channel, shared);
  }
}

// ---- backward -----------------------------------------------------------------------------------------------------

template <typename T>
struct BlendGradShared {
  Batch<T> batch;
  T grad[4][kHalves * kWarp];  // of colour and depth, by pixel
  T v[kWarp][kWarp];           // gradient of the exponent, by entry and pixel of a half
  T weight[kWarp][kWarp];
  T features[kFeatures][kWarp];      // by entry
  T grad_features[kFeatures][kWarp];  // by pixel of a half
};

template <typename T>
struct Behind {
  T light;  // transmittance behind the entries still to come
  T sum;    // <grad, what lies behind>, weighted
  int32_t last;
};

// The bits of entries base .. base + 31 that are in front of `last`.
__device__ inline uint32_t in_front(int64_t last, int64_t base) {
  const int64_t n = last - base;
  return n >= kWarp ? ~0u : n <= 0 ? 0u : (1u << n) - 1;
}

// <feature gradients of the lane's pixel, features of entry j>, for the entries in `mine`, into shared.v[j][lane].
template <typename T>
__device__ void dot_features(const Job<T>& job, const RasterImageGrads<T>& grads, const T* entry_features,
                             const Pixel<T>& pixel, uint32_t mine, int lane, BlendGradShared<T>& shared) {
  const int64_t n = job.scene.n_features;
  for (int64_t channel = 0; channel < n; channel += kFeatures) {
    const int n_channels = static_cast<int>(min(n - channel, int64_t{kFeatures}));
    T g[kFeatures];
    __syncwarp();
    for (int c = 0; c < kFeatures; ++c) {
      g[c] = pixel.inside && c < n_channels ? grads.features[pixel.index * n + channel + c] : T(0);
      shared.features[c][lane] = entry_features && c < n_channels ? entry_features[channel + c] : T(0);
    }
    __syncwarp();
    for (uint32_t rest = mine; rest; rest &= rest - 1) {
      const int j = __ffs(rest) - 1;
      T sum = channel ? shared.v[j][lane] : T(0);
      for (int c = 0; c < kFeatures; ++c) sum += g[c] * shared.features[c][j];
      shared.v[j][lane] = sum;
    }
  }
}

// Feature gradients of the lane's entry from the pixels in `mine`, written to or added to its slot.
template <typename T>
__device__ void sum_features(const Job<T>& job, const RasterImageGrads<T>& grads, const Pixel<T>& pixel, uint32_t mine,
                             int lane, bool add, BlendGradShared<T>& shared, T* slot) {
  const int64_t n = job.scene.n_features;
  for (int64_t channel = 0; channel < n; channel += kFeatures) {
    const int n_channels = static_cast<int>(min(n - channel, int64_t{kFeatures}));
    __syncwarp();
    for (int c = 0; c < kFeatures; ++c)
      shared.grad_features[c][lane] =
          pixel.inside && c < n_channels ? grads.features[pixel.index * n + channel + c] : T(0);
    __syncwarp();
    if (!slot) continue;
    T sums[kFeatures] = {};
    for (uint32_t rest = mine; rest; rest &= rest - 1) {
      const int p = __ffs(rest) - 1;
      for (int c = 0; c < kFeatures; ++c) sums[c] += shared.weight[lane][p] * shared.grad_features[c][p];
    }
    for (int c = 0; c < n_channels; ++c) {
      T& to = slot[kSlotFixed + channel + c];
      to = add ? to + sums[c] : sums[c];
    }
  }
}

// From back to front. With s = <grad, values of the entry> at a pixel and S the same sum over all that lies behind it,
// weighted: grad_alpha = T s - S / (1 - alpha). T before an entry is T behind it / (1 - alpha).
template <typename T, bool kFade>
__device__ void blend_spot_vjp(const Job<T>& job, const RasterImageGrads<T>& grads, int64_t task, T* slots,
                               T* spot_background, BlendGradShared<T>& shared) {
  const RasterScene<T>& s = job.scene;
  const int lane = threadIdx.x % kWarp;
  const Spot spot(job, task);
  const int64_t slot_width = kSlotFixed + s.n_features;
  Behind<T> behind[kHalves];
  T background_sums[3] = {};
  int32_t n_used = 0;
  __syncwarp();
#pragma unroll
  for (int half = 0; half < kHalves; ++half) {
    const Pixel<T> pixel(s, spot, half, lane);
    Behind<T>& at = behind[half];
    at = {T(1), T(0), 0};
    T g[4] = {};
    if (pixel.inside) {
      at.light = grads.transmittance[pixel.index];
      at.last = static_cast<int32_t>(min(int64_t{grads.last[pixel.index]}, spot.n));
      T seen = -grads.alpha[pixel.index];
      for (int c = 0; c < 3; ++c) {
        g[c] = grads.color[3 * pixel.index + c];
        seen += g[c] * background_of(s, spot.image, c);
        background_sums[c] += g[c] * at.light;
      }
      g[3] = grads.depth[pixel.index];
      at.sum = at.light * seen;
    }
    for (int c = 0; c < 4; ++c) shared.grad[c][half * kWarp + lane] = g[c];
    n_used = max(n_used, at.last);
  }
#pragma unroll
  for (int step = kWarp / 2; step > 0; step /= 2) {
    n_used = max(n_used, __shfl_xor_sync(kFullWarp, n_used, step));
    for (int c = 0; c < 3; ++c) background_sums[c] += __shfl_xor_sync(kFullWarp, background_sums[c], step);
  }
  if (lane == 0)
    for (int c = 0; c < 3; ++c) spot_background[3 * task + c] = background_sums[c];

  // Nothing behind the last entry in use has a gradient.
  const int64_t n_batches = (spot.n + kWarp - 1) / kWarp;
  for (int64_t b = n_batches - 1; b >= 0; --b) {
    const int64_t base = b * kWarp;
    uint32_t bits[kHalves] = {};
    T* slot = nullptr;
    const T* entry_features = nullptr;
    T mean_x = 0, mean_y = 0, slope = 0;
    __syncwarp();
    if (base + lane < spot.n) {
      const uint32_t pair = job.entries[spot.begin + base + lane].pair();
      const Record<T> record = job.records[pair];
      const int place = job.group->place(spots_of(record), spot.x0 / kSpot, spot.y0 / kSpot);
      slot = slots + (int64_t{job.slot_begin[pair]} + place) * slot_width;
      entry_features = features_of(job, spot.image, pair);
      put(record, lane, shared.batch);
      if (base + lane < n_used) cover(record, spot.x0, spot.y0, bits);
      mean_x = record.x, mean_y = record.y, slope = record.slope;
    }
    __syncwarp();
    T sums[kSlotFixed] = {};
    if (base < n_used) {
#pragma unroll
      for (int half = 0; half < kHalves; ++half) {
        const Pixel<T> pixel(s, spot, half, lane);
        Behind<T>& at = behind[half];
        uint32_t mine = transpose_bits(bits[half], lane) & in_front(at.last, base);
        if (s.n_features) dot_features(job, grads, entry_features, pixel, mine, lane, shared);
        T g[4];
        for (int c = 0; c < 4; ++c) g[c] = shared.grad[c][half * kWarp + lane];
        uint32_t seen = 0;
        while (mine) {
          const int j = 31 - __clz(mine);
          mine ^= 1u << j;
          const Sight<T> sight(shared.batch, j, pixel.x, pixel.y);
          T alpha = min_of(sight.raw, T(kMaxAlpha));
          T slope_of_alpha = sight.raw <= T(kMaxAlpha) ? sight.raw : T(0);
          if constexpr (kFade)
            slope_of_alpha *= fade_slope(alpha), alpha = fade(alpha);
          else if (!(alpha >= T(kMinAlpha)))
            continue;
          const T inverse = T(1) / (T(1) - alpha);
          const T light = at.light * inverse, weight = alpha * light;
          T total = s.n_features ? shared.v[j][lane] : T(0);
          for (int c = 0; c < 3; ++c) total += g[c] * shared.batch[kRed + c][j];
          total += g[3] * shared.batch[kDepth][j];
          shared.v[j][lane] = (light * total - at.sum * inverse) * slope_of_alpha;
          shared.weight[j][lane] = weight;
          at.light = light;
          at.sum += weight * total;
          seen |= 1u << j;
        }
        seen = transpose_bits(seen, lane);
        __syncwarp();
        const T x0 = T(spot.x0) + T(0.5) - mean_x;
        const T y0 = T(spot.y0 + half * (kWarp / kSpot)) + T(0.5) - mean_y;
        for (uint32_t rest = seen; rest; rest &= rest - 1) {
          const int p = __ffs(rest) - 1;
          const T dy = y0 + T(p / kSpot), u = (x0 + T(p % kSpot)) - slope * dy;
          const T v = shared.v[lane][p], weight = shared.weight[lane][p], vu = v * u;
          sums[0] += vu;
          sums[1] += v * dy;
          sums[2] += vu * u;
          sums[3] += vu * dy;
          sums[4] += v * dy * dy;
          sums[5] += v;
          for (int c = 0; c < 4; ++c) sums[6 + c] += weight * shared.grad[c][half * kWarp + p];
        }
        if (s.n_features) sum_features(job, grads, pixel, seen, lane, half > 0, shared, slot);
        __syncwarp();
      }
    } else if (slot) {
      for (int64_t c = kSlotFixed; c < slot_width; ++c) slot[c] = 0;
    }
    if (slot)
      for (int c = 0; c < kSlotFixed; ++c) slot[c] = sums[c];
  }
}

template <typename T, bool kFade>
__device__ void blend_spots_vjp(const Job<T>& job, const RasterImageGrads<T>& grads, T* slots, T* spot_background,
                                BlendGradShared<T>& shared) {
  const int64_t end = job.group->spot_end;
  for (int64_t task = job.group->spot_begin + int64_t{blockIdx.x} * kWarps + threadIdx.x / kWarp; task < end;
       task += int64_t{gridDim.x} * kWarps)
    blend_spot_vjp<T, kFade>(job, grads, task, slots, spot_background, shared);
}

}  // namespace gsim3d::raster
