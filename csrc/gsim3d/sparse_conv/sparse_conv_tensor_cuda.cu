// The convolution on tensor cores. A block owns a tile of rows, in the order of the plan, and kColumns output channels,
// whose sums stay in registers. Some warps copy what the tile's taps read, stage by stage; each group of four further
// warps multiplies 64 rows, and leaves out the taps that none of its rows has. Where there are few tiles the stages of
// a tile are shared by several blocks, whose sums are added in a fixed order.
#include <algorithm>

#include "gsim3d/sparse_conv/sparse_conv_device.cuh"
#include "gsim3d/sparse_conv/sparse_conv_mma.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kDepth = 64;  // channels of one stage: rows of 128 bytes, in 8 chunks
constexpr int kChunk = 8;   // channels of 16 bytes
constexpr int kRowBytes = 128, kRowChunks = 8;
constexpr int kGroupRows = kConvGroupRows;
constexpr int kCopying = 128;      // threads that copy
constexpr int64_t kEnough = 128;   // blocks that nearly fill a large GPU
constexpr int64_t kMaxSplits = 16;
constexpr int kAdders = 256;

template <int kGroups_, int kColumns_>
struct Shape {
  static constexpr int kGroups = kGroups_, kColumns = kColumns_, kRows = kGroupRows * kGroups;
  static constexpr int kThreads = kCopying + 128 * kGroups, kBlocksOnSm = kColumns == 128 ? 1 : 2;
  static constexpr int kStages = kGroups == 1 ? 6 : 4;
  static constexpr int kBytesA = kRows * kRowBytes, kBytesB = kColumns * kRowBytes;
  static_assert(kConvPlanStep % kRows == 0);
};

template <typename S>
struct alignas(128) Memory {  // at a multiple of 1024 bytes
  char a[S::kStages][S::kBytesA];
  char b[S::kStages][S::kBytesB];
  uint64_t full[S::kStages], empty[S::kStages];
  int32_t n_others;
  // then Tables

  static size_t bytes(int64_t taps, int64_t chunks) {
    const int64_t stages = (taps * chunks + 2 * kRowChunks) / kRowChunks;
    return sizeof(Memory) + stages * (kRowChunks * sizeof(uint32_t) + 1) + taps * sizeof(uint32_t) + 16;
  }
};

// The channels that a tile reads, in chunks: those of its taps one after another, then, from a new stage on, the
// centre's.
struct Walk {
  int32_t chunks;  // of a row
  int32_t n_others, other_stages, n_stages;

  __device__ Walk(int32_t channels, int32_t n_others)
      : chunks(channels / kChunk),
        n_others(n_others),
        other_stages((n_others * chunks + kRowChunks - 1) / kRowChunks),
        n_stages(other_stages + (chunks + kRowChunks - 1) / kRowChunks) {}

  // A chunk of a stage: which of the tile's taps it belongs to (n_others: the centre; -1: none), and which of its row.
  __device__ int2 at(int32_t stage, int32_t chunk) const {
    if (stage >= other_stages) {
      const int32_t q = (stage - other_stages) * kRowChunks + chunk;
      return {q < chunks ? n_others : -1, q};
    }
    const uint32_t q = stage * kRowChunks + chunk, entry = q / static_cast<uint32_t>(chunks);
    return {static_cast<int32_t>(entry) < n_others ? static_cast<int32_t>(entry) : -1,
            static_cast<int32_t>(q - entry * chunks)};
  }
};

// What a chunk of a stage reads, in 32 bits: a tap, and a chunk of its row.
constexpr uint32_t kNoTap = 0xffff;
__device__ __forceinline__ uint32_t packed_source(uint32_t tap, uint32_t chunk) { return tap << 16 | chunk; }
__device__ __forceinline__ uint32_t tap_of(uint32_t source) { return source >> 16; }
__device__ __forceinline__ uint32_t chunk_of(uint32_t source) { return source & 0xffff; }

