#include <utility>

#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/row_norm/row_norm_rows.cuh"

namespace gsim3d::cuda {
namespace {

template <typename T, int kGroup, int kPacks, bool kExact>
__global__ void __launch_bounds__(kThreads)
    residual_kernel(const Sum<T>* __restrict__ x, const T* __restrict__ branch, const Sum<T>* __restrict__ keep,
                    NormWeights<Sum<T>> branch_norm, NormWeights<Sum<T>> norm, RowNormShape shape, Sum<T> eps,
                    Sum<T>* __restrict__ sum, T* __restrict__ out, Sum<T>* __restrict__ branch_stats,
                    Sum<T>* __restrict__ stats) {
  using S = Sum<T>;
  using Rows = Layout<kGroup, kPacks, kExact>;
  const int lane = threadIdx.x % kGroup, channels = static_cast<int>(shape.channels);
  const int64_t owned = static_cast<int64_t>(blockIdx.x) * (kThreads / kGroup) + threadIdx.x / kGroup;
  const int64_t row = min(owned, shape.n_rows - 1);  // whole warps take part in the sums
  const bool mine = owned < shape.n_rows;
  S value[kPacks][kVector], added[kPacks][kVector], w[kPacks][kVector], b[kPacks][kVector];
  Rows::load(branch + row * channels, channels, lane, value);
  Rows::load(x + row * channels, channels, lane, added);
  const S share = keep ? keep[row] : S(1);
  if (branch_norm.weight) {
    Rows::load(branch_norm.weight, channels, lane, w);
    Rows::load(branch_norm.bias, channels, lane, b);
    const RowStats<S> of = stats_of<Rows, kGroup>(value, channels, lane, eps);
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) value[p][j] = row_norm_value(value[p][j], of, w[p][j], b[p][j]);
    if (mine && lane == 0) {
      branch_stats[2 * row] = of.mean;
      branch_stats[2 * row + 1] = of.scale;
    }
  }
#pragma unroll
  for (int p = 0; p < kPacks; ++p)
#pragma unroll
    for (int j = 0; j < kVector; ++j) value[p][j] = share * value[p][j] + added[p][j];
  if (mine) Rows::store(sum + row * channels, channels, lane, value);
  if (norm.weight) {
    Rows::load(norm.weight, channels, lane, w);
    Rows::load(norm.bias, channels, lane, b);
    const RowStats<S> of = stats_of<Rows, kGroup>(value, channels, lane, eps);
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) value[p][j] = row_norm_value(value[p][j], of, w[p][j], b[p][j]);
    if (mine && lane == 0) {
      stats[2 * row] = of.mean;
      stats[2 * row + 1] = of.scale;
    }
  }
  if (mine) Rows::store(out + row * channels, channels, lane, value);
}

// What the backward kernel reads and writes; see residual_norm_vjp.
template <typename T>
struct Backward {
  const Sum<T>* grad_sum;
  const T *grad_out, *branch;
  const Sum<T> *sum, *keep, *branch_weight, *weight, *branch_stats, *stats;
  RowNormShape shape;
  Sum<T>* grad_x;
  T* grad_branch;
  Sum<T>* partial;  // [blocks, sums, channels]
  int rows;         // of a group
};

