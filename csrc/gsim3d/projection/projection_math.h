// The formulas of the projection. T is float or double; P is T or a Jet of it. A VJP stands below its function.
#pragma once

#include <cmath>
#include <cstdint>

#include "gsim3d/core/platform.h"
#include "gsim3d/projection/jet.h"
#include "gsim3d/projection/projection.h"
#include "gsim3d/raster/raster_math.h"

namespace gsim3d::projection {

constexpr int kIntrinsics = 5;  // fx, skew, cx, fy, cy
constexpr int kLensValues = kIntrinsics + kDistortion;
constexpr double kMaxExtent = 3.33;  // standard deviations: alpha of a Gaussian of any opacity is below 1/255 there

// ---- lens: a point of the camera's frame -> pixels -----------------------------------------------------------------

template <typename P>
struct LensOf {
  Lens kind;
  bool clamped;
  int64_t width, height;
  P values[kLensValues];  // fx, skew, cx, fy, cy in pixels, then the distortion
};

// theta / r of theta = atan(r / z): a series where r is small, for it has derivatives of all orders there.
template <typename N>
GSIM3D_HD N angle_per_radius(const N& r2, const N& z) {
  const N t = r2 / (z * z);
  using S = decltype(plain(t));
  if (plain(t) >= S(1e-2) || !(plain(z) > S(0))) {
    const N r = root(r2);
    return angle(r, z) / r;
  }
  N sum = N(S(1) / S(17));
  for (int n = 15; n >= 1; n -= 2) sum = N(S(1) / S(n)) - t * sum;
  return sum / z;
}

// N: P, or Jet of P.
template <typename P, typename N>
GSIM3D_HD void lens_map(const LensOf<P>& lens, const N point[3], N pixel[2]) {
  const P* k = lens.values + kIntrinsics;
  N x, y;
  if (lens.kind == Lens::kOrthographic) {
    x = point[0], y = point[1];
  } else if (lens.kind == Lens::kFisheye) {
    const N r2 = point[0] * point[0] + point[1] * point[1];
    const N unit = angle_per_radius(r2, point[2]);
    const N t2 = unit * unit * r2;  // theta^2
    const N scale = unit * ((((t2 * k[3] + k[2]) * t2 + k[1]) * t2 + k[0]) * t2 + P(1));
    x = point[0] * scale, y = point[1] * scale;
  } else {
    x = point[0] / point[2], y = point[1] / point[2];
    if (lens.kind == Lens::kOpenCV) {  // k1, k2, p1, p2, k3, k4, k5, k6
      const N xx = x * x, yy = y * y, xy2 = x * y * P(2), r2 = xx + yy;
      const N radial = (((r2 * k[4] + k[1]) * r2 + k[0]) * r2 + P(1)) / (((r2 * k[7] + k[6]) * r2 + k[5]) * r2 + P(1));
      const N distorted_x = x * radial + xy2 * k[2] + (r2 + xx * P(2)) * k[3];
      y = y * radial + (r2 + yy * P(2)) * k[2] + xy2 * k[3];
      x = distorted_x;
    }
  }
  pixel[0] = x * lens.values[0] + y * lens.values[1] + lens.values[2];
  pixel[1] = y * lens.values[3] + lens.values[4];
}

template <typename P>
GSIM3D_HD P clamp_between(const P& x, const P& low, const P& high) {
  return plain(x) < plain(low) ? low : plain(x) > plain(high) ? high : x;
}

// Where the Jacobian is taken: at the point, or for a clamped pinhole not far outside of the image.
template <typename P>
GSIM3D_HD void linearised_at(const LensOf<P>& lens, const P point[3], P at[3]) {
  for (int i = 0; i < 3; ++i) at[i] = point[i];
  if (lens.kind != Lens::kPinhole || !lens.clamped) return;
  const P &fx = lens.values[0], &cx = lens.values[2], &fy = lens.values[3], &cy = lens.values[4];
  const P margin_x = P(raster::kFieldMargin * double(lens.width)), end_x = P(double(lens.width)) + margin_x;
  const P margin_y = P(raster::kFieldMargin * double(lens.height)), end_y = P(double(lens.height)) + margin_y;
  const P skew = lens.values[1] / fx, y = point[1] / point[2], x = point[0] / point[2] + skew * y;
  const P seen_x = clamp_between(x, (P(0) - margin_x - cx) / fx, (end_x - cx) / fx);
  const P seen_y = clamp_between(y, (P(0) - margin_y - cy) / fy, (end_y - cy) / fy);
  at[0] = (seen_x - skew * seen_y) * point[2], at[1] = seen_y * point[2];
}

// Pixel of the point, and the Jacobian [2, 3] of the lens.
template <typename P>
GSIM3D_HD void look(const LensOf<P>& lens, const P point[3], P pixel[2], P jacobian[6]) {
  P at[3];
  linearised_at(lens, point, at);
  lens_map(lens, point, pixel);
  Jet<P, 3> moving[3], image[2];
  for (int i = 0; i < 3; ++i) moving[i] = Jet<P, 3>(at[i]), moving[i].along[i] = P(1);
  lens_map(lens, moving, image);
  for (int i = 0; i < 6; ++i) jacobian[i] = image[i / 3].along[i % 3];
}

// <grad_pixel, pixel> + <grad_jacobian, jacobian>, differentiated along one direction at a time.
template <typename S>
GSIM3D_HD void look_vjp(const LensOf<S>& lens, const S point[3], const S grad_pixel[2], const S grad_jacobian[6],
                        S grad_point[3], S* grad_lens) {  // [kLensValues], added to; or null
  using P = Jet<S, 1>;
  LensOf<P> moving{lens.kind, lens.clamped, lens.width, lens.height, {}};
  for (int i = 0; i < kLensValues; ++i) moving.values[i] = P(lens.values[i]);
  P at[3], pixel[2], jacobian[6];
  for (int i = 0; i < 3; ++i) at[i] = P(point[i]);
  const auto along = [&](P& seed) {
    seed.along[0] = S(1);
    look(moving, at, pixel, jacobian);
    seed.along[0] = S(0);
    S sum = grad_pixel[0] * pixel[0].along[0] + grad_pixel[1] * pixel[1].along[0];
    for (int i = 0; i < 6; ++i) sum += grad_jacobian[i] * jacobian[i].along[0];
    return sum;
  };
  for (int i = 0; i < 3; ++i) grad_point[i] = along(at[i]);
  if (grad_lens == nullptr) return;
  const int n = lens.kind == Lens::kOpenCV || lens.kind == Lens::kFisheye ? kLensValues : kIntrinsics;
  for (int i = 0; i < n; ++i) grad_lens[i] += along(moving.values[i]);
}

// Whether the lens shows the point: up to the radius where it would fold back onto itself.
template <typename S>
GSIM3D_HD bool within_lens(Lens kind, const S point[3], S limit) {
  const S r = std::sqrt(point[0] * point[0] + point[1] * point[1]);
  if (kind == Lens::kOpenCV) return r < limit * point[2];
  return kind != Lens::kFisheye || std::atan2(r, point[2]) < limit;
}

// ---- camera --------------------------------------------------------------------------------------------------------

template <typename T>
struct View {
  T rotation[9], translation[3];
  LensOf<T> lens;
  T limit;
  int64_t row_begin, row_end, pair_begin;  // rows of the image's cloud, and its first pair
};

// `rows`: [2] of the cloud, within [0, n_rows].
template <typename T>
GSIM3D_HD View<T> view_of(const ProjectionScene<T>& s, int64_t image, int64_t row_begin, int64_t row_end) {
  View<T> view;
  const T* viewmat = s.viewmats + 16 * image;
  const T* K = s.Ks + 9 * image;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) view.rotation[row * 3 + column] = viewmat[row * 4 + column];
    view.translation[row] = viewmat[row * 4 + 3];
  }
  view.lens = {s.lens, s.clamped, s.width, s.height, {K[0], K[1], K[2], K[4], K[5]}};
  for (int i = 0; i < kDistortion; ++i)
    view.lens.values[kIntrinsics + i] = s.distortion ? s.distortion[kDistortion * image + i] : T(0);
  view.limit = s.limits ? s.limits[image] : T(raster::kUnbounded);
  view.row_begin = row_begin, view.row_end = row_end, view.pair_begin = s.cu_pairs[image];
  return view;
}

