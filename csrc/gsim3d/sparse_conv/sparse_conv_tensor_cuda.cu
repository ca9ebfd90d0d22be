// The convolution on tensor cores. A block owns a tile of voxels and kColumns output channels; the sums of its voxels
// lie in shared memory. For each tap the pairs of the tile, packed, are one dense product (rows gathered, the tap's
// weights), so that no work is spent on absent neighbours; its rows are then added to the sums of the voxels they
// write. A tap has a voxel at most once, hence every sum has one owner between two barriers and the order of additions
// is fixed.
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"
#include "gsim3d/sparse_conv/sparse_conv_mma.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kDepth = 64;  // channels of one stage
constexpr int kStages = 3;
constexpr int kWarpsAcross = 2;  // groups of columns

template <typename E, int kColumns>
struct alignas(128) Memory {               // at a multiple of 1024 bytes
  static constexpr int kChunk = kColumns;  // pairs of one product
  // 16 warps an SM: one wide block, or two narrow ones.
  static constexpr int kThreads = 4 * kColumns, kBlocksOnSm = kColumns == 64 ? 2 : 1;
  E a[kStages][kChunk * kDepth];
  E b[kStages][kColumns * kDepth];
  float sums[kTile * kColumns];
  uint8_t places[kStages][kChunk];
  int32_t n_listed;
  // then the list of products

  static size_t bytes(int32_t taps) { return sizeof(Memory) + sizeof(uint32_t) * taps * (kTile / kChunk); }
};

// Neighbouring voxels start at different banks.
template <int kColumns>
__device__ __forceinline__ int sum_offset(int place, int column) {
  return place * kColumns + (column ^ ((place & 1) << 4));
}

// The output column that row `row` of the staged weights holds. A thread gets columns 2 t, 2 t + 1 of every eight rows
// from the tensor cores; in this order those of two neighbouring groups are four columns side by side.
__device__ __forceinline__ int column_of(int row) {
  return (row & ~15) | (row >> 1 & 3) << 2 | (row >> 3 & 1) << 1 | (row & 1);
}

// One product of a block: `rows` pairs of a tap from pair m0 of its list on.
struct Product {
  int32_t tap, m0, rows;

  __device__ uint32_t packed() const { return static_cast<uint32_t>(tap) << 12 | m0 / 64 << 8 | rows; }
  __device__ static Product unpacked(uint32_t bits) {
    return {static_cast<int32_t>(bits >> 12), static_cast<int32_t>(bits >> 8 & 15) * 64,
            static_cast<int32_t>(bits & 255)};
  }
};

// Lists the products of a tile, taps in order, without the centre's; returns their number. A whole warp calls it.
__device__ int32_t list_products(const int32_t* counts, int32_t taps, int32_t chunk, uint32_t* list) {
  const int lane = threadIdx.x % kWarp;
  int32_t before = 0;
  for (int32_t t0 = 0; t0 < taps; t0 += kWarp) {
    const int32_t tap = t0 + lane, count = tap < taps && tap != taps / 2 ? min(counts[tap], kTile) : 0;
    const int32_t products = (count + chunk - 1) / chunk;
    int32_t through = products;
#pragma unroll
    for (int step = 1; step < kWarp; step *= 2) {
      const int32_t other = __shfl_up_sync(kFullWarp, through, step);
      if (lane >= step) through += other;
    }
    for (int32_t i = 0; i < products; ++i)
      list[before + through - products + i] = Product{tap, i * chunk, min(chunk, count - i * chunk)}.packed();
    before += __shfl_sync(kFullWarp, through, kWarp - 1);
  }
  return before;
}

// The sums of a warp: rows lane / 4 and lane / 4 + 8 of its 16, for groups of eight columns.
template <int kColumns>
using Sums = float[kColumns / kWarpsAcross / 8][4];

