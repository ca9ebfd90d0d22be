// The numbers of patch attention that every backend shares: softmax weights relative to a running maximum.
#pragma once

#include <cstdint>
#include <limits>

#include "gsim3d/core/platform.h"

namespace gsim3d::patch_attn {

// 2^x for x <= 0: x = n + f with n whole and |f| <= 1/2, 2^f = 1 + f P(f), times 2^n made in the exponent bits.
// P is a minimax fit of the relative error; 2^0 is exactly 1. Where n reaches -kBias the result is exactly 0.
template <typename T>
struct Exp2;

template <>
struct Exp2<float> {
  static constexpr int kMantissaBits = 23, kBias = 127, kTerms = 6;
  // Adding it rounds to a whole number and leaves n + kBias in the lowest bits.
  static constexpr float kRound = 12582912.0f + kBias;
  // Relative error 2.0e-9; one term less would cost 9.2e-8, as much as all roundings together.
  static constexpr float kP[kTerms] = {0.693147202983955262f,    0.240226478969567586f,   0.0555033216695662118f,
                                       0.00961843859440120604f, 0.00133990014468391268f, 0.000153532568258110549f};
};

template <>
struct Exp2<double> {
  static constexpr int kMantissaBits = 52, kBias = 1023, kTerms = 11;
  static constexpr double kRound = 6755399441055744.0 + kBias;
  // Relative error 3.4e-18.
  static constexpr double kP[kTerms] = {
      0.693147180559945326,    0.240226506959101319,    0.0555041086648200678,   0.00961812910759384367,
      0.00133335581467774865,  0.000154035304574938627, 1.52527334911744019e-5,  1.32154350775773718e-6,
      1.01782000631947001e-7,  7.07382063264808164e-9,  4.43474380802215952e-10};
};

// The softmax weight of a logit is exp(scale (s - largest)) = 2^(slope (s - largest)), at most 1.
template <typename T>
struct Softmax {
  T sign;    // queries are multiplied by it, so that the largest logit is the largest dot product for any scale
  T slope;   // |scale| log2(e)
  T lowest;  // differences below it give weight 0

  static constexpr T kLowestNumber = std::numeric_limits<T>::lowest();

  GSIM3D_HD explicit Softmax(double scale)
      : sign(scale < 0 ? T(-1) : T(1)),
        slope(static_cast<T>((scale < 0 ? -scale : scale) * 1.4426950408889634074)),
        lowest(slope > T(0) ? -T(Exp2<T>::kBias) / slope : kLowestNumber) {}
};

}  // namespace gsim3d::patch_attn
