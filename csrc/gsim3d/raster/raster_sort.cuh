// Inside of the CUDA rasterizer: entries of every tile in order of depth, and from them the lists of its quarters. A
// block sorts one tile at a time: entries go to buckets by key, and each finds its rank among the few of its bucket.
// Keys that crowd in one bucket are sorted by a network instead, and what is longer than a block holds in runs that are
// merged in memory.
#pragma once

#include "gsim3d/raster/raster_scatter.cuh"

namespace gsim3d::raster {

constexpr int kSortBlock = 256;  // threads of the kernel that only sorts; half of them for short lists
template <typename T>
constexpr int kSortItems = 128 / sizeof(Entry<T>);  // of a thread
template <typename T, int kThreads>
constexpr int kSortRun = kSortItems<T> * kThreads;
constexpr int kCrowd = 128;  // entries of a bucket that are too many

// Entries, then the beginnings of buckets.
template <typename T, int kThreads>
constexpr size_t kSortBytes = kSortRun<T, kThreads> * (sizeof(Entry<T>) + sizeof(uint32_t) / 2);

// Bitonic sort of n entries in `shared`, which holds the next power of two of them.
template <int kThreads, typename T>
__device__ void sort_by_network(Entry<T>* shared, int n) {
  int size = 2;
  while (size < n) size *= 2;
  for (int i = n + threadIdx.x; i < size; i += kThreads) shared[i] = Entry<T>::last();
  __syncthreads();
  for (int run = 2; run <= size; run *= 2) {
    for (int step = run / 2; step > 0; step /= 2) {
      for (int i = threadIdx.x; i < size / 2; i += kThreads) {
        const int first = 2 * i - (i & (step - 1)), second = first + step;
        const Entry<T> a = shared[first], b = shared[second];
        if ((b < a) == !(first & run)) shared[first] = b, shared[second] = a;
      }
      __syncthreads();
    }
  }
}

// What distinguishes entries first: the highest bits of their keys, or where those are equal the lowest.
__device__ __forceinline__ uint32_t digit_of(const Entry<float>& entry, bool equal) {
  return static_cast<uint32_t>(equal ? entry.key : entry.key >> 32);
}
__device__ __forceinline__ uint32_t digit_of(const Entry<double>& entry, bool) {
  return static_cast<uint32_t>(entry.key >> 32);
}

struct DigitRange {
  uint32_t low, high;
};

// Of all threads of the block.
template <int kThreads>
__device__ DigitRange block_range(uint32_t low, uint32_t high) {
  __shared__ DigitRange of_warps[kThreads / kWarp];
  const int lane = threadIdx.x % kWarp;
  low = __reduce_min_sync(kFullWarp, low), high = __reduce_max_sync(kFullWarp, high);
  __syncthreads();
  if (lane == 0) of_warps[threadIdx.x / kWarp] = {low, high};
  __syncthreads();
  const DigitRange other = of_warps[lane % (kThreads / kWarp)];
  return {__reduce_min_sync(kFullWarp, other.low), __reduce_max_sync(kFullWarp, other.high)};
}

// Sum over the threads of the block in front of the calling one.
template <int kThreads>
__device__ uint32_t sum_before(uint32_t value) {
  __shared__ uint32_t of_warps[kThreads / kWarp];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const uint32_t end = warp_sum(value);
  __syncthreads();
  if (lane == kWarp - 1) of_warps[warp] = end;
  __syncthreads();
  return __reduce_add_sync(kFullWarp, lane < warp ? of_warps[lane] : 0) + end - value;
}

// Sorts n <= kItems * kThreads entries, of which thread t holds entry i * kThreads + t, and hands them to
// store(place, entry). Does nothing and returns false when too many keys are of one bucket.
template <int kItems, int kThreads, typename T, typename F>
__device__ bool sort_by_buckets(const Entry<T> (&mine)[kItems], int n, Entry<T>* shared, const F& store) {
  constexpr int kMine = kItems < kSortItems<T> ? kItems : kItems / 2;  // buckets of a thread
  constexpr int kBuckets = kMine * kThreads;
  auto* const begins = reinterpret_cast<uint32_t*>(shared + kSortRun<T, kThreads>);
  // The buckets of one thread, which are neighbours, lie in one bank.
  const auto begin_of = [begins](uint32_t bucket) -> uint32_t& {
    return begins[bucket % kMine * kThreads + bucket / kMine];
  };
  const int thread = threadIdx.x;
#pragma unroll
  for (int i = 0; i < kMine; ++i) begins[i * kThreads + thread] = 0;
  const auto find_range = [&](bool equal) {
    uint32_t low = ~0u, high = 0;
#pragma unroll
    for (int i = 0; i < kItems; ++i)
      if (i * kThreads + thread < n)
        low = min(low, digit_of(mine[i], equal)), high = max(high, digit_of(mine[i], equal));
    return block_range<kThreads>(low, high);
  };
  DigitRange range = find_range(false);
  const bool equal = range.low >= range.high;
  if (equal) range = find_range(true);
  const int shift = max(0, 32 - __clz(static_cast<int>(range.high - range.low)) - (31 - __clz(kBuckets)));
  const auto bucket_of = [&](const Entry<T>& entry) { return (digit_of(entry, equal) - range.low) >> shift; };

  uint32_t within[kItems];
#pragma unroll
  for (int i = 0; i < kItems; ++i)
    if (i * kThreads + thread < n) within[i] = atomicAdd(&begin_of(bucket_of(mine[i])), 1u);
  __syncthreads();
  uint32_t counts[kMine], sum = 0, most = 0;
#pragma unroll
  for (int i = 0; i < kMine; ++i) {
    counts[i] = begins[i * kThreads + thread];
    sum += counts[i], most = max(most, counts[i]);
  }
  if (__syncthreads_or(most > kCrowd)) return false;
  uint32_t begin = sum_before<kThreads>(sum);
#pragma unroll
  for (int i = 0; i < kMine; ++i) {
    begins[i * kThreads + thread] = begin;
    begin += counts[i];
  }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kItems; ++i)
    if (i * kThreads + thread < n) shared[begin_of(bucket_of(mine[i])) + within[i]] = mine[i];
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    if (i * kThreads + thread >= n) continue;
    const uint32_t bucket = bucket_of(mine[i]), from = begin_of(bucket);
    const uint32_t to = bucket + 1 < kBuckets ? begin_of(bucket + 1) : static_cast<uint32_t>(n);
    uint32_t rank = from;
    for (uint32_t k = from; k < to; ++k) rank += shared[k] < mine[i] ? 1 : 0;
    within[i] = rank;
  }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kItems; ++i)
    if (i * kThreads + thread < n) store(static_cast<int>(within[i]), mine[i]);
  return true;
}

