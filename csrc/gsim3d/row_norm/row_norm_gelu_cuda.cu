#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/row_norm/row_norm_rows.cuh"

namespace gsim3d::cuda {
namespace {

// The part of the rows that a block works on: kGroup * kVector channels of `rows` rows for each of its groups.
template <int kGroup>
struct Tile {
  int lane = threadIdx.x % kGroup, group = threadIdx.x / kGroup;
  int64_t column = static_cast<int64_t>(blockIdx.y) * kGroup * kVector;
  int64_t first;
  int n_rows, width;

  __device__ Tile(RowNormShape shape, int rows)
      : first(static_cast<int64_t>(blockIdx.x) * (kThreads / kGroup) * rows + group),
        n_rows(rows_before<kThreads / kGroup>(first, shape.n_rows, rows)),
        width(static_cast<int>(min(shape.channels - column, static_cast<int64_t>(kGroup * kVector)))) {}
  __device__ int64_t row(int i) const { return first + static_cast<int64_t>(i) * (kThreads / kGroup); }
};

template <typename In, typename Out, int kGroup, bool kExact>
__global__ void __launch_bounds__(kThreads)
    gelu_kernel(const In* __restrict__ x, const Sum<In>* __restrict__ mean, const Sum<In>* __restrict__ scale,
                const Sum<In>* __restrict__ bias, RowNormShape shape, int rows, Out* __restrict__ out) {
  using S = Sum<In>;
  using Rows = Layout<kGroup, 1, kExact>;
  const Tile<kGroup> tile(shape, rows);
  S m[1][kVector], w[1][kVector], b[1][kVector];
  Rows::load(mean + tile.column, tile.width, tile.lane, m);
  Rows::load(scale + tile.column, tile.width, tile.lane, w);
  Rows::load(bias + tile.column, tile.width, tile.lane, b);
#pragma unroll 4
  for (int i = 0; i < tile.n_rows; ++i) {
    const int64_t at = tile.row(i) * shape.channels + tile.column;
    S value[1][kVector];
    Rows::load(x + at, tile.width, tile.lane, value);
#pragma unroll
    for (int j = 0; j < kVector; ++j) value[0][j] = gelu((value[0][j] - m[0][j]) * w[0][j] + b[0][j]);
    Rows::store(out + at, tile.width, tile.lane, value);
  }
}

// partial [blocks, 2, channels]: sums over rows for scale and bias.
template <typename In, typename Out, int kGroup, bool kExact>
__global__ void __launch_bounds__(kThreads)
    gelu_backward_kernel(const Out* __restrict__ grad, const In* __restrict__ x, const Sum<In>* __restrict__ mean,
                         const Sum<In>* __restrict__ scale, const Sum<In>* __restrict__ bias, RowNormShape shape,
                         int rows, In* __restrict__ grad_x, Sum<In>* __restrict__ partial) {
  using S = Sum<In>;
  using Rows = Layout<kGroup, 1, kExact>;
  __shared__ S sums[kThreads * kVector];
  const Tile<kGroup> tile(shape, rows);
  S m[1][kVector], w[1][kVector], b[1][kVector], of_scale[1][kVector] = {}, of_bias[1][kVector] = {};
  Rows::load(mean + tile.column, tile.width, tile.lane, m);
  Rows::load(scale + tile.column, tile.width, tile.lane, w);
  Rows::load(bias + tile.column, tile.width, tile.lane, b);
#pragma unroll 4
  for (int i = 0; i < tile.n_rows; ++i) {
    const int64_t at = tile.row(i) * shape.channels + tile.column;
    S value[1][kVector], g[1][kVector];
    Rows::load(x + at, tile.width, tile.lane, value);
    Rows::load(grad + at, tile.width, tile.lane, g);
#pragma unroll
    for (int j = 0; j < kVector; ++j) {
      const S centered = value[0][j] - m[0][j], of = gelu_vjp(g[0][j], centered * w[0][j] + b[0][j]);
      value[0][j] = of * w[0][j];
      of_scale[0][j] += of * centered;
      of_bias[0][j] += of;
    }
    Rows::store(grad_x + at, tile.width, tile.lane, value);
  }
  S* to = partial + static_cast<int64_t>(blockIdx.x) * 2 * shape.channels + tile.column;
  sum_groups<Rows, kGroup>(of_scale, tile.width, sums, to);
  sum_groups<Rows, kGroup>(of_bias, tile.width, sums, to + shape.channels);
}

// Calls f.template operator()<kGroup, kExact>(blocks, rows) for the number of channels.
template <typename F>
void by_width(const char* op, RowNormShape shape, bool aligned, const F& f) {
  const auto run = [&]<int kGroup, bool kExact>() {
    constexpr int kGroups = kThreads / kGroup;
    const unsigned columns = blocks_for(op, shape.channels, kGroup * kVector);
    const int rows = rows_of_group(shape.n_rows, kGroups, columns, 2 * kManyBlocks);
    f.template operator()<kGroup, kExact>(dim3(blocks_for(op, shape.n_rows, kGroups * rows), columns), rows);
  };
  if (!aligned || shape.channels % kVector != 0) run.template operator()<kWarp, false>();
  else if (shape.channels <= 32) run.template operator()<8, true>();
  else if (shape.channels <= 64) run.template operator()<16, true>();
  else run.template operator()<kWarp, true>();
}

}  // namespace

template <typename In, typename Out>
void norm_gelu(const In* x, const Sum<In>* mean, const Sum<In>* scale, const Sum<In>* bias, RowNormShape shape,
               Out* out, Stream stream) {
  const char* op = "norm_gelu";
  by_width(op, shape, aligned(x, mean, scale, bias, out), [&]<int kGroup, bool kExact>(dim3 blocks, int rows) {
    launch(op, gelu_kernel<In, Out, kGroup, kExact>, blocks, kThreads, 0, stream, x, mean, scale, bias, shape, rows,
           out);
  });
}

template <typename In, typename Out>
void norm_gelu_vjp(const Out* grad, const In* x, const Sum<In>* mean, const Sum<In>* scale, const Sum<In>* bias,
                   RowNormShape shape, In* grad_x, Sum<In>* grad_scale, Sum<In>* grad_bias, const Workspace& workspace,
                   Stream stream) {
  using S = Sum<In>;
  const char* op = "norm_gelu_backward";
  if (shape.n_rows == 0) {
    fill_zero(op, grad_scale, shape.channels, stream);
    fill_zero(op, grad_bias, shape.channels, stream);
    return;
  }
  by_width(op, shape, aligned(grad, x, mean, scale, bias, grad_x), [&]<int kGroup, bool kExact>(dim3 blocks, int rows) {
    S* partial = workspace.take<S>(static_cast<int64_t>(blocks.x) * 2 * shape.channels);
    launch(op, gelu_backward_kernel<In, Out, kGroup, kExact>, blocks, kThreads, 0, stream, grad, x, mean, scale, bias,
           shape, rows, grad_x, partial);
    launch(op, reduce_kernel<S>, blocks_for(op, 2 * shape.channels, kWarp), dim3(kWarp, kReduceRows), 0, stream,
           partial, blocks.x, 2 * shape.channels, shape.channels, RowSums<S>{{grad_scale, grad_bias}});
  });
}

#define GSIM3D_INSTANTIATE(In, Out)                                                                                  \
  template void norm_gelu<In, Out>(const In*, const Sum<In>*, const Sum<In>*, const Sum<In>*, RowNormShape, Out*,    \
                                   Stream);                                                                          \
  template void norm_gelu_vjp<In, Out>(const Out*, const In*, const Sum<In>*, const Sum<In>*, const Sum<In>*,        \
                                       RowNormShape, In*, Sum<In>*, Sum<In>*, const Workspace&, Stream);
GSIM3D_ROW_NORM_TYPES(GSIM3D_INSTANTIATE)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
