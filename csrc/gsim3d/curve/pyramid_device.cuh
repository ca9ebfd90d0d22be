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

// The count vector: problems, then for every stage rows, clouds, patches, keys and voxels, then half the pairs of every
// kernel map.
enum Count : int { kRows, kClouds, kPatches, kKeys, kVoxels, kStageCounts };
GSIM3D_HD int64_t count_at(int64_t stage, Count what) { return 1 + stage * kStageCounts + what; }
GSIM3D_HD int64_t pairs_at(int64_t n_stages, int64_t kernel) { return 1 + n_stages * kStageCounts + kernel; }

// One stage. A cell is packed as cloud, x, y, z with 16 bits each. Cells, voxel_rows and sorted of all stages follow
// each other.
struct StageArrays {
  uint64_t* cells;       // [room], by row
  uint64_t* codes;       // [4, room], cloud << 3 depth | code, ascending along each curve
  uint32_t* rows;        // [4, room], the rows in that order
  uint32_t* cu_cluster;  // [room + 1], places in the first serialization of the stage before
  uint32_t* time_index;  // [room], or null

  int64_t* scene;        // [n_clouds], ascending by (scene, slot)
  int64_t* slot;         // [n_clouds]
  uint32_t* merged;      // [n_clouds], the next stage's cloud of each cloud
  uint32_t* members;     // [n_clouds + 1], first cloud of the stage before in each cloud
  uint32_t* run_starts;  // [n_clouds + 1], places of the clouds of the stage before in this stage's lists
  uint32_t* cu_clouds;   // [n_clouds + 1]
  uint32_t* cu_patches;  // [n_clouds + 1], patches of the clouds before
  uint32_t* cu_keys;     // [n_clouds + 1], keys of their patches

  uint64_t* sorted;      // [room], cells ascending
  uint32_t* voxel_rows;  // [room], their rows
  uint32_t* row_voxel;   // [room]
  uint32_t* cu_voxels;   // [room + 1]
  uint64_t* voxels;      // [room], packed cells, ascending

  int64_t patch_size;
  int32_t merged_bits;              // of a slot, on the way to this stage
  int32_t curves[kSerializations];  // of each serialization row
};

// One kernel map. Each warp of 32 voxels counts the pairs it finds at each tap before the centre.
struct MapArrays {
  int64_t begin;  // of its counts: [taps before the centre, n_warps]
  int32_t stage, kernel_size;
};

// Where the results of a stage go, null where it has none of a kind, and how large they are.
struct StageResults {
  int64_t *input_rows, *cu_input_rows, *cu_cluster, *time_index, *grid, *cloud, *cu_clouds, *order, *cu_q, *cu_k,
      *kv_rows, *row_voxel, *voxel_rows, *cu_voxel_rows;
  int64_t n_rows, n_clouds, n_patches, n_keys, n_voxels;
};
struct MapResults {
  int64_t *tap_in, *tap_out, *cu_taps;
  int64_t n_pairs;
};

// Everything, for kernels that serve all stages (blockIdx.y) or maps at once. Pointers are to device memory.
struct Build {
  const StageArrays* stages;  // [n_stages]
  const MapArrays* maps;      // [n_maps]
  int64_t n_stages, n_maps, room, n_warps;
  int64_t* counts;
  int32_t* depth;        // [n_stages], levels of the codes that a stage keeps below the cloud
  int32_t* drop;         // [n_stages], bits an axis that the step to this stage drops
  uint32_t* found;       // [counts of all maps, then one more]
  uint32_t* starts;      // sums of `found`
  uint32_t* input_rows;  // [room], rows that take part
  uint32_t* tickets;     // for tile_of, zero
  uint32_t* published;   // [scans, tiles of the room], zero
};

inline unsigned blocks_of(int64_t n) { return blocks_for("build_pyramid", n, kPyramidThreads); }

__device__ __forceinline__ int64_t thread_index() { return int64_t{blockIdx.x} * kPyramidThreads + threadIdx.x; }

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

// Numbering the elements of a list that hold a property, in one pass: a block takes a tile, publishes how many it has
// and looks back over the tiles before it (Merrill and Garland 2016).
constexpr int kScanItems = 8;
constexpr int kScanTile = kPyramidThreads * kScanItems;

GSIM3D_HD int64_t tiles_of(int64_t n) { return (n + kScanTile - 1) / kScanTile; }