// What a block looks up in shared memory.
struct Tables {
  uint32_t* sources;  // [stages, kRowChunks]
  uint32_t* taps;     // [n_others + 1]
  uint8_t* groups;    // [stages], by bit the groups that multiply
};

// A tap of a tile and, by bit, the groups that have it.
__device__ __forceinline__ uint32_t packed_tap(int32_t tap, uint32_t groups) { return tap << 4 | groups; }
__device__ __forceinline__ uint32_t listed_tap(uint32_t packed) { return packed >> 4; }
__device__ __forceinline__ uint32_t groups_of(uint32_t packed) { return packed & 15; }

// Lists the taps of a tile, the centre last; returns the number of the others. A whole warp calls it.
template <int kGroups>
__device__ int32_t list_taps(const RowPlan& plan, int64_t tile, int32_t taps, uint32_t* list) {
  const int lane = threadIdx.x % kWarp;
  int32_t n = 0;
  for (int32_t w = 0; w < plan.words; ++w) {
    uint32_t groups = 0;
#pragma unroll
    for (int g = 0; g < kGroups; ++g)
      groups |= (plan.active[(tile * kGroups + g) * plan.words + w] >> lane & 1) << g;
    const int32_t tap = w * 32 + lane;
    const bool listed = groups != 0 && tap < taps && tap != taps / 2;
    const unsigned found = __ballot_sync(kFullWarp, listed);
    if (listed) list[n + __popc(found & ((1u << lane) - 1))] = packed_tap(tap, groups);
    n += __popc(found);
  }
  if (lane == 0) list[n] = packed_tap(taps / 2, (1u << kGroups) - 1);
  return n;
}

__device__ __forceinline__ int32_t round_up_to_four(int32_t n) { return (n + 3) & ~3; }

// The stages of one block.
struct Stages {
  int32_t begin, end;
};

template <typename E, typename S>
struct Tile {
  const Convolution<E>& conv;
  Memory<S>& memory;
  const Tables tables;
  const Walk walk;
  const Stages stages;
  int64_t first_place;
  int32_t n0;

  __device__ uint32_t full(int slot) const { return shared_address(memory.full + slot); }
  __device__ uint32_t empty(int slot) const { return shared_address(memory.empty + slot); }
};

// The rows of the left factor. A thread copies one chunk of four rows of every group, one below the other. Where they
// are is looked up one stage ahead.
template <typename E, typename S>
struct RowCopy {
  static constexpr int kEach = 4 * S::kGroups;
  static_assert(kCopying / kRowChunks * 4 == kGroupRows);
  const Tile<E, S>& tile;
  const int chunk, first_row;
  const uint32_t to, row_bytes;
  int32_t rows[kEach], upcoming[kEach];
  uint32_t tap = kNoTap + 1;  // of rows
  uint32_t next;

  __device__ RowCopy(const Tile<E, S>& tile, int thread)
      : tile(tile),
        chunk(thread % kRowChunks),
        first_row(thread / kRowChunks * 4),
        to(shared_address(tile.memory.a[0]) + first_row * kRowBytes),
        row_bytes(tile.conv.values.channels * static_cast<uint32_t>(sizeof(E))) {}

  __device__ void look_up(int32_t stage) {
    next = tile.tables.sources[stage * kRowChunks + chunk];
    if (tap_of(next) == tap) return;
    const RowPlan& plan = tile.conv.plan;
    const bool centre = tap_of(next) == tile.conv.taps / 2;
    const int32_t* from = centre ? plan.order : plan.sources + wide_product(tap_of(next), plan.pitch);
#pragma unroll
    for (int i = 0; i < kEach; i += 4) {
      int4 four{-1, -1, -1, -1};
      if (tap_of(next) != kNoTap)
        four = *reinterpret_cast<const int4*>(from + tile.first_place + first_row + i / 4 * kGroupRows);
      upcoming[i] = four.x;
      upcoming[i + 1] = four.y;
      upcoming[i + 2] = four.z;
      upcoming[i + 3] = four.w;
    }
  }

