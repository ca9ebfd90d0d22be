// Backward pass in 16-bit numbers on the tensor cores: some blocks own queries, some own keys. Each finds the weights
// again from the saved maximum and sum, so no block adds to what another one wrote or waits for it.
#include <algorithm>

#include "gsim3d/patch_attn/patch_attn_backward.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kWarps = 8, kThreads = kWarps * kWarp;
constexpr const char* kOp = "patch_attention_backward";

template <int D>
struct Shape {
  static constexpr int kRowTiles = D == 16 ? 2 : 1;       // of 16 rows, a warp
  static constexpr int kGroup = kWarps * 16 * kRowTiles;  // rows of a block at a time
  static constexpr int kBlocks = D < 64 ? 2 : 1;          // of a multiprocessor at a time
  static constexpr int kTileRows = 16384 / D;             // rows of the other side in shared memory
  static constexpr int kTileBytes = kTileRows * D * 2;
  static constexpr size_t kSharedBytes = 2 * kTileBytes + kTileRows * 3 * sizeof(float);
};

// ---- queries --------------------------------------------------------------------------------------------------------

template <typename T, int D>
class QueryWarp {
  static constexpr int M = Shape<D>::kRowTiles;

 public:
  __device__ __forceinline__ QueryWarp(const Backward<T>& args, uint32_t keys, uint32_t values, const uint8_t* valid)
      : slope_(args.slope), keys_(keys), values_(values), valid_(valid) {}

  // Reads the queries, and keeps their numbers for the careful way. False where scores are so large that the fast way
  // loses accuracy.
  __device__ __forceinline__ bool load(const Backward<T>& args, int64_t first, int64_t end, int64_t head) {
    bool fast = true;
    clear(grad_q_);
#pragma unroll
    for (int m = 0; m < M; ++m) {
      const int64_t* rows = args.table.q_rows;
      const int64_t n_q = args.table.n_q;
      const RowPair<T> q = find_rows(args.q, rows, first + 16 * m, end, n_q, head);
      const RowPair<T> grad = find_rows(args.grad, rows, first + 16 * m, end, n_q, head);
      const RowPair<T> out = find_rows(args.out, rows, first + 16 * m, end, n_q, head);
      float delta[2] = {0, 0};
#pragma unroll
      for (int s = 0; s < D / 16; ++s) {
        uint32_t result[4];
        load_fragment(q, s, q_[m][s]);
        load_fragment(grad, s, grad_[m][s]);
        load_fragment(out, s, result);
        if (args.sign < 0) negate(q_[m][s]);
#pragma unroll
        for (int i = 0; i < 4; ++i) {
          const float2 a = unpack<T>(grad_[m][s][i]), b = unpack<T>(result[i]);
          delta[i % 2] = fmaf(a.x, b.x, fmaf(a.y, b.y, delta[i % 2]));
        }
      }
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const int64_t i = first + 16 * m + threadIdx.x % kWarp / 4 + 8 * h;
        const int64_t row = i < end ? rows[i] : -1;
        QueryNumbers x = QueryNumbers::none();
        delta[h] = sum_of_row(delta[h]);
        if (inside(row, n_q)) {
          const float2 pair = *reinterpret_cast<const float2*>(args.stats + 2 * (row * args.size.heads + head));
          const float log_sum = log2f(pair.y);
          if (pair.y != 0) x = {pair.x, log_sum, delta[h], -fmaf(pair.x, args.slope, log_sum)};
        }
        if (i < end) args.numbers[head * args.table.n_q_listed + i] = x;  // all four lanes, so that each may read it
        fast = fast && x.is_fast(args.slope);
        minus_delta_[m][h] = -x.delta;
        shift_[m][h] = x.shift;
      }
    }
    numbers_ = args.numbers + head * args.table.n_q_listed + first;
    n_ = static_cast<int>(min(end - first, int64_t{16 * M}));
    return __all_sync(kFullWarp, fast);
  }

  template <bool kFast>
  __device__ __forceinline__ void step(int step) {
    float s[M][2][4], slopes[M][2][4];
    clear(s);
    multiply_by_rows<T, D, M>(q_, keys_, step, s);
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int i = 0; i < 8; ++i) slopes[m][i / 4][i % 4] = minus_delta_[m][i % 4 / 2];
    multiply_by_rows<T, D, M>(grad_, values_, step, slopes);
    uint32_t a[M][4];
