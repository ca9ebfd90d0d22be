#include <algorithm>

#include "gsim3d/core/pack.cuh"
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"

namespace gsim3d::cuda {
namespace {

using namespace conv;

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / kWarp;
constexpr int64_t kMaxRows = int64_t{1} << 30;  // rows and slots together are counted in 32 bits
constexpr int64_t kMaxKernel = 39;              // taps are a dimension of a grid
constexpr int64_t kBiasRows = 512;              // rows of one block of a bias gradient
constexpr int64_t kMaxPlanTaps = 1024;          // whose sources are listed for every row
constexpr int64_t kMaxPlanChannels = 1 << 18;   // numbers of taps and chunks fit 16 bits, their products 31
constexpr int64_t kAlignment = 16;              // bytes that the tensor-core kernels read at once
constexpr int64_t kWeightBlocks = 900;          // blocks of a weight gradient that fill a large GPU a few times
constexpr int64_t kPairsPerBlock = 128;         // pairs on average that pay for adding up a block's result
constexpr int64_t kChunkMin = 1024, kChunkMax = 16384;

enum class VoxelValue { kMean, kSum, kFirst };

void check_sizes(const char* op, const SparseConvMap& map, int64_t c_in, int64_t c_out) {
  check(map.n_rows < kMaxRows && map.n_voxels < kMaxRows, op, ": CUDA takes fewer than 2^30 rows; got ", map.n_rows);
  check(c_in < kMaxRows && c_out < kMaxRows, op, ": CUDA takes fewer than 2^30 channels");
  check(map.kernel_size <= kMaxKernel, op, ": CUDA takes kernels up to ", kMaxKernel, "; got ", map.kernel_size);
}

// One value for each voxel of several rows; a thread has kVector columns of a voxel and takes its rows in order.
template <typename E, int kVector>
__global__ void __launch_bounds__(kThreads)
    combine_rows(const E* x, Sources sources, int32_t channels, VoxelValue kind, E* shared) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x, across = channels / kVector;
  const int64_t voxel = i / across, c = i % across * kVector;
  if (voxel >= sources.n_voxels) return;
  const int32_t source = sources.of(voxel);
  if (source < sources.n_rows) return;
  Range rows = range_of(sources.cu_voxel_rows, voxel, sources.n_rows);
  if (kind == VoxelValue::kFirst) rows.end = rows.begin + 1;
  Sum<E> sums[kVector] = {};
#pragma unroll 2
  for (int64_t j = rows.begin; j < rows.end; ++j) {
    const int64_t row = sources.voxel_rows[j];
    if (!inside(row, sources.n_rows)) continue;
    const auto values = *reinterpret_cast<const Pack<E, kVector>*>(x + row * channels + c);
#pragma unroll
    for (int k = 0; k < kVector; ++k) sums[k] += static_cast<Sum<E>>(values.lane[k]);
  }
  const Sum<E> count = kind == VoxelValue::kMean ? static_cast<Sum<E>>(rows.end - rows.begin) : Sum<E>(1);
  Pack<E, kVector> result;
#pragma unroll
  for (int k = 0; k < kVector; ++k) result.lane[k] = static_cast<E>(sums[k] / count);
  *reinterpret_cast<Pack<E, kVector>*>(shared + wide_product(source - sources.n_rows, channels) + c) = result;
}

// Clears the rows that no voxel lists. Every lane looks for one row among those of its voxel, which ascend; the warp
// clears what it does not find.
template <typename E>
__global__ void __launch_bounds__(kThreads)
    clear_unlisted(Sources sources, const int64_t* row_voxel, int32_t channels, E* y) {
  const int64_t row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = threadIdx.x % kWarp;
  bool listed = row >= sources.n_rows;
  const int64_t voxel = listed ? -1 : row_voxel[row];
  if (inside(voxel, sources.n_voxels)) {
    Range rows = range_of(sources.cu_voxel_rows, voxel, sources.n_rows);
    while (rows.begin < rows.end && !listed) {
      const int64_t middle = (rows.begin + rows.end) / 2, found = sources.voxel_rows[middle];
      listed = found == row;
      if (found < row)
        rows.begin = middle + 1;
      else
        rows.end = middle;
    }
  }
  for (unsigned missing = __ballot_sync(kFullWarp, !listed); missing != 0; missing &= missing - 1) {
    E* to = y + (row - lane + __ffs(missing) - 1) * channels;
    for (int32_t c = lane; c < channels; c += kWarp) to[c] = E(0);
  }
}

// Rows of `channels` columns, with zeros up to `padded`.
template <typename E>
__global__ void __launch_bounds__(kThreads)
    pad_rows(const E* from, int64_t n, int32_t channels, int32_t padded, E* to) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n * padded) return;
  const int64_t row = i / padded, c = i % padded;
  to[i] = c < channels ? from[row * channels + c] : E(0);
}

