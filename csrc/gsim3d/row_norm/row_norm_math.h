// Layer normalisation of one row, y = (x - mean) / sqrt(variance + eps) * weight + bias, and GELU, for host and device.
#pragma once

#include <cmath>

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

// x Phi(x), with the distribution function of the normal distribution.
template <typename T>
GSIM3D_HD T gelu(T x) {
  constexpr T kRootHalf = T(0.70710678118654752440);
  return T(0.5) * x * (T(1) + std::erf(x * kRootHalf));
}

template <typename T>
GSIM3D_HD T gelu_vjp(T grad, T x) {
  constexpr T kRootHalf = T(0.70710678118654752440), kDensity = T(0.39894228040143267794);  // 1 / sqrt(2 pi)
  return grad * (T(0.5) * (T(1) + std::erf(x * kRootHalf)) + x * kDensity * std::exp(T(-0.5) * x * x));
}

}  // namespace gsim3d
