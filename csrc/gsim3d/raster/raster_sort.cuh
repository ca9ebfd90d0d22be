// Inside of the CUDA rasterizer: entries of every tile in order of depth, and from them the lists of its quarters. A
// block sorts one tile at a time, in registers; what is longer than these hold is sorted in runs that are merged in
// memory.
#pragma once

#include "gsim3d/raster/raster_lists.cuh"

namespace gsim3d::raster {

template <typename T>
constexpr int kSortItems = 256 / sizeof(Entry<T>);  // of a thread
template <typename T>
constexpr int kSortRun = kSortItems<T> * kBlock;

template <typename T>
__device__ __forceinline__ void put_in_order(Entry<T>& a, Entry<T>& b, bool ascending) {
  if ((b < a) == ascending) {
    const Entry<T> c = a;
    a = b, b = c;
  }
}

// Bitonic sort of kItems * kBlock entries; a thread holds kItems neighbours. `shared` holds as many.
template <int kItems, typename T>
__device__ void sort_block(Entry<T> (&mine)[kItems], Entry<T>* shared) {
  const int thread = threadIdx.x;
#pragma unroll
  for (int run = 2; run < kItems; run *= 2)
#pragma unroll
    for (int step = run / 2; step > 0; step /= 2)
#pragma unroll
      for (int i = 0; i < kItems; ++i)
        if (!(i & step)) put_in_order(mine[i], mine[i | step], !(i & run));
  for (int run = 1; run <= kBlock; run *= 2) {  // threads of a run
    const bool ascending = !(thread & run);
    for (int step = run / 2; step > 0; step /= 2) {
      const bool keep_smaller = ascending == !(thread & step);
      if (step >= kWarp) {
#pragma unroll
        for (int i = 0; i < kItems; ++i) shared[i * kBlock + thread] = mine[i];
        __syncthreads();
      }
#pragma unroll
      for (int i = 0; i < kItems; ++i) {
        const Entry<T> other = step >= kWarp ? shared[i * kBlock + (thread ^ step)] : mine[i].from_lane(step);
        if ((other < mine[i]) == keep_smaller) mine[i] = other;
      }
      if (step >= kWarp) __syncthreads();
    }
#pragma unroll
    for (int step = kItems / 2; step > 0; step /= 2)
#pragma unroll
      for (int i = 0; i < kItems; ++i)
        if (!(i & step)) put_in_order(mine[i], mine[i | step], ascending);
  }
}

// Sorts n <= kItems * kBlock entries and hands them to store(place, entry).
template <int kItems, typename T, typename F>
__device__ void sort_run(const Entry<T>* list, int n, Entry<T>* shared, const F& store) {
  Entry<T> mine[kItems];
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const int place = i * kBlock + threadIdx.x;
    mine[i] = place < n ? list[place] : Entry<T>::last();
  }
  sort_block<kItems>(mine, shared);
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const int place = static_cast<int>(threadIdx.x) * kItems + i;
    if (place < n) store(place, mine[i]);
  }
}

// Merges pairs of sorted runs of `run` entries; each thread finds where its outputs begin in both.
template <typename T>
__device__ void merge_runs(const Entry<T>* from, Entry<T>* to, int64_t n, int64_t run) {
  constexpr int kItems = 16;  // divides 2 * run, so that a thread's outputs are of one pair of runs
  for (int64_t begin = int64_t{threadIdx.x} * kItems; begin < n; begin += int64_t{kBlock} * kItems) {
    const int64_t base = begin / (2 * run) * (2 * run);
    const Entry<T>* a = from + base;
    const int64_t n_a = min(run, n - base);
    const Entry<T>* b = a + n_a;
    const int64_t n_b = min(run, n - base - n_a);
    const int64_t skip = begin - base;
    int64_t low = max(int64_t{0}, skip - n_b), high = min(skip, n_a);
    while (low < high) {
      const int64_t middle = (low + high) / 2;
      if (a[middle] < b[skip - 1 - middle])
        low = middle + 1;
      else
        high = middle;
    }
    int64_t i = low, j = skip - low;
    for (int k = 0; k < kItems && i + j < n_a + n_b; ++k)
      to[base + skip + k] = j >= n_b || (i < n_a && a[i] < b[j]) ? a[i++] : b[j++];
  }
  __syncthreads();
}

