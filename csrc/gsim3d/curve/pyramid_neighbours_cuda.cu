// Voxels, convolution maps and attention patches of the stages.
#include <cub/block/block_scan.cuh>

#include "gsim3d/curve/pyramid_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = kPyramidThreads;
constexpr const char* kOp = "build_pyramid";

__global__ void flag_voxels_kernel(const uint64_t* __restrict__ sorted, int64_t room, const int64_t* n_rows,
                                   uint32_t* __restrict__ flags) {
  const int64_t i = thread_index();
  if (i < room) flags[i] = i < *n_rows && (i == 0 || sorted[i] != sorted[i - 1]);
}

// `sums`: flags before each place, over all stages.
__global__ void list_voxels_kernel(const uint64_t* __restrict__ sorted, const uint32_t* __restrict__ sums,
                                   StageArrays stage, int64_t* stage_counts) {
  const int64_t i = thread_index(), n = stage_counts[kRows];
  if (i == 0) {
    stage.cu_voxels[sums[n] - sums[0]] = static_cast<uint32_t>(n);
    stage_counts[kVoxels] = sums[n] - sums[0];
  }
  if (i >= n) return;
  const bool first = i == 0 || sorted[i] != sorted[i - 1];
  const uint32_t voxel = sums[i] - sums[0] + first - 1;
  stage.row_voxel[stage.voxel_rows[i]] = voxel;
  if (!first) return;
  stage.cu_voxels[voxel] = static_cast<uint32_t>(i);
  stage.voxels[voxel] = sorted[i];
}

// Calls f(tap, neighbour) for the taps before the centre, in order and by every lane of a warp; neighbour is n where the
// cell is empty. Keys ascend and differ, so one search finds a column of cells.
template <typename F>
__device__ __forceinline__ void for_first_half(const uint64_t* __restrict__ keys, int64_t n, int64_t p,
                                               int kernel_size, const F& f) {
  const int radius = kernel_size / 2, centre = radius * kernel_size + radius;
  const uint64_t key = p < n ? keys[p] : 0;
  const int x = static_cast<int>(key >> 32 & kAxisMask), y = static_cast<int>(key >> 16 & kAxisMask);
  const int z = static_cast<int>(key & kAxisMask), top = static_cast<int>(kAxisMask);
  for (int column = 0; column <= centre; ++column) {
    const int dx = column / kernel_size - radius, dy = column % kernel_size - radius;
    const bool within = p < n && x + dx >= 0 && x + dx <= top && y + dy >= 0 && y + dy <= top;
    const uint64_t base = key - static_cast<uint64_t>(z) + (static_cast<uint64_t>(static_cast<int64_t>(dx)) << 32) +
                          (static_cast<uint64_t>(static_cast<int64_t>(dy)) << 16);
    const uint64_t low = base + static_cast<uint64_t>(max(z - radius, 0));
    int64_t cursor = p;
    if (within)
      cursor = partition_point(column == centre ? max(p - radius, int64_t{0}) : int64_t{0}, p,
                               [&](int64_t q) { return keys[q] < low; });
    const int end = column == centre ? radius : kernel_size;
    for (int kz = 0; kz < end; ++kz) {
      const int at = z - radius + kz;
      const bool hit = within && at >= 0 && at <= top && cursor < n && keys[cursor] == base + static_cast<uint64_t>(at);
      f(column * kernel_size + kz, hit ? cursor : n);
      cursor += hit;
    }
  }
}

__global__ void count_pairs_kernel(const uint64_t* __restrict__ keys, const int64_t* n_voxels, int kernel_size,
                                   int64_t n_warps, uint32_t* __restrict__ counts) {
  const int64_t p = thread_index(), n = *n_voxels;
  if (p / kWarp >= n_warps) return;
  const auto write = [&](int tap, uint32_t count) {
    if (threadIdx.x % kWarp == 0) counts[tap * n_warps + p / kWarp] = count;
  };
  if (p / kWarp * kWarp >= n) {
    for (int tap = 0; tap < kernel_size * kernel_size * kernel_size / 2; ++tap) write(tap, 0);
    return;
  }
  for_first_half(keys, n, p, kernel_size,
                 [&](int tap, int64_t q) { write(tap, __popc(__ballot_sync(kFullWarp, q < n))); });
}

__global__ void store_pairs_count_kernel(const uint32_t* starts, int64_t begin, int64_t end, int64_t* count) {
  *count = starts[end] - starts[begin];
}

// Pairs before a tap of the half before the centre.
__device__ __forceinline__ int64_t pairs_before(const MapArrays& map, int64_t tap) {
  return map.starts[tap * map.n_warps] - map.starts[0];
}

