// Layer normalisation of packed rows, with the sum that follows it in a residual network.
//
// Each row is normalised over its channels, whatever rows are packed with it: its bits do not depend on them. Sums over
// rows (the gradients of weight and bias) go over fixed blocks of rows in order. Stats keep mean and 1 / sqrt(variance + eps).
#pragma once

#include <cstdint>

#include "gsim3d/core/half.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

struct RowNormShape {
  int64_t n_rows, channels;
};

namespace cpu {

// out = normalised(x) * weight + bias (+ residual). T is float or double.
template <typename T>
void row_norm(const T* x,         // [n_rows, channels]
              const T* weight,    // [channels]
              const T* bias,      // [channels]
              const T* residual,  // [n_rows, channels] or nullptr
              RowNormShape shape, double eps,
              T* out,    // [n_rows, channels]
              T* stats,  // [n_rows, 2]
              const Parallel& parallel);

// The gradient of residual is grad itself.
template <typename T>
void row_norm_vjp(const T* grad, const T* x, const T* weight, const T* stats, RowNormShape shape,
                  T* grad_x,       // [n_rows, channels]
                  T* grad_weight,  // [channels]
                  T* grad_bias,    // [channels]
                  const Parallel& parallel);

}  // namespace cpu

// The same on the device of `stream`. In and Out are float or a 16-bit format, computed in float; or both double.
namespace cuda {

template <typename In, typename Out>
void row_norm(const In* x, const Sum<In>* weight, const Sum<In>* bias, const Out* residual,
              RowNormShape shape, double eps, Out* out, Sum<In>* stats, Stream stream);

template <typename In, typename Out>
void row_norm_vjp(const Out* grad, const In* x, const Sum<In>* weight, const Sum<In>* stats,
                  RowNormShape shape, In* grad_x, Sum<In>* grad_weight, Sum<In>* grad_bias,
                  const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
