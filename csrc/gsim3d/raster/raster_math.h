// The differentiable parts of the rasterizer. V is float, double or a short vector of them: every function is free of
// branches on values, so one vector carries several Gaussians. A VJP stands below its function.
#pragma once

#include <cmath>
#include <cstdint>

#include "gsim3d/core/platform.h"

namespace gsim3d::raster {

constexpr double kMinAlpha = 1.0 / 255;       // weaker than the smallest step of an 8-bit image: left out
constexpr double kMaxAlpha = 0.99;            // keeps 1 / (1 - alpha) in the backward pass below 100
constexpr double kMinTransmittance = 1e-4;    // a pixel ends before falling below it; what is behind is invisible
constexpr double kDilation = 0.3;             // px^2, added to both variances: no Gaussian falls between pixels
constexpr double kFieldMargin = 0.15;         // how far outside of the image, in its size, a clamped Jacobian is taken
constexpr double kUnbounded = 3e38;           // no ratio of usable numbers is larger in float32
constexpr double kLargest = 1e15;              // beyond it a number is not used: products and squares stay finite
constexpr double kMinQuat = 1e-6;             // shorter quaternions have no direction: identity, no gradient
constexpr int kTile = 16;                     // pixels; part of the meaning of RasterCutoff::kTile3Sigma

// What the functions need of V beyond arithmetic; vector types specialise it.
template <typename V>
struct Lanes {
  using Scalar = V;
  static constexpr int kCount = 1;
  GSIM3D_HD static V splat(Scalar value) { return value; }
  GSIM3D_HD static V sqrt(V value) { return std::sqrt(value); }
};

template <typename V>
using ScalarOf = typename Lanes<V>::Scalar;

template <typename V>
GSIM3D_HD V max_of(V a, V b) {
  return a > b ? a : b;
}
template <typename V>
GSIM3D_HD V min_of(V a, V b) {
  return a < b ? a : b;
}
template <typename V>
GSIM3D_HD V abs_of(V a) {
  return a < V{} ? -a : a;
}
template <typename V>
GSIM3D_HD V value_or_zero(const V* values, int64_t i) {
  return values ? values[i] : V{};
}

// Finite, and small enough for the products of this file.
template <typename S>
GSIM3D_HD bool usable(S x) {
  return x >= S(-kLargest) && x <= S(kLargest);
}

template <typename S>
struct Camera {
  S rotation[9], translation[3];
  S fx, fy, cx, cy;
  S skew;                        // skew / fx
  S low_x, high_x, low_y, high_y;  // range of the normalised image coordinates at which the Jacobian is taken
  S near_plane;
};

template <typename S>
GSIM3D_HD Camera<S> make_camera(const S* viewmat, const S* K, int64_t width, int64_t height, S near_plane,
                                bool clamped) {
  Camera<S> camera;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) camera.rotation[row * 3 + column] = viewmat[row * 4 + column];
    camera.translation[row] = viewmat[row * 4 + 3];
  }
  camera.fx = K[0], camera.skew = K[1] / K[0], camera.cx = K[2], camera.fy = K[4], camera.cy = K[5];
  camera.low_x = camera.low_y = S(-kUnbounded), camera.high_x = camera.high_y = S(kUnbounded);
  if (clamped) {
    const S margin_x = S(kFieldMargin) * S(width), margin_y = S(kFieldMargin) * S(height);
    camera.low_x = (-margin_x - camera.cx) / camera.fx, camera.high_x = (S(width) + margin_x - camera.cx) / camera.fx;
    camera.low_y = (-margin_y - camera.cy) / camera.fy, camera.high_y = (S(height) + margin_y - camera.cy) / camera.fy;
  }
  camera.near_plane = near_plane;
  return camera;
}

// ---- quaternion (w, x, y, z) of any length -> rotation matrix -----------------------------------------------------

template <typename V>
struct Rotation {
  V unit[4];
  V inverse_norm;  // 0 where the quaternion has no direction
  V r[9];
};