// A pair seen from its other end belongs to the mirrored tap; neighbours at one offset ascend with the voxel, so both
// lists come out ascending.
__global__ void write_pairs_kernel(const uint64_t* __restrict__ keys, int64_t n, MapArrays map, int64_t n_pairs,
                                   int64_t* __restrict__ tap_in, int64_t* __restrict__ tap_out) {
  const int64_t p = thread_index();
  if (p / kWarp * kWarp >= n) return;
  const unsigned before = (1u << threadIdx.x % kWarp) - 1;
  for_first_half(keys, n, p, static_cast<int>(map.kernel_size), [&](int tap, int64_t q) {
    const unsigned found = __ballot_sync(kFullWarp, q < n);
    if (q >= n) return;
    const int64_t at = map.starts[tap * map.n_warps + p / kWarp] - map.starts[0] + __popc(found & before);
    const int64_t mirrored = n_pairs - pairs_before(map, tap + 1) + at - pairs_before(map, tap);
    tap_in[at] = q;
    tap_out[at] = p;
    tap_in[mirrored] = p;
    tap_out[mirrored] = q;
  });
}

__global__ void write_taps_kernel(MapArrays map, int64_t n_pairs, int64_t* __restrict__ cu_taps) {
  const int64_t n_taps = map.kernel_size * map.kernel_size * map.kernel_size, tap = thread_index();
  if (tap > n_taps) return;
  cu_taps[tap] = tap <= n_taps / 2 ? pairs_before(map, tap) : n_pairs - pairs_before(map, n_taps - tap);
}

// One block: clouds are few.
__global__ void count_patches_kernel(StageArrays stage, int64_t patch_size, int64_t* stage_counts) {
  using Scan = cub::BlockScan<int64_t, kThreads>;
  __shared__ typename Scan::TempStorage storage;
  const int64_t n = stage_counts[kClouds];
  int64_t patches_before = 0, keys_before = 0;
  for (int64_t first = 0; first < n; first += kThreads) {
    const int64_t c = first + threadIdx.x;
    int64_t size = 0;
    if (c < n) {
      stage.cu_clouds[c] = stage.run_starts[stage.members[c]];
      size = stage.run_starts[stage.members[c + 1]] - stage.cu_clouds[c];
    }
    const int64_t patches = (size + patch_size - 1) / patch_size, keys = size < patch_size ? size : patches * patch_size;
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

__global__ void write_offsets_kernel(StageArrays stage, StageSizes sizes, int64_t patch_size, int64_t* __restrict__ cu_q,
                                     int64_t* __restrict__ cu_k) {
  const int64_t p = thread_index() - 1;
  if (p >= sizes.patches) return;
  if (p < 0) {
    cu_q[0] = cu_k[0] = 0;
    return;
  }
  const int64_t c = segment_of(stage.cu_patches, sizes.clouds, p);
  const int64_t end = (p - stage.cu_patches[c] + 1) * patch_size;
  cu_q[p + 1] = min(stage.cu_clouds[c] + end, int64_t{stage.cu_clouds[c + 1]});
  cu_k[p + 1] = min(stage.cu_keys[c] + end, int64_t{stage.cu_keys[c + 1]});
}

__global__ void write_keys_kernel(StageArrays stage, StageSizes sizes, int64_t patch_size,
                                  const int64_t* __restrict__ order, int64_t* __restrict__ kv_rows) {
  const int64_t i = thread_index();
  if (i >= kSerializations * sizes.keys) return;
  const int64_t r = i / sizes.keys, key = i % sizes.keys, c = segment_of(stage.cu_keys, sizes.clouds, key);
  const int64_t begin = stage.cu_clouds[c], size = stage.cu_clouds[c + 1] - begin, local = key - stage.cu_keys[c];
  const int64_t from = local / patch_size * patch_size;
  kv_rows[i] = order[r * sizes.rows + begin + min(from, max(size - patch_size, int64_t{0})) + local - from];
}

__global__ void write_voxels_kernel(StageArrays stage, StageSizes sizes, int64_t* __restrict__ row_voxel,
                                    int64_t* __restrict__ voxel_rows, int64_t* __restrict__ cu_voxel_rows) {
  const int64_t i = thread_index();
  if (i < sizes.rows) {
    row_voxel[i] = stage.row_voxel[i];
    voxel_rows[i] = stage.voxel_rows[i];
  }
  if (i <= sizes.voxels) cu_voxel_rows[i] = stage.cu_voxels[i];
}

}  // namespace

void find_voxels(StageArrays* stages, int64_t n_stages, int64_t room, int cloud_bits, int64_t* counts,
                 const Workspace& workspace, Stream stream) {
  uint64_t* sorted = workspace.take<uint64_t>(n_stages * room);
  uint32_t* flags = workspace.take<uint32_t>(n_stages * room + 1);
  uint32_t* sums = workspace.take<uint32_t>(n_stages * room + 1);
  sort_rows(kOp,
            {.keys = stages[0].cells,
             .n_rows = n_stages,
             .room = room,
             .bits = 48 + cloud_bits,
             .sizes = counts + count_at(0, kRows),
             .size_stride = kStageCounts,
             .sorted = sorted,
             .index = stages[0].voxel_rows},
            workspace, stream);
  for (int64_t s = 0; s < n_stages; ++s)
    launch(kOp, flag_voxels_kernel, blocks_of(room), kThreads, 0, stream, sorted + s * room, room,
           counts + count_at(s, kRows), flags + s * room);
  exclusive_sums(kOp, flags, n_stages * room + 1, sums, workspace, stream);
  for (int64_t s = 0; s < n_stages; ++s)
    launch(kOp, list_voxels_kernel, blocks_of(room), kThreads, 0, stream, sorted + s * room, sums + s * room, stages[s],
           counts + count_at(s, kRows));
}

void count_pairs(const StageArrays* stages, const PyramidSpec& spec, int64_t room, int64_t* counts, MapArrays* maps,
                 const Workspace& workspace, Stream stream) {
  const int64_t n_warps = (room + kWarp - 1) / kWarp, n_kernels = spec.cu_kernels[spec.n_stages];
  const auto half = [&](int64_t k) {
    return spec.kernel_sizes[k] * spec.kernel_sizes[k] * spec.kernel_sizes[k] / 2;
  };
  int64_t total = 0;
  for (int64_t k = 0; k < n_kernels; ++k) total += half(k) * n_warps;
  check(total * kWarp < int64_t{1} << 32, kOp, ": ", room, " rows are too many for these kernel_sizes");
  uint32_t* found = workspace.take<uint32_t>(total + 1);
  uint32_t* starts = workspace.take<uint32_t>(total + 1);
  int64_t begin = 0;
  for (int64_t s = 0; s < spec.n_stages; ++s)
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k) {
      maps[k] = {starts + begin, spec.kernel_sizes[k], n_warps};
      launch(kOp, count_pairs_kernel, blocks_of(room), kThreads, 0, stream, stages[s].voxels,
             counts + count_at(s, kVoxels), spec.kernel_sizes[k], n_warps, found + begin);
      begin += half(k) * n_warps;
    }
  exclusive_sums(kOp, found, total + 1, starts, workspace, stream);
  for (int64_t k = 0; k < n_kernels; ++k)
    launch(kOp, store_pairs_count_kernel, 1, 1, 0, stream, maps[k].starts, 0, half(k) * n_warps,
           counts + pairs_at(spec.n_stages, k));
}

