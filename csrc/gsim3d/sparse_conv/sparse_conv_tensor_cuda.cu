// The convolution on tensor cores. A block owns a tile of voxels and kColumns output channels; the sums of its voxels
// lie in shared memory. For each tap the pairs of the tile, packed, are one dense product (rows gathered, the tap's
// weights), so that no work is spent on absent neighbours; its rows are then added to the sums of the voxels they
// write. A tap has a voxel at most once, hence every sum has one owner between two barriers and the order of additions
// is fixed.
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"
#include "gsim3d/sparse_conv/sparse_conv_mma.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / kWarp;
constexpr int kChunk = 128;  // pairs of one product
constexpr int kDepth = 64;   // channels of one stage
constexpr int kStages = 3;
constexpr int kWarpColumns = 32;

template <typename E, int kColumns>
struct Memory {
  E a[kStages][kChunk * kDepth];
  E b[kStages][kColumns * kDepth];
  uint8_t places[kStages][kChunk];
  float sums[kTile * kColumns];
  // then counts[taps]
};

// Consecutive voxels start at different banks.
template <int kColumns>
__device__ __forceinline__ int sum_offset(int place, int column) {
  return place * kColumns + (column ^ ((place & 3) << 3));
}

// The products of a block, one after another: taps in order, the centre (rows of the tile's voxels) last; each in
// chunks of pairs, those in stages of channels.
struct Jobs {
  const int32_t* counts;  // [taps], in shared memory
  int32_t taps, depth, n_rows;
  int32_t index = -1, tap = 0, count = 0, m0 = 0, k0 = 0;

  __device__ Jobs(const int32_t* counts, int32_t taps, int32_t depth, int32_t n_rows)
      : counts(counts), taps(taps), depth(depth), n_rows(n_rows) {
    next_tap();
  }
  __device__ bool done() const { return index >= taps; }
  __device__ bool centre() const { return tap == taps / 2; }
  __device__ bool last_stage() const { return k0 + kDepth >= depth; }
  __device__ void next_tap() {
    m0 = 0;
    do {
      if (++index >= taps) return;
      tap = index == taps - 1 ? taps / 2 : index < taps / 2 ? index : index + 1;
      count = centre() ? n_rows : counts[tap];
    } while (count == 0);
  }
  __device__ void advance() {
    k0 += kDepth;
    if (k0 < depth) return;
    k0 = 0;
    m0 += kChunk;
    if (m0 >= count) next_tap();
  }
};

