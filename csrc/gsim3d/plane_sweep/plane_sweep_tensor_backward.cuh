// The backward pass of the sweep on tensor cores: gradients of scores, what references gather, what sources get.
#pragma once

#include "gsim3d/plane_sweep/plane_sweep_halves.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kScored = 560;  // source pixels with scores, or gradients of them, in shared memory
static_assert(kScored % 16 == 0);
constexpr int kScoreStride = kTile + 4;  // spreads a warp's accesses over the banks

constexpr int kRun = 8;   // source pixels side by side
constexpr int kRuns = 4;  // of a block, one below the other
constexpr int kTotalStride = kRun * kRuns + 4;
constexpr int kCapacity = 832;  // of a tile, for all pixels that most tiles touch
constexpr int64_t kKeptBytes = int64_t{768} << 20;

// What a launch takes over from the one before it and leaves to the next: sums of pairs that did not fit one launch.
struct Relay {
  float* memory;  // [blocks, slots(), kTileThreads]
  bool first, last;

  static constexpr int kSums = 32;  // of a thread
  __host__ __device__ static constexpr int slots(bool whole) { return whole ? kSums : 2 * kSums + 3; }
  __device__ __forceinline__ float* of_thread(int64_t block) const {
    return memory + block * slots(first && last) * kTileThreads + threadIdx.x;
  }
};

// A thread's sums over pairs, in registers as long as one pair has the same unit as the next. Where units differ what
// there is moves to memory, and so what the sums are does not depend on how pairs are shared among launches.
class PairSums {
 public:
  float scaled[2][4][4] = {};
  int turn = 0;

  __device__ __forceinline__ PairSums(const Relay& relay, int64_t block)
      : memory_(relay.of_thread(block)), begun_(!relay.first), moved_(!relay.first) {
    if (relay.first) return;
    for_sums([&](int i, float& sum) { sum = slot(kSums + i); });
    unit_ = Unit(slot(2 * kSums), slot(2 * kSums + 1));
    turn = __float_as_int(slot(2 * kSums + 2));
  }

  // Before the products of a pair.
  __device__ __forceinline__ void start(const Unit& unit) {
    if (begun_ && unit != unit_) {
      for_sums([&](int i, float& sum) {
        slot(i) = (moved_ ? slot(i) : 0.0f) + unit_(sum);
        sum = 0;
      });
      moved_ = true;
    }
    begun_ = true;
    unit_ = unit;
  }

  __device__ __forceinline__ void leave() {
    for_sums([&](int i, float& sum) {
      if (!moved_) slot(i) = 0;
      slot(kSums + i) = sum;
    });
    slot(2 * kSums) = unit_.lesser;
    slot(2 * kSums + 1) = unit_.greater;
    slot(2 * kSums + 2) = __int_as_float(turn);
  }

  // The sums become what they stand for; 0 is positive.
  __device__ __forceinline__ void finish() {
    for_sums([&](int i, float& sum) { sum = (moved_ ? slot(i) : 0.0f) + unit_(sum); });
  }

 private:
  static constexpr int kSums = Relay::kSums;

  template <typename F>
  __device__ __forceinline__ void for_sums(const F& f) {
#pragma unroll
    for (int i = 0; i < kSums; ++i) f(i, scaled[i / 16][i / 4 % 4][i % 4]);
  }
  __device__ __forceinline__ float& slot(int i) const { return memory_[i * kTileThreads]; }

  float* memory_;
  Unit unit_{1.0f, 1.0f};
  bool begun_, moved_;
};

// Gradients of the scores of tiles [first_tile, first_tile + n_tiles) of every image with the sources of pairs
// [first_pair, first_pair + n_pairs), for ranks [first_rank, first_rank + capacity) of what a tile touches.
struct KeptScores {
  __half* rows;       // [n_pairs, n_tiles, capacity, 2, kTile], high and low
  uint32_t* runs;     // [n_pairs, height * columns, n_tiles]: who is touched in a run, above that the first one's rank
  int32_t* counts;    // [all pairs, all tiles], how much a tile touches
  int32_t* longest;   // the largest of them
  float* inverses;    // [n_images], what the scale of an image's gradients is undone by
  int64_t first_pair, n_pairs;
  int32_t first_tile, n_tiles, first_rank, capacity;

