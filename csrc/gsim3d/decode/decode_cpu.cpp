#include "gsim3d/decode/decode.h"

#include <algorithm>

#include "gsim3d/decode/decode_math.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kGrain = 2048;  // rows

}  // namespace

template <typename T>
void decode(const T* raw, const T* readings, DecodeShape shape, Decoded<T> out, const Parallel& parallel) {
  const T low = static_cast<T>(shape.scale_min), high = static_cast<T>(shape.scale_max);
  with_degree(shape.degree, [&]<int kDegree>() {
    parallel.range(shape.n_rows, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row)
        decode_row<kDegree>(raw + row * shape.columns(), shape.terms, readings, low, high, out.quats + 4 * row,
                            out.scales + 3 * row, out.sh + 3 * shape.kept_terms() * row);
    });
  });
}

template <typename T>
void decode_vjp(const T* raw, const T* readings, DecodeShape shape, DecodedGradients<T> grads, T* grad_raw,
                const Parallel& parallel) {
  const T low = static_cast<T>(shape.scale_min), high = static_cast<T>(shape.scale_max);
  with_degree(shape.degree, [&]<int kDegree>() {
    parallel.range(shape.n_rows, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row) {
        T* to = grad_raw + row * shape.columns();
        std::copy_n(raw + row * shape.columns(), shape.columns(), to);
        decode_row_vjp<kDegree>(to, shape.terms, readings, low, high, grads.quats + 4 * row, grads.scales + 3 * row,
                                grads.sh + 3 * shape.kept_terms() * row);
      }
    });
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                  \
  template void decode<T>(const T*, const T*, DecodeShape, Decoded<T>, const Parallel&);       \
  template void decode_vjp<T>(const T*, const T*, DecodeShape, DecodedGradients<T>, T*, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
