// Tensor-core instructions of sm_80 and later, as functions. A warp holds m16n8k16 fragments as PTX lays them out.
#pragma once

#include <cuda_bf16.h>
#include <cuda_fp16.h>

#include <cstdint>
#include <type_traits>

namespace gsim3d::cuda::conv {

__device__ __forceinline__ uint32_t shared_address(const void* pointer) {
  return static_cast<uint32_t>(__cvta_generic_to_shared(pointer));
}

// 16 bytes to shared memory, in the background; zeros unless `real`.
__device__ __forceinline__ void copy_async(uint32_t to, const void* from, bool real) {
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(to), "l"(from), "r"(real ? 16 : 0) : "memory");
}
__device__ __forceinline__ void close_copies() { asm volatile("cp.async.commit_group;" ::: "memory"); }
template <int kOpen>
__device__ __forceinline__ void wait_for_copies() {
  asm volatile("cp.async.wait_group %0;" ::"n"(kOpen) : "memory");
}

// Four 8x8 matrices; lane l names row l % 8 of matrix l / 8.
__device__ __forceinline__ void load_matrices(uint32_t address, uint32_t (&to)[4]) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(address)
               : "memory");
}
__device__ __forceinline__ void load_matrices_transposed(uint32_t address, uint32_t (&to)[4]) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(address)
               : "memory");
}

template <typename E>
__device__ __forceinline__ void multiply_add(const uint32_t (&a)[4], uint32_t b0, uint32_t b1, float (&sum)[4]);

template <>
__device__ __forceinline__ void multiply_add<__half>(const uint32_t (&a)[4], uint32_t b0, uint32_t b1,
                                                     float (&sum)[4]) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
      "%3};"
      : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}
template <>
__device__ __forceinline__ void multiply_add<__nv_bfloat16>(const uint32_t (&a)[4], uint32_t b0, uint32_t b1,
                                                            float (&sum)[4]) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

// Makes the copies that this thread knows to be finished visible to the instructions of warp groups, which read memory
// on another way.
__device__ __forceinline__ void publish_copies() {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
#endif
}

// Barriers in shared memory: arrivals complete a phase, waits name the parity of the phase they wait for.
__device__ __forceinline__ void start_barrier(uint32_t barrier, int arrivals) {
  asm volatile("mbarrier.init.shared.b64 [%0], %1;" ::"r"(barrier), "r"(arrivals) : "memory");
}
__device__ __forceinline__ void arrive(uint32_t barrier) {
  asm volatile("{.reg .b64 state; mbarrier.arrive.shared.b64 state, [%0];}" ::"r"(barrier) : "memory");
}
// Arrives when the copies that this thread has queued so far are there.
__device__ __forceinline__ void arrive_behind_copies(uint32_t barrier) {
  asm volatile("cp.async.mbarrier.arrive.noinc.shared.b64 [%0];" ::"r"(barrier) : "memory");
}
__device__ __forceinline__ void wait_for_phase(uint32_t barrier, uint32_t parity) {
#if __CUDA_ARCH__ >= 900
#define GSIM3D_WAIT "mbarrier.try_wait.parity.shared.b64"
#else
#define GSIM3D_WAIT "mbarrier.test_wait.parity.shared.b64"
#endif
  asm volatile("{.reg .pred done;\nagain:\n" GSIM3D_WAIT " done, [%0], %1;\n@!done bra again;\n}" ::"r"(barrier),
               "r"(parity)
               : "memory");
#undef GSIM3D_WAIT
}

// A factor in shared memory: where it starts, in the way that the instructions at hand ask for. Of a turned factor the
// second 64 rows (columns) lie `apart` bytes behind the first.
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
using Factor = uint64_t;
__device__ __forceinline__ Factor factor_at(uint32_t address, uint32_t apart = 16) {
  constexpr uint64_t kEightRows = 1024 / 16, kPermuted128 = 1;
  return address / 16 | uint64_t{apart / 16} << 16 | kEightRows << 32 | kPermuted128 << 62;
}
__device__ __forceinline__ Factor moved(Factor factor, uint32_t bytes) { return factor + bytes / 16; }
#else
using Factor = uint32_t;
__device__ __forceinline__ Factor factor_at(uint32_t address, uint32_t = 0) { return address; }
__device__ __forceinline__ Factor moved(Factor factor, uint32_t bytes) { return factor + bytes; }
#endif

#ifdef __CUDA_ARCH_FEAT_SM90_ALL
// Products of a group of four warps (wgmma), 64 rows by 32, 64 or 128 columns, with both factors in shared memory: rows
// of 128 bytes whose chunks are permuted as in chunk_offset, from a multiple of 1024 bytes on. A row of memory holds 64
// steps of the sum for a row (column) of the left (right) factor; of a turned factor 64 rows (columns) for a step.
__device__ __forceinline__ void start_group_products() { asm volatile("wgmma.fence.sync.aligned;" ::: "memory"); }
__device__ __forceinline__ void close_group_products() {
  asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
}
template <int kOpen>
__device__ __forceinline__ void wait_for_group_products() {
  asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(kOpen) : "memory");
}
// Keeps the compiler from moving accesses of the sums across the products that are under way.
template <int kGroups>
__device__ __forceinline__ void fence_sums(float (&sums)[kGroups][4]) {
#pragma unroll
  for (int j = 0; j < kGroups; ++j)
#pragma unroll
    for (int e = 0; e < 4; ++e) asm volatile("" : "+f"(sums[j][e])::"memory");
}