  __device__ __forceinline__ bool over() const { return first_rank > 0 && *longest <= first_rank; }
  __device__ __forceinline__ __half* rows_of(int64_t pair, int32_t tile) const {
    return rows + ((pair - first_pair) * n_tiles + tile - first_tile) * capacity * 2 * kTile;
  }
  __device__ __forceinline__ int32_t* count_of(const TileSizes& s, int64_t pair, int32_t tile) const {
    return counts + pair * s.n_tiles + tile;
  }
  __device__ __forceinline__ uint32_t* runs_of(const TileSizes& s, int64_t pair, int32_t run) const {
    return runs + ((pair - first_pair) * s.height * s.columns + run) * n_tiles;
  }
};

__device__ void keep_runs(const Word* words, const TileSizes& s, const KeptScores& kept, int64_t pair, int32_t tile) {
  for (int32_t run = threadIdx.x; run < s.height * s.columns; run += kTileThreads) {
    const int32_t y = run / s.columns, x = (run - y * s.columns) * kRun, at = (y + 1) * s.stride + x + 1;
    const Word word = words[at >> 5];
    const uint32_t next = (at >> 5) + 1 < s.n_words ? words[(at >> 5) + 1].bits : 0;
    const uint32_t bits = __funnelshift_r(word.bits, next, at & 31) & ((1u << min(kRun, s.width - x)) - 1);
    const uint32_t rank = word.before + __popc(word.bits & ((1u << (at & 31)) - 1));
    kept.runs_of(s, pair, run)[tile - kept.first_tile] = rank << kRun | bits;
  }
}

// What a sample gives one of its four corners.
struct Corner {
  uint32_t rank;  // kNone: nothing
  float grad;
};
constexpr uint32_t kNone = ~0u;

// The corners of samples of kTileWarps depths from `first_depth` on, by the parity of their column and row: no two
// kinds touch the same source pixel.
__device__ __forceinline__ void place_corners(const TileLines& lines, const TileMemory& memory, const TileSizes& s,
                                              const float* __restrict__ grad /* of the image and pixel */, float scale,
                                              int32_t first_depth, int32_t first,
                                              Corner* corners /* [4, kTileWarps, kTile] */) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const int32_t k = first_depth + warp;
  Corner* to = corners + warp * kTile + lane;
  constexpr int kKind = kTileWarps * kTile;
  Place<float> place{};
  if (k < s.n_depths) place = lines.at(memory.depths[k], s);
  if (!place.inside) {
#pragma unroll
    for (int kind = 0; kind < 4; ++kind) to[kind * kKind] = {kNone, 0.0f};
    return;
  }
  const int32_t top = table_index(place, s);
  const uint32_t above = rank_of(memory.words, top) - first, below = rank_of(memory.words, top + s.stride) - first;
  float values[4] = {};
  interpolate_vjp(values[0], values[1], values[2], values[3], place.fx, place.fy,
                  grad[int64_t{k} * s.n_pixels] * scale);
  const int kind = (place.x & 1) | (place.y & 1) << 1;
  to[kind * kKind] = {above, values[0]};
  to[(kind ^ 1) * kKind] = {above + 1, values[1]};
  to[(kind ^ 2) * kKind] = {below, values[2]};
  to[(kind ^ 3) * kKind] = {below + 1, values[3]};
}

// grads[r, p] += gradient of the score of own pixel p and the source pixel with rank first + r. Four warps take a kind
// of corners each.
__device__ void add_score_gradients(const TileLines& lines, const TileMemory& memory, const TileSizes& s,
                                    const float* __restrict__ grad, float scale, int32_t first, int32_t rows,
                                    Corner* corners, float* grads) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  uint32_t current = kNone;
  float sum = 0;
  const auto flush = [&] {
    if (current < static_cast<uint32_t>(rows)) grads[current * kScoreStride + lane] += sum;
  };
  for (int32_t depth = 0; depth < s.n_depths; depth += kTileWarps) {
    place_corners(lines, memory, s, grad, scale, depth, first, corners);
    __syncthreads();
    if (warp < 4) {
#pragma unroll
      for (int k = 0; k < kTileWarps; ++k) {
        const Corner corner = corners[(warp * kTileWarps + k) * kTile + lane];
        if (corner.rank != current) {
          flush();
          current = corner.rank;
          sum = 0;
        }
        sum += corner.grad;
      }
    }
    __syncthreads();
  }
  if (warp < 4) flush();
  __syncthreads();
}