// The tile of this block, in the order in which blocks start: a tile waits for earlier ones only. For all threads.
__device__ __forceinline__ int64_t tile_of(uint32_t* ticket) {
  __shared__ uint32_t own;
  if (threadIdx.x == 0) own = atomicAdd(ticket, 1u);
  __syncthreads();
  return own;
}

// before[j]: how many elements before element (tile, j, thread) have the property, over all tiles. Returns how many
// have it up to this tile's end. For all threads of a block, once.
__device__ __forceinline__ uint32_t number_tile(const bool (&flags)[kScanItems], int64_t tile, uint32_t* published,
                                                uint32_t (&before)[kScanItems]) {
  constexpr int kWarps = kPyramidThreads / kWarp, kParts = kWarps * kScanItems, kEach = kParts / kWarp;
  constexpr uint32_t kOfTile = 1u << 30, kUpToTile = 2u << 30;
  static_assert(kParts % kWarp == 0);
  __shared__ uint32_t parts[kParts];
  __shared__ uint32_t earlier;
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  unsigned ballots[kScanItems];
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    ballots[j] = __ballot_sync(kFullWarp, flags[j]);
    if (lane == 0) parts[j * kWarps + warp] = __popc(ballots[j]);
  }
  __syncthreads();
  if (warp == 0) {
    uint32_t own[kEach], sum = 0;
#pragma unroll
    for (int e = 0; e < kEach; ++e) sum += own[e] = parts[lane * kEach + e];
    uint32_t up_to = sum;
#pragma unroll
    for (int offset = 1; offset < kWarp; offset *= 2) {
      const uint32_t from = __shfl_up_sync(kFullWarp, up_to, offset);
      if (lane >= offset) up_to += from;
    }
    const uint32_t total = __shfl_sync(kFullWarp, up_to, kWarp - 1);
    if (lane == 0) *static_cast<volatile uint32_t*>(published + tile) = total | (tile == 0 ? kUpToTile : kOfTile);
    uint32_t sum_before = 0;
    for (int64_t last = tile - 1; last >= 0; last -= kWarp) {
      uint32_t word = kUpToTile;
      if (last >= lane) do
          word = *static_cast<const volatile uint32_t*>(published + last - lane);
        while (word < kOfTile);
      const unsigned whole = __ballot_sync(kFullWarp, word >= kUpToTile);
      const int nearest = whole ? __ffs(whole) - 1 : kWarp;
      sum_before += __reduce_add_sync(kFullWarp, lane <= nearest ? word & (kOfTile - 1) : 0u);
      if (whole) break;
    }
    if (lane == 0) {
      if (tile > 0) *static_cast<volatile uint32_t*>(published + tile) = (sum_before + total) | kUpToTile;
      earlier = sum_before + total;
    }
    uint32_t start = sum_before + up_to - sum;
#pragma unroll
    for (int e = 0; e < kEach; ++e) {
      parts[lane * kEach + e] = start;
      start += own[e];
    }
  }
  __syncthreads();
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) before[j] = parts[j * kWarps + warp] + __popc(ballots[j] & ((1u << lane) - 1));
  return earlier;
}

// What a call finds out about its input before the first stage.
struct Intake {
  uint64_t* extent;    // [6], lowest and highest position an axis as ordered bits; release only
  uint32_t* top;       // [1], largest cell coordinate
  uint64_t* cells;     // [n_rows], x, y, z
  uint32_t* start;     // [n_rows + 1], rows that take part before
  uint32_t* cloud_id;  // [n_clouds]
};

// Who takes part, the clouds of every stage and the levels of their codes.
template <typename T>
void find_clouds(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Intake& intake, const Build& build,
                 Stream stream);

// Raises what the CPU raises for the input that gave this status, which is not 0.
template <typename T>
void raise_status(int64_t status, const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Intake& intake,
                  Stream stream);

// Voxels of all stages from their cells. `cloud_bits`: bits of a cloud id.
void find_voxels(const Build& build, const StageArrays* stages, int cloud_bits, const Workspace& workspace,
                 Stream stream);

// Counts of all kernel maps, and of the patches of all stages.
void count_pairs(const Build& build, int64_t n_counts, const Workspace& workspace, Stream stream);
void count_patches(const Build& build, Stream stream);

// `results` on the device; `most`: the size of the largest array, and of the largest cu_taps.
void write_patches(const Build& build, const StageResults* results, int64_t most, Stream stream);
void write_pairs(const Build& build, const MapResults* results, int64_t most, Stream stream);

}  // namespace gsim3d::cuda
