// What the kernels of sparse convolution share: types, and where the value of a voxel lies.
#pragma once

#include <type_traits>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/half.cuh"
#include "gsim3d/sparse_conv/sparse_conv.h"

namespace gsim3d::cuda::conv {

constexpr int kTile = 256;  // voxels of one block of a convolution

template <typename E>
constexpr bool kIsHalf = std::is_same_v<E, __half> || std::is_same_v<E, __nv_bfloat16>;

inline int64_t taps_of(const SparseConvMap& map) { return map.kernel_size * map.kernel_size * map.kernel_size; }
inline int64_t tiles_of(const SparseConvMap& map) { return (map.n_voxels + kTile - 1) / kTile; }
inline int64_t round_up(int64_t n, int64_t step) { return (n + step - 1) / step * step; }
// Where some voxels are empty, any number of the others may be shared.
inline int64_t slots_of(const SparseConvMap& map) {
  return map.n_voxels > map.n_rows ? map.n_rows : map.n_rows - map.n_voxels;
}

// One value a voxel, without copying those of voxels with one row. A source below n_rows is a row; the others count
// voxels of several rows: voxel v has the slot "rows before it" - v, which is below n_rows - n_voxels.
struct Sources {
  const int64_t* voxel_rows;
  const int64_t* cu_voxel_rows;
  int64_t n_rows, n_voxels, n_slots;

  __device__ int32_t of(int64_t voxel) const {  // -1: none
    if (!inside(voxel, n_voxels) || voxel >= n_rows) return -1;
    if (n_slots == 0) {  // no voxel is empty, hence every voxel has one row
      const int64_t row = voxel_rows[voxel];
      return inside(row, n_rows) ? static_cast<int32_t>(row) : -1;
    }
    const Range rows = range_of(cu_voxel_rows, voxel, n_rows);
    if (rows.begin == rows.end) return -1;
    if (rows.end - rows.begin == 1) {
      const int64_t row = voxel_rows[rows.begin];
      return inside(row, n_rows) ? static_cast<int32_t>(row) : -1;
    }
    const int64_t slot = rows.begin - voxel;
    return inside(slot, n_slots) ? static_cast<int32_t>(n_rows + slot) : -1;
  }
};

inline Sources sources_of(const SparseConvMap& map) {
  return {map.voxel_rows, map.cu_voxel_rows, map.n_rows, map.n_voxels, slots_of(map)};
}

// A product of two numbers that are not negative, in one instruction.
__device__ __forceinline__ int64_t wide_product(int32_t a, int32_t b) {
  return static_cast<int64_t>(static_cast<uint64_t>(static_cast<uint32_t>(a)) * static_cast<uint32_t>(b));
}

// Rows of features, then the values of shared voxels; both with `channels` columns.
template <typename E>
struct Values {
  const E* rows;
  const E* shared;
  int32_t n_rows, n_sources, channels;

  __device__ const E* at(int32_t source) const {
    const bool alone = source < n_rows;
    return (alone ? rows : shared) + wide_product(alone ? source : source - n_rows, channels);
  }
};

// Rows in the order in which tiles take them, and where the taps of each read.
struct RowPlan {
  const int32_t* order;    // [pitch], the row at each place; -1: none
  const int32_t* sources;  // [taps, pitch], -1: none; the centre's are not listed
  const uint32_t* active;  // [pitch / kConvGroupRows, words], by bit the taps that a group of places has
  int32_t pitch;           // a multiple of kConvPlanStep
  int32_t words;
  bool mirrored;  // tap t of the plan is tap taps - 1 - t of the weights
};
RowPlan row_plan_in(const int32_t* memory, int64_t n_rows, int64_t taps, bool mirrored);
void make_row_plan(const char* op, const SparseConvMap& map, bool transposed, int32_t* memory,
                   const Workspace& workspace, Stream stream);

// The pairs that write a tile of voxels through a tap, packed.
struct TilePairs {
  const int32_t* sources;  // [taps, pitch]; those of tile b start at b * kTile
  const uint8_t* places;   // [taps, pitch], the written voxel of the tile
  const int32_t* counts;   // [tiles, taps]
  const int32_t* rows;     // [n_rows], voxel_rows where they are in range, else -1
  int32_t pitch;           // tiles * kTile
};

enum class Share { kWhole, kEqualParts, kFirstRow };  // what the rows of a voxel get of the voxel's sum

// y[p] = bias + values[p] B_centre + share of (sum over pairs that write voxel v(p): values[source] B_tap), where
// B_tap[k, n] is weight[n, tap, k]; for the gradient of the input weight[k, tap, n] or, on tensor cores, the same of a
// transposed copy of the weights.
template <typename E>
struct Convolution {
  Values<E> values;
  const E* weight;  // [c_out, taps, weight_row]
  const E* bias;    // [c_write] or null
  const int64_t* row_voxel;
  const int64_t* voxel_rows;
  const int64_t* cu_voxel_rows;
  int64_t n_voxels;
  int32_t taps, c_read, c_write, c_out, weight_row;
  Share share;
  E* y;
  TilePairs pairs;  // for plain products
  RowPlan plan;     // for tensor cores

