// One row of decode.h, for host and device, with its gradient.
//
// Harmonics of degree l turn by "Y(R n)^T Y(n)^-T c": read the colour on 2 l + 1 directions n, write it back from the
// turned ones. This is exact for every rotation R, and smooth.
#pragma once

#include <cmath>

#include "gsim3d/core/platform.h"
#include "gsim3d/raster/raster_math.h"

namespace gsim3d {

template <int kLevel, typename S>
struct Level {
  static constexpr int kSize = 2 * kLevel + 1, kFirst = kLevel * kLevel, kTerms = (kLevel + 1) * (kLevel + 1);
  static constexpr int kOffset = kLevel == 1 ? 0 : kLevel == 2 ? 18 : 58;
  // Colour starts almost independent of the view.
  static constexpr S kDamping = kLevel == 1 ? S(0.025) : kLevel == 2 ? S(0.00625) : S(0.0015625);
  const S *directions, *read;

  GSIM3D_HD explicit Level(const S* readings)
      : directions(readings + kOffset), read(readings + kOffset + 3 * kSize) {}

  // Direction i, turned by r.
  GSIM3D_HD void turned(int i, const S r[9], S d[3]) const {
    for (int a = 0; a < 3; ++a) {
      d[a] = S(0);
      for (int b = 0; b < 3; ++b) d[a] += r[3 * a + b] * directions[3 * i + b];
    }
  }
  // Colour c of a row on direction i, before the turn.
  GSIM3D_HD S value(int i, int c, const S* raw, int terms) const {
    S sum = S(0);
    for (int j = 0; j < kSize; ++j) sum += read[i * kSize + j] * raw[c * terms + kFirst + j];
    return kDamping * sum;
  }
};

template <int kLevel, typename S>
GSIM3D_HD void turn_level(const S* raw, int terms, const S* readings, const S r[9], S* sh) {
  using L = Level<kLevel, S>;
  const L level(readings);
  S sums[3 * L::kSize] = {};
  for (int i = 0; i < L::kSize; ++i) {
    S d[3], basis[L::kTerms];
    level.turned(i, r, d);
    raster::sh_basis<L::kTerms>(d, basis);
    for (int c = 0; c < 3; ++c) {
      const S value = level.value(i, c, raw, terms);
      for (int k = 0; k < L::kSize; ++k) sums[3 * k + c] += basis[L::kFirst + k] * value;
    }
  }
  for (int m = 0; m < 3 * L::kSize; ++m) sh[3 * L::kFirst + m] = sums[m];
}

// grad_raw may be raw: a degree is read before it is written.
template <int kLevel, typename S>
GSIM3D_HD void turn_level_vjp(const S* raw, int terms, const S* readings, const S r[9], const S* grad_sh, S* grad_raw,
                              S grad_r[9]) {
  using L = Level<kLevel, S>;
  const L level(readings);
  const S* g = grad_sh + 3 * L::kFirst;
  S sums[3 * L::kSize] = {};
  for (int i = 0; i < L::kSize; ++i) {
    S d[3], basis[L::kTerms], grad_basis[L::kTerms] = {}, grad_d[3];
    level.turned(i, r, d);
    raster::sh_basis<L::kTerms>(d, basis);
    for (int c = 0; c < 3; ++c) {
      const S value = level.value(i, c, raw, terms);
      S grad_value = S(0);
      for (int k = 0; k < L::kSize; ++k) {
        grad_value += basis[L::kFirst + k] * g[3 * k + c];
        grad_basis[L::kFirst + k] += value * g[3 * k + c];
      }
      for (int j = 0; j < L::kSize; ++j) sums[c * L::kSize + j] += level.read[i * L::kSize + j] * grad_value;
    }
    raster::sh_basis_vjp<L::kTerms>(d, grad_basis, grad_d);
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) grad_r[3 * a + b] += grad_d[a] * level.directions[3 * i + b];
  }
  for (int c = 0; c < 3; ++c)
    for (int j = 0; j < L::kSize; ++j)
      grad_raw[c * terms + L::kFirst + j] = L::kDamping * sums[c * L::kSize + j];
}

