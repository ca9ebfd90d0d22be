// The order in which the tensor cores take rows, and where the taps of each row read.
//
// Rows with the same neighbours lie next to each other, so that a tile of rows multiplies with few taps beside those it
// has: each row's occupied taps make a key, and rows are sorted by it (as in spconv 2; Yan et al., SECOND, 2018). Keys
// are ranks in a Gray code, in which neighbouring tiles differ in one tap, with the rarest taps first.
#include <algorithm>

#include "gsim3d/curve/curve_device.cuh"
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kThreads = 256;
constexpr int kKeyBits = 27;
constexpr int kFewKeyBits = 16;      // enough where rows have many neighbours, and two passes of the sort less
constexpr int64_t kManyPairs = 4;    // a row
constexpr int64_t kWindow = 65536;   // rows sorted among each other, whose values the L2 cache holds
constexpr int64_t kMaxWindows = 32;  // their numbers and the keys fit four digits of the sort
constexpr int64_t kUnsorted = 1024;  // so few rows are faster multiplied than sorted

// Corners, edges and faces of 3 x 3 x 3 cells, from the highest bit on.
__constant__ uint8_t kBitOfTap[27] = {26, 18, 25, 17, 6, 16, 24, 15, 23, 14, 5,  13, 4, 0,
                                      3,  12, 2,  11, 22, 10, 21, 9, 1, 8,  20, 7, 19};

__device__ uint32_t key_of(int32_t tap, int32_t taps) {
  return 1u << (taps == 27 ? kBitOfTap[tap] : static_cast<int32_t>(int64_t{tap} * kKeyBits / taps));
}

__device__ uint32_t gray_rank(uint32_t key) {
#pragma unroll
  for (int step = 1; step < 32; step *= 2) key ^= key >> step;
  return key;
}

struct Pairs {
  const int64_t* written;
  const int64_t* read;
  const int64_t* cu_taps;
  int64_t n_pairs;
  int32_t taps;

  __device__ int32_t tap_of(int64_t i) const {  // -1: none, or the centre's
    int32_t low = 0, high = taps;
    while (high - low > 1) {
      const int32_t middle = (low + high) / 2;
      (cu_taps[middle] <= i ? low : high) = middle;
    }
    return cu_taps[low] <= i && i < cu_taps[low + 1] && low != taps / 2 ? low : -1;
  }
};

__global__ void __launch_bounds__(kThreads) mark_taps(Pairs pairs, int64_t n_voxels, uint32_t* keys) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= pairs.n_pairs) return;
  const int64_t voxel = pairs.written[i];
  const int32_t tap = pairs.tap_of(i);
  if (tap >= 0 && inside(voxel, n_voxels)) atomicOr(keys + voxel, key_of(tap, pairs.taps));
}

// For the i-th of voxel_rows its window and the rank of its taps.
__global__ void __launch_bounds__(kThreads)
    rank_rows(Sources sources, const int64_t* row_voxel, const uint32_t* keys, int64_t window, int bits,
              uint64_t* ranks) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= sources.n_rows) return;
  const int64_t row = sources.voxel_rows[i], voxel = inside(row, sources.n_rows) ? row_voxel[row] : -1;
  const uint32_t key = inside(voxel, sources.n_voxels) ? keys[voxel] : 0;
  ranks[i] = static_cast<uint64_t>(i / window) << bits | gray_rank(key) >> (kKeyBits - bits);
}

// index[place] of voxel_rows lies at this place; without an index all lie where they are.
__global__ void __launch_bounds__(kThreads)
    place_rows(Sources sources, const uint32_t* index, int32_t pitch, int32_t* order, int32_t* places) {
  const int32_t place = blockIdx.x * kThreads + threadIdx.x;
  if (place >= pitch) return;
  int64_t row = -1;
  if (place < sources.n_rows) {
    const int32_t i = index != nullptr ? static_cast<int32_t>(index[place]) : place;
    row = sources.voxel_rows[i];
    places[i] = place;
  }
  order[place] = inside(row, sources.n_rows) ? static_cast<int32_t>(row) : -1;
}

