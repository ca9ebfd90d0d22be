// Voxels, convolution maps and attention patches of the stages.
#include <algorithm>
#include <cub/block/block_scan.cuh>

#include "gsim3d/curve/pyramid_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = kPyramidThreads;
constexpr const char* kOp = "build_pyramid";
constexpr int kWindow = 64;  // keys that a warp keeps at hand while it searches a column of cells

// Tiles of all stages, one after another.
__global__ void __launch_bounds__(kThreads) find_voxels_kernel(Build build) {
  const int64_t tiles = tiles_of(build.room), ticket = tile_of(build.tickets);
  const int64_t s = ticket / tiles, tile = ticket % tiles;
  const StageArrays& stage = build.stages[s];
  int64_t* stage_counts = build.counts + count_at(s, kRows);
  const int64_t n = stage_counts[kRows], begin = tile * kScanTile + threadIdx.x;
  if (n == 0 && tile == 0 && threadIdx.x == 0) stage.cu_voxels[0] = 0;
  if (tile * kScanTile >= n) return;
  const uint64_t* sorted = stage.sorted;
  bool first[kScanItems];
  uint64_t cell[kScanItems];
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    const int64_t i = begin + j * kThreads;
    cell[j] = i < n ? sorted[i] : 0;
    first[j] = i < n && (i == 0 || cell[j] != sorted[i - 1]);
  }
  uint32_t before[kScanItems];
  const uint32_t up_to = number_tile(first, tile, build.published + s * tiles, before);
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    const int64_t i = begin + j * kThreads;
    if (i >= n) continue;
    const uint32_t voxel = before[j] + first[j] - 1;
    stage.row_voxel[stage.voxel_rows[i]] = voxel;
    if (first[j]) {
      stage.cu_voxels[voxel] = static_cast<uint32_t>(i);
      stage.voxels[voxel] = cell[j];
    }
    if (i == n - 1) {
      stage.cu_voxels[up_to] = static_cast<uint32_t>(n);
      stage_counts[kVoxels] = up_to;
    }
  }
}

// The first of keys[0 .. end) that is not less than `low`; all lanes ask the same.
__device__ __forceinline__ int32_t search_together(const uint64_t* __restrict__ keys, int32_t end, uint64_t low) {
  const int lane = threadIdx.x % kWarp;
  int32_t begin = 0;
  while (end - begin > kWarp) {
    const int32_t step = (end - begin + kWarp - 1) / kWarp, probe = begin + lane * step;
    const int less = __popc(__ballot_sync(kFullWarp, probe < end && keys[probe] < low));
    if (less == 0) return begin;
    end = min(end, begin + less * step);
    begin += (less - 1) * step + 1;
  }
  return begin + __popc(__ballot_sync(kFullWarp, begin + lane < end && keys[begin + lane] < low));
}

// Calls f(tap, hit, neighbour) for the taps before the centre, in order, by every lane of a warp, without those that no
// lane hits. Keys ascend and differ: one search finds a column of cells, for all lanes near each other. Rows are fewer
// than 2^29, so places fit 32 bits.
template <typename F>
__device__ __forceinline__ void for_first_half(const uint64_t* __restrict__ keys, int32_t n, int32_t p, int kernel_size,
                                               uint64_t* window /* [kWindow], shared */, const F& f) {
  const int lane = threadIdx.x % kWarp, radius = kernel_size / 2, centre = radius * kernel_size + radius;
  const uint64_t key = p < n ? keys[p] : 0;
  const int x = static_cast<int>(key >> 32 & kAxisMask), y = static_cast<int>(key >> 16 & kAxisMask);
  const int z = static_cast<int>(key & kAxisMask), top = static_cast<int>(kAxisMask);
  for (int column = 0; column <= centre; ++column) {
    const int dx = column / kernel_size - radius, dy = column % kernel_size - radius;
    const bool within = p < n && x + dx >= 0 && x + dx <= top && y + dy >= 0 && y + dy <= top;
    const unsigned asking = __ballot_sync(kFullWarp, within);
    if (!asking) continue;
    const int first = __ffs(asking) - 1, end = column == centre ? radius : kernel_size;
    const uint64_t base = key - static_cast<uint64_t>(z) + (static_cast<uint64_t>(static_cast<int64_t>(dx)) << 32) +
                          (static_cast<uint64_t>(static_cast<int64_t>(dy)) << 16);
    const uint64_t low = base + static_cast<uint64_t>(max(z - radius, 0));
    const int32_t before = p - lane + first;  // the voxel of the first lane that asks; its neighbours come earlier
    const int32_t begin = column == centre ? max(before - radius, 0)
                                           : search_together(keys, before, __shfl_sync(kFullWarp, low, first));
    __syncwarp();
    for (int w = lane; w < kWindow; w += kWarp) window[w] = begin + w < n ? keys[begin + w] : ~uint64_t{0};
    __syncwarp();
    const auto at = [&](int32_t q) { return q - begin < kWindow ? window[q - begin] : q < n ? keys[q] : ~uint64_t{0}; };
    int32_t cursor = p;
    uint64_t next = ~uint64_t{0};
    if (within) {
      cursor = partition_point(begin, min(begin + kWindow, p), [&](int32_t q) { return window[q - begin] < low; });
      if (cursor == begin + kWindow)
        cursor = partition_point(cursor, p, [&](int32_t q) { return keys[q] < low; });
      next = at(cursor);
    }
    const int last = min(z - radius + end - 1, top);
    if (!__any_sync(kFullWarp, within && last >= 0 && next <= base + static_cast<uint64_t>(last))) continue;
    for (int kz = 0; kz < end; ++kz) {
      const int wanted = z - radius + kz;
      const bool hit = within && wanted >= 0 && wanted <= top && next == base + static_cast<uint64_t>(wanted);
      f(column * kernel_size + kz, hit, cursor);
      if (hit) next = at(++cursor);
    }
  }
}