// ---- a Gaussian's shape: R S with covariance (R S)(R S)^T, or the covariance itself ---------------------------------

template <typename T>
struct Shape {
  bool is_covariance;
  raster::Axes<T> axes;
  T scale[3];
  T matrix[9];  // R S, or the covariance
};

template <typename T>
GSIM3D_HD Shape<T> shape_of(const ProjectionScene<T>& s, int64_t row) {
  Shape<T> shape{};
  shape.is_covariance = s.covars != nullptr;
  if (shape.is_covariance) {
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) shape.matrix[3 * i + j] = s.covars[9 * row + (i < j ? 3 * i + j : 3 * j + i)];
    return shape;
  }
  for (int i = 0; i < 3; ++i) shape.scale[i] = s.scales[3 * row + i];
  shape.axes = raster::axes_of(s.quats + 4 * row, shape.scale);
  for (int i = 0; i < 9; ++i) shape.matrix[i] = shape.axes.a[i];
  return shape;
}

template <typename T>
GSIM3D_HD bool row_is_good(const ProjectionScene<T>& s, int64_t row, const Shape<T>& shape) {
  bool good = true;
  for (int i = 0; i < 3; ++i) good &= raster::usable(s.means[3 * row + i]) && shape.scale[i] >= 0;
  for (int i = 0; i < 9; ++i) good &= raster::usable(shape.matrix[i]);
  return good;
}