template <typename S>
GSIM3D_HD S sigmoid(S x) {
  return S(1) / (S(1) + std::exp(-x));
}

// The rotation of a row, whose last seven columns are (x, y, z, w) and the scales.
template <typename S>
GSIM3D_HD raster::Rotation<S> rotation_of_row(const S* raw, int terms) {
  const S* q = raw + 3 * terms;
  const S quat[4] = {q[3], q[0], q[1], q[2]};
  return raster::rotation_of(quat);
}

template <int kDegree, typename S>
GSIM3D_HD void decode_row(const S* raw, int terms, const S* readings, S scale_min, S scale_max, S* quat, S* scale,
                          S* sh) {
  const raster::Rotation<S> rotation = rotation_of_row(raw, terms);
  for (int i = 0; i < 4; ++i) quat[i] = rotation.unit[i];
  for (int i = 0; i < 3; ++i) scale[i] = scale_min + (scale_max - scale_min) * sigmoid(raw[3 * terms + 4 + i]);
  if constexpr (kDegree >= 0)
    for (int c = 0; c < 3; ++c) sh[c] = raw[c * terms];
  if constexpr (kDegree >= 1) turn_level<1>(raw, terms, readings, rotation.r, sh);
  if constexpr (kDegree >= 2) turn_level<2>(raw, terms, readings, rotation.r, sh);
  if constexpr (kDegree >= 3) turn_level<3>(raw, terms, readings, rotation.r, sh);
}

// The gradient takes the place of the row.
template <int kDegree, typename S>
GSIM3D_HD void decode_row_vjp(S* raw, int terms, const S* readings, S scale_min, S scale_max, const S* grad_quat,
                              const S* grad_scale, const S* grad_sh) {
  const raster::Rotation<S> rotation = rotation_of_row(raw, terms);
  S grad_r[9] = {}, by_rotation[4];
  if constexpr (kDegree >= 1) turn_level_vjp<1>(raw, terms, readings, rotation.r, grad_sh, raw, grad_r);
  if constexpr (kDegree >= 2) turn_level_vjp<2>(raw, terms, readings, rotation.r, grad_sh, raw, grad_r);
  if constexpr (kDegree >= 3) turn_level_vjp<3>(raw, terms, readings, rotation.r, grad_sh, raw, grad_r);
  constexpr int kKept = (kDegree + 1) * (kDegree + 1);
  for (int c = 0; c < 3; ++c) {
    if constexpr (kDegree >= 0) raw[c * terms] = grad_sh[c];
    for (int k = kKept; k < terms; ++k) raw[c * terms + k] = S(0);
  }
  raster::rotation_of_vjp(rotation, grad_r, by_rotation);
  S along = S(0);
  for (int i = 0; i < 4; ++i) along += rotation.unit[i] * grad_quat[i];
  S* q = raw + 3 * terms;
  for (int i = 0; i < 4; ++i)
    q[(i + 3) % 4] = by_rotation[i] + (grad_quat[i] - rotation.unit[i] * along) * rotation.inverse_norm;
  for (int i = 0; i < 3; ++i) {
    const S s = sigmoid(q[4 + i]);
    q[4 + i] = grad_scale[i] * (scale_max - scale_min) * s * (S(1) - s);
  }
}

// Calls f.template operator()<kDegree>() for a degree of -1 to 3.
template <typename F>
void with_degree(int degree, const F& f) {
  switch (degree) {
    case -1: return f.template operator()<-1>();
    case 0: return f.template operator()<0>();
    case 1: return f.template operator()<1>();
    case 2: return f.template operator()<2>();
    default: return f.template operator()<3>();
  }
}

}  // namespace gsim3d
