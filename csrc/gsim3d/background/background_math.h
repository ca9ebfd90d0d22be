// What the backends share: keys, and searches among them.
#pragma once

#include <cstdint>

#include "gsim3d/background/background.h"
#include "gsim3d/core/platform.h"

namespace gsim3d::background {

constexpr int kAxisBits = 16, kSpaceBits = 3 * kAxisBits;  // of a cell, below the scene in a key

GSIM3D_HD int64_t cell_key(int64_t scene, const int64_t* cell) {
  return scene << kSpaceBits | cell[0] << 2 * kAxisBits | cell[1] << kAxisBits | cell[2];
}

// How many of n ascending numbers are below `key`, with kOrEqual at most it.
template <bool kOrEqual>
GSIM3D_HD int64_t count_below(const int64_t* numbers, int64_t n, int64_t key) {
  int64_t begin = 0, end = n;
  while (begin < end) {
    const int64_t middle = begin + (end - begin) / 2;
    if (kOrEqual ? numbers[middle] <= key : numbers[middle] < key) begin = middle + 1;
    else end = middle;
  }
  return begin;
}

GSIM3D_HD int64_t place_of(const int64_t* cells, int64_t n_cells, int64_t key) {
  const int64_t at = count_below<false>(cells, n_cells, key);
  return at < n_cells && cells[at] == key ? at : n_cells - 1;
}

// The patch around a code, or n_patches: none.
GSIM3D_HD int64_t patch_of(const int64_t* first, int64_t n_patches, int64_t code) {
  const int64_t p = count_below<true>(first, n_patches, code) - 1;
  return p >= 0 && first[p] >> kSpaceBits == code >> kSpaceBits ? p : n_patches;
}

// The scene of a row of stage s; 0 where the chain below it ends before the input, or leaves what there is.
GSIM3D_HD int64_t scene_of(const RowChain& chain, int64_t s, int64_t row) {
  for (; s >= 0; --s) {
    const int64_t at = chain.cu_rows[s][row], end = chain.cu_rows[s][row + 1];
    if (at < 0 || at >= end || at >= chain.n_listed[s]) return 0;
    row = chain.rows[s][at];
    if (row < 0 || (s > 0 && row >= chain.n_rows[s - 1])) return 0;
  }
  const int64_t cloud = count_below<true>(chain.cu_input, chain.n_clouds + 1, row) - 1;
  return cloud >= 0 && cloud < chain.n_clouds ? chain.cloud_scene[cloud] : 0;
}

}  // namespace gsim3d::background