  // Queues the chunk of a stage that was looked up; then looks up the next.
  __device__ void copy(int32_t stage, int slot) {
    if (tap_of(next) != tap) {
      tap = tap_of(next);
#pragma unroll
      for (int i = 0; i < kEach; ++i) rows[i] = upcoming[i];
    }
    const Values<E>& values = tile.conv.values;
    const uint32_t groups = tile.tables.groups[stage], stage_to = to + slot * S::kBytesA;
    const int64_t column = tap == kNoTap ? 0 : chunk_of(next) * (kChunk * sizeof(E));
    // An address is one multiply-add: the values of voxels with several rows count on behind the rows.
    const int64_t of_rows = reinterpret_cast<int64_t>(values.rows) + column;
    const int64_t of_shared = reinterpret_cast<int64_t>(values.shared) + column - int64_t{values.n_rows} * row_bytes;
#pragma unroll
    for (int i = 0; i < kEach; ++i) {
      if ((groups >> (i / 4) & 1) == 0) continue;
      const bool real = static_cast<uint32_t>(rows[i]) < static_cast<uint32_t>(values.n_sources);
      const uint32_t source = real ? rows[i] : 0;
      const int64_t from = (source < static_cast<uint32_t>(values.n_rows) ? of_rows : of_shared) +
                           static_cast<int64_t>(static_cast<uint64_t>(source) * row_bytes);
      const int32_t row = i / 4 * kGroupRows + i % 4;
      copy_async(stage_to + row * kRowBytes + ((chunk ^ ((first_row + i % 4) & 7)) << 4),
                 reinterpret_cast<const void*>(from), real);
    }
    if (stage + 1 < tile.stages.end) look_up(stage + 1);
  }
};

// The right factor: rows of kDepth input channels for each output channel.
template <typename E, typename S>
struct WeightCopy {
  static constexpr int kApart = kCopying / kRowChunks;
  const Tile<E, S>& tile;
  const int chunk, row;
  const E* from;
  int64_t step;
  uint32_t to;

  __device__ WeightCopy(const Tile<E, S>& tile, int thread)
      : tile(tile), chunk(thread % kRowChunks), row(thread / kRowChunks) {
    const int64_t row_step = wide_product(tile.conv.taps, tile.conv.weight_row);
    from = tile.conv.weight + (tile.n0 + row) * row_step;
    step = kApart * row_step;
    to = shared_address(tile.memory.b[0]) + row * kRowBytes + ((chunk ^ (row & 7)) << 4);
  }

  __device__ void copy(int32_t stage, int slot) const {
    const Convolution<E>& conv = tile.conv;
    const uint32_t source = tile.tables.sources[stage * kRowChunks + chunk];
    const bool listed = tap_of(source) != kNoTap;
    const int32_t tap = conv.weight_tap(tap_of(source));
    const E* here = from + wide_product(tap, conv.weight_row) + chunk_of(source) * kChunk;
#pragma unroll
    for (int i = 0; i < S::kColumns / kApart; ++i, here += step) {
      const bool real = listed && tile.n0 + row + i * kApart < conv.c_write;
      copy_async(to + slot * S::kBytesB + i * kApart * kRowBytes, real ? here : conv.weight, real);
    }
  }
};

template <typename E, typename S>
__device__ void copy_tile(const Tile<E, S>& tile, int thread) {
  if (tile.stages.begin >= tile.stages.end) return;
  RowCopy<E, S> rows(tile, thread);
  const WeightCopy<E, S> weights(tile, thread);
  rows.look_up(tile.stages.begin);
  int slot = 0;
  uint32_t parity = 1;  // the first round finds all slots empty
  for (int32_t stage = tile.stages.begin; stage < tile.stages.end; ++stage) {
    wait_for_phase(tile.empty(slot), parity);
    weights.copy(stage, slot);
    rows.copy(stage, slot);
    arrive_behind_copies(tile.full(slot));
    if (++slot == S::kStages) {
      slot = 0;
      parity ^= 1;
    }
  }
  wait_for_copies<0>();
}

