// All geometry of a call of the dynamics network, as integers: who takes part, cells, curve orders, attention patches,
// voxels, convolution maps and pooling clusters of every stage.
//
// A stage halves cells (stride 2^k drops k bits an axis) and may merge time: clouds of one scene whose slots agree
// above the merged bits become one cloud. Nothing but the order of cloud ids passes between clouds, so a cloud's
// geometry does not depend on what else is in the call, except with `release`.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <initializer_list>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

// Where results go whose sizes depend on the data: the caller makes one int64 array for each call, in order.
class Arrays {
 public:
  using Append = int64_t* (*)(void* state, const int64_t* sizes, int64_t dims);

  Arrays(Append append, void* state) : append_(append), state_(state) {}

  int64_t* append(std::initializer_list<int64_t> sizes) const {
    return append_(state_, sizes.begin(), static_cast<int64_t>(sizes.size()));
  }

 private:
  Append append_;
  void* state_;
};

struct PyramidSpec {
  double grid_size;               // metres, edge of a cell of stage 0
  int64_t slot_bits;              // cloud_slot is in [0, 2^slot_bits)
  int64_t n_stages;
  const int64_t* strides;         // [n_stages - 1], powers of two
  const int64_t* merge_windows;   // [n_stages - 1], powers of two: slots merged into one cloud
  const int64_t* patch_sizes;     // [n_stages]
  const int64_t* curves;          // [n_stages, 4], curve of each serialization row
  const int64_t* kernel_sizes;    // odd; those of stage s lie between cu_kernels[s] and cu_kernels[s + 1]
  const int64_t* cu_kernels;      // [n_stages + 1]
  bool release;  // as published: cells truncated from the minimum over all clouds, depth from the extent, ties by row
  // Null: arrays fit what they hold. Else their sizes, known before the data: capacity_at of every count.
  const int64_t* capacity = nullptr;
  // Sizes are rounded up from what the data has, so that calls with similar data have the same ones; otherwise as with
  // `capacity`, which is null then.
  bool rounded = false;
  // Levels of the curves, 1 to 16: a row whose cell does not fit sleeps, and a stride of more levels than are left pools
  // none. 0: 16, or what `release` says.
  int64_t depth = 0;
};

// What `capacity` and `found` count: rows, clouds, patches and keys of every stage, then the pairs of every kernel map.
enum class Counted { kRows, kClouds, kPatches, kKeys, kPerStage };
constexpr int64_t capacity_at(int64_t stage, Counted what) {
  return stage * static_cast<int64_t>(Counted::kPerStage) + static_cast<int64_t>(what);
}
constexpr int64_t capacity_of_pairs(int64_t n_stages, int64_t kernel) {
  return capacity_at(n_stages, Counted::kRows) + kernel;
}

// The sizes of a rounded pyramid, in place, from what was counted: at most one part in 32 more. Clouds stay as they
// are.
inline void round_counts(int64_t* counts, int64_t n_stages, int64_t n_counts, int64_t n_rows) {
  constexpr int64_t kEach = capacity_at(1, Counted::kRows);
  for (int64_t i = 0; i < n_counts; ++i) {
    const bool of_stage = i < capacity_of_pairs(n_stages, 0);
    if (of_stage && i % kEach == static_cast<int64_t>(Counted::kClouds)) continue;
    const auto step = std::max<int64_t>(1, static_cast<int64_t>(std::bit_floor(static_cast<uint64_t>(counts[i])) / 32));
    counts[i] = (counts[i] + step - 1) / step * step;
    if (of_stage && i % kEach == static_cast<int64_t>(Counted::kRows)) counts[i] = std::min(counts[i], n_rows);
  }
  counts[0] = n_rows;
}

// Reasons why a pyramid of given sizes is empty: bits of found[0].
enum PyramidProblem : int64_t { kBadClouds = 1, kTooManyClouds = 2, kTooWide = 4, kTooLarge = 8 };

