// Device helpers of row_norm: a group of lanes owns a row and keeps it in registers.
#pragma once

#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/half.cuh"
#include "gsim3d/core/half.h"
#include "gsim3d/core/pack.cuh"
#include "gsim3d/row_norm/row_norm_math.h"

// apply(In, Out) for the types of rows and results that row_norm and norm_gelu take.
#define GSIM3D_ROW_NORM_TYPES(apply)                                                               \
  apply(float, float) apply(float, Float16) apply(float, BFloat16) apply(Float16, float)           \
  apply(Float16, Float16) apply(BFloat16, float) apply(BFloat16, BFloat16) apply(double, double)

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kVector = 4;           // channels that a lane moves at once
constexpr int64_t kMostRows = 16;    // of one group of lanes where rows are summed
constexpr int64_t kManyBlocks = 512; // occupy a large GPU
constexpr int kReduceRows = 32;      // partial sums that one block of the last reduction adds side by side

// Rows of one group of lanes, `groups` of them a block, `columns` blocks side by side: the borders of sums over rows.
// The same for the same sizes, whatever the GPU. Few rows are spread over many blocks, for each row waits for memory.
inline int rows_of_group(int64_t n_rows, int64_t groups, unsigned columns = 1, int64_t blocks = kManyBlocks) {
  const int64_t at_once = groups * std::max<int64_t>(1, blocks / std::max(1u, columns));
  return static_cast<int>(std::clamp<int64_t>((n_rows + at_once - 1) / at_once, 1, kMostRows));
}

template <typename S>
__device__ __forceinline__ S widen(S x) {
  return x;
}
__device__ __forceinline__ float widen(Float16 x) { return __half2float(__ushort_as_half(x.bits)); }
__device__ __forceinline__ float widen(BFloat16 x) { return __bfloat162float(__ushort_as_bfloat16(x.bits)); }

template <typename To, typename S>
__device__ __forceinline__ To narrow(S x) {
  if constexpr (std::is_same_v<To, Float16>) return {__half_as_ushort(__float2half_rn(x))};
  else if constexpr (std::is_same_v<To, BFloat16>) return {__bfloat16_as_ushort(__float2bfloat16_rn(x))};
  else return x;
}

// A group of kGroup lanes owns a row; a lane holds kPacks times kVector of its channels. kExact: rows are whole vectors
// and aligned, else single channels are moved.
template <int kGroup, int kPacks, bool kExact>
struct Layout {
  static __device__ __forceinline__ int channel(int pack, int lane) { return (pack * kGroup + lane) * kVector; }

  template <typename S, typename T>
  static __device__ __forceinline__ void load(const T* row, int channels, int lane, S (&to)[kPacks][kVector]) {
#pragma unroll
    for (int p = 0; p < kPacks; ++p) {
      const int c = channel(p, lane);
      if (kExact) {
        Pack<T, kVector> pack{};
        if (c < channels) pack = *reinterpret_cast<const Pack<T, kVector>*>(row + c);
#pragma unroll
        for (int j = 0; j < kVector; ++j) to[p][j] = c < channels ? static_cast<S>(widen(pack.lane[j])) : S(0);
      } else {
#pragma unroll
        for (int j = 0; j < kVector; ++j) to[p][j] = c + j < channels ? static_cast<S>(widen(row[c + j])) : S(0);
      }
    }
  }

  template <typename T, typename S>
  static __device__ __forceinline__ void store(T* row, int channels, int lane, const S (&from)[kPacks][kVector]) {
#pragma unroll
    for (int p = 0; p < kPacks; ++p) {
      const int c = channel(p, lane);
      if (kExact) {
        Pack<T, kVector> pack;
#pragma unroll
        for (int j = 0; j < kVector; ++j) pack.lane[j] = narrow<T>(from[p][j]);
        if (c < channels) *reinterpret_cast<Pack<T, kVector>*>(row + c) = pack;
      } else {
#pragma unroll
        for (int j = 0; j < kVector; ++j)
          if (c + j < channels) row[c + j] = narrow<T>(from[p][j]);
      }
    }
  }
};

template <int kGroup, typename S>
__device__ __forceinline__ S group_sum(S x) {
#pragma unroll
  for (int step = kGroup / 2; step > 0; step /= 2) x += __shfl_xor_sync(kFullWarp, x, step, kGroup);
  return x;
}

// Mean and 1 / sqrt(variance + eps) of a row that a group holds.
template <typename Rows, int kGroup, int kPacks, typename S>
__device__ __forceinline__ RowStats<S> stats_of(const S (&value)[kPacks][kVector], int channels, int lane, S eps) {
  S sum = 0;
#pragma unroll
  for (int p = 0; p < kPacks; ++p)
#pragma unroll
    for (int j = 0; j < kVector; ++j) sum += value[p][j];
  const S mean = group_sum<kGroup>(sum) / static_cast<S>(channels);
  S square = 0;
#pragma unroll
  for (int p = 0; p < kPacks; ++p)
#pragma unroll
    for (int j = 0; j < kVector; ++j) {
      const S distance = Rows::channel(p, lane) + j < channels ? value[p][j] - mean : S(0);
      square += distance * distance;
    }
  const S variance = group_sum<kGroup>(square) / static_cast<S>(channels);
  return {mean, S(1) / sqrt(variance + eps)};
}

