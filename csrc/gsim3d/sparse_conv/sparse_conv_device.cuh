// What the kernels of sparse convolution share: types, and where the value of a voxel lies.
#pragma once

#include <cuda_bf16.h>
#include <cuda_fp16.h>

#include <type_traits>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/half.h"
#include "gsim3d/sparse_conv/sparse_conv.h"

namespace gsim3d::cuda::conv {

constexpr int kTile = 256;  // voxels of one block of a convolution

// The format a kernel computes with, and the one it adds in.
template <typename T>
struct Native {
  using Type = T;
};
template <>
struct Native<Float16> {
  using Type = __half;
};
template <>
struct Native<BFloat16> {
  using Type = __nv_bfloat16;
};
template <typename E>
using Sum = std::conditional_t<std::is_same_v<E, double>, double, float>;

template <typename E>
constexpr bool kIsHalf = std::is_same_v<E, __half> || std::is_same_v<E, __nv_bfloat16>;

inline int64_t taps_of(const SparseConvMap& map) { return map.kernel_size * map.kernel_size * map.kernel_size; }
inline int64_t tiles_of(const SparseConvMap& map) { return (map.n_voxels + kTile - 1) / kTile; }
inline int64_t round_up(int64_t n, int64_t step) { return (n + step - 1) / step * step; }

// One value a voxel, without copying those of voxels with one row. A source below n_rows is a row; the others count
// voxels of several rows: voxel v has the slot "rows before it" - v, which is below n_rows - n_voxels.
struct Sources {
  const int64_t* voxel_rows;
  const int64_t* cu_voxel_rows;
  int64_t n_rows, n_voxels, n_slots;
  bool first;  // the lowest row stands for the voxel

  __device__ int32_t of(int64_t voxel) const {  // -1: none
    if (!inside(voxel, n_voxels)) return -1;
    const Range rows = range_of(cu_voxel_rows, voxel, n_rows);
    if (rows.begin == rows.end) return -1;
    if (first || n_slots == 0 || rows.end - rows.begin == 1) {
      const int64_t row = voxel_rows[rows.begin];
      return inside(row, n_rows) ? static_cast<int32_t>(row) : -1;
    }
    const int64_t slot = rows.begin - voxel;
    return inside(slot, n_slots) ? static_cast<int32_t>(n_rows + slot) : -1;
  }
};

// Rows of features, then the values of shared voxels; both with `channels` columns.
template <typename E>
struct Values {
  const E* rows;
  const E* shared;
  int32_t n_rows, channels;