// The clouds of a call: rows cu_rows[q] .. cu_rows[q + 1] - 1 are cloud q.
template <typename T>
struct PyramidClouds {
  const T* positions;          // [n_rows, 3] metres
  const int64_t* cu_rows;      // [n_clouds + 1]
  const int64_t* scene;        // [n_clouds], in [0, n_scenes)
  const int64_t* slot;         // [n_clouds], in [0, 2^slot_bits); no two clouds share scene and slot
  const double* origin;        // [n_scenes, 3] metres
  int64_t n_rows, n_clouds, n_scenes;
};

namespace cpu {

// Appends, in this order:
//   rows [N0]: input rows that take part, ascending; the others are not finite or outside [0, 2^16) cells of the origin
//   cu_rows [N0 + 1]: row i of stage 0 is input row rows[cu_rows[i]]
//   for every stage, N rows in C clouds and V voxels:
//     cu_cluster [N + 1]    except at stage 0: row i pools rows order[0, cu_cluster[i]:cu_cluster[i + 1]] of stage
//                           s - 1
//     time_index [N]        only where slots merge: slot inside the merged window
//     grid [N, 3], cloud [N], cu_clouds [C + 1]: order[:, cu_clouds[c]:cu_clouds[c + 1]] are the rows of cloud c
//     order [4, N]          rows by (cloud, code, position inside the cell, row)
//     cu_q [P + 1], cu_k [P + 1], kv_rows [4, M]: patch p asks rows order[r, cu_q[p]:cu_q[p + 1]] and reads
//                           kv_rows[r, cu_k[p]:cu_k[p + 1]]; the last patch of a cloud reads a whole patch of rows
//     row_voxel [N], voxel_rows [N], cu_voxel_rows [V + 1]: rows of equal (cloud, cell); voxels by (cloud, x, y, z)
//     for every kernel size K: tap_in [L], tap_out [L], cu_taps [K^3 + 1]: voxel tap_in lies at (kx, ky, kz) - K / 2
//                           cells from tap_out, tap = (kx K + ky) K + kz; both ascend inside a tap; centre empty
// and with spec.capacity or spec.rounded at last found [1 + counts]: problems, then the counts that the data has. Then
// N, C, P, M, L are those of the capacity (N0 = n_rows), V is N + 1, and behind what the data has follow rows that
// nothing reads: in orders they stay at their places, each is a voxel of its own, `rows` lists those that sleep; the
// last voxels, patches, clouds and clusters are empty (offsets stay at the end), other entries are 0. Where a count
// exceeds its capacity, there are such rows only.
// T is float or double. Throws ArgumentError where clouds or spec are malformed.
template <typename T>
void build_pyramid(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                   const Workspace& workspace, const Parallel& parallel);

// build_pyramid with spec.capacity or spec.rounded.
template <typename T>
void build_given(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                 const Workspace& workspace, const Parallel& parallel);

// Throw ArgumentError where a part of the input is malformed.
void check_spec(const PyramidSpec& spec);
void check_capacity(const PyramidSpec& spec, int64_t n_rows);
template <typename T>
void check_clouds(const PyramidClouds<T>& clouds, const PyramidSpec& spec);
// With `release`: the corners [3] of all positions.
template <typename T>
void check_extent(const T* low, const T* high, double grid_size);

// The pieces that need cells only.

// Appends row_voxel, voxel_rows, cu_voxel_rows. Returns the voxels' keys (cloud, x, y, z, 16 bits each), ascending, in
// scratch, and their number.
struct VoxelKeys {
  const uint64_t* keys;
  int64_t n;
};
VoxelKeys append_voxels(const int64_t* grid, const int64_t* cloud, int64_t n, const Arrays& arrays,
                        const Workspace& workspace, const Parallel& parallel);

// Appends tap_in, tap_out, cu_taps.
void append_kernel_map(const VoxelKeys& voxels, int64_t kernel_size, const Arrays& arrays, const Parallel& parallel);

// Appends cu_q, cu_k, kv_rows.
void append_patches(const int64_t* cu_clouds, int64_t n_clouds, const int64_t* order, int64_t n, int64_t patch_size,
                    const Arrays& arrays);

}  // namespace cpu

namespace cuda {

// The same results on the device of `stream`, in arrays on that device. Waits for the stream once, for the counts that
// size the arrays; with spec.capacity never: then malformed clouds give an empty pyramid, and found[0] says so.
template <typename T>
void build_pyramid(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                   const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