  __device__ int32_t weight_tap(int32_t tap) const { return plan.mirrored ? taps - 1 - tap : tap; }
};

// The first of ascending values [low, high) that is not below `wanted`. The halves of a warp search for two values.
__device__ inline int64_t search(const int64_t* values, int64_t low, int64_t high, int64_t wanted) {
  constexpr int kProbes = 16;
  const int lane = threadIdx.x % kWarp;
  while (__any_sync(kFullWarp, low < high)) {
    const int64_t size = high - low, step = (size + kProbes - 1) / kProbes;
    const auto probe = [&](int i) { return min(low + step * (i + 1), high) - 1; };
    const bool below = size > 0 && values[probe(lane % kProbes)] < wanted;
    const int n_below = __popc(__ballot_sync(kFullWarp, below) >> (lane / kProbes * kProbes) & 0xffff);
    if (size <= 0) continue;
    const int64_t begin = n_below > 0 ? probe(n_below - 1) + 1 : low;
    if (n_below < kProbes) high = probe(n_below);
    low = begin;
  }
  return low;
}

// The pairs of a tap whose values lie in [first, first + count). A whole warp calls it.
__device__ inline Range search_range(const int64_t* values, Range range, int64_t first, int64_t count) {
  const int64_t bound = search(values, range.begin, range.end, first + threadIdx.x % kWarp / 16 * count);
  return {__shfl_sync(kFullWarp, bound, 0), __shfl_sync(kFullWarp, bound, kWarp - 1)};
}

// Outer products of pairs: grad_weight[:, tap, :] = sum over pairs of grads[out] inputs[in]^T. Voxels are cut into
// chunks; a block sums the pairs of one tap that write a chunk, or of a part of a chunk's rows with themselves for the
// centre tap, which has most pairs. The blocks of a chunk follow each other, since they read the same rows.
template <typename E>
struct OuterProducts {
  Values<E> grads, inputs;
  Sources sources;
  const int64_t* tap_in;
  const int64_t* tap_out;
  const int64_t* cu_taps;
  int64_t n_pairs, chunk_voxels;
  int32_t taps, centre_parts, c_out, c_in;
  Sum<E>* partials;  // [chunks, centre_parts + taps - 1, c_out, c_in]; or null:
  void* result;      // [result_rows, taps, c_in], Sum<E> or, where rounded, E; one block has all pairs of a tap
  int32_t result_rows;
  bool rounded;

  __host__ __device__ int32_t blocks_per_chunk() const { return centre_parts + taps - 1; }
};

struct PairBlock {
  int32_t tap;
  Range pairs;  // for the centre tap: of voxel_rows
};

// A whole warp calls it.
template <typename E>
__device__ PairBlock pair_block(const OuterProducts<E>& products, int64_t index) {
  const int64_t first = index / products.blocks_per_chunk() * products.chunk_voxels;
  const int32_t unit = static_cast<int32_t>(index % products.blocks_per_chunk()), centre = products.taps / 2;
  const Sources& sources = products.sources;
  if (unit < products.centre_parts) {
    const int64_t part = products.chunk_voxels / products.centre_parts, v = first + unit * part;
    const int64_t begin = sources.cu_voxel_rows[min(v, sources.n_voxels)];
    const int64_t end = sources.cu_voxel_rows[min(v + part, sources.n_voxels)];
    const int64_t low = min(max(begin, int64_t{0}), sources.n_rows);
    return {centre, {low, min(max(end, low), sources.n_rows)}};
  }
  const int32_t other = unit - products.centre_parts, tap = other < centre ? other : other + 1;
  const Range range = range_of(products.cu_taps, tap, products.n_pairs);
  return {tap, search_range(products.tap_out, range, first, products.chunk_voxels)};
}

// Rows of memory of one pair; -1, -1 where it is none.
struct PairSources {
  int32_t out, in;
};
template <typename E>
__device__ PairSources pair_sources(const OuterProducts<E>& products, int32_t tap, int64_t i) {
  if (tap == products.taps / 2) {
    const int64_t row = products.sources.voxel_rows[i];
    const int32_t source = inside(row, products.sources.n_rows) ? static_cast<int32_t>(row) : -1;
    return {source, source};
  }
  const int32_t out = products.sources.of(products.tap_out[i]), in = products.sources.of(products.tap_in[i]);
  return out < 0 || in < 0 ? PairSources{-1, -1} : PairSources{out, in};
}

// The products, by plain multiply-adds for any type and size, and by tensor cores for 16-bit types whose rows are
// multiples of 16 bytes.
template <typename E>
void convolve_plain(const char* op, const Convolution<E>& conv, int64_t n_tiles, bool transposed, Stream stream);
// False, and nothing is queued, where the tables of so many taps find no room.
template <typename E>
bool convolve_tensor(const char* op, const Convolution<E>& conv, const Workspace& workspace, Stream stream);
template <typename E>
void outer_products_plain(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream);
template <typename E>
void outer_products_tensor(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream);

}  // namespace gsim3d::cuda::conv
