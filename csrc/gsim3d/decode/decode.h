// What a network says about the shape and colour of a Gaussian -> rotation, scale and colour in the world.
#pragma once

#include <cstdint>

#include "gsim3d/core/half.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/platform.h"
#include "gsim3d/core/stream.h"

namespace gsim3d {

// A row of the network holds harmonics (3, terms) in the Gaussian's frame, a rotation (x, y, z, w) and three scales
// before their sigmoid. Of the colour, the harmonics up to `degree` are kept, which is at most that of the row; degree
// -1 has no terms.
struct DecodeShape {
  int64_t n_rows;
  int terms, degree;
  double scale_min, scale_max;

  GSIM3D_HD int columns() const { return 3 * terms + 7; }
  GSIM3D_HD int kept_terms() const { return (degree + 1) * (degree + 1); }
};

// How degrees 1 to 3 are read on 2 l + 1 directions: of each degree the directions, then what turns values into
// coefficients.
constexpr int kReadings = 9 + 9 + 15 + 25 + 21 + 49;

template <typename S>
struct Decoded {
  S *quats, *scales, *sh;  // [N, 4] (w, x, y, z), [N, 3], [N, kept terms, 3]
};
template <typename S>
struct DecodedGradients {
  const S *quats, *scales, *sh;
};

namespace cpu {
template <typename T>
void decode(const T* raw, const T* readings, DecodeShape shape, Decoded<T> out, const Parallel& parallel);
template <typename T>
void decode_vjp(const T* raw, const T* readings, DecodeShape shape, DecodedGradients<T> grads, T* grad_raw,
                const Parallel& parallel);
}  // namespace cpu

namespace cuda {
template <typename T>
void decode(const T* raw, const Sum<T>* readings, DecodeShape shape, Decoded<Sum<T>> out, Stream stream);
template <typename T>
void decode_vjp(const T* raw, const Sum<T>* readings, DecodeShape shape, DecodedGradients<Sum<T>> grads, T* grad_raw,
                Stream stream);
}  // namespace cuda

}  // namespace gsim3d