// Asks for what the tile's taps will look up, on its way from memory to the second-level cache.
template <typename E, typename S>
__device__ void prefetch_sources(const Tile<E, S>& tile, int thread) {
  constexpr int kLine = 32, kLines = S::kRows / kLine;  // of a tap
  const RowPlan& plan = tile.conv.plan;
  for (int32_t i = thread; i < tile.walk.n_others * kLines; i += 128 * S::kGroups) {
    const int32_t* line = plan.sources + wide_product(listed_tap(tile.tables.taps[i / kLines]), plan.pitch) +
                          tile.first_place + i % kLines * kLine;
    asm volatile("prefetch.global.L2 [%0];" ::"l"(line));
  }
}

// The sums of a warp: rows lane / 4 and lane / 4 + 8 of its 16, columns 2 (lane % 4) and the next of every eight.
template <int kColumns>
using Sums = float[kColumns / 8][4];

// sums += a b over a stage.
template <typename E, int kColumns>
__device__ __forceinline__ void multiply_stage(Factor a, Factor b, Sums<kColumns>& sums) {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  fence_sums(sums);
  start_group_products();
#pragma unroll
  for (int k = 0; k < kDepth / 16; ++k)
    multiply_add_group<E, false>(moved(a, k * 32), moved(b, k * 32), sums);
  close_group_products();
  wait_for_group_products<0>();
  fence_sums(sums);
#else
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp % 4;
  a += chunk_offset<kDepth>(warp * 16 + lane % 16, lane / 16) * sizeof(E);
  b += chunk_offset<kDepth>(lane / 16 * 8 + lane % 8, lane / 8 % 2) * sizeof(E);
#pragma unroll
  for (int k = 0; k < kDepth / 16; ++k) {
    uint32_t left[4];
    load_matrices(a ^ (k * 32), left);
#pragma unroll
    for (int j = 0; j < kColumns / 8; j += 2) {
      uint32_t right[4];
      load_matrices((b ^ (k * 32)) + j * 8 * kRowBytes, right);
      multiply_add<E>(left, right[0], right[1], sums[j]);
      multiply_add<E>(left, right[2], right[3], sums[j + 1]);
    }
  }
#endif
}

// The row at a place; -1: none.
template <typename E>
__device__ __forceinline__ int32_t row_at(const Convolution<E>& conv, int64_t place) {
  const int32_t row = conv.plan.order[place];
  return inside(row, conv.values.n_rows) ? row : -1;
}

// What a row gets of its voxel's sum.
template <typename E>
__device__ float share_of(const Convolution<E>& conv, int32_t row) {
  const int64_t n_rows = conv.values.n_rows;
  if (row < 0) return 0;
  const int64_t voxel = conv.row_voxel[row];
  if (!inside(voxel, conv.n_voxels)) return 0;
  const Range rows = range_of(conv.cu_voxel_rows, voxel, n_rows);
  if (conv.share == Share::kFirstRow) return rows.begin < rows.end && conv.voxel_rows[rows.begin] == row ? 1.0f : 0.0f;
  return 1.0f / static_cast<float>(max(rows.end - rows.begin, int64_t{1}));
}

template <int kColumns>
__device__ __forceinline__ void scale(Sums<kColumns>& sums, const float (&shares)[2]) {
#pragma unroll
  for (auto& sum : sums)
#pragma unroll
    for (int e = 0; e < 4; ++e) sum[e] *= shares[e / 2];
}

