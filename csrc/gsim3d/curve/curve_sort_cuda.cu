// Stable radix sort of several rows of 64-bit keys at once, 8 bits a pass. One launch serves all rows, so that short
// rows fill the GPU together; a digit in which all keys of a row agree costs that row no pass; how many keys a row has
// may be known on the device only.
//
// Low digits get no pass where the digits above tell nearly all keys of a row apart: in the end every key counts the
// few that agree with it in those and belong on its other side. Whether they are few is judged by a sample of the row's
// keys.
//
// A pass takes each tile of a row through shared memory: ranks by digit inside the tile, then the tile's first place
// for each digit, which is the sum over the tiles before it. Tiles publish their counts and look back over those of the
// tiles before them (Merrill and Garland 2016; Adinets and Merrill 2022).
#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/curve/curve_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kDigitBits = 8;
constexpr int kDigits = 1 << kDigitBits;
constexpr int kMaxPasses = 64 / kDigitBits;
constexpr int kThreads = kDigits;  // thread d looks after digit d
constexpr int kWarps = kThreads / kWarp;
constexpr int kTogether = 16;  // counts of earlier tiles read at once

// How a pass cuts rows: large tiles look back less, small ones fill the GPU with few keys.
struct LargeTile {
  static constexpr int kThreads = 512, kItems = 16, kBlocks = 1;  // kItems: keys a thread; kBlocks: of an SM
};
struct SmallTile {
  static constexpr int kThreads = 256, kItems = 8, kBlocks = 4;
};
constexpr int64_t kManyKeys = 700000;
template <typename Tile>
constexpr int kKeys = Tile::kThreads * Tile::kItems;

// A count that a tile has published: nothing yet, of the tile alone, or of all tiles up to it.
constexpr uint32_t kOfTile = 1u << 30, kUpToTile = 2u << 30, kCountMask = kOfTile - 1;

struct Sort {
  SortRows rows;
  uint32_t* totals;     // [rows, kMaxPasses, kDigits]: keys of each digit, then the first place of each digit
  // [rows, kMaxPasses]: 0: all keys agree in digit p; else 1 + pairs of the sample that agree from it up
  uint32_t* alike;
  uint32_t* published;  // [kMaxPasses, rows, tiles, kDigits]
  uint32_t* tickets;    // [kMaxPasses]
  uint64_t* keys[2];    // [rows, room] each
  uint32_t* index[2];   // [rows, room] each
  int64_t tiles;        // of a row, at most
  int n_passes;
};

__device__ __forceinline__ int64_t size_of(const SortRows& rows, int64_t row) {
  return rows.sizes ? rows.sizes[row * rows.size_stride] : rows.room;
}

// Takes the zeros out of four packed numbers, which costs passes less, and back.
__device__ __forceinline__ uint64_t squeezed(uint64_t key, int bits) {
  return ((key >> 48 << bits | (key >> 32 & 0xffff)) << bits | (key >> 16 & 0xffff)) << bits | (key & 0xffff);
}
__device__ __forceinline__ uint64_t unsqueezed(uint64_t key, int bits) {
  const uint64_t mask = (uint64_t{1} << bits) - 1;
  return key >> 3 * bits << 48 | (key >> 2 * bits & mask) << 32 | (key >> bits & mask) << 16 | (key & mask);
}

// A key as the caller gave it, as the passes order it.
__device__ __forceinline__ uint64_t ordered_key(const SortRows& rows, int64_t row, uint64_t key) {
  return rows.squeeze ? squeezed(key, rows.squeeze[row]) : key ^ rows.flip;
}

// Bit p: pass p moves keys of the row.
struct Passes {
  uint32_t kept;
  bool rest;  // keys differ below the last of them
};
constexpr uint32_t kFewAlike = 2;  // of kThreads^2 pairs, in both orders
constexpr int64_t kLongRow = 1 << 21;
__device__ __forceinline__ Passes passes_of(const Sort& sort, int64_t row) {
  const uint32_t* alike = sort.alike + row * kMaxPasses;
  Passes passes{0, false};
  bool enough = false;
#pragma unroll
  for (int p = kMaxPasses - 1; p >= 0; --p) {
    const uint32_t pairs = alike[p];
    if (pairs == 0) continue;
    if (enough)
      passes.rest = true;
    else
      passes.kept |= 1u << p;
    enough = enough || pairs - 1 <= kFewAlike;
  }
  return passes;
}

