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
constexpr int kWarpColumns = 32;
constexpr size_t kStaticBytes = 128;  // of shared memory, beside Memory

template <typename E, int kColumns>
struct alignas(128) Memory {
  static constexpr int kChunk = kColumns;  // pairs of one product
  // 16 warps an SM: one wide block, or two narrow ones.
  static constexpr int kThreads = 4 * kColumns, kBlocksOnSm = kColumns == 64 ? 2 : 1;
  E a[kStages][kChunk * kDepth];
  E b[kStages][kColumns * kDepth];
  float sums[kTile * kColumns];
  uint8_t places[kStages][kChunk];
  // then the list of products

  static size_t bytes(int32_t taps) { return sizeof(Memory) + sizeof(uint32_t) * taps * (kTile / kChunk); }
};

// Consecutive voxels start at different banks.
template <int kColumns>
__device__ __forceinline__ int sum_offset(int place, int column) {
  return place * kColumns + (column ^ ((place & 3) << 3));
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

// sums (+)= a b over a stage (channels beyond the last are zeros), for kActive blocks of 16 rows; kFirst starts from
// zero. Addresses are those of the first step and block; a step flips bits 5 and 6 of the address of a row of 128
// bytes.
template <typename E, bool kFirst, int kActive, int kBlocks, int kBlockBytes, int kWeightRow, bool kTransposed>
__device__ __forceinline__ void multiply_stage(uint32_t a, uint32_t b, float (&sums)[kBlocks][kWarpColumns / 8][4]) {
#pragma unroll
  for (int k = 0; k < kDepth / 16; ++k) {
    uint32_t right[kWarpColumns / 16][4], left[kActive][4];
#pragma unroll
    for (int j = 0; j < kWarpColumns / 16; ++j) {
      if constexpr (kTransposed)
        load_matrices_transposed((b ^ (j * 32)) + k * 16 * kWeightRow * static_cast<int>(sizeof(E)), right[j]);
      else
        load_matrices((b ^ (k * 32)) + j * 16 * kWeightRow * static_cast<int>(sizeof(E)), right[j]);
    }
#pragma unroll
    for (int i = 0; i < kActive; ++i) load_matrices((a ^ (k * 32)) + i * kBlockBytes, left[i]);
#pragma unroll
    for (int i = 0; i < kActive; ++i)
#pragma unroll
      for (int j = 0; j < kWarpColumns / 8; ++j) {
        if (kFirst && k == 0) sums[i][j][0] = sums[i][j][1] = sums[i][j][2] = sums[i][j][3] = 0;
        multiply_add<E>(left[i], right[j / 2][j % 2 * 2], right[j / 2][j % 2 * 2 + 1], sums[i][j]);
      }
  }
}

// Adds the products of a tap's pairs to the sums of the voxels they write.
template <int kColumns, int kBlocks, int kRowsApart>
__device__ __forceinline__ void add_to_voxels(const float (&products)[kBlocks][kWarpColumns / 8][4], int first_row,
                                              int column, int rows, const uint8_t* places, float* sums) {
  const int lane = threadIdx.x % kWarp;
#pragma unroll
  for (int i = 0; i < kBlocks; ++i)
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const int row = first_row + i * kRowsApart + lane / 4 + h * 8;
      if (row >= rows) continue;
      const int place = places[row];
#pragma unroll
      for (int j = 0; j < kWarpColumns / 8; ++j) {
        float2& sum = *reinterpret_cast<float2*>(sums + sum_offset<kColumns>(place, column + j * 8 + lane % 4 * 2));
        sum = float2{sum.x + products[i][j][2 * h], sum.y + products[i][j][2 * h + 1]};
      }
    }
}

template <typename E>
__device__ __forceinline__ uint32_t packed(float x, float y) {
  const E pair[2] = {static_cast<E>(x), static_cast<E>(y)};
  uint32_t bits;
  memcpy(&bits, pair, sizeof(bits));
  return bits;
}