// Rows as in row_norm's backward kernel. Sums over rows: of the branch's gradient; with kBranchNorm of its norm's
// weight and bias; with kNorm of the other norm's.
template <typename T, int kGroup, int kPacks, bool kExact, bool kBranchNorm, bool kNorm>
__global__ void __launch_bounds__(kThreads) residual_backward_kernel(const Backward<T> at) {
  using S = Sum<T>;
  using Rows = Layout<kGroup, kPacks, kExact>;
  constexpr int kGroups = kThreads / kGroup, kSums = 1 + 2 * kBranchNorm + 2 * kNorm;
  constexpr int kNormSums = 1 + 2 * kBranchNorm;  // where those of the other norm begin
  extern __shared__ __align__(16) unsigned char shared[];
  const int lane = threadIdx.x % kGroup, group = threadIdx.x / kGroup, channels = static_cast<int>(at.shape.channels);
  S total[kSums][kPacks][kVector] = {};
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kGroups * at.rows;
  for (int i = 0; i < at.rows; ++i) {
    const int64_t owned = first + static_cast<int64_t>(i) * kGroups + group;
    if (owned - group >= at.shape.n_rows) break;  // the same for all lanes of the block
    const bool mine = owned < at.shape.n_rows;
    const int64_t row = min(owned, at.shape.n_rows - 1), start = row * channels;
    const S counted = mine ? S(1) : S(0);
    S g[kPacks][kVector] = {}, grad[kPacks][kVector], value[kPacks][kVector], w[kPacks][kVector];
    S branch[kBranchNorm ? kPacks : 1][kVector];  // on its way while the sums of the other norm are formed
    if constexpr (kBranchNorm) Rows::load(at.branch + start, channels, lane, branch);
    if (at.grad_sum) Rows::load(at.grad_sum + start, channels, lane, g);
    if (at.grad_out) {
      Rows::load(at.grad_out + start, channels, lane, grad);
      if constexpr (kNorm) {
        Rows::load(at.sum + start, channels, lane, value);
        Rows::load(at.weight, channels, lane, w);
        const RowStats<S> of{at.stats[2 * row], at.stats[2 * row + 1]};
        const auto [mean_grad, mean_grad_x] = grad_means_of<kGroup>(grad, value, w, of, channels);
#pragma unroll
        for (int p = 0; p < kPacks; ++p)
#pragma unroll
          for (int j = 0; j < kVector; ++j) {
            total[kNormSums][p][j] += counted * grad[p][j] * normalised(value[p][j], of);
            total[kNormSums + 1][p][j] += counted * grad[p][j];
            g[p][j] += row_norm_value_vjp(grad[p][j], value[p][j], of, w[p][j], mean_grad, mean_grad_x);
          }
      } else {
#pragma unroll
        for (int p = 0; p < kPacks; ++p)
#pragma unroll
          for (int j = 0; j < kVector; ++j) g[p][j] += grad[p][j];
      }
    }
    if (mine) Rows::store(at.grad_x + start, channels, lane, g);
    const S share = at.keep ? at.keep[row] : S(1);
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) g[p][j] = Rows::channel(p, lane) + j < channels ? share * g[p][j] : S(0);
    if constexpr (kBranchNorm) {
      Rows::load(at.branch_weight, channels, lane, w);
      const RowStats<S> of{at.branch_stats[2 * row], at.branch_stats[2 * row + 1]};
      const auto [mean_grad, mean_grad_x] = grad_means_of<kGroup>(g, branch, w, of, channels);
#pragma unroll
      for (int p = 0; p < kPacks; ++p)
#pragma unroll
        for (int j = 0; j < kVector; ++j) {
          total[1][p][j] += counted * g[p][j] * normalised(branch[p][j], of);
          total[2][p][j] += counted * g[p][j];
          g[p][j] = row_norm_value_vjp(g[p][j], branch[p][j], of, w[p][j], mean_grad, mean_grad_x);
        }
    }
#pragma unroll
    for (int p = 0; p < kPacks; ++p)
#pragma unroll
      for (int j = 0; j < kVector; ++j) total[0][p][j] += counted * g[p][j];
    if (mine) Rows::store(at.grad_branch + start, channels, lane, g);
  }
  S* to = at.partial + static_cast<int64_t>(blockIdx.x) * kSums * channels;
#pragma unroll
  for (int s = 0; s < kSums; ++s)
    sum_groups<Rows, kGroup>(total[s], channels, reinterpret_cast<S*>(shared), to + static_cast<int64_t>(s) * channels);
}

// Sums over rows. A block adds up kGroup * kVector channels of `rows` rows for each of its groups.
template <typename T, int kGroup, bool kExact>
__global__ void __launch_bounds__(kThreads)
    sum_kernel(const T* __restrict__ x, RowNormShape shape, int rows, Sum<T>* __restrict__ partial) {
  using S = Sum<T>;
  using Rows = Layout<kGroup, 1, kExact>;
  constexpr int kGroups = kThreads / kGroup;
  __shared__ S sums[kThreads * kVector];
  const int lane = threadIdx.x % kGroup, group = threadIdx.x / kGroup;
  const int64_t column = static_cast<int64_t>(blockIdx.y) * kGroup * kVector;
  const int width = static_cast<int>(min(shape.channels - column, static_cast<int64_t>(kGroup * kVector)));
  S total[1][kVector] = {};
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kGroups * rows + group;
  const int mine = rows_before<kGroups>(first, shape.n_rows, rows);
#pragma unroll 4
  for (int i = 0; i < mine; ++i) {
    const int64_t row = first + static_cast<int64_t>(i) * kGroups;
    S value[1][kVector];
    Rows::load(x + row * shape.channels + column, width, lane, value);
#pragma unroll
    for (int j = 0; j < kVector; ++j) total[0][j] += value[0][j];
  }
  sum_groups<Rows, kGroup>(total, width, sums, partial + static_cast<int64_t>(blockIdx.x) * shape.channels + column);
}

}  // namespace

template <typename T>
void residual_norm(const Sum<T>* x, const T* branch, const Sum<T>* keep, NormWeights<Sum<T>> branch_norm,
                   NormWeights<Sum<T>> norm, RowNormShape shape, double eps, Sum<T>* sum, T* out, Sum<T>* branch_stats,
                   Sum<T>* stats, Stream stream) {
  const char* op = "residual_norm";
  if (shape.n_rows == 0 || shape.channels == 0) return;
  const bool exact = aligned(x, branch, branch_norm.weight, branch_norm.bias, norm.weight, norm.bias, sum, out);
  by_shape(op, shape.channels, exact, [&]<int kGroup, int kPacks, bool kExact>() {
    launch(op, residual_kernel<T, kGroup, kPacks, kExact>, blocks_for(op, shape.n_rows, kThreads / kGroup), kThreads, 0,
           stream, x, branch, keep, branch_norm, norm, shape, static_cast<Sum<T>>(eps), sum, out, branch_stats, stats);
  });
}