__device__ __forceinline__ uint32_t digit_of(uint64_t key, int pass) {
  return static_cast<uint32_t>(key >> (pass * kDigitBits)) & (kDigits - 1);
}

// Where a row's keys lie after `moves` passes.
struct Keys {
  const uint64_t* keys;
  const uint32_t* index;  // null: the place itself
};
__device__ __forceinline__ Keys keys_after(const Sort& sort, int64_t row, int moves) {
  if (moves == 0) return {sort.rows.keys + row * sort.rows.room, nullptr};
  const int64_t at = row * sort.rows.room;
  return {sort.keys[(moves - 1) % 2] + at, sort.index[(moves - 1) % 2] + at};
}

__global__ void __launch_bounds__(kThreads) count_digits_kernel(Sort sort) {
  __shared__ uint32_t counts[kMaxPasses][kDigits];
  const int64_t row = blockIdx.y, n = size_of(sort.rows, row);
  const uint64_t* keys = sort.rows.keys + row * sort.rows.room;
  for (int p = 0; p < kMaxPasses; ++p) counts[p][threadIdx.x] = 0;
  __syncthreads();
  constexpr int kLoads = 4;  // keys of a thread in flight
  const int64_t step = int64_t{gridDim.x} * kThreads;
  for (int64_t first = int64_t{blockIdx.x} * kThreads; first < n; first += kLoads * step) {
    uint64_t loaded[kLoads];
#pragma unroll
    for (int load = 0; load < kLoads; ++load) {
      const int64_t i = first + load * step + threadIdx.x;
      loaded[load] = i < n ? keys[i] : 0;
    }
#pragma unroll
    for (int load = 0; load < kLoads; ++load) {
      const bool valid = first + load * step + threadIdx.x < n;
      const unsigned active = __ballot_sync(kFullWarp, valid);
      if (!valid) continue;
      const uint64_t key = ordered_key(sort.rows, row, loaded[load]);
      const uint32_t low = static_cast<uint32_t>(key), high = static_cast<uint32_t>(key >> 32);
      const uint64_t differs = uint64_t{__reduce_or_sync(active, high) ^ __reduce_and_sync(active, high)} << 32 |
                               (__reduce_or_sync(active, low) ^ __reduce_and_sync(active, low));
      for (int p = 0; p < sort.n_passes; ++p) {
        // Lanes that agree, as high digits mostly do, would wait for each other.
        if (digit_of(differs, p) != 0)
          atomicAdd(&counts[p][digit_of(key, p)], 1u);
        else if (threadIdx.x % kWarp == __ffs(active) - 1)
          atomicAdd(&counts[p][digit_of(key, p)], static_cast<uint32_t>(__popc(active)));
      }
    }
  }
  __syncthreads();
  for (int p = 0; p < sort.n_passes; ++p)
    if (const uint32_t count = counts[p][threadIdx.x])
      atomicAdd(sort.totals + (row * kMaxPasses + p) * kDigits + threadIdx.x, count);
}

// Sum over the threads before; the barriers also order the use of `sums`.
__device__ __forceinline__ uint32_t exclusive_block_sum(uint32_t value, uint32_t* sums /* [warps], shared */) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  uint32_t sum = value;
#pragma unroll
  for (int offset = 1; offset < kWarp; offset *= 2) {
    const uint32_t from = __shfl_up_sync(kFullWarp, sum, offset);
    if (lane >= offset) sum += from;
  }
  if (lane == kWarp - 1) sums[warp] = sum;
  __syncthreads();
  uint32_t before = 0;
  for (int w = 0; w < warp; ++w) before += sums[w];
  __syncthreads();
  return before + sum - value;
}

// Places of the sample: scattered, since equal steps may keep step with how a cloud was made.
__device__ __forceinline__ uint32_t sampled_place(uint32_t i, int64_t n /* < 2^30 */) {
  uint32_t hash = (i + 1) * 0x9e3779b9u;
  hash = (hash ^ hash >> 16) * 0x85ebca6bu;
  hash = (hash ^ hash >> 13) * 0xc2b2ae35u;
  return static_cast<uint32_t>(static_cast<uint64_t>(hash ^ hash >> 16) * static_cast<uint64_t>(n) >> 32);
}

