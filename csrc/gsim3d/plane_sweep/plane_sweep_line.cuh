// The line of samples that one pixel draws in a source image, traced by one warp in shared memory.
//
// Every source pixel that a sample touches sets a flag; its rank among the flags is its place in the line's list. So
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
  return {static_cast<int32_t>(sweep.height),
          static_cast<int32_t>(sweep.width),
          static_cast<int32_t>(n_pixels),
          static_cast<int32_t>(sweep.n_depths),
          static_cast<int32_t>((n_pixels + 31) / 32),
          static_cast<int32_t>(std::min(4 * sweep.n_depths, n_pixels))};
}

// The shared memory of a block, in bytes, which `bytes` must fit.
template <typename T>
int64_t check_shared_bytes(const char* op, int64_t bytes, const PlaneSweep<T>& sweep, Stream stream) {
  int limit = 0;
  check_cuda(cudaDeviceGetAttribute(&limit, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), op);
  check(bytes <= limit, op, ": features and depths must be small enough for one pixel's line to fit ", limit,
        " bytes of shared memory; got ", sweep.height, " x ", sweep.width, " pixels and ", sweep.n_depths, " depths");
  return limit;
}

// 1 / (number of sources * sqrt(C)).
template <typename T>
__device__ __forceinline__ T cost_scale(const Range& pairs, int64_t channels) {
  return T(1) / (static_cast<T>(pairs.end - pairs.begin) * sqrt(static_cast<T>(channels)));
}

// The image that owns a pair: the last whose pairs begin at or before it; -1 where the offsets say none.
template <typename T>
__device__ __forceinline__ int64_t owner_of(const PlaneSweep<T>& sweep, int64_t pair) {
  int64_t image = 0, past = sweep.n_images;
  while (past - image > 1) {
    const int64_t middle = (image + past) / 2;
    (sweep.cu_src[middle] <= pair ? image : past) = middle;
  }
  const Range owned = range_of(sweep.cu_src, image, sweep.n_pairs);
  return pair >= owned.begin && pair < owned.end ? image : -1;
}

template <typename T>
struct Line {
  int32_t* code;     // [n_depths], of each sample's cell (see trace)
  T* fx;             // [n_depths]
  T* fy;             // [n_depths]
  ushort4* places;   // [n_depths], places in the list of top left, top right, bottom left, bottom right; capacity: none
  uint8_t* touched;  // [n_words, 32], of use inside trace only
  uint32_t* bits;    // [n_words], touched source pixels
  uint16_t* before;  // [n_words], how many are touched in the words before
};

GSIM3D_HD int64_t aligned_bytes(int64_t bytes) { return (bytes + 15) / 16 * 16; }

// `shared_bytes`: how many the caller wants to use where the flags lie.
template <typename T>
GSIM3D_HD int64_t line_bytes(const LineSizes& s, int64_t shared_bytes) {
  const int64_t flags = s.n_words * 32;
  return aligned_bytes(s.n_depths * sizeof(int32_t)) + 2 * aligned_bytes(s.n_depths * sizeof(T)) +
         aligned_bytes(s.n_depths * sizeof(ushort4)) + (flags > shared_bytes ? flags : shared_bytes) +
         aligned_bytes(s.n_words * sizeof(uint32_t)) + aligned_bytes(s.n_words * sizeof(uint16_t));
}

// Takes `count` elements from shared memory at `at`.
template <typename U>
__device__ __forceinline__ U* carve(char*& at, int32_t count) {
  U* const here = reinterpret_cast<U*>(at);
  at += aligned_bytes(count * sizeof(U));
  return here;
}

template <typename T>
__device__ __forceinline__ Line<T> carve_line(char*& at, const LineSizes& s, int64_t shared_bytes) {
  Line<T> line;
  char* const end = at + line_bytes<T>(s, shared_bytes);
  line.code = carve<int32_t>(at, s.n_depths);
  line.fx = carve<T>(at, s.n_depths);
  line.fy = carve<T>(at, s.n_depths);
  line.places = carve<ushort4>(at, s.n_depths);
  line.bits = carve<uint32_t>(at, s.n_words);
  line.before = carve<uint16_t>(at, s.n_words);
  line.touched = reinterpret_cast<uint8_t*>(at);
  at = end;
  return line;
}

// Clears the flags, by all lanes of a warp.
__device__ __forceinline__ void clear_flags(uint8_t* touched, const LineSizes& s) {
  uint4* flags = reinterpret_cast<uint4*>(touched);
  for (int32_t w = threadIdx.x % kWarp; w < 2 * s.n_words; w += kWarp) flags[w] = make_uint4(0, 0, 0, 0);
  __syncwarp();
}

// Four flags, one a byte, as four bits.
__device__ __forceinline__ uint32_t pack_flags(uint32_t flags) { return flags * 0x01020408u >> 24 & 15; }

