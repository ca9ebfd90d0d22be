// What the sweep's kernels share: features with channels last, and four neighbouring pixels with their lines.
#pragma once

#include "gsim3d/core/pack.cuh"
#include "gsim3d/plane_sweep/plane_sweep_line.cuh"

namespace gsim3d::cuda {
namespace {

using namespace plane_sweep_math;

constexpr int kMaxWarps = 8;
constexpr int kGroup = 16;                          // lanes that share a dot product
constexpr int kPiece = 8, kOwned = 2 * kPiece;     // source pixels whose gradients a warp holds
constexpr int kParts = 4, kTasks = kMaxWarps / kParts;  // warps that share them, and such groups of a block
constexpr int64_t kListBytes = int64_t{512} << 20;  // lines kept at once in the backward pass; more run in pieces

// kVectors elements of a feature, one load.
template <typename T, int kVectors>
using Feature = Pack<T, kVectors, sizeof(T) * kVectors < 16 ? sizeof(T) * kVectors : 16>;

// Channels-last features: image i, pixel p at data + (i n_pixels + p) stride; stride is a multiple of a warp's packs.
template <typename T>
struct Pixels {
  T* data;
  int32_t stride;

  __device__ __forceinline__ T* at(const LineSizes& s, int64_t image, int32_t pixel) const {
    return data + (image * s.n_pixels + pixel) * stride;
  }
};

// [n, rows, cols] -> [n, cols, stride], zeros in the padding.
template <typename T>
__global__ void to_pixels_kernel(const T* __restrict__ planes, int64_t rows, int64_t cols, int64_t stride,
                                 int64_t col_tiles, T* __restrict__ pixels) {
  __shared__ T tile[32][33];
  const int64_t image = blockIdx.x / col_tiles, col0 = blockIdx.x % col_tiles * 32, row0 = int64_t{blockIdx.y} * 32;
  for (int r = threadIdx.y; r < 32; r += 8) {
    const int64_t row = row0 + r, col = col0 + threadIdx.x;
    tile[r][threadIdx.x] = row < rows && col < cols ? planes[(image * rows + row) * cols + col] : T(0);
  }
  __syncthreads();
  for (int c = threadIdx.y; c < 32; c += 8) {
    const int64_t col = col0 + c, row = row0 + threadIdx.x;
    if (col < cols && row < stride) pixels[(image * cols + col) * stride + row] = tile[threadIdx.x][c];
  }
}

// [n, cols, stride] -> [n, rows, cols].
template <typename T>
__global__ void to_planes_kernel(const T* __restrict__ pixels, int64_t rows, int64_t cols, int64_t stride,
                                 int64_t col_tiles, T* __restrict__ planes) {
  __shared__ T tile[32][33];
  const int64_t image = blockIdx.x / col_tiles, col0 = blockIdx.x % col_tiles * 32, row0 = int64_t{blockIdx.y} * 32;
  for (int c = threadIdx.y; c < 32; c += 8) {
    const int64_t col = col0 + c, row = row0 + threadIdx.x;
    tile[threadIdx.x][c] = row < rows && col < cols ? pixels[(image * cols + col) * stride + row] : T(0);
  }
  __syncthreads();
  for (int r = threadIdx.y; r < 32; r += 8) {
    const int64_t row = row0 + r, col = col0 + threadIdx.x;
    if (row < rows && col < cols) planes[(image * rows + row) * cols + col] = tile[r][threadIdx.x];
  }
}

// The forward pass gives a warp four neighbouring pixels: their lines run close to each other, so that a source pixel
// is loaded once for most of them. A lane holds one depth of each.
constexpr int kQuad = 4;
constexpr int kRows = 128;  // source pixels whose scores a warp holds at once

// Four neighbouring pixels of an image. The warps of a block take 2 x 4 of them where an image holds whole blocks of
// them, for the sake of the first-level cache.
struct Quad {
  int32_t u, v, width, height;