// ---- pair: point, pixel, covariance in the image --------------------------------------------------------------------

template <typename T>
struct Pair {
  T point[3], pixel[2];
  T jacobian[6], jw[6];   // [2, 3] of the lens in the camera's frame, in the world's
  T half[6];              // jw times the shape's matrix
  T xx, xy, yy;           // covariance, dilated
  T plain_xx, plain_yy;   // not dilated
  T determinant, plain_determinant;
};

template <typename T>
GSIM3D_HD void to_camera(const View<T>& view, const T mean[3], T point[3]) {
  const T* w = view.rotation;
  for (int i = 0; i < 3; ++i)
    point[i] = w[3 * i] * mean[0] + w[3 * i + 1] * mean[1] + w[3 * i + 2] * mean[2] + view.translation[i];
}

template <typename T>
GSIM3D_HD Pair<T> project_pair(const View<T>& view, const T mean[3], const Shape<T>& shape, T dilation) {
  Pair<T> out;
  to_camera(view, mean, out.point);
  look(view.lens, out.point, out.pixel, out.jacobian);
  const T *w = view.rotation, *j = out.jacobian;
  for (int i = 0; i < 6; ++i)
    out.jw[i] = j[i / 3 * 3] * w[i % 3] + j[i / 3 * 3 + 1] * w[3 + i % 3] + j[i / 3 * 3 + 2] * w[6 + i % 3];
  const T* m = shape.matrix;
  for (int i = 0; i < 6; ++i)
    out.half[i] =
        out.jw[i / 3 * 3] * m[i % 3] + out.jw[i / 3 * 3 + 1] * m[3 + i % 3] + out.jw[i / 3 * 3 + 2] * m[6 + i % 3];
  const T *a = out.half, *b = out.half + 3;
  if (shape.is_covariance) {
    const T *p = out.jw, *q = out.jw + 3;
    out.plain_xx = a[0] * p[0] + a[1] * p[1] + a[2] * p[2], out.plain_yy = b[0] * q[0] + b[1] * q[1] + b[2] * q[2];
    out.xy = a[0] * q[0] + a[1] * q[1] + a[2] * q[2];
    const T determinant = out.plain_xx * out.plain_yy - out.xy * out.xy;
    out.plain_determinant = determinant > 0 ? determinant : T(0);
  } else {
    out.plain_xx = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], out.plain_yy = b[0] * b[0] + b[1] * b[1] + b[2] * b[2];
    out.xy = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const T c0 = a[1] * b[2] - a[2] * b[1], c1 = a[2] * b[0] - a[0] * b[2], c2 = a[0] * b[1] - a[1] * b[0];
    out.plain_determinant = c0 * c0 + c1 * c1 + c2 * c2;  // as of raster_math.h
  }
  out.xx = out.plain_xx + dilation, out.yy = out.plain_yy + dilation;
  out.determinant = out.plain_determinant + dilation * (out.plain_xx + out.plain_yy) + dilation * dilation;
  return out;
}

template <typename T>
struct PairGrad {
  T pixel[2], depth, conic[3], compensation;
};

