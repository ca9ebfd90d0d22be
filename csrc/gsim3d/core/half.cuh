// The 16-bit formats as kernels compute with them.
#pragma once

#include <cuda_bf16.h>
#include <cuda_fp16.h>

#include "gsim3d/core/half.h"

namespace gsim3d::cuda {

template <typename T>
struct NativeOf {
  using Type = T;
};
template <>
struct NativeOf<Float16> {
  using Type = __half;
};
template <>
struct NativeOf<BFloat16> {
  using Type = __nv_bfloat16;
};
template <typename T>
using Native = typename NativeOf<T>::Type;

}  // namespace gsim3d::cuda
