// Tiles of listed rows in shared memory, and the fragments that a warp reads from them.
#pragma once

#include "gsim3d/patch_attn/patch_attn_mma.cuh"
#include "gsim3d/patch_attn/patch_attn_parts.cuh"

namespace gsim3d::cuda {

constexpr int kStep = 16;  // rows of a tile that a warp takes at a time

// Rows of D 16-bit numbers, D / 8 chunks of 16 bytes each. Chunks of a row change places, so that the eight rows of a
// matrix that a warp loads lie in different banks.
template <int D>
struct TileLayout {
  static constexpr int kChunks = D / 8, kRowsPerLine = 8 / kChunks;
  static constexpr int kBytesPerStep = kStep * D * 2;

  __device__ __forceinline__ static int chunk(int row, int c) {
    return row * kChunks + (c ^ (row / kRowsPerLine % kChunks));
  }

  // Where lane `lane` finds its row for load_matrices of the chunks 2s and 2s + 1 of the first 16 rows; the next 16
  // rows are kBytesPerStep further. The four matrices, by rows: (rows 0-7, chunk 2s), (0-7, 2s + 1), (8-15, 2s),
  // (8-15, 2s + 1); otherwise: (0-7, 2s), (8-15, 2s), (0-7, 2s + 1), (8-15, 2s + 1).
  template <bool kByRows>
  __device__ __forceinline__ static int lane_offset(int lane, int s) {
    const int matrix = lane / 8;
    const int row = lane % 8 + 8 * (kByRows ? matrix / 2 : matrix % 2);
    return 16 * chunk(row, 2 * s + (kByRows ? matrix % 2 : matrix / 2));
  }
};

// Queues copies: the listed rows of one head of two matrices into two tiles of at most kRows rows, a group of copies
// for each of kParts parts of the tiles; rows beyond n up to the next multiple of kStep, and rows outside [0, n_rows),
// become 0. Where `valid` is given, it gets a byte for each row: whether it takes part. Returns whether all n rows that
// this thread saw do.
template <int D, int kThreads, int kRows, int kParts = 1, typename T>
__device__ __forceinline__ bool copy_tiles(const HeadRows<T> (&x)[2], const int64_t* rows, int n, int64_t n_rows,
                                           int64_t head, const uint32_t (&tiles)[2], uint8_t* valid) {
  // A thread keeps its chunk of a row, and its place in a group of eight rows.
  constexpr int kChunks = TileLayout<D>::kChunks, kRowsAtOnce = kThreads / kChunks;
  constexpr int kTurns = kRows / kRowsAtOnce;
  static_assert(kRowsAtOnce % 8 == 0 && kRows % kRowsAtOnce == 0 && kTurns % kParts == 0);
  const int c = threadIdx.x % kChunks, first = threadIdx.x / kChunks, padded = (n + kStep - 1) / kStep * kStep;
  int64_t listed[kTurns];  // all are on their way before the first copy waits for its row
#pragma unroll
  for (int i = 0; i < kTurns; ++i) listed[i] = first + i * kRowsAtOnce < n ? rows[first + i * kRowsAtOnce] : -1;
  const T* from[2] = {x[0].at(0, head) + 8 * c, x[1].at(0, head) + 8 * c};
  const uint32_t to = 16 * TileLayout<D>::chunk(first, c);
  bool all = true;
#pragma unroll
  for (int i = 0; i < kTurns; ++i) {
    const int r = first + i * kRowsAtOnce;
    if (r < padded) {
      const bool wanted = inside(listed[i], n_rows);
#pragma unroll
      for (int j = 0; j < 2; ++j)
        copy_async(tiles[j] + to + i * kRowsAtOnce * D * static_cast<int>(sizeof(T)),
                   wanted ? from[j] + listed[i] * x[j].row_stride : x[j].data, wanted);
      if (valid != nullptr && c == 0) valid[r] = wanted;
      all = all && (wanted || r >= n);
    }
    if ((i + 1) % (kTurns / kParts) == 0) commit_copies();
  }
  return all;
}

// Rows first .. first + 15 of listed rows as an A tile, 16 columns from column 16 s; rows outside become 0.
template <typename T>
struct RowPair {
  const T* low;   // row g of the lane, nullptr where there is none
  const T* high;  // row g + 8
};
template <typename T>
__device__ __forceinline__ RowPair<T> find_rows(const HeadRows<T>& x, const int64_t* rows, int64_t first, int64_t end,
                                                int64_t n_rows, int64_t head) {
  const int64_t i = first + threadIdx.x % kWarp / 4;
  const int64_t low = i < end ? rows[i] : -1, high = i + 8 < end ? rows[i + 8] : -1;
  return {inside(low, n_rows) ? x.at(low, head) : nullptr, inside(high, n_rows) ? x.at(high, head) : nullptr};
}
template <typename T>
__device__ __forceinline__ void load_fragment(const RowPair<T>& rows, int s, uint32_t (&a)[4]) {
  const int column = 16 * s + 2 * (threadIdx.x % 4);
  const auto pair = [](const T* row, int at) { return row ? *reinterpret_cast<const uint32_t*>(row + at) : 0u; };
  a[0] = pair(rows.low, column);
  a[1] = pair(rows.high, column);
  a[2] = pair(rows.low, column + 8);
  a[3] = pair(rows.high, column + 8);
}
__device__ __forceinline__ void negate(uint32_t (&a)[4]) {
#pragma unroll
  for (uint32_t& pair : a) pair ^= 0x80008000u;
}

// c += a b^T for M row tiles a [16, D] and the 16 rows b [16, D] of one step of a tile in shared memory.
template <typename T, int D, int M>
__device__ __forceinline__ void multiply_by_rows(const uint32_t (&a)[M][D / 16][4], uint32_t tile, int step,
                                                 float (&c)[M][2][4]) {
#pragma unroll
  for (int d = 0; d < D / 16; ++d) {
    uint32_t b[4];
    load_matrices<false>(b, tile + step * TileLayout<D>::kBytesPerStep +
                                TileLayout<D>::template lane_offset<true>(threadIdx.x % kWarp, d));
#pragma unroll
    for (int m = 0; m < M; ++m) {
      mma<T>(c[m][0], a[m][d], b[0], b[1]);
      mma<T>(c[m][1], a[m][d], b[2], b[3]);
    }
  }
}

// c += a b for M row tiles a [16, 16] and the 16 rows b [16, D] of one step of a tile.
template <typename T, int D, int M>
__device__ __forceinline__ void multiply_by_columns(const uint32_t (&a)[M][4], uint32_t tile, int step,
                                                    float (&c)[M][D / 8][4]) {
#pragma unroll
  for (int d = 0; d < D / 16; ++d) {
    uint32_t b[4];
    load_matrices<true>(b, tile + step * TileLayout<D>::kBytesPerStep +
                               TileLayout<D>::template lane_offset<false>(threadIdx.x % kWarp, d));
#pragma unroll
    for (int m = 0; m < M; ++m) {
      mma<T>(c[m][2 * d], a[m], b[0], b[1]);
      mma<T>(c[m][2 * d + 1], a[m], b[2], b[3]);
    }
  }
}

// Largest and sum over the four lanes that share a row of a C tile.
__device__ __forceinline__ float largest_of_row(float x) {
  x = fmaxf(x, __shfl_xor_sync(kFullWarp, x, 1));
  return fmaxf(x, __shfl_xor_sync(kFullWarp, x, 2));
}
__device__ __forceinline__ float sum_of_row(float x) {
  x += __shfl_xor_sync(kFullWarp, x, 1);
  return x + __shfl_xor_sync(kFullWarp, x, 2);
}

}  // namespace gsim3d::cuda