// Sorts n <= kItems * kThreads entries and hands them to store(place, entry), which may write to `shared`.
template <int kItems, int kThreads, typename T, typename F>
__device__ void sort_run(const Entry<T>* list, int n, Entry<T>* shared, const F& store) {
  Entry<T> mine[kItems];
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const int place = i * kThreads + threadIdx.x;
    mine[i] = place < n ? list[place] : Entry<T>::last();
  }
  if (sort_by_buckets<kItems, kThreads>(mine, n, shared, store)) return;
#pragma unroll
  for (int i = 0; i < kItems; ++i)
    if (i * kThreads + static_cast<int>(threadIdx.x) < n) shared[i * kThreads + threadIdx.x] = mine[i];
  sort_by_network<kThreads>(shared, n);
#pragma unroll
  for (int i = 0; i < kItems; ++i)
    if (i * kThreads + static_cast<int>(threadIdx.x) < n) mine[i] = shared[i * kThreads + threadIdx.x];
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kItems; ++i)
    if (i * kThreads + static_cast<int>(threadIdx.x) < n) store(i * kThreads + threadIdx.x, mine[i]);
}

// Merges pairs of sorted runs of `run` entries; each thread finds where its outputs begin in both.
template <int kThreads, typename T>
__device__ void merge_runs(const Entry<T>* from, Entry<T>* to, int64_t n, int64_t run) {
  constexpr int kItems = 16;  // divides 2 * run, so that a thread's outputs are of one pair of runs
  for (int64_t begin = int64_t{threadIdx.x} * kItems; begin < n; begin += int64_t{kThreads} * kItems) {
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
template <int kThreads, typename T>
__device__ Entry<T>* sort_long(Entry<T>* list, Entry<T>* other, int64_t n, Entry<T>* shared) {
  constexpr int64_t kRun = kSortRun<T, kThreads>;
  for (int64_t i = 0; i < n; i += kRun) {
    Entry<T>* run = list + i;
    sort_run<kSortItems<T>, kThreads>(run, static_cast<int>(min(n - i, kRun)), shared,
                                      [run](int place, const Entry<T>& entry) { run[place] = entry; });
    __syncthreads();
  }
  for (int64_t run = kRun; run < n; run *= 2) {
    merge_runs<kThreads, T>(list, other, n, run);
    Entry<T>* swapped = list;
    list = other, other = swapped;
  }
  return list;
}

// Writes the lists of the quarters: the pairs of word(0), word(1), ... that touch them. A warp takes a run of words.
template <int kThreads, typename T, typename F>
__device__ void list_quarters(const Job<T>& job, int64_t tile, int64_t n, const F& word) {
  constexpr int kParts = kThreads / kWarp;
  __shared__ uint32_t counts[kParts][kQuarters], begins[kQuarters];
  const int lane = threadIdx.x % kWarp, part = threadIdx.x / kWarp;
  const int64_t share = (n + kParts * kWarp - 1) / (kParts * kWarp) * kWarp;
  const int64_t from = min(n, part * share), end = min(n, from + share);
  uint32_t count[kQuarters] = {};
  for (int64_t i = from + lane; i < end; i += kWarp) {
    const uint32_t mine = word(i);
#pragma unroll
    for (int q = 0; q < kQuarters; ++q) count[q] += mine >> q & 1;
  }
#pragma unroll
  for (int q = 0; q < kQuarters; ++q) {
    const uint32_t all = __reduce_add_sync(kFullWarp, count[q]);
    if (lane == q) counts[part][q] = all;
  }
  __syncthreads();
  if (threadIdx.x < kQuarters) {
    uint32_t all = 0;
    for (int p = 0; p < kParts; ++p) {
      const uint32_t of_part = counts[p][threadIdx.x];
      counts[p][threadIdx.x] = all, all += of_part;
    }
    const int64_t image = tile / job.n_tiles;
    begins[threadIdx.x] = job.first_slot(image, *job.group) + atomicAdd(job.list_cursor + image, all);
    job.lists[tile * kQuarters + threadIdx.x] = {begins[threadIdx.x], all};
  }
  __syncthreads();
#pragma unroll
  for (int q = 0; q < kQuarters; ++q) count[q] = begins[q] + counts[part][q];
  for (int64_t base = from; base < end; base += kWarp) {
    const uint32_t mine = base + lane < end ? word(base + lane) : 0;
#pragma unroll
    for (int q = 0; q < kQuarters; ++q) {
      const bool hit = mine >> q & 1;
      const unsigned hits = __ballot_sync(kFullWarp, hit);
      if (hit) job.listed[count[q] + __popc(hits & ((1u << lane) - 1))] = pair_of(mine);
      count[q] += __popc(hits);
    }
  }
}

template <int kThreads, typename T>
__device__ void sort_lists(const Job<T>& job, Entry<T>* shared) {
  const int64_t first = job.group->tile_begin, n_tiles = job.group->tile_end - first;
  auto* words = reinterpret_cast<uint32_t*>(shared);
  const auto store = [words](int place, const Entry<T>& entry) { words[place] = entry.word(); };
  for (int64_t i = blockIdx.x; i < n_tiles; i += gridDim.x) {
    const int64_t tile = first + job.order[i];
    const int64_t begin = job.tile_begin[tile], n = job.tile_begin[tile + 1] - begin;
    Entry<T>* list = job.entries + begin;
    constexpr int kItems = kSortItems<T>;
    const int length = static_cast<int>(min(n, int64_t{kSortRun<T, kThreads>} + 1));
    if (length > kItems * kThreads) {
      const Entry<T>* sorted = sort_long<kThreads>(list, job.spare + begin, n, shared);
      list_quarters<kThreads>(job, tile, n, [sorted](int64_t i) { return sorted[i].word(); });
    } else {
      if (length > kItems / 2 * kThreads)
        sort_run<kItems, kThreads>(list, length, shared, store);
      else if (length > kItems / 4 * kThreads)
        sort_run<kItems / 2, kThreads>(list, length, shared, store);
      else if (length > kItems / 8 * kThreads)
        sort_run<kItems / 4, kThreads>(list, length, shared, store);
      else
        sort_run<kItems / 8, kThreads>(list, length, shared, store);
      __syncthreads();
      list_quarters<kThreads>(job, tile, n, [words](int64_t i) { return words[i]; });
    }
    __syncthreads();
  }
}

}  // namespace gsim3d::raster