void count_patches(const StageArrays& stage, int64_t patch_size, int64_t* stage_counts, Stream stream) {
  launch(kOp, count_patches_kernel, 1, kThreads, 0, stream, stage, patch_size, stage_counts);
}

void write_patches(const StageArrays& stage, const StageSizes& sizes, int64_t patch_size, const int64_t* order,
                   int64_t* cu_q, int64_t* cu_k, int64_t* kv_rows, Stream stream) {
  launch(kOp, write_offsets_kernel, blocks_of(sizes.patches + 1), kThreads, 0, stream, stage, sizes, patch_size, cu_q,
         cu_k);
  launch(kOp, write_keys_kernel, blocks_of(kSerializations * sizes.keys), kThreads, 0, stream, stage, sizes, patch_size,
         order, kv_rows);
}

void write_voxels(const StageArrays& stage, const StageSizes& sizes, int64_t* row_voxel, int64_t* voxel_rows,
                  int64_t* cu_voxel_rows, Stream stream) {
  launch(kOp, write_voxels_kernel, blocks_of(sizes.rows + 1), kThreads, 0, stream, stage, sizes, row_voxel, voxel_rows,
         cu_voxel_rows);
}

void write_pairs(const StageArrays& stage, const MapArrays& map, int64_t n_voxels, int64_t n_pairs, int64_t* tap_in,
                 int64_t* tap_out, int64_t* cu_taps, Stream stream) {
  launch(kOp, write_pairs_kernel, blocks_of(n_voxels), kThreads, 0, stream, stage.voxels, n_voxels, map, n_pairs, tap_in,
         tap_out);
  launch(kOp, write_taps_kernel, blocks_of(map.kernel_size * map.kernel_size * map.kernel_size + 1), kThreads, 0, stream,
         map, n_pairs, cu_taps);
}

}  // namespace gsim3d::cuda