__global__ void __launch_bounds__(kThreads) plan_passes_kernel(Sort sort) {
  __shared__ uint32_t sums[kWarps];
  __shared__ uint64_t sample[kThreads];
  __shared__ uint32_t places[kThreads];
  __shared__ uint32_t pairs;
  const int64_t row = blockIdx.x, n = size_of(sort.rows, row);
  const int pass = blockIdx.y;
  const uint32_t place = sampled_place(threadIdx.x, n);
  const uint64_t key = n > 0 ? sort.rows.keys[row * sort.rows.room + place] : 0;
  const uint64_t prefix = n > 0 ? ordered_key(sort.rows, row, key) >> (pass * kDigitBits) : 0;
  sample[threadIdx.x] = prefix;
  places[threadIdx.x] = place;
  if (threadIdx.x == 0) pairs = 0;
  uint32_t* total = sort.totals + (row * kMaxPasses + pass) * kDigits + threadIdx.x;
  const uint32_t count = *total;
  *total = exclusive_block_sum(count, sums);
  if (!__syncthreads_or(count > 0 && count < n)) return;
  uint32_t same = 0;
#pragma unroll 8
  for (int i = 0; i < kThreads; ++i) same += sample[i] == prefix && places[i] != place;
  same = __reduce_add_sync(kFullWarp, same);
  if (threadIdx.x % kWarp == 0) atomicAdd(&pairs, same);
  __syncthreads();
  // In long rows few pairs of the sample are still many keys.
  if (threadIdx.x == 0) sort.alike[row * kMaxPasses + pass] = 1 + (n < kLongRow ? pairs : kThreads);
}

// The key with place i in the order.
__device__ __forceinline__ void write_result(const SortRows& rows, int64_t row, int64_t i, uint64_t key,
                                             uint32_t index) {
  const int64_t at = row * rows.room;
  if (rows.sorted) rows.sorted[at + i] = rows.squeeze ? unsqueezed(key, rows.squeeze[row]) : key ^ rows.flip;
  if (rows.index) rows.index[at + i] = index;
  if (rows.order) rows.order[at + i] = index;
  if (rows.inverse) rows.inverse[at + index] = i;
}

template <typename Tile>
struct PassMemory {
  static constexpr int kWarps = Tile::kThreads / kWarp;
  uint64_t keys[kKeys<Tile>];
  uint32_t index[kKeys<Tile>];
  uint32_t counts[kWarps][kDigits];
  uint32_t first[kDigits];   // place in the tile of each digit's first key
  uint32_t target[kDigits];  // place in the row of each digit's first key, less `first`
  uint32_t sums[kWarps];
  uint32_t ticket;
};

// Keys of a digit in all tiles before this one. Every tile has published its own count before it waits for others, and
// tiles start in order, so the wait ends.
__device__ __forceinline__ uint32_t keys_before(const uint32_t* published, int64_t tile) {
  const auto read = [&](int64_t t) -> uint32_t {
    return t < 0 ? kUpToTile : *static_cast<const volatile uint32_t*>(published + t * kDigits);
  };
  uint32_t sum = 0;
  for (int64_t last = tile - 1; last >= 0; last -= kTogether) {
    uint32_t words[kTogether];
#pragma unroll
    for (int t = 0; t < kTogether; ++t) words[t] = read(last - t);
#pragma unroll
    for (int t = 0; t < kTogether; ++t) {
      while (words[t] < kOfTile) words[t] = read(last - t);
      sum += words[t] & kCountMask;
      if (words[t] >= kUpToTile) return sum;
    }
  }
  return sum;
}