// Two rows of gradients become pairs of halves of both, high in the first and low in the second; `to`: where they are
// kept as halves of a row each, null: nowhere. The border has no features to gather.
__device__ __forceinline__ void split_gradients(float* grads, const int32_t* list, int32_t rows,
                                                __half* __restrict__ to) {
  for (int32_t i = threadIdx.x; i < (rows + 15) / 16 * 8 * (kTile / 4); i += kTileThreads) {
    const int32_t r = i / (kTile / 4) * 2, p = i % (kTile / 4) * 4;
    float* first = grads + r * kScoreStride + p;
    float4 a = load4(first), b = load4(first + kScoreStride);
    if (r < rows && list[r] < 0) a = make_float4(0, 0, 0, 0);
    if (r + 1 < rows && list[r + 1] < 0) b = make_float4(0, 0, 0, 0);
    const Halves pairs[4] = {Halves(a.x, b.x), Halves(a.y, b.y), Halves(a.z, b.z), Halves(a.w, b.w)};
    *reinterpret_cast<uint4*>(first) = make_uint4(pairs[0].high, pairs[1].high, pairs[2].high, pairs[3].high);
    *reinterpret_cast<uint4*>(first + kScoreStride) =
        make_uint4(pairs[0].low, pairs[1].low, pairs[2].low, pairs[3].low);
    if (!to) continue;
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      if (r + half >= rows) break;
      const unsigned which = half ? 0x7632 : 0x5410;
      uint2* kept = reinterpret_cast<uint2*>(to + int64_t{r + half} * 2 * kTile + p);
      kept[0] = make_uint2(__byte_perm(pairs[0].high, pairs[1].high, which),
                           __byte_perm(pairs[2].high, pairs[3].high, which));
      kept[kTile / 4] = make_uint2(__byte_perm(pairs[0].low, pairs[1].low, which),
                                   __byte_perm(pairs[2].low, pairs[3].low, which));
    }
  }
}

// sums[m][n] += the part of a warp in the product of the listed source pixels' features and split `grads`: its 32
// channels, of which row g + 8 h of product m holds 4 g + 2 m + h, and every `ways`-th sixteen source pixels.
__device__ __forceinline__ void gather_features(const __half* __restrict__ source /* from the warp's channel on */,
                                                int32_t channels, const int32_t* list, int32_t rows, const float* grads,
                                                int way, int ways, float (&sums)[2][4][4]) {
  const int g = threadIdx.x % kWarp / 4, t = threadIdx.x % 4;
  for (int32_t r = way * 16; r < rows; r += ways * 16) {
    uint2 high[4], low[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const int32_t entry = list[min(r + i / 2 * 8 + 2 * t + i % 2, rows - 1)];
      const __half* from = source + int64_t{nearest(entry)} * 2 * channels + 4 * g;
      high[i] = *reinterpret_cast<const uint2*>(from);
      low[i] = *reinterpret_cast<const uint2*>(from + channels);
    }
    const auto first_of = [](uint32_t a, uint32_t b) { return __byte_perm(a, b, 0x5410); };
    const auto second_of = [](uint32_t a, uint32_t b) { return __byte_perm(a, b, 0x7632); };
    const uint4 a_high[2] = {{first_of(high[0].x, high[1].x), second_of(high[0].x, high[1].x),
                              first_of(high[2].x, high[3].x), second_of(high[2].x, high[3].x)},
                             {first_of(high[0].y, high[1].y), second_of(high[0].y, high[1].y),
                              first_of(high[2].y, high[3].y), second_of(high[2].y, high[3].y)}};
    const uint4 a_low[2] = {{first_of(low[0].x, low[1].x), second_of(low[0].x, low[1].x),
                             first_of(low[2].x, low[3].x), second_of(low[2].x, low[3].x)},
                            {first_of(low[0].y, low[1].y), second_of(low[0].y, low[1].y),
                             first_of(low[2].y, low[3].y), second_of(low[2].y, low[3].y)}};
    const uint32_t* pairs = reinterpret_cast<const uint32_t*>(grads) + (r + 2 * t) * kScoreStride + g;
#pragma unroll
    for (int n = 0; n < 4; ++n) {
      const uint2 b_high = {pairs[n * 8], pairs[8 * kScoreStride + n * 8]};
      const uint2 b_low = {pairs[kScoreStride + n * 8], pairs[9 * kScoreStride + n * 8]};
#pragma unroll
      for (int m = 0; m < 2; ++m) multiply_add(sums[m][n], a_high[m], a_low[m], b_high, b_low);
    }
  }
}

