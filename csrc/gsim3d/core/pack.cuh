// Several numbers that one thread moves at once.
#pragma once

#include <cstddef>

namespace gsim3d::cuda {

// N numbers, aligned so that they are one load where 16 bytes hold them.
template <typename T, int N, size_t kAlignment = sizeof(T) * N>
struct alignas(kAlignment) Pack {
  T lane[N];
};

}  // namespace gsim3d::cuda