// Writes rows voxel_rows[i0 + row]: products of the centre tap and the voxel's share. All lanes call it.
template <typename E, int kColumns, int kBlocks, int kRowsApart>
__device__ __forceinline__ void write_rows(const Convolution<E>& conv,
                                           const float (&products)[kBlocks][kWarpColumns / 8][4], int first_row,
                                           int column, int rows, int64_t i0, int64_t v0, int32_t n0,
                                           const float* sums) {
  const int lane = threadIdx.x % kWarp, odd = lane % 2;
  const bool whole = conv.c_write % 4 == 0;  // rows of whole groups of four columns
#pragma unroll
  for (int i = 0; i < kBlocks; ++i)
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const int row = first_row + i * kRowsApart + lane / 4 + h * 8;
      const Part part = row < rows ? part_of(conv, i0 + row, v0) : Part{-1, -1, 1};
      const float share = part.parts == 1 ? 1.0f : 1.0f / static_cast<float>(part.parts);
      float2 y[kWarpColumns / 8];
#pragma unroll
      for (int j = 0; j < kWarpColumns / 8; ++j) {
        const int c = column + j * 8 + lane % 4 * 2;
        y[j] = float2{products[i][j][2 * h], products[i][j][2 * h + 1]};
        if (part.place >= 0) {
          const float2 sum = *reinterpret_cast<const float2*>(sums + sum_offset<kColumns>(part.place, c));
          y[j].x += sum.x * share;
          y[j].y += sum.y * share;
        }
      }
      E* to = conv.y + part.row * conv.c_write + n0;
      // Two lanes exchange halves of two column groups: each then writes 8 bytes, four lanes a whole sector.
#pragma unroll
      for (int j = 0; j < kWarpColumns / 8; j += 2) {
        const uint32_t low = packed<E>(y[j].x, y[j].y), high = packed<E>(y[j + 1].x, y[j + 1].y);
        const uint32_t other = __shfl_xor_sync(kFullWarp, odd ? low : high, 1);
        const int c = column + (j + odd) * 8 + lane % 4 / 2 * 4;
        if (part.row < 0) continue;
        if (whole) {
          if (n0 + c < conv.c_write) *reinterpret_cast<uint2*>(to + c) = odd ? uint2{other, high} : uint2{low, other};
          continue;
        }
#pragma unroll
        for (int e = 0; e < 4; ++e) {
          const int single = column + (j + e / 2) * 8 + lane % 4 * 2 + e % 2;
          const float value = e % 2 ? y[j + e / 2].y : y[j + e / 2].x;
          if (n0 + single < conv.c_write) to[single] = static_cast<E>(value);
        }
      }
    }
}

