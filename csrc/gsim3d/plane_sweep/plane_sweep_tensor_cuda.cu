#include "gsim3d/plane_sweep/plane_sweep_tensor.h"

#include "gsim3d/core/overlap.cuh"
#include "gsim3d/plane_sweep/plane_sweep_tensor_backward.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kDepths = 8;        // of a thread, so 64 of a tile at once
constexpr int kPairNumbers = 12;  // of a homography and a translation

// Four bytes for shared memory, without waiting for them; 0 where `real` is false.
__device__ __forceinline__ void copy4(void* to, const void* from, bool real) {
  const uint32_t at = static_cast<uint32_t>(__cvta_generic_to_shared(to));
  asm volatile("cp.async.ca.shared.global [%0], [%1], 4, %2;" ::"r"(at), "l"(from), "r"(real ? 4 : 0) : "memory");
}
__device__ __forceinline__ void wait_for_copies() { asm volatile("cp.async.wait_all;" ::: "memory"); }

int64_t forward_bytes(const TileSizes& s) {
  return TileMemory::bytes(s, kScored) + kTile * 2 * kChannels * sizeof(__half) +
         2 * aligned_bytes(kPairNumbers * sizeof(float)) +
         std::max<int64_t>(s.n_words * 32, (kScored + 1) * kScoreStride * sizeof(float));
}

// Begins to bring channels [first, first + count) of the tile's pixels to shared memory as [count / 16, 2, 2,
// kFragment]: high and low, 16 pixels x 16 channels each. Channels 8 t + 4 i + .. of 32 stand for columns 2 t, 2 t + 1,
// 2 t + 8 and 2 t + 9 of the i-th sixteen.
__device__ void load_tile(const __half* __restrict__ rows /* of the image */, int32_t tile, const TileSizes& s,
                          int32_t first, int32_t count, uint32_t* own) {
  const int32_t p = threadIdx.x / 2 % kTile;  // two lanes take 32 bytes
  const int32_t u = tile % s.columns * kTileWidth + p % kTileWidth;
  const int32_t v = tile / s.columns * kTileHeight + p / kTileWidth;
  const bool here = u < s.width && v < s.height;
  const __half* from = rows + (here ? int64_t{v} * s.width + u : 0) * 2 * s.channels + first;
#pragma unroll
  for (int low = 0; low < 2; ++low)
    for (int32_t c = (threadIdx.x / (2 * kTile) * 2 + threadIdx.x % 2) * 8; c < count; c += kTileThreads / kTile * 8) {
      const int32_t fragment = (c / 32 * 4 + low) * 2 + p / 16;
      uint32_t* to = own + fragment * (kFragment / 2) + (p % 8 * 4 + c / 8 % 4) * 4 + p / 8 % 2;
      const __half* four = from + low * s.channels + c;
#pragma unroll
      for (int i = 0; i < 4; ++i) copy4(to + i % 2 * 2 + i / 2 * 2 * kFragment, four + 2 * i, here);
    }
}

// scores[r, p] (+)= <own pixel p, source pixel list[r]> over `count` channels; 0 in the border. A warp takes 16 source
// pixels.
__device__ __forceinline__ void add_scores(const uint32_t* own, const __half* __restrict__ source, int32_t channels,
                                           int32_t count, const int32_t* list, int32_t rows, bool add, float* scores) {
  const int g = threadIdx.x % kWarp / 4, t = threadIdx.x % 4;
  for (int32_t begin = threadIdx.x / kWarp * 16; begin < rows; begin += kTileWarps * 16) {
    const __half* from[2];
#pragma unroll
    for (int n = 0; n < 2; ++n)
      from[n] = source + int64_t{nearest(list[min(begin + n * 8 + g, rows - 1)])} * 2 * channels + 8 * t;
    float sums[2][2][4] = {};
#pragma unroll 2
    for (int32_t c = 0; c < count; c += 32) {
      uint4 high[2], low[2];
#pragma unroll
      for (int n = 0; n < 2; ++n) {
        high[n] = load8(from[n] + c);
        low[n] = load8(from[n] + channels + c);
      }
      const uint4* mine = reinterpret_cast<const uint4*>(own) + c / 16 * 4 * kWarp + threadIdx.x % kWarp;
#pragma unroll
      for (int step = 0; step < 2; ++step)
#pragma unroll
        for (int m = 0; m < 2; ++m) {
          const uint4 a_high = mine[(step * 4 + m) * kWarp], a_low = mine[(step * 4 + 2 + m) * kWarp];
#pragma unroll
          for (int n = 0; n < 2; ++n)
            if (step == 0)
              multiply_add(sums[m][n], a_high, a_low, {high[n].x, high[n].y}, {low[n].x, low[n].y});
            else
              multiply_add(sums[m][n], a_high, a_low, {high[n].z, high[n].w}, {low[n].z, low[n].w});
        }
    }
#pragma unroll
    for (int n = 0; n < 2; ++n)
#pragma unroll
      for (int e = 0; e < 2; ++e) {
        const int32_t r = begin + n * 8 + 2 * t + e;
        const bool in_image = r < rows && list[r] >= 0;
#pragma unroll
        for (int m = 0; m < 2; ++m)
#pragma unroll
          for (int half = 0; half < 2; ++half) {
            float& score = scores[r * kScoreStride + m * 16 + half * 8 + g];
            const float sum = in_image ? sums[m][n][2 * half + e] : 0.0f;
            score = add ? score + sum : sum;
          }
      }
  }
}

