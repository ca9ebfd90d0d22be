// What the passes of build_pyramid hand to each other in device memory.
//
// How many rows, clouds and voxels a stage has is known on the device only: arrays have room for all input rows
// (`room`), kernels cover it and stop at the count. One copy of all counts to the host then sizes the results.
#pragma once

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/platform.h"
#include "gsim3d/curve/curve_device.cuh"
#include "gsim3d/curve/pyramid.h"

namespace gsim3d::cuda {

constexpr int kPyramidThreads = 256;
constexpr int64_t kSerializations = 4;
constexpr uint64_t kCellMask = (uint64_t{1} << 48) - 1;
constexpr uint32_t kAxisMask = 0xffff;

// The count vector: status, then for every stage rows, clouds, patches, keys and voxels, then half the pairs of every
// kernel map.
enum Status : int64_t { kBadClouds = 1, kTooManyClouds = 2, kTooWide = 4 };
enum Count : int { kRows, kClouds, kPatches, kKeys, kVoxels, kStageCounts };
GSIM3D_HD int64_t count_at(int64_t stage, Count what) { return 1 + stage * kStageCounts + what; }
GSIM3D_HD int64_t pairs_at(int64_t n_stages, int64_t kernel) { return 1 + n_stages * kStageCounts + kernel; }

// One stage. A cell is packed as cloud, x, y, z with 16 bits each. Cells and voxel_rows of the stages follow each other.
struct StageArrays {
  uint64_t* cells;       // [room], by row
  uint64_t* codes;       // [4, room], cloud << 3 depth | code, ascending along each curve
  uint32_t* rows;        // [4, room], the rows in that order
  uint32_t* cu_cluster;  // [room + 1], places in the first serialization of the stage before
  uint32_t* time_index;  // [room], or null

  int64_t* scene;         // [n_clouds], ascending by (scene, slot)
  int64_t* slot;          // [n_clouds]
  uint32_t* merged;       // [n_clouds], the next stage's cloud of each cloud
  uint32_t* members;      // [n_clouds + 1], first cloud of the stage before in each cloud
  uint32_t* run_starts;   // [n_clouds + 1], places of the clouds of the stage before in this stage's lists
  uint32_t* cu_clouds;    // [n_clouds + 1]
  uint32_t* cu_patches;   // [n_clouds + 1], patches of the clouds before
  uint32_t* cu_keys;      // [n_clouds + 1], keys of their patches

  uint32_t* voxel_rows;   // [room]
  uint32_t* row_voxel;    // [room]
  uint32_t* cu_voxels;    // [room + 1]
  uint64_t* voxels;       // [room], packed cells, ascending
};

// Pairs of one kernel map: how many each warp of 32 voxels finds at each tap before the centre, summed over all maps.
struct MapArrays {
  const uint32_t* starts;  // [taps before the centre, warps], then one more
  int64_t kernel_size, n_warps;
};

struct Levels {
  int32_t* depth;  // [n_stages]
  int32_t* drop;   // [n_stages], bits an axis that the step to this stage drops
};

inline unsigned blocks_of(int64_t n) { return blocks_for("build_pyramid", n, kPyramidThreads); }

__device__ __forceinline__ int64_t thread_index() {
  return int64_t{blockIdx.x} * kPyramidThreads + threadIdx.x;
}

// The first i in [begin, end) with !(less(i)), for a range where less holds first; end where it holds everywhere.
template <typename I, typename F>
__device__ __forceinline__ I partition_point(I begin, I end, const F& less) {
  while (begin < end) {
    const I middle = begin + (end - begin) / 2;
    if (less(middle))
      begin = middle + 1;
    else
      end = middle;
  }
  return begin;
}

// The segment of offsets cu[0 .. n] that holds i.
template <typename T>
__device__ __forceinline__ int64_t segment_of(const T* __restrict__ cu, int64_t n, int64_t i) {
  return partition_point(int64_t{1}, n, [&](int64_t s) { return static_cast<int64_t>(cu[s]) <= i; }) - 1;
}

// Voxels of all stages from their cells. `cloud_bits`: bits of a cloud id.
void find_voxels(StageArrays* stages, int64_t n_stages, int64_t room, int cloud_bits, int64_t* counts,
                 const Workspace& workspace, Stream stream);

// Counts of all kernel maps; fills maps[kernel].
void count_pairs(const StageArrays* stages, const PyramidSpec& spec, int64_t room, int64_t* counts, MapArrays* maps,
                 const Workspace& workspace, Stream stream);

// cu_clouds, cu_patches, cu_keys and the counts of clouds, patches and keys of a stage.
void count_patches(const StageArrays& stage, int64_t patch_size, int64_t* stage_counts, Stream stream);

// What a stage's results are made of.
struct StageSizes {
  int64_t rows, clouds, patches, keys, voxels;
};

void write_patches(const StageArrays& stage, const StageSizes& sizes, int64_t patch_size, const int64_t* order,
                   int64_t* cu_q, int64_t* cu_k, int64_t* kv_rows, Stream stream);
void write_voxels(const StageArrays& stage, const StageSizes& sizes, int64_t* row_voxel, int64_t* voxel_rows,
                  int64_t* cu_voxel_rows, Stream stream);
void write_pairs(const StageArrays& stage, const MapArrays& map, int64_t n_voxels, int64_t n_pairs, int64_t* tap_in,
                 int64_t* tap_out, int64_t* cu_taps, Stream stream);

}  // namespace gsim3d::cuda
