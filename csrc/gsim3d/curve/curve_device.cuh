// Sorting and summing in device memory, for the kernels of this folder.
#pragma once

#include <cstdint>

#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d::cuda {

// Stable ascending sort of each of `rows` rows of n keys by their bits below `bits`: index[r, i] is the place in row r
// of the i-th smallest key. n < 2^32.
void sort_rows(const char* op, const uint64_t* keys /* [rows, n] */, int64_t rows, int64_t n, int bits,
               uint64_t* sorted /* [rows, n] */, uint32_t* index /* [rows, n] */, const Workspace& workspace,
               Stream stream);

// sums[i] = values[0] + .. + values[i - 1]; the last of the n values does not count. n <= 2^31.
void exclusive_sums(const char* op, const uint32_t* values, int64_t n, uint32_t* sums, const Workspace& workspace,
                    Stream stream);

}  // namespace gsim3d::cuda
