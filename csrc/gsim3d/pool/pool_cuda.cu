#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/pack.cuh"
#include "gsim3d/pool/pool.h"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;

template <typename T, int N>
__device__ __forceinline__ Pack<T, N> load(const T* at) {
  return *reinterpret_cast<const Pack<T, N>*>(at);
}
template <typename T, int N>
__device__ __forceinline__ void store(T* at, const Pack<T, N>& value) {
  *reinterpret_cast<Pack<T, N>*>(at) = value;
}

// One thread owns N channels of one segment and walks its rows in the order of the list: neighbours in a warp read
// neighbouring channels, and every sum has one order.
struct Place {
  int64_t segment, channel;
};
template <int N>
__device__ __forceinline__ bool find_place(int64_t n_segments, int64_t channels, Place& place) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x, per_row = channels / N;
  if (i >= n_segments * per_row) return false;
  place = {i / per_row, i % per_row * N};
  return true;
}

template <typename T, int N>
__global__ void max_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out,
                           int64_t* __restrict__ argmax) {
  Place at;
  if (!find_place<N>(segments.n_segments, channels, at)) return;
  const Range range = range_of(segments.cu_rows, at.segment, segments.n_listed);
  Pack<T, N> best{};
  int64_t where[N];
#pragma unroll
  for (int j = 0; j < N; ++j) where[j] = -1;
  for (int64_t i = range.begin; i < range.end; ++i) {
    const int64_t row = segments.rows[i];
    if (!inside(row, segments.n_rows)) continue;
    const Pack<T, N> value = load<T, N>(x + row * channels + at.channel);
#pragma unroll
    for (int j = 0; j < N; ++j) {
      const T v = value.lane[j], b = best.lane[j];
      if (where[j] < 0 || v > b || (v != v && b == b)) {
        best.lane[j] = v;
        where[j] = row;
      }
    }
  }
  const int64_t to = at.segment * channels + at.channel;
  store(out + to, best);
#pragma unroll
  for (int j = 0; j < N; ++j) argmax[to + j] = where[j];
}

template <typename T>
__global__ void max_vjp_kernel(const T* __restrict__ grad, const int64_t* __restrict__ argmax, int64_t n_segments,
                               int64_t n_rows, int64_t channels, T* __restrict__ grad_x) {
  Place at;
  if (!find_place<1>(n_segments, channels, at)) return;
  const int64_t i = at.segment * channels + at.channel, row = argmax[i];
  if (inside(row, n_rows)) grad_x[row * channels + at.channel] = grad[i];
}

template <typename T, int N, bool kMean>
__global__ void sum_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out) {
  Place at;
  if (!find_place<N>(segments.n_segments, channels, at)) return;
  const Range range = range_of(segments.cu_rows, at.segment, segments.n_listed);
  Pack<T, N> sum{};
  for (int64_t i = range.begin; i < range.end; ++i) {
    const int64_t row = segments.rows[i];
    if (!inside(row, segments.n_rows)) continue;
    const Pack<T, N> value = load<T, N>(x + row * channels + at.channel);
#pragma unroll
    for (int j = 0; j < N; ++j) sum.lane[j] += value.lane[j];
  }
  if (kMean && range.end - range.begin > 1) {
#pragma unroll
    for (int j = 0; j < N; ++j) sum.lane[j] /= static_cast<T>(range.end - range.begin);
  }
  store(out + at.segment * channels + at.channel, sum);
}

// The same sums where channels come one at a time: a warp owns a segment, and looks up its rows once.
template <typename T, bool kMean>
__global__ void sum_by_warp_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out) {
  const int64_t segment = (static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
  if (segment >= segments.n_segments) return;
  const Range range = range_of(segments.cu_rows, segment, segments.n_listed);
  for (int64_t c = threadIdx.x % kWarp; c < channels; c += kWarp) {
    T sum = 0;
    for (int64_t i = range.begin; i < range.end; ++i) {
      const int64_t row = segments.rows[i];
      if (inside(row, segments.n_rows)) sum += x[row * channels + c];
    }
    if (kMean && range.end - range.begin > 1) sum /= static_cast<T>(range.end - range.begin);
    out[segment * channels + c] = sum;
  }
}

// Every row of a segment gets the segment's value, divided by its size for the mean.
template <typename T, int N, bool kMean>
__global__ void spread_kernel(const T* __restrict__ x, Segments segments, int64_t channels, T* __restrict__ out) {
  Place at;
  if (!find_place<N>(segments.n_segments, channels, at)) return;
  const Range range = range_of(segments.cu_rows, at.segment, segments.n_listed);
  Pack<T, N> value = load<T, N>(x + at.segment * channels + at.channel);
  if (kMean) {
#pragma unroll
    for (int j = 0; j < N; ++j) value.lane[j] /= static_cast<T>(range.end - range.begin);
  }
  for (int64_t i = range.begin; i < range.end; ++i) {
    const int64_t row = segments.rows[i];
    if (inside(row, segments.n_rows)) store(out + row * channels + at.channel, value);
  }
}

// Calls f.template operator()<N>(): N channels in 16 bytes where rows and pointers allow it, else one.
template <typename T, typename F>
void by_width(int64_t channels, const void* a, const void* b, const F& f) {
  constexpr int kWide = 16 / sizeof(T);
  const bool aligned = (reinterpret_cast<uintptr_t>(a) | reinterpret_cast<uintptr_t>(b)) % 16 == 0;
  if (aligned && channels % kWide == 0) f.template operator()<kWide>();
  else f.template operator()<1>();
}

template <typename T, bool kMean>
void add_up(const char* op, const T* x, const Segments& segments, int64_t channels, T* out, Stream stream) {
  by_width<T>(channels, x, out, [&]<int N>() {
    if (N == 1 && channels >= kWarp)
      return launch(op, sum_by_warp_kernel<T, kMean>, blocks_for(op, segments.n_segments, kThreads / kWarp), kThreads,
                    0, stream, x, segments, channels, out);
    launch(op, sum_kernel<T, N, kMean>, blocks_for(op, segments.n_segments * (channels / N), kThreads), kThreads, 0,
           stream, x, segments, channels, out);
  });
}

template <typename T, bool kMean>
void spread(const char* op, const T* x, const Segments& segments, int64_t channels, T* out, Stream stream) {
  fill_zero(op, out, segments.n_rows * channels, stream);  // rows that no segment has are known to the device only
  by_width<T>(channels, x, out, [&]<int N>() {
    launch(op, spread_kernel<T, N, kMean>, blocks_for(op, segments.n_segments * (channels / N), kThreads), kThreads, 0,
           stream, x, segments, channels, out);
  });
}

}  // namespace

template <typename T>
void pool_max(const T* x, const Segments& segments, int64_t channels, T* out, int64_t* argmax, Stream stream) {
  const char* op = "pool_max";
  by_width<T>(channels, x, out, [&]<int N>() {
    launch(op, max_kernel<T, N>, blocks_for(op, segments.n_segments * (channels / N), kThreads), kThreads, 0, stream, x,
           segments, channels, out, argmax);
  });
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
  add_up<T, true>("pool_mean", x, segments, channels, out, stream);
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
  add_up<T, false>("unpool_backward", grad, segments, channels, grad_x, stream);
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
