// Hardware approximations, to one or two units in the last place, where nothing needs more; exact for double.
#pragma once

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/raster/raster_jet.h"

namespace gsim3d::raster {

// Results below 2^-126 are 0.
__device__ __forceinline__ float fast_exp2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ float fast_sqrt(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ float fast_reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ double fast_exp2(double x) { return exp2(x); }
__device__ __forceinline__ double fast_sqrt(double x) { return sqrt(x); }
__device__ __forceinline__ double fast_reciprocal(double x) { return 1 / x; }
template <typename T>
__device__ __forceinline__ Dual<T> fast_exp2(const Dual<T>& x) {
  const T value = fast_exp2(x.value);
  return dual(value, value * (T(0.5 / kLog2eHalf) * x.along[0]));  // times ln(2)
}

// Copies from global to shared memory. What is loaded ahead into registers under a condition is waited for at once, to
// be merged with what was there; these are waited for in wait_copies, after which the calling thread sees its own.
template <typename V>
__device__ __forceinline__ void start_copy(const V* from, V* to) {
  const auto shared = static_cast<uint32_t>(__cvta_generic_to_shared(to));
  if constexpr (sizeof(V) % 16 == 0) {
#pragma unroll
    for (uint32_t i = 0; i < sizeof(V); i += 16)
      asm volatile("cp.async.ca.shared.global [%0], [%1], 16;" ::"r"(shared + i),
                   "l"(reinterpret_cast<const char*>(from) + i)
                   : "memory");
  } else {
    static_assert(sizeof(V) == 4);
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(shared), "l"(from) : "memory");
  }
}
__device__ __forceinline__ void wait_copies() { asm volatile("cp.async.wait_all;" ::: "memory"); }

// Saturating: 0 for what is negative.
__device__ __forceinline__ uint32_t ceil_to_whole(float x) { return __float2uint_ru(x); }
__device__ __forceinline__ uint32_t ceil_to_whole(double x) { return __double2uint_ru(x); }
__device__ __forceinline__ uint32_t floor_to_whole(float x) { return __float2uint_rd(x); }
__device__ __forceinline__ uint32_t floor_to_whole(double x) { return __double2uint_rd(x); }

}  // namespace gsim3d::raster
