// What the sweep's tensor-core kernels share: a tile of reference pixels, the source pixels that its samples touch, and
// products of float32 matrices in three of half precision.
//
// Pixels of a tile draw their lines close to each other, so the pixels that they touch in a source make a short list,
// and scores of the tile with that list are a dense product. Source pixels are counted in a table with a border of one
// pixel around the image: whatever a sample inside meets is in the table, and pixels of the border have feature 0.
//
// A number is kept as the sum of two halves after all of its image have been scaled by one power of two, so that the
// largest lies below 2^14: 22 bits of what is not far smaller than the largest.
#pragma once

#include <cuda_fp16.h>

#include "gsim3d/plane_sweep/plane_sweep_line.cuh"

namespace gsim3d::cuda {
namespace {

using namespace plane_sweep_math;

constexpr int kTileWidth = 8, kTileHeight = 4;
constexpr int kTile = kTileWidth * kTileHeight;  // a lane each
static_assert(kTile == kWarp);
constexpr int kTileThreads = 256, kTileWarps = kTileThreads / kWarp;
constexpr int kChannels = 128;  // taken at once

// Pixels of one image fit 32 bits (check_sizes); offsets over images are 64-bit.
struct TileSizes {
  int32_t height, width, n_pixels, n_depths;
  int32_t stride, n_words;       // of the table: pixels of a row, words with a bit for each pixel
  int32_t columns, n_tiles;      // of an image
  int32_t channels;              // with padding: a multiple of 32
};

template <typename Sweep>
TileSizes tile_sizes(const Sweep& sweep) {
  const int64_t table = (sweep.height + 2) * (sweep.width + 2);
  const int64_t columns = (sweep.width + kTileWidth - 1) / kTileWidth;
  return {static_cast<int32_t>(sweep.height),
          static_cast<int32_t>(sweep.width),
          static_cast<int32_t>(sweep.height * sweep.width),
          static_cast<int32_t>(sweep.n_depths),
          static_cast<int32_t>(sweep.width + 2),
          static_cast<int32_t>((table + 31) / 32),
          static_cast<int32_t>(columns),
          static_cast<int32_t>(columns * ((sweep.height + kTileHeight - 1) / kTileHeight)),
          static_cast<int32_t>((sweep.channels + 31) / 32 * 32)};
}

// Touched pixels of 32 places of the table, and how many are touched before them.
struct Word {
  uint32_t bits, before;
};

// A lane's pixel of a tile.
struct TilePixel {
  int32_t u, v;
  bool here;  // false where the tile stands over the image's edge

  __device__ __forceinline__ TilePixel(int32_t tile, const TileSizes& s)
      : u(tile % s.columns * kTileWidth + threadIdx.x % kTileWidth),
        v(tile / s.columns * kTileHeight + threadIdx.x % kWarp / kTileWidth),
        here(u < s.width && v < s.height) {}
};

// The lines of a tile in the source of one pair.
struct TileLines {
  Ray<float> ray;
  float b[3];
  bool here;

  __device__ __forceinline__ TileLines(const float* homography, const float* translation, const TilePixel& pixel)
      : ray(source_ray(homography, static_cast<float>(pixel.u), static_cast<float>(pixel.v))),
        b{translation[0], translation[1], translation[2]},
        here(pixel.here) {}

  __device__ __forceinline__ Place<float> at(float depth, const TileSizes& s) const {
    Place<float> place = sample_place(ray, b, depth, s.height, s.width);
    place.inside = place.inside && here;
    return place;
  }
};

__device__ __forceinline__ int32_t table_index(const Place<float>& place, const TileSizes& s) {
  return (place.y + 1) * s.stride + place.x + 1;
}

__device__ __forceinline__ int32_t rank_of(const Word* words, int32_t at) {
  const Word word = words[at >> 5];
  return word.before + __popc(word.bits & ((1u << (at & 31)) - 1));
}

// Sum over the threads before and over all; the barriers also order the use of `sums`.
__device__ __forceinline__ uint32_t sum_before(uint32_t value, uint32_t* sums /* [kTileWarps], shared */,
                                               uint32_t& total) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  uint32_t sum = value;
#pragma unroll
  for (int offset = 1; offset < kWarp; offset *= 2) {
    const uint32_t from = __shfl_up_sync(kFullWarp, sum, offset);
    if (lane >= offset) sum += from;
  }
  if (lane == kWarp - 1) sums[warp] = sum;
  __syncthreads();
  uint32_t before = 0;
  total = 0;
#pragma unroll
  for (int w = 0; w < kTileWarps; ++w) {
    if (w == warp) before = total;
    total += sums[w];
  }
  __syncthreads();
  return before + sum - value;
}

// Up to so many words of a table each warp packs and lists some of them, a lane a bit; of more a thread takes a word.
constexpr int kFewWords = 8 * kTileWarps;

struct Words {
  int32_t begin, end;
};
__device__ __forceinline__ Words words_of_warp(const TileSizes& s) {
  const int32_t each = (s.n_words + kTileWarps - 1) / kTileWarps, first = threadIdx.x / kWarp * each;
  return {min(first, s.n_words), min(first + each, s.n_words)};
}

// mark_lines of few words, from their flags.
__device__ __forceinline__ int32_t pack_few_words(const TileSizes& s, const uint8_t* flags, uint32_t* sums,
                                                  Word* words) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const Words own = words_of_warp(s);
  uint32_t count = 0;
  for (int32_t w = own.begin; w < own.end; ++w) {
    const uint32_t bits = __ballot_sync(kFullWarp, flags[w * 32 + lane] != 0);
    if (lane == 0) words[w] = {bits, count};
    count += __popc(bits);
  }
  if (lane == 0) sums[warp] = count;
  __syncthreads();
  const uint32_t of_warp = lane < kTileWarps ? sums[lane] : 0;
  const uint32_t before = __reduce_add_sync(kFullWarp, lane < warp ? of_warp : 0);
  for (int32_t w = own.begin + lane; w < own.end; w += kWarp) words[w].before += before;
  __syncthreads();
  return static_cast<int32_t>(__reduce_add_sync(kFullWarp, of_warp));
}

