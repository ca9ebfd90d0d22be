#include <algorithm>
#include <cmath>
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

}  // namespace

template <typename T>
void row_norm(const T* x, const T* weight, const T* bias, const T* residual, RowNormShape shape, double eps, T* out,
              T* stats, const Parallel& parallel) {
  const int64_t channels = shape.channels;
  parallel.range(shape.n_rows, rows_per_chunk(channels), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const T* from = x + row * channels;
      T* to = out + row * channels;
      const T mean = sum<T>(channels, [&](int64_t c) { return from[c]; }) / static_cast<T>(channels);
      const T square = sum<T>(channels, [&](int64_t c) { return (from[c] - mean) * (from[c] - mean); });
      const T variance = square / static_cast<T>(channels);
      const RowStats<T> row_stats{mean, T(1) / std::sqrt(variance + static_cast<T>(eps))};
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
  const int64_t channels = shape.channels, grain = rows_per_chunk(channels);
  const int64_t n_chunks = (shape.n_rows + grain - 1) / grain;
  std::vector<T> partial(static_cast<size_t>(std::max<int64_t>(1, n_chunks) * 2 * channels), T(0));
  parallel.range(shape.n_rows, grain, [&](int64_t begin, int64_t end) {
    T* weight_sum = partial.data() + begin / grain * 2 * channels;
    T* bias_sum = weight_sum + channels;
    for (int64_t row = begin; row < end; ++row) {
      const T *g = grad + row * channels, *from = x + row * channels;
      T* to = grad_x + row * channels;
      const RowStats<T> row_stats{stats[2 * row], stats[2 * row + 1]};
      const T n = static_cast<T>(channels);
      const T mean_grad = sum<T>(channels, [&](int64_t c) { return g[c] * weight[c]; }) / n;
      const T mean_grad_x =
          sum<T>(channels, [&](int64_t c) { return g[c] * weight[c] * normalised(from[c], row_stats); }) / n;
#pragma omp simd
      for (int64_t c = 0; c < channels; ++c) {
        to[c] = row_norm_value_vjp(g[c], from[c], row_stats, weight[c], mean_grad, mean_grad_x);
        weight_sum[c] += g[c] * normalised(from[c], row_stats);
        bias_sum[c] += g[c];
      }
    }
  });
  std::fill_n(grad_weight, channels, T(0));
  std::fill_n(grad_bias, channels, T(0));
  for (int64_t chunk = 0; chunk < n_chunks; ++chunk) {
    const T* sums = partial.data() + chunk * 2 * channels;
    for (int64_t c = 0; c < channels; ++c) {
      grad_weight[c] += sums[c];
      grad_bias[c] += sums[channels + c];
    }
  }
}

#define GSIM3D_INSTANTIATE(T)                                                                                     \
  template void row_norm<T>(const T*, const T*, const T*, const T*, RowNormShape, double, T*, T*, const Parallel&); \
  template void row_norm_vjp<T>(const T*, const T*, const T*, const T*, RowNormShape, T*, T*, T*, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
