// Inside of the CUDA rasterizer: where the list of each tile begins, and the entries put there.
#pragma once

#include <type_traits>

#include "gsim3d/raster/raster_project.cuh"

namespace gsim3d::raster {

// ---- offsets: where each tile's list begins, and how many tiles fit; one block ------------------------------------

// The images whose slots fit, as the end of their tiles.
template <typename T>
__device__ int64_t images_by_slots(const Job<T>& job, int64_t first, int64_t last) {
  uint64_t slots = 0;
  for (int64_t base = first; base < last; base += blockDim.x) {
    const int64_t i = base + threadIdx.x;
    uint64_t total;
    const uint64_t n = i < last ? job.slot_count[i] : 0, end = slots + block_sum(n, total);
    if (i < last) job.slot_count[i] = end - n;
    const int n_fit = __syncthreads_count(i < last && end <= static_cast<uint64_t>(job.limits.slots));
    if (n_fit < static_cast<int>(blockDim.x)) return (base + n_fit) * job.n_tiles;
    slots += total;
  }
  return last * job.n_tiles;
}

// The bin of a tile by the length of its list; long lists come first.
__device__ __forceinline__ uint32_t bin_of(uint32_t length) {
  return kBins - 1 - min(length / kBinWidth, uint32_t{kBins - 1});
}
template <typename T>
__device__ uint32_t bin_of(const Job<T>& job, int64_t tile) {
  return bin_of(job.tile_begin[tile + 1] - job.tile_begin[tile]);
}

template <typename T>
__device__ void find_offsets(const Job<T>& job) {
  constexpr int kItems = 8;  // tiles of a thread
  __shared__ uint32_t bins[kWarp][kBins];  // by warp, so that few threads meet at one
  Group& group = *job.group;
  const int64_t begin = group.tile_begin, end = group.last * job.n_tiles;  // read before thread 0 writes the group
  const int64_t by_slots = group.resumed ? begin : images_by_slots(job, group.first, group.last);
  const uint64_t max_entries = job.limits.entries, max_covered = job.limits.slots / kQuarters;  // of a part
  uint32_t* const of_warp = bins[threadIdx.x / kWarp];
  for (int i = threadIdx.x; i < kWarp * kBins; i += blockDim.x) bins[0][i] = 0;
  uint64_t before = 0, others_before = 0;
  uint32_t fit[2] = {};  // tiles, whole images
  for (int64_t base = begin; base < end; base += int64_t{blockDim.x} * kItems) {
    const int64_t mine = base + int64_t{threadIdx.x} * kItems;
    uint32_t counts[kItems], more[kItems] = {};  // of active tiles; of the others
    uint64_t sum = 0, more_sum = 0, total, more_total = 0;
    for (int i = 0; i < kItems; ++i) {
      counts[i] = mine + i < end ? job.cursor[mine + i] : 0;
      if (job.covered && mine + i < end) more[i] = job.covered[mine + i] - counts[i];
      sum += counts[i], more_sum += more[i];
    }
    uint64_t position = before + block_sum(sum, total) - sum, others = 0;
    if (job.covered) others = others_before + block_sum(more_sum, more_total) - more_sum;
    int64_t to_image_end = job.n_tiles - mine % job.n_tiles;
    for (int i = 0; i < kItems; ++i) {
      if (mine + i >= end) break;
      job.tile_begin[mine + i] = job.cursor[mine + i] = static_cast<uint32_t>(position);
      position += counts[i], others += more[i];
      atomicAdd(of_warp + bin_of(counts[i]), 1u);
      fit[0] += position <= max_entries && position + others <= max_covered ? 1 : 0;
      if (--to_image_end == 0) fit[1] += position <= max_entries ? 1 : 0, to_image_end = job.n_tiles;
    }
    before += total, others_before += more_total;
    if (mine < end && mine + kItems >= end) job.tile_begin[end] = static_cast<uint32_t>(position);
  }
  uint64_t all_fit;
  block_sum(uint64_t{fit[1]} << 32 | fit[0], all_fit);
  const auto tiles_fit = static_cast<int64_t>(all_fit & 0xffffffffu), images_fit = static_cast<int64_t>(all_fit >> 32);
  const int64_t whole = min((group.first + images_fit) * job.n_tiles, by_slots);
  const int64_t stop = whole > begin ? whole : min(begin + tiles_fit, (group.first + 1) * job.n_tiles);
  if (stop < end) {  // the bins hold tiles that do not fit
    __syncthreads();
    for (int i = threadIdx.x; i < kWarp * kBins; i += blockDim.x) bins[0][i] = 0;
    __syncthreads();
    for (int64_t tile = begin + threadIdx.x; tile < stop; tile += blockDim.x)
      atomicAdd(of_warp + bin_of(job, tile), 1u);
  }
  __syncthreads();
  if (threadIdx.x < kWarp) {
    const int lane = threadIdx.x;
    uint32_t a = 0, b = 0;
    for (int w = 0; w < static_cast<int>(blockDim.x) / kWarp; ++w)
      a += bins[w][2 * lane], b += bins[w][2 * lane + 1];
    const uint32_t earlier = warp_sum(a + b) - a - b;
    job.bins[2 * lane] = earlier, job.bins[2 * lane + 1] = earlier + a;
  }
  if (threadIdx.x != 0) return;
  group.tile_end = stop;
  group.last = (group.tile_end + job.n_tiles - 1) / job.n_tiles;
  group.finished = group.tile_end % job.n_tiles == 0;
  group.in_parts = whole <= begin;
  group.x_end = static_cast<int>(group.tile_end % job.n_tiles % job.tiles_x);
  group.y_end = static_cast<int>(group.tile_end % job.n_tiles / job.tiles_x);
}

// ---- order: long lists first, so that none of them is begun last; within a bin they come in any order ---------------

template <typename T>
__device__ void find_order(const Job<T>& job) {
  const int64_t begin = job.group->tile_begin, end = job.group->tile_end;
  const int lane = threadIdx.x % kWarp;
  for (int64_t base = begin + int64_t{blockIdx.x} * kBlock; base < end; base += int64_t{gridDim.x} * kBlock) {
    const int64_t tile = base + threadIdx.x;
    const uint32_t bin = tile < end ? bin_of(job, tile) : kBins;
    const unsigned same = __match_any_sync(kFullWarp, bin);
    const int leader = __ffs(same) - 1;
    uint32_t position = 0;
    if (bin < kBins && lane == leader) position = atomicAdd(job.bins + bin, static_cast<uint32_t>(__popc(same)));
    position = __shfl_sync(kFullWarp, position, leader) + __popc(same & ((1u << lane) - 1));
    if (bin < kBins) job.order[position] = static_cast<uint32_t>(tile - begin);
  }
}

// ---- scatter: every record writes its entries; their order is whatever it is --------------------------------------

template <typename T>
struct Scattered {
  uint32_t pair;
  T z;
  Ellipse<T> ellipse;  // where many tiles are touched
};

template <typename T>
__device__ void scatter_rows(const Job<T>& job) {
  constexpr int kMost = 4;  // entries of a lane that wait for their places together
  __shared__ Walked<Scattered<T>> walked[kBlock];
  const Group group = *job.group;
  const int64_t n_chunks = count_chunks(job);
  const int lane = threadIdx.x % kWarp;
  for (int64_t chunk = blockIdx.x; chunk < n_chunks; chunk += gridDim.x) {
    const Rows rows(job, chunk);
    // What is known of the next image's pair is fetched while this one's is scattered.
    int64_t next = rows.first_image, next_pair = 0;
    PixelRect next_bounds{};
    T next_z = 0;
    const auto fetch = [&] {
      if (next >= group.last) return;
      next_pair = job.pair_begin[next] + rows.row - job.views[next].row_begin;
      if (rows.inside) next_bounds = job.bounds[next_pair], next_z = job.depths[next_pair];
    };
    fetch();
    while (next < group.last) {
      const int64_t image = next, pair = next_pair;
      const PixelRect bounds = next_bounds;
      Scattered<T> scattered;
      scattered.pair = static_cast<uint32_t>(pair), scattered.z = next_z;
      next = job.views[next].next;
      fetch();
      WarpTiles<Scattered<T>> tiles(bounds, walked + threadIdx.x / kWarp * kWarp);
      if (tiles.total == 0) continue;
      const int n = group.n_slots(squares_of(bounds, kTile), squares_of(bounds, kQuarter)), end = warp_sum(n);
      uint32_t slot = 0;
      if (lane == kWarp - 1)
        slot = job.first_slot(image, group) + atomicAdd(job.slot_cursor + image, static_cast<uint32_t>(end));
      if (tiles.many() && bounds.x0 < bounds.x1) scattered.ellipse = Ellipse<T>(job.records[pair]);
      tiles.share(scattered);
      const int64_t first_tile = image * job.n_tiles;
      // Entries base .. base + kCount * 32 - 1 of the warp.
      const auto put = [&](int base, auto count) {
        constexpr int kCount = decltype(count)::value;
        Entry<T> entry[kCount];
        uint32_t position[kCount] = {};
        unsigned same[kCount];  // lanes with an entry of the same tile
#pragma unroll
        for (int k = 0; k < kCount; ++k) {
          const auto place = tiles.at(base + k * kWarp);
          const Scattered<T>& owner = place.owner->load;
          const uint32_t quarters =
              tiles.many() ? owner.ellipse.touched(place.quarters, place.x, place.y) : place.quarters;
          entry[k] = Entry<T>::make(owner.z, word_of(owner.pair, quarters));
          const auto tile = static_cast<uint32_t>(place.y * job.tiles_x + place.x);
          same[k] = tiles.lanes_of(
              tile, place.used && group.has(first_tile + tile) && job.is_active(first_tile + tile));
          if (__ffs(same[k]) - 1 == lane)
            position[k] = atomicAdd(job.cursor + first_tile + tile, static_cast<uint32_t>(__popc(same[k])));
        }
#pragma unroll
        for (int k = 0; k < kCount; ++k) {
          const uint32_t first = __shfl_sync(kFullWarp, position[k], max(__ffs(same[k]) - 1, 0));
          if (same[k]) job.entries[first + __popc(same[k] & ((1u << lane) - 1))] = entry[k];
        }
      };
      int base = 0;
      for (; base + kMost * kWarp / 2 < tiles.total; base += kMost * kWarp)
        put(base, std::integral_constant<int, kMost>{});
      for (; base < tiles.total; base += kMost * kWarp / 2) put(base, std::integral_constant<int, kMost / 2>{});
      slot = __shfl_sync(kFullWarp, slot, kWarp - 1);
      if (n > 0) job.slot_begin[pair] = slot + end - n;
    }
  }
}

}  // namespace gsim3d::raster
