// Names of the 16-bit formats for code that no CUDA compiler reads. Only kernels compute with them.
#pragma once

#include <cstdint>

namespace gsim3d {

struct Float16 {
  uint16_t bits;
};
struct BFloat16 {
  uint16_t bits;
};

}  // namespace gsim3d