  __device__ const E* at(int32_t source) const {
    return source < n_rows ? rows + static_cast<int64_t>(source) * channels
                           : shared + static_cast<int64_t>(source - n_rows) * channels;
  }
};

// The pairs that write a tile of voxels through a tap, packed.
struct TilePairs {
  const int32_t* sources;  // [taps, pitch]; those of tile b start at b * kTile
  const uint8_t* places;   // [taps, pitch], the written voxel of the tile
  const int32_t* counts;   // [tiles, taps]
  int64_t pitch;           // tiles * kTile
};

enum class Share { kWhole, kEqualParts, kFirstRow };  // what the rows of a voxel get of the voxel's sum

// y[p] = bias + values[p] B_centre + share of (sum over pairs that write voxel v(p): values[source] B_tap), where
// B_tap[k, n] is weight[n, tap, k], or weight[k, tap, n] for the gradient of the input.
template <typename E>
struct Convolution {
  Values<E> values;
  const E* weight;  // [c_out, taps, weight_row]
  const E* bias;    // [c_write] or null
  TilePairs pairs;
  const int64_t* voxel_rows;
  const int64_t* cu_voxel_rows;
  const int64_t* row_voxel;
  int64_t n_voxels;
  int32_t taps, c_read, c_write, c_out, weight_row;
  Share share;
  E* y;
};

// What the row at voxel_rows[i] gets of its voxel's sum, and where that sum is.
struct Part {
  int64_t row;    // -1: nothing is written
  int32_t place;  // -1: no sum
  int32_t parts;  // that share the sum
};

template <typename E>
__device__ Part part_of(const Convolution<E>& conv, int64_t i, int64_t v0) {
  const int64_t n_rows = conv.values.n_rows, row = conv.voxel_rows[i];
  if (!inside(row, n_rows)) return {-1, -1, 1};
  const int64_t voxel = conv.row_voxel[row];
  if (!inside(voxel, conv.n_voxels) || !inside(voxel - v0, kTile)) return {row, -1, 1};
  const int32_t place = static_cast<int32_t>(voxel - v0);
  if (conv.share == Share::kWhole) return {row, place, 1};
  const Range rows = range_of(conv.cu_voxel_rows, voxel, n_rows);
  if (conv.share == Share::kFirstRow) return {row, i == rows.begin ? place : -1, 1};
  return {row, place, static_cast<int32_t>(max(rows.end - rows.begin, int64_t{1}))};
}

// Outer products of pairs: grad_weight[:, tap, :] = sum over pairs of grads[out] inputs[in]^T.
template <typename E>
struct OuterProducts {
  Values<E> grads, inputs;
  Sources grad_sources, input_sources;
  const int64_t* tap_in;
  const int64_t* tap_out;
  const int64_t* cu_taps;
  int64_t n_pairs, n_rows, block_pairs;
  int32_t taps, c_out, c_in;
  Sum<E>* partials;  // [blocks, c_out, c_in]
};

// The pairs of one block of a weight gradient. Each tap is cut into equal blocks of at most block_pairs; the centre
// tap pairs every row with itself.
struct PairBlock {
  int32_t tap;    // -1: there is no such block
  int32_t first;  // first block of the tap
  int32_t blocks;
  int64_t begin, end;
};

constexpr int kPairStep = 64;  // blocks start at multiples of it

__device__ inline Range pairs_of_tap(const int64_t* cu_taps, int32_t tap, int32_t taps, int64_t n_pairs,
                                     int64_t n_rows) {
  return tap == taps / 2 ? Range{0, n_rows} : range_of(cu_taps, tap, n_pairs);
}

// Called by a whole warp. Finds block `slot`, or with `slot` -1 the blocks of `tap`.
__device__ inline PairBlock find_block(const int64_t* cu_taps, int32_t taps, int64_t n_pairs, int64_t n_rows,
                                       int64_t block_pairs, int32_t slot, int32_t tap) {
  const int lane = threadIdx.x % kWarp;
  int32_t before = 0;
  for (int32_t t0 = 0; t0 < taps; t0 += kWarp) {
    const int32_t t = t0 + lane;
    Range range{0, 0};
    if (t < taps) range = pairs_of_tap(cu_taps, t, taps, n_pairs, n_rows);
    const int64_t n = range.end - range.begin;
    const int32_t blocks = static_cast<int32_t>((n + block_pairs - 1) / block_pairs);
    int32_t through = blocks;
    for (int step = 1; step < kWarp; step *= 2) {
      const int32_t other = __shfl_up_sync(kFullWarp, through, step);
      if (lane >= step) through += other;
    }
    const int32_t first = before + through - blocks;
    const bool mine = t < taps && (slot < 0 ? t == tap : first <= slot && slot < before + through);
    const unsigned found = __ballot_sync(kFullWarp, mine);
    if (found != 0) {
      PairBlock result{t, first, blocks, 0, 0};
      if (blocks > 0) {
        const int64_t length = ((n + blocks - 1) / blocks + kPairStep - 1) / kPairStep * kPairStep;
        result.begin = min(range.end, range.begin + max(slot - first, 0) * length);
        result.end = min(range.end, result.begin + length);
      }
      const int owner = __ffs(found) - 1;
      result.tap = __shfl_sync(kFullWarp, result.tap, owner);
      result.first = __shfl_sync(kFullWarp, result.first, owner);
      result.blocks = __shfl_sync(kFullWarp, result.blocks, owner);
      result.begin = __shfl_sync(kFullWarp, result.begin, owner);
      result.end = __shfl_sync(kFullWarp, result.end, owner);
      return result;
    }
    before += __shfl_sync(kFullWarp, through, kWarp - 1);
  }
  return {-1, 0, 0, 0, 0};
}

// The products, by plain multiply-adds for any type and size, and by tensor cores for 16-bit types whose rows are
// multiples of 16 bytes.
template <typename E>
void convolve_plain(const char* op, const Convolution<E>& conv, int64_t n_tiles, bool transposed, Stream stream);
template <typename E>
void convolve_tensor(const char* op, const Convolution<E>& conv, int64_t n_tiles, bool transposed, Stream stream);
template <typename E>
void outer_products_plain(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream);
template <typename E>
void outer_products_tensor(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream);

}  // namespace gsim3d::cuda::conv