// Lane t of four holds columns 2 t and 2 t + 1 of four groups of eight; afterwards it holds group t.
__device__ __forceinline__ void exchange(uint32_t (&x)[4]) {
  const auto swap = [](uint32_t& a, uint32_t& b, bool really) {
    const uint32_t old = a;
    a = really ? b : a;
    b = really ? old : b;
  };
  const bool odd = threadIdx.x & 1, high = threadIdx.x & 2;
  swap(x[0], x[1], odd);
  swap(x[2], x[3], odd);
  x[1] = __shfl_xor_sync(kFullWarp, x[1], 1);
  x[3] = __shfl_xor_sync(kFullWarp, x[3], 1);
  swap(x[0], x[1], odd);
  swap(x[2], x[3], odd);
  swap(x[0], x[2], high);
  swap(x[1], x[3], high);
  x[2] = __shfl_xor_sync(kFullWarp, x[2], 2);
  x[3] = __shfl_xor_sync(kFullWarp, x[3], 2);
  swap(x[0], x[2], high);
  swap(x[1], x[3], high);
}

template <typename E, int kColumns>
__device__ void write_sums(const Convolution<E>& conv, Sums<kColumns>& sums, const int32_t (&rows)[2], int32_t n0) {
  const int t = threadIdx.x % 4;
  if (conv.bias != nullptr)
#pragma unroll
    for (int j = 0; j < kColumns / 8; ++j)
#pragma unroll
      for (int e = 0; e < 2; ++e) {
        const int32_t n = n0 + j * 8 + t * 2 + e;
        const float bias = n < conv.c_write ? static_cast<float>(conv.bias[n]) : 0.0f;
        sums[j][e] += bias;
        sums[j][2 + e] += bias;
      }
  const bool whole = conv.c_write % kChunk == 0;
#pragma unroll
  for (int h = 0; h < 2; ++h) {
    E* to = conv.y + wide_product(max(rows[h], 0), conv.c_write) + n0;
#pragma unroll
    for (int j = 0; j < kColumns / 8; j += 4) {
      if (whole) {
        uint32_t x[4];
#pragma unroll
        for (int i = 0; i < 4; ++i) x[i] = pair_of<E>(sums[j + i][2 * h], sums[j + i][2 * h + 1]);
        exchange(x);
        const int column = (j + t) * 8;
        if (rows[h] >= 0 && n0 + column < conv.c_write)
          *reinterpret_cast<uint4*>(to + column) = uint4{x[0], x[1], x[2], x[3]};
      } else {
#pragma unroll
        for (int i = 0; i < 4; ++i)
#pragma unroll
          for (int e = 0; e < 2; ++e) {
            const int column = (j + i) * 8 + t * 2 + e;
            if (rows[h] >= 0 && n0 + column < conv.c_write)
              to[column] = static_cast<E>(sums[j + i][2 * h + e]);
          }
      }
    }
  }
}

// Sums of a part of the stages, as floats: [splits, pitch, columns].
template <int kColumns>
__device__ void write_partials(const Sums<kColumns>& sums, float* to, int64_t columns) {
#pragma unroll
  for (int h = 0; h < 2; ++h)
#pragma unroll
    for (int j = 0; j < kColumns / 8; ++j)
      *reinterpret_cast<float2*>(to + h * 8 * columns + j * 8) = float2{sums[j][2 * h], sums[j][2 * h + 1]};
}

template <typename E, typename S>
__device__ void multiply_tile(const Tile<E, S>& tile, int group, int64_t columns, float* partials) {
  constexpr int kColumns = S::kColumns;
  const Convolution<E>& conv = tile.conv;
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp % 4;
  const int64_t place = tile.first_place + group * kGroupRows + warp * 16 + lane / 4;
  const int32_t rows[2] = {row_at(conv, place), row_at(conv, place + 8)};
  float shares[2] = {1, 1};
  if (conv.share != Share::kWhole) {
#pragma unroll
    for (int h = 0; h < 2; ++h) shares[h] = share_of(conv, rows[h]);
  }
  const Factor a = factor_at(shared_address(tile.memory.a[0]) + group * (kGroupRows * kRowBytes));
  const Factor b = factor_at(shared_address(tile.memory.b[0]));

  Sums<kColumns> sums{};
  int slot = 0;
  uint32_t parity = 0;
  const auto multiply = [&](int32_t begin, int32_t end) {
    for (int32_t stage = begin; stage < end; ++stage) {
      wait_for_phase(tile.full(slot), parity);
      if (tile.tables.groups[stage] >> group & 1) {
        publish_copies();
        multiply_stage<E, kColumns>(moved(a, slot * S::kBytesA), moved(b, slot * S::kBytesB), sums);
      }
      __syncwarp();
      if (lane == 0) arrive(tile.empty(slot));
      if (++slot == S::kStages) {
        slot = 0;
        parity ^= 1;
      }
    }
  };
  const int32_t middle = min(max(tile.walk.other_stages, tile.stages.begin), tile.stages.end);
  multiply(tile.stages.begin, middle);
  if (conv.share != Share::kWhole) scale<kColumns>(sums, shares);
  multiply(middle, tile.stages.end);
  if (partials != nullptr)
    write_partials<kColumns>(
        sums, partials + (blockIdx.y * int64_t{conv.plan.pitch} + place) * columns + tile.n0 + lane % 4 * 2, columns);
  else
    write_sums<E, kColumns>(conv, sums, rows, tile.n0);
}