// to[ci, tap, co] = from[co, tap, ci], with zeros for co up to `padded`, a multiple of 8. A block turns a square: a
// thread reads eight columns of two rows, in vectors where rows hold whole ones, and writes eight columns of two rows.
constexpr int kSquare = 64;
template <typename E, bool kVectors>
__global__ void __launch_bounds__(kThreads)
    transpose_weights(const E* from, int32_t taps, int32_t c_in, int32_t c_out, int32_t padded, E* to) {
  using Eight = Pack<E, 8>;
  using Two = Pack<E, 2>;
  constexpr int kTwos = kSquare / 2, kEights = kSquare / 8;
  static_assert(kThreads == kTwos * kEights);
  __shared__ Two square[kSquare][kTwos + 1];
  const int32_t ci0 = blockIdx.x * kSquare, co0 = blockIdx.y * kSquare, tap = blockIdx.z;
  const int column = threadIdx.x % kEights, row = threadIdx.x / kEights;
  Eight read[2] = {};
#pragma unroll
  for (int h = 0; h < 2; ++h) {
    const int64_t co = co0 + 2 * row + h;
    const int32_t ci = ci0 + column * 8;
    const E* values = from + (co * taps + tap) * c_in + ci;
    if (co >= c_out) continue;
    if constexpr (kVectors) {
      if (ci < c_in) read[h] = *reinterpret_cast<const Eight*>(values);
    } else {
#pragma unroll
      for (int k = 0; k < 8; ++k)
        if (ci + k < c_in) read[h].lane[k] = values[k];
    }
  }
#pragma unroll
  for (int k = 0; k < 8; ++k) square[column * 8 + k][row] = Two{read[0].lane[k], read[1].lane[k]};
  __syncthreads();
#pragma unroll
  for (int r = row; r < kSquare; r += kTwos) {
    const int64_t ci = ci0 + r;
    const int32_t co = co0 + column * 8;
    Eight turned;
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const Two two = square[r][column * 4 + k];
      turned.lane[2 * k] = two.lane[0];
      turned.lane[2 * k + 1] = two.lane[1];
    }
    if (ci < c_in && co < padded) *reinterpret_cast<Eight*>(to + (ci * taps + tap) * padded + co) = turned;
  }
}

// The pairs that write each tile through each tap: `written` ascends inside a tap. One warp for a tile and a tap.
__global__ void __launch_bounds__(kThreads)
    list_pairs(const int64_t* written, const int64_t* read, const int64_t* cu_taps, int32_t taps, int64_t n_pairs,
               int64_t n_tiles, Sources sources, int64_t pitch, int32_t* list, uint8_t* places, int32_t* counts,
               int32_t* rows) {
  constexpr int kAtOnce = 4;  // pairs of a lane whose loads are in flight together
  const int64_t tile = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / kWarp, v0 = tile * kTile;
  if (tile >= n_tiles) return;
  const int32_t tap = blockIdx.y, lane = threadIdx.x % kWarp;
  if (tap == taps / 2) {
    const int64_t end = range_of(sources.cu_voxel_rows, min(v0 + kTile, sources.n_voxels) - 1, sources.n_rows).end;
    for (int64_t i = range_of(sources.cu_voxel_rows, v0, sources.n_rows).begin + lane; i < end; i += kWarp)
      rows[i] = inside(sources.voxel_rows[i], sources.n_rows) ? static_cast<int32_t>(sources.voxel_rows[i]) : -1;
    if (lane == 0) counts[tile * taps + tap] = 0;
    return;
  }
  const Range found_pairs = search_range(written, range_of(cu_taps, tap, n_pairs), v0, kTile);
  const int64_t begin = found_pairs.begin, end = found_pairs.end;
  const int64_t at = tap * pitch + v0;
  int32_t count = 0;
  for (int64_t i0 = begin; i0 < end && count < kTile; i0 += kAtOnce * kWarp) {
    int64_t place[kAtOnce], voxel[kAtOnce];
    int32_t source[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int64_t i = i0 + k * kWarp + lane;
      place[k] = i < end ? written[i] - v0 : -1;
      voxel[k] = i < end ? read[i] : -1;
    }
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) source[k] = sources.of(voxel[k]);
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const bool good = source[k] >= 0 && inside(place[k], kTile);
      const unsigned found = __ballot_sync(kFullWarp, good);
      const int32_t slot = count + __popc(found & ((1u << lane) - 1));
      if (good && slot < kTile) {
        list[at + slot] = source[k];
        places[at + slot] = static_cast<uint8_t>(place[k]);
      }
      count = min(count + __popc(found), kTile);
    }
  }
  if (lane == 0) counts[tile * taps + tap] = count;
}