template <typename E, int kColumns, bool kTransposed>
__global__ void __launch_bounds__(Memory<E, kColumns>::kThreads, Memory<E, kColumns>::kBlocksOnSm)
    convolve(Convolution<E> conv, int32_t column_blocks) {
  using Shared = Memory<E, kColumns>;
  constexpr int kChunk = Shared::kChunk, kThreads = Shared::kThreads, kWarps = kThreads / kWarp;
  constexpr int kWarpsAcross = kColumns / kWarpColumns, kWarpsDown = kWarps / kWarpsAcross;
  constexpr int kBlocks = kChunk / 16 / kWarpsDown;  // blocks of 16 pairs of one warp
  constexpr int kRowBytes = kDepth * sizeof(E);
  constexpr int kBlockBytes = kWarpsDown * 16 * kRowBytes;
  // A thread copies 16 bytes of every kRowsApart-th pair, and of every kWeightsApart-th row of weights.
  constexpr int kRowsApart = kThreads / (kDepth / 8), kRowsCopied = kChunk / kRowsApart;
  constexpr int kWeightRow = kTransposed ? kColumns : kDepth;  // elements of a row of b
  constexpr int kWeightsApart = kThreads / (kWeightRow / 8);
  constexpr int kWeightsCopied = (kTransposed ? kDepth : kColumns) / kWeightsApart;
  static_assert(kRowsApart % 8 == 0 && kWeightsApart % 8 == 0);  // the rows of a thread have one permutation of chunks
  constexpr uint32_t kStageA = sizeof(Shared::a) / kStages, kStageB = sizeof(Shared::b) / kStages;

  extern __shared__ __align__(128) char raw[];
  auto& memory = *reinterpret_cast<Shared*>(raw);
  uint32_t* listed = reinterpret_cast<uint32_t*>(raw + sizeof(Shared));
  __shared__ int32_t listed_count;
  const int thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  const int warp_down = warp / kWarpsAcross, warp_across = warp % kWarpsAcross;
  const int64_t tile = blockIdx.x / column_blocks, v0 = tile * kTile;
  const int32_t n0 = blockIdx.x % column_blocks * kColumns, centre = conv.taps / 2;
  const int64_t n_rows = conv.values.n_rows;
  const int64_t begin = min(max(conv.cu_voxel_rows[v0], int64_t{0}), n_rows);
  const int64_t end = min(max(conv.cu_voxel_rows[min(v0 + kTile, conv.n_voxels)], begin), n_rows);

  if (warp == 0) {
    const int32_t n = list_products(conv.pairs.counts + tile * conv.taps, conv.taps, kChunk, listed);
    if (lane == 0) listed_count = n;
  }
  static_assert(kThreads * 4 / kColumns % 4 == 0);  // a thread starts the same columns of each of its voxels
  float start[4];
#pragma unroll
  for (int e = 0; e < 4; ++e) {
    const int32_t n = n0 + sum_offset<kColumns>(thread * 4 / kColumns, thread * 4 % kColumns + e) % kColumns;
    start[e] = conv.bias != nullptr && n < conv.c_write ? static_cast<float>(conv.bias[n]) : 0.0f;
  }
  for (int i = thread * 4; i < kTile * kColumns; i += kThreads * 4)
    *reinterpret_cast<float4*>(memory.sums + i) = float4{start[0], start[1], start[2], start[3]};
  __syncthreads();
  const int32_t n_listed = listed_count;
  const int32_t n_products = n_listed + static_cast<int32_t>((end - begin + kChunk - 1) / kChunk);
  const auto product_at = [&](int32_t i) {
    if (i < n_listed) return Product::unpacked(listed[i]);
    const int32_t m0 = (i - n_listed) * kChunk;
    return Product{centre, m0, static_cast<int32_t>(min(end - begin - m0, int64_t{kChunk}))};
  };

  // Where this thread copies to, and from where. Sources are looked up one product ahead.
  const int row = thread / (kDepth / 8), chunk = thread % (kDepth / 8);
  const int weight_row = thread / (kWeightRow / 8), weight_chunk = thread % (kWeightRow / 8);
  const uint32_t to_a = shared_address(memory.a[0] + chunk_offset<kDepth>(row, chunk));
  const uint32_t to_b = shared_address(memory.b[0] + chunk_offset<kWeightRow>(weight_row, weight_chunk));
  const int64_t weight_step = static_cast<int64_t>(conv.taps) * conv.weight_row;
  // Outputs beyond the last are computed from whatever weights are there and never written.
  const E* weights[kWeightsCopied];
#pragma unroll
  for (int i = 0; i < kWeightsCopied; ++i) {
    const int32_t r = weight_row + i * kWeightsApart;
    weights[i] = kTransposed ? conv.weight + r * weight_step + min(n0 + weight_chunk * 8, conv.weight_row - 8)
                             : conv.weight + min(n0 + r, conv.c_out - 1) * weight_step + weight_chunk * 8;
  }
  Product copied{}, next = product_at(0);
  int32_t copied_index = 0, copied_k = 0, sources[kRowsCopied];
  const E* rows_from[kRowsCopied];
  bool real_rows[kRowsCopied];
  int64_t copied_list = 0, next_list = 0;  // where the product's pairs are listed
  const auto look_up = [&] {
    const bool own = next.tap == centre;
    next_list = own ? begin + next.m0 : wide_product(next.tap, conv.pairs.pitch) + v0 + next.m0;
    const int32_t* from = (own ? conv.pairs.rows : conv.pairs.sources) + next_list + row;
#pragma unroll
    for (int i = 0; i < kRowsCopied; ++i) sources[i] = row + i * kRowsApart < next.rows ? from[i * kRowsApart] : -1;
  };
  const auto copy_next = [&](int stage) {
    if (copied_index < n_products) {
      if (copied_k == 0) {
        copied = next;
        copied_list = next_list;
#pragma unroll
        for (int i = 0; i < kRowsCopied; ++i) {
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
      for (int i = 0; i < kRowsCopied; ++i)
        if (row + i * kRowsApart < (copied.rows + 15 & ~15))
          copy_async(to_a + stage * kStageA + i * kRowsApart * kRowBytes, rows_from[i] + k, inside_row && real_rows[i]);
      const int64_t weights_at = wide_product(copied.tap, conv.weight_row) + (kTransposed ? copied_k * weight_step : k);
#pragma unroll
      for (int i = 0; i < kWeightsCopied; ++i) {
        const bool real = kTransposed ? copied_k + weight_row + i * kWeightsApart < conv.c_out : inside_row;
        copy_async(to_b + stage * kStageB + i * kWeightsApart * kWeightRow * static_cast<int>(sizeof(E)),
                   kTransposed && !real ? conv.weight : weights[i] + weights_at, real);
      }
      const bool last = copied_k + kDepth >= conv.c_read;
      if (last && thread < kChunk / 16 && copied.tap != centre)
        copy_async(shared_address(memory.places[stage] + thread * 16), conv.pairs.places + copied_list + thread * 16,
                   true);
      copied_k = last ? 0 : copied_k + kDepth;
      copied_index += last;
    }
    close_copies();
  };

  // Where this warp's matrices lie in the first stage.
  const uint32_t from_a = shared_address(memory.a[0] + chunk_offset<kDepth>(warp_down * 16 + lane % 16, lane / 16));
  const uint32_t from_b =
      kTransposed
          ? shared_address(memory.b[0] + chunk_offset<kWeightRow>(lane / 8 % 2 * 8 + lane % 8,
                                                                  warp_across * kWarpColumns / 8 + lane / 16))
          : shared_address(memory.b[0] + chunk_offset<kWeightRow>(warp_across * kWarpColumns + lane / 16 * 8 + lane % 8,
                                                                  lane / 8 % 2));
  float sums[kBlocks][kWarpColumns / 8][4];
  if (n_products > 0) look_up();
  for (int stage = 0; stage < kStages - 1; ++stage) copy_next(stage);

  int stage = 0;
  for (int32_t index = 0; index < n_products; ++index) {
    const Product product = product_at(index);
    const int active = max(0, (product.rows - warp_down * 16 + kWarpsDown * 16 - 1) / (kWarpsDown * 16));
    int last_stage = 0;
    for (int32_t k0 = 0; k0 == 0 || k0 < conv.c_read; k0 += kDepth, stage = stage + 1 == kStages ? 0 : stage + 1) {
      wait_for_copies<kStages - 2>();
      __syncthreads();
      copy_next(stage == 0 ? kStages - 1 : stage - 1);
      const uint32_t a = from_a + stage * kStageA, b = from_b + stage * kStageB;
      const auto multiply = [&]<bool kFirst, int kActive>() {
        multiply_stage<E, kFirst, kActive, kBlocks, kBlockBytes, kWeightRow, kTransposed>(a, b, sums);
      };
      static_assert(kBlocks <= 2);
      if (kBlocks == 2 && active == 2) {
        if (k0 == 0)
          multiply.template operator()<true, kBlocks>();
        else
          multiply.template operator()<false, kBlocks>();
      } else if (active == 1) {
        if (k0 == 0)
          multiply.template operator()<true, 1>();
        else
          multiply.template operator()<false, 1>();
      }
      last_stage = stage;
    }
    const int first_row = warp_down * 16, column = warp_across * kWarpColumns;
    if (index >= n_listed)
      write_rows<E, kColumns, kBlocks, kWarpsDown * 16>(conv, sums, first_row, column, product.rows, begin + product.m0,
                                                        v0, n0, memory.sums);
    else
      add_to_voxels<kColumns, kBlocks, kWarpsDown * 16>(sums, first_row, column, product.rows,
                                                        memory.places[last_stage], memory.sums);
  }
  wait_for_copies<0>();
}

}  // namespace

template <typename E>
void convolve_tensor(const char* op, const Convolution<E>& conv, int64_t n_tiles, bool transposed, Stream stream) {
  const auto queue = [&]<int kColumns>() {
    const int64_t column_blocks = blocks_for(op, conv.c_write, kColumns);
    launch(op, transposed ? convolve<E, kColumns, true> : convolve<E, kColumns, false>,
           blocks_for(op, n_tiles * column_blocks, 1), Memory<E, kColumns>::kThreads,
           Memory<E, kColumns>::bytes(conv.taps), stream, conv, column_blocks);
  };
  int shared_bytes = 0;
  check_cuda(cudaDeviceGetAttribute(&shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), op);
  const bool wide = Memory<E, 128>::bytes(conv.taps) + kStaticBytes <= static_cast<size_t>(shared_bytes);
  if (conv.c_write > 64 && wide)
    queue.template operator()<128>();
  else
    queue.template operator()<64>();
}

template void convolve_tensor<__half>(const char*, const Convolution<__half>&, int64_t, bool, Stream);
template void convolve_tensor<__nv_bfloat16>(const char*, const Convolution<__nv_bfloat16>&, int64_t, bool, Stream);

}  // namespace gsim3d::cuda::conv
