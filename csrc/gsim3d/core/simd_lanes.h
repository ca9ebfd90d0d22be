// Part of simd.h, which includes it once for each instruction set: lanes of GSIM3D_SIMD_BYTES.

template <typename T>
struct LanesOf;
template <>
struct LanesOf<float> {
  typedef float Type __attribute__((vector_size(GSIM3D_SIMD_BYTES)));
  typedef int32_t Bits __attribute__((vector_size(GSIM3D_SIMD_BYTES)));
};
template <>
struct LanesOf<double> {
  typedef double Type __attribute__((vector_size(GSIM3D_SIMD_BYTES)));
  typedef int64_t Bits __attribute__((vector_size(GSIM3D_SIMD_BYTES)));
};
template <typename T>
using Lanes = typename LanesOf<T>::Type;
template <typename T>
using Bits = typename LanesOf<T>::Bits;

template <typename T>
constexpr int W = GSIM3D_SIMD_BYTES / sizeof(T);

// Registers that hold vectors.
#if GSIM3D_SIMD_BYTES == 32
constexpr int kRegisters = 16;
#else
constexpr int kRegisters = 32;
#endif

template <typename T>
GSIM3D_SIMD_INLINE Lanes<T> load(const T* from) {
  Lanes<T> x;
  std::memcpy(&x, from, sizeof(x));
  return x;
}

template <typename T>
GSIM3D_SIMD_INLINE void store(T* to, const Lanes<T>& x) {
  std::memcpy(to, &x, sizeof(x));
}

template <typename T>
GSIM3D_SIMD_INLINE Lanes<T> fill(T x) {
  return x - Lanes<T>{};  // keeps the sign of zero
}

// a * b + c, rounded once.
#if GSIM3D_SIMD_BYTES == 64
GSIM3D_SIMD_INLINE Lanes<float> fma(const Lanes<float>& a, const Lanes<float>& b, const Lanes<float>& c) {
  return _mm512_fmadd_ps(a, b, c);
}
GSIM3D_SIMD_INLINE Lanes<double> fma(const Lanes<double>& a, const Lanes<double>& b, const Lanes<double>& c) {
  return _mm512_fmadd_pd(a, b, c);
}
#elif GSIM3D_SIMD_BYTES == 32
GSIM3D_SIMD_INLINE Lanes<float> fma(const Lanes<float>& a, const Lanes<float>& b, const Lanes<float>& c) {
  return _mm256_fmadd_ps(a, b, c);
}
GSIM3D_SIMD_INLINE Lanes<double> fma(const Lanes<double>& a, const Lanes<double>& b, const Lanes<double>& c) {
  return _mm256_fmadd_pd(a, b, c);
}
#else
template <typename V>
GSIM3D_SIMD_INLINE V fma(const V& a, const V& b, V c) {
  for (size_t i = 0; i < sizeof(V) / sizeof(c[0]); ++i) c[i] = std::fma(a[i], b[i], c[i]);
  return c;
}
#endif

// The larger of each lane; a NaN in x is kept.
template <typename V>
GSIM3D_SIMD_INLINE V max_keeping_nan(const V& x, const V& floor) {
  return floor > x ? floor : x;
}