// Fills `words` with the places that the lines touch at depths [first, end); returns how many. The flags are of use
// inside only, the block synchronises before it comes here and before it uses their memory again.
__device__ __forceinline__ int32_t mark_lines(const TileLines& lines, const float* depths, int32_t first, int32_t end,
                                              const TileSizes& s, uint8_t* flags, uint32_t* sums, Word* words) {
  uint4* clear = reinterpret_cast<uint4*>(flags);
  for (int32_t i = threadIdx.x; i < 2 * s.n_words; i += kTileThreads) clear[i] = make_uint4(0, 0, 0, 0);
  __syncthreads();
  for (int32_t k = first + threadIdx.x / kWarp; k < end; k += kTileWarps) {
    const Place<float> place = lines.at(depths[k], s);
    if (!place.inside) continue;
    uint8_t* touched = flags + table_index(place, s);
    touched[0] = touched[1] = touched[s.stride] = touched[s.stride + 1] = 1;
  }
  __syncthreads();
  if (s.n_words <= kFewWords) return pack_few_words(s, flags, sums, words);
  uint32_t count = 0;
  for (int32_t begin = 0; begin < s.n_words; begin += kTileThreads) {
    const int32_t w = begin + threadIdx.x;
    uint32_t bits = 0;
    if (w < s.n_words) {
      const uint4* of_word = reinterpret_cast<const uint4*>(flags) + 2 * w;
      const uint4 low = of_word[0], high = of_word[1];
      // Four flags, one a byte, as four bits.
      const auto pack = [](uint32_t four) { return four * 0x01020408u >> 24 & 15; };
      bits = pack(low.x) | pack(low.y) << 4 | pack(low.z) << 8 | pack(low.w) << 12 | pack(high.x) << 16 |
             pack(high.y) << 20 | pack(high.z) << 24 | pack(high.w) << 28;
    }
    uint32_t total;
    const uint32_t before = count + sum_before(__popc(bits), sums, total);
    if (w < s.n_words) words[w] = {bits, before};
    count += total;
  }
  __syncthreads();
  return static_cast<int32_t>(count);
}

// list_pixels of few words.
__device__ __forceinline__ void list_few_words(const Word* words, const TileSizes& s, int32_t first, int32_t rows,
                                               int32_t* list) {
  const uint32_t lane = threadIdx.x % kWarp;
  const float inverse_stride = 1.0f / static_cast<float>(s.stride);
  const Words own = words_of_warp(s);
  for (int32_t w = own.begin; w < own.end; ++w) {
    const Word word = words[w];
    const int32_t rank = static_cast<int32_t>(word.before + __popc(word.bits & ((1u << lane) - 1))) - first;
    if (!(word.bits >> lane & 1) || static_cast<uint32_t>(rank) >= static_cast<uint32_t>(rows)) continue;
    // Half a place from the next whole number, so the quotient is exact.
    const int32_t at = w * 32 + lane, y = static_cast<int32_t>((static_cast<float>(at) + 0.5f) * inverse_stride);
    const int32_t x = at - y * s.stride;
    const int32_t near_y = min(max(y - 1, 0), s.height - 1), near_x = min(max(x - 1, 0), s.width - 1);
    const int32_t pixel = near_y * s.width + near_x;
    list[rank] = x - 1 == near_x && y - 1 == near_y ? pixel : -1 - pixel;
  }
}

// list[r - first] = the pixel q with rank r of [first, first + rows); in the border -1 - q for the pixel beside it.
__device__ __forceinline__ void list_pixels(const Word* words, const TileSizes& s, int32_t first, int32_t rows,
                                            int32_t* list) {
  if (s.n_words <= kFewWords) return list_few_words(words, s, first, rows, list);
  for (int32_t w = threadIdx.x; w < s.n_words; w += kTileThreads) {
    const Word word = words[w];
    int32_t rank = static_cast<int32_t>(word.before) - first;
    if (word.bits == 0 || rank >= rows || rank + 32 <= 0) continue;
    int32_t y = w * 32 / s.stride, x = w * 32 - y * s.stride, at = 0;
    for (uint32_t rest = word.bits; rest; rest &= rest - 1, ++rank) {
      const int32_t bit = __ffs(rest) - 1;
      for (x += bit - at, at = bit; x >= s.stride; x -= s.stride) ++y;
      if (static_cast<uint32_t>(rank) >= static_cast<uint32_t>(rows)) continue;
      const int32_t near_y = min(max(y - 1, 0), s.height - 1), near_x = min(max(x - 1, 0), s.width - 1);
      const int32_t pixel = near_y * s.width + near_x;
      list[rank] = x - 1 == near_x && y - 1 == near_y ? pixel : -1 - pixel;
    }
  }
}