template <typename T>
void residual_norm_vjp(const Sum<T>* grad_sum, const T* grad_out, const T* branch, const Sum<T>* sum,
                       const Sum<T>* keep, const Sum<T>* branch_weight, const Sum<T>* weight,
                       const Sum<T>* branch_stats, const Sum<T>* stats, RowNormShape shape, Sum<T>* grad_x,
                       T* grad_branch, Sum<T>* branch_sum, NormGrads<Sum<T>> branch_grads, NormGrads<Sum<T>> grads,
                       const Workspace& workspace, Stream stream) {
  using S = Sum<T>;
  const char* op = "residual_norm_backward";
  RowSums<S> sums{{branch_sum}};
  int n_sums = 1;
  for (const auto& [of, norm_weight] : {std::pair(branch_grads, branch_weight), std::pair(grads, weight)})
    if (norm_weight) {
      sums.to[n_sums++] = of.weight;
      sums.to[n_sums++] = of.bias;
    }
  if (shape.channels == 0) return;
  if (shape.n_rows == 0) {
    for (int i = 0; i < n_sums; ++i) fill_zero(op, sums.to[i], shape.channels, stream);
    return;
  }
  const bool exact = aligned(grad_sum, grad_out, branch, sum, branch_weight, weight, grad_x, grad_branch);
  by_shape(op, shape.channels, exact, [&]<int kGroup, int kPacks, bool kExact>() {
    constexpr int kGroups = kThreads / kGroup;
    const int rows = rows_of_group(shape.n_rows, kGroups);
    const unsigned n_blocks = blocks_for(op, shape.n_rows, kGroups * rows);
    S* partial = workspace.take<S>(static_cast<int64_t>(n_blocks) * n_sums * shape.channels);
    const Backward<T> at{grad_sum,     grad_out, branch, sum,    keep,        branch_weight, weight,
                         branch_stats, stats,    shape,  grad_x, grad_branch, partial, rows};
    const auto run = [&]<bool kBranchNorm, bool kNorm>() {
      launch(op, residual_backward_kernel<T, kGroup, kPacks, kExact, kBranchNorm, kNorm>, n_blocks, kThreads,
             kGroups * kGroup * kPacks * kVector * sizeof(S), stream, at);
    };
    if (branch_weight && weight) run.template operator()<true, true>();
    else if (branch_weight) run.template operator()<true, false>();
    else if (weight) run.template operator()<false, true>();
    else run.template operator()<false, false>();
    launch(op, reduce_kernel<S>, blocks_for(op, n_sums * shape.channels, kWarp), dim3(kWarp, kReduceRows), 0, stream,
           partial, n_blocks, n_sums * shape.channels, shape.channels, sums);
  });
}

template <typename T>
void sum_rows(const T* x, RowNormShape shape, Sum<T>* out, const Workspace& workspace, Stream stream) {
  using S = Sum<T>;
  const char* op = "linear_grad_bias";
  if (shape.n_rows == 0) return fill_zero(op, out, shape.channels, stream);
  const bool exact = aligned(x) && shape.channels % kVector == 0;
  const auto run = [&]<int kGroup, bool kExact>() {
    const unsigned columns = blocks_for(op, shape.channels, kGroup * kVector);
    const int rows = rows_of_group(shape.n_rows, kThreads / kGroup, columns);
    const unsigned n_blocks = blocks_for(op, shape.n_rows, kThreads / kGroup * rows);
    S* partial = workspace.take<S>(static_cast<int64_t>(n_blocks) * shape.channels);
    launch(op, sum_kernel<T, kGroup, kExact>, dim3(n_blocks, columns), kThreads, 0, stream, x, shape, rows, partial);
    launch(op, reduce_kernel<S>, blocks_for(op, shape.channels, kWarp), dim3(kWarp, kReduceRows), 0, stream, partial,
           n_blocks, shape.channels, shape.channels, RowSums<S>{{out}});
  };
  if (!exact) run.template operator()<kWarp, false>();
  else if (shape.channels <= 32) run.template operator()<8, true>();
  else if (shape.channels <= 64) run.template operator()<16, true>();
  else run.template operator()<kWarp, true>();
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template void residual_norm<T>(const Sum<T>*, const T*, const Sum<T>*, NormWeights<Sum<T>>, NormWeights<Sum<T>>,    \
                                 RowNormShape, double, Sum<T>*, T*, Sum<T>*, Sum<T>*, Stream);                        \
  template void residual_norm_vjp<T>(const Sum<T>*, const T*, const T*, const Sum<T>*, const Sum<T>*, const Sum<T>*,  \
                                     const Sum<T>*, const Sum<T>*, const Sum<T>*, RowNormShape, Sum<T>*, T*, Sum<T>*, \
                                     NormGrads<Sum<T>>, NormGrads<Sum<T>>, const Workspace&, Stream);                 \
  template void sum_rows<T>(const T*, RowNormShape, Sum<T>*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(Float16)
GSIM3D_INSTANTIATE(BFloat16)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