template <typename Tile>
__global__ void __launch_bounds__(Tile::kThreads, Tile::kBlocks) move_keys_kernel(Sort sort, int pass) {
  constexpr int kItems = Tile::kItems;
  extern __shared__ __align__(16) char shared[];
  PassMemory<Tile>& memory = *reinterpret_cast<PassMemory<Tile>*>(shared);
  if (threadIdx.x == 0) memory.ticket = atomicAdd(sort.tickets + pass, 1u);
  __syncthreads();
  const int64_t row = memory.ticket / sort.tiles, tile = memory.ticket % sort.tiles;
  const int64_t n = size_of(sort.rows, row), begin = tile * kKeys<Tile>;
  const Passes passes = passes_of(sort, row);
  if (!(passes.kept >> pass & 1) || begin >= n) return;
  const int moves = __popc(passes.kept & ((1u << pass) - 1));
  const Keys from = keys_after(sort, row, moves);
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const int count = static_cast<int>(min(n - begin, int64_t{kKeys<Tile>}));

  // Ranks among the keys of a digit that come earlier in the warp's part of the tile.
  for (int c = threadIdx.x; c < memory.kWarps * kDigits; c += Tile::kThreads) memory.counts[0][c] = 0;
  uint64_t keys[kItems];
  uint32_t index[kItems], rank[kItems];
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const int at = warp * kWarp * kItems + i * kWarp + lane;
    keys[i] = 0;
    if (at >= count) continue;
    keys[i] = from.keys[begin + at];
    if (moves == 0) keys[i] = ordered_key(sort.rows, row, keys[i]);
    index[i] = from.index ? from.index[begin + at] : static_cast<uint32_t>(begin + at);
  }
  __syncthreads();
  const unsigned lower = (1u << lane) - 1;
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const bool valid = warp * kWarp * kItems + i * kWarp + lane < count;
    const uint32_t digit = digit_of(keys[i], pass);
    unsigned same = __ballot_sync(kFullWarp, valid);
#pragma unroll
    for (int bit = 0; bit < kDigitBits; ++bit) {
      const unsigned set = __ballot_sync(kFullWarp, digit >> bit & 1);
      same &= digit >> bit & 1 ? set : ~set;
    }
    const uint32_t before = memory.counts[warp][digit];
    rank[i] = before + __popc(same & lower);
    __syncwarp();
    if (valid && (same & lower) == 0) memory.counts[warp][digit] = before + __popc(same);
    __syncwarp();
  }
  __syncthreads();

  // Thread d: the places of digit d.
  const int digit = threadIdx.x;
  const bool counts = digit < kDigits;
  uint32_t own = 0;
  uint32_t* published = sort.published + ((pass * sort.rows.n_rows + row) * sort.tiles) * kDigits + digit;
  volatile uint32_t* mine = published + tile * kDigits;
  if (counts) {
    for (int w = 0; w < memory.kWarps; ++w) {
      const uint32_t part = memory.counts[w][digit];
      memory.counts[w][digit] = own;
      own += part;
    }
    *mine = own | (tile == 0 ? kUpToTile : kOfTile);
  }
  const uint32_t first = exclusive_block_sum(own, memory.sums);
  if (counts) {
    const uint32_t before = keys_before(published, tile);
    if (tile > 0) *mine = (before + own) | kUpToTile;
    memory.first[digit] = first;
    memory.target[digit] = sort.totals[(row * kMaxPasses + pass) * kDigits + digit] + before - first;
  }
  __syncthreads();

#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    if (warp * kWarp * kItems + i * kWarp + lane >= count) continue;
    const uint32_t d = digit_of(keys[i], pass), to = memory.first[d] + memory.counts[warp][d] + rank[i];
    memory.keys[to] = keys[i];
    memory.index[to] = index[i];
  }
  __syncthreads();
  const bool last = passes.kept >> pass == 1 && !passes.rest;
  uint64_t* to_keys = sort.keys[moves % 2] + row * sort.rows.room;
  uint32_t* to_index = sort.index[moves % 2] + row * sort.rows.room;
#pragma unroll 4
  for (int at = threadIdx.x; at < count; at += Tile::kThreads) {
    const uint64_t key = memory.keys[at];
    const uint32_t to = memory.target[digit_of(key, pass)] + at, from_place = memory.index[at];
    if (last) {
      write_result(sort.rows, row, to, key, from_place);
    } else {
      to_keys[to] = key;
      to_index[to] = from_place;
    }
  }
}

// Ends what the passes left: rows that no pass moved are in order, and keys that agree in all moved digits stand side
// by side, in the order of the caller.
constexpr int kFinishItems = 4, kFinished = kThreads * kFinishItems;
constexpr int kAround = 64;  // keys before and after those of a block that it holds too

