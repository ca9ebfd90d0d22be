#include <algorithm>
#include <cstring>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/core/simd.h"
#include "gsim3d/sparse_conv/sparse_conv.h"

namespace gsim3d::cpu {
namespace {

template <typename T>
struct Products {
  void (*pack_by_output)(const T* weight, int64_t taps, int64_t tap, int64_t c_in, int64_t c_out, T* panels);
  void (*pack_by_input)(const T* weight, int64_t taps, int64_t tap, int64_t c_in, int64_t c_out, T* panels);
  void (*multiply_rows)(int64_t rows, int64_t depth, int64_t columns, const T* const* a, const T* panels, T* const* c);
  void (*add_outer_products)(int64_t count, const T* const* left, int64_t r0, int64_t rows, const T* const* right,
                             int64_t j0, int64_t columns, T* left_panels, T* right_panels, T* sum, int64_t sum_row);
};

namespace baseline {
using namespace simd::baseline;
#include "gsim3d/sparse_conv/sparse_conv_tile.inc"
}  // namespace baseline

#ifdef GSIM3D_SIMD_X86
GSIM3D_SIMD_AVX512_BEGIN
namespace avx512 {
using namespace simd::avx512;
#include "gsim3d/sparse_conv/sparse_conv_tile.inc"
}  // namespace avx512
GSIM3D_SIMD_AVX512_END
#else
namespace avx512 = baseline;
#endif

template <typename T>
const Products<T>& products() {
  return simd::use_avx512() ? avx512::kProducts<T> : baseline::kProducts<T>;
}

constexpr int64_t kBlockPairs = 4096;  // pairs of one block of a weight gradient: part of the result's definition
constexpr int64_t kPanelPairs = 256;   // pairs gathered at a time: their panels fit the L2 cache
constexpr int64_t kBiasRows = 1024;    // rows of one block of a bias gradient: part of the result's definition
constexpr int64_t kTileOutputs = 96, kTileInputs = 128;  // largest tile of a weight gradient
constexpr int64_t kPairsPerTap = 32;  // pairs of a tap in a block of voxels that pay for reading the tap's weights
constexpr int64_t kMaxKernel = 1024;  // K^3 taps are counted in 64 bits; larger kernels are mistakes
constexpr int64_t kElementsPerChunk = 32768;
constexpr int64_t kPairsPerCheck = 16384;  // pairs that pay for handing a check to a thread

// Padding that suits the panels of every instruction set.
template <typename T>
constexpr int64_t kColumnPad = 128 / sizeof(T);
constexpr int64_t kRowPad = 24;

int64_t round_up(int64_t n, int64_t step) { return (n + step - 1) / step * step; }
int64_t taps_of(const SparseConvMap& map) { return map.kernel_size * map.kernel_size * map.kernel_size; }

// The map without empty voxels and pairs of no tap, which its lists may end with.
SparseConvMap filled_part(SparseConvMap map) {
  const int64_t* cu = map.cu_voxel_rows;
  if (map.n_voxels > map.n_rows) map.n_voxels = std::find(cu, cu + map.n_voxels, map.n_rows) - cu;
  map.n_pairs = map.cu_taps[taps_of(map)];
  return map;
}

enum class VoxelValue { kMean, kSum, kFirst };
enum class Share { kWhole, kEqualParts, kFirstRow };  // what the rows of a voxel get of the voxel's sum

// One feature row a voxel: a row of x where it can be, else computed in scratch.
template <typename T>
const T** voxel_values(const T* x, const SparseConvMap& map, int64_t channels, VoxelValue kind,
                       const Workspace& workspace, const Parallel& parallel) {
  const T** values = workspace.take<const T*>(map.n_voxels);
  const int64_t* cu = map.cu_voxel_rows;
  int64_t n_shared = 0;
  for (int64_t v = 0; v < map.n_voxels; ++v) {
    values[v] = x + map.voxel_rows[cu[v]] * channels;
    n_shared += cu[v + 1] - cu[v] > 1;
  }
  if (kind == VoxelValue::kFirst || n_shared == 0) return values;
  T* scratch = workspace.take<T>(n_shared * channels);
  int64_t* shared = workspace.take<int64_t>(n_shared);
  for (int64_t v = 0, i = 0; v < map.n_voxels; ++v)
    if (cu[v + 1] - cu[v] > 1) shared[i++] = v;
  parallel.range(n_shared, std::max<int64_t>(1, kElementsPerChunk / (2 * channels + 1)),
                 [&](int64_t begin, int64_t end) {
                   for (int64_t i = begin; i < end; ++i) {
                     const int64_t v = shared[i];
                     T* sum = scratch + i * channels;
                     std::fill_n(sum, channels, T(0));
                     for (int64_t r = cu[v]; r < cu[v + 1]; ++r) {
                       const T* row = x + map.voxel_rows[r] * channels;
                       for (int64_t c = 0; c < channels; ++c) sum[c] += row[c];
                     }
                     if (kind == VoxelValue::kMean)
                       for (int64_t c = 0; c < channels; ++c) sum[c] /= static_cast<T>(cu[v + 1] - cu[v]);
                     values[v] = sum;
                   }
                 });
  return values;
}

// Pairs read -> write of voxels, by tap and inside a tap by blocks of `block` written voxels.
struct Pairs {
  const int64_t* read;
  const int64_t* write;
  const int64_t* starts;  // [taps * n_blocks + 1]
  int64_t block, n_blocks;
};

int64_t voxels_per_block(const SparseConvMap& map) {
  const int64_t filled = kPairsPerTap * taps_of(map) * map.n_voxels / std::max<int64_t>(1, map.n_pairs);
  return std::clamp<int64_t>(std::min(filled, map.n_voxels / 16), 64, 1024);
}

Pairs pairs_by_output(const SparseConvMap& map, const Workspace& workspace) {
  const int64_t taps = taps_of(map), block = voxels_per_block(map), n_blocks = (map.n_voxels + block - 1) / block;
  int64_t* starts = workspace.take<int64_t>(taps * n_blocks + 1);
  for (int64_t t = 0; t < taps; ++t) {
    const int64_t *from = map.tap_out + map.cu_taps[t], *to = map.tap_out + map.cu_taps[t + 1];
    for (int64_t b = 0; b < n_blocks; ++b) {
      from = std::lower_bound(from, to, b * block);
      starts[t * n_blocks + b] = from - map.tap_out;
    }
  }
  starts[taps * n_blocks] = map.n_pairs;
  return {map.tap_in, map.tap_out, starts, block, n_blocks};
}

Pairs pairs_by_input(const SparseConvMap& map, const Workspace& workspace, const Parallel& parallel) {
  const int64_t taps = taps_of(map), block = voxels_per_block(map), n_blocks = (map.n_voxels + block - 1) / block;
  int64_t* starts = workspace.take<int64_t>(taps * n_blocks + 1);
  int64_t* read = workspace.take<int64_t>(map.n_pairs);
  int64_t* write = workspace.take<int64_t>(map.n_pairs);
  parallel.chunks(taps, [&](int64_t t) {
    const int64_t begin = map.cu_taps[t], end = map.cu_taps[t + 1];
    std::vector<int64_t> next(static_cast<size_t>(n_blocks) + 1, 0);
    for (int64_t i = begin; i < end; ++i) ++next[map.tap_in[i] / block + 1];
    next[0] = begin;
    for (int64_t b = 0; b < n_blocks; ++b) {
      next[b + 1] += next[b];
      starts[t * n_blocks + b] = next[b];
    }
    for (int64_t i = begin; i < end; ++i) {
      const int64_t slot = next[map.tap_in[i] / block]++;
      write[slot] = map.tap_in[i];
      read[slot] = map.tap_out[i];
    }
  });
  starts[taps * n_blocks] = map.n_pairs;
  return {read, write, starts, block, n_blocks};
}

// y[p] = start + x[p] B_centre + share of (sum over pairs that write voxel v(p): values[read] B_tap).
template <typename T>
struct Convolution {
  const T* x;
  const T* const* values;  // [n_voxels]
  const T* panels;         // [taps] matrices of c_read x c_write, padded to panels
  const T* start;          // [c_write] or null
  int64_t c_read, c_write;
  Share share;
  T* y;
};

template <typename T>
void convolve_block(const Convolution<T>& conv, const SparseConvMap& map, const Pairs& pairs, int64_t block) {
  const int64_t v0 = block * pairs.block, v1 = std::min(map.n_voxels, v0 + pairs.block);
  const int64_t* cu = map.cu_voxel_rows;
  const int64_t taps = taps_of(map), matrix = conv.c_read * round_up(conv.c_write, kColumnPad<T>),
                c_write = conv.c_write;
  const auto& multiply_rows = products<T>().multiply_rows;

  const int64_t n_rows = cu[v1] - cu[v0];
  std::vector<const T*> from(static_cast<size_t>(n_rows));
  std::vector<T*> to(static_cast<size_t>(n_rows));
  for (int64_t i = 0; i < n_rows; ++i) {
    const int64_t row = map.voxel_rows[cu[v0] + i];
    from[i] = conv.x + row * conv.c_read;
    to[i] = conv.y + row * c_write;
    if (conv.start) std::copy_n(conv.start, c_write, to[i]);
    else std::fill_n(to[i], c_write, T(0));
  }
  multiply_rows(n_rows, conv.c_read, c_write, from.data(), conv.panels + taps / 2 * matrix, to.data());

  // A voxel of one row adds to that row; the sums of the others are kept apart, then shared out.
  std::vector<T*> sums(static_cast<size_t>(v1 - v0));
  int64_t n_shared = 0;
  for (int64_t v = v0; v < v1; ++v) n_shared += cu[v + 1] - cu[v] > 1;
  std::vector<T> shared(static_cast<size_t>(n_shared * c_write), T(0));
  T* next = shared.data();
  for (int64_t v = v0; v < v1; ++v) {
    const bool alone = cu[v + 1] - cu[v] == 1;
    sums[v - v0] = alone ? conv.y + map.voxel_rows[cu[v]] * c_write : next;
    if (!alone) next += c_write;
  }
  for (int64_t t = 0; t < taps; ++t) {
    const int64_t begin = pairs.starts[t * pairs.n_blocks + block], end = pairs.starts[t * pairs.n_blocks + block + 1];
    for (int64_t i = begin; i < end; ++i) {
      from[i - begin] = conv.values[pairs.read[i]];
      to[i - begin] = sums[pairs.write[i] - v0];
    }
    multiply_rows(end - begin, conv.c_read, c_write, from.data(), conv.panels + t * matrix, to.data());
  }
  if (n_shared == 0) return;
  for (int64_t v = v0; v < v1; ++v) {
    const int64_t count = cu[v + 1] - cu[v];
    if (count == 1) continue;
    const T* sum = sums[v - v0];
    const T parts = conv.share == Share::kEqualParts ? static_cast<T>(count) : T(1);
    for (int64_t r = cu[v]; r < (conv.share == Share::kFirstRow ? cu[v] + 1 : cu[v + 1]); ++r) {
      T* row = conv.y + map.voxel_rows[r] * c_write;
      for (int64_t c = 0; c < c_write; ++c) row[c] += sum[c] / parts;
    }
  }
}

// The matrices of all taps that are used, in panels.
template <typename T, typename Pack>
const T* pack_weights(const T* weight, const SparseConvMap& map, int64_t c_in, int64_t c_out, int64_t matrix, Pack pack,
                      const Workspace& workspace, const Parallel& parallel) {
  const int64_t taps = taps_of(map);
  T* panels = workspace.take<T>(taps * matrix);
  parallel.chunks(taps, [&](int64_t t) {
    if (t == taps / 2 || map.cu_taps[t] < map.cu_taps[t + 1]) pack(weight, taps, t, c_in, c_out, panels + t * matrix);
  });
  return panels;
}

// Adds blocks[1..] to blocks[0] in a fixed tree: neighbours first.
template <typename T>
void add_in_tree(T* blocks, int64_t n_blocks, int64_t size, int64_t begin, int64_t end) {
  for (int64_t step = 1; step < n_blocks; step *= 2)
    for (int64_t b = 0; b + step < n_blocks; b += 2 * step) {
      T* to = blocks + b * size;
      const T* from = blocks + (b + step) * size;
      for (int64_t i = begin; i < end; ++i) to[i] += from[i];
    }
}

template <typename T>
void bias_vjp(const T* grad, int64_t n_rows, int64_t c_out, T* grad_bias, const Workspace& workspace,
              const Parallel& parallel) {
  const int64_t n_blocks = std::max<int64_t>(1, (n_rows + kBiasRows - 1) / kBiasRows);
  T* blocks = workspace.take<T>(n_blocks * c_out);
  parallel.chunks(n_blocks, [&](int64_t b) {
    T* sum = blocks + b * c_out;
    std::fill_n(sum, c_out, T(0));
    for (int64_t row = b * kBiasRows; row < std::min(n_rows, (b + 1) * kBiasRows); ++row)
      for (int64_t c = 0; c < c_out; ++c) sum[c] += grad[row * c_out + c];
  });
  add_in_tree(blocks, n_blocks, c_out, 0, c_out);
  std::copy_n(blocks, c_out, grad_bias);
}

// What check_sparse_conv_map asks of the pairs of a tap, without messages and many times faster.
bool pairs_are_well_formed(const SparseConvMap& map, int64_t begin, int64_t end) {
  const uint64_t n_voxels = static_cast<uint64_t>(map.n_voxels);
  bool good = true;
  for (int64_t i = begin; i < end; ++i)
    good &= static_cast<uint64_t>(map.tap_in[i]) < n_voxels && static_cast<uint64_t>(map.tap_out[i]) < n_voxels;
  for (int64_t i = begin + 1; i < end; ++i) {
    good &= map.tap_in[i - 1] < map.tap_in[i];
    good &= map.tap_out[i - 1] < map.tap_out[i];
  }
  return good;
}

// One block of pairs of one tap.
struct WeightBlock {
  int64_t tap, begin, end;
  int64_t partial;  // its slot among the partial sums; -1 where it is the tap's only block
};

}  // namespace

void check_sparse_conv_kernel(const char* op, int64_t kernel_size) {
  check(kernel_size % 2 == 1 && kernel_size > 0 && kernel_size < kMaxKernel, op, ": kernel_size must be odd and below ",
        kMaxKernel, "; got ", kernel_size);
}

void check_sparse_conv_map(const char* op, const SparseConvMap& map, const Parallel& parallel) {
  const int64_t *cu = map.cu_voxel_rows, *cu_taps = map.cu_taps, taps = taps_of(map), centre = taps / 2;
  check(cu[0] == 0 && cu[map.n_voxels] == map.n_rows, op, ": cu_voxel_rows must run from 0 to N=", map.n_rows, "; got ",
        cu[0], " .. ", cu[map.n_voxels]);
  const int64_t n_filled = filled_part(map).n_voxels;
  for (int64_t v = n_filled; v < map.n_voxels; ++v)
    check(cu[v + 1] == map.n_rows, op, ": cu_voxel_rows must stay at N=", map.n_rows, " behind the last row; got ",
          cu[v + 1], " at ", v + 1);
  for (int64_t v = 0; v < n_filled; ++v) {
    check(cu[v] < cu[v + 1] && cu[v + 1] <= map.n_rows, op, ": cu_voxel_rows must ascend, no voxel is empty; got ",
          cu[v], " then ", cu[v + 1], " at ", v);
    for (int64_t i = cu[v]; i < cu[v + 1]; ++i) {
      const int64_t row = map.voxel_rows[i];
      check(row >= 0 && row < map.n_rows, op, ": voxel_rows must be in [0, N) with N=", map.n_rows, "; got ", row,
            " at ", i);
      check(map.row_voxel[row] == v, op, ": row_voxel must agree with voxel_rows: row ", row, " is listed in voxel ", v,
            "; got ", map.row_voxel[row]);
      check(i == cu[v] || map.voxel_rows[i - 1] < row, op, ": voxel_rows must ascend inside a voxel; got ",
            map.voxel_rows[i - 1], " then ", row);
    }
  }
  check(cu_taps[0] == 0 && cu_taps[taps] <= map.n_pairs, op, ": cu_taps must run from 0 to at most len(tap_in)=",
        map.n_pairs, "; got ", cu_taps[0], " .. ", cu_taps[taps]);
  for (int64_t t = 0; t < taps; ++t)
    check(cu_taps[t] <= cu_taps[t + 1], op, ": cu_taps must not descend; got ", cu_taps[t], " then ", cu_taps[t + 1],
          " at ", t);
  check(cu_taps[centre] == cu_taps[centre + 1], op, ": the centre tap ", centre, " must have no pairs; got ",
        cu_taps[centre + 1] - cu_taps[centre]);
  const auto check_tap = [&](int64_t t) {
    if (pairs_are_well_formed(map, cu_taps[t], cu_taps[t + 1])) return;
    for (int64_t i = cu_taps[t]; i < cu_taps[t + 1]; ++i) {
      const int64_t in = map.tap_in[i], out = map.tap_out[i];
      check(in >= 0 && in < map.n_voxels, op, ": tap_in must be in [0, V) with V=", map.n_voxels, "; got ", in, " at ",
            i);
      check(out >= 0 && out < map.n_voxels, op, ": tap_out must be in [0, V) with V=", map.n_voxels, "; got ", out,
            " at ", i);
      check(i == cu_taps[t] || map.tap_out[i - 1] < out, op, ": tap_out must ascend inside a tap; got ",
            map.tap_out[i - 1], " then ", out, " at ", i);
      check(i == cu_taps[t] || map.tap_in[i - 1] < in, op, ": tap_in must ascend inside a tap; got ", map.tap_in[i - 1],
            " then ", in, " at ", i);
    }
  };
  // A few taps at a time: small maps are not worth a thread.
  parallel.range(taps, std::max<int64_t>(1, kPairsPerCheck * taps / std::max<int64_t>(1, map.n_pairs)),
                 [&](int64_t begin, int64_t end) {
                   for (int64_t t = begin; t < end; ++t) check_tap(t);
                 });
}

template <typename T>
void sparse_conv(const T* x, const T* weight, const T* bias, const SparseConvMap& whole, int64_t c_in, int64_t c_out,
                 T* out, const Workspace& workspace, const Parallel& parallel) {
  const SparseConvMap map = filled_part(whole);
  const int64_t matrix = c_in * round_up(c_out, kColumnPad<T>);
  const T* panels = pack_weights(weight, map, c_in, c_out, matrix, products<T>().pack_by_output, workspace, parallel);
  const auto kind = map.first ? VoxelValue::kFirst : VoxelValue::kMean;
  const T** values = voxel_values(x, map, c_in, kind, workspace, parallel);
  const Pairs pairs = pairs_by_output(map, workspace);
  const Convolution<T> conv{x, values, panels, bias, c_in, c_out, Share::kWhole, out};
  parallel.chunks(pairs.n_blocks, [&](int64_t block) { convolve_block(conv, map, pairs, block); });
}

template <typename T>
void sparse_conv_vjp_input(const T* grad, const T* weight, const SparseConvMap& whole, int64_t c_in, int64_t c_out,
                           T* grad_x, const Workspace& workspace, const Parallel& parallel) {
  const SparseConvMap map = filled_part(whole);
  const int64_t matrix = c_out * round_up(c_in, kColumnPad<T>);
  const T* panels = pack_weights(weight, map, c_in, c_out, matrix, products<T>().pack_by_input, workspace, parallel);
  const T** values = voxel_values(grad, map, c_out, VoxelValue::kSum, workspace, parallel);
  const Pairs pairs = pairs_by_input(map, workspace, parallel);
  const Share share = map.first ? Share::kFirstRow : Share::kEqualParts;
  const Convolution<T> conv{grad, values, panels, nullptr, c_out, c_in, share, grad_x};
  parallel.chunks(pairs.n_blocks, [&](int64_t block) { convolve_block(conv, map, pairs, block); });
}

template <typename T>
void sparse_conv_vjp_weight(const T* grad, const T* x, const SparseConvMap& whole, int64_t c_in, int64_t c_out,
                            T* grad_weight, T* grad_bias, const Workspace& workspace, const Parallel& parallel) {
  const SparseConvMap map = filled_part(whole);
  bias_vjp(grad, map.n_rows, c_out, grad_bias, workspace, parallel);
  const T** inputs =
      voxel_values(x, map, c_in, map.first ? VoxelValue::kFirst : VoxelValue::kMean, workspace, parallel);
  const T** grads = voxel_values(grad, map, c_out, VoxelValue::kSum, workspace, parallel);

  const int64_t taps = taps_of(map), size = c_out * c_in;
  std::vector<WeightBlock> blocks;
  std::vector<int64_t> first_block(static_cast<size_t>(taps) + 1);
  int64_t n_partial = 0;
  for (int64_t t = 0; t < taps; ++t) {
    first_block[t] = static_cast<int64_t>(blocks.size());
    const int64_t begin = t == taps / 2 ? 0 : map.cu_taps[t], end = t == taps / 2 ? map.n_rows : map.cu_taps[t + 1];
    const bool split = end - begin > kBlockPairs;
    for (int64_t i = begin; i == begin || i < end; i += kBlockPairs)
      blocks.push_back({t, i, std::min(end, i + kBlockPairs), split ? n_partial++ : -1});
  }
  first_block[taps] = static_cast<int64_t>(blocks.size());
  T* partials = workspace.take<T>(n_partial * size);

  const int64_t n_out = (c_out + kTileOutputs - 1) / kTileOutputs, n_in = (c_in + kTileInputs - 1) / kTileInputs;
  const int64_t tile_out = round_up((c_out + n_out - 1) / std::max<int64_t>(1, n_out), kRowPad);
  const int64_t tile_in = round_up((c_in + n_in - 1) / std::max<int64_t>(1, n_in), kColumnPad<T>);
  parallel.chunks(first_block[taps] * n_out * n_in, [&](int64_t unit) {
    const WeightBlock& block = blocks[unit / (n_out * n_in)];
    const int64_t co0 = unit / n_in % n_out * tile_out, ci0 = unit % n_in * tile_in;
    const int64_t rows = std::min(tile_out, c_out - co0), columns = std::min(tile_in, c_in - ci0);
    if (rows <= 0 || columns <= 0) return;
    std::vector<T> left(static_cast<size_t>(kPanelPairs * tile_out)), right(static_cast<size_t>(kPanelPairs * tile_in));
    std::vector<T> sum(static_cast<size_t>(tile_out * tile_in), T(0));
    const T *g[kPanelPairs], *f[kPanelPairs];
    for (int64_t begin = block.begin; begin < block.end; begin += kPanelPairs) {
      const int64_t count = std::min(kPanelPairs, block.end - begin);
      for (int64_t i = 0; i < count; ++i) {
        const bool own_row = block.tap == taps / 2;
        g[i] = own_row ? grad + (begin + i) * c_out : grads[map.tap_out[begin + i]];
        f[i] = own_row ? x + (begin + i) * c_in : inputs[map.tap_in[begin + i]];
      }
      products<T>().add_outer_products(count, g, co0, rows, f, ci0, columns, left.data(), right.data(), sum.data(),
                                       tile_in);
    }
    const bool whole = block.partial < 0;
    T* to = whole ? grad_weight + (co0 * taps + block.tap) * c_in + ci0
                  : partials + block.partial * size + co0 * c_in + ci0;
    for (int64_t r = 0; r < rows; ++r)
      std::copy_n(sum.data() + r * tile_in, columns, to + r * (whole ? taps : 1) * c_in);
  });

  // The blocks of long taps; outputs are shared among threads.
  parallel.range(c_out, std::max<int64_t>(1, kElementsPerChunk / (c_in + 1)), [&](int64_t begin, int64_t end) {
    for (int64_t t = 0; t < taps; ++t) {
      const int64_t slot = blocks[first_block[t]].partial;
      if (slot < 0) continue;
      T* sums = partials + slot * size;
      add_in_tree(sums, first_block[t + 1] - first_block[t], size, begin * c_in, end * c_in);
      for (int64_t co = begin; co < end; ++co)
        std::copy_n(sums + co * c_in, c_in, grad_weight + (co * taps + t) * c_in);
    }
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                 \
  template void sparse_conv<T>(const T*, const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*,      \
                               const Workspace&, const Parallel&);                                            \
  template void sparse_conv_vjp_input<T>(const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*,      \
                                         const Workspace&, const Parallel&);                                  \
  template void sparse_conv_vjp_weight<T>(const T*, const T*, const SparseConvMap&, int64_t, int64_t, T*, T*, \
                                          const Workspace&, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