// partials[block, c] = sum over the rows of a block. Eight threads lie side by side with kVector columns each, 32 take
// turns at the rows; their sums are added in a tree.
template <typename E, int kVector>
__global__ void __launch_bounds__(kThreads)
    sum_rows(const E* grad, int64_t n_rows, int32_t channels, Sum<E>* partials) {
  constexpr int kAcross = 8, kRowsAtOnce = kThreads / kAcross;
  __shared__ Sum<E> sums[kWarps][kAcross * kVector];
  const int column = threadIdx.x % kAcross * kVector, lane = threadIdx.x / kAcross;
  const int32_t c0 = blockIdx.y * kAcross * kVector, c = c0 + column;
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * kBiasRows, end = min(n_rows, begin + kBiasRows);
  Sum<E> sum[kVector] = {};
  if (c < channels)
#pragma unroll 8
    for (int64_t row = begin + lane; row < end; row += kRowsAtOnce) {
      const auto values = *reinterpret_cast<const Pack<E, kVector>*>(grad + row * channels + c);
#pragma unroll
      for (int i = 0; i < kVector; ++i) sum[i] += static_cast<Sum<E>>(values.lane[i]);
    }
#pragma unroll
  for (int i = 0; i < kVector; ++i) {
    sum[i] += __shfl_xor_sync(kFullWarp, sum[i], kAcross);
    sum[i] += __shfl_xor_sync(kFullWarp, sum[i], 2 * kAcross);
    if (threadIdx.x % kWarp < kAcross) sums[threadIdx.x / kWarp][column + i] = sum[i];
  }
  __syncthreads();
  const int i = threadIdx.x;
  if (i >= kAcross * kVector || c0 + i >= channels) return;
  static_assert(kWarps == 8);
  partials[static_cast<int64_t>(blockIdx.x) * channels + c0 + i] =
      ((sums[0][i] + sums[1][i]) + (sums[2][i] + sums[3][i])) + ((sums[4][i] + sums[5][i]) + (sums[6][i] + sums[7][i]));
}

// The bias of a weight gradient: every warp adds every kWarps-th block up, for one column a lane; then in a tree.
template <typename T, typename R>
__device__ void add_bias(const T* partials, int64_t blocks, int32_t channels, R* grad_bias) {
  __shared__ T sums[kWarps][kWarp];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t c = static_cast<int64_t>(blockIdx.x) * kWarp + lane;
  if (c - lane >= channels) return;
  T sum{};
  if (c < channels)
#pragma unroll 8
    for (int64_t b = warp; b < blocks; b += kWarps) sum += partials[b * channels + c];
  sums[warp][lane] = sum;
  __syncthreads();
  if (warp > 0 || c >= channels) return;
  static_assert(kWarps == 8);
  grad_bias[c] = static_cast<R>(((sums[0][lane] + sums[1][lane]) + (sums[2][lane] + sums[3][lane])) +
                                ((sums[4][lane] + sums[5][lane]) + (sums[6][lane] + sums[7][lane])));
}

