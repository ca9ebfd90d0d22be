#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/row_norm/row_norm_rows.cuh"

namespace gsim3d::cuda {
namespace {

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
  const RowStats<S> row_stats = stats_of<Rows, kGroup>(value, channels, lane, eps);
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

// A block takes `rows` rows for each of its groups; group g the rows g, g + groups, ... of them. partial is
// [blocks, 2, channels]: sums of this block's rows, groups added in order.
template <typename In, typename Out, int kGroup, int kPacks, bool kExact>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(const Out* __restrict__ grad, const In* __restrict__ x, const Sum<In>* __restrict__ weight,
                    const Sum<In>* __restrict__ stats, RowNormShape shape, int rows, In* __restrict__ grad_x,
                    Sum<In>* __restrict__ partial) {
  using S = Sum<In>;
  using Rows = Layout<kGroup, kPacks, kExact>;
  constexpr int kGroups = kThreads / kGroup;
  extern __shared__ __align__(16) unsigned char shared[];
  S* sums = reinterpret_cast<S*>(shared);  // a row for each group
  const int lane = threadIdx.x % kGroup, group = threadIdx.x / kGroup, channels = static_cast<int>(shape.channels);
  S w[kPacks][kVector], weight_sum[kPacks][kVector] = {}, bias_sum[kPacks][kVector] = {};
  Rows::load(weight, channels, lane, w);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kGroups * rows;
  for (int i = 0; i < rows; ++i) {
    const int64_t owned = first + static_cast<int64_t>(i) * kGroups + group;
    const bool mine = owned < shape.n_rows;
    const int64_t row = min(owned, shape.n_rows - 1);
    S g[kPacks][kVector], value[kPacks][kVector];
    Rows::load(grad + row * channels, channels, lane, g);
    Rows::load(x + row * channels, channels, lane, value);
    const RowStats<S> row_stats{stats[2 * row], stats[2 * row + 1]};
    const auto [mean_grad, mean_grad_x] = grad_means_of<kGroup>(g, value, w, row_stats, channels);
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
  S* to = partial + static_cast<int64_t>(blockIdx.x) * 2 * channels;
  sum_groups<Rows, kGroup>(weight_sum, channels, sums, to);
  sum_groups<Rows, kGroup>(bias_sum, channels, sums, to + channels);
}

}  // namespace

template <typename In, typename Out>
void row_norm(const In* x, const Sum<In>* weight, const Sum<In>* bias, const Out* residual,
              RowNormShape shape, double eps, Out* out, Sum<In>* stats, Stream stream) {
  const char* op = "row_norm";
  if (shape.n_rows == 0 || shape.channels == 0) return;
  by_shape(op, shape.channels, aligned(x, weight, bias, residual, out), [&]<int kGroup, int kPacks, bool kExact>() {
    launch(op, forward_kernel<In, Out, kGroup, kPacks, kExact>, blocks_for(op, shape.n_rows, kThreads / kGroup),
           kThreads, 0, stream, x, weight, bias, residual, shape, eps, out, stats);
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
    const int rows = rows_of_group(shape.n_rows, kGroups);
    const unsigned n_blocks = blocks_for(op, shape.n_rows, kGroups * rows);
    S* partial = workspace.take<S>(static_cast<int64_t>(n_blocks) * 2 * shape.channels);
    launch(op, backward_kernel<In, Out, kGroup, kPacks, kExact>, n_blocks, kThreads,
           kGroups * kGroup * kPacks * kVector * sizeof(S), stream, grad, x, weight, stats, shape, rows, grad_x,
           partial);
    launch(op, reduce_kernel<S>, blocks_for(op, 2 * shape.channels, kWarp), dim3(kWarp, kReduceRows), 0, stream,
           partial, n_blocks, 2 * shape.channels, shape.channels, RowSums<S>{{grad_weight, grad_bias}});
  });
}

#define GSIM3D_INSTANTIATE(In, Out)                                                                                  \
  template void row_norm<In, Out>(const In*, const Sum<In>*, const Sum<In>*, const Out*, RowNormShape, \
                                  double, Out*, Sum<In>*, Stream);                                            \
  template void row_norm_vjp<In, Out>(const Out*, const In*, const Sum<In>*, const Sum<In>*,           \
                                      RowNormShape, In*, Sum<In>*, Sum<In>*, const Workspace&, Stream);
GSIM3D_ROW_NORM_TYPES(GSIM3D_INSTANTIATE)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