// Where one sample lies.
template <typename T>
struct Sample {
  int32_t first;    // index of the top left corner
  int32_t corners;  // bits of those that lie in the image: top left, top right, bottom left, bottom right
  T fx, fy;
};

template <typename T>
__device__ __forceinline__ Sample<T> sample_at(const PlaneSweep<T>& sweep, const LineSizes& s, int64_t pair,
                                               const plane_sweep_math::Ray<T>& ray, T depth) {
  const T* at = sweep.translations + 3 * pair;
  const T b[3] = {at[0], at[1], at[2]};
  const plane_sweep_math::Place<T> place = plane_sweep_math::sample_place(ray, b, depth, s.height, s.width);
  const int32_t columns = (place.x >= 0 ? 5 : 0) | (place.x + 1 < s.width ? 10 : 0);
  const int32_t rows = (place.y >= 0 ? 3 : 0) | (place.y + 1 < s.height ? 12 : 0);
  return {place.y * s.width + place.x, place.inside ? columns & rows : 0, place.fx, place.fy};
}

// Packs flags into bits; before[w]: how many are set in the words before w. Returns how many are set, the
// same in every lane.
__device__ __forceinline__ int32_t list_flags(uint8_t* touched, const LineSizes& s, uint32_t* all_bits,
                                              uint16_t* before) {
  const int lane = threadIdx.x % kWarp;
  int32_t count = 0;
  for (int32_t begin = 0; begin < s.n_words; begin += kWarp) {
    const int32_t w = begin + lane;
    uint32_t bits = 0;
    if (w < s.n_words) {
      const uint4* flags = reinterpret_cast<const uint4*>(touched) + 2 * w;
      const uint4 low = flags[0], high = flags[1];
      bits = pack_flags(low.x) | pack_flags(low.y) << 4 | pack_flags(low.z) << 8 | pack_flags(low.w) << 12 |
             pack_flags(high.x) << 16 | pack_flags(high.y) << 20 | pack_flags(high.z) << 24 | pack_flags(high.w) << 28;
    }
    const int32_t own = __popc(bits);
    int32_t sum = own;
#pragma unroll
    for (int offset = 1; offset < kWarp; offset *= 2) {
      const int32_t from = __shfl_up_sync(kFullWarp, sum, offset);
      if (lane >= offset) sum += from;
    }
    if (w < s.n_words) {
      all_bits[w] = bits;
      before[w] = static_cast<uint16_t>(count + sum - own);
    }
    count += __shfl_sync(kFullWarp, sum, kWarp - 1);
  }
  return count;
}

// Fills the line of a pixel and a pair of its image; returns the length of the list, the same in every lane. Nothing
// but that is filled where it is 0. The caller synchronises the warp between its last look at a line and the next call.
template <typename T>
__device__ int32_t trace(const PlaneSweep<T>& sweep, const LineSizes& s, int64_t image, int64_t pair, int32_t pixel,
                         const Line<T>& line) {
  using namespace plane_sweep_math;
  const int lane = threadIdx.x % kWarp;
  const int32_t v = pixel / s.width;
  const Ray<T> ray = source_ray(sweep.homographies + 9 * pair, static_cast<T>(pixel - v * s.width), static_cast<T>(v));
  bool touches = false;
  clear_flags(line.touched, s);
  for (int32_t k = lane; k < s.n_depths; k += kWarp) {
    const Sample<T> at = sample_at(sweep, s, pair, ray, T(1) / sweep.inverse_depths[image * s.n_depths + k]);
    line.fx[k] = at.fx;
    line.fy[k] = at.fy;
    const int32_t corners = at.corners, first = at.first;
    // The corners lie below the index of the top left one, which is moved so that it is not negative.
    line.code[k] = (first + s.width + 1) << 4 | corners;
    touches |= corners != 0;
    if (corners & 1) line.touched[first] = 1;
    if (corners & 2) line.touched[first + 1] = 1;
    if (corners & 4) line.touched[first + s.width] = 1;
    if (corners & 8) line.touched[first + s.width + 1] = 1;
  }
  if (!__any_sync(kFullWarp, touches)) return 0;
  __syncwarp();
  const int32_t count = list_flags(line.touched, s, line.bits, line.before);
  __syncwarp();
  const uint16_t none = static_cast<uint16_t>(s.capacity);
  for (int32_t k = lane; k < s.n_depths; k += kWarp) {
    const int32_t code = line.code[k], first = (code >> 4) - s.width - 1;
    const auto place = [&](int side, int32_t q) {
      if (!(code >> side & 1)) return none;
      const int32_t rank = line.before[q >> 5] + __popc(line.bits[q >> 5] & ((1u << (q & 31)) - 1));
      return static_cast<uint16_t>(rank);
    };
    line.places[k] =
        make_ushort4(place(0, first), place(1, first + 1), place(2, first + s.width), place(3, first + s.width + 1));
  }
  __syncwarp();
  return count;
}

}  // namespace gsim3d::cuda
