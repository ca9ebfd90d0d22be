#include <type_traits>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/pool/pool.h"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;

// One thread owns one channel of one segment and walks its rows in the order of the list: neighbours in a warp read
// neighbouring channels, and every sum has one order.
struct Place {
  int64_t segment, channel;
};
__device__ __forceinline__ bool find_place(int64_t n_segments, int64_t channels, Place& place) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n_segments * channels) return false;
  place = {i / channels, i % channels};
  return true;
}

template <typename T>
__global__ void max_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out,
                           int64_t* __restrict__ argmax) {
  Place at;
  if (!find_place(segments.n_segments, channels, at)) return;
  const Range range = range_of(segments.cu_rows, at.segment, segments.n_listed);
  T best = 0;
  int64_t where = -1;
  for (int64_t i = range.begin; i < range.end; ++i) {
    const int64_t row = segments.rows[i];
    if (!inside(row, segments.n_rows)) continue;
    const T value = x[row * channels + at.channel];
    if (where < 0 || value > best || (value != value && best == best)) {
      best = value;
      where = row;
    }
  }
  out[at.segment * channels + at.channel] = best;
  argmax[at.segment * channels + at.channel] = where;
}

template <typename T>
__global__ void max_vjp_kernel(const T* __restrict__ grad, const int64_t* __restrict__ argmax, int64_t n_segments,
                               int64_t n_rows, int64_t channels, T* __restrict__ grad_x) {
  Place at;
  if (!find_place(n_segments, channels, at)) return;
  const int64_t i = at.segment * channels + at.channel, row = argmax[i];
  if (inside(row, n_rows)) grad_x[row * channels + at.channel] = grad[i];
}

template <typename T, bool kMean>
__global__ void sum_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out) {
  Place at;
  if (!find_place(segments.n_segments, channels, at)) return;
  const Range range = range_of(segments.cu_rows, at.segment, segments.n_listed);
  T sum = 0;
  for (int64_t i = range.begin; i < range.end; ++i) {
    const int64_t row = segments.rows[i];
    if (inside(row, segments.n_rows)) sum += x[row * channels + at.channel];
  }
  if (kMean && range.end - range.begin > 1) sum /= static_cast<T>(range.end - range.begin);
  out[at.segment * channels + at.channel] = sum;
}

// Every row of a segment gets the segment's value, divided by its size for the mean.
template <typename T, bool kMean>
__global__ void spread_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out) {
  Place at;
  if (!find_place(segments.n_segments, channels, at)) return;
  const Range range = range_of(segments.cu_rows, at.segment, segments.n_listed);
  T value = x[at.segment * channels + at.channel];
  if (kMean) value /= static_cast<T>(range.end - range.begin);
  for (int64_t i = range.begin; i < range.end; ++i) {
    const int64_t row = segments.rows[i];
    if (inside(row, segments.n_rows)) out[row * channels + at.channel] = value;
  }
}

template <typename T, bool kMean>
void spread(const char* op, const T* x, const Segments& segments, int64_t channels, T* out, Stream stream) {
  if (segments.n_listed != segments.n_rows) fill_zero(op, out, segments.n_rows * channels, stream);
  launch(op, spread_kernel<T, kMean>, blocks_for(op, segments.n_segments * channels, kThreads), kThreads, 0, stream, x,
         segments, channels, out);
}

}  // namespace

template <typename T>
void pool_max(const T* x, const Segments& segments, int64_t channels, T* out, int64_t* argmax, Stream stream) {
  const char* op = "pool_max";
  launch(op, max_kernel<T>, blocks_for(op, segments.n_segments * channels, kThreads), kThreads, 0, stream, x, segments,
         channels, out, argmax);
}

template <typename T>
void pool_max_vjp(const T* grad, const int64_t* argmax, int64_t n_segments, int64_t n_rows, int64_t channels, T* grad_x,
                  Stream stream) {
  const char* op = "pool_max_backward";
  fill_zero(op, grad_x, n_rows * channels, stream);
  launch(op, max_vjp_kernel<T>, blocks_for(op, n_segments * channels, kThreads), kThreads, 0, stream, grad, argmax,
         n_segments, n_rows, channels, grad_x);
}

template <typename T>
void pool_mean(const T* x, const Segments& segments, int64_t channels, T* out, Stream stream) {
  const char* op = "pool_mean";
  launch(op, sum_kernel<T, true>, blocks_for(op, segments.n_segments * channels, kThreads), kThreads, 0, stream, x,
         segments, channels, out);
}

template <typename T>
void pool_mean_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, Stream stream) {
  spread<T, true>("pool_mean_backward", grad, segments, channels, grad_x, stream);
}

template <typename T>
void unpool(const T* x, const Segments& segments, int64_t channels, T* out, Stream stream) {
  spread<T, false>("unpool", x, segments, channels, out, stream);
}

template <typename T>
void unpool_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, Stream stream) {
  const char* op = "unpool_backward";
  launch(op, sum_kernel<T, false>, blocks_for(op, segments.n_segments * channels, kThreads), kThreads, 0, stream, grad,
         segments, channels, grad_x);
}

#define GSIM3D_INSTANTIATE(T)                                                                        \
  template void pool_max<T>(const T*, const Segments&, int64_t, T*, int64_t*, Stream);               \
  template void pool_max_vjp<T>(const T*, const int64_t*, int64_t, int64_t, int64_t, T*, Stream);    \
  template void pool_mean<T>(const T*, const Segments&, int64_t, T*, Stream);                        \
  template void pool_mean_vjp<T>(const T*, const Segments&, int64_t, T*, Stream);                    \
  template void unpool<T>(const T*, const Segments&, int64_t, T*, Stream);                           \
  template void unpool_vjp<T>(const T*, const Segments&, int64_t, T*, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
