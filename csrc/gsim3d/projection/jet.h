// Numbers that carry their derivatives along kN directions; nested, they carry second derivatives.
#pragma once

#include <cmath>
#include <type_traits>

#include "gsim3d/core/platform.h"

namespace gsim3d::projection {

template <typename V, int kN>
struct Jet {
  V value;
  V along[kN];

  Jet() = default;
  GSIM3D_HD Jet(V constant) : value(constant) {
    for (int i = 0; i < kN; ++i) along[i] = V(0);
  }
  template <typename Number>
    requires(std::is_arithmetic_v<Number> && !std::is_same_v<Number, V>)
  GSIM3D_HD Jet(Number constant) : Jet(V(constant)) {}

  GSIM3D_HD friend Jet operator+(const Jet& a, const Jet& b) {
    Jet out;
    out.value = a.value + b.value;
    for (int i = 0; i < kN; ++i) out.along[i] = a.along[i] + b.along[i];
    return out;
  }
  GSIM3D_HD friend Jet operator-(const Jet& a, const Jet& b) {
    Jet out;
    out.value = a.value - b.value;
    for (int i = 0; i < kN; ++i) out.along[i] = a.along[i] - b.along[i];
    return out;
  }
  GSIM3D_HD friend Jet operator*(const Jet& a, const Jet& b) {
    Jet out;
    out.value = a.value * b.value;
    for (int i = 0; i < kN; ++i) out.along[i] = a.value * b.along[i] + a.along[i] * b.value;
    return out;
  }
  GSIM3D_HD friend Jet operator/(const Jet& a, const Jet& b) {
    Jet out;
    const V inverse = V(1) / b.value;
    out.value = a.value * inverse;
    for (int i = 0; i < kN; ++i) out.along[i] = (a.along[i] - out.value * b.along[i]) * inverse;
    return out;
  }
  GSIM3D_HD friend Jet operator-(const Jet& a) { return Jet(V(0)) - a; }
  GSIM3D_HD friend Jet& operator+=(Jet& a, const Jet& b) { return a = a + b; }
  GSIM3D_HD friend Jet& operator-=(Jet& a, const Jet& b) { return a = a - b; }
  GSIM3D_HD friend bool operator<(const Jet& a, const Jet& b) { return a.value < b.value; }
  GSIM3D_HD friend bool operator>(const Jet& a, const Jet& b) { return a.value > b.value; }
  GSIM3D_HD friend bool operator==(const Jet& a, const Jet& b) { return a.value == b.value; }
  // Of a constant.
  GSIM3D_HD friend Jet operator+(const Jet& a, const V& b) {
    Jet out = a;
    out.value = a.value + b;
    return out;
  }
  GSIM3D_HD friend Jet operator*(const Jet& a, const V& b) {
    Jet out;
    out.value = a.value * b;
    for (int i = 0; i < kN; ++i) out.along[i] = a.along[i] * b;
    return out;
  }
};

// The plain number within.
template <typename S>
GSIM3D_HD S plain(S x) {
  return x;
}
template <typename V, int kN>
GSIM3D_HD auto plain(const Jet<V, kN>& x) {
  return plain(x.value);
}

template <typename S>
GSIM3D_HD S root(S x) {
  return std::sqrt(x);
}
template <typename V, int kN>
GSIM3D_HD Jet<V, kN> root(const Jet<V, kN>& x) {
  Jet<V, kN> out;
  out.value = root(x.value);
  const V slope = V(0.5) / out.value;
  for (int i = 0; i < kN; ++i) out.along[i] = x.along[i] * slope;
  return out;
}

// The angle of (x, y), y above 0.
template <typename S>
GSIM3D_HD S angle(S y, S x) {
  return std::atan2(y, x);
}
template <typename V, int kN>
GSIM3D_HD Jet<V, kN> angle(const Jet<V, kN>& y, const Jet<V, kN>& x) {
  Jet<V, kN> out;
  out.value = angle(y.value, x.value);
  const V inverse = V(1) / (x.value * x.value + y.value * y.value);
  for (int i = 0; i < kN; ++i) out.along[i] = (x.value * y.along[i] - y.value * x.along[i]) * inverse;
  return out;
}

}  // namespace gsim3d::projection
