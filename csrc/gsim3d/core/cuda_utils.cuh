// What every *_cuda.cu needs: launches that check for errors, clearing memory, and reading offsets without trust.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>
#include <stdexcept>
#include <string>

#include "gsim3d/core/check.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d::cuda {

constexpr unsigned kFullWarp = 0xffffffffu;
constexpr int kWarp = 32;

inline cudaStream_t native(Stream stream) { return static_cast<cudaStream_t>(stream.handle); }

// A failure of the CUDA runtime, no fault of the arguments: std::runtime_error with the call's name.
inline void check_cuda(cudaError_t status, const char* what) {
  if (status != cudaSuccess) [[unlikely]]
    throw std::runtime_error(std::string(what) + ": CUDA reports " + cudaGetErrorString(status));
}

// launch("pool_max", kernel, blocks, threads, shared_bytes, stream, arguments...); no blocks: nothing is queued.
template <typename... Formal, typename... Actual>
void launch(const char* what, void (*kernel)(Formal...), dim3 blocks, dim3 threads, size_t shared_bytes, Stream stream,
            Actual... arguments) {
  if (blocks.x == 0 || blocks.y == 0 || blocks.z == 0) return;
  constexpr size_t kDefaultLimit = 48 * 1024;
  if (shared_bytes > kDefaultLimit)
    check_cuda(
        cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(shared_bytes)),
        what);
  kernel<<<blocks, threads, shared_bytes, native(stream)>>>(static_cast<Formal>(arguments)...);
  check_cuda(cudaGetLastError(), what);
}

// Blocks that cover n items; a grid's x dimension holds 2^31 - 1 blocks.
inline unsigned blocks_for(const char* what, int64_t n, int64_t per_block) {
  const int64_t blocks = (n + per_block - 1) / per_block;
  check(blocks <= 0x7fffffff, what, ": ", n, " items are more than one launch holds");
  return static_cast<unsigned>(blocks);
}

template <typename T>
void fill_zero(const char* what, T* data, int64_t count, Stream stream) {
  if (count > 0) check_cuda(cudaMemsetAsync(data, 0, static_cast<size_t>(count) * sizeof(T), native(stream)), what);
}

// Offsets come from the caller unchecked (checking them would wait for the device): whatever they hold, [begin, end)
// stays inside [0, n].
struct Range {
  int64_t begin, end;
};
__device__ __forceinline__ Range range_of(const int64_t* __restrict__ cu, int64_t i, int64_t n) {
  const int64_t begin = min(max(cu[i], int64_t{0}), n);
  return {begin, min(max(cu[i + 1], begin), n)};
}
__device__ __forceinline__ bool inside(int64_t index, int64_t n) {
  return static_cast<uint64_t>(index) < static_cast<uint64_t>(n);
}

}  // namespace gsim3d::cuda