#pragma unroll
    for (int m = 0; m < M; ++m) {
      if constexpr (kFast) {
#pragma unroll
        for (int i = 0; i < 8; ++i)
          slopes[m][i / 4][i % 4] *= fast_weight(s[m][i / 4][i % 4], slope_, shift_[m][i % 4 / 2]);
      } else {
        const uint8_t* valid = valid_ + step * kStep + 2 * (threadIdx.x % 4);
#pragma unroll
        for (int h = 0; h < 2; ++h) {
          const int at = 16 * m + threadIdx.x % kWarp / 4 + 8 * h;
          const QueryNumbers query = at < n_ ? numbers_[at] : QueryNumbers::none();
#pragma unroll
          for (int i = 0; i < 4; ++i) {
            float& x = slopes[m][i / 2][2 * h + i % 2];
            const float p =
                careful_weight(s[m][i / 2][2 * h + i % 2], query.largest, slope_, -query.log_sum);
            x = valid[i / 2 * 8 + i % 2] ? x * p : 0.0f;
          }
        }
      }
      pack_tile<T, true>(slopes[m], a[m]);
    }
    multiply_by_columns<T, D, M>(a, keys_, step, grad_q_);
  }

  __device__ __forceinline__ void store(const Backward<T>& args, int64_t first, int64_t end, int64_t head) const {
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const int64_t i = first + 16 * m + threadIdx.x % kWarp / 4 + 8 * h;
        const int64_t row = i < end ? args.table.q_rows[i] : -1;
        if (!inside(row, args.table.n_q)) continue;
        T* to = args.gradients.q + row * args.gradients.row_stride + head * D + 2 * (threadIdx.x % 4);
#pragma unroll
        for (int c = 0; c < D / 8; ++c)
          *reinterpret_cast<uint32_t*>(to + 8 * c) =
              pack<T>(grad_q_[m][c][2 * h] * args.scale, grad_q_[m][c][2 * h + 1] * args.scale);
      }
  }

 private:
  float slope_;
  uint32_t keys_, values_;
  const uint8_t* valid_;
  uint32_t q_[M][D / 16][4], grad_[M][D / 16][4];
  float grad_q_[M][D / 8][4], minus_delta_[M][2], shift_[M][2];
  const QueryNumbers* numbers_;  // of the warp's queries, n_ of them
  int n_;
};

