// SIMD lanes for the CPU loops: one generic source, compiled for each instruction set, chosen at run time.
//
// A kernel is written once, in a file that is included between GSIM3D_SIMD_AVX512_BEGIN / _END and again, plainly, for
// the baseline (see patch_attn_cpu.cpp). Inside, Lanes<T> is the widest vector of the instruction set and W<T> its
// width. Templates of GCC vectors cannot do this alone: GCC splits wide vectors where a function is defined, before it
// is inlined into a caller that has the wider registers.
//
// Equal bits on every width are up to the kernel: no sum may run across lanes, and every element must see the same
// operations in the same order. fma() is one rounding everywhere; everything else is an IEEE operation a lane.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <string_view>

#if defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#define GSIM3D_SIMD_X86 1
#endif

#define GSIM3D_SIMD_INLINE inline __attribute__((always_inline))

#ifdef GSIM3D_SIMD_X86
#define GSIM3D_SIMD_AVX512_BEGIN   \
  _Pragma("GCC push_options")      \
  _Pragma("GCC target(\"avx512f,avx512bw,avx512cd,avx512dq,avx512vl,prefer-vector-width=512\")")
#define GSIM3D_SIMD_AVX512_END _Pragma("GCC pop_options")
#endif

namespace gsim3d::simd {

// True where the wide variant may run: the processor has AVX-512 and GSIM3D_SIMD=avx2 does not forbid it.
inline bool use_avx512() {
#ifdef GSIM3D_SIMD_X86
  static const bool use = [] {
    const char* wish = std::getenv("GSIM3D_SIMD");
    if (wish && std::string_view(wish) == "avx2") return false;
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl");
  }();
  return use;
#else
  return false;
#endif
}

namespace baseline {
#ifdef GSIM3D_SIMD_X86
#define GSIM3D_SIMD_BYTES 32
#else
#define GSIM3D_SIMD_BYTES 16
#endif
#include "gsim3d/core/simd_lanes.inc"
#undef GSIM3D_SIMD_BYTES
}  // namespace baseline

#ifdef GSIM3D_SIMD_X86
GSIM3D_SIMD_AVX512_BEGIN
namespace avx512 {
#define GSIM3D_SIMD_BYTES 64
#include "gsim3d/core/simd_lanes.inc"
#undef GSIM3D_SIMD_BYTES
}  // namespace avx512
GSIM3D_SIMD_AVX512_END
#endif

}  // namespace gsim3d::simd
