// Where the rows of a call meet a background that was computed before: its cells, and the patches along its curves.
//
// Keys of the background ascend. Results are integers: the same on every device, for any number of threads.
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/platform.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

constexpr int64_t kMaxChain = 8;  // stages of a network

// Rows of several stages: row i of stage s pools the rows rows[s][cu_rows[s][i] .. cu_rows[s][i + 1]] of stage s - 1,
// of the input for s = 0, whose rows of cloud q are cu_input[q] .. cu_input[q + 1].
struct RowChain {
  const int64_t* cloud_scene;  // [n_clouds]
  const int64_t* cu_input;     // [n_clouds + 1]
  int64_t n_clouds;
  const int64_t* rows[kMaxChain];     // [n_listed[s]]
  const int64_t* cu_rows[kMaxChain];  // [n_rows[s] + 1]
  int64_t* scene[kMaxChain];          // [n_rows[s]], result
  int64_t n_listed[kMaxChain], n_rows[kMaxChain];
  int64_t n_stages;
};

// A background cut into patches along several curves, and the rows that look for theirs.
struct Overlap {
  const int64_t* first;    // [n_curves, n_patches] ascending: the code at which each patch begins, scenes above
  const int64_t* kv_rows;  // [n_curves, n_keys]
  const int64_t* cu_k;     // [n_patches + 1], keys of each patch, at most patch_size
  int64_t n_curves, n_patches, n_keys, patch_size;
  const int64_t* codes;      // [n_curves, n_rows] of the rows
  const int64_t* order;      // [n_curves, n_rows], clouds one after another, by ascending code in each
  const int64_t* cu_clouds;  // [n_clouds + 1]; rows behind are none
  int64_t n_rows, n_clouds;

  // Patches in parts of at most patch_size queries: so many there can be, and so many keys do they list at most. (What
  // a patch has beyond its first part are whole parts, no longer than their queries are many.)
  GSIM3D_HD int64_t n_parts() const { return n_patches + n_rows / patch_size; }
  GSIM3D_HD int64_t n_listed() const { return n_keys + n_rows; }
  GSIM3D_HD int64_t parts_of(int64_t n_queries) const { return n_queries > 0 ? 1 + (n_queries - 1) / patch_size : 0; }
};

// Part p of a curve: queries q_rows[cu_q[p]] .. and keys kv_rows[cu_k[p]] .. A patch of many queries becomes several
// parts, which all list its keys; one of none becomes no part. Parts are ordered by patch, queries of a patch by cloud
// and code. Behind the last part offsets repeat, q_rows lists the rows without a patch, and kv_rows is 0.
struct QueryParts {
  int64_t* q_rows;   // [n_curves, n_rows]
  int64_t* kv_rows;  // [n_curves, n_listed]
  int64_t* cu_q;     // [n_curves, n_parts + 1]
  int64_t* cu_k;     // [n_curves, n_parts + 1]
};

namespace cpu {

// The scene of every row of every stage, that of the first row that it pools; 0 where it pools none.
void row_scenes(const RowChain& chain, const Parallel& parallel);

// The place of each row's cell among `cells`, keys of scene and cell; n_cells - 1 where it is not among them.
void find_cells(const int64_t* cells,  // [n_cells] ascending, n_cells >= 1
                int64_t n_cells,
                const int64_t* scene,  // [n]
                const int64_t* grid,   // [n, 3]
                int64_t n,
                int64_t* places,  // [n]
                const Parallel& parallel);

// out[i] = x[i] + field[places[i]], rows of `channels` numbers. Throws ArgumentError where a place is not in
// [0, n_cells).
template <typename T>
void add_cells(const T* x,      // [n, channels]
               const T* field,  // [n_cells, channels]
               const int64_t* places, int64_t n, int64_t n_cells, int64_t channels,
               T* out,  // [n, channels]
               const Parallel& parallel);

// A row belongs to the last patch of its scene that begins no later than its code. Throws ArgumentError unless the
// lists are well formed.
void overlapping_patches(const Overlap& overlap, const QueryParts& parts, const Workspace& workspace,
                         const Parallel& parallel);

}  // namespace cpu

// The same functions on the device of `stream`. What is out of range is skipped.
namespace cuda {

void row_scenes(const RowChain& chain, Stream stream);
void find_cells(const int64_t* cells, int64_t n_cells, const int64_t* scene, const int64_t* grid, int64_t n,
                int64_t* places, Stream stream);
// T may be Float16 or BFloat16; a row whose place is out of range is copied.
template <typename T>
void add_cells(const T* x, const T* field, const int64_t* places, int64_t n, int64_t n_cells, int64_t channels, T* out,
               Stream stream);
void overlapping_patches(const Overlap& overlap, const QueryParts& parts, const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
