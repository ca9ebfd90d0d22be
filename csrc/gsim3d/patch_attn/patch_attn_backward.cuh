// What the kernels of the backward pass on the tensor cores share: numbers of the queries, and the warps that own keys.
//
//   p = exp(scale s - lse),  ds = p (<grad, v> - delta),  delta = <grad, out>
//   grad_q = scale sum_k ds k,  grad_k = scale sum_q ds q,  grad_v = sum_q p grad
#pragma once

#include <cfloat>

#include "gsim3d/patch_attn/patch_attn_mma_tile.cuh"
#include "gsim3d/patch_attn/patch_attn_softmax.cuh"
#include "gsim3d/patch_attn/patch_attn_tensor.cuh"

namespace gsim3d::cuda {

// What the weights and slopes of a query need. A slot whose row is out of range, and a query that saw no key, has
// log_sum = inf: its weights are 0.
struct alignas(16) QueryNumbers {
  float largest, log_sum, delta, shift;  // shift: of fast_weight

  __device__ __forceinline__ static QueryNumbers none() { return {0.0f, INFINITY, 0.0f, -INFINITY}; }
  __device__ __forceinline__ bool is_fast(float slope) const { return fabsf(largest * slope) <= kLargestShift; }
};

template <typename T>
struct Backward {
  HeadRows<T> grad, q, k, v, out;
  const float* stats;  // [n_q, H, 2]
  PatchTable table;
  AttentionSize size;
  Division division;
  float slope, sign, scale;
  QueryNumbers* numbers;  // [H, n_q_listed]
  Gradients<T> gradients;
};

template <typename T, int D>
__device__ __forceinline__ QueryNumbers numbers_of(const Backward<T>& args, int64_t row, int64_t head) {
  if (!inside(row, args.table.n_q)) return QueryNumbers::none();
  const T* grad = args.grad.at(row, head);
  const T* out = args.out.at(row, head);
  float delta = 0;
#pragma unroll
  for (int i = 0; i < D / 8; ++i) {
    const uint4 a = reinterpret_cast<const uint4*>(grad)[i], b = reinterpret_cast<const uint4*>(out)[i];
    const uint32_t x[4] = {a.x, a.y, a.z, a.w}, y[4] = {b.x, b.y, b.z, b.w};
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const float2 p = unpack<T>(x[j]), q = unpack<T>(y[j]);
      delta = fmaf(p.x, q.x, fmaf(p.y, q.y, delta));
    }
  }
  const float2 pair = *reinterpret_cast<const float2*>(args.stats + 2 * (row * args.size.heads + head));
  if (pair.y == 0) return QueryNumbers::none();
  const float log_sum = log2f(pair.y);
  return {pair.x, log_sum, delta, -fmaf(pair.x, args.slope, log_sum)};
}

// Head dim 16 in one kernel; takes as long for few patches and heads as for one on each multiprocessor. Needs shared
// memory that not every GPU has.
bool fits_fused_backward(Stream stream);
template <typename T>
void fused_backward(Backward<T> args, const Workspace& workspace, Stream stream);

// Numbers of the queries of a tile, in shared memory.
struct TileNumbers {
  const float* shift;         // [rows]
  const float4* minus_delta;  // [rows / 2], of a pair of queries twice: a C tile of the tensor cores
};

// A warp that owns 16 M keys.
template <typename T, int D, int M>
class KeyWarp {
 public:
  __device__ __forceinline__ KeyWarp(const Backward<T>& args, uint32_t queries, uint32_t grads,
                                     const TileNumbers& numbers)
      : slope_(args.slope), queries_(queries), grads_(grads), numbers_(numbers) {}

  __device__ __forceinline__ void load(const Backward<T>& args, int64_t first, int64_t end, int64_t head) {
    clear(grad_k_);
    clear(grad_v_);
#pragma unroll
    for (int m = 0; m < M; ++m) {
      const RowPair<T> k = find_rows(args.k, args.table.kv_rows, first + 16 * m, end, args.table.n_k, head);
      const RowPair<T> v = find_rows(args.v, args.table.kv_rows, first + 16 * m, end, args.table.n_k, head);
#pragma unroll
      for (int s = 0; s < D / 16; ++s) {
        load_fragment(k, s, k_[m][s]);
        load_fragment(v, s, v_[m][s]);
        if (args.sign < 0) negate(k_[m][s]);
      }
    }
  }