// Gradient of the covariance (xx, xy, yy; xy counts both of its entries) from those of conic and compensation.
template <typename T>
GSIM3D_HD void covariance_vjp(const Pair<T>& p, const PairGrad<T>& grad, T covariance[3]) {
  const T inverse = T(1) / p.determinant;
  const T a = p.yy * inverse, b = -p.xy * inverse, c = p.xx * inverse;  // the conic C; grad = -C G C
  const T g0 = grad.conic[0], g1 = grad.conic[1] / 2, g2 = grad.conic[2];
  const T r0 = a * g0 + b * g1, r1 = a * g1 + b * g2, r2 = b * g0 + c * g1, r3 = b * g1 + c * g2;  // C G
  covariance[0] = -(r0 * a + r1 * b);
  covariance[1] = -(r0 * b + r1 * c) - (r2 * a + r3 * b);
  covariance[2] = -(r2 * b + r3 * c);
  if (!(p.plain_determinant > 0) || grad.compensation == 0) return;
  // compensation = sqrt(plain / determinant)
  const T compensation = std::sqrt(p.plain_determinant * inverse);
  const T of_plain = grad.compensation * compensation / (2 * p.plain_determinant);
  const T of_dilated = -grad.compensation * compensation / 2 * inverse;
  covariance[0] += of_plain * p.plain_yy + of_dilated * p.yy;
  covariance[1] -= 2 * (of_plain + of_dilated) * p.xy;
  covariance[2] += of_plain * p.plain_xx + of_dilated * p.xx;
}

// grad_matrix and, unless null, grad_viewmat [12] and grad_lens [kLensValues] are added to.
template <typename T>
GSIM3D_HD void project_pair_vjp(const View<T>& view, const T mean[3], const Shape<T>& shape, const Pair<T>& p,
                                const PairGrad<T>& grad, T grad_mean[3], T grad_matrix[9], T* grad_viewmat,
                                T* grad_lens) {
  T g[3], grad_jw[6], grad_jacobian[6], grad_point[3];
  covariance_vjp(p, grad, g);
  const auto mix = [&](const T from[6], T to[6]) {  // (G + G^T) from
    for (int i = 0; i < 3; ++i) {
      to[i] = 2 * g[0] * from[i] + g[1] * from[3 + i];
      to[3 + i] = g[1] * from[i] + 2 * g[2] * from[3 + i];
    }
  };
  T mixed[6];
  if (shape.is_covariance) {
    mix(p.half, grad_jw);  // (G + G^T) J W Sigma
    mix(p.jw, mixed);
    for (int i = 0; i < 9; ++i)
      grad_matrix[i] += (p.jw[i / 3] * mixed[i % 3] + p.jw[3 + i / 3] * mixed[3 + i % 3]) / 2;
  } else {
    mix(p.half, mixed);
    for (int i = 0; i < 9; ++i) grad_matrix[i] += p.jw[i / 3] * mixed[i % 3] + p.jw[3 + i / 3] * mixed[3 + i % 3];
    for (int i = 0; i < 6; ++i) {
      const T *row = shape.matrix + 3 * (i % 3), *half = mixed + i / 3 * 3;
      grad_jw[i] = half[0] * row[0] + half[1] * row[1] + half[2] * row[2];
    }
  }
  const T* w = view.rotation;
  for (int i = 0; i < 6; ++i) {
    const T *row = w + 3 * (i % 3), *of = grad_jw + i / 3 * 3;
    grad_jacobian[i] = of[0] * row[0] + of[1] * row[1] + of[2] * row[2];
  }
  look_vjp(view.lens, p.point, grad.pixel, grad_jacobian, grad_point, grad_lens);
  grad_point[2] += grad.depth;
  for (int i = 0; i < 3; ++i) {
    grad_mean[i] += w[i] * grad_point[0] + w[3 + i] * grad_point[1] + w[6 + i] * grad_point[2];
    for (int k = 0; k < 3 && grad_viewmat; ++k)
      grad_viewmat[4 * i + k] +=
          grad_point[i] * mean[k] + p.jacobian[i] * grad_jw[k] + p.jacobian[3 + i] * grad_jw[3 + k];
    if (grad_viewmat) grad_viewmat[4 * i + 3] += grad_point[i];
  }
}

// ---- what one call writes ------------------------------------------------------------------------------------------

