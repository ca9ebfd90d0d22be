// Softmax weights on C tiles of the tensor cores, in float32.
#pragma once

#include <cfloat>

#include "gsim3d/patch_attn/patch_attn_mma.cuh"

namespace gsim3d::cuda {

// Shifts this large leave 2^(slope s + shift) with a relative error of 2e-4; beyond, weights are found by differences.
constexpr float kLargestShift = 4096.0f;

__device__ __forceinline__ float fast_weight(float s, float slope, float shift) {
  return exp2_unit(fmaf(s, slope, shift));
}

// 2^(252 x - 126) with x = slope s + shift held within [0, 1], by multiplications: for a share of the weights, as the
// special function unit takes eight cycles a warp. Relative error 1e-4, a fifth of a float16's last place.
constexpr float kMultipliedRange = 252.0f, kMultipliedLow = -126.0f;
__device__ __forceinline__ float multiplied_weight(float s, float slope, float shift) {
  constexpr float kRound = 12582912.0f + kMultipliedLow;  // beside 1.5 * 2^23 the fraction of a sum rounds away
  const float x = __saturatef(fmaf(s, slope, shift));
  const float rounded = fmaf(x, kMultipliedRange, kRound);
  const float f = fmaf(x, kMultipliedRange, kRound - rounded);
  const float y = fmaf(fmaf(fmaf(f, 0.05517166f, 0.24261112f), f, 0.69326099f), f, 0.99992807f);
  return __int_as_float(__float_as_int(y) + (__float_as_int(rounded) << 23));
}

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