__global__ void __launch_bounds__(kThreads) finish_rows_kernel(Sort sort) {
  __shared__ uint64_t held[kFinished + 2 * kAround];
  const int64_t row = blockIdx.y, n = size_of(sort.rows, row), begin = int64_t{blockIdx.x} * kFinished;
  const Passes passes = passes_of(sort, row);
  if (begin >= n || (passes.kept != 0 && !passes.rest)) return;
  const Keys from = keys_after(sort, row, __popc(passes.kept));
  if (passes.kept == 0) {
    for (int64_t i = begin + threadIdx.x; i < min(begin + kFinished, n); i += kThreads)
      write_result(sort.rows, row, i, ordered_key(sort.rows, row, from.keys[i]), static_cast<uint32_t>(i));
    return;
  }
  const int64_t first = max(begin - kAround, int64_t{0}), last = min(begin + kFinished + kAround, n);
  for (int64_t i = first + threadIdx.x; i < last; i += kThreads) held[i - first] = from.keys[i];
  __syncthreads();
  const auto key_at = [&](int64_t i) { return i >= first && i < last ? held[i - first] : from.keys[i]; };
  const int shift = kDigitBits * (__ffs(passes.kept) - 1);
#pragma unroll
  for (int item = 0; item < kFinishItems; ++item) {
    const int64_t i = begin + item * kThreads + threadIdx.x;
    if (i >= n) continue;
    const uint64_t key = held[i - first];
    int64_t place = i;
    for (int64_t j = i - 1; j >= 0; --j) {
      const uint64_t other = key_at(j);
      if ((other ^ key) >> shift != 0) break;
      place -= other > key;
    }
    for (int64_t j = i + 1; j < n; ++j) {
      const uint64_t other = key_at(j);
      if ((other ^ key) >> shift != 0) break;
      place += other < key;
    }
    write_result(sort.rows, row, place, key, from.index[i]);
  }
}

}  // namespace

void sort_rows(const char* op, const SortRows& rows, const Workspace& workspace, Stream stream) {
  if (rows.n_rows * rows.room == 0) return;
  check(rows.room < int64_t{1} << 30, op, ": rows must have fewer than 2^30 codes on CUDA; got ", rows.room);
  check(rows.n_rows < 1 << 16, op, ": there must be fewer than 2^16 rows on CUDA; got ", rows.n_rows);
  Sort sort{rows};
  const bool large = rows.n_rows * rows.room >= kManyKeys;
  const int64_t tile = large ? kKeys<LargeTile> : kKeys<SmallTile>;
  sort.tiles = (rows.room + tile - 1) / tile;
  sort.n_passes = (rows.bits + kDigitBits - 1) / kDigitBits;
  const int64_t n_totals = rows.n_rows * kMaxPasses * kDigits,
                n_published = sort.n_passes * rows.n_rows * sort.tiles * kDigits;
  const int64_t n_alike = rows.n_rows * kMaxPasses, n_zeros = n_totals + kMaxPasses + n_alike + n_published;
  sort.totals = workspace.take<uint32_t>(n_zeros);
  sort.tickets = sort.totals + n_totals;
  sort.alike = sort.tickets + kMaxPasses;
  sort.published = sort.alike + n_alike;
  for (int i = 0; i < 2; ++i) {
    sort.keys[i] = workspace.take<uint64_t>(rows.n_rows * rows.room);
    sort.index[i] = workspace.take<uint32_t>(rows.n_rows * rows.room);
  }
  fill_zero(op, sort.totals, n_zeros, stream);
  const unsigned n_rows = static_cast<unsigned>(rows.n_rows);
  launch(op, count_digits_kernel,
         dim3(static_cast<unsigned>(std::min<int64_t>((rows.room + 2047) / 2048, 128)), n_rows), kThreads, 0, stream,
         sort);
  launch(op, plan_passes_kernel, dim3(n_rows, sort.n_passes), kThreads, 0, stream, sort);
  const auto move = [&]<typename Tile>(Tile, int pass) {
    launch(op, move_keys_kernel<Tile>, blocks_for(op, rows.n_rows * sort.tiles, 1), Tile::kThreads,
           sizeof(PassMemory<Tile>), stream, sort, pass);
  };
  for (int pass = 0; pass < sort.n_passes; ++pass) large ? move(LargeTile{}, pass) : move(SmallTile{}, pass);
  launch(op, finish_rows_kernel, dim3(static_cast<unsigned>((rows.room + kFinished - 1) / kFinished), n_rows), kThreads,
         0, stream, sort);
}

}  // namespace gsim3d::cuda