// Queues sums (+)= a b over a stage, whose channels beyond the last are zeros; `first` starts from zero. a and b are
// the 64 rows of a group of four warps, whatever lies in rows that are not used, and its columns.
// The sums are there after finish_stage.
template <typename E, int kColumns>
__device__ __forceinline__ void start_stage(Factor a, Factor b, bool first, Sums<kColumns>& sums) {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  fence_sums(sums);
  start_group_products();
#pragma unroll
  for (int k = 0; k < kDepth / 16; ++k)
    multiply_add_group<E, false>(moved(a, k * 32), moved(b, k * 32), !first || k > 0, sums);
  close_group_products();
#else
  constexpr int kGroups = kColumns / kWarpsAcross / 8, kBytes = sizeof(E);
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp % 4;
  if (first)
#pragma unroll
    for (int j = 0; j < kGroups; ++j) sums[j][0] = sums[j][1] = sums[j][2] = sums[j][3] = 0;
  a += chunk_offset<kDepth>(warp * 16 + lane % 16, lane / 16) * kBytes;
  b += chunk_offset<kDepth>(lane / 16 * 8 + lane % 8, lane / 8 % 2) * kBytes;
#pragma unroll
  for (int k = 0; k < kDepth / 16; ++k) {
    uint32_t left[4];
    load_matrices(a ^ (k * 32), left);
#pragma unroll
    for (int j = 0; j < kGroups; j += 2) {
      uint32_t right[4];
      load_matrices((b ^ (k * 32)) + j * 8 * kDepth * kBytes, right);
      multiply_add<E>(left, right[0], right[1], sums[j]);
      multiply_add<E>(left, right[2], right[3], sums[j + 1]);
    }
  }
#endif
}

template <int kColumns>
__device__ __forceinline__ void finish_stage(Sums<kColumns>& sums) {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  wait_for_group_products();
  fence_sums(sums);
#endif
}

// Adds the products of a tap's pairs to the sums of the voxels they write. `column` is the warp's first.
template <int kColumns>
__device__ __forceinline__ void add_to_voxels(const Sums<kColumns>& products, int first_row, int column, int rows,
                                              const uint8_t* places, float* sums) {
  const int lane = threadIdx.x % kWarp;
#pragma unroll
  for (int h = 0; h < 2; ++h) {
    const int row = first_row + lane / 4 + h * 8;
    if (row >= rows) continue;
    const int offset = sum_offset<kColumns>(places[row], column + lane % 4 * 4);
#pragma unroll
    for (int j = 0; j < kColumns / kWarpsAcross / 16; ++j) {
      float4& sum = *reinterpret_cast<float4*>(sums + (offset ^ (j * 16)));
      const float *low = products[2 * j] + 2 * h, *high = products[2 * j + 1] + 2 * h;
      sum = float4{sum.x + low[0], sum.y + low[1], sum.z + high[0], sum.w + high[1]};
    }
  }
}

// Writes rows voxel_rows[i0 + row]: products of the centre tap and the voxel's share.
template <typename E, int kColumns>
__device__ __forceinline__ void write_rows(const Convolution<E>& conv, const Sums<kColumns>& products, int first_row,
                                           int column, int rows, int64_t i0, int64_t v0, int32_t n0,
                                           const float* sums) {
  struct alignas(4 * sizeof(E)) Four {
    E values[4];
  };
  const int lane = threadIdx.x % kWarp;
  const bool whole = conv.c_write % 4 == 0;  // rows of whole groups of four columns
#pragma unroll
  for (int h = 0; h < 2; ++h) {
    const int row = first_row + lane / 4 + h * 8;
    if (row >= rows) continue;
    const Part part = part_of(conv, i0 + row, v0);
    if (part.row < 0) continue;
    const float share = part.parts == 1 ? 1.0f : 1.0f / static_cast<float>(part.parts);
    E* to = conv.y + part.row * conv.c_write + n0;
#pragma unroll
    for (int j = 0; j < kColumns / kWarpsAcross / 16; ++j) {
      const int c = column + j * 16 + lane % 4 * 4;
      float4 sum{0, 0, 0, 0};
      if (part.place >= 0) sum = *reinterpret_cast<const float4*>(sums + sum_offset<kColumns>(part.place, c));
      const float *low = products[2 * j] + 2 * h, *high = products[2 * j + 1] + 2 * h;
      const Four four{static_cast<E>(low[0] + share * sum.x), static_cast<E>(low[1] + share * sum.y),
                      static_cast<E>(high[0] + share * sum.z), static_cast<E>(high[1] + share * sum.w)};
      if (whole) {
        if (n0 + c < conv.c_write) *reinterpret_cast<Four*>(to + c) = four;
      } else {
#pragma unroll
        for (int e = 0; e < 4; ++e)
          if (n0 + c + e < conv.c_write) to[c + e] = four.values[e];
      }
    }
  }
}