template <typename V>
GSIM3D_HD Rotation<V> rotation_of(const V quat[4]) {
  using S = ScalarOf<V>;
  const V one = Lanes<V>::splat(1);
  Rotation<V> out;
  // Scaled by the largest component first: squares of very long and very short quaternions leave the number range.
  const V largest = max_of(max_of(abs_of(quat[0]), abs_of(quat[1])), max_of(abs_of(quat[2]), abs_of(quat[3])));
  const auto has_direction = largest > V{} + S(kMinQuat);
  const V inverse_largest = one / (has_direction ? largest : one);
  V q[4];
  for (int i = 0; i < 4; ++i) q[i] = has_direction ? quat[i] * inverse_largest : (i == 0 ? one : V{});
  const V inverse = one / Lanes<V>::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int i = 0; i < 4; ++i) out.unit[i] = q[i] * inverse;
  out.inverse_norm = has_direction ? inverse * inverse_largest : V{};
  const V w = out.unit[0], x = out.unit[1], y = out.unit[2], z = out.unit[3];
  const S two = 2;
  out.r[0] = one - two * (y * y + z * z), out.r[1] = two * (x * y - w * z), out.r[2] = two * (x * z + w * y);
  out.r[3] = two * (x * y + w * z), out.r[4] = one - two * (x * x + z * z), out.r[5] = two * (y * z - w * x);
  out.r[6] = two * (x * z - w * y), out.r[7] = two * (y * z + w * x), out.r[8] = one - two * (x * x + y * y);
  return out;
}

// grad_quat = (I - u u^T) (dr/du)^T grad_r / |quat|
template <typename V>
GSIM3D_HD void rotation_of_vjp(const Rotation<V>& out, const V g[9], V grad_quat[4]) {
  using S = ScalarOf<V>;
  const V w = out.unit[0], x = out.unit[1], y = out.unit[2], z = out.unit[3];
  const S two = 2;
  V u[4];
  u[0] = two * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]));
  u[1] = two * (y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]) - two * x * (g[4] + g[8]));
  u[2] = two * (x * (g[1] + g[3]) + z * (g[5] + g[7]) + w * (g[2] - g[6]) - two * y * (g[0] + g[8]));
  u[3] = two * (x * (g[2] + g[6]) + y * (g[5] + g[7]) + w * (g[3] - g[1]) - two * z * (g[0] + g[4]));
  const V along = u[0] * w + u[1] * x + u[2] * y + u[3] * z;
  for (int i = 0; i < 4; ++i) grad_quat[i] = (u[i] - out.unit[i] * along) * out.inverse_norm;
}

// ---- axes of the Gaussian, which all images share ------------------------------------------------------------------

template <typename V>
struct Axes {
  Rotation<V> rotation;
  V a[9];  // R diag(scale)
};

template <typename V>
GSIM3D_HD Axes<V> axes_of(const V quat[4], const V scale[3]) {
  Axes<V> out;
  out.rotation = rotation_of(quat);
  for (int i = 0; i < 9; ++i) out.a[i] = out.rotation.r[i] * scale[i % 3];
  return out;
}

template <typename V>
GSIM3D_HD void axes_vjp(const Axes<V>& axes, const V scale[3], const V grad_axes[9], V grad_quat[4], V grad_scale[3]) {
  V grad_r[9];
  for (int i = 0; i < 3; ++i) grad_scale[i] = V{};
  for (int i = 0; i < 9; ++i) {
    grad_scale[i % 3] += grad_axes[i] * axes.rotation.r[i];
    grad_r[i] = grad_axes[i] * scale[i % 3];
  }
  rotation_of_vjp(axes.rotation, grad_r, grad_quat);
}

// ---- Gaussian -> image: mean, depth and covariance in pixels ------------------------------------------------------

template <typename V>
struct Projection {
  V x, y, z;         // pixels, pixels, metres
  V xx, xy, yy;      // covariance, px^2, dilated
  V determinant;     // xx yy - xy^2
  V point[3];        // camera frame
  V inverse_z, ratio_x, ratio_y;  // ratios as the Jacobian sees them: clamped, where it is
  V free_x, free_y;               // 1, or 0 where clamped
  V jw[6];        // J W
  V half[6];      // J W R diag(scale): covariance = half half^T + dilation
};

