#include <cuda_bf16.h>
#include <cuda_fp16.h>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/row_norm/row_norm_math.h"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kVector = 4;           // channels that a lane moves at once
constexpr int kRowsPerGroup = 16;    // rows of one group of lanes in the backward pass: the borders of its partial sums
constexpr int kReduceRows = 32;      // partial sums that one block of the last reduction adds side by side

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

template <typename T>
struct alignas(sizeof(T) * kVector) Pack {
  T lane[kVector];
};

// A group of kGroup lanes owns a row; a lane holds kPacks times kVector of its channels. kExact: rows are whole vectors and
// aligned, else single channels are moved.
template <int kGroup, int kPacks, bool kExact>
struct Layout {
  static __device__ __forceinline__ int channel(int pack, int lane) { return (pack * kGroup + lane) * kVector; }

  template <typename S, typename T>
  static __device__ __forceinline__ void load(const T* row, int channels, int lane, S (&to)[kPacks][kVector]) {
#pragma unroll
    for (int p = 0; p < kPacks; ++p) {
      const int c = channel(p, lane);
      if (kExact) {
        Pack<T> pack{};
        if (c < channels) pack = *reinterpret_cast<const Pack<T>*>(row + c);
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
        Pack<T> pack;
#pragma unroll
        for (int j = 0; j < kVector; ++j) pack.lane[j] = narrow<T>(from[p][j]);
        if (c < channels) *reinterpret_cast<Pack<T>*>(row + c) = pack;
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

template <typename In, typename Out, int kGroup, int kPacks, bool kExact>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(const In* __restrict__ x, const Sum<In>* __restrict__ weight,
                   const Sum<In>* __restrict__ bias, const Out* __restrict__ residual, RowNormShape shape,
                   Sum<In> eps, Out* __restrict__ out, Sum<In>* __restrict__ stats) {
  using S = Sum<In>;
  using Rows = Layout<kGroup, kPacks, kExact>;
  const int lane = threadIdx.x % kGroup, channels = static_cast<int>(shape.channels);
  const int64_t owned = static_cast<int64_t>(blockIdx.x) * (kThreads / kGroup) + threadIdx.x / kGroup;
  const int64_t row = min(owned, shape.n_rows - 1);  // whole warps take part in the sums
  S value[kPacks][kVector], w[kPacks][kVector], b[kPacks][kVector];
  Rows::load(x + row * channels, channels, lane, value);
  Rows::load(weight, channels, lane, w);
  Rows::load(bias, channels, lane, b);
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
  const RowStats<S> row_stats{mean, S(1) / sqrt(variance + eps)};
#pragma unroll
  for (int p = 0; p < kPacks; ++p)
#pragma unroll
    for (int j = 0; j < kVector; ++j) value[p][j] = row_norm_value(value[p][j], row_stats, w[p][j], b[p][j]);
  if (residual) {
    Rows::load(residual + row * channels, channels, lane, w);
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) value[p][j] += w[p][j];
  }
  if (owned >= shape.n_rows) return;
  Rows::store(out + row * channels, channels, lane, value);
  if (lane == 0) {
    stats[2 * row] = row_stats.mean;
    stats[2 * row + 1] = row_stats.scale;
  }
}

// A block takes kRowsPerGroup rows for each of its groups; group g the rows g, g + groups, ... of them. partial is
// [blocks, 2, channels]: sums of this block's rows, groups added in order.
template <typename In, typename Out, int kGroup, int kPacks, bool kExact>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(const Out* __restrict__ grad, const In* __restrict__ x, const Sum<In>* __restrict__ weight,
                    const Sum<In>* __restrict__ stats, RowNormShape shape, In* __restrict__ grad_x,
                    Sum<In>* __restrict__ partial) {
  using S = Sum<In>;
  using Rows = Layout<kGroup, kPacks, kExact>;
  constexpr int kGroups = kThreads / kGroup, kWidth = kGroup * kPacks * kVector;
  extern __shared__ __align__(16) unsigned char shared[];
  S* sums = reinterpret_cast<S*>(shared);  // [kGroups, kWidth]
  const int lane = threadIdx.x % kGroup, group = threadIdx.x / kGroup, channels = static_cast<int>(shape.channels);
  S w[kPacks][kVector], weight_sum[kPacks][kVector] = {}, bias_sum[kPacks][kVector] = {};
  Rows::load(weight, channels, lane, w);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kGroups * kRowsPerGroup;
  for (int i = 0; i < kRowsPerGroup; ++i) {
    const int64_t owned = first + static_cast<int64_t>(i) * kGroups + group;
    const bool mine = owned < shape.n_rows;
    const int64_t row = min(owned, shape.n_rows - 1);
    S g[kPacks][kVector], value[kPacks][kVector];
    Rows::load(grad + row * channels, channels, lane, g);
    Rows::load(x + row * channels, channels, lane, value);
    const RowStats<S> row_stats{stats[2 * row], stats[2 * row + 1]};
    S sum = 0, sum_x = 0;
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) {
        const S scaled = g[p][j] * w[p][j];  // 0 behind the last channel
        sum += scaled;
        sum_x += scaled * normalised(value[p][j], row_stats);
      }
    const S mean_grad = group_sum<kGroup>(sum) / static_cast<S>(channels);
    const S mean_grad_x = group_sum<kGroup>(sum_x) / static_cast<S>(channels);
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) {
        if (mine) {
          weight_sum[p][j] += g[p][j] * normalised(value[p][j], row_stats);
          bias_sum[p][j] += g[p][j];
        }
        value[p][j] = row_norm_value_vjp(g[p][j], value[p][j], row_stats, w[p][j], mean_grad, mean_grad_x);
      }
    if (mine) Rows::store(grad_x + row * channels, channels, lane, value);
  }
  for (int what = 0; what < 2; ++what) {
    const auto& mine = what == 0 ? weight_sum : bias_sum;
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) sums[group * kWidth + Rows::channel(p, lane) + j] = mine[p][j];
    __syncthreads();
    for (int c = threadIdx.x; c < channels; c += kThreads) {
      S total = 0;
      for (int other = 0; other < kGroups; ++other) total += sums[other * kWidth + c];
      partial[(static_cast<int64_t>(blockIdx.x) * 2 + what) * channels + c] = total;
    }
    __syncthreads();
  }
}

