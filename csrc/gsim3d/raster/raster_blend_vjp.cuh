// Inside of the CUDA rasterizer: the backward pass of raster_blend.cuh. Every entry's gradients in a quarter go to a
// slot of their own.
#pragma once

#include "gsim3d/raster/raster_blend.cuh"

namespace gsim3d::raster {

constexpr int kHalves = 2;  // of a quarter: rows 0 to 3 and 4 to 7
constexpr int kHalfRows = kQuarter / kHalves;

// Gradients of an entry: Moments (5), sum v, colour (3), depth.
constexpr int kSlotValues = 10;
template <typename T>
struct alignas(2 * sizeof(T)) SlotSums {
  T value[kSlotValues];
};

// What the gradients of a group are made of.
template <typename T>
struct Slots {
  SlotSums<T>* sums;    // [slots], unset where not live
  T* features;          // [slots, n_columns], the same
  int64_t n_columns;    // n_features, or two more: |gradient| of the mean, pixel by pixel
  unsigned char* live;  // [slots] 1 where a pixel may have seen the entry
  SlotSums<T>* unfinished;  // [n_rows] sums of an image's tiles in earlier groups
  T* backgrounds;       // [n_images * n_tiles * kQuarters, 3]
  T* viewmats;          // [n_images, kViewmatParts, 12], or null when they are not asked for
};

// What one pixel tells one entry: the gradient v of the exponent, and the weight of the entry's values.
template <typename T>
struct alignas(2 * sizeof(T)) Share {
  T v, weight;
};
template <typename T>
struct alignas(4 * sizeof(T)) PixelGrad {
  T value[4];  // of colour and depth
};

template <typename T, bool kWithFeatures>
struct BlendGradShared {
  Batch<T> batch;
  PixelGrad<T> grad[kHalves * kWarp];
  // By pixel of a half and entry. One column more than entries: neither writing one entry's column nor reading one
  // pixel's row has bank conflicts.
  Share<T> shares[kWarp][kWarp + 1];
  T features[kWithFeatures ? kFeatures : 1][kWarp];       // by entry
  T grad_features[kWithFeatures ? kFeatures : 1][kWarp];  // by pixel of a half
};

// Sums of v over the pixels of a quarter, (x, y) counted from its centre.
template <typename T>
struct QuarterSums {
  T one = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0;