template <typename T, int D>
__device__ __forceinline__ void own_queries(const Backward<T>& args, int64_t block, int64_t n_blocks) {
  using S = Shape<D>;
  extern __shared__ uint4 shared[];
  uint8_t* valid = reinterpret_cast<uint8_t*>(shared) + 2 * S::kTileBytes;
  const uint32_t keys = shared_address(shared), values = keys + S::kTileBytes;
  const PatchTable& table = args.table;
  for (int64_t i = block; i < args.division.n_shares; i += n_blocks) {
    const Share share = args.division.at(i);
    const Range q_range = range_of(table.cu_q, share.patch, table.n_q_listed);
    const Range k_range = range_of(table.cu_k, share.patch, table.n_k_listed);
    const int64_t n_keys = k_range.end - k_range.begin, n_tiles = (n_keys + S::kTileRows - 1) / S::kTileRows;
    if (n_tiles == 0 || q_range.begin + share.split * S::kGroup >= q_range.end) continue;
    const auto load_tile = [&](int64_t tile) {
      const int64_t* rows = table.kv_rows + k_range.begin + tile * S::kTileRows;
      const int n = static_cast<int>(min(n_keys - tile * S::kTileRows, int64_t{S::kTileRows}));
      __syncthreads();
      return copy_tiles<D, kThreads, S::kTileRows>({args.k, args.v}, rows, n, table.n_k, share.head, {keys, values},
                                                   valid);
    };
    // The one tile of a patch is on its way while the first queries are read, and then stays.
    bool arriving = n_tiles == 1, all_valid = arriving && load_tile(0), plain = false;
    for (int64_t group = q_range.begin + share.split * S::kGroup; group < q_range.end;
         group += args.division.splits * S::kGroup) {
      const int64_t first = group + threadIdx.x / kWarp * 16 * S::kRowTiles;
      const bool active = first < q_range.end;
      QueryWarp<T, D> warp(args, keys, values, valid);
      const bool fast = active && warp.load(args, first, q_range.end, share.head);
      for (int64_t tile = 0; tile < n_tiles; ++tile) {
        const int n = static_cast<int>(min(n_keys - tile * S::kTileRows, int64_t{S::kTileRows}));
        if (n_tiles > 1) {
          all_valid = load_tile(tile);
          arriving = true;
        }
        if (arriving) {
          wait_for_copies();
          plain = __syncthreads_and(all_valid) != 0;
          arriving = false;
        }
        if (!active) continue;
        int step = 0;
        if (fast && plain) {
#pragma unroll 2
          for (; step < n / kStep; ++step) warp.template step<true>(step);
        }
        for (; step * kStep < n; ++step) warp.template step<false>(step);
      }
      if (active) warp.store(args, first, q_range.end, share.head);
    }
  }
}

// ---- keys -----------------------------------------------------------------------------------------------------------

template <typename T, int D>
__device__ __forceinline__ void own_keys(const Backward<T>& args, int64_t block, int64_t n_blocks) {
  using S = Shape<D>;
  extern __shared__ uint4 shared[];
  float* minus_delta = reinterpret_cast<float*>(shared + 2 * S::kTileBytes / sizeof(uint4));
  float* shift = minus_delta + 2 * S::kTileRows;
  const TileNumbers numbers{shift, reinterpret_cast<const float4*>(minus_delta)};
  const uint32_t queries = shared_address(shared), grads = queries + S::kTileBytes;
  const PatchTable& table = args.table;
  for (int64_t i = block; i < args.division.n_shares; i += n_blocks) {
    const Share share = args.division.at(i);
    const Range q_range = range_of(table.cu_q, share.patch, table.n_q_listed);
    const Range k_range = range_of(table.cu_k, share.patch, table.n_k_listed);
    const int64_t n_queries = q_range.end - q_range.begin, n_tiles = (n_queries + S::kTileRows - 1) / S::kTileRows;
    bool loaded = false, plain = false;
    for (int64_t group = k_range.begin + share.split * S::kGroup; group < k_range.end;
         group += args.division.splits * S::kGroup) {
      const int64_t first = group + threadIdx.x / kWarp * 16 * S::kRowTiles;
      const bool active = first < k_range.end;
      KeyWarp<T, D, S::kRowTiles> warp(args, queries, grads, numbers);
      if (active) warp.load(args, first, k_range.end, share.head);
      for (int64_t tile = 0; tile < n_tiles; ++tile) {
        const int64_t begin = q_range.begin + tile * S::kTileRows;
        const int n = static_cast<int>(min(q_range.end - begin, int64_t{S::kTileRows}));
        QueryNumbers* listed = args.numbers + share.head * table.n_q_listed + begin;
        if (n_tiles > 1 || !loaded) {
          __syncthreads();
          copy_tiles<D, kThreads, S::kTileRows>({args.q, args.grad}, table.q_rows + begin, n, table.n_q, share.head,
                                  {queries, grads}, nullptr);
          bool fast = true;
          for (int r = threadIdx.x; r < (n + kStep - 1) / kStep * kStep; r += kThreads) {
            const QueryNumbers x =
                r < n ? numbers_of<T, D>(args, table.q_rows[begin + r], share.head) : QueryNumbers::none();
            if (r < n) listed[r] = x;
            shift[r] = x.shift;
            minus_delta[r / 2 * 4 + r % 2] = minus_delta[r / 2 * 4 + r % 2 + 2] = -x.delta;
            fast = fast && x.is_fast(args.slope);
          }
          wait_for_copies();
          plain = __syncthreads_and(fast) != 0;
          loaded = true;
        }
        if (!active) continue;
        uint32_t ds[S::kRowTiles][4];
        if (plain) {
#pragma unroll 2
          for (int step = 0; step * kStep < n; ++step) warp.template step<true>(step, nullptr, n, ds);
        } else {
          for (int step = 0; step * kStep < n; ++step) warp.template step<false>(step, listed, n, ds);
        }
      }
      if (active) warp.store(args, first, k_range.end, share.head);
    }
  }
}