template <typename V, typename S>
GSIM3D_HD Projection<V> project(const Camera<S>& camera, const V mean[3], const Axes<V>& axes) {
  const V one = Lanes<V>::splat(1);
  const S* w = camera.rotation;
  Projection<V> out;
  for (int i = 0; i < 3; ++i)
    out.point[i] = w[3 * i] * mean[0] + w[3 * i + 1] * mean[1] + w[3 * i + 2] * mean[2] + camera.translation[i];
  out.z = out.point[2];
  // Left-out Gaussians take any harmless depth, so that their lanes stay finite.
  out.inverse_z = one / (out.z > V{} + camera.near_plane ? out.z : one);
  const V raw_y = out.point[1] * out.inverse_z, raw_x = out.point[0] * out.inverse_z + camera.skew * raw_y;
  out.x = camera.fx * raw_x + camera.cx;
  out.y = camera.fy * raw_y + camera.cy;
  out.ratio_x = min_of(max_of(raw_x, V{} + camera.low_x), V{} + camera.high_x);
  out.ratio_y = min_of(max_of(raw_y, V{} + camera.low_y), V{} + camera.high_y);
  out.free_x = out.ratio_x == raw_x ? one : V{};
  out.free_y = out.ratio_y == raw_y ? one : V{};

  // J = [[fx, fx skew, -fx ratio_x], [0, fy, -fy ratio_y]] / z
  const V jx = camera.fx * out.inverse_z, jy = camera.fy * out.inverse_z;
  for (int i = 0; i < 3; ++i) {
    out.jw[i] = jx * (w[i] + camera.skew * w[3 + i] - out.ratio_x * w[6 + i]);
    out.jw[3 + i] = jy * (w[3 + i] - out.ratio_y * w[6 + i]);
  }
  for (int row = 0; row < 2; ++row)
    for (int i = 0; i < 3; ++i)
      out.half[row * 3 + i] =
          out.jw[row * 3] * axes.a[i] + out.jw[row * 3 + 1] * axes.a[3 + i] + out.jw[row * 3 + 2] * axes.a[6 + i];
  const V* a = out.half;
  const V* b = out.half + 3;
  const S dilation = S(kDilation);
  const V plain_xx = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], plain_yy = b[0] * b[0] + b[1] * b[1] + b[2] * b[2];
  out.xx = plain_xx + dilation;
  out.xy = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  out.yy = plain_yy + dilation;
  // |a x b|^2 is the determinant before dilation without the cancellation that xx yy - xy^2 has for needles.
  const V c0 = a[1] * b[2] - a[2] * b[1], c1 = a[2] * b[0] - a[0] * b[2], c2 = a[0] * b[1] - a[1] * b[0];
  out.determinant = c0 * c0 + c1 * c1 + c2 * c2 + dilation * (plain_xx + plain_yy) + dilation * dilation;
  return out;
}

template <typename V>
struct ProjectionGrad {
  V x, y, z;     // in: of Projection's members of the same name
  V xx, xy, yy;  // in; xy counts both off-diagonal entries
  V point[3];    // in: of the camera-frame point from elsewhere (the view direction)
};