// Adding blocks of pairs up. Where there are few, a thread adds all of them, for kFewEach times kFewColumns elements.
// Else kAdders threads take every kAdders-th block, then their sums are added in a tree; a thread has kEach elements,
// kElements apart. The loads of a thread are in flight together.
constexpr int kFewColumns = 4, kFewEach = 2;
constexpr int kAdders = 4, kElements = kThreads / kAdders, kEach = 4;
constexpr int64_t kFewChunks = 4;

// First the bias, then one tap after another.
template <typename E, typename R, bool kFew>
__global__ void __launch_bounds__(kThreads)
    add_partials(OuterProducts<E> products, int64_t n_chunks, int32_t c_out, int32_t c_in, const Sum<E>* bias_partials,
                 int64_t bias_blocks, R* grad_weight, R* grad_bias) {
  using T = Sum<E>;
  if (blockIdx.y == 0) return add_bias(bias_partials, bias_blocks, c_out, grad_bias);
  const int32_t tap = static_cast<int32_t>(blockIdx.y) - 1, centre = products.taps / 2;
  const int32_t parts_of_chunk = tap == centre ? products.centre_parts : 1;
  const int32_t unit = tap == centre ? 0 : products.centre_parts + (tap < centre ? tap : tap - 1);
  const int64_t size = static_cast<int64_t>(products.c_out) * products.c_in, blocks = n_chunks * parts_of_chunk;
  const int64_t count = static_cast<int64_t>(c_out) * c_in;
  const auto block_at = [&](int64_t b) {
    return products.partials + (b / parts_of_chunk * products.blocks_per_chunk() + unit + b % parts_of_chunk) * size;
  };
  const auto result_at = [&](int64_t i) { return grad_weight + (i / c_in * products.taps + tap) * c_in + i % c_in; };
  if constexpr (kFew) {
    constexpr int64_t kApart = kThreads * kFewColumns;
    const int64_t first = static_cast<int64_t>(blockIdx.x) * kApart * kFewEach + threadIdx.x * kFewColumns;
    T sums[kFewEach][kFewColumns] = {};
#pragma unroll 4
    for (int64_t b = 0; b < blocks; ++b) {
      const T* from = block_at(b);
#pragma unroll
      for (int k = 0; k < kFewEach; ++k) {
        const int64_t i = first + k * kApart;
        if (i >= count) continue;
        const auto part = *reinterpret_cast<const Pack<T, kFewColumns>*>(from + i);
#pragma unroll
        for (int j = 0; j < kFewColumns; ++j) sums[k][j] += part.lane[j];
      }
    }
#pragma unroll
    for (int k = 0; k < kFewEach; ++k) {
      const int64_t i = first + k * kApart;
      if (i >= count) continue;
      Pack<R, kFewColumns> result;
#pragma unroll
      for (int j = 0; j < kFewColumns; ++j) result.lane[j] = static_cast<R>(sums[k][j]);
      *reinterpret_cast<Pack<R, kFewColumns>*>(result_at(i)) = result;
    }
  } else {
    __shared__ T sums[kAdders][kEach][kElements];
    const int adder = threadIdx.x / kElements, element = threadIdx.x % kElements;
    const int64_t first = static_cast<int64_t>(blockIdx.x) * kElements * kEach + element;
    if (first - element >= count) return;
    int64_t offset[kEach];
#pragma unroll
    for (int k = 0; k < kEach; ++k) {
      const int64_t i = min(first + k * kElements, count - 1);
      offset[k] = i / c_in * products.c_in + i % c_in;
    }
    T parts[kEach] = {};
#pragma unroll 4
    for (int64_t b = adder; b < blocks; b += kAdders) {
      const T* from = block_at(b);
#pragma unroll
      for (int k = 0; k < kEach; ++k) parts[k] += from[offset[k]];
    }
#pragma unroll
    for (int k = 0; k < kEach; ++k) sums[adder][k][element] = parts[k];
    __syncthreads();
    // Each adder finishes one of the kEach elements.
    static_assert(kAdders == kEach);
    const int64_t i = first + adder * kElements;
    if (i < count)
      *result_at(i) = static_cast<R>((sums[0][adder][element] + sums[1][adder][element]) +
                                     (sums[2][adder][element] + sums[3][adder][element]));
  }
}

template <typename E>
bool aligned(const E* data) {
  return reinterpret_cast<uintptr_t>(data) % kAlignment == 0;
}

