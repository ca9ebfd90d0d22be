// Layer normalisation of packed rows, with the sum that follows it in a residual network.
//
// Each row is normalised over its channels, whatever rows are packed with it: its bits do not depend on them. Sums over
// rows (the gradients of weight and bias) go over fixed blocks of rows in order. Stats keep mean and 1 / sqrt(variance
// + eps).
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

// Weight and bias of one normalisation, [channels] each; nullptr: there is none.
template <typename S>
struct NormWeights {
  const S *weight = nullptr, *bias = nullptr;
};
template <typename S>
struct NormGrads {
  S *weight = nullptr, *bias = nullptr;
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

// One residual sum and the normalisations around it: sum = x + keep * norm(branch); out = norm(sum).
template <typename T>
void residual_norm(const T* x,                 // [n_rows, channels]
                   const T* branch,            // [n_rows, channels]
                   const T* keep,              // [n_rows], or nullptr: 1
                   NormWeights<T> branch_norm, NormWeights<T> norm, RowNormShape shape, double eps,
                   T* sum,           // [n_rows, channels]
                   T* out,           // [n_rows, channels]
                   T* branch_stats,  // [n_rows, 2] where branch_norm is given
                   T* stats,         // [n_rows, 2] where norm is given
                   const Parallel& parallel);

// Gradients of x, branch and the weights that are given; branch_sum is the sum over rows of the branch's gradient, that
// of a bias of the linear layer before.
template <typename T>
void residual_norm_vjp(const T* grad_sum,  // [n_rows, channels], or nullptr: 0
                       const T* grad_out,  // [n_rows, channels], or nullptr: 0
                       const T* branch, const T* sum, const T* keep, const T* branch_weight, const T* weight,
                       const T* branch_stats, const T* stats, RowNormShape shape,
                       T* grad_x,       // [n_rows, channels]
                       T* grad_branch,  // [n_rows, channels]
                       T* branch_sum,   // [channels]
                       NormGrads<T> branch_grads, NormGrads<T> grads, const Parallel& parallel);

// out[c] = sum over rows of x[row, c].
template <typename T>
void sum_rows(const T* x, RowNormShape shape, T* out, const Parallel& parallel);

// One normalisation of channels and the activation behind it: out = gelu((x - mean) * scale + bias), mean, scale and
// bias one value a channel.
template <typename T>
void norm_gelu(const T* x,  // [n_rows, channels]
               const T* mean, const T* scale, const T* bias, RowNormShape shape, T* out, const Parallel& parallel);

// The gradient of mean is -scale * grad_bias.
template <typename T>
void norm_gelu_vjp(const T* grad, const T* x, const T* mean, const T* scale, const T* bias, RowNormShape shape,
                   T* grad_x, T* grad_scale, T* grad_bias, const Parallel& parallel);

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

// T is float or a 16-bit format, and the residual stream float; or all are double.
template <typename T>
void residual_norm(const Sum<T>* x, const T* branch, const Sum<T>* keep, NormWeights<Sum<T>> branch_norm,
                   NormWeights<Sum<T>> norm, RowNormShape shape, double eps, Sum<T>* sum, T* out, Sum<T>* branch_stats,
                   Sum<T>* stats, Stream stream);

template <typename T>
void residual_norm_vjp(const Sum<T>* grad_sum, const T* grad_out, const T* branch, const Sum<T>* sum,
                       const Sum<T>* keep, const Sum<T>* branch_weight, const Sum<T>* weight,
                       const Sum<T>* branch_stats, const Sum<T>* stats, RowNormShape shape, Sum<T>* grad_x,
                       T* grad_branch, Sum<T>* branch_sum, NormGrads<Sum<T>> branch_grads, NormGrads<Sum<T>> grads,
                       const Workspace& workspace, Stream stream);

template <typename T>
void sum_rows(const T* x, RowNormShape shape, Sum<T>* out, const Workspace& workspace, Stream stream);

// In and Out as for row_norm.
template <typename In, typename Out>
void norm_gelu(const In* x, const Sum<In>* mean, const Sum<In>* scale, const Sum<In>* bias, RowNormShape shape,
               Out* out, Stream stream);

template <typename In, typename Out>
void norm_gelu_vjp(const Out* grad, const In* x, const Sum<In>* mean, const Sum<In>* scale, const Sum<In>* bias,
                   RowNormShape shape, In* grad_x, Sum<In>* grad_scale, Sum<In>* grad_bias, const Workspace& workspace,
                   Stream stream);

}  // namespace cuda
}  // namespace gsim3d