// A block owns the costs of a tile of reference pixels.
__global__ void __launch_bounds__(kTileThreads, 2)
    tile_costs_kernel(SweepHalves halves, PlaneSweep<float> sweep, TileSizes s, float* __restrict__ cost) {
  extern __shared__ __align__(16) char shared[];
  char* at = shared;
  const TileMemory memory(at, s, kScored);
  uint32_t* own = carve<uint32_t>(at, kTile * kChannels);
  float* numbers = carve<float>(at, kPairNumbers);  // of this pair or the next, in turns
  float* next_numbers = carve<float>(at, kPairNumbers);
  uint8_t* flags = reinterpret_cast<uint8_t*>(at);
  float* scores = reinterpret_cast<float*>(at);  // [kScored + 1, kScoreStride], the last 0
  const int32_t image = blockIdx.x / s.n_tiles, tile = blockIdx.x % s.n_tiles;
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const int64_t image_size = int64_t{s.n_pixels} * 2 * s.channels;
  const Range pairs = range_of(sweep.cu_src, image, sweep.n_pairs);
  const auto bring = [&](int64_t pair, float* to) {
    if (threadIdx.x >= kPairNumbers) return;
    const int32_t i = threadIdx.x;
    copy4(to + i, i < 9 ? sweep.homographies + 9 * pair + i : sweep.translations + 3 * pair + i - 9, true);
  };
  if (pairs.begin < pairs.end) bring(pairs.begin, next_numbers);
  memory.fill_depths(sweep, image);
  int32_t held = -1;  // the first of the channels in `own`

  for (int32_t first_depth = 0; first_depth < s.n_depths; first_depth += kDepths * kTileWarps) {
    const int32_t end_depth = min(first_depth + kDepths * kTileWarps, s.n_depths);
    float costs[kDepths] = {};
    for (int64_t pair = pairs.begin; pair < pairs.end; ++pair) {
      const int64_t source = sweep.src_images[pair];  // on its way while the lines are marked
      wait_for_copies();
      __syncthreads();
      float* const brought = next_numbers;
      next_numbers = numbers;
      numbers = brought;
      bring(pair + 1 < pairs.end ? pair + 1 : pairs.begin, next_numbers);
      if (held < 0) {
        wait_for_previous();
        load_tile(halves.rows + image * image_size, tile, s, 0, min(s.channels, kChannels), own);
        held = 0;
      }
      const int32_t count = mark_lines(TileLines(numbers, numbers + 9, TilePixel(tile, s)), memory.depths, first_depth,
                                       end_depth, s, flags, memory.sums, memory.words);
      if (!inside(source, sweep.n_images)) continue;
      const Unit unit(halves.inverses[image], halves.inverses[source]);
      for (int32_t first = 0; first < count; first += kScored) {
        const int32_t rows = min(count - first, kScored);
        if (first > 0) __syncthreads();
        list_pixels(memory.words, s, first, rows, memory.list);
        if (threadIdx.x < kTile) scores[kScored * kScoreStride + threadIdx.x] = 0;
        for (int32_t c = 0; c < s.channels; c += kChannels) {
          const int32_t channels = min(s.channels - c, kChannels);
          if (held != c) {
            __syncthreads();
            load_tile(halves.rows + image * image_size, tile, s, c, channels, own);
            held = c;
          }
          wait_for_copies();
          __syncthreads();
          add_scores(own, halves.rows + source * image_size + c, s.channels, channels, memory.list, rows, c > 0,
                     scores);
        }
        __syncthreads();
        const TileLines lines(numbers, numbers + 9, TilePixel(tile, s));  // again, registers are few
#pragma unroll
        for (int j = 0; j < kDepths; ++j) {
          const int32_t k = first_depth + warp + j * kTileWarps;
          if (k >= end_depth) break;
          const Place<float> place = lines.at(memory.depths[k], s);
          if (!place.inside) continue;
          const int32_t top = table_index(place, s);
          const auto score = [&](uint32_t rank) {
            return scores[(rank < static_cast<uint32_t>(rows) ? rank : kScored) * kScoreStride + lane];
          };
          const uint32_t above = rank_of(memory.words, top) - first;
          const uint32_t below = rank_of(memory.words, top + s.stride) - first;
          costs[j] +=
              unit(interpolate(score(above), score(above + 1), score(below), score(below + 1), place.fx, place.fy));
        }
      }
    }
    const float mean = pairs.begin < pairs.end ? cost_scale<float>(pairs, sweep.channels) : 0.0f;
    const TilePixel pixel(tile, s);
#pragma unroll
    for (int j = 0; j < kDepths; ++j) {
      const int32_t k = first_depth + warp + j * kTileWarps;
      if (k < end_depth && pixel.here)
        cost[(int64_t{image} * s.n_depths + k) * s.n_pixels + pixel.v * s.width + pixel.u] = costs[j] * mean;
    }
  }
  wait_for_previous();  // also where there are no pairs
}

}  // namespace

