// Names of the 16-bit formats for code that no CUDA compiler reads. Only kernels compute with them.
#pragma once

#include <cstdint>
#include <type_traits>

namespace gsim3d {

struct Float16 {
  uint16_t bits;
};
struct BFloat16 {
  uint16_t bits;
};

// What numbers of type T are added in.
template <typename T>
using Sum = std::conditional_t<std::is_same_v<T, double>, double, float>;

}  // namespace gsim3d