// What the tensor cores read: rows that start at multiples of 16 bytes.
template <typename E>
struct Padded {
  const E* data;
  int64_t channels;
};

template <typename E>
Padded<E> padded(const char* op, const E* data, int64_t n, int64_t channels, const Workspace& workspace,
                 Stream stream) {
  const int64_t wanted = round_up(channels, kAlignment / static_cast<int64_t>(sizeof(E)));
  if (!kIsHalf<E> || (wanted == channels && aligned(data))) return {data, channels};
  E* copy = workspace.take<E>(n * wanted);
  launch(op, pad_rows<E>, blocks_for(op, n * wanted, kThreads), kThreads, 0, stream, data, n, channels, wanted, copy);
  return {copy, wanted};
}

// Rows of `channels` columns, and for voxels of several rows one value each.
template <typename E>
Values<E> values_of(const char* op, const E* x, const SparseConvMap& map, int64_t channels, VoxelValue kind,
                    const Workspace& workspace, Stream stream) {
  const int64_t n_slots = slots_of(map);
  E* shared = nullptr;
  if (n_slots > 0 && channels > 0) {
    shared = workspace.take<E>(n_slots * channels);
    constexpr int kVector = kAlignment / sizeof(E);
    const bool vectors = channels % kVector == 0 && aligned(x);
    launch(op, vectors ? combine_rows<E, kVector> : combine_rows<E, 1>,
           blocks_for(op, map.n_voxels * (vectors ? channels / kVector : channels), kThreads), kThreads, 0, stream, x,
           sources_of(map), channels, kind, shared);
  }
  return {x, shared, static_cast<int32_t>(map.n_rows), static_cast<int32_t>(map.n_rows + n_slots),
          static_cast<int32_t>(channels)};
}

TilePairs pairs_of(const char* op, const SparseConvMap& map, bool transposed, const Workspace& workspace,
                   Stream stream) {
  const int64_t taps = taps_of(map), n_tiles = tiles_of(map), pitch = n_tiles * kTile;
  int32_t* sources = workspace.take<int32_t>(taps * pitch + taps * pitch / 4 + taps * n_tiles + map.n_rows);
  uint8_t* places = reinterpret_cast<uint8_t*>(sources + taps * pitch);  // at a multiple of 16 bytes, as it is read
  int32_t* counts = sources + taps * pitch + taps * pitch / 4;
  int32_t* rows = counts + taps * n_tiles;
  launch(op, list_pairs, dim3(blocks_for(op, n_tiles, kWarps), static_cast<unsigned>(taps)), kThreads, 0, stream,
         transposed ? map.tap_in : map.tap_out, transposed ? map.tap_out : map.tap_in, map.cu_taps, taps, map.n_pairs,
         n_tiles, sources_of(map), pitch, sources, places, counts, rows);
  return {sources, places, counts, rows, static_cast<int32_t>(pitch)};
}

// How a weight gradient is cut: the same for the same sizes, whatever the GPU.
struct WeightPlan {
  int64_t chunk_voxels, n_chunks, centre_parts;
};

WeightPlan plan_of(const SparseConvMap& map, int64_t c_in, int64_t c_out) {
  const int64_t others = taps_of(map) - 1, pairs = std::max<int64_t>(1, map.n_pairs);
  const int64_t tiles = round_up(c_out, 128) * round_up(c_in, 128) / (128 * 128);
  const int64_t ratio = map.n_rows * std::max<int64_t>(1, others) / pairs;  // of centre pairs to those of another tap
  WeightPlan plan{kChunkMin, 0, 1};
  const auto blocks = [&] { return map.n_voxels / plan.chunk_voxels * (others + ratio) * tiles; };
  const auto pairs_per_block = [&] { return pairs * plan.chunk_voxels / std::max<int64_t>(1, map.n_voxels * others); };
  while (plan.chunk_voxels < kChunkMax && (blocks() > kWeightBlocks || pairs_per_block() < kPairsPerBlock))
    plan.chunk_voxels *= 2;
  while (2 * plan.centre_parts <= ratio && plan.chunk_voxels / plan.centre_parts > kChunkMin) plan.centre_parts *= 2;
  plan.n_chunks = (map.n_voxels + plan.chunk_voxels - 1) / plan.chunk_voxels;
  return plan;
}