// With H = J W A, A = R diag(scale), Sigma = H H^T: grad_H = (G + G^T) H, grad_A = (J W)^T grad_H, grad_{JW} = grad_H
// A^T.
template <typename V, typename S>
GSIM3D_HD void project_vjp(const Camera<S>& camera, const V mean[3], const Axes<V>& axes, const Projection<V>& out,
                           const ProjectionGrad<V>& grad, V grad_mean[3], V grad_axes[9],
                           V grad_viewmat[12]) {  // [3, 4], added to
  const S* w = camera.rotation;
  const S two = 2;
  V grad_half[6];
  for (int i = 0; i < 3; ++i) {
    grad_half[i] = two * grad.xx * out.half[i] + grad.xy * out.half[3 + i];
    grad_half[3 + i] = grad.xy * out.half[i] + two * grad.yy * out.half[3 + i];
  }
  for (int i = 0; i < 9; ++i)
    grad_axes[i] = out.jw[i / 3] * grad_half[i % 3] + out.jw[3 + i / 3] * grad_half[3 + i % 3];

  V grad_jw[6];
  for (int i = 0; i < 6; ++i) {
    const V* axis = axes.a + 3 * (i % 3);
    const V* half = grad_half + 3 * (i / 3);
    grad_jw[i] = half[0] * axis[0] + half[1] * axis[1] + half[2] * axis[2];
  }
  const V jx = camera.fx * out.inverse_z, jy = camera.fy * out.inverse_z;
  V grad_ratio_x = V{}, grad_ratio_y = V{}, grad_jx = V{}, grad_jy = V{};
  for (int i = 0; i < 3; ++i) {
    grad_jx += grad_jw[i] * (w[i] + camera.skew * w[3 + i] - out.ratio_x * w[6 + i]);
    grad_jy += grad_jw[3 + i] * (w[3 + i] - out.ratio_y * w[6 + i]);
    grad_ratio_x -= jx * grad_jw[i] * w[6 + i];
    grad_ratio_y -= jy * grad_jw[3 + i] * w[6 + i];
    grad_viewmat[i] += jx * grad_jw[i];
    grad_viewmat[4 + i] += jx * camera.skew * grad_jw[i] + jy * grad_jw[3 + i];
    grad_viewmat[8 + i] -= jx * out.ratio_x * grad_jw[i] + jy * out.ratio_y * grad_jw[3 + i];
  }
  const V grad_raw_x = camera.fx * grad.x + out.free_x * grad_ratio_x;
  const V grad_raw_y = camera.fy * grad.y + out.free_y * grad_ratio_y + camera.skew * grad_raw_x;
  V grad_inverse_z = out.point[0] * grad_raw_x + out.point[1] * (grad_raw_y);
  grad_inverse_z += camera.fx * grad_jx + camera.fy * grad_jy;
  V grad_point[3];
  grad_point[0] = grad.point[0] + out.inverse_z * grad_raw_x;
  grad_point[1] = grad.point[1] + out.inverse_z * grad_raw_y;
  grad_point[2] = grad.point[2] + grad.z - out.inverse_z * out.inverse_z * grad_inverse_z;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) grad_viewmat[4 * i + j] += grad_point[i] * mean[j];
    grad_viewmat[4 * i + 3] += grad_point[i];
    grad_mean[i] = w[i] * grad_point[0] + w[3 + i] * grad_point[1] + w[6 + i] * grad_point[2];
  }
}

// ---- view direction: W^T point, normalised; it points from the camera to the Gaussian -----------------------------

template <typename V>
struct Direction {
  V unit[3];
  V inverse_length;
};

template <typename V, typename S>
GSIM3D_HD Direction<V> view_direction(const Camera<S>& camera, const V point[3]) {
  const S* w = camera.rotation;
  const V one = Lanes<V>::splat(1);
  V d[3];
  for (int i = 0; i < 3; ++i) d[i] = w[i] * point[0] + w[3 + i] * point[1] + w[6 + i] * point[2];
  const V largest = max_of(max_of(abs_of(d[0]), abs_of(d[1])), abs_of(d[2]));
  const V inverse_largest = one / (largest > V{} ? largest : one);
  for (int i = 0; i < 3; ++i) d[i] = largest > V{} ? d[i] * inverse_largest : one;
  const V inverse = one / Lanes<V>::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  Direction<V> out;
  for (int i = 0; i < 3; ++i) out.unit[i] = d[i] * inverse;
  out.inverse_length = inverse * inverse_largest;
  return out;
}