template <typename E, int kColumns, bool kTransposed>
__global__ void __launch_bounds__(kThreads) convolve(Convolution<E> conv, int32_t column_blocks) {
  constexpr int kWarpsAcross = kColumns / kWarpColumns, kWarpsDown = kWarps / kWarpsAcross;
  constexpr int kBlocks = kChunk / 16 / kWarpsDown;    // blocks of 16 pairs of one warp
  constexpr int kRowsApart = kThreads / (kDepth / 8);  // a thread copies one chunk of 8 channels of every 32nd pair
  constexpr int kRowsCopied = kChunk / kRowsApart;
  constexpr int kWeightRow = kTransposed ? kColumns : kDepth;  // elements of a row of b
  constexpr int kWeightRows = kTransposed ? kDepth : kColumns;
  constexpr int kWeightsApart = kThreads / (kWeightRow / 8);

  extern __shared__ __align__(128) char raw[];
  auto& memory = *reinterpret_cast<Memory<E, kColumns>*>(raw);
  int32_t* counts = reinterpret_cast<int32_t*>(raw + sizeof(memory));
  const int thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  const int warp_down = warp / kWarpsAcross, warp_across = warp % kWarpsAcross;
  const int64_t tile = blockIdx.x / column_blocks, v0 = tile * kTile;
  const int32_t n0 = blockIdx.x % column_blocks * kColumns;
  const int64_t n_rows = conv.values.n_rows;
  const int64_t begin = min(max(conv.cu_voxel_rows[v0], int64_t{0}), n_rows);
  const int64_t end = min(max(conv.cu_voxel_rows[min(v0 + kTile, conv.n_voxels)], begin), n_rows);

  for (int i = thread; i < conv.taps; i += kThreads) counts[i] = conv.pairs.counts[tile * conv.taps + i];
  for (int i = thread * 4; i < kTile * kColumns; i += kThreads * 4)
    *reinterpret_cast<float4*>(memory.sums + i) = float4{0, 0, 0, 0};
  __syncthreads();

  Jobs copied(counts, conv.taps, conv.c_read, static_cast<int32_t>(end - begin));
  Jobs job = copied;

  // The rows that this thread copies for `copied`: looked up one product ahead.
  int32_t sources[kRowsCopied];
  const auto look_up = [&] {
#pragma unroll
    for (int i = 0; i < kRowsCopied; ++i) {
      const int32_t at = copied.m0 + thread / (kDepth / 8) + i * kRowsApart;
      sources[i] = -1;
      if (at >= copied.count) continue;
      if (copied.centre()) {
        const int64_t row = conv.voxel_rows[begin + at];
        if (inside(row, n_rows)) sources[i] = static_cast<int32_t>(row);
      } else {
        sources[i] = conv.pairs.sources[copied.tap * conv.pairs.pitch + v0 + at];
      }
    }
  };

  const auto copy_next = [&](int stage) {
    if (!copied.done()) {
      const int chunk = thread % (kDepth / 8), k = copied.k0 + chunk * 8;
      const int rows = min(kChunk, (copied.count - copied.m0 + 15) / 16 * 16);
#pragma unroll
      for (int i = 0; i < kRowsCopied; ++i) {
        const int row = thread / (kDepth / 8) + i * kRowsApart;
        const bool real = sources[i] >= 0 && k < conv.c_read;
        if (row < rows)
          copy_async(shared_address(memory.a[stage] + chunk_offset<kDepth>(row, chunk)),
                     real ? conv.values.at(sources[i]) + k : conv.values.rows, real);
      }
#pragma unroll
      for (int i = 0; i < kWeightRows / kWeightsApart; ++i) {
        const int row = thread / (kWeightRow / 8) + i * kWeightsApart, part = thread % (kWeightRow / 8);
        const int32_t first = kTransposed ? copied.k0 + row : n0 + row;  // index of the weight's first dimension
        const int32_t last = (kTransposed ? n0 : copied.k0) + part * 8;  // and of its last
        const bool real = first < conv.c_out && last < conv.weight_row;
        const E* from = conv.weight + (static_cast<int64_t>(first) * conv.taps + copied.tap) * conv.weight_row + last;
        copy_async(shared_address(memory.b[stage] + chunk_offset<kWeightRow>(row, part)), real ? from : conv.weight,
                   real);
      }
      if (!copied.centre() && copied.last_stage() && thread < kChunk / 16)
        copy_async(shared_address(memory.places[stage] + thread * 16),
                   conv.pairs.places + copied.tap * conv.pairs.pitch + v0 + copied.m0 + thread * 16, true);
      copied.advance();
      if (!copied.done() && copied.k0 == 0) look_up();
    }
    close_copies();
  };

  float sums[kBlocks][kWarpColumns / 8][4] = {};
  if (!copied.done()) look_up();
  for (int stage = 0; stage < kStages - 1; ++stage) copy_next(stage);

  for (int stage = 0; !job.done(); stage = (stage + 1) % kStages) {
    wait_for_copies<kStages - 2>();
    __syncthreads();
    copy_next((stage + kStages - 1) % kStages);

    const int rows = min(kChunk, job.count - job.m0);
    const int depth = min(kDepth, conv.c_read - job.k0);
#pragma unroll
    for (int k = 0; k < kDepth; k += 16) {
      if (k >= depth) break;
      uint32_t b[kWarpColumns / 16][4];
#pragma unroll
      for (int j = 0; j < kWarpColumns / 16; ++j) {
        const int column = warp_across * kWarpColumns + j * 16;
        if constexpr (kTransposed)
          load_matrices_transposed(
              shared_address(memory.b[stage] +
                             chunk_offset<kWeightRow>(k + lane / 8 % 2 * 8 + lane % 8, column / 8 + lane / 16)),
              b[j]);
        else
          load_matrices(shared_address(memory.b[stage] + chunk_offset<kWeightRow>(column + lane / 16 * 8 + lane % 8,
                                                                                  k / 8 + lane / 8 % 2)),
                        b[j]);
      }
#pragma unroll
      for (int i = 0; i < kBlocks; ++i) {
        const int row = (warp_down + i * kWarpsDown) * 16;
        if (row >= rows) break;
        uint32_t a[4];
        load_matrices(shared_address(memory.a[stage] + chunk_offset<kDepth>(row + lane % 16, k / 8 + lane / 16)), a);
#pragma unroll
        for (int j = 0; j < kWarpColumns / 8; ++j)
          multiply_add<E>(a, b[j / 2][j % 2 * 2], b[j / 2][j % 2 * 2 + 1], sums[i][j]);
      }
    }

    if (job.last_stage()) {
#pragma unroll
      for (int i = 0; i < kBlocks; ++i) {
#pragma unroll
        for (int h = 0; h < 2; ++h) {
          const int row = (warp_down + i * kWarpsDown) * 16 + lane / 4 + h * 8;
          const int column = warp_across * kWarpColumns + lane % 4 * 2;
          if (row < rows && !job.centre()) {
            const int place = memory.places[stage][row];
#pragma unroll
            for (int j = 0; j < kWarpColumns / 8; ++j) {
              float2& sum = *reinterpret_cast<float2*>(memory.sums + sum_offset<kColumns>(place, column + j * 8));
              sum = float2{sum.x + sums[i][j][2 * h], sum.y + sums[i][j][2 * h + 1]};
            }
          } else if (row < rows) {
            const Part part = part_of(conv, begin + job.m0 + row, v0);
#pragma unroll
            for (int j = 0; j < kWarpColumns / 8; ++j)
#pragma unroll
              for (int e = 0; e < 2; ++e) {
                const int32_t n = n0 + column + j * 8 + e;
                if (part.row < 0 || n >= conv.c_write) continue;
                float y = sums[i][j][2 * h + e];
                if (conv.bias != nullptr) y += static_cast<float>(conv.bias[n]);
                if (part.place >= 0)
                  y += memory.sums[sum_offset<kColumns>(part.place, column + j * 8 + e)] /
                       static_cast<float>(part.parts);
                conv.y[part.row * conv.c_write + n] = static_cast<E>(y);
              }
          }
#pragma unroll
          for (int j = 0; j < kWarpColumns / 8; ++j) sums[i][j][2 * h] = sums[i][j][2 * h + 1] = 0;
        }
      }
    }
    job.advance();
  }
  wait_for_copies<0>();
}

}  // namespace

template <typename E>
void convolve_tensor(const char* op, const Convolution<E>& conv, int64_t n_tiles, bool transposed, Stream stream) {
  const auto queue = [&]<int kColumns>() {
    const int64_t column_blocks = blocks_for(op, conv.c_write, kColumns);
    const size_t bytes = sizeof(Memory<E, kColumns>) + sizeof(int32_t) * conv.taps;
    launch(op, transposed ? convolve<E, kColumns, true> : convolve<E, kColumns, false>,
           blocks_for(op, n_tiles * column_blocks, 1), kThreads, bytes, stream, conv, column_blocks);
  };
  int shared_bytes = 0;
  check_cuda(cudaDeviceGetAttribute(&shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), op);
  const bool wide = sizeof(Memory<E, 128>) + sizeof(int32_t) * conv.taps <= static_cast<size_t>(shared_bytes);
  if (conv.c_write > 64 && wide)
    queue.template operator()<128>();
  else
    queue.template operator()<64>();
}

template void convolve_tensor<__half>(const char*, const Convolution<__half>&, int64_t, bool, Stream);
template void convolve_tensor<__nv_bfloat16>(const char*, const Convolution<__nv_bfloat16>&, int64_t, bool, Stream);

}  // namespace gsim3d::cuda::conv