template <typename E, typename S>
__global__ void __launch_bounds__(S::kThreads, S::kBlocksOnSm)
    convolve(Convolution<E> conv, int32_t column_blocks, float* partials) {
  extern __shared__ __align__(1024) char raw[];
  auto& memory = *reinterpret_cast<Memory<S>*>(raw);
  auto* room = reinterpret_cast<uint32_t*>(&memory + 1);
  // Tiles with more taps lie behind those with few and are begun first.
  const int64_t n_tiles = gridDim.x / column_blocks, index = n_tiles - 1 - blockIdx.x / column_blocks;
  const int32_t n0 = blockIdx.x % column_blocks * S::kColumns;
  if (threadIdx.x < kWarp) {
    const int32_t n = list_taps<S::kGroups>(conv.plan, index, conv.taps, room);
    if (threadIdx.x == 0) {
      memory.n_others = n;
      for (int i = 0; i < S::kStages; ++i) {
        start_barrier(shared_address(memory.full + i), kCopying);
        start_barrier(shared_address(memory.empty + i), 4 * S::kGroups);
      }
    }
  }
  __syncthreads();
  const Walk walk(conv.c_read, memory.n_others);
  const int64_t splits = gridDim.y, split = blockIdx.y;
  const Stages stages{static_cast<int32_t>(walk.n_stages * split / splits),
                      static_cast<int32_t>(walk.n_stages * (split + 1) / splits)};
  uint32_t* sources = room + round_up_to_four(conv.taps);
  const Tables tables{sources, room, reinterpret_cast<uint8_t*>(sources + walk.n_stages * kRowChunks)};
  for (int32_t i = stages.begin * kRowChunks + threadIdx.x; i < stages.end * kRowChunks; i += S::kThreads) {
    const int2 at = walk.at(i / kRowChunks, i % kRowChunks);
    sources[i] = at.x < 0 ? packed_source(kNoTap, 0) : packed_source(listed_tap(tables.taps[at.x]), at.y);
  }
  for (int32_t s = stages.begin + threadIdx.x; s < stages.end; s += S::kThreads) {
    const int32_t first = walk.at(s, 0).x;
    uint32_t groups = groups_of(tables.taps[first]);
    for (int32_t e = first + 1; e < walk.n_others && e * walk.chunks < (s + 1) * kRowChunks; ++e)
      groups |= groups_of(tables.taps[e]);
    tables.groups[s] = static_cast<uint8_t>(groups);
  }
  __syncthreads();
  const Tile<E, S> tile{conv, memory, tables, walk, stages, index * S::kRows, n0};
  const int group = threadIdx.x / 128;
  if (group < S::kGroups) {
    prefetch_sources(tile, threadIdx.x);
    multiply_tile<E, S>(tile, group, int64_t{column_blocks} * S::kColumns, partials);
  } else {
    copy_tile<E, S>(tile, threadIdx.x - 128 * S::kGroups);
  }
}