// grad_d = (I - u u^T) grad_u / |d|; both grad_point and grad_viewmat are added to.
template <typename V, typename S>
GSIM3D_HD void view_direction_vjp(const Camera<S>& camera, const V point[3], const Direction<V>& out, const V grad[3],
                                  V grad_point[3], V grad_viewmat[12]) {
  const S* w = camera.rotation;
  const V along = grad[0] * out.unit[0] + grad[1] * out.unit[1] + grad[2] * out.unit[2];
  for (int i = 0; i < 3; ++i) {
    const V g = (grad[i] - out.unit[i] * along) * out.inverse_length;
    for (int j = 0; j < 3; ++j) {
      grad_point[j] += w[3 * j + i] * g;
      grad_viewmat[4 * j + i] += point[j] * g;
    }
  }
}

// ---- colour of real spherical harmonics, standard 3DGS basis and order, kTerms = 1, 4, 9, 16 or 25-----------------

template <int kTerms, typename V>
GSIM3D_HD void sh_basis(const V d[3], V basis[kTerms]) {
  using S = ScalarOf<V>;
  basis[0] = Lanes<V>::splat(S(0.28209479177387814));
  if constexpr (kTerms >= 4) {
    const S c = S(0.4886025119029199);
    basis[1] = -c * d[1], basis[2] = c * d[2], basis[3] = -c * d[0];
  }
  if constexpr (kTerms >= 9) {
    const V x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
    const S c = S(1.0925484305920792), two = 2;
    basis[4] = c * x * y, basis[5] = -c * y * z;
    basis[6] = S(0.31539156525252005) * (two * zz - xx - yy);
    basis[7] = -c * x * z, basis[8] = S(0.5462742152960396) * (xx - yy);
    if constexpr (kTerms >= 16) {
      const S three = 3, four = 4, c3 = S(0.5900435899266435), c1 = S(0.4570457994644658);
      basis[9] = -c3 * y * (three * xx - yy), basis[10] = S(2.890611442640554) * x * y * z;
      basis[11] = -c1 * y * (four * zz - xx - yy);
      basis[12] = S(0.3731763325901154) * z * (two * zz - three * xx - three * yy);
      basis[13] = -c1 * x * (four * zz - xx - yy), basis[14] = S(1.445305721320277) * z * (xx - yy);
      basis[15] = -c3 * x * (xx - three * yy);
    }
    if constexpr (kTerms >= 25) {
      const S one = 1, three = 3, six = 6, seven = 7;
      const S c1 = S(1.7701307697799304), c3 = S(0.6690465435572892), square = S(0.47308734787878004);
      basis[16] = S(2.5033429417967046) * x * y * (xx - yy), basis[17] = -c1 * y * z * (three * xx - yy);
      basis[18] = two * square * x * y * (seven * zz - one), basis[19] = -c3 * y * z * (seven * zz - three);
      basis[20] = S(0.10578554691520431) * (zz * (S(35) * zz - S(30)) + three);
      basis[21] = -c3 * x * z * (seven * zz - three), basis[22] = square * (xx - yy) * (seven * zz - one);
      basis[23] = -c1 * x * z * (xx - three * yy);
      basis[24] = S(0.6258357354491761) * (xx * (xx - six * yy) + yy * yy);
    }
  }
}

