// Products of sparse convolution by fused multiply-adds: exact float32 and float64, and 16-bit types of any size.
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kThreads = 256;
constexpr int kRows = 64;     // pairs of one product
constexpr int kColumns = 64;  // output channels of a block
constexpr int kDepth = 16;    // channels staged at a time
constexpr int kPitch = kRows + 4;

template <typename E>
__device__ __forceinline__ Sum<E> widen(E value) {
  return static_cast<Sum<E>>(value);
}

// sums[4][4] += a[k][4 rows from r] b[k][4 columns from c], k = 0 .. kDepth - 1.
template <typename T>
__device__ __forceinline__ void multiply(const T (*a)[kPitch], const T (*b)[kPitch], int r, int c, T (&sums)[4][4]) {
#pragma unroll
  for (int k = 0; k < kDepth; ++k) {
    T left[4], right[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      left[i] = a[k][r + i];
      right[i] = b[k][c + i];
    }
#pragma unroll
    for (int i = 0; i < 4; ++i)
#pragma unroll
      for (int j = 0; j < 4; ++j) sums[i][j] = fma(left[i], right[j], sums[i][j]);
  }
}

template <typename E>
struct alignas(16) Stage {
  Sum<E> a[kDepth][kPitch];
  Sum<E> b[kDepth][kPitch];
};

// Four neighbouring elements of which `left` exist; at once where `whole` says that all rows are groups of four.
template <typename E>
__device__ __forceinline__ void load_four(const E* from, int32_t left, bool whole, Sum<E> (&to)[4]) {
  struct alignas(4 * sizeof(E)) Four {
    E values[4];
  };
  Four four{};
  if (whole && left > 0) {
    four = *reinterpret_cast<const Four*>(from);
  } else {
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < left) four.values[i] = from[i];
  }
#pragma unroll
  for (int i = 0; i < 4; ++i) to[i] = widen(four.values[i]);
}

// Adds the products of the thread's row (of kRows; null: zeros) with B_tap to sums. All threads call it. The loads of a
// stage are in flight while the stage before is multiplied.
template <typename E, bool kTransposed>
__device__ __forceinline__ void multiply_rows(const Convolution<E>& conv, const E* row, int32_t tap, int32_t n0,
                                              bool whole, Stage<E>& stage, Sum<E> (&sums)[4][4]) {
  const int thread = threadIdx.x, r = thread / 4, kr = thread % 4 * 4;
  const int bk = thread / 16, bn = thread % 16 * 4;  // of a transposed weight
  Sum<E> left[4], right[4];
  const auto load = [&](int32_t k0) {
    load_four(row + k0 + kr, row != nullptr ? conv.c_read - k0 - kr : 0, whole, left);
    const int32_t first = kTransposed ? k0 + bk : n0 + r, last = kTransposed ? n0 + bn : k0 + kr;
    const int32_t columns = kTransposed ? conv.c_write : conv.c_read;
    const E* from = conv.weight + (static_cast<int64_t>(first) * conv.taps + tap) * conv.weight_row + last;
    load_four(from, first < conv.c_out ? columns - last : 0, whole, right);
  };
  load(0);
  for (int32_t k0 = 0; k0 < conv.c_read; k0 += kDepth) {
    __syncthreads();
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      stage.a[kr + i][r] = left[i];
      if constexpr (kTransposed)
        stage.b[bk][bn + i] = right[i];
      else
        stage.b[kr + i][r] = right[i];
    }
    __syncthreads();
    if (k0 + kDepth < conv.c_read) load(k0 + kDepth);
    multiply(stage.a, stage.b, thread / 16 * 4, thread % 16 * 4, sums);
  }
}

// What the row at voxel_rows[i] gets of its voxel's sum, and where that sum is.
struct Part {
  int64_t row;    // -1: nothing is written
  int32_t place;  // -1: no sum
  int32_t parts;  // that share the sum
};