template <typename T>
const auto* native_data(const T* data) {
  return reinterpret_cast<const Native<T>*>(data);
}
template <typename T>
auto* native_data(T* data) {
  return reinterpret_cast<Native<T>*>(data);
}

// The convolution, or the gradient of its input from that of its output.
template <typename E, bool kGradient>
void convolve(const char* op, const E* x, const E* weight, const E* bias, const SparseConvMap& map, int64_t c_in,
              int64_t c_out, E* y, const Workspace& workspace, Stream stream) {
  check_sizes(op, map, c_in, c_out);
  const int64_t taps = taps_of(map);
  const Padded<E> rows = padded(op, x, map.n_rows, kGradient ? c_out : c_in, workspace, stream);
  const Padded<E> weights =
      kGradient ? Padded<E>{weight, c_in} : padded(op, weight, c_out * taps, c_in, workspace, stream);
  const VoxelValue kind = kGradient ? VoxelValue::kSum : map.first ? VoxelValue::kFirst : VoxelValue::kMean;
  const bool whole = !kGradient || slots_of(map) == 0;
  const int64_t c_write = kGradient ? c_in : c_out;
  Convolution<E> conv{values_of(op, rows.data, map, rows.channels, kind, workspace, stream),
                      weights.data,
                      bias,
                      map.row_voxel,
                      map.voxel_rows,
                      map.cu_voxel_rows,
                      map.n_voxels,
                      static_cast<int32_t>(taps),
                      static_cast<int32_t>(rows.channels),
                      static_cast<int32_t>(c_write),
                      static_cast<int32_t>(c_out),
                      static_cast<int32_t>(weights.channels),
                      whole ? Share::kWhole : map.first ? Share::kFirstRow : Share::kEqualParts,
                      y,
                      {},
                      {}};
  if constexpr (kIsHalf<E>)
    if (rows.channels > 0 && taps <= kMaxPlanTaps && std::max(c_in, c_out) <= kMaxPlanChannels) {
      const int32_t* plan = map.plan;
      if (plan == nullptr) {
        int32_t* own = workspace.take<int32_t>(sparse_conv_plan_size(map.n_rows, map.kernel_size));
        make_row_plan(op, map, kGradient, own, workspace, stream);
        plan = own;
      }
      Convolution<E> tensor = conv;
      tensor.plan = row_plan_in(plan, map.n_rows, taps, kGradient && map.plan != nullptr);
      if constexpr (kGradient) {
        E* transposed = workspace.take<E>(c_in * taps * rows.channels);
        const dim3 squares(blocks_for(op, c_in, kSquare), blocks_for(op, rows.channels, kSquare),
                           static_cast<unsigned>(taps));
        launch(op, c_in % 8 == 0 && aligned(weight) ? transpose_weights<E, true> : transpose_weights<E, false>, squares,
               kThreads, 0, stream, weight, taps, c_in, c_out, rows.channels, transposed);
        tensor.weight = transposed;
        tensor.weight_row = static_cast<int32_t>(rows.channels);
      }
      launch(op, clear_unlisted<E>, blocks_for(op, map.n_rows, kThreads), kThreads, 0, stream, sources_of(map),
             map.row_voxel, c_write, y);
      if (convolve_tensor(op, tensor, workspace, stream)) return;
    }
  fill_zero(op, y, map.n_rows * c_write, stream);
  conv.pairs = pairs_of(op, map, kGradient, workspace, stream);
  convolve_plain(op, conv, tiles_of(map), kGradient, stream);
}

}  // namespace

template <typename T>
void sparse_conv(const T* x, const T* weight, const T* bias, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                 T* out, const Workspace& workspace, Stream stream) {
  convolve<Native<T>, false>("sparse_conv", native_data(x), native_data(weight),
                             bias == nullptr ? nullptr : native_data(bias), map, c_in, c_out, native_data(out),
                             workspace, stream);
}

template <typename T>
void sparse_conv_vjp_input(const T* grad, const T* weight, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                           T* grad_x, const Workspace& workspace, Stream stream) {
  convolve<Native<T>, true>("sparse_conv_grad_input", native_data(grad), native_data(weight), nullptr, map, c_in, c_out,
                            native_data(grad_x), workspace, stream);
}