// Whole pixels about the mean outside of which alpha < 1/255; false where the pair is not seen.
template <typename T>
GSIM3D_HD bool radii_of(const ProjectionScene<T>& s, const Pair<T>& p, T opacity, int32_t radii[2]) {
  if (!(p.determinant > 0) || !std::isfinite(p.determinant)) return false;
  if (!raster::usable(p.pixel[0]) || !raster::usable(p.pixel[1])) return false;
  T extent = T(kMaxExtent);
  if (s.opacities) {
    if (!(opacity >= T(raster::kMinAlpha))) return false;
    extent = raster::min_of(extent, T(std::sqrt(2 * std::log(opacity / T(raster::kMinAlpha)))));
  }
  const T x = std::ceil(extent * std::sqrt(p.xx)), y = std::ceil(extent * std::sqrt(p.yy));
  if (!(x < T(1 << 30)) || !(y < T(1 << 30)) || (x <= s.radius_clip && y <= s.radius_clip)) return false;
  radii[0] = static_cast<int32_t>(x), radii[1] = static_cast<int32_t>(y);
  return p.pixel[0] + x > 0 && p.pixel[0] - x < T(s.width) && p.pixel[1] + y > 0 && p.pixel[1] - y < T(s.height);
}

template <typename T>
GSIM3D_HD void write_pair(const ProjectionScene<T>& s, const View<T>& view, int64_t row,
                          const ProjectionPairs<T>& out) {
  const int64_t pair = view.pair_begin + row - view.row_begin;
  T point[3];
  to_camera(view, s.means + 3 * row, point);
  const Shape<T> shape = shape_of(s, row);
  int32_t radii[2] = {0, 0};
  bool seen = row_is_good(s, row, shape) && point[2] > s.near_plane && point[2] < s.far_plane &&
              within_lens(view.lens.kind, point, view.limit);
  Pair<T> p{};
  T compensation = 0;
  if (seen) {
    p = project_pair(view, s.means + 3 * row, shape, s.dilation);
    compensation = std::sqrt(p.plain_determinant / p.determinant);
    const T opacity = s.opacities ? s.opacities[row] * (s.antialiased ? compensation : T(1)) : T(1);
    seen = radii_of(s, p, opacity, radii);
  }
  const T inverse = seen ? T(1) / p.determinant : T(0);
  for (int i = 0; i < 2; ++i) {
    out.means2d[2 * pair + i] = seen ? p.pixel[i] : T(0);
    out.radii[2 * pair + i] = seen ? radii[i] : 0;
  }
  out.conics[3 * pair] = seen ? p.yy * inverse : T(0), out.conics[3 * pair + 1] = seen ? -p.xy * inverse : T(0);
  out.conics[3 * pair + 2] = seen ? p.xx * inverse : T(0);
  out.depths[pair] = seen ? p.point[2] : T(0);
  out.compensations[pair] = seen ? compensation : T(0);
}

template <typename T>
struct RowGrad {
  T mean[3], matrix[9];
};

// Adds what one pair tells its row, and unless null its view. Nothing where it was not seen.
template <typename T>
GSIM3D_HD void read_pair_vjp(const ProjectionScene<T>& s, const View<T>& view, int64_t row, const Shape<T>& shape,
                             const ProjectionPairGrads<T>& grads, RowGrad<T>& to, T* grad_viewmat, T* grad_lens) {
  const int64_t pair = view.pair_begin + row - view.row_begin;
  if (grads.radii[2 * pair] <= 0 || grads.radii[2 * pair + 1] <= 0) return;
  PairGrad<T> grad;
  for (int i = 0; i < 2; ++i) grad.pixel[i] = raster::value_or_zero(grads.means2d, 2 * pair + i);
  for (int i = 0; i < 3; ++i) grad.conic[i] = raster::value_or_zero(grads.conics, 3 * pair + i);
  grad.depth = raster::value_or_zero(grads.depths, pair);
  grad.compensation = raster::value_or_zero(grads.compensations, pair);
  const T* mean = s.means + 3 * row;
  const Pair<T> p = project_pair(view, mean, shape, s.dilation);
  project_pair_vjp(view, mean, shape, p, grad, to.mean, to.matrix, grad_viewmat, grad_lens);
}