GSIM3D_HD int64_t half_taps(int64_t kernel_size) { return kernel_size * kernel_size * kernel_size / 2; }

// Fills counts that are not zero.
__global__ void __launch_bounds__(kThreads) count_pairs_kernel(Build build) {
  __shared__ uint64_t windows[kThreads / kWarp][kWindow];
  const MapArrays map = build.maps[blockIdx.y];
  const int32_t p = static_cast<int32_t>(thread_index());
  const int32_t n = static_cast<int32_t>(build.counts[count_at(map.stage, kVoxels)]);
  if (p / kWarp * kWarp >= n) return;
  uint32_t* found = build.found + map.begin + p / kWarp;
  for_first_half(build.stages[map.stage].voxels, n, p, map.kernel_size, windows[threadIdx.x / kWarp],
                 [&](int tap, bool hit, int32_t) {
                   const unsigned hits = __ballot_sync(kFullWarp, hit);
                   if (threadIdx.x % kWarp == 0) found[tap * build.n_warps] = __popc(hits);
                 });
}

__global__ void store_pair_counts_kernel(Build build) {
  for (int64_t k = threadIdx.x; k < build.n_maps; k += blockDim.x) {
    const MapArrays map = build.maps[k];
    const int64_t end = map.begin + half_taps(map.kernel_size) * build.n_warps;
    build.counts[pairs_at(build.n_stages, k)] = build.starts[end] - build.starts[map.begin];
  }
}

// A pair seen from its other end belongs to the mirrored tap; neighbours at one offset ascend with the voxel, so both
// lists come out ascending.
__global__ void __launch_bounds__(kThreads) write_pairs_kernel(Build build, const MapResults* results) {
  __shared__ uint64_t windows[kThreads / kWarp][kWindow];
  const MapArrays map = build.maps[blockIdx.y];
  const MapResults to = results[blockIdx.y];
  const int32_t p = static_cast<int32_t>(thread_index());
  const int32_t n = static_cast<int32_t>(build.counts[count_at(map.stage, kVoxels)]);
  const int64_t n_pairs = 2 * build.counts[pairs_at(build.n_stages, blockIdx.y)];
  const uint32_t* starts = build.starts + map.begin;
  const auto pairs_before = [&](int64_t tap) { return int64_t{starts[tap * build.n_warps] - starts[0]}; };
  const int64_t n_taps = int64_t{map.kernel_size} * map.kernel_size * map.kernel_size;
  if (p <= n_taps)
    to.cu_taps[p] = n_pairs == 0 ? 0 : p <= n_taps / 2 ? pairs_before(p) : n_pairs - pairs_before(n_taps - p);
  for (int64_t i = n_pairs + p; i < to.n_pairs; i += int64_t{gridDim.x} * kThreads) to.tap_in[i] = to.tap_out[i] = 0;
  if (p / kWarp * kWarp >= n) return;
  const unsigned lower = (1u << threadIdx.x % kWarp) - 1;
  for_first_half(build.stages[map.stage].voxels, n, p, map.kernel_size, windows[threadIdx.x / kWarp],
                 [&](int tap, bool hit, int32_t q) {
                   const unsigned hits = __ballot_sync(kFullWarp, hit);
                   if (!hit) return;
                   const int64_t at = starts[tap * build.n_warps + p / kWarp] - starts[0] + __popc(hits & lower);
                   const int64_t mirrored = n_pairs - pairs_before(tap + 1) + at - pairs_before(tap);
                   to.tap_in[at] = q;
                   to.tap_out[at] = p;
                   to.tap_in[mirrored] = p;
                   to.tap_out[mirrored] = q;
                 });
}