  __device__ __forceinline__ Quad(int32_t task, const LineSizes& s) : width(s.width), height(s.height) {
    const int32_t columns = (s.width + 1) / 2, rows = (s.height + 1) / 2;
    int32_t column = task % columns, row = task / columns;
    if (columns % 4 == 0 && rows % 2 == 0) {
      const int32_t block = task / 8, across = columns / 4;
      column = block % across * 4 + task % 4;
      row = block / across * 2 + task / 4 % 2;
    }
    u = 2 * column;
    v = 2 * row;
  }
  __device__ __forceinline__ bool holds(int j) const { return u + j % 2 < width && v + j / 2 < height; }
  __device__ __forceinline__ int32_t pixel(int j) const { return (v + j / 2) * width + u + j % 2; }
};

int64_t quads_of(const LineSizes& s) {
  return static_cast<int64_t>((s.height + 1) / 2) * ((s.width + 1) / 2);
}

// Shared memory of a warp. Flags are done with when the list is made.
template <typename T>
struct QuadMemory {
  uint8_t* touched;  // [n_words, 32]
  int32_t* list;     // [kRows]
  T* scores;         // [kRows + 1, kQuad], the last 0
  uint32_t* bits;    // [n_words]
  uint16_t* before;  // [n_words]
};

template <typename T>
GSIM3D_HD int64_t quad_bytes(const LineSizes& s) {
  const int64_t flags = s.n_words * 32, rows = kRows * sizeof(int32_t) + (kRows + 1) * kQuad * sizeof(T);
  return (flags > rows ? flags : rows) + aligned_bytes(s.n_words * sizeof(uint32_t)) +
         aligned_bytes(s.n_words * sizeof(uint16_t));
}

template <typename T>
__device__ __forceinline__ QuadMemory<T> carve_quad(char* at, const LineSizes& s) {
  QuadMemory<T> memory;
  char* end = at + quad_bytes<T>(s);
  memory.touched = reinterpret_cast<uint8_t*>(at);
  memory.scores = carve<T>(at, (kRows + 1) * kQuad);
  memory.list = carve<int32_t>(at, kRows);
  at = end - aligned_bytes(s.n_words * sizeof(uint32_t)) - aligned_bytes(s.n_words * sizeof(uint16_t));
  memory.bits = carve<uint32_t>(at, s.n_words);
  memory.before = carve<uint16_t>(at, s.n_words);
  return memory;
}

// f(side, source pixel) for the corners of a sample.
template <typename T, typename F>
__device__ __forceinline__ void for_corners(const Sample<T>& sample, const LineSizes& s, const F& f) {
#pragma unroll
  for (int side = 0; side < 4; ++side)
    if (sample.corners >> side & 1) f(side, sample.first + (side & 1) + (side >> 1) * s.width);
}

// Marks the source pixels that the samples touch; returns how many they are, the same in every lane.
template <typename T>
__device__ __forceinline__ int32_t mark(const Sample<T> (&samples)[kQuad], const LineSizes& s,
                                        const QuadMemory<T>& memory) {
  int32_t touches = 0;
#pragma unroll
  for (int j = 0; j < kQuad; ++j) touches |= samples[j].corners;
  if (!__any_sync(kFullWarp, touches != 0)) return 0;
  clear_flags(memory.touched, s);
#pragma unroll
  for (int j = 0; j < kQuad; ++j) for_corners(samples[j], s, [&](int, int32_t q) { memory.touched[q] = 1; });
  __syncwarp();
  const int32_t count = list_flags(memory.touched, s, memory.bits, memory.before);
  __syncwarp();
  return count;
}

// What a lane holds of 32 kVectors channels that kGroup lanes share.
template <typename T, int kVectors>
struct Share {
  static constexpr int kWidth = kVectors == 1 ? 2 : 4, kPacks = 2 * kVectors / kWidth;
  Feature<T, kWidth> packs[kPacks];

  __device__ __forceinline__ void load(const T* __restrict__ from) {
#pragma unroll
    for (int e = 0; e < kPacks; ++e)
      packs[e] = reinterpret_cast<const Feature<T, kWidth>*>(from)[threadIdx.x % kGroup + e * kGroup];
  }
};

// scores[r, j] (+)= <own pixel j, source pixel list[r]> over 32 kVectors channels, which start at `source`.
template <typename T, int kVectors>
__device__ __forceinline__ void add_dots(const Share<T, kVectors> (&own)[kQuad], const T* __restrict__ source,
                                         int32_t stride, const int32_t* list, int32_t count, bool first, T* scores) {
  using Part = Share<T, kVectors>;
  constexpr int kGroups = kWarp / kGroup;
  constexpr int kTogether = 4;  // source pixels of a group in flight
  const int lane = threadIdx.x % kWarp, group = lane / kGroup;
  const bool upper_half = lane & 8, odd_pair = lane & 4;
  for (int32_t r0 = 0; r0 < count; r0 += kTogether * kGroups) {
    Part other[kTogether];
#pragma unroll
    for (int t = 0; t < kTogether; ++t)
      other[t].load(source + int64_t{list[min(r0 + t * kGroups + group, count - 1)]} * stride);
#pragma unroll
    for (int t = 0; t < kTogether; ++t) {
      T sums[kQuad];
#pragma unroll
      for (int j = 0; j < kQuad; ++j) {
        sums[j] = 0;
#pragma unroll
        for (int e = 0; e < Part::kPacks; ++e)
#pragma unroll
          for (int c = 0; c < Part::kWidth; ++c) sums[j] += own[j].packs[e].lane[c] * other[t].packs[e].lane[c];
      }
      // Lanes exchange halves of what they hold, so that every four lanes end with one pixel's sum.
      T a = upper_half ? sums[2] : sums[0], b = upper_half ? sums[3] : sums[1];
      a += __shfl_xor_sync(kFullWarp, upper_half ? sums[0] : sums[2], 8);
      b += __shfl_xor_sync(kFullWarp, upper_half ? sums[1] : sums[3], 8);
      T sum = odd_pair ? b : a;
      sum += __shfl_xor_sync(kFullWarp, odd_pair ? a : b, 4);
      sum += __shfl_xor_sync(kFullWarp, sum, 2);
      sum += __shfl_xor_sync(kFullWarp, sum, 1);
      const int32_t r = r0 + t * kGroups + group;
      if (lane % 4 == 0 && r < count) {
        T& score = scores[r * kQuad + lane % kGroup / 4];
        score = first ? sum : score + sum;
      }
    }
  }
}

}  // namespace
}  // namespace gsim3d::cuda