  // The same with u = x - slope y + u0 and y + y0 in place of x and y.
  __device__ void finish(T u0, T y0, T slope, SlotSums<T>& to) const {
    const T u = x - slope * y;  // before the shift
    to.value[0] = u + u0 * one;
    to.value[1] = y + y0 * one;
    to.value[2] = (xx - slope * (T(2) * xy - slope * yy)) + u0 * (T(2) * u + u0 * one);
    to.value[3] = (xy - slope * yy + u0 * y) + y0 * (u + u0 * one);
    to.value[4] = yy + y0 * (T(2) * y + y0 * one);
    to.value[5] = one;
  }
};

template <typename T>
struct Behind {
  T light;  // transmittance behind the entries still to come
  T sum;    // <grad, what lies behind>, weighted
  int32_t last;
};

// The bits of entries base .. base + 31 that are in front of `last`.
__device__ inline uint32_t in_front(int32_t last, int32_t base) {
  const int32_t n = last - base;
  return n >= kWarp ? ~0u : n <= 0 ? 0u : (1u << n) - 1;
}

// Into shared.shares[lane][j].v, for the entries j in `mine`: <feature gradients of the lane's pixel, features of j>.
template <typename T>
__device__ void dot_features(const RasterScene<T>& s, const RasterImageGrads<T>& grads, const T* entry_features,
                             int64_t pixel, uint32_t mine, int lane, BlendGradShared<T, true>& shared) {
  for (uint32_t rest = mine; rest; rest &= rest - 1) shared.shares[lane][__ffs(rest) - 1].v = 0;
  for (int64_t channel = 0; channel < s.n_features; channel += kFeatures) {
    const int n_channels = static_cast<int>(min(s.n_features - channel, int64_t{kFeatures}));
    T g[kFeatures];
    __syncwarp();
    for (int c = 0; c < kFeatures; ++c) {
      const bool is = pixel >= 0 && c < n_channels;
      g[c] = is ? value_or_zero(grads.features, pixel * s.n_features + channel + c) : T(0);
      shared.features[c][lane] = entry_features && c < n_channels ? entry_features[channel + c] : T(0);
    }
    __syncwarp();
    for (uint32_t rest = mine; rest; rest &= rest - 1) {
      const int j = __ffs(rest) - 1;
      for (int c = 0; c < kFeatures; ++c) shared.shares[lane][j].v += g[c] * shared.features[c][j];
    }
  }
}

// Feature gradients of the lane's entry from the pixels of a half, written to or added to its slot.
template <typename T>
__device__ void sum_features(const RasterScene<T>& s, const RasterImageGrads<T>& grads, int64_t pixel, int lane,
                             uint32_t seen_by, bool add, BlendGradShared<T, true>& shared, T* slot) {
  for (int64_t channel = 0; channel < s.n_features; channel += kFeatures) {
    const int n_channels = static_cast<int>(min(s.n_features - channel, int64_t{kFeatures}));
    __syncwarp();
    for (int c = 0; c < kFeatures; ++c)
      shared.grad_features[c][lane] =
          pixel >= 0 && c < n_channels ? value_or_zero(grads.features, pixel * s.n_features + channel + c) : T(0);
    __syncwarp();
    if (!slot) continue;
    T sums[kFeatures] = {};
    for (uint32_t rest = seen_by; rest; rest &= rest - 1) {
      const int p = __ffs(rest) - 1;
      for (int c = 0; c < kFeatures; ++c) sums[c] += shared.shares[p][lane].weight * shared.grad_features[c][p];
    }
    for (int c = 0; c < n_channels; ++c) {
      T& to = slot[channel + c];
      to = add ? to + sums[c] : sums[c];
    }
  }
}

// From back to front. With s = <grad, values of the entry> at a pixel and S the same sum over all that lies behind it,
// weighted: grad_alpha = T s - S / (1 - alpha). T before an entry is T behind it / (1 - alpha).
template <typename T, bool kFade, bool kWithFeatures, bool kAbsolute>
__device__ void blend_quarter_vjp(const Job<T>& job, const RasterImageGrads<T>& grads, int64_t index,
                                  const Slots<T>& slots, BlendGradShared<T, kWithFeatures>& shared) {
  const RasterScene<T>& s = job.scene;
  const int lane = threadIdx.x % kWarp;
  const Quarter quarter(job, index);
  const uint32_t* pairs = job.listed + job.lists[quarter.index].begin;
  Behind<T> behind[kHalves];
  T background_sums[3] = {};
  int32_t n_used = 0;
#pragma unroll
  for (int half = 0; half < kHalves; ++half) {
    const int64_t pixel = pixel_of(s, quarter, lane % kQuarter, lane / kQuarter + half * kHalfRows);
    Behind<T>& at = behind[half];
    at = {T(1), T(0), 0};
    T g[4] = {};
    if (pixel >= 0) {
      at.light = grads.transmittance[pixel];
      at.last = min(grads.last[pixel], quarter.n);
      T seen = -value_or_zero(grads.alpha, pixel);
      for (int c = 0; c < 3; ++c) {
        g[c] = value_or_zero(grads.color, 3 * pixel + c);
        seen += g[c] * background_of<T>(s, quarter.image, c);
        background_sums[c] += g[c] * at.light;
      }
      g[3] = value_or_zero(grads.depth, pixel);
      at.sum = at.light * seen;
    }
    for (int c = 0; c < 4; ++c) shared.grad[half * kWarp + lane].value[c] = g[c];
    n_used = max(n_used, at.last);
  }
#pragma unroll
  for (int step = kWarp / 2; step > 0; step /= 2) {
    n_used = max(n_used, __shfl_xor_sync(kFullWarp, n_used, step));
    for (int c = 0; c < 3; ++c) background_sums[c] += __shfl_xor_sync(kFullWarp, background_sums[c], step);
  }
  if (lane == 0)
    for (int c = 0; c < 3; ++c) slots.backgrounds[3 * quarter.index + c] = background_sums[c];

  // The records of a batch are fetched while the batch before is in work, their numbers another batch earlier.
  int32_t base = (n_used - 1) / kWarp * kWarp;  // what is behind the last entry in use has no gradients
  uint32_t pair = 0, next_pair = base + lane < n_used ? pairs[base + lane] : 0, slot_begin = 0;
  Record<T> record{};
  const auto fetch = [&](int32_t base) {
    pair = next_pair;
    if (base >= 0 && base + lane < n_used) load_record(job.records + pair, record), slot_begin = job.slot_begin[pair];
    if (base >= kWarp) next_pair = pairs[base - kWarp + lane];
  };
  fetch(base);
  const Group group = *job.group;
  const T x = in_register(T(lane % kQuarter));
  for (; base >= 0 && n_used > 0; base -= kWarp) {
    const bool used = base + lane < n_used;
    uint32_t bits[kHalves] = {};
    if (used) {
      put(record, quarter, lane, shared.batch);
      uint32_t spans[kQuarter];
      cover(record, quarter, spans);
#pragma unroll
      for (int row = 0; row < kQuarter; ++row) bits[row / kHalfRows] |= spans[row] << (row % kHalfRows * kQuarter);
    }
    const T from_x = T(quarter.x0 + kQuarter / 2) - record.x, from_y = T(quarter.y0 + kQuarter / 2) - record.y;
    const T slope = record.slope;
    const T tight = record.tight * record.tight * T(1 / kLog2eHalf);  // of Footprint
    const T loose = record.loose * record.loose * T(1 / kLog2eHalf);
    const T* entry_features = kWithFeatures && used ? s.features + features_of(job, quarter.image, pair) : nullptr;
    int64_t slot = 0;
    if (used) {
      const PixelRect bounds{record.x0, record.x1, record.y0, record.y1};
      slot = int64_t{slot_begin} + group.slot(squares_of(bounds, kTile), squares_of(bounds, kQuarter),
                                              quarter.x0 / kTile, quarter.y0 / kTile, quarter.index % kQuarters);
    }
    __syncwarp();
    fetch(base - kWarp);

    SlotSums<T> sums{};
    QuarterSums<T> moments;
    T absolute[2] = {};
    uint32_t live = 0;  // not 0: a pixel may have seen the entry
#pragma unroll
    for (int half = 0; half < kHalves; ++half) {
      const T y = T(lane / kQuarter + half * kHalfRows);
      Behind<T>& at = behind[half];
      const uint32_t front = in_front(at.last, base);
      uint32_t mine = transpose_bits(bits[half], lane) & front;
      const int64_t pixel =
          kWithFeatures ? pixel_of(s, quarter, lane % kQuarter, lane / kQuarter + half * kHalfRows) : 0;
      if constexpr (kWithFeatures) dot_features(s, grads, entry_features, pixel, mine, lane, shared);
      const PixelGrad<T> g = shared.grad[half * kWarp + lane];
      // The alpha of the next entry is on the way while this one is in work.
      int next = kWarp - 1 - __clz(mine | 1);
      T next_full = alpha_at(shared.batch, next, x, y);
      while (mine) {
        const int j = next;
        const T full = next_full;
        mine ^= 1u << j;
        next = kWarp - 1 - __clz(mine | 1), next_full = alpha_at(shared.batch, next, x, y);
        Share<T>& share = shared.shares[lane][j];
        const T raw = full >= T(kMinAlpha) ? full : T(0);  // an entry that does not count leaves zeros
        T alpha = min_of(raw, T(kMaxAlpha));
        T slope_of_alpha = raw <= T(kMaxAlpha) ? raw : T(0);
        if constexpr (kFade) slope_of_alpha *= fade_slope(alpha), alpha = fade(alpha);
        const T inverse = fast_reciprocal(T(1) - alpha);
        const T light = at.light * inverse, weight = alpha * light;
        T total = kWithFeatures ? share.v : T(0);
        const auto value = shared.batch.values[j];
        total += g.value[0] * value.red, total += g.value[1] * value.green;
        total += g.value[2] * value.blue, total += g.value[3] * value.depth;
        share = {(light * total - at.sum * inverse) * slope_of_alpha, weight};
        at.light = light;
        at.sum += weight * total;
      }
      // Pixels that have visited the lane's entry, and those that have visited any.
      const bool all_in_front = __all_sync(kFullWarp, front == ~0u);
      const uint32_t visited_by = bits[half] & (all_in_front ? ~0u : transpose_bits(front, lane));
      const uint32_t visitors = __reduce_or_sync(kFullWarp, visited_by);
      live |= visited_by;
      __syncwarp();
#pragma unroll
      for (int row = 0; row < kHalfRows; ++row) {
        if (!(visitors >> row * kQuarter & (1u << kQuarter) - 1)) continue;
        T one = 0, vx = 0, vxx = 0;
#pragma unroll
        for (int column = 0; column < kQuarter; ++column) {
          const int p = row * kQuarter + column;
          Share<T> share = shared.shares[p][lane];  // loaded in any case, which is cheaper than to ask first
          share.v = visited_by >> p & 1 ? share.v : T(0), share.weight = visited_by >> p & 1 ? share.weight : T(0);
          const PixelGrad<T> grad = shared.grad[half * kWarp + p];
          const T from_centre = T(column) - T(kQuarter - 1) / 2;
          if constexpr (kAbsolute) {
            const T dy = from_y + (T(half * kHalfRows + row) - T(kQuarter - 1) / 2);
            const T by_u = share.v * (tight * (from_x + from_centre - slope * dy));
            absolute[0] += abs_of(by_u), absolute[1] += abs_of(share.v * (loose * dy) - slope * by_u);
          }
          one += share.v, vx += share.v * from_centre, vxx += share.v * (from_centre * from_centre);
          for (int c = 0; c < 4; ++c) sums.value[6 + c] += share.weight * grad.value[c];
        }
        const T from_centre = T(half * kHalfRows + row) - T(kQuarter - 1) / 2;
        moments.one += one, moments.x += vx, moments.xx += vxx;
        moments.y += one * from_centre, moments.xy += vx * from_centre, moments.yy += one * (from_centre * from_centre);
      }
      if constexpr (kWithFeatures)
        sum_features(s, grads, pixel, lane, visited_by, half > 0, shared,
                     used ? slots.features + slot * slots.n_columns : nullptr);
      __syncwarp();
    }
    if (live) {
      moments.finish(from_x - slope * from_y, from_y, slope, sums);
      slots.sums[slot] = sums;
      for (int i = 0; i < 2 && kAbsolute; ++i)
        slots.features[slot * slots.n_columns + s.n_features + i] = absolute[i];
      slots.live[slot] = 1;
    }
  }
}

template <typename T, bool kFade, bool kAbsolute, bool kWithFeatures>
__device__ void blend_tiles_vjp(const Job<T>& job, const RasterImageGrads<T>& grads, const Slots<T>& slots,
                                BlendGradShared<T, kWithFeatures>& shared) {
  for (WarpQuarters quarters(job); quarters.more(); quarters.next())
    blend_quarter_vjp<T, kFade, kWithFeatures, kAbsolute>(job, grads, quarters.index(), slots, shared);
}

}  // namespace gsim3d::raster
