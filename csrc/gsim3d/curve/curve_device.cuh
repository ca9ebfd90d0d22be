// Sorting and summing in device memory, for the kernels of this folder.
#pragma once

#include <cstdint>

#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d::cuda {

struct SortRows {
  const uint64_t* keys;  // [n_rows, room]
  int64_t n_rows, room;
  int bits;              // keys of a row differ below this bit only
  uint64_t flip;         // the order is that of key ^ flip
  const int64_t* sizes;  // on the device: row r has sizes[r size_stride] <= room keys; null: room
  int64_t size_stride;
  const int32_t*
      squeeze;  // on the device: keys of row r hold a number above three of 16 bits, which lie below 2^squeeze[r]
  // What is wanted, each [n_rows, room]; the others are null.
  uint64_t* sorted;  // the keys in order
  uint32_t* index;   // the place of the i-th smallest key
  int64_t* order;    // the same
  int64_t* inverse;  // inverse[order[i]] = i
};

// Stable ascending sort of every row. room < 2^30.
void sort_rows(const char* op, const SortRows& rows, const Workspace& workspace, Stream stream);

// sums[i] = values[0] + .. + values[i - 1]; the last of the n values does not count. n <= 2^31.
void exclusive_sums(const char* op, const uint32_t* values, int64_t n, uint32_t* sums, const Workspace& workspace,
                    Stream stream);

}  // namespace gsim3d::cuda
