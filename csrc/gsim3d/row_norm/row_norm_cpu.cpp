#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <iterator>
#include <vector>

#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/row_norm/row_norm_math.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kElementsPerChunk = 32768;  // enough to pay for handing a chunk to a thread
constexpr int kSums = 16;                     // running sums of a row: as many lanes as the widest registers hold

int64_t rows_per_chunk(int64_t channels) {
  return std::max<int64_t>(1, kElementsPerChunk / std::max<int64_t>(1, channels));
}

// Sum of f(c) over the channels: kSums running sums, added in order.
template <typename T, typename F>
T sum(int64_t channels, const F& f) {
  T sums[kSums] = {};
  int64_t c = 0;
  for (; c + kSums <= channels; c += kSums)
#pragma omp simd
    for (int lane = 0; lane < kSums; ++lane) sums[lane] += f(c + lane);
  for (int lane = 0; c < channels; ++c, ++lane) sums[lane] += f(c);
  T total = 0;
  for (T part : sums) total += part;
  return total;
}

template <typename T>
RowStats<T> stats_of(const T* row, int64_t channels, double eps) {
  const T mean = sum<T>(channels, [&](int64_t c) { return row[c]; }) / static_cast<T>(channels);
  const T square = sum<T>(channels, [&](int64_t c) { return (row[c] - mean) * (row[c] - mean); });
  return {mean, T(1) / std::sqrt(square / static_cast<T>(channels) + static_cast<T>(eps))};
}

// to = the gradient of x for one row, or += it; adds to the sums of weight and bias.
template <bool kAdd, typename T>
void row_vjp(const T* g, const T* x, const T* weight, RowStats<T> stats, int64_t channels, T* to, T* weight_sum,
             T* bias_sum) {
  const T n = static_cast<T>(channels);
  const T mean_grad = sum<T>(channels, [&](int64_t c) { return g[c] * weight[c]; }) / n;
  const T mean_grad_x = sum<T>(channels, [&](int64_t c) { return g[c] * weight[c] * normalised(x[c], stats); }) / n;
#pragma omp simd
  for (int64_t c = 0; c < channels; ++c) {
    const T grad = row_norm_value_vjp(g[c], x[c], stats, weight[c], mean_grad, mean_grad_x);
    weight_sum[c] += g[c] * normalised(x[c], stats);
    bias_sum[c] += g[c];
    to[c] = kAdd ? to[c] + grad : grad;
  }
}

// Calls f(begin, end, sums) for chunks of rows; `sums` [n_sums, channels] starts at 0 and belongs to the chunk. Adds
// the chunks in order to to[0], to[1], ..., where given.
template <typename T, typename F>
void sum_over_rows(RowNormShape shape, std::initializer_list<T*> to, const Parallel& parallel, const F& f) {
  const int64_t channels = shape.channels, grain = rows_per_chunk(channels), width = channels * std::ssize(to);
  const int64_t n_chunks = (shape.n_rows + grain - 1) / grain;
  std::vector<T> partial(static_cast<size_t>(n_chunks * width), T(0));
  parallel.range(shape.n_rows, grain,
                 [&](int64_t begin, int64_t end) { f(begin, end, partial.data() + begin / grain * width); });
  int64_t first = 0;
  for (T* total : to) {
    if (total) {
      std::fill_n(total, channels, T(0));
      for (int64_t chunk = 0; chunk < n_chunks; ++chunk)
        for (int64_t c = 0; c < channels; ++c) total[c] += partial[chunk * width + first + c];
    }
    first += channels;
  }
}

}  // namespace

template <typename T>
void row_norm(const T* x, const T* weight, const T* bias, const T* residual, RowNormShape shape, double eps, T* out,
              T* stats, const Parallel& parallel) {
  const int64_t channels = shape.channels;
  parallel.range(shape.n_rows, rows_per_chunk(channels), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const T* from = x + row * channels;
      T* to = out + row * channels;
      const RowStats<T> row_stats = stats_of(from, channels, eps);
#pragma omp simd
      for (int64_t c = 0; c < channels; ++c) to[c] = row_norm_value(from[c], row_stats, weight[c], bias[c]);
      if (residual) {
#pragma omp simd
        for (int64_t c = 0; c < channels; ++c) to[c] += residual[row * channels + c];
      }
      stats[2 * row] = row_stats.mean;
      stats[2 * row + 1] = row_stats.scale;
    }
  });
}

template <typename T>
void row_norm_vjp(const T* grad, const T* x, const T* weight, const T* stats, RowNormShape shape, T* grad_x,
                  T* grad_weight, T* grad_bias, const Parallel& parallel) {
  const int64_t channels = shape.channels;
  sum_over_rows<T>(shape, {grad_weight, grad_bias}, parallel, [&](int64_t begin, int64_t end, T* sums) {
    for (int64_t row = begin; row < end; ++row)
      row_vjp<false>(grad + row * channels, x + row * channels, weight, RowStats<T>{stats[2 * row], stats[2 * row + 1]},
                     channels, grad_x + row * channels, sums, sums + channels);
  });
}

