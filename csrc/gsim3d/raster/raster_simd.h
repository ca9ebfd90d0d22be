// Vectors of one 256-bit register for the CPU kernels: Simd<float> has 8 lanes, Simd<double> 4.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <initializer_list>

#if defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#endif

#include "gsim3d/raster/raster_math.h"

namespace gsim3d::raster {

typedef float Float8 __attribute__((vector_size(32)));
typedef double Double4 __attribute__((vector_size(32)));
typedef int32_t Int8 __attribute__((vector_size(32)));
typedef int64_t Long4 __attribute__((vector_size(32)));

template <typename T>
struct SimdOf;
template <>
struct SimdOf<float> {
  using Vector = Float8;
  using Mask = Int8;
  using Int = int32_t;
};
template <>
struct SimdOf<double> {
  using Vector = Double4;
  using Mask = Long4;
  using Int = int64_t;
};
template <typename T>
using Simd = typename SimdOf<T>::Vector;
template <typename T>
using SimdMask = typename SimdOf<T>::Mask;
// As wide as T, so that a mask of one selects the other.
template <typename T>
using IntOf = typename SimdOf<T>::Int;
template <typename T>
constexpr int kLanes = 32 / sizeof(T);

template <typename V, typename S>
V load(const S* from) {
  V value;
  std::memcpy(&value, from, sizeof(V));
  return value;
}
template <typename V, typename S>
void store(S* to, V value) {
  std::memcpy(to, &value, sizeof(V));
}

template <>
struct Lanes<Float8> {
  using Scalar = float;
  static constexpr int kCount = 8;
  static Float8 splat(float s) { return Float8{} + s; }
#if defined(__AVX2__) && defined(__FMA__)
  static Float8 sqrt(Float8 v) { return (Float8)_mm256_sqrt_ps((__m256)v); }
#else
  static Float8 sqrt(Float8 v) {
    for (int i = 0; i < 8; ++i) v[i] = std::sqrt(v[i]);
    return v;
  }
#endif
};

template <>
struct Lanes<Double4> {
  using Scalar = double;
  static constexpr int kCount = 4;
  static Double4 splat(double s) { return Double4{} + s; }
#if defined(__AVX2__) && defined(__FMA__)
  static Double4 sqrt(Double4 v) { return (Double4)_mm256_sqrt_pd((__m256d)v); }
#else
  static Double4 sqrt(Double4 v) {
    for (int i = 0; i < 4; ++i) v[i] = std::sqrt(v[i]);
    return v;
  }
#endif
};

#if defined(__AVX2__) && defined(__FMA__)
inline Float8 fma(Float8 a, Float8 b, Float8 c) { return (Float8)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
inline Double4 fma(Double4 a, Double4 b, Double4 c) {
  return (Double4)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
}
inline bool any(Int8 mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
inline bool any(Long4 mask) { return _mm256_movemask_pd((__m256d)mask) != 0; }
#else
template <typename V>
V fma(V a, V b, V c) {
  for (int i = 0; i < Lanes<V>::kCount; ++i) a[i] = std::fma(a[i], b[i], c[i]);
  return a;
}
template <typename M>
bool any(M mask) {
  for (size_t i = 0; i < sizeof(M) / sizeof(mask[0]); ++i)
    if (mask[i]) return true;
  return false;
}
#endif

// Sum over lanes in the fixed order of halves.
inline float sum_lanes(Float8 v) {
#if defined(__AVX2__) && defined(__FMA__)
  const __m128 four = _mm_add_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
  const __m128 two = _mm_add_ps(four, _mm_movehl_ps(four, four));
  return _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)));
#else
  const float a = v[0] + v[4], b = v[1] + v[5], c = v[2] + v[6], d = v[3] + v[7];
  return (a + c) + (b + d);
#endif
}
inline double sum_lanes(Double4 v) { return (v[0] + v[2]) + (v[1] + v[3]); }

// 2^x for x <= 0, to the last bit but one; below -126 it stays at 2^-126. x = n + f with n the nearest integer: 2^f
// is a polynomial, and n goes into the exponent bits. Adding 1.5 * 2^(mantissa bits) rounds to n and leaves it in the
// low bits.
inline Float8 exp2_of(Float8 x) {
  const Float8 low = Lanes<Float8>::splat(-126.0f);
  x = x < low ? low : x;
  const Float8 shifted = x + 12582912.0f;
  const Float8 f = x - (shifted - 12582912.0f);
  Float8 p = Lanes<Float8>::splat(0.00015345809f);
  for (const float c : {0.0013399931f, 0.009618489f, 0.055503288f, 0.24022647f, 0.6931472f, 1.0f})
    p = fma(p, f, Lanes<Float8>::splat(c));
  return (Float8)((Int8)p + ((Int8)shifted << 23));
}
// Taylor coefficients ln(2)^k / k!; the rest is below 2e-16 for |f| <= 1/2.
inline Double4 exp2_of(Double4 x) {
  const Double4 low = Lanes<Double4>::splat(-1022.0);
  x = x < low ? low : x;
  const Double4 shifted = x + 6755399441055744.0;
  const Double4 f = x - (shifted - 6755399441055744.0);
  Double4 p = Lanes<Double4>::splat(2.5678435993488196e-11);
  for (const double c : {4.44553827187081e-10, 7.054911620801121e-09, 1.0178086009239696e-07, 1.3215486790144305e-06,
                         1.5252733804059838e-05, 0.00015403530393381606, 0.0013333558146428441, 0.009618129107628477,
                         0.055504108664821576, 0.2402265069591007, 0.6931471805599453, 1.0})
    p = fma(p, f, Lanes<Double4>::splat(c));
  return (Double4)((Long4)p + ((Long4)shifted << 52));
}

}  // namespace gsim3d::raster