template <typename T>
GSIM3D_HD void write_row_grad(const ProjectionSceneGrads<T>& grads, int64_t row, const Shape<T>& shape,
                              const RowGrad<T>& of) {
  for (int i = 0; i < 3; ++i) grads.means[3 * row + i] = of.mean[i];
  if (grads.covars)
    for (int i = 0; i < 9; ++i) grads.covars[9 * row + i] = of.matrix[i];
  if (!grads.quats) return;
  T quat[4], scale[3];
  raster::axes_vjp(shape.axes, shape.scale, of.matrix, quat, scale);
  for (int i = 0; i < 4; ++i) grads.quats[4 * row + i] = quat[i];
  for (int i = 0; i < 3; ++i) grads.scales[3 * row + i] = scale[i];
}

constexpr int kCameraValues = 12 + kLensValues;

// Writes the gradients of one image from their sum over its rows.
template <typename T>
GSIM3D_HD void write_camera_grad(const ProjectionSceneGrads<T>& grads, int64_t image, const T sums[kCameraValues]) {
  for (int i = 0; i < 16 && grads.viewmats; ++i) grads.viewmats[16 * image + i] = i < 12 ? sums[i] : T(0);
  const T* lens = sums + 12;
  for (int i = 0; i < 9 && grads.Ks; ++i)
    grads.Ks[9 * image + i] = i < 3 ? lens[i] : i == 4 || i == 5 ? lens[i - 1] : T(0);
  for (int i = 0; i < kDistortion && grads.distortion; ++i)
    grads.distortion[kDistortion * image + i] = lens[kIntrinsics + i];
}

// ---- colours of spherical harmonics --------------------------------------------------------------------------------

// A direction whose components are all smaller is none: it has a fixed unit vector, and no gradient, which would be
// too large for float32.
constexpr double kShortestDirection = 1e-18;

template <typename T>
GSIM3D_HD T unit_of(const T direction[3], T unit[3]) {
  T largest = 0;
  for (int i = 0; i < 3; ++i) largest = raster::max_of(largest, raster::abs_of(direction[i]));
  const bool is_none = largest < T(kShortestDirection);
  const T inverse_largest = is_none ? T(0) : T(1) / largest;
  for (int i = 0; i < 3; ++i) unit[i] = is_none ? T(1) : direction[i] * inverse_largest;
  const T inverse = T(1) / std::sqrt(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2]);
  for (int i = 0; i < 3; ++i) unit[i] *= inverse;
  return inverse * inverse_largest;  // 1 / length, 0 where the direction is none
}

template <typename T, int kTerms>
GSIM3D_HD void sh_row(const T direction[3], const T* sh, int64_t n_channels, T* color) {
  T unit[3], basis[kTerms];
  unit_of(direction, unit);
  raster::sh_basis<kTerms>(unit, basis);
  for (int64_t c = 0; c < n_channels; ++c) {
    T sum = T(0.5);
    for (int k = 0; k < kTerms; ++k) sum += basis[k] * sh[k * n_channels + c];
    color[c] = sum > 0 || !(sum == sum) ? sum : T(0);
  }
}

// grad_sh is added to.
template <typename T, int kTerms>
GSIM3D_HD void sh_row_vjp(const T direction[3], const T* sh, int64_t n_channels, const T* grad, T grad_direction[3],
                          T* grad_sh) {
  T unit[3], basis[kTerms], grad_basis[kTerms] = {}, grad_unit[3] = {};
  const T inverse = unit_of(direction, unit);
  raster::sh_basis<kTerms>(unit, basis);
  for (int64_t c = 0; c < n_channels; ++c) {
    T sum = T(0.5);
    for (int k = 0; k < kTerms; ++k) sum += basis[k] * sh[k * n_channels + c];
    if (!(sum > 0)) continue;
    for (int k = 0; k < kTerms; ++k) {
      grad_basis[k] += grad[c] * sh[k * n_channels + c];
      grad_sh[k * n_channels + c] += grad[c] * basis[k];
    }
  }
  raster::sh_basis_vjp<kTerms>(unit, grad_basis, grad_unit);
  const T along = grad_unit[0] * unit[0] + grad_unit[1] * unit[1] + grad_unit[2] * unit[2];
  for (int i = 0; i < 3; ++i) grad_direction[i] = (grad_unit[i] - unit[i] * along) * inverse;
}

}  // namespace gsim3d::projection