// ---- both -----------------------------------------------------------------------------------------------------------

// The first blocks own queries, the others keys.
template <typename T, int D>
__global__ void __launch_bounds__(kThreads, Shape<D>::kBlocks)
    backward_kernel(Backward<T> of_queries, Backward<T> of_keys, int64_t query_blocks) {
  if (blockIdx.x < query_blocks) own_queries<T, D>(of_queries, blockIdx.x, query_blocks);
  else own_keys<T, D>(of_keys, blockIdx.x - query_blocks, gridDim.x - query_blocks);
}

template <typename T, int D>
void run(Backward<T> of_queries, const Workspace& workspace, Stream stream) {
  using S = Shape<D>;
  const PatchTable& table = of_queries.table;
  const int64_t heads = of_queries.size.heads, resident = S::kBlocks * multiprocessors(kOp, stream);
  Backward<T> of_keys = of_queries;
  of_keys.numbers = workspace.take<QueryNumbers>(heads * table.n_q_listed);
  of_queries.division = divide(table.n_patches, table.n_q_listed, S::kGroup, heads, resident);
  of_keys.division = divide(table.n_patches, table.n_k_listed, S::kGroup, heads, resident);
  constexpr int64_t kMostBlocks = 1 << 30;
  const int64_t query_blocks = std::min(of_queries.division.n_shares, kMostBlocks);
  const int64_t key_blocks = std::min(of_keys.division.n_shares, kMostBlocks);
  launch(kOp, backward_kernel<T, D>, static_cast<unsigned>(query_blocks + key_blocks), kThreads, S::kSharedBytes,
         stream, of_queries, of_keys, query_blocks);
}

// One kernel is 1.8 times as fast as two, if it fills the multiprocessors.
template <typename T>
bool pays_to_fuse(const Backward<T>& args, Stream stream) {
  const int64_t blocks = args.table.n_patches * args.size.heads, count = multiprocessors(kOp, stream);
  const int64_t rounds = (blocks + count - 1) / count;
  return 5 * rounds * count <= 9 * blocks && fits_fused_backward(stream);
}

}  // namespace

template <typename T>
void tensor_backward(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                     const T* out, const float* stats, const PatchTable& table, const AttentionSize& size,
                     const Gradients<T>& gradients, const Workspace& workspace, Stream stream) {
  const patch_attn::Softmax<float> softmax(size.scale);
  const HeadRows<T> out_rows{out, size.heads * size.dim, size.dim};
  const Backward<T> args{grad, q, k, v, out_rows, stats, table, size, {}, softmax.slope, softmax.sign,
                         static_cast<float>(size.scale),
                         workspace.take<QueryNumbers>(size.heads * table.n_q_listed), gradients};
  if (size.dim == 16 && pays_to_fuse(args, stream)) fused_backward(args, workspace, stream);
  else if (size.dim == 16) run<T, 16>(args, workspace, stream);
  else if (size.dim == 32) run<T, 32>(args, workspace, stream);
  else run<T, 64>(args, workspace, stream);
}

#define GSIM3D_INSTANTIATE(T)                                                                                        \
  template void tensor_backward<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&,   \
                                   const T*, const float*, const PatchTable&, const AttentionSize&, \
                                   const Gradients<T>&, const Workspace&, Stream);
GSIM3D_INSTANTIATE(__nv_bfloat16)
GSIM3D_INSTANTIATE(__half)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