// grad_d = (d basis / d d)^T grad_basis
template <int kTerms, typename V>
GSIM3D_HD void sh_basis_vjp(const V d[3], const V g[kTerms], V grad_d[3]) {
  using S = ScalarOf<V>;
  V gx = V{}, gy = V{}, gz = V{};
  if constexpr (kTerms >= 4) {
    const S c = S(0.4886025119029199);
    gx -= c * g[3], gy -= c * g[1], gz += c * g[2];
  }
  if constexpr (kTerms >= 9) {
    const V x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
    const S c = S(1.0925484305920792), c0 = S(2 * 0.31539156525252005), c2 = S(2 * 0.5462742152960396), two = 2;
    gx += c * (y * g[4] - z * g[7]) - c0 * x * g[6] + c2 * x * g[8];
    gy += c * (x * g[4] - z * g[5]) - c0 * y * g[6] - c2 * y * g[8];
    gz += two * c0 * z * g[6] - c * (y * g[5] + x * g[7]);
    if constexpr (kTerms >= 16) {
      const S three = 3, four = 4, six = 6, eight = 8;
      const S c3 = S(0.5900435899266435), c1 = S(0.4570457994644658), c4 = S(0.3731763325901154);
      const S c5 = S(2.890611442640554), c6 = S(1.445305721320277);
      const V rim = four * zz - xx - yy, cross = two * x * y, square = three * (xx - yy);
      gx += -c3 * (three * cross * g[9] + square * g[15]) + c5 * y * z * g[10] + c1 * cross * g[11];
      gx += -c4 * six * x * z * g[12] - c1 * (rim - two * xx) * g[13] + c6 * two * x * z * g[14];
      gy += -c3 * (square * g[9] - three * cross * g[15]) + c5 * x * z * g[10] - c1 * (rim - two * yy) * g[11];
      gy += -c4 * six * y * z * g[12] + c1 * cross * g[13] - c6 * two * y * z * g[14];
      gz += c5 * x * y * g[10] - c1 * eight * z * (y * g[11] + x * g[13]);
      gz += c4 * three * (two * zz - xx - yy) * g[12] + c6 * (xx - yy) * g[14];
    }
    if constexpr (kTerms >= 25) {
      const S one = 1, three = 3, four = 4, six = 6, seven = 7, twelve = 12;
      const S c0 = S(2.5033429417967046), c1 = S(1.7701307697799304), c3 = S(0.6690465435572892);
      const S square = S(0.47308734787878004), c8 = S(0.6258357354491761);
      const V belt = seven * zz - one, rim = seven * zz - three, end = S(21) * zz - three, xyz = x * y * z;
      gx += c0 * y * (three * xx - yy) * g[16] - six * c1 * xyz * g[17] + two * square * y * belt * g[18];
      gx += -c3 * z * rim * g[21] + two * square * x * belt * g[22] - three * c1 * z * (xx - yy) * g[23];
      gx += c8 * x * (four * xx - twelve * yy) * g[24];
      gy += c0 * x * (xx - three * yy) * g[16] - three * c1 * z * (xx - yy) * g[17] + two * square * x * belt * g[18];
      gy += -c3 * z * rim * g[19] - two * square * y * belt * g[22] + six * c1 * xyz * g[23];
      gy += c8 * y * (four * yy - twelve * xx) * g[24];
      gz += -c1 * y * (three * xx - yy) * g[17] + S(28) * square * xyz * g[18] - c3 * y * end * g[19];
      gz += S(0.10578554691520431) * z * (S(140) * zz - S(60)) * g[20] - c3 * x * end * g[21];
      gz += S(14) * square * z * (xx - yy) * g[22] - c1 * x * (xx - three * yy) * g[23];
    }
  }
  grad_d[0] = gx, grad_d[1] = gy, grad_d[2] = gz;
}

// color[c] = max(0, 0.5 + sum_k basis_k coefficients[k, c])
template <int kTerms, typename V>
GSIM3D_HD void sh_color(const V basis[kTerms], const V coefficients[kTerms * 3], V color[3]) {
  using S = ScalarOf<V>;
  for (int c = 0; c < 3; ++c) {
    V sum = Lanes<V>::splat(S(0.5));
    for (int k = 0; k < kTerms; ++k) sum += basis[k] * coefficients[3 * k + c];
    color[c] = max_of(sum, V{});
  }
}

// No gradient passes where the colour was clamped. `color` is the result of sh_color.
template <int kTerms, typename V>
GSIM3D_HD void sh_color_vjp(const V basis[kTerms], const V coefficients[kTerms * 3], const V color[3], const V grad[3],
                            V grad_basis[kTerms], V grad_coefficients[kTerms * 3]) {
  V g[3];
  for (int c = 0; c < 3; ++c) g[c] = color[c] > V{} ? grad[c] : V{};
  for (int k = 0; k < kTerms; ++k) {
    grad_basis[k] = V{};
    for (int c = 0; c < 3; ++c) {
      grad_basis[k] += g[c] * coefficients[3 * k + c];
      grad_coefficients[3 * k + c] = g[c] * basis[k];
    }
  }
}

