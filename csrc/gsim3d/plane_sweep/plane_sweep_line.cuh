// The line of samples that one pixel draws in a source image, traced by one warp in shared memory.
//
// Every source pixel that a sample touches sets a bit; its rank among the set bits is its place in the line's list. So
// each source pixel is met once, and the order of the list depends on nothing but the geometry.
#pragma once

#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/plane_sweep/plane_sweep.h"
#include "gsim3d/plane_sweep/plane_sweep_math.h"

namespace gsim3d::cuda {

// Pixels of one image fit 32 bits (check_sizes); offsets over images are 64-bit.
struct LineSizes {
  int32_t height, width, n_pixels, n_depths, n_words, capacity;
};

template <typename T>
LineSizes line_sizes(const PlaneSweep<T>& sweep) {
  const int64_t n_pixels = sweep.height * sweep.width;
  return {static_cast<int32_t>(sweep.height),         static_cast<int32_t>(sweep.width),
          static_cast<int32_t>(n_pixels),             static_cast<int32_t>(sweep.n_depths),
          static_cast<int32_t>((n_pixels + 31) / 32), static_cast<int32_t>(std::min(4 * sweep.n_depths, n_pixels))};
}

template <typename T>
struct Line {
  int32_t* corner;   // [n_depths], of each sample's cell in the table of plane_sweep_math.h
  T* fx;             // [n_depths]
  T* fy;             // [n_depths]
  uint32_t* bits;    // [n_words], touched source pixels
  uint16_t* before;  // [n_words], how many are touched in the words before
  int32_t* list;     // [capacity], touched source pixels, ascending
};

GSIM3D_HD int64_t aligned_bytes(int64_t bytes) { return (bytes + 15) / 16 * 16; }

template <typename T>
GSIM3D_HD int64_t line_bytes(const LineSizes& s) {
  return aligned_bytes(s.n_depths * sizeof(int32_t)) + 2 * aligned_bytes(s.n_depths * sizeof(T)) +
         aligned_bytes(s.n_words * sizeof(uint32_t)) + aligned_bytes(s.n_words * sizeof(uint16_t)) +
         aligned_bytes(s.capacity * sizeof(int32_t));
}

// Takes `count` elements from shared memory at `at`.
template <typename U>
__device__ __forceinline__ U* carve(char*& at, int32_t count) {
  U* const here = reinterpret_cast<U*>(at);
  at += aligned_bytes(count * sizeof(U));
  return here;
}

template <typename T>
__device__ __forceinline__ Line<T> carve_line(char*& at, const LineSizes& s) {
  Line<T> line;
  line.corner = carve<int32_t>(at, s.n_depths);
  line.fx = carve<T>(at, s.n_depths);
  line.fy = carve<T>(at, s.n_depths);
  line.bits = carve<uint32_t>(at, s.n_words);
  line.before = carve<uint16_t>(at, s.n_words);
  line.list = carve<int32_t>(at, s.capacity);
  return line;
}

// f(source pixel, side) for the corners of a cell that lie in the image; side: 1 right, 2 bottom, 3 both.
template <typename F>
__device__ __forceinline__ void for_corners(int32_t corner, const LineSizes& s, const F& f) {
  const int32_t row = corner / (s.width + 2), x = corner - row * (s.width + 2) - 1, y = row - 1;
#pragma unroll
  for (int side = 0; side < 4; ++side) {
    const int32_t cx = x + (side & 1), cy = y + (side >> 1);
    if (cx >= 0 && cx < s.width && cy >= 0 && cy < s.height) f(cy * s.width + cx, side);
  }
}

template <typename T>
__device__ __forceinline__ int32_t rank_of(const Line<T>& line, int32_t pixel) {
  return line.before[pixel >> 5] + __popc(line.bits[pixel >> 5] & ((1u << (pixel & 31)) - 1));
}

// Fills the line of a pixel and a pair of its image; returns the length of the list, the same in every lane. The caller
// synchronises the warp between its last look at a line and the next call.
template <typename T>
__device__ int32_t trace(const PlaneSweep<T>& sweep, const LineSizes& s, int64_t image, int64_t pair, int32_t pixel,
                         const Line<T>& line) {
  using namespace plane_sweep_math;
  const int lane = threadIdx.x % kWarp;
  const int32_t outside = static_cast<int32_t>(outside_corner(s.height, s.width));
  const int32_t v = pixel / s.width;
  const Ray<T> ray =
      source_ray(sweep.homographies + 9 * pair, static_cast<T>(pixel - v * s.width), static_cast<T>(v));
  const T b[3] = {sweep.translations[3 * pair], sweep.translations[3 * pair + 1], sweep.translations[3 * pair + 2]};
  for (int32_t w = lane; w < s.n_words; w += kWarp) line.bits[w] = 0;
  __syncwarp();
  bool touches = false;
  for (int32_t k = lane; k < s.n_depths; k += kWarp) {
    const T depth = T(1) / sweep.inverse_depths[image * s.n_depths + k];
    const Cell<T> cell = sample_cell(ray, b, depth, s.height, s.width);
    line.corner[k] = cell.corner;
    line.fx[k] = cell.fx;
    line.fy[k] = cell.fy;
    if (cell.corner == outside) continue;
    touches = true;
    for_corners(cell.corner, s, [&](int32_t q, int) { atomicOr(line.bits + (q >> 5), 1u << (q & 31)); });
  }
  if (!__any_sync(kFullWarp, touches)) {
    return 0;
  }
  __syncwarp();
  int32_t count = 0;
  for (int32_t first = 0; first < s.n_words; first += kWarp) {
    const int32_t w = first + lane;
    const int32_t own = w < s.n_words ? __popc(line.bits[w]) : 0;
    int32_t sum = own;
#pragma unroll
    for (int offset = 1; offset < kWarp; offset *= 2) {
      const int32_t from = __shfl_up_sync(kFullWarp, sum, offset);
      if (lane >= offset) sum += from;
    }
    if (w < s.n_words) line.before[w] = static_cast<uint16_t>(count + sum - own);
    count += __shfl_sync(kFullWarp, sum, kWarp - 1);
  }
  __syncwarp();
  for (int32_t k = lane; k < s.n_depths; k += kWarp)
    if (line.corner[k] != outside)
      for_corners(line.corner[k], s, [&](int32_t q, int) { line.list[rank_of(line, q)] = q; });
  __syncwarp();
  return count;
}

}  // namespace gsim3d::cuda
