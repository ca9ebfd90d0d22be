// A block copies the rows of its threads into shared memory, each thread works on one row there, and the block copies
// the results: neighbouring threads read and write neighbouring words of memory.
#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/half.cuh"
#include "gsim3d/decode/decode.h"
#include "gsim3d/decode/decode_math.h"

namespace gsim3d::cuda {
namespace {

constexpr int kRows = 64;  // of a block, one a thread

// The distance of rows in shared memory: odd, so that threads of a warp are in different banks.
__host__ __device__ constexpr int stride_of(int columns) { return columns | 1; }

template <typename S>
size_t shared_bytes(DecodeShape shape) {
  const int out = 3 * shape.kept_terms() + 7;
  return sizeof(S) * (kReadings + kRows * (stride_of(shape.columns()) + stride_of(out)));
}

template <typename T, typename S>
__device__ void load_tile(const T* from, int n_rows, int columns, S* tile, int stride) {
  for (int i = threadIdx.x; i < n_rows * columns; i += kRows)
    tile[i / columns * stride + i % columns] = static_cast<S>(from[i]);
}
template <typename T, typename S>
__device__ void store_tile(const S* tile, int stride, int n_rows, int columns, T* to) {
  for (int i = threadIdx.x; i < n_rows * columns; i += kRows)
    to[i] = static_cast<T>(tile[i / columns * stride + i % columns]);
}

// The rows of a block in shared memory: those of the network, and behind them the decoded ones (quat, scale, sh).
template <typename S>
struct Tiles {
  S *readings, *raw, *out;
  int raw_stride, out_stride, n_rows;
  int64_t first;

  __device__ Tiles(unsigned char* shared, const S* given, DecodeShape shape)
      : readings(reinterpret_cast<S*>(shared)), raw(readings + kReadings), raw_stride(stride_of(shape.columns())),
        out_stride(stride_of(3 * shape.kept_terms() + 7)), first(static_cast<int64_t>(blockIdx.x) * kRows) {
    out = raw + kRows * raw_stride;
    n_rows = static_cast<int>(min(static_cast<int64_t>(kRows), shape.n_rows - first));
    for (int i = threadIdx.x; i < kReadings; i += kRows) readings[i] = given[i];
  }
  __device__ S* own_raw() const { return raw + threadIdx.x * raw_stride; }
  __device__ S* own_out() const { return out + threadIdx.x * out_stride; }
};

template <int kDegree, typename T, typename S>
__global__ void __launch_bounds__(kRows)
    decode_kernel(const T* __restrict__ raw, const S* __restrict__ readings, DecodeShape shape, Decoded<S> out) {
  extern __shared__ __align__(16) unsigned char shared[];
  constexpr int kColors = 3 * (kDegree + 1) * (kDegree + 1);
  const Tiles<S> tiles(shared, readings, shape);
  load_tile(raw + tiles.first * shape.columns(), tiles.n_rows, shape.columns(), tiles.raw, tiles.raw_stride);
  __syncthreads();
  if (threadIdx.x < tiles.n_rows) {
    S* own = tiles.own_out();
    decode_row<kDegree>(tiles.own_raw(), shape.terms, tiles.readings, S(shape.scale_min), S(shape.scale_max), own,
                        own + 4, own + 7);
  }
  __syncthreads();
  store_tile(tiles.out, tiles.out_stride, tiles.n_rows, 4, out.quats + tiles.first * 4);
  store_tile(tiles.out + 4, tiles.out_stride, tiles.n_rows, 3, out.scales + tiles.first * 3);
  store_tile(tiles.out + 7, tiles.out_stride, tiles.n_rows, kColors, out.sh + tiles.first * kColors);
}

template <int kDegree, typename T, typename S>
__global__ void __launch_bounds__(kRows)
    decode_vjp_kernel(const T* __restrict__ raw, const S* __restrict__ readings, DecodeShape shape,
                      DecodedGradients<S> grads, T* __restrict__ grad_raw) {
  extern __shared__ __align__(16) unsigned char shared[];
  constexpr int kColors = 3 * (kDegree + 1) * (kDegree + 1);
  const Tiles<S> tiles(shared, readings, shape);
  const int stride = tiles.out_stride;
  load_tile(raw + tiles.first * shape.columns(), tiles.n_rows, shape.columns(), tiles.raw, tiles.raw_stride);
  load_tile(grads.quats + tiles.first * 4, tiles.n_rows, 4, tiles.out, stride);
  load_tile(grads.scales + tiles.first * 3, tiles.n_rows, 3, tiles.out + 4, stride);
  load_tile(grads.sh + tiles.first * kColors, tiles.n_rows, kColors, tiles.out + 7, stride);
  __syncthreads();
  if (threadIdx.x < tiles.n_rows) {
    const S* own = tiles.own_out();
    decode_row_vjp<kDegree>(tiles.own_raw(), shape.terms, tiles.readings, S(shape.scale_min), S(shape.scale_max), own,
                            own + 4, own + 7);
  }
  __syncthreads();
  store_tile(tiles.raw, tiles.raw_stride, tiles.n_rows, shape.columns(), grad_raw + tiles.first * shape.columns());
}

}  // namespace

template <typename T>
void decode(const T* raw, const Sum<T>* readings, DecodeShape shape, Decoded<Sum<T>> out, Stream stream) {
  using N = Native<T>;
  const char* op = "decode_gaussians";
  with_degree(shape.degree, [&]<int kDegree>() {
    launch(op, decode_kernel<kDegree, N, Sum<T>>, blocks_for(op, shape.n_rows, kRows), kRows,
           shared_bytes<Sum<T>>(shape), stream, reinterpret_cast<const N*>(raw), readings, shape, out);
  });
}

template <typename T>
void decode_vjp(const T* raw, const Sum<T>* readings, DecodeShape shape, DecodedGradients<Sum<T>> grads, T* grad_raw,
                Stream stream) {
  using N = Native<T>;
  const char* op = "decode_gaussians_backward";
  with_degree(shape.degree, [&]<int kDegree>() {
    launch(op, decode_vjp_kernel<kDegree, N, Sum<T>>, blocks_for(op, shape.n_rows, kRows), kRows,
           shared_bytes<Sum<T>>(shape), stream, reinterpret_cast<const N*>(raw), readings, shape, grads,
           reinterpret_cast<N*>(grad_raw));
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                  \
  template void decode<T>(const T*, const Sum<T>*, DecodeShape, Decoded<Sum<T>>, Stream);      \
  template void decode_vjp<T>(const T*, const Sum<T>*, DecodeShape, DecodedGradients<Sum<T>>, T*, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(Float16)
GSIM3D_INSTANTIATE(BFloat16)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