#define GSIM3D_SUMS(j) "+f"(d[j][0]), "+f"(d[j][1]), "+f"(d[j][2]), "+f"(d[j][3])
#define GSIM3D_SUMS_4(j) GSIM3D_SUMS(j), GSIM3D_SUMS(j + 1), GSIM3D_SUMS(j + 2), GSIM3D_SUMS(j + 3)
#define GSIM3D_FACTORS "l"(a), "l"(b), "n"(static_cast<int>(kTurned))
#define GSIM3D_GROUP_PRODUCT_32(TYPE)                                                      \
  asm volatile("wgmma.mma_async.sync.aligned.m64n32k16.f32." TYPE "." TYPE                 \
               " {%0,%1,%2,%3,%4,%5,%6,%7,%8,%9,%10,%11,%12,%13,%14,%15}, %16, %17, 1, 1, 1, %18, %18;" \
               : GSIM3D_SUMS_4(0)                                                          \
               : GSIM3D_FACTORS)
#define GSIM3D_GROUP_PRODUCT_64(TYPE)                                                                      \
  asm volatile("wgmma.mma_async.sync.aligned.m64n64k16.f32." TYPE "." TYPE                                 \
               " {%0,%1,%2,%3,%4,%5,%6,%7,%8,%9,%10,%11,%12,%13,%14,%15,%16,%17,%18,%19,%20,%21,%22,%23,"  \
               "%24,%25,%26,%27,%28,%29,%30,%31}, %32, %33, 1, 1, 1, %34, %34;"                            \
               : GSIM3D_SUMS_4(0), GSIM3D_SUMS_4(4)                                                        \
               : GSIM3D_FACTORS)
#define GSIM3D_GROUP_PRODUCT_128(TYPE)                                                                     \
  asm volatile("wgmma.mma_async.sync.aligned.m64n128k16.f32." TYPE "." TYPE                                \
               " {%0,%1,%2,%3,%4,%5,%6,%7,%8,%9,%10,%11,%12,%13,%14,%15,%16,%17,%18,%19,%20,%21,%22,%23,"  \
               "%24,%25,%26,%27,%28,%29,%30,%31,%32,%33,%34,%35,%36,%37,%38,%39,%40,%41,%42,%43,%44,%45,"  \
               "%46,%47,%48,%49,%50,%51,%52,%53,%54,%55,%56,%57,%58,%59,%60,%61,%62,%63}, %64, %65, 1, 1," \
               " 1, %66, %66;"                                                                             \
               : GSIM3D_SUMS_4(0), GSIM3D_SUMS_4(4), GSIM3D_SUMS_4(8), GSIM3D_SUMS_4(12)                   \
               : GSIM3D_FACTORS)
#define GSIM3D_GROUP_PRODUCT(COLUMNS)                                                         \
  template <typename E, bool kTurned>                                         \
  __device__ __forceinline__ void multiply_add_group(Factor a, Factor b, float (&d)[COLUMNS / 8][4]) { \
    if constexpr (std::is_same_v<E, __half>)                                                  \
      GSIM3D_GROUP_PRODUCT_##COLUMNS("f16");                                                  \
    else                                                                                      \
      GSIM3D_GROUP_PRODUCT_##COLUMNS("bf16");                                                 \
  }
GSIM3D_GROUP_PRODUCT(32)
GSIM3D_GROUP_PRODUCT(64)
GSIM3D_GROUP_PRODUCT(128)
#undef GSIM3D_GROUP_PRODUCT
#undef GSIM3D_GROUP_PRODUCT_32
#undef GSIM3D_GROUP_PRODUCT_64
#undef GSIM3D_GROUP_PRODUCT_128
#undef GSIM3D_FACTORS
#undef GSIM3D_SUMS_4
#undef GSIM3D_SUMS
#endif

// Two neighbouring elements, rounded.
template <typename E>
__device__ __forceinline__ uint32_t pair_of(float low, float high) {
  struct alignas(4) Two {
    E values[2];
  } two{static_cast<E>(low), static_cast<E>(high)};
  return *reinterpret_cast<uint32_t*>(&two);
}

// Offset in elements of 16-byte chunk `chunk` of row `row`: chunks are permuted so that the eight rows of a matrix lie
// in different banks. Rows are whole multiples of 128 bytes.
template <int kRowElements>
__device__ __forceinline__ int chunk_offset(int row, int chunk) {
  static_assert(kRowElements % 64 == 0);
  return row * kRowElements + (chunk ^ (row & 7)) * 8;
}

}  // namespace gsim3d::cuda::conv