int64_t backward_bytes(const TileSizes& s) {
  return TileMemory::bytes(s, kScored) + 4 * kTileWarps * kTile * sizeof(Corner) +
         std::max<int64_t>(s.n_words * 32, kScored * kScoreStride * sizeof(float));
}

// The power of two for gradients of scores: n_depths gradients of costs add up to what half precision holds.
__device__ __forceinline__ HalfScale score_gradient_scale(const uint32_t* __restrict__ largest /* of the image */,
                                                          const PlaneSweep<float>& sweep) {
  const float per_cost = static_cast<float>(sweep.n_depths) * rsqrtf(static_cast<float>(sweep.channels));
  return HalfScale(fminf(largest_of(largest) * per_cost, 0x1p126f));
}

// A block owns a tile of reference pixels: it keeps the gradients of their scores for the sources and gathers what the
// references get.
__global__ void __launch_bounds__(kTileThreads, 2)
    tile_gradients_kernel(const float* __restrict__ grad, const uint32_t* __restrict__ largest_grad, SweepHalves halves,
                          PlaneSweep<float> sweep, TileSizes s, KeptScores kept, Relay relay,
                          float* __restrict__ grad_features) {
  extern __shared__ __align__(16) char shared[];
  if (kept.over()) return;
  char* at = shared;
  const TileMemory memory(at, s, kScored);
  Corner* corners = carve<Corner>(at, 4 * kTileWarps * kTile);
  uint8_t* flags = reinterpret_cast<uint8_t*>(at);
  float* grads = reinterpret_cast<float*>(at);  // [kScored, kScoreStride]
  const int64_t image = blockIdx.x / kept.n_tiles;
  const int32_t tile = kept.first_tile + static_cast<int32_t>(blockIdx.x % kept.n_tiles);
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const int32_t first_channel = blockIdx.y * kChannels;
  const int groups = min(s.channels - first_channel, kChannels) / 32, ways = kTileWarps / groups;
  const int32_t channel = first_channel + warp % groups * 32;
  const TilePixel pixel(tile, s);
  const float* own_grad = grad + image * s.n_depths * s.n_pixels + pixel.v * s.width + pixel.u;
  const Range pairs = range_of(sweep.cu_src, image, sweep.n_pairs);
  const HalfScale scale = score_gradient_scale(largest_grad + image * kParts, sweep);
  if (tile == kept.first_tile && blockIdx.y == 0 && threadIdx.x == 0) kept.inverses[image] = scale.inverse;
  const float grad_scale = cost_scale<float>(pairs, sweep.channels) * scale.scale;
  memory.fill_depths(sweep, image);
  PairSums sums(relay, (blockIdx.y * sweep.n_images + image) * s.n_tiles + tile);
  bool gathers = kept.first_rank == 0;

  const int64_t end_pair = min(pairs.end, kept.first_pair + kept.n_pairs);
  for (int64_t pair = max(pairs.begin, kept.first_pair); pair < end_pair; ++pair) {
    const int64_t source = sweep.src_images[pair];
    if (!inside(source, sweep.n_images)) continue;
    if (kept.first_rank > 0 && *kept.count_of(s, pair, tile) <= kept.first_rank) continue;
    const TileLines lines(sweep.homographies + 9 * pair, sweep.translations + 3 * pair, pixel);
    const int32_t count = mark_lines(lines, memory.depths, 0, s.n_depths, s, flags, memory.sums, memory.words);
    if (blockIdx.y == 0) {
      keep_runs(memory.words, s, kept, pair, tile);
      if (kept.first_rank == 0 && threadIdx.x == 0) {
        *kept.count_of(s, pair, tile) = count;
        atomicMax(kept.longest, count);
      }
    }
    gathers = true;
    sums.start(Unit(scale.inverse, halves.inverses[source]));
    const int32_t end = min(count, kept.first_rank + kept.capacity);
    for (int32_t first = kept.first_rank; first < end; first += kScored) {
      const int32_t rows = min(end - first, kScored);
      list_pixels(memory.words, s, first, rows, memory.list);
      for (int32_t i = threadIdx.x; i < (rows + 15) / 16 * 16 * kScoreStride / 4; i += kTileThreads)
        reinterpret_cast<float4*>(grads)[i] = make_float4(0, 0, 0, 0);
      add_score_gradients(lines, memory, s, own_grad, grad_scale, first, rows, corners, grads);
      __half* to = kept.rows_of(pair, tile) + int64_t{first - kept.first_rank} * 2 * kTile;
      split_gradients(grads, memory.list, rows, blockIdx.y == 0 ? to : nullptr);
      __syncthreads();
      if (warp < groups * ways)
        gather_features(halves.rows + source * s.n_pixels * 2 * s.channels + channel, s.channels, memory.list, rows,
                        grads, warp / groups, ways, sums.scaled);
      __syncthreads();
    }
  }

  if (!relay.last) return sums.leave();
  if (relay.first && !gathers) return;
  sums.finish();
  float* total = grads;  // [channels, kScoreStride]
  const int g = lane / 4, t = lane % 4;
  for (int way = 0; way < ways; ++way) {
    if (warp / groups == way) {
#pragma unroll
      for (int m = 0; m < 2; ++m)
#pragma unroll
        for (int n = 0; n < 4; ++n)
#pragma unroll
          for (int e = 0; e < 4; ++e) {
            float& sum = total[(warp % groups * 32 + 4 * g + 2 * m + e / 2) * kScoreStride + n * 8 + 2 * t + e % 2];
            sum = way > 0 ? sum + sums.scaled[m][n][e] : sums.scaled[m][n][e];
          }
    }
    __syncthreads();
  }
  if (!pixel.here) return;
  for (int32_t c = warp; c < groups * 32; c += kTileWarps) {
    if (first_channel + c >= sweep.channels) break;
    float& to = grad_features[(image * sweep.channels + first_channel + c) * s.n_pixels + pixel.v * s.width + pixel.u];
    const float sum = total[c * kScoreStride + lane];
    to = kept.first_rank > 0 ? to + sum : sum;
  }
}

