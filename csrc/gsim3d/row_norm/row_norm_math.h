// Layer normalisation of one row: y = (x - mean) / sqrt(variance + eps) * weight + bias, for host and device.
#pragma once

#include "gsim3d/core/platform.h"

namespace gsim3d {

template <typename T>
struct RowStats {
  T mean, scale;  // scale = 1 / sqrt(variance + eps)
};

template <typename T>
GSIM3D_HD T normalised(T x, RowStats<T> stats) {
  return (x - stats.mean) * stats.scale;
}

template <typename T>
GSIM3D_HD T row_norm_value(T x, RowStats<T> stats, T weight, T bias) {
  return normalised(x, stats) * weight + bias;
}

// The gradient of x needs two means over its row: of grad * weight, and of grad * weight * normalised(x).
template <typename T>
GSIM3D_HD T row_norm_value_vjp(T grad, T x, RowStats<T> stats, T weight, T mean_grad, T mean_grad_x) {
  return (grad * weight - mean_grad - normalised(x, stats) * mean_grad_x) * stats.scale;
}

}  // namespace gsim3d
