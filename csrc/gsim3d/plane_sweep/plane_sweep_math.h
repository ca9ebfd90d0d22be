// Where a pixel lands in a source image, and bilinear interpolation there.
#pragma once

#include <cmath>
#include <cstdint>

#include "gsim3d/core/platform.h"

namespace gsim3d::plane_sweep_math {

// Smallest depth that divides, in metres: keeps points on and behind the source camera's plane finite (they land far
// outside its image unless they lie on its axis).
template <typename T>
constexpr T kMinDepth = T(1e-3);

// The ray of one pixel in the source camera: A [u, v, 1].
template <typename T>
struct Ray {
  T x, y, z;
};

template <typename T>
GSIM3D_HD Ray<T> source_ray(const T* a /* [3, 3] */, T u, T v) {
  return {a[0] * u + a[1] * v + a[2], a[3] * u + a[4] * v + a[5], a[6] * u + a[7] * v + a[8]};
}

// A place between four pixels. Scores lie in a table of (height + 3) rows of (width + 2): a border of zeros around the
// image, and two rows of zeros below it for samples that fall outside.
template <typename T>
struct Cell {
  int32_t corner;  // top left corner in the table; the others are at +1, +stride, +stride + 1
  T fx, fy;        // in [0, 1)
};

GSIM3D_HD int64_t table_stride(int64_t width) { return width + 2; }
GSIM3D_HD int64_t table_size(int64_t height, int64_t width) { return (height + 3) * (width + 2); }
GSIM3D_HD int64_t outside_corner(int64_t height, int64_t width) { return (height + 1) * (width + 2); }

// Where a sample lies: between columns x, x + 1 and rows y, y + 1.
template <typename T>
struct Place {
  bool inside;
  int32_t x, y;  // in [-1, width) and [-1, height) where inside
  T fx, fy;      // in [0, 1)
};

// b: [3]. A NaN or infinite place counts as outside.
template <typename T>
GSIM3D_HD Place<T> sample_place(const Ray<T>& ray, const T* b, T depth, int32_t height, int32_t width) {
  const T z = ray.z * depth + b[2];
  const T inverse_z = T(1) / (z > kMinDepth<T> ? z : kMinDepth<T>);
  const T x = (ray.x * depth + b[0]) * inverse_z, y = (ray.y * depth + b[1]) * inverse_z;
  const bool inside = (x > T(-1)) & (x < T(width)) & (y > T(-1)) & (y < T(height));
  const T safe_x = inside ? x : T(0), safe_y = inside ? y : T(0);
  const T x0 = std::floor(safe_x), y0 = std::floor(safe_y);
  return {inside, static_cast<int32_t>(x0), static_cast<int32_t>(y0), safe_x - x0, safe_y - y0};
}

template <typename T>
GSIM3D_HD Cell<T> sample_cell(const Ray<T>& ray, const T* b, T depth, int32_t height, int32_t width) {
  const Place<T> at = sample_place(ray, b, depth, height, width);
  const int32_t corner = (at.y + 1) * (width + 2) + at.x + 1;
  return {at.inside ? corner : (height + 1) * (width + 2), at.fx, at.fy};
}

// s00: top left, s01: top right, s10: bottom left, s11: bottom right.
template <typename T>
GSIM3D_HD T interpolate(T s00, T s01, T s10, T s11, T fx, T fy) {
  const T top = s00 + (s01 - s00) * fx, bottom = s10 + (s11 - s10) * fx;
  return top + (bottom - top) * fy;
}

// Adds the gradients of the four scores.
template <typename T>
GSIM3D_HD void interpolate_vjp(T& g00, T& g01, T& g10, T& g11, T fx, T fy, T grad) {
  const T bottom = grad * fy, top = grad - bottom;
  const T top_right = top * fx, bottom_right = bottom * fx;
  g00 += top - top_right;
  g01 += top_right;
  g10 += bottom - bottom_right;
  g11 += bottom_right;
}

}  // namespace gsim3d::plane_sweep_math