// A block owns kRuns runs of source pixels and adds what the kept scores give them, by pairs, then by tiles. A warp
// takes 32 channels and every `ways`-th tile.
__global__ void __launch_bounds__(kTileThreads, 2)
    source_gradients_kernel(SweepHalves halves, PlaneSweep<float> sweep, TileSizes s, KeptScores kept, Relay relay,
                            int32_t blocks_per_image, float* __restrict__ grad_features) {
  __shared__ float total[kChannels * kTotalStride];
  if (kept.over()) return;
  const int64_t image = blockIdx.x / blocks_per_image;
  const int32_t block = blockIdx.x % blocks_per_image, column = block % s.columns, top = block / s.columns * kRuns;
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, g = lane / 4, t = lane % 4;
  const int32_t first_channel = blockIdx.y * kChannels;
  const int groups = min(s.channels - first_channel, kChannels) / 32, ways = kTileWarps / groups;
  const int32_t channel = first_channel + warp % groups * 32;
  const int way = warp / groups;
  PairSums sums(relay, int64_t{blockIdx.y} * gridDim.x + blockIdx.x);
  static_assert(kRuns == 4);
  bool gathers = false;
  for (int64_t begin = kept.first_pair; begin < kept.first_pair + kept.n_pairs; begin += kWarp) {
    const bool ours = begin + lane < kept.first_pair + kept.n_pairs && sweep.src_images[begin + lane] == image;
    for (unsigned waiting = __ballot_sync(kFullWarp, ours); waiting; waiting &= waiting - 1) {
      const int64_t pair = begin + __ffs(waiting) - 1, owner = owner_of(sweep, pair);
      if (owner < 0) continue;
      sums.start(Unit(kept.inverses[owner], halves.inverses[owner]));
      for (int32_t first = 0; first < kept.n_tiles; first += kWarp) {
        uint32_t runs[kRuns], any = 0;
        bool reaches = first + lane < kept.n_tiles;
        if (kept.first_rank > 0 && reaches)
          reaches = *kept.count_of(s, pair, kept.first_tile + first + lane) > kept.first_rank;
#pragma unroll
        for (int i = 0; i < kRuns; ++i) {
          const bool here = reaches && top + i < s.height;
          runs[i] = here ? kept.runs_of(s, pair, (top + i) * s.columns + column)[first + lane] : 0;
          const int32_t rank = runs[i] >> kRun;
          if (rank + kRun <= kept.first_rank || rank >= kept.first_rank + kept.capacity) runs[i] = 0;
          any |= runs[i] & ((1u << kRun) - 1);
        }
        for (unsigned hits = __ballot_sync(kFullWarp, any != 0); hits; hits &= hits - 1, ++sums.turn) {
          gathers = true;
          if (sums.turn % ways != way) continue;
          const int hit = __ffs(hits) - 1;
          const int32_t tile = kept.first_tile + first + hit;
          const uint4* own = reinterpret_cast<const uint4*>(halves.tiles) +
                             ((owner * s.n_tiles + tile) * s.channels + channel) / 16 * 4 * kWarp + lane;
          uint4 fragments[2][4];  // of each sixteen channels: two high, two low
#pragma unroll
          for (int m = 0; m < 2; ++m)
#pragma unroll
            for (int f = 0; f < 4; ++f) fragments[m][f] = own[(m * 4 + f) * kWarp];
          const __half* rows = kept.rows_of(pair, tile) + 8 * t;
          // All runs at once, so that their loads wait together.
          uint4 high[kRuns], low[kRuns];
          uint32_t touched[kRuns];
#pragma unroll
          for (int i = 0; i < kRuns; ++i) {
            const uint32_t run = __shfl_sync(kFullWarp, runs[i], hit);
            touched[i] = run & ((1u << kRun) - 1);
            const uint32_t row = (run >> kRun) + __popc(touched[i] & ((1u << g) - 1)) - kept.first_rank;
            high[i] = low[i] = make_uint4(0, 0, 0, 0);
            if (touched[i] >> g & 1 && row < static_cast<uint32_t>(kept.capacity)) {
              high[i] = load8(rows + static_cast<int64_t>(row) * 2 * kTile);
              low[i] = load8(rows + static_cast<int64_t>(row) * 2 * kTile + kTile);
            }
          }
#pragma unroll
          for (int i = 0; i < kRuns; ++i) {
            if (!touched[i]) continue;
#pragma unroll
            for (int m = 0; m < 2; ++m) {
              multiply_add(sums.scaled[m][i], fragments[m][0], fragments[m][2], {high[i].x, high[i].y},
                           {low[i].x, low[i].y});
              multiply_add(sums.scaled[m][i], fragments[m][1], fragments[m][3], {high[i].z, high[i].w},
                           {low[i].z, low[i].w});
            }
          }
        }
      }
    }
  }

  if (!relay.last) return sums.leave();
  if (relay.first && !gathers) return;
  sums.finish();
  for (int w = 0; w < ways; ++w) {
    if (way == w) {
#pragma unroll
      for (int m = 0; m < 2; ++m)
#pragma unroll
        for (int i = 0; i < kRuns; ++i)
#pragma unroll
          for (int e = 0; e < 4; ++e) {
            const int c = warp % groups * 32 + m * 16 + e / 2 * 8 + g;
            float& sum = total[c * kTotalStride + i * kRun + 2 * t + e % 2];
            sum = w > 0 ? sum + sums.scaled[m][i][e] : sums.scaled[m][i][e];
          }
    }
    __syncthreads();
  }
  for (int32_t i = threadIdx.x; i < groups * 32 * kRuns * kRun; i += kTileThreads) {
    const int32_t c = i / (kRuns * kRun), at = i % (kRuns * kRun), x = column * kRun + at % kRun, y = top + at / kRun;
    if (x >= s.width || y >= s.height || first_channel + c >= sweep.channels) continue;
    grad_features[(image * sweep.channels + first_channel + c) * s.n_pixels + y * s.width + x] +=
        total[c * kTotalStride + at];
  }
}

}  // namespace
}  // namespace gsim3d::cuda