// The pixel of an entry, and the nearest to one in the border.
__device__ __forceinline__ int32_t nearest(int32_t entry) { return entry < 0 ? -1 - entry : entry; }

__device__ __forceinline__ void multiply_halves(float (&sum)[4], const uint4& a, const uint2& b) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
      : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b.x), "r"(b.y));
}

// sum += a b for a 16 x 16 and a 16 x 8 matrix. Lane (g, t) = (lane / 4, lane % 4) holds pairs of a: (g, 2t),
// (g + 8, 2t), (g, 2t + 8), (g + 8, 2t + 8) with the column after each; of b: (2t, g), (2t + 8, g) with the row after
// each; of the sum: (g, 2t), (g, 2t + 1), (g + 8, 2t), (g + 8, 2t + 1).
__device__ __forceinline__ void multiply_add(float (&sum)[4], const uint4& a_high, const uint4& a_low,
                                             const uint2& b_high, const uint2& b_low) {
  multiply_halves(sum, a_low, b_high);
  multiply_halves(sum, a_high, b_low);
  multiply_halves(sum, a_high, b_high);
}

__device__ __forceinline__ uint32_t bits_of(__half2 pair) { return *reinterpret_cast<const uint32_t*>(&pair); }

// Two numbers as pairs of halves.
struct Halves {
  uint32_t high, low;

  __device__ __forceinline__ Halves(float x, float y) {
    const __half2 rounded = __floats2half2_rn(x, y);
    high = bits_of(rounded);
    low = bits_of(__floats2half2_rn(x - __low2float(rounded), y - __high2float(rounded)));
  }
};

// The power of two that brings numbers up to `largest` below 2^14, and its inverse.
struct HalfScale {
  float scale, inverse;

  __device__ __forceinline__ explicit HalfScale(float largest) {
    const int power = min(13 - (static_cast<int>(__float_as_uint(largest) >> 23) - 127), 126);
    scale = __uint_as_float(static_cast<uint32_t>(power + 127) << 23);
    inverse = __uint_as_float(static_cast<uint32_t>(127 - power) << 23);
  }
};

// What products of two scaled numbers are multiplied by. The smaller factor comes first: nothing overflows on the way
// that does not in the end.
struct Unit {
  float lesser, greater;

  __device__ __forceinline__ Unit(float a, float b) : lesser(fminf(a, b)), greater(fmaxf(a, b)) {}
  __device__ __forceinline__ float operator()(float product) const { return product * lesser * greater; }
  __device__ __forceinline__ bool operator!=(const Unit& other) const {
    return lesser != other.lesser || greater != other.greater;
  }
};

// Parts of an image whose largest finite magnitudes are found apart from each other: one for each lane.
constexpr int kParts = kWarp;

// By a whole warp.
__device__ __forceinline__ float largest_of(const uint32_t* __restrict__ parts /* of the image */) {
  return __uint_as_float(__reduce_max_sync(kFullWarp, parts[threadIdx.x % kWarp]));
}

__device__ __forceinline__ float4 load4(const float* from) { return *reinterpret_cast<const float4*>(from); }

// Eight halves.
__device__ __forceinline__ uint4 load8(const __half* from) { return *reinterpret_cast<const uint4*>(from); }

// What both kernels keep beside their matrix.
struct TileMemory {
  Word* words;     // [n_words]
  int32_t* list;   // [listed]
  uint32_t* sums;  // [kTileWarps]
  float* depths;   // [n_depths]

  __device__ __forceinline__ TileMemory(char*& at, const TileSizes& s, int listed)
      : words(carve<Word>(at, s.n_words)),
        list(carve<int32_t>(at, listed)),
        sums(carve<uint32_t>(at, kTileWarps)),
        depths(carve<float>(at, s.n_depths)) {}
  static int64_t bytes(const TileSizes& s, int listed) {
    return aligned_bytes(s.n_words * sizeof(Word)) + aligned_bytes(listed * sizeof(int32_t)) +
           aligned_bytes(kTileWarps * sizeof(uint32_t)) + aligned_bytes(s.n_depths * sizeof(float));
  }
  __device__ __forceinline__ void fill_depths(const PlaneSweep<float>& sweep, int64_t image) const {
    for (int64_t k = threadIdx.x; k < sweep.n_depths; k += kTileThreads)
      depths[k] = 1.0f / sweep.inverse_depths[image * sweep.n_depths + k];
  }
};

}  // namespace
}  // namespace gsim3d::cuda