// ---- the footprint in the image -----------------------------------------------------------------------------------

// d^T Sigma^-1 d = tight (dx - slope dy)^2 + loose dy^2: a sum of squares, so needles lose no digits.
template <typename V>
struct Footprint {
  V slope, tight, loose;
};

template <typename V>
GSIM3D_HD Footprint<V> footprint_of(V xy, V yy, V determinant) {
  const V loose = Lanes<V>::splat(1) / yy;
  return {xy * loose, yy / determinant, loose};
}

// Sums over pixels of the gradient v of the exponent -d^T Sigma^-1 d / 2, with u = dx - slope dy.
template <typename V>
struct Moments {
  V u, y, uu, uy, yy;
};

// With e = Sigma^-1 d = (tight u, loose dy - slope tight u): grad_mean = sum v e, grad_Sigma = sum v e e^T / 2.
template <typename V>
GSIM3D_HD void footprint_vjp(const Footprint<V>& shape, const Moments<V>& sums, ProjectionGrad<V>& grad) {
  using S = ScalarOf<V>;
  const S half = S(0.5);
  const V a = shape.tight, b = shape.loose, c = shape.slope * shape.tight;
  grad.x = a * sums.u;
  grad.y = b * sums.y - c * sums.u;
  grad.xx = half * a * a * sums.uu;
  grad.xy = a * b * sums.uy - a * c * sums.uu;
  grad.yy = half * (b * b * sums.yy + c * c * sums.uu) - b * c * sums.uy;
}

// ---- a Gaussian that is projected already: its conic (a, b, c) is Sigma^-1; T is a scalar ---------------------------

// Of needles the difference cancels: its products are exact in double.
template <typename T>
GSIM3D_HD T conic_determinant(T a, T b, T c) {
  return static_cast<T>(static_cast<double>(a) * c - static_cast<double>(b) * b);
}

template <typename T>
GSIM3D_HD bool conic_is_good(T a, T b, T c) {
  return usable(a) && usable(b) && usable(c) && a > T(0) && conic_determinant(a, b, c) > T(0);
}

template <typename T>
GSIM3D_HD Footprint<T> footprint_of_conic(T a, T b, T c) {
  return {-b / a, a, conic_determinant(a, b, c) / a};
}

template <typename T>
struct Covariance {
  T xx, yy, determinant;
};

template <typename T>
GSIM3D_HD Covariance<T> covariance_of_conic(T a, T b, T c) {
  const T inverse = T(1) / conic_determinant(a, b, c);
  return {c * inverse, a * inverse, inverse};
}

// The exponent is -(a dx^2 + 2 b dx dy + c dy^2) / 2, dx = u + slope dy, and (dx, dy) falls with the mean.
template <typename V>
GSIM3D_HD void conic_vjp(const Footprint<V>& shape, const Moments<V>& sums, V grad_mean[2], V grad_conic[3]) {
  using S = ScalarOf<V>;
  const V a = shape.tight, b = shape.loose, c = shape.slope * shape.tight, slope = shape.slope;
  grad_mean[0] = a * sums.u;
  grad_mean[1] = b * sums.y - c * sums.u;
  grad_conic[0] = S(-0.5) * (sums.uu + slope * (S(2) * sums.uy + slope * sums.yy));
  grad_conic[1] = -(sums.uy + slope * sums.yy);
  grad_conic[2] = S(-0.5) * sums.yy;
}

// ---- pixels that may see a Gaussian; V is a scalar here -------------------------------------------------------------

// Rounding of the exponent and of pixel coordinates, with room to spare: a bound may only err outwards.
constexpr double kLevelSlack = 1e-3;
constexpr double kPixelSlack = 0.01;
constexpr double kLog2eHalf = 0.72134752044448170;  // alpha = opacity 2^(-kLog2eHalf d^T Sigma^-1 d)

// [x0, x1) x [y0, y1)
struct alignas(8) PixelRect {
  uint16_t x0 = 0, x1 = 0, y0 = 0, y1 = 0;
};