void tensor_sweep(const char* op, const float* features, const PlaneSweep<float>& sweep, float* cost,
                  const Workspace& workspace, Stream stream) {
  const TileSizes s = tile_sizes(sweep);
  const int64_t bytes = forward_bytes(s);
  check_shared_bytes(op, bytes, sweep, stream);
  const SweepHalves halves = make_halves(op, features, sweep, s, false, workspace, stream);
  launch_overlapping(op, tile_costs_kernel, blocks_for(op, sweep.n_images * s.n_tiles, 1), kTileThreads, bytes, stream,
                     halves, sweep, s, cost);
}

void tensor_sweep_vjp(const char* op, const float* grad, const float* features, const PlaneSweep<float>& sweep,
                      float* grad_features, const Workspace& workspace, Stream stream) {
  const TileSizes s = tile_sizes(sweep);
  const int64_t bytes = backward_bytes(s);
  check_shared_bytes(op, bytes, sweep, stream);
  // Ranks beyond the capacity, which few tiles have, take further launches, which end at once if there are none.
  const int64_t most = std::min<int64_t>(int64_t{s.n_words} * 32, int64_t{4} * kTile * s.n_depths);
  const int64_t capacity = std::min<int64_t>(kCapacity, most);
  const int64_t n_runs = int64_t{s.height} * s.columns;
  const int64_t bytes_of_tile = capacity * kTile * 2 * sizeof(__half) + n_runs * sizeof(uint32_t);
  const int64_t room = std::max<int64_t>(kKeptBytes / bytes_of_tile, 1);
  const int64_t tiles = std::min<int64_t>(room, s.n_tiles);
  const int64_t pairs = std::min(std::max<int64_t>(room / s.n_tiles, 1), sweep.n_pairs);
  const bool whole = tiles == s.n_tiles && pairs == sweep.n_pairs;
  const unsigned blocks_of_channels = static_cast<unsigned>((s.channels + kChannels - 1) / kChannels);
  const int32_t blocks_per_image = (s.height + kRuns - 1) / kRuns * s.columns;
  const SweepHalves halves = make_halves(op, features, sweep, s, true, workspace, stream);
  uint32_t* largest_grad = workspace.take<uint32_t>(sweep.n_images * kParts);
  launch(op, largest_kernel, blocks_for(op, sweep.n_images * kParts, 1), 512, 0, stream, grad,
         int64_t{s.n_depths} * s.n_pixels, largest_grad);
  KeptScores kept{workspace.take<__half>(pairs * tiles * capacity * 2 * kTile),
                  workspace.take<uint32_t>(pairs * tiles * n_runs),
                  workspace.take<int32_t>(sweep.n_pairs * s.n_tiles),
                  workspace.take<int32_t>(1),
                  workspace.take<float>(sweep.n_images)};
  kept.capacity = static_cast<int32_t>(capacity);
  fill_zero(op, kept.longest, 1, stream);
  // A block has one tile, or one block of an image; of sums in memory only those of one kernel at once where no
  // launch leaves any to the next.
  const int64_t slots = int64_t{Relay::slots(whole)} * kTileThreads * blocks_of_channels * sweep.n_images;
  float* of_tiles = workspace.take<float>(slots * (whole ? std::max(s.n_tiles, blocks_per_image) : s.n_tiles));
  float* of_sources = whole ? of_tiles : workspace.take<float>(slots * blocks_per_image);
  for (int64_t rank = 0; rank < most; rank += capacity) {
    kept.first_rank = static_cast<int32_t>(rank);
    for (kept.first_pair = 0; kept.first_pair < sweep.n_pairs; kept.first_pair += pairs) {
      kept.n_pairs = std::min(pairs, sweep.n_pairs - kept.first_pair);
      const bool first = kept.first_pair == 0, last = kept.first_pair + kept.n_pairs == sweep.n_pairs;
      for (int64_t tile = 0; tile < s.n_tiles; tile += tiles) {
        kept.first_tile = static_cast<int32_t>(tile);
        kept.n_tiles = static_cast<int32_t>(std::min(tiles, s.n_tiles - tile));
        launch(op, tile_gradients_kernel, dim3(blocks_for(op, sweep.n_images * kept.n_tiles, 1), blocks_of_channels),
               kTileThreads, bytes, stream, grad, largest_grad, halves, sweep, s, kept, Relay{of_tiles, first, last},
               grad_features);
        launch(op, source_gradients_kernel,
               dim3(blocks_for(op, sweep.n_images * blocks_per_image, 1), blocks_of_channels), kTileThreads, 0, stream,
               halves, sweep, s, kept, Relay{of_sources, first && tile == 0, last && tile + tiles >= s.n_tiles},
               blocks_per_image, grad_features);
      }
    }
  }
}

}  // namespace gsim3d::cuda