// The two means over a row that its gradient needs; see row_norm_value_vjp. Channels behind the last have g = 0.
template <typename S>
struct GradMeans {
  S mean_grad, mean_grad_x;
};
template <int kGroup, int kPacks, typename S>
__device__ __forceinline__ GradMeans<S> grad_means_of(const S (&g)[kPacks][kVector], const S (&x)[kPacks][kVector],
                                                      const S (&weight)[kPacks][kVector], RowStats<S> stats,
                                                      int channels) {
  S sum = 0, sum_x = 0;
#pragma unroll
  for (int p = 0; p < kPacks; ++p)
#pragma unroll
    for (int j = 0; j < kVector; ++j) {
      const S scaled = g[p][j] * weight[p][j];
      sum += scaled;
      sum_x += scaled * normalised(x[p][j], stats);
    }
  return {group_sum<kGroup>(sum) / static_cast<S>(channels), group_sum<kGroup>(sum_x) / static_cast<S>(channels)};
}

// How many of the rows first, first + kGroups, ... lie before n_rows, of `rows` at most.
template <int kGroups>
__device__ __forceinline__ int rows_before(int64_t first, int64_t n_rows, int rows) {
  return static_cast<int>(min(max((n_rows - first + kGroups - 1) / kGroups, int64_t{0}), static_cast<int64_t>(rows)));
}

// to[c] = sum over the groups of a block of `mine`, groups in order. sums: shared memory for one row a group.
template <typename Rows, int kGroup, int kPacks, typename S>
__device__ __forceinline__ void sum_groups(const S (&mine)[kPacks][kVector], int channels, S* sums, S* to) {
  constexpr int kGroups = kThreads / kGroup, kWidth = kGroup * kPacks * kVector;
  const int lane = threadIdx.x % kGroup, group = threadIdx.x / kGroup;
  __syncthreads();
#pragma unroll
  for (int p = 0; p < kPacks; ++p)
#pragma unroll
    for (int j = 0; j < kVector; ++j) sums[group * kWidth + Rows::channel(p, lane) + j] = mine[p][j];
  __syncthreads();
  for (int c = threadIdx.x; c < channels; c += kThreads) {
    S total = 0;
    for (int other = 0; other < kGroups; ++other) total += sums[other * kWidth + c];
    to[c] = total;
  }
}

// Results of sums over rows, each [channels].
template <typename S>
struct RowSums {
  static constexpr int kMost = 5;
  S* to[kMost];
};

// to[i][c] = sum over blocks of partial[block, i, c]: kReduceRows running sums, added in order.
template <typename S>
__global__ void reduce_kernel(const S* __restrict__ partial, int64_t n_blocks, int64_t width, int64_t channels,
                              RowSums<S> sums_of) {
  __shared__ S sums[kReduceRows][kWarp + 1];
  const int64_t c = static_cast<int64_t>(blockIdx.x) * kWarp + threadIdx.x;
  S sum = 0;
  for (int64_t block = threadIdx.y; c < width && block < n_blocks; block += kReduceRows)
    sum += partial[block * width + c];
  sums[threadIdx.y][threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.y != 0 || c >= width) return;
  S total = 0;
  for (int y = 0; y < kReduceRows; ++y) total += sums[y][threadIdx.x];
  sums_of.to[c / channels][c % channels] = total;
}

// Calls f.template operator()<kGroup, kPacks, kExact>() for the number of channels.
template <typename F>
void by_shape(const char* op, int64_t channels, bool aligned, const F& f) {
  check(channels <= 1024, op, ": x must have at most 1024 channels on CUDA; got ", channels);
  const bool exact = aligned && channels % kVector == 0;
  const auto pick = [&]<int kGroup, int kPacks>() {
    if (exact) f.template operator()<kGroup, kPacks, true>();
    else f.template operator()<kGroup, kPacks, false>();
  };
  if (channels <= 32) pick.template operator()<8, 1>();
  else if (channels <= 64) pick.template operator()<16, 1>();
  else if (channels <= 128) pick.template operator()<32, 1>();
  else if (channels <= 256) pick.template operator()<32, 2>();
  else if (channels <= 512) pick.template operator()<32, 4>();
  else pick.template operator()<32, 8>();
}

template <typename... Pointers>
bool aligned(const Pointers*... pointers) {
  return ((reinterpret_cast<uintptr_t>(pointers) % (sizeof(Pointers) * kVector) == 0) && ...);
}

}  // namespace
}  // namespace gsim3d::cuda
