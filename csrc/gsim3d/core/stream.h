// Where a CUDA kernel is queued, without a CUDA header.
#pragma once

#include <cstdint>

namespace gsim3d {

struct Stream {
  void* handle;    // cudaStream_t; nullptr is the default stream of the device
  int32_t device;  // must be the current device of the calling thread
};

}  // namespace gsim3d