template <typename E, int kColumns>
__global__ void __launch_bounds__(Memory<E, kColumns>::kThreads, Memory<E, kColumns>::kBlocksOnSm)
    convolve(Convolution<E> conv, int32_t column_blocks) {
  using Shared = Memory<E, kColumns>;
  constexpr int kChunk = Shared::kChunk, kThreads = Shared::kThreads;
  constexpr int kRowBytes = kDepth * sizeof(E), kWarpColumns = kColumns / kWarpsAcross;
  // A thread copies 16 bytes of every kRowsApart-th pair and of every kRowsApart-th row of weights.
  constexpr int kRowsApart = kThreads / (kDepth / 8), kCopied = kColumns / kRowsApart;
  static_assert(kRowsApart % 16 == 0 && kChunk == kColumns);
  constexpr uint32_t kStageA = sizeof(Shared::a) / kStages, kStageB = sizeof(Shared::b) / kStages;

  extern __shared__ __align__(1024) char raw[];
  auto& memory = *reinterpret_cast<Shared*>(raw);
  uint32_t* listed = reinterpret_cast<uint32_t*>(raw + sizeof(Shared));
  const int thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  // Four warps in a row work on 64 rows and the same columns.
  const int group_row = warp / (4 * kWarpsAcross) * 64, first_row = group_row + warp % 4 * 16;
  const int column = warp / 4 % kWarpsAcross * kWarpColumns;
  const int64_t tile = blockIdx.x / column_blocks, v0 = tile * kTile;
  const int32_t n0 = blockIdx.x % column_blocks * kColumns, centre = conv.taps / 2;
  const int64_t n_rows = conv.values.n_rows;
  const int64_t begin = min(max(conv.cu_voxel_rows[v0], int64_t{0}), n_rows);
  const int64_t end = min(max(conv.cu_voxel_rows[min(v0 + kTile, conv.n_voxels)], begin), n_rows);

  if (warp == 0) {
    const int32_t n = list_products(conv.pairs.counts + tile * conv.taps, conv.taps, kChunk, listed);
    if (lane == 0) memory.n_listed = n;
  }
  static_assert(kThreads * 4 / kColumns % 2 == 0);  // a thread starts the same columns of each of its voxels
  float start[4];
#pragma unroll
  for (int e = 0; e < 4; ++e) {
    const int32_t n = n0 + sum_offset<kColumns>(thread * 4 / kColumns, thread * 4 % kColumns + e) % kColumns;
    start[e] = conv.bias != nullptr && n < conv.c_write ? static_cast<float>(conv.bias[n]) : 0.0f;
  }
  for (int i = thread * 4; i < kTile * kColumns; i += kThreads * 4)
    *reinterpret_cast<float4*>(memory.sums + i) = float4{start[0], start[1], start[2], start[3]};
  __syncthreads();
  const int32_t n_listed = memory.n_listed;
  const int32_t n_products = n_listed + static_cast<int32_t>((end - begin + kChunk - 1) / kChunk);
  const auto product_at = [&](int32_t i) {
    if (i < n_listed) return Product::unpacked(listed[i]);
    const int32_t m0 = (i - n_listed) * kChunk;
    return Product{centre, m0, static_cast<int32_t>(min(end - begin - m0, int64_t{kChunk}))};
  };

  // Where this thread copies to, and from where. Sources are looked up one product ahead.
  const int row = thread / (kDepth / 8), chunk = thread % (kDepth / 8);
  const uint32_t to_a = shared_address(memory.a[0] + chunk_offset<kDepth>(row, chunk));
  const uint32_t to_b = shared_address(memory.b[0] + chunk_offset<kDepth>(row, chunk));
  const int64_t weight_step = static_cast<int64_t>(conv.taps) * conv.c_read;
  const E* weights[kCopied];  // columns beyond the last repeat it and are never written
#pragma unroll
  for (int i = 0; i < kCopied; ++i)
    weights[i] = conv.weight + min(n0 + column_of(row + i * kRowsApart), conv.c_write - 1) * weight_step + chunk * 8;
  Product copied{}, next = product_at(0);
  int32_t copied_index = 0, copied_k = 0, sources[kCopied];
  const E* rows_from[kCopied];
  bool real_rows[kCopied];
  int64_t copied_list = 0, next_list = 0;  // where the product's pairs are listed
  const auto look_up = [&] {
    const bool own = next.tap == centre;
    next_list = own ? begin + next.m0 : wide_product(next.tap, conv.pairs.pitch) + v0 + next.m0;
    const int32_t* from = (own ? conv.pairs.rows : conv.pairs.sources) + next_list + row;
#pragma unroll
    for (int i = 0; i < kCopied; ++i) sources[i] = row + i * kRowsApart < next.rows ? from[i * kRowsApart] : -1;
  };
  const auto copy_next = [&](int stage) {
    if (copied_index < n_products) {
      if (copied_k == 0) {
        copied = next;
        copied_list = next_list;
#pragma unroll
        for (int i = 0; i < kCopied; ++i) {
          real_rows[i] = sources[i] >= 0;
          rows_from[i] = conv.values.at(max(sources[i], 0)) + chunk * 8;
        }
        if (copied_index + 1 < n_products) {
          next = product_at(copied_index + 1);
          look_up();
        }
      }
      const bool inside_row = copied_k + chunk * 8 < conv.c_read;
      const int32_t k = inside_row ? copied_k : 0;
#pragma unroll
      for (int i = 0; i < kCopied; ++i)
        if (row + i * kRowsApart < (copied.rows + 15 & ~15))
          copy_async(to_a + stage * kStageA + i * kRowsApart * kRowBytes, rows_from[i] + k, inside_row && real_rows[i]);
      const int64_t weights_at = wide_product(copied.tap, conv.c_read) + k;
#pragma unroll
      for (int i = 0; i < kCopied; ++i)
        copy_async(to_b + stage * kStageB + i * kRowsApart * kRowBytes, weights[i] + weights_at, inside_row);
      const bool last = copied_k + kDepth >= conv.c_read;
      if (last && thread < kChunk / 16 && copied.tap != centre)
        copy_async(shared_address(memory.places[stage] + thread * 16), conv.pairs.places + copied_list + thread * 16,
                   true);
      copied_k = last ? 0 : copied_k + kDepth;
      copied_index += last;
    }
    close_copies();
  };

  const Factor from_a = factor_at(shared_address(memory.a[0]) + group_row * kRowBytes);
  const Factor from_b = factor_at(shared_address(memory.b[0]) + column * kRowBytes);
  Sums<kColumns> sums;
  if (n_products > 0) look_up();
  for (int stage = 0; stage < kStages - 1; ++stage) copy_next(stage);

  int stage = 0;
  for (int32_t index = 0; index < n_products; ++index) {
    const Product product = product_at(index);
    int last_stage = 0;
    for (int32_t k0 = 0; k0 < conv.c_read; k0 += kDepth, stage = stage + 1 == kStages ? 0 : stage + 1) {
      wait_for_copies<kStages - 2>();
      publish_copies();
      __syncthreads();
      start_stage<E, kColumns>(moved(from_a, stage * kStageA), moved(from_b, stage * kStageB), k0 == 0, sums);
      copy_next(stage == 0 ? kStages - 1 : stage - 1);
      finish_stage<kColumns>(sums);
      last_stage = stage;
    }
    if (index >= n_listed)
      write_rows<E, kColumns>(conv, sums, first_row, column, product.rows, begin + product.m0, v0, n0, memory.sums);
    else
      add_to_voxels<kColumns>(sums, first_row, column, product.rows, memory.places[last_stage], memory.sums);
  }
  wait_for_copies<0>();
}

}  // namespace

template <typename E>
void convolve_tensor(const char* op, const Convolution<E>& conv, int64_t n_tiles, Stream stream) {
  const auto queue = [&]<int kColumns>() {
    const int64_t column_blocks = blocks_for(op, conv.c_write, kColumns);
    launch(op, convolve<E, kColumns>, blocks_for(op, n_tiles * column_blocks, 1), Memory<E, kColumns>::kThreads,
           Memory<E, kColumns>::bytes(conv.taps), stream, conv, column_blocks);
  };
  int shared_bytes = 0;
  check_cuda(cudaDeviceGetAttribute(&shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), op);
  const bool wide = Memory<E, 128>::bytes(conv.taps) <= static_cast<size_t>(shared_bytes);
  if (conv.c_write > 64 && wide)
    queue.template operator()<128>();
  else
    queue.template operator()<64>();
}

template void convolve_tensor<__half>(const char*, const Convolution<__half>&, int64_t, Stream);
template void convolve_tensor<__nv_bfloat16>(const char*, const Convolution<__nv_bfloat16>&, int64_t, Stream);

}  // namespace gsim3d::cuda::conv