// Leaves the sorted entries in `list` or in `other`; returns which.
template <typename T>
__device__ Entry<T>* sort_long(Entry<T>* list, Entry<T>* other, int64_t n, Entry<T>* shared) {
  for (int64_t i = 0; i < n; i += kSortRun<T>) {
    Entry<T>* run = list + i;
    sort_run<kSortItems<T>>(run, static_cast<int>(min(n - i, int64_t{kSortRun<T>})), shared,
                            [run](int place, const Entry<T>& entry) { run[place] = entry; });
    __syncthreads();
  }
  for (int64_t run = kSortRun<T>; run < n; run *= 2) {
    merge_runs<T>(list, other, n, run);
    Entry<T>* swapped = list;
    list = other, other = swapped;
  }
  return list;
}

// Each warp writes the list of its quarter: the pairs of word(0), word(1), ... that touch it.
template <typename T, typename F>
__device__ void list_quarter(const Job<T>& job, int64_t tile, int64_t n, const F& word) {
  const int lane = threadIdx.x % kWarp, quarter = threadIdx.x / kWarp;
  uint32_t count = 0;
  for (int64_t i = lane; i < n; i += kWarp) count += word(i) >> quarter & 1;
  count = __reduce_add_sync(kFullWarp, count);
  const int64_t image = tile / job.n_tiles;
  uint32_t begin = 0;
  if (lane == 0) {
    begin = job.first_slot(image, *job.group) + atomicAdd(job.list_cursor + image, count);
    job.lists[tile * kQuarters + quarter] = {begin, count};
  }
  uint32_t* to = job.listed + __shfl_sync(kFullWarp, begin, 0);
  for (int64_t base = 0; base < n; base += kWarp) {
    const uint32_t mine = base + lane < n ? word(base + lane) : 0;
    const bool hit = mine >> quarter & 1;
    const unsigned hits = __ballot_sync(kFullWarp, hit);
    if (hit) to[__popc(hits & ((1u << lane) - 1))] = pair_of(mine);
    to += __popc(hits);
  }
}

template <typename T>
__device__ void sort_lists(const Job<T>& job, Entry<T>* shared) {
  const int64_t first = job.group->tile_begin, n_tiles = job.group->tile_end - first;
  auto* words = reinterpret_cast<uint32_t*>(shared);
  const auto store = [words](int place, const Entry<T>& entry) { words[place] = entry.word(); };
  for (int64_t i = blockIdx.x; i < n_tiles; i += gridDim.x) {
    const int64_t tile = first + job.order[i];
    const int64_t begin = job.tile_begin[tile], n = job.tile_begin[tile + 1] - begin;
    Entry<T>* list = job.entries + begin;
    constexpr int kItems = kSortItems<T>;
    const int length = static_cast<int>(min(n, int64_t{kSortRun<T>} + 1));
    if (length > kSortRun<T>) {
      const Entry<T>* sorted = sort_long(list, job.spare + begin, n, shared);
      list_quarter(job, tile, n, [sorted](int64_t i) { return sorted[i].word(); });
    } else {
      if (length > kItems / 2 * kBlock)
        sort_run<kItems>(list, length, shared, store);
      else if (length > kItems / 4 * kBlock)
        sort_run<kItems / 2>(list, length, shared, store);
      else if (length > kItems / 8 * kBlock)
        sort_run<kItems / 4>(list, length, shared, store);
      else
        sort_run<kItems / 8>(list, length, shared, store);
      __syncthreads();
      list_quarter(job, tile, n, [words](int64_t i) { return words[i]; });
    }
    __syncthreads();
  }
}

}  // namespace gsim3d::raster