// One block a stage: clouds are few.
__global__ void __launch_bounds__(kThreads) count_patches_kernel(Build build) {
  using Scan = cub::BlockScan<int64_t, kThreads>;
  __shared__ typename Scan::TempStorage storage;
  const StageArrays& stage = build.stages[blockIdx.x];
  int64_t* stage_counts = build.counts + count_at(blockIdx.x, kRows);
  const int64_t n = stage_counts[kClouds], patch_size = stage.patch_size;
  int64_t patches_before = 0, keys_before = 0;
  for (int64_t first = 0; first < n; first += kThreads) {
    const int64_t c = first + threadIdx.x;
    int64_t size = 0;
    if (c < n) {
      stage.cu_clouds[c] = stage.run_starts[stage.members[c]];
      size = stage.run_starts[stage.members[c + 1]] - stage.cu_clouds[c];
    }
    const int64_t patches = (size + patch_size - 1) / patch_size,
                  keys = size < patch_size ? size : patches * patch_size;
    int64_t at, total;
    Scan(storage).ExclusiveSum(patches, at, total);
    if (c < n) stage.cu_patches[c] = static_cast<uint32_t>(patches_before + at);
    patches_before += total;
    __syncthreads();
    Scan(storage).ExclusiveSum(keys, at, total);
    if (c < n) stage.cu_keys[c] = static_cast<uint32_t>(keys_before + at);
    keys_before += total;
    __syncthreads();
  }
  if (threadIdx.x > 0) return;
  stage.cu_clouds[n] = static_cast<uint32_t>(stage_counts[kRows]);
  stage.cu_patches[n] = static_cast<uint32_t>(patches_before);
  stage.cu_keys[n] = static_cast<uint32_t>(keys_before);
  stage_counts[kPatches] = patches_before;
  stage_counts[kKeys] = keys_before;
}

__global__ void __launch_bounds__(kThreads) write_patches_kernel(Build build, const StageResults* results) {
  const StageArrays& stage = build.stages[blockIdx.y];
  const StageResults& to = results[blockIdx.y];
  const int64_t* own = build.counts + count_at(blockIdx.y, kRows);
  const int64_t n_clouds = own[kClouds], n_keys = own[kKeys], patch_size = stage.patch_size, i = thread_index();
  if (i <= to.n_clouds) to.cu_clouds[i] = stage.cu_clouds[min(i, n_clouds)];
  if (i == 0) to.cu_q[0] = to.cu_k[0] = 0;
  if (i < own[kPatches]) {
    const int64_t c = segment_of(stage.cu_patches, n_clouds, i), end = (i - stage.cu_patches[c] + 1) * patch_size;
    to.cu_q[i + 1] = min(stage.cu_clouds[c] + end, int64_t{stage.cu_clouds[c + 1]});
    to.cu_k[i + 1] = min(stage.cu_keys[c] + end, int64_t{stage.cu_keys[c + 1]});
  } else if (i < to.n_patches) {
    to.cu_q[i + 1] = own[kRows];
    to.cu_k[i + 1] = n_keys;
  }
  if (i >= n_keys) {
    for (int r = 0; r < kSerializations && i < to.n_keys; ++r) to.kv_rows[r * to.n_keys + i] = 0;
    return;
  }
  const int64_t c = segment_of(stage.cu_keys, n_clouds, i), begin = stage.cu_clouds[c];
  const int64_t size = stage.cu_clouds[c + 1] - begin, local = i - stage.cu_keys[c],
                from = local / patch_size * patch_size;
  const int64_t place = begin + min(from, max(size - patch_size, int64_t{0})) + local - from;
#pragma unroll
  for (int r = 0; r < kSerializations; ++r)
    to.kv_rows[r * to.n_keys + i] = stage.rows[stage.curves[r] * build.room + place];
}

}  // namespace

void find_voxels(const Build& build, const StageArrays* stages, int cloud_bits, const Workspace& workspace,
                 Stream stream) {
  sort_rows(kOp,
            {.keys = stages[0].cells,
             .n_rows = build.n_stages,
             .room = build.room,
             .bits = 48 + cloud_bits,
             .sizes = build.counts + count_at(0, kRows),
             .size_stride = kStageCounts,
             .squeeze = build.depth,
             .sorted = stages[0].sorted,
             .index = stages[0].voxel_rows},
            workspace, stream);
  launch(kOp, find_voxels_kernel, blocks_for(kOp, build.n_stages * tiles_of(build.room), 1), kThreads, 0, stream,
         build);
}

void count_pairs(const Build& build, int64_t n_counts, const Workspace& workspace, Stream stream) {
  fill_zero(kOp, build.found, n_counts, stream);
  launch(kOp, count_pairs_kernel, dim3(blocks_of(build.room), static_cast<unsigned>(build.n_maps)), kThreads, 0, stream,
         build);
  exclusive_sums(kOp, build.found, n_counts, build.starts, workspace, stream);
  launch(kOp, store_pair_counts_kernel, 1, kWarp, 0, stream, build);
}

void count_patches(const Build& build, Stream stream) {
  launch(kOp, count_patches_kernel, static_cast<unsigned>(build.n_stages), kThreads, 0, stream, build);
}

void write_patches(const Build& build, const StageResults* results, int64_t most, Stream stream) {
  launch(kOp, write_patches_kernel, dim3(blocks_of(most), static_cast<unsigned>(build.n_stages)), kThreads, 0, stream,
         build, results);
}

void write_pairs(const Build& build, const MapResults* results, int64_t most, Stream stream) {
  launch(kOp, write_pairs_kernel, dim3(blocks_of(most), static_cast<unsigned>(build.n_maps)), kThreads, 0, stream,
         build, results);
}

}  // namespace gsim3d::cuda
