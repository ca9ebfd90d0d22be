// The formulas of raster_math.h on numbers that carry a derivative along one direction of the arguments.
#pragma once

#include <algorithm>
#include <type_traits>
#include <utility>

#include "gsim3d/projection/jet.h"
#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_math.h"

namespace gsim3d::raster {

using projection::plain;

template <typename T>
using Dual = projection::Jet<T, 1>;

template <typename V>
using PlainOf = decltype(plain(std::declval<V>()));

template <typename T>
struct Lanes<Dual<T>> {
  using Scalar = Dual<T>;
  static constexpr int kCount = 1;
  GSIM3D_HD static Dual<T> splat(Dual<T> value) { return value; }
  GSIM3D_HD static Dual<T> sqrt(Dual<T> value) { return projection::root(value); }
};

template <typename T>
GSIM3D_HD Dual<T> dual(T value, T along) {
  Dual<T> out(value);
  out.along[0] = along;
  return out;
}
template <typename T>
GSIM3D_HD Dual<T> dual(const T* values, const T* tangents, int64_t at) {
  return dual(values[at], tangents ? tangents[at] : T(0));
}

// An argument as V, which is T or Dual<T>.
template <typename V, typename T>
GSIM3D_HD V argument(const T* values, const T* tangents, int64_t at) {
  if constexpr (std::is_same_v<V, T>)
    return values[at];
  else
    return dual(values, tangents, at);
}

// What an image shows of a number: itself, or its derivative.
template <typename T>
GSIM3D_HD T shown(T x) {
  return x;
}
template <typename T>
GSIM3D_HD T shown(const Dual<T>& x) {
  return x.along[0];
}

template <typename T>
GSIM3D_HD Camera<Dual<T>> dual_camera(const RasterScene<T>& s, const RasterTangents<T>& t, int64_t image) {
  Dual<T> viewmat[16], K[9];
  for (int i = 0; i < 16; ++i) viewmat[i] = dual(s.viewmats, t.viewmats, 16 * image + i);
  for (int i = 0; i < 9; ++i) K[i] = Dual<T>(s.Ks[9 * image + i]);
  return make_camera(viewmat, K, s.width, s.height, Dual<T>(s.near_plane), s.jacobian == RasterJacobian::kClamped);
}

// A row, and what an image makes of it.
template <typename T, int kTerms>
struct DualRow {
  using D = Dual<T>;
  static constexpr int kColumns = std::max(1, kTerms) * 3;
  D mean[3], quat[4], scale[3], opacity, coefficients[kColumns], color[3];
  Axes<D> axes;
  Projection<D> projection;
  Direction<D> direction;
  Footprint<D> shape;
  D basis[std::max(1, kTerms)];

  GSIM3D_HD DualRow(const RasterScene<T>& s, const RasterTangents<T>& t, const Camera<D>& camera, int64_t row) {
    for (int i = 0; i < 3; ++i) mean[i] = dual(s.means, t.means, 3 * row + i);
    for (int i = 0; i < 4; ++i) quat[i] = dual(s.quats, t.quats, 4 * row + i);
    for (int i = 0; i < 3; ++i) scale[i] = dual(s.scales, t.scales, 3 * row + i);
    for (int i = 0; i < kColumns; ++i) coefficients[i] = dual(s.color, t.color, kColumns * row + i);
    opacity = dual(s.opacities, t.opacities, row);
    axes = axes_of(quat, scale);
    projection = project(camera, mean, axes);
    shape = footprint_of(projection.xy, projection.yy, projection.determinant);
    if constexpr (kTerms > 0) {
      direction = view_direction(camera, projection.point);
      sh_basis<kTerms>(direction.unit, basis);
      sh_color<kTerms>(basis, coefficients, color);
    } else {
      for (int c = 0; c < 3; ++c) color[c] = coefficients[c];
    }
  }
};

}  // namespace gsim3d::raster
