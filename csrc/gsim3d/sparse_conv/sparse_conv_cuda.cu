#include <algorithm>

#include "gsim3d/sparse_conv/sparse_conv_device.cuh"

namespace gsim3d::cuda {
namespace {

using namespace conv;

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / kWarp;
constexpr int64_t kMaxRows = int64_t{1} << 30;  // rows and slots together are counted in 32 bits
constexpr int64_t kMaxKernel = 39;              // taps are a dimension of a grid
constexpr int64_t kBiasRows = 512;              // rows of one block of a bias gradient
constexpr int64_t kAlignment = 16;              // bytes that the tensor-core kernels read at once
// Blocks of a weight gradient: enough of them to fill a large GPU, few enough that adding them up stays cheap.
constexpr int64_t kBlockPairsMin = 256, kBlockPairsMax = 2048, kWeightBlocks = 800;

enum class VoxelValue { kMean, kSum };

void check_sizes(const char* op, const SparseConvMap& map, int64_t c_in, int64_t c_out) {
  check(map.n_rows < kMaxRows && map.n_voxels < kMaxRows, op, ": CUDA takes fewer than 2^30 rows; got ", map.n_rows);
  check(c_in < kMaxRows && c_out < kMaxRows, op, ": CUDA takes fewer than 2^30 channels");
  check(map.kernel_size <= kMaxKernel, op, ": CUDA takes kernels up to ", kMaxKernel, "; got ", map.kernel_size);
}

int64_t slots_of(const SparseConvMap& map) { return std::max<int64_t>(0, map.n_rows - map.n_voxels); }

Sources sources_of(const SparseConvMap& map, bool first) {
  return {map.voxel_rows, map.cu_voxel_rows, map.n_rows, map.n_voxels, slots_of(map), first};
}

// A warp sums the rows of a voxel, in order.
template <typename E>
__global__ void __launch_bounds__(kThreads)
    combine_rows(const E* x, Sources sources, int32_t channels, bool mean, E* shared) {
  const int64_t voxel = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (voxel >= sources.n_voxels) return;
  const int32_t source = sources.of(voxel);
  if (source < sources.n_rows) return;
  const Range rows = range_of(sources.cu_voxel_rows, voxel, sources.n_rows);
  E* to = shared + (source - sources.n_rows) * channels;
  for (int32_t c = threadIdx.x % kWarp; c < channels; c += kWarp) {
    Sum<E> sum = 0;
    for (int64_t i = rows.begin; i < rows.end; ++i) {
      const int64_t row = sources.voxel_rows[i];
      if (inside(row, sources.n_rows)) sum += static_cast<Sum<E>>(x[row * channels + c]);
    }
    to[c] = static_cast<E>(mean ? sum / static_cast<Sum<E>>(rows.end - rows.begin) : sum);
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

// The pairs that write each tile through each tap: a warp finds them by bisection, for `written` ascends inside a tap.
__global__ void __launch_bounds__(kThreads)
    list_pairs(const int64_t* written, const int64_t* read, const int64_t* cu_taps, int32_t taps, int64_t n_pairs,
               int64_t n_tiles, Sources sources, int64_t pitch, int32_t* list, uint8_t* places, int32_t* counts) {
  const int64_t unit = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (unit >= n_tiles * taps) return;
  const int64_t tile = unit % n_tiles, v0 = tile * kTile;
  const int32_t tap = static_cast<int32_t>(unit / n_tiles), lane = threadIdx.x % kWarp;
  const Range range = range_of(cu_taps, tap, n_pairs);
  int64_t low = range.begin, high = range.end;
  const int64_t wanted = v0 + (lane == 1 ? kTile : 0);
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (written[middle] < wanted)
      low = middle + 1;
    else
      high = middle;
  }
  const int64_t begin = __shfl_sync(kFullWarp, low, 0), end = __shfl_sync(kFullWarp, low, 1);
  const int64_t at = tap * pitch + v0;
  int32_t count = 0;
  for (int64_t i0 = begin; i0 < end && tap != taps / 2; i0 += kWarp) {
    const int64_t i = i0 + lane;
    int32_t source = -1;
    int64_t place = -1;
    if (i < end) {
      place = written[i] - v0;
      source = sources.of(read[i]);
    }
    const bool good = source >= 0 && inside(place, kTile);
    const unsigned found = __ballot_sync(kFullWarp, good);
    const int32_t slot = count + __popc(found & ((1u << lane) - 1));
    if (good && slot < kTile) {
      list[at + slot] = source;
      places[at + slot] = static_cast<uint8_t>(place);
    }
    count = min(count + __popc(found), kTile);
    if (count == kTile) break;
  }
  if (lane == 0) counts[tile * taps + tap] = count;
}

// partials[block, c] = sum over the rows of a block; threads of a column take every fourth row.
template <typename E>
__global__ void __launch_bounds__(kThreads)
    sum_rows(const E* grad, int64_t n_rows, int32_t channels, Sum<E>* partials) {
  constexpr int kColumns = 64, kLanes = kThreads / kColumns;
  __shared__ Sum<E> sums[kLanes][kColumns];
  const int lane = threadIdx.x / kColumns, column = threadIdx.x % kColumns;
  const int32_t c = blockIdx.y * kColumns + column;
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * kBiasRows, end = min(n_rows, begin + kBiasRows);
  Sum<E> sum = 0;
  if (c < channels)
    for (int64_t row = begin + lane; row < end; row += kLanes) sum += static_cast<Sum<E>>(grad[row * channels + c]);
  sums[lane][column] = sum;
  __syncthreads();
  if (lane == 0 && c < channels)
    partials[static_cast<int64_t>(blockIdx.x) * channels + c] =
        (sums[0][column] + sums[1][column]) + (sums[2][column] + sums[3][column]);
}

// Blocks are added in four chains, the chains in pairs.
template <typename T>
__device__ T add_blocks(const T* blocks, int64_t n, int64_t size) {
  T sums[4] = {};
  for (int64_t b = 0; b < n; b += 4)
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (b + i < n) sums[i] += blocks[(b + i) * size];
  return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

// One tap (blockIdx.y), then the bias.
template <typename E>
__global__ void __launch_bounds__(kThreads)
    add_partials(OuterProducts<E> products, int32_t c_out, int32_t c_in, const Sum<E>* bias_partials,
                 int64_t bias_blocks, E* grad_weight, E* grad_bias) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int32_t tap = blockIdx.y;
  if (tap == products.taps) {
    if (i < c_out) grad_bias[i] = static_cast<E>(add_blocks(bias_partials + i, bias_blocks, c_out));
    return;
  }
  const PairBlock block =
      find_block(products.cu_taps, products.taps, products.n_pairs, products.n_rows, products.block_pairs, -1, tap);
  if (i >= static_cast<int64_t>(c_out) * c_in) return;
  const int64_t size = static_cast<int64_t>(products.c_out) * products.c_in, co = i / c_in, ci = i % c_in;
  const Sum<E>* from = products.partials + block.first * size + co * products.c_in + ci;
  grad_weight[(co * products.taps + tap) * c_in + ci] = static_cast<E>(add_blocks(from, block.blocks, size));
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

// Values of the voxels; rows of `channels` columns.
template <typename E>
Values<E> values_of(const char* op, const E* x, const SparseConvMap& map, int64_t channels, VoxelValue kind, bool first,
                    const Workspace& workspace, Stream stream) {
  const int64_t n_slots = slots_of(map);
  E* shared = nullptr;
  if (n_slots > 0 && !first) {
    shared = workspace.take<E>(n_slots * channels);
    launch(op, combine_rows<E>, blocks_for(op, map.n_voxels, kWarps), kThreads, 0, stream, x, sources_of(map, first),
           channels, kind == VoxelValue::kMean, shared);
  }
  return {x, shared, static_cast<int32_t>(map.n_rows), static_cast<int32_t>(channels)};
}

TilePairs pairs_of(const char* op, const SparseConvMap& map, bool transposed, bool first, const Workspace& workspace,
                   Stream stream) {
  const int64_t taps = taps_of(map), n_tiles = tiles_of(map), pitch = n_tiles * kTile;
  int32_t* sources = workspace.take<int32_t>(taps * pitch);
  uint8_t* places = workspace.take<uint8_t>(taps * pitch);
  int32_t* counts = workspace.take<int32_t>(taps * n_tiles);
  launch(op, list_pairs, blocks_for(op, n_tiles * taps, kWarps), kThreads, 0, stream,
         transposed ? map.tap_in : map.tap_out, transposed ? map.tap_out : map.tap_in, map.cu_taps, taps, map.n_pairs,
         n_tiles, sources_of(map, first), pitch, sources, places, counts);
  return {sources, places, counts, pitch};
}

template <typename E>
void convolve(const char* op, const Convolution<E>& convolution, int64_t n_tiles, bool transposed, Stream stream) {
  if constexpr (kIsHalf<E>)
    convolve_tensor(op, convolution, n_tiles, transposed, stream);
  else
    convolve_plain(op, convolution, n_tiles, transposed, stream);
}

template <typename T>
const auto* native_data(const T* data) {
  return reinterpret_cast<const typename Native<T>::Type*>(data);
}
template <typename T>
auto* native_data(T* data) {
  return reinterpret_cast<typename Native<T>::Type*>(data);
}

}  // namespace

template <typename T>
void sparse_conv(const T* x, const T* weight, const T* bias, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                 T* out, const Workspace& workspace, Stream stream) {
  using E = typename Native<T>::Type;
  const char* op = "sparse_conv";
  check_sizes(op, map, c_in, c_out);
  const int64_t taps = taps_of(map);
  const Padded<E> rows = padded(op, native_data(x), map.n_rows, c_in, workspace, stream);
  const Padded<E> weights = padded(op, native_data(weight), c_out * taps, c_in, workspace, stream);
  const Values<E> values =
      values_of(op, rows.data, map, rows.channels, VoxelValue::kMean, map.first, workspace, stream);
  const TilePairs pairs = pairs_of(op, map, false, map.first, workspace, stream);
  const Convolution<E> convolution{values,
                                   weights.data,
                                   bias == nullptr ? nullptr : native_data(bias),
                                   pairs,
                                   map.voxel_rows,
                                   map.cu_voxel_rows,
                                   map.row_voxel,
                                   map.n_voxels,
                                   static_cast<int32_t>(taps),
                                   static_cast<int32_t>(rows.channels),
                                   static_cast<int32_t>(c_out),
                                   static_cast<int32_t>(c_out),
                                   static_cast<int32_t>(weights.channels),
                                   Share::kWhole,
                                   native_data(out)};
  convolve(op, convolution, tiles_of(map), false, stream);
}

template <typename T>
void sparse_conv_vjp_input(const T* grad, const T* weight, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                           T* grad_x, const Workspace& workspace, Stream stream) {
  using E = typename Native<T>::Type;
  const char* op = "sparse_conv_grad_input";
  check_sizes(op, map, c_in, c_out);
  const int64_t taps = taps_of(map);
  const Padded<E> rows = padded(op, native_data(grad), map.n_rows, c_out, workspace, stream);
  const Padded<E> weights = padded(op, native_data(weight), c_out * taps, c_in, workspace, stream);
  const Values<E> values = values_of(op, rows.data, map, rows.channels, VoxelValue::kSum, false, workspace, stream);
  const TilePairs pairs = pairs_of(op, map, true, false, workspace, stream);
  const Convolution<E> convolution{values,
                                   weights.data,
                                   nullptr,
                                   pairs,
                                   map.voxel_rows,
                                   map.cu_voxel_rows,
                                   map.row_voxel,
                                   map.n_voxels,
                                   static_cast<int32_t>(taps),
                                   static_cast<int32_t>(rows.channels),
                                   static_cast<int32_t>(c_in),
                                   static_cast<int32_t>(c_out),
                                   static_cast<int32_t>(weights.channels),
                                   map.first ? Share::kFirstRow : Share::kEqualParts,
                                   native_data(grad_x)};
  convolve(op, convolution, tiles_of(map), true, stream);
}

template <typename T>
void sparse_conv_vjp_weight(const T* grad, const T* x, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                            T* grad_weight, T* grad_bias, const Workspace& workspace, Stream stream) {
  using E = typename Native<T>::Type;
  const char* op = "sparse_conv_grad_weight";
  check_sizes(op, map, c_in, c_out);
  const int64_t taps = taps_of(map);
  const Padded<E> left = padded(op, native_data(grad), map.n_rows, c_out, workspace, stream);
  const Padded<E> right = padded(op, native_data(x), map.n_rows, c_in, workspace, stream);

  const int64_t bias_blocks = (map.n_rows + kBiasRows - 1) / kBiasRows;
  Sum<E>* bias_partials = workspace.take<Sum<E>>(bias_blocks * c_out);
  launch(op, sum_rows<E>, dim3(blocks_for(op, bias_blocks, 1), blocks_for(op, c_out, 64)), kThreads, 0, stream,
         native_data(grad), map.n_rows, c_out, bias_partials);

  const int64_t n_pairs = map.n_pairs + map.n_rows, tiles = round_up(c_out, 128) * round_up(c_in, 128) / (128 * 128);
  const int64_t block_pairs =
      std::clamp(round_up(n_pairs * tiles / kWeightBlocks, kPairStep), kBlockPairsMin, kBlockPairsMax);
  const int64_t n_blocks = n_pairs / block_pairs + taps;
  const OuterProducts<E> products{
      values_of(op, left.data, map, left.channels, VoxelValue::kSum, false, workspace, stream),
      values_of(op, right.data, map, right.channels, VoxelValue::kMean, map.first, workspace, stream),
      sources_of(map, false),
      sources_of(map, map.first),
      map.tap_in,
      map.tap_out,
      map.cu_taps,
      map.n_pairs,
      map.n_rows,
      block_pairs,
      static_cast<int32_t>(taps),
      static_cast<int32_t>(left.channels),
      static_cast<int32_t>(right.channels),
      workspace.take<Sum<E>>(n_blocks * left.channels * right.channels)};
  if constexpr (kIsHalf<E>)
    outer_products_tensor(op, products, n_blocks, stream);
  else
    outer_products_plain(op, products, n_blocks, stream);
  const unsigned columns = std::max(blocks_for(op, c_out * c_in, kThreads), blocks_for(op, c_out, kThreads));
  launch(op, add_partials<E>, dim3(columns, static_cast<unsigned>(taps + 1)), kThreads, 0, stream, products, c_out,
         c_in, bias_partials, bias_blocks, native_data(grad_weight), native_data(grad_bias));
}

#define GSIM3D_INSTANTIATE(T)                                                                                 \
  template void sparse_conv<T>(const T*, const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*,      \
                               const Workspace&, Stream);                                                     \
  template void sparse_conv_vjp_input<T>(const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*,      \
                                         const Workspace&, Stream);                                           \
  template void sparse_conv_vjp_weight<T>(const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*, T*, \
                                          const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(Float16)
GSIM3D_INSTANTIATE(BFloat16)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
