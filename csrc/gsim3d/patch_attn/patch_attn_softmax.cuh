// Softmax weights on C tiles of the tensor cores, in float32.
#pragma once

#include <cfloat>

#include "gsim3d/patch_attn/patch_attn_mma.cuh"

namespace gsim3d::cuda {

// Shifts this large leave 2^(slope s + shift) with a relative error of 2e-4; beyond, weights are found by differences.
constexpr float kLargestShift = 4096.0f;
// Of eight weights of a lane, so many are found by a polynomial: the special function unit is the bottleneck, and the
// multipliers are idle beside it.
constexpr int kByPolynomial = 0;

// 2^(slope s + shift).
class FastWeights {
 public:
  __device__ __forceinline__ explicit FastWeights(float slope) : slope_(slope), slope_by_span_(slope / kSpan) {}

  __device__ __forceinline__ float slope() const { return slope_; }

  struct Shift {
    float shift, shift_by_span;
  };
  __device__ __forceinline__ static Shift prepare(float shift) {
    return {shift, fmaf(shift, 1 / kSpan, -kLowest / kSpan)};
  }

  // The weight of number i of a lane's eight.
  __device__ __forceinline__ float at(int i, float s, const Shift& shift) const {
    return i * kByPolynomial % 8 < kByPolynomial ? by_polynomial(s, shift) : by_unit(s, shift);
  }

 private:
  __device__ __forceinline__ float by_unit(float s, const Shift& shift) const {
    return exp2_unit(fmaf(s, slope_, shift.shift));
  }
  // Relative error 1e-4, far below the rounding to 16 bits that follows. A NaN becomes 0.
  __device__ __forceinline__ float by_polynomial(float s, const Shift& shift) const {
    const float y = __saturatef(fmaf(s, slope_by_span_, shift.shift_by_span));
    const float whole = fmaf(y, kSpan, kRound + kLowest);
    const float f = fmaf(y, kSpan, kRound + kLowest - whole);
    const float p = fmaf(fmaf(fmaf(0.0551716685f, f, 0.2426111251f), f, 0.6932609678f), f,
                         0.9999280572f);
    return __int_as_float(__float_as_int(p) + (__float_as_int(whole) << 23));
  }

  // The polynomial takes slope s + shift in [kLowest, 128]: one fma saturates it to [0, 1].
  static constexpr float kLowest = -126.0f, kSpan = 254.0f;
  // Adding it rounds to a whole number n and leaves n in the lowest bits.
  static constexpr float kRound = 12582912.0f;

  float slope_, slope_by_span_;
};

// 2^(slope (s - reference) + shift), at most 1: exact where s is the reference, however large both are.
__device__ __forceinline__ float careful_weight(float s, float reference, float slope, float shift) {
  const float x = fmaf(s - reference, slope, shift);
  return exp2_unit(x > 0 ? 0.0f : x);
}

__device__ __forceinline__ void clear(float (&x)[4]) {
#pragma unroll
  for (float& value : x) value = 0;
}
template <typename Tile, int n>
__device__ __forceinline__ void clear(Tile (&x)[n]) {
#pragma unroll
  for (Tile& tile : x) clear(tile);
}

// One A tile from two C tiles side by side.
template <typename T, bool kFinite = false>
__device__ __forceinline__ void pack_tile(const float (&c)[2][4], uint32_t (&a)[4]) {
  a[0] = pack<T, kFinite>(c[0][0], c[0][1]);
  a[1] = pack<T, kFinite>(c[0][2], c[0][3]);
  a[2] = pack<T, kFinite>(c[1][0], c[1][1]);
  a[3] = pack<T, kFinite>(c[1][2], c[1][3]);
}

}  // namespace gsim3d::cuda