__global__ void __launch_bounds__(kThreads)
    list_sources(Pairs pairs, Sources sources, const int32_t* places, int32_t pitch, int32_t words, int32_t* table,
                 uint32_t* active) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= pairs.n_pairs) return;
  const int64_t voxel = pairs.written[i];
  const int32_t tap = pairs.tap_of(i), source = sources.of(pairs.read[i]);
  if (tap < 0 || source < 0 || !inside(voxel, sources.n_voxels)) return;
  const Range rows = range_of(sources.cu_voxel_rows, voxel, sources.n_rows);
  for (int64_t j = rows.begin; j < rows.end; ++j) {
    const int32_t place = places[j];
    table[wide_product(tap, pitch) + place] = source;
    uint32_t* word = active + static_cast<int64_t>(place / kConvGroupRows) * words + tap / 32;
    const uint32_t bit = 1u << tap % 32;
    if ((*static_cast<volatile uint32_t*>(word) & bit) == 0) atomicOr(word, bit);
  }
}

}  // namespace

RowPlan row_plan_in(const int32_t* memory, int64_t n_rows, int64_t taps, bool mirrored) {
  const int64_t pitch = round_up(n_rows, kConvPlanStep);
  return {memory, memory + pitch, reinterpret_cast<const uint32_t*>(memory + (taps + 1) * pitch),
          static_cast<int32_t>(pitch), static_cast<int32_t>((taps + 31) / 32), mirrored};
}

void make_row_plan(const char* op, const SparseConvMap& map, bool transposed, int32_t* memory,
                   const Workspace& workspace, Stream stream) {
  const int64_t taps = taps_of(map);
  const RowPlan plan = row_plan_in(memory, map.n_rows, taps, false);
  int32_t *order = memory, *table = memory + plan.pitch;
  auto* active = reinterpret_cast<uint32_t*>(table + taps * plan.pitch);
  const Sources sources = sources_of(map);
  const Pairs pairs{transposed ? map.tap_in : map.tap_out, transposed ? map.tap_out : map.tap_in, map.cu_taps,
                    map.n_pairs, static_cast<int32_t>(taps)};
  const unsigned pair_blocks = blocks_for(op, map.n_pairs, kThreads), row_blocks = blocks_for(op, map.n_rows, kThreads);

  uint32_t* index = nullptr;
  if (map.n_rows > kUnsorted) {
    uint32_t* keys = workspace.take<uint32_t>(map.n_voxels);
    auto* ranks = workspace.take<uint64_t>(map.n_rows);
    index = workspace.take<uint32_t>(map.n_rows);
    fill_zero(op, keys, map.n_voxels, stream);
    launch(op, mark_taps, pair_blocks, kThreads, 0, stream, pairs, map.n_voxels, keys);
    const int64_t window = std::max(kWindow, round_up(map.n_rows, kMaxWindows) / kMaxWindows);
    const int bits = map.n_pairs > kManyPairs * map.n_rows ? kFewKeyBits : kKeyBits;
    launch(op, rank_rows, row_blocks, kThreads, 0, stream, sources, map.row_voxel, keys, window, bits, ranks);
    SortRows sort{};
    sort.keys = ranks;
    sort.n_rows = 1;
    sort.room = map.n_rows;
    sort.bits = bits;
    while ((map.n_rows - 1) / window >> (sort.bits - bits) > 0) ++sort.bits;
    sort.index = index;
    sort_rows(op, sort, workspace, stream);
  }
  int32_t* places = workspace.take<int32_t>(map.n_rows);
  launch(op, place_rows, blocks_for(op, plan.pitch, kThreads), kThreads, 0, stream, sources, index, plan.pitch, order,
         places);
  if (plan.pitch > 0)
    check_cuda(cudaMemsetAsync(table, 0xff, sizeof(int32_t) * taps * plan.pitch, native(stream)), op);
  fill_zero(op, active, plan.pitch / kConvGroupRows * plan.words, stream);
  launch(op, list_sources, pair_blocks, kThreads, 0, stream, pairs, sources, places, plan.pitch, plan.words, table,
         active);
}

}  // namespace gsim3d::cuda::conv

namespace gsim3d::cuda {

void sparse_conv_plan(const SparseConvMap& map, int32_t* plan, const Workspace& workspace, Stream stream) {
  conv::make_row_plan("sparse_conv_plan", map, false, plan, workspace, stream);
}

}  // namespace gsim3d::cuda