// y[order[place], c] = bias + the sums of all parts.
template <typename E>
__global__ void __launch_bounds__(kAdders)
    add_parts(Convolution<E> conv, const float* partials, int32_t splits, int64_t columns) {
  const int64_t i = (static_cast<int64_t>(blockIdx.x) * kAdders + threadIdx.x) * 4, place = i / columns;
  if (place >= conv.plan.pitch) return;
  const int32_t row = row_at(conv, place), c = static_cast<int32_t>(i % columns);
  if (row < 0 || c >= conv.c_write) return;
  float4 sum{0, 0, 0, 0};
  const int64_t step = int64_t{conv.plan.pitch} * columns;
#pragma unroll 4
  for (int32_t s = 0; s < splits; ++s) {
    const float4 part = *reinterpret_cast<const float4*>(partials + s * step + i);
    sum = float4{sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w};
  }
  const float four[4] = {sum.x, sum.y, sum.z, sum.w};
#pragma unroll
  for (int e = 0; e < 4; ++e)
    if (c + e < conv.c_write)
      conv.y[wide_product(row, conv.c_write) + c + e] =
          static_cast<E>(four[e] + (conv.bias != nullptr ? static_cast<float>(conv.bias[c + e]) : 0.0f));
}

}  // namespace

template <typename E>
bool convolve_tensor(const char* op, const Convolution<E>& conv, const Workspace& workspace, Stream stream) {
  int shared_bytes = 0;
  check_cuda(cudaDeviceGetAttribute(&shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), op);
  const auto bytes_of = [&]<typename S>() { return Memory<S>::bytes(conv.taps, conv.c_read / kChunk); };
  const auto fits = [&]<typename S>() {
    return bytes_of.template operator()<S>() <= static_cast<size_t>(shared_bytes);
  };
  const auto column_blocks = [&]<typename S>() { return (conv.c_write + S::kColumns - 1) / S::kColumns; };
  const auto blocks = [&]<typename S>() {
    return (conv.plan.pitch + S::kRows - 1) / S::kRows * int64_t{column_blocks.template operator()<S>()};
  };
  const auto queue = [&]<typename S>() {
    const int32_t across = column_blocks.template operator()<S>();
    const int64_t n_blocks = blocks.template operator()<S>(), columns = int64_t{across} * S::kColumns;
    if (n_blocks == 0) return;
    const int64_t splits = n_blocks >= kEnough ? 1 : std::min(kMaxSplits, 2 * kEnough / n_blocks);
    float* partials = splits > 1 ? workspace.take<float>(splits * conv.plan.pitch * columns) : nullptr;
    const dim3 grid(blocks_for(op, n_blocks, 1), static_cast<unsigned>(splits));
    launch(op, convolve<E, S>, grid, S::kThreads, bytes_of.template operator()<S>(), stream, conv, across, partials);
    if (splits > 1)
      launch(op, add_parts<E>, blocks_for(op, conv.plan.pitch * columns, 4 * kAdders), kAdders, 0, stream, conv,
             partials, static_cast<int32_t>(splits), columns);
  };
  using Wide = Shape<4, 128>;
  using Narrow = Shape<2, 64>;
  using Small = Shape<1, 64>;
  const bool suits = round_up(conv.c_write, 128) * 4 <= round_up(conv.c_write, 64) * 5;  // few columns beyond the last
  if (suits && fits.template operator()<Wide>() && blocks.template operator()<Wide>() >= kEnough)
    queue.template operator()<Wide>();
  else if (fits.template operator()<Narrow>() && blocks.template operator()<Narrow>() >= kEnough)
    queue.template operator()<Narrow>();
  else if (fits.template operator()<Small>())
    queue.template operator()<Small>();
  else
    return false;
  return true;
}

template bool convolve_tensor<__half>(const char*, const Convolution<__half>&, const Workspace&, Stream);
template bool convolve_tensor<__nv_bfloat16>(const char*, const Convolution<__nv_bfloat16>&, const Workspace&, Stream);

}  // namespace gsim3d::cuda::conv