template <typename E>
__device__ Part part_of(const Convolution<E>& conv, int64_t i, int64_t v0) {
  const int64_t n_rows = conv.values.n_rows, row = conv.pairs.rows[i];
  if (row < 0) return {-1, -1, 1};
  // Where there are as many voxels as rows every voxel has one.
  const int64_t voxel = conv.n_voxels == n_rows ? i : conv.row_voxel[row];
  if (!inside(voxel, conv.n_voxels) || !inside(voxel - v0, kTile)) return {row, -1, 1};
  const int32_t place = static_cast<int32_t>(voxel - v0);
  if (conv.share == Share::kWhole || conv.n_voxels == n_rows) return {row, place, 1};
  const Range rows = range_of(conv.cu_voxel_rows, voxel, n_rows);
  if (conv.share == Share::kFirstRow) return {row, i == rows.begin ? place : -1, 1};
  return {row, place, static_cast<int32_t>(max(rows.end - rows.begin, int64_t{1}))};
}

// One block: a tile of voxels, kColumns output channels. The sums of the tile's voxels lie in shared memory; a tap has
// every voxel at most once, so each sum has one owner between two barriers.
template <typename E, bool kTransposed>
__global__ void __launch_bounds__(kThreads) convolve(Convolution<E> conv, bool whole) {
  using T = Sum<E>;
  extern __shared__ __align__(16) char memory[];
  Stage<E>& stage = *reinterpret_cast<Stage<E>*>(memory);
  T* tile = reinterpret_cast<T*>(memory + sizeof(Stage<E>));  // [kTile, kColumns]
  const int thread = threadIdx.x, r = thread / 16 * 4, c = thread % 16 * 4;
  const int64_t v0 = static_cast<int64_t>(blockIdx.x) * kTile;
  const int32_t n0 = blockIdx.y * kColumns, centre = conv.taps / 2;
  for (int i = thread; i < kTile * kColumns; i += kThreads) tile[i] = T(0);
  __syncthreads();

  for (int32_t tap = 0; tap < conv.taps; ++tap) {
    if (tap == centre) continue;
    const int32_t count = conv.pairs.counts[static_cast<int64_t>(blockIdx.x) * conv.taps + tap];
    const int64_t list = wide_product(tap, conv.pairs.pitch) + v0;
    for (int32_t m0 = 0; m0 < count; m0 += kRows) {
      const int32_t mine = m0 + thread / 4;
      const E* row = mine < count ? conv.values.at(conv.pairs.sources[list + mine]) : nullptr;
      T sums[4][4] = {};
      multiply_rows<E, kTransposed>(conv, row, tap, n0, whole, stage, sums);
#pragma unroll
      for (int i = 0; i < 4; ++i)
        if (m0 + r + i < count) {
          T* to = tile + conv.pairs.places[list + m0 + r + i] * kColumns + c;
#pragma unroll
          for (int j = 0; j < 4; ++j) to[j] += sums[i][j];
        }
    }
  }
  __syncthreads();

  const int64_t n_rows = conv.values.n_rows;
  const int64_t begin = min(max(conv.cu_voxel_rows[v0], int64_t{0}), n_rows);
  const int64_t end = min(max(conv.cu_voxel_rows[min(v0 + kTile, conv.n_voxels)], begin), n_rows);
  for (int64_t m0 = begin; m0 < end; m0 += kRows) {
    const int64_t mine = m0 + thread / 4, index = mine < end ? conv.pairs.rows[mine] : -1;
    const E* row = index >= 0 ? conv.values.rows + index * conv.c_read : nullptr;
    T sums[4][4] = {};
    multiply_rows<E, kTransposed>(conv, row, centre, n0, whole, stage, sums);
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      if (m0 + r + i >= end) continue;
      const Part part = part_of(conv, m0 + r + i, v0);
      if (part.row < 0) continue;
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        const int32_t n = n0 + c + j;
        if (n >= conv.c_write) continue;
        T y = sums[i][j];
        if (conv.bias != nullptr) y += widen(conv.bias[n]);
        if (part.place >= 0) y += tile[part.place * kColumns + c + j] / static_cast<T>(part.parts);
        conv.y[part.row * conv.c_write + n] = static_cast<E>(y);
      }
    }
  }
}