// The exponent of 2 beyond which alpha < 1/255.
template <typename T>
GSIM3D_HD T level_of(T opacity) {
  return std::log2(opacity * T(1 / kMinAlpha)) + T(kLevelSlack);
}

// For bounds that err outwards by more than its error.
template <typename T>
GSIM3D_HD T rough_sqrt(T value) {
  return std::sqrt(value);
}
template <>
GSIM3D_HD float rough_sqrt(float value) {
#ifdef __CUDA_ARCH__
  asm("sqrt.approx.ftz.f32 %0, %0;" : "+f"(value));
  return value;
#else
  return std::sqrt(value);
#endif
}

// First and last + 1 pixel whose centre lies in [low, high], within [0, size).
template <typename T>
GSIM3D_HD void pixel_range(T low, T high, int64_t size, uint16_t& begin, uint16_t& end) {
  const T first = std::ceil(low - T(0.5) - T(kPixelSlack)), last = std::floor(high - T(0.5) + T(kPixelSlack));
  begin = first > 0 ? static_cast<uint16_t>(min_of(first, T(size))) : 0;
  end = last >= 0 ? static_cast<uint16_t>(min_of(last + 1, T(size))) : 0;
}

// The release's range of tiles around a centre, as a cut of the pixel range. Its coordinates count from the centre of
// the first pixel.
template <typename T>
GSIM3D_HD void cut_to_tiles(T centre, T radius, uint16_t& begin, uint16_t& end) {
  const T position = centre - T(0.5);
  const T first = max_of(std::trunc((position - radius) / kTile), T(0)) * kTile;
  const T last = max_of(std::trunc((position + radius + (kTile - 1)) / kTile), T(0)) * kTile;
  begin = static_cast<uint16_t>(max_of(min_of(first, T(end)), T(begin)));
  end = static_cast<uint16_t>(min_of(last, T(end)));
}

// Bounds of the ellipse of `level` around (x, y) with covariance (xx, yy), within width x height; `three_sigma` also
// cuts it to the tiles of RasterCutoff::kTile3Sigma.
template <typename T>
GSIM3D_HD PixelRect pixel_bounds(T x, T y, T xx, T yy, T determinant, T level, int64_t width, int64_t height,
                                 bool three_sigma) {
  PixelRect rect;
  const T spread = level * T(1 / kLog2eHalf);
  const T reach_x = rough_sqrt(spread * xx), reach_y = rough_sqrt(spread * yy);
  pixel_range(x - reach_x, x + reach_x, width, rect.x0, rect.x1);
  pixel_range(y - reach_y, y + reach_y, height, rect.y0, rect.y1);
  if (three_sigma) {
    const T middle = T(0.5) * (xx + yy);
    const T largest = middle + std::sqrt(max_of(middle * middle - determinant, T(0.1)));
    const T radius = std::ceil(3 * std::sqrt(largest));
    cut_to_tiles(x, radius, rect.x0, rect.x1);
    cut_to_tiles(y, radius, rect.y0, rect.y1);
  }
  return rect.x0 < rect.x1 && rect.y0 < rect.y1 ? rect : PixelRect{};
}

// ---- opacity of one Gaussian at one pixel -------------------------------------------------------------------------

// alpha of RasterCutoff::kSmooth: 0 below kMinAlpha, untouched above twice that, a cubic step between.
template <typename V>
GSIM3D_HD V fade(V alpha) {
  using S = ScalarOf<V>;
  const V t = min_of(max_of(alpha * S(1 / kMinAlpha) - S(1), V{}), Lanes<V>::splat(1));
  return alpha * t * t * (S(3) - S(2) * t);
}

// d fade / d alpha
template <typename V>
GSIM3D_HD V fade_slope(V alpha) {
  using S = ScalarOf<V>;
  const V t = min_of(max_of(alpha * S(1 / kMinAlpha) - S(1), V{}), Lanes<V>::splat(1));
  return t * t * (S(3) - S(2) * t) + alpha * S(1 / kMinAlpha) * S(6) * t * (S(1) - t);
}

}  // namespace gsim3d::raster