  // Takes 16 queries; `ds` becomes their slopes, keys x queries. `careful`: numbers of the queries of the tile in
  // global memory, n of them; nullptr for the fast way.
  template <bool kFast>
  __device__ __forceinline__ void step(int step, const QueryNumbers* careful, int n, uint32_t (&ds)[M][4]) {
    const int t = threadIdx.x % 4;
    float s[M][2][4], slopes[M][2][4];
    clear(s);
    multiply_by_rows<T, D, M>(k_, queries_, step, s);
#pragma unroll
    for (int j = 0; j < 2; ++j) {
      const float4 start = numbers_.minus_delta[step * 8 + j * 4 + t];
#pragma unroll
      for (int m = 0; m < M; ++m) {
        slopes[m][j][0] = start.x;
        slopes[m][j][1] = start.y;
        slopes[m][j][2] = start.z;
        slopes[m][j][3] = start.w;
      }
    }
    multiply_by_rows<T, D, M>(v_, grads_, step, slopes);
    uint32_t p[M][4];
    float shift[4];
    if constexpr (kFast) {
#pragma unroll
      for (int j = 0; j < 2; ++j) {
        const float2 pair = *reinterpret_cast<const float2*>(numbers_.shift + step * kStep + 8 * j + 2 * t);
        shift[2 * j] = pair.x;
        shift[2 * j + 1] = pair.y;
      }
    }
#pragma unroll
    for (int j = 0; j < 2; ++j)
#pragma unroll
      for (int i = 0; i < 2; ++i) {
        QueryNumbers query;
        if constexpr (!kFast) {
          const int at = step * kStep + 8 * j + 2 * t + i;
          query = at < n ? careful[at] : QueryNumbers::none();
        }
#pragma unroll
        for (int m = 0; m < M; ++m)
#pragma unroll
          for (int h = 0; h < 2; ++h) {
            float& x = s[m][j][2 * h + i];
            if constexpr (kFast) x = fast_weight(x, slope_, shift[2 * j + i]);
            else x = careful_weight(x, query.largest, slope_, -query.log_sum);
            slopes[m][j][2 * h + i] *= x;
          }
      }
#pragma unroll
    for (int m = 0; m < M; ++m) {
      pack_tile<T>(s[m], p[m]);
      pack_tile<T, true>(slopes[m], ds[m]);
    }
    multiply_by_columns<T, D, M>(p, grads_, step, grad_v_);
    multiply_by_columns<T, D, M>(ds, queries_, step, grad_k_);
  }

  __device__ __forceinline__ void store(const Backward<T>& args, int64_t first, int64_t end, int64_t head) const {
    const int t = threadIdx.x % 4;
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const int64_t slot = first + 16 * m + threadIdx.x % kWarp / 4 + 8 * h;
        const int64_t row = slot < end ? args.table.kv_rows[slot] : -1;
        if (!inside(row, args.table.n_k)) continue;
        const bool at_once = args.gradients.at_once(row);
        const int64_t place = row * args.gradients.row_stride + head * D + 2 * t;
        float* to = args.gradients.slot(slot, head, args.size) + 2 * t;
#pragma unroll
        for (int c = 0; c < D / 8; ++c) {
          const float2 k = {grad_k_[m][c][2 * h] * args.scale, grad_k_[m][c][2 * h + 1] * args.scale};
          const float2 v = {grad_v_[m][c][2 * h], grad_v_[m][c][2 * h + 1]};
          if (at_once) {
            *reinterpret_cast<uint32_t*>(args.gradients.k + place + 8 * c) = pack<T>(k.x, k.y);
            *reinterpret_cast<uint32_t*>(args.gradients.v + place + 8 * c) = pack<T>(v.x, v.y);
          } else {
            *reinterpret_cast<float2*>(to + 8 * c) = k;
            *reinterpret_cast<float2*>(to + D + 8 * c) = v;
          }
        }
      }
  }

 private:
  float slope_;
  uint32_t queries_, grads_;
  TileNumbers numbers_;
  uint32_t k_[M][D / 16][4], v_[M][D / 16][4];
  float grad_k_[M][D / 8][4], grad_v_[M][D / 8][4];
};

}  // namespace gsim3d::cuda