// out[c] = sum over blocks of partial[block, c]: kReduceRows running sums, added in order.
template <typename S>
__global__ void reduce_kernel(const S* __restrict__ partial, int64_t n_blocks, int64_t width, int64_t channels,
                              S* __restrict__ grad_weight, S* __restrict__ grad_bias) {
  __shared__ S sums[kReduceRows][kWarp + 1];
  const int64_t c = static_cast<int64_t>(blockIdx.x) * kWarp + threadIdx.x;
  S sum = 0;
  for (int64_t block = threadIdx.y; c < width && block < n_blocks; block += kReduceRows) sum += partial[block * width + c];
  sums[threadIdx.y][threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.y != 0 || c >= width) return;
  S total = 0;
  for (int y = 0; y < kReduceRows; ++y) total += sums[y][threadIdx.x];
  (c < channels ? grad_weight[c] : grad_bias[c - channels]) = total;
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

template <typename In, typename Out>
void row_norm(const In* x, const Sum<In>* weight, const Sum<In>* bias, const Out* residual,
              RowNormShape shape, double eps, Out* out, Sum<In>* stats, Stream stream) {
  const char* op = "row_norm";
  if (shape.n_rows == 0 || shape.channels == 0) return;
  by_shape(op, shape.channels, aligned(x, weight, bias, residual, out), [&]<int kGroup, int kPacks, bool kExact>() {
    launch(op, forward_kernel<In, Out, kGroup, kPacks, kExact>, blocks_for(op, shape.n_rows, kThreads / kGroup), kThreads,
           0, stream, x, weight, bias, residual, shape, eps, out, stats);
  });
}

template <typename In, typename Out>
void row_norm_vjp(const Out* grad, const In* x, const Sum<In>* weight, const Sum<In>* stats,
                  RowNormShape shape, In* grad_x, Sum<In>* grad_weight, Sum<In>* grad_bias,
                  const Workspace& workspace, Stream stream) {
  using S = Sum<In>;
  const char* op = "row_norm_backward";
  if (shape.channels == 0) return;
  if (shape.n_rows == 0) {
    fill_zero(op, grad_weight, shape.channels, stream);
    fill_zero(op, grad_bias, shape.channels, stream);
    return;
  }
  by_shape(op, shape.channels, aligned(grad, x, weight, grad_x), [&]<int kGroup, int kPacks, bool kExact>() {
    constexpr int kGroups = kThreads / kGroup;
    const unsigned n_blocks = blocks_for(op, shape.n_rows, kGroups * kRowsPerGroup);
    S* partial = workspace.take<S>(static_cast<int64_t>(n_blocks) * 2 * shape.channels);
    launch(op, backward_kernel<In, Out, kGroup, kPacks, kExact>, n_blocks, kThreads,
           kGroups * kGroup * kPacks * kVector * sizeof(S), stream, grad, x, weight, stats, shape, grad_x, partial);
    launch(op, reduce_kernel<S>, blocks_for(op, 2 * shape.channels, kWarp), dim3(kWarp, kReduceRows), 0, stream, partial,
           n_blocks, 2 * shape.channels, shape.channels, grad_weight, grad_bias);
  });
}

#define GSIM3D_INSTANTIATE(In, Out)                                                                                  \
  template void row_norm<In, Out>(const In*, const Sum<In>*, const Sum<In>*, const Out*, RowNormShape, \
                                  double, Out*, Sum<In>*, Stream);                                            \
  template void row_norm_vjp<In, Out>(const Out*, const In*, const Sum<In>*, const Sum<In>*,           \
                                      RowNormShape, In*, Sum<In>*, Sum<In>*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float, float)
GSIM3D_INSTANTIATE(float, Float16)
GSIM3D_INSTANTIATE(float, BFloat16)
GSIM3D_INSTANTIATE(Float16, float)
GSIM3D_INSTANTIATE(Float16, Float16)
GSIM3D_INSTANTIATE(BFloat16, float)
GSIM3D_INSTANTIATE(BFloat16, BFloat16)
GSIM3D_INSTANTIATE(double, double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
