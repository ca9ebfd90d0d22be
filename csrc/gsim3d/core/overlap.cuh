// A kernel that begins while the one queued before it still runs, from Hopper on.
#pragma once

#include "gsim3d/core/cuda_utils.cuh"

namespace gsim3d::cuda {

// launch() for such a kernel. The one before it calls let_next_begin(); every thread of this one calls
// wait_for_previous() before it touches what that one writes, and before it ends.
template <typename... Formal, typename... Actual>
void launch_overlapping(const char* what, void (*kernel)(Formal...), dim3 blocks, dim3 threads, size_t shared_bytes,
                        Stream stream, Actual... arguments) {
  if (blocks.x == 0 || blocks.y == 0 || blocks.z == 0) return;
  check_cuda(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(shared_bytes)),
             what);
  int generation = 0;
  check_cuda(cudaDeviceGetAttribute(&generation, cudaDevAttrComputeCapabilityMajor, stream.device), what);
  cudaLaunchAttribute overlap{};
  overlap.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  overlap.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = blocks;
  config.blockDim = threads;
  config.dynamicSmemBytes = shared_bytes;
  config.stream = native(stream);
  config.attrs = &overlap;
  config.numAttrs = generation >= 9 ? 1 : 0;
  check_cuda(cudaLaunchKernelEx(&config, kernel, static_cast<Formal>(arguments)...), what);
}

__device__ __forceinline__ void let_next_begin() {
#if __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}
__device__ __forceinline__ void wait_for_previous() {
#if __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

}  // namespace gsim3d::cuda