template <typename T>
void residual_norm(const T* x, const T* branch, const T* keep, NormWeights<T> branch_norm, NormWeights<T> norm,
                   RowNormShape shape, double eps, T* sum, T* out, T* branch_stats, T* stats,
                   const Parallel& parallel) {
  const int64_t channels = shape.channels;
  parallel.range(shape.n_rows, rows_per_chunk(channels), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const T *from = branch + row * channels, *added = x + row * channels, share = keep ? keep[row] : T(1);
      T *total = sum + row * channels, *to = out + row * channels;
      if (branch_norm.weight) {
        const RowStats<T> of = stats_of(from, channels, eps);
        branch_stats[2 * row] = of.mean;
        branch_stats[2 * row + 1] = of.scale;
#pragma omp simd
        for (int64_t c = 0; c < channels; ++c)
          total[c] = row_norm_value(from[c], of, branch_norm.weight[c], branch_norm.bias[c]);
      } else {
        std::copy_n(from, channels, total);
      }
#pragma omp simd
      for (int64_t c = 0; c < channels; ++c) total[c] = share * total[c] + added[c];
      if (norm.weight) {
        const RowStats<T> of = stats_of(total, channels, eps);
        stats[2 * row] = of.mean;
        stats[2 * row + 1] = of.scale;
#pragma omp simd
        for (int64_t c = 0; c < channels; ++c) to[c] = row_norm_value(total[c], of, norm.weight[c], norm.bias[c]);
      } else {
        std::copy_n(total, channels, to);
      }
    }
  });
}

template <typename T>
void residual_norm_vjp(const T* grad_sum, const T* grad_out, const T* branch, const T* sum, const T* keep,
                       const T* branch_weight, const T* weight, const T* branch_stats, const T* stats,
                       RowNormShape shape, T* grad_x, T* grad_branch, T* branch_sum, NormGrads<T> branch_grads,
                       NormGrads<T> grads, const Parallel& parallel) {
  const int64_t channels = shape.channels;
  const auto totals = {branch_grads.weight, branch_grads.bias, grads.weight, grads.bias, branch_sum};
  sum_over_rows<T>(shape, totals, parallel, [&](int64_t begin, int64_t end, T* sums) {
    std::vector<T> scaled(static_cast<size_t>(channels));
    for (int64_t row = begin; row < end; ++row) {
      const int64_t at = row * channels;
      T *to = grad_x + at, *to_branch = grad_branch + at;
      if (grad_sum) std::copy_n(grad_sum + at, channels, to);
      else std::fill_n(to, channels, T(0));
      if (grad_out && weight) {
        const RowStats<T> of{stats[2 * row], stats[2 * row + 1]};
        row_vjp<true>(grad_out + at, sum + at, weight, of, channels, to, sums + 2 * channels, sums + 3 * channels);
      } else if (grad_out) {
#pragma omp simd
        for (int64_t c = 0; c < channels; ++c) to[c] += grad_out[at + c];
      }
      const T share = keep ? keep[row] : T(1);
#pragma omp simd
      for (int64_t c = 0; c < channels; ++c) scaled[c] = share * to[c];
      if (branch_weight) {
        const RowStats<T> of{branch_stats[2 * row], branch_stats[2 * row + 1]};
        row_vjp<false>(scaled.data(), branch + at, branch_weight, of, channels, to_branch, sums, sums + channels);
      } else {
        std::copy_n(scaled.data(), channels, to_branch);
      }
#pragma omp simd
      for (int64_t c = 0; c < channels; ++c) sums[4 * channels + c] += to_branch[c];
    }
  });
}

template <typename T>
void sum_rows(const T* x, RowNormShape shape, T* out, const Parallel& parallel) {
  sum_over_rows<T>(shape, {out}, parallel, [&](int64_t begin, int64_t end, T* sums) {
    for (int64_t row = begin; row < end; ++row)
#pragma omp simd
      for (int64_t c = 0; c < shape.channels; ++c) sums[c] += x[row * shape.channels + c];
  });
}

template <typename T>
void norm_gelu(const T* x, const T* mean, const T* scale, const T* bias, RowNormShape shape, T* out,
               const Parallel& parallel) {
  const int64_t channels = shape.channels;
  parallel.range(shape.n_rows, rows_per_chunk(channels), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row)
      for (int64_t c = 0; c < channels; ++c) {
        const int64_t at = row * channels + c;
        out[at] = gelu((x[at] - mean[c]) * scale[c] + bias[c]);
      }
  });
}

template <typename T>
void norm_gelu_vjp(const T* grad, const T* x, const T* mean, const T* scale, const T* bias, RowNormShape shape,
                   T* grad_x, T* grad_scale, T* grad_bias, const Parallel& parallel) {
  const int64_t channels = shape.channels;
  sum_over_rows<T>(shape, {grad_scale, grad_bias}, parallel, [&](int64_t begin, int64_t end, T* sums) {
    for (int64_t row = begin; row < end; ++row)
      for (int64_t c = 0; c < channels; ++c) {
        const int64_t at = row * channels + c;
        const T centered = x[at] - mean[c], g = gelu_vjp(grad[at], centered * scale[c] + bias[c]);
        grad_x[at] = g * scale[c];
        sums[c] += g * centered;
        sums[channels + c] += g;
      }
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                       \
  template void row_norm<T>(const T*, const T*, const T*, const T*, RowNormShape, double, T*, T*, const Parallel&); \
  template void row_norm_vjp<T>(const T*, const T*, const T*, const T*, RowNormShape, T*, T*, T*, const Parallel&); \
  template void residual_norm<T>(const T*, const T*, const T*, NormWeights<T>, NormWeights<T>, RowNormShape,        \
                                 double, T*, T*, T*, T*, const Parallel&);                                          \
  template void residual_norm_vjp<T>(const T*, const T*, const T*, const T*, const T*, const T*, const T*,          \
                                     const T*, const T*, RowNormShape, T*, T*, T*, NormGrads<T>, NormGrads<T>,      \
                                     const Parallel&);                                                              \
  template void sum_rows<T>(const T*, RowNormShape, T*, const Parallel&);                                           \
  template void norm_gelu<T>(const T*, const T*, const T*, const T*, RowNormShape, T*, const Parallel&);            \
  template void norm_gelu_vjp<T>(const T*, const T*, const T*, const T*, const T*, RowNormShape, T*, T*, T*,        \
                                 const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