// One block: a block of pairs of a tap, kRows x kColumns of its outer products.
template <typename E>
__global__ void __launch_bounds__(kThreads) multiply_pairs(OuterProducts<E> products, int32_t column_tiles) {
  using T = Sum<E>;
  __shared__ Stage<E> stage;
  const PairBlock block = pair_block(products, blockIdx.x);
  const int thread = threadIdx.x, pair = thread / 16, from = thread % 16 * 4;
  const int32_t co = blockIdx.y / column_tiles * kRows, ci = blockIdx.y % column_tiles * kColumns;
  T sums[4][4] = {};
  for (int64_t p0 = block.pairs.begin; p0 < block.pairs.end; p0 += kDepth) {
    const int64_t p = p0 + pair;
    const PairSources rows = p < block.pairs.end ? pair_sources(products, block.tap, p) : PairSources{-1, -1};
    const bool real = rows.out >= 0;
    const E* left = real ? products.grads.at(rows.out) : nullptr;
    const E* right = real ? products.inputs.at(rows.in) : nullptr;
    __syncthreads();
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      stage.a[pair][from + i] = real && co + from + i < products.c_out ? widen(left[co + from + i]) : T(0);
      stage.b[pair][from + i] = real && ci + from + i < products.c_in ? widen(right[ci + from + i]) : T(0);
    }
    __syncthreads();
    multiply(stage.a, stage.b, thread / 16 * 4, thread % 16 * 4, sums);
  }
  T* to = products.partials + static_cast<int64_t>(blockIdx.x) * products.c_out * products.c_in;
#pragma unroll
  for (int i = 0; i < 4; ++i)
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const int32_t o = co + thread / 16 * 4 + i, n = ci + thread % 16 * 4 + j;
      if (o < products.c_out && n < products.c_in) to[static_cast<int64_t>(o) * products.c_in + n] = sums[i][j];
    }
}

}  // namespace

template <typename E>
void convolve_plain(const char* op, const Convolution<E>& conv, int64_t n_tiles, bool transposed, Stream stream) {
  const dim3 blocks(blocks_for(op, n_tiles, 1), blocks_for(op, conv.c_write, kColumns));
  const auto fours = [](const E* data) { return reinterpret_cast<uintptr_t>(data) % (4 * sizeof(E)) == 0; };
  const bool whole = conv.c_read % 4 == 0 && conv.weight_row % 4 == 0 && fours(conv.values.rows) &&
                     fours(conv.values.shared) && fours(conv.weight);
  const size_t bytes = sizeof(Stage<E>) + sizeof(Sum<E>) * kTile * kColumns;
  launch(op, transposed ? convolve<E, true> : convolve<E, false>, blocks, kThreads, bytes, stream, conv, whole);
}

template <typename E>
void outer_products_plain(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream) {
  const unsigned columns = blocks_for(op, products.c_in, kColumns);
  const dim3 blocks(blocks_for(op, n_blocks, 1), blocks_for(op, products.c_out, kRows) * columns);
  launch(op, multiply_pairs<E>, blocks, kThreads, 0, stream, products, static_cast<int32_t>(columns));
}

#define GSIM3D_INSTANTIATE(E)                                                                 \
  template void convolve_plain<E>(const char*, const Convolution<E>&, int64_t, bool, Stream); \
  template void outer_products_plain<E>(const char*, const OuterProducts<E>&, int64_t, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(__half)
GSIM3D_INSTANTIATE(__nv_bfloat16)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda::conv