template <typename T, typename R>
void sparse_conv_vjp_weight(const T* grad, const T* x, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                            R* grad_weight, R* grad_bias, const Workspace& workspace, Stream stream) {
  using E = Native<T>;
  const char* op = "sparse_conv_grad_weight";
  check_sizes(op, map, c_in, c_out);
  const int64_t taps = taps_of(map);
  const Padded<E> left = padded(op, native_data(grad), map.n_rows, c_out, workspace, stream);
  const Padded<E> right = padded(op, native_data(x), map.n_rows, c_in, workspace, stream);

  const int64_t bias_blocks = (map.n_rows + kBiasRows - 1) / kBiasRows;
  Sum<E>* bias_partials = workspace.take<Sum<E>>(bias_blocks * c_out);
  constexpr int kVector = kAlignment / sizeof(E);
  const bool vectors = c_out % kVector == 0 && aligned(native_data(grad));
  launch(op, vectors ? sum_rows<E, kVector> : sum_rows<E, 1>,
         dim3(blocks_for(op, bias_blocks, 1), blocks_for(op, c_out, vectors ? 8 * kVector : 8)), kThreads, 0, stream,
         native_data(grad), map.n_rows, c_out, bias_partials);

  const WeightPlan plan = plan_of(map, c_in, c_out);
  const bool direct = kIsHalf<E> && plan.n_chunks * plan.centre_parts == 1 && right.channels == c_in;
  const int64_t n_blocks = plan.n_chunks * (plan.centre_parts + taps - 1);
  const OuterProducts<E> products{
      values_of(op, left.data, map, left.channels, VoxelValue::kSum, workspace, stream),
      values_of(op, right.data, map, right.channels, map.first ? VoxelValue::kFirst : VoxelValue::kMean, workspace,
                stream),
      sources_of(map),
      map.tap_in,
      map.tap_out,
      map.cu_taps,
      map.n_pairs,
      plan.chunk_voxels,
      static_cast<int32_t>(taps),
      static_cast<int32_t>(plan.centre_parts),
      static_cast<int32_t>(left.channels),
      static_cast<int32_t>(right.channels),
      direct ? nullptr : workspace.take<Sum<E>>(n_blocks * left.channels * right.channels),
      grad_weight,
      static_cast<int32_t>(c_out),
      !std::is_same_v<R, Sum<T>>};
  if constexpr (kIsHalf<E>)
    outer_products_tensor(op, products, n_blocks, stream);
  else
    outer_products_plain(op, products, n_blocks, stream);
  const bool few = plan.n_chunks <= kFewChunks && right.channels == c_in && c_in % kFewColumns == 0;
  const unsigned columns =
      blocks_for(op, direct ? 0 : c_out * c_in, few ? kThreads * kFewColumns * kFewEach : kElements * kEach);
  const dim3 blocks(std::max(columns, blocks_for(op, c_out, kWarp)), direct ? 1 : static_cast<unsigned>(taps + 1));
  launch(op, few ? add_partials<E, Native<R>, true> : add_partials<E, Native<R>, false>, blocks, kThreads, 0, stream,
         products, plan.n_chunks, c_out, c_in, bias_partials, bias_blocks, native_data(grad_weight),
         native_data(grad_bias));
}

#define GSIM3D_INSTANTIATE_WEIGHT(T, R)                                                                       \
  template void sparse_conv_vjp_weight<T, R>(const T*, const T*, const SparseConvMap&, int64_t, int64_t, R*,  \
                                             R*, const Workspace&, Stream);
#define GSIM3D_INSTANTIATE(T)                                                                                 \
  template void sparse_conv<T>(const T*, const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*,      \
                               const Workspace&, Stream);                                                     \
  template void sparse_conv_vjp_input<T>(const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*,      \
                                         const Workspace&, Stream);                                           \
  GSIM3D_INSTANTIATE_WEIGHT(T, Sum<T>)
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(Float16)
GSIM3D_INSTANTIATE(BFloat16)
GSIM3D_INSTANTIATE_WEIGHT(Float16, Float16)
GSIM3D_INSTANTIATE_WEIGHT(BFloat16, BFloat16)
#undef GSIM3D_INSTANTIATE
#undef GSIM3D_INSTANTIATE_WEIGHT

}  // namespace gsim3d::cuda
