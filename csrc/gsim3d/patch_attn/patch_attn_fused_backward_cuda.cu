// Backward pass in 16-bit numbers for head dim 16, in one kernel that finds every weight once: a block owns one head of
// a patch, a warp owns 32 of 512 keys, and the gradients of 1024 queries stay in shared memory.
//
// Warps add to the gradients of queries in turns: in a phase, each has a group of queries of its own, and a barrier
// stands between phases. So the order of additions is fixed. Longer patches add up their queries' gradients in memory
// that the block owns.
#include "gsim3d/patch_attn/patch_attn_backward.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int D = 16;
constexpr int kWarps = 16, kThreads = kWarps * kWarp;
constexpr int kRowTiles = 2, kKeys = kWarps * 16 * kRowTiles;
constexpr int kQueries = 1024, kTileBytes = kQueries * D * 2;
constexpr size_t kSharedBytes = 2 * kTileBytes + kQueries * (D + 3) * sizeof(float);
constexpr const char* kOp = "patch_attention_backward";

// Products with the keys of a warp, for the gradients of queries: grad_q^T [16, queries] += k^T ds.
template <typename T>
class QuerySums {
 public:
  __device__ __forceinline__ explicit QuerySums(float4* sums) : sums_(sums) {}

  __device__ __forceinline__ void load(const Backward<T>& args, int64_t first, int64_t end, int64_t head) {
    missing_ = 0;
#pragma unroll
    for (int m = 0; m < kRowTiles; ++m) {
      const RowPair<T> rows = find_rows(args.k, args.table.kv_rows, first + 16 * m, end, args.table.n_k, head);
      if (rows.low == nullptr) missing_ |= 1 << 2 * m;
      if (rows.high == nullptr) missing_ |= 2 << 2 * m;
      uint32_t k[4];
      load_fragment(rows, 0, k);
      k_[m][0] = transpose_matrix(k[0]);
      k_[m][1] = transpose_matrix(k[2]);
      k_[m][2] = transpose_matrix(k[1]);
      k_[m][3] = transpose_matrix(k[3]);
    }
    all_there_ = __all_sync(kFullWarp, missing_ == 0);
  }

  __device__ __forceinline__ void add(int step, uint32_t (&ds)[kRowTiles][4]) {
    if (!all_there_) {  // weights of keys that do not take part may be infinite
#pragma unroll
      for (int m = 0; m < kRowTiles; ++m)
#pragma unroll
        for (int i = 0; i < 4; ++i)
          if (missing_ >> (2 * m + i % 2) & 1) ds[m][i] = 0;
    }
#pragma unroll
    for (int j = 0; j < 2; ++j) {
      float4& place = sums_[(2 * step + j) * kWarp + threadIdx.x % kWarp];
      const float4 before = place;
      float sum[4] = {before.x, before.y, before.z, before.w};
#pragma unroll
      for (int m = 0; m < kRowTiles; ++m)
        mma<T>(sum, k_[m], transpose_matrix(ds[m][2 * j]), transpose_matrix(ds[m][2 * j + 1]));
      place = {sum[0], sum[1], sum[2], sum[3]};
    }
  }

  // Element d of the sum of query `at` of the tile.
  __device__ __forceinline__ static int index(int at, int d) {
    const int lane = d % 8 * 4 + at % 8 / 2;
    return (at / 8 * kWarp + lane) * 4 + d / 8 * 2 + at % 2;
  }

 private:
  float4* sums_;
  uint32_t k_[kRowTiles][4];
  int missing_;  // bits: row g and row g + 8 of each tile
  bool all_there_;
};

template <typename T>
__global__ void __launch_bounds__(kThreads, 1) fused_kernel(Backward<T> args, float* partial) {
  extern __shared__ uint4 shared[];
  float* minus_delta = reinterpret_cast<float*>(shared + 2 * kTileBytes / sizeof(uint4));
  float* shift = minus_delta + 2 * kQueries;
  float* sums = shift + kQueries;
  const TileNumbers numbers{shift, reinterpret_cast<const float4*>(minus_delta)};
  const uint32_t queries = shared_address(shared), grads = queries + kTileBytes;
  const PatchTable& table = args.table;
  const int warp_id = threadIdx.x / kWarp;
  for (int64_t i = blockIdx.x; i < args.division.n_shares; i += gridDim.x) {
    const Share share = args.division.at(i);
    const Range q_range = range_of(table.cu_q, share.patch, table.n_q_listed);
    const Range k_range = range_of(table.cu_k, share.patch, table.n_k_listed);
    const int64_t n_tiles = (q_range.end - q_range.begin + kQueries - 1) / kQueries;
    bool plain = false;
    for (int64_t keys = k_range.begin; keys < k_range.end; keys += kKeys) {
      const bool first_keys = keys == k_range.begin, last_keys = keys + kKeys >= k_range.end;
      const int64_t first = keys + warp_id * 16 * kRowTiles;
      const bool active = first < k_range.end;
      KeyWarp<T, D, kRowTiles> warp(args, queries, grads, numbers);
      QuerySums<T> query_sums(reinterpret_cast<float4*>(sums));
      if (active) {
        query_sums.load(args, first, k_range.end, share.head);
        warp.load(args, first, k_range.end, share.head);
      }
      for (int64_t tile = 0; tile < n_tiles; ++tile) {
        const int64_t begin = q_range.begin + tile * kQueries;
        const int n = static_cast<int>(min(q_range.end - begin, int64_t{kQueries}));
        const int n_steps = (n + kStep - 1) / kStep;
        QueryNumbers* listed = args.numbers + share.head * table.n_q_listed + begin;
        if (n_tiles > 1 || first_keys) {
          __syncthreads();
          copy_tiles<D, kThreads, kQueries>({args.q, args.grad}, table.q_rows + begin, n, table.n_q, share.head,
                                  {queries, grads}, nullptr);
          bool fast = true;
          for (int r = threadIdx.x; r < n_steps * kStep; r += kThreads) {
            const QueryNumbers x =
                r < n ? numbers_of<T, D>(args, table.q_rows[begin + r], share.head) : QueryNumbers::none();
            if (r < n) listed[r] = x;
            shift[r] = x.shift;
            minus_delta[r / 2 * 4 + r % 2] = minus_delta[r / 2 * 4 + r % 2 + 2] = -x.delta;
            fast = fast && x.is_fast(args.slope);
          }
          for (int s = threadIdx.x; s < n_steps * kStep * D / 4; s += kThreads)
            reinterpret_cast<float4*>(sums)[s] = {0, 0, 0, 0};
          wait_for_copies();
          plain = __syncthreads_and(fast) != 0;
        }
        const int group = (n_steps + kWarps - 1) / kWarps;
        for (int phase = 0; phase < kWarps; ++phase) {
          const int from = (phase + warp_id) % kWarps * group, to = min(from + group, n_steps);
          if (active) {
            uint32_t ds[kRowTiles][4];
            if (plain) {
              for (int step = from; step < to; ++step) {
                warp.template step<true>(step, nullptr, n, ds);
                query_sums.add(step, ds);
              }
            } else {
              for (int step = from; step < to; ++step) {
                warp.template step<false>(step, listed, n, ds);
                query_sums.add(step, ds);
              }
            }
          }
          __syncthreads();
        }
        if (n_tiles == 1 && !last_keys) continue;
        for (int r = threadIdx.x; r < n; r += kThreads) {
          const int64_t row = table.q_rows[begin + r];
          if (!inside(row, table.n_q)) continue;
          float sum[D];
          float* so_far = partial + (share.head * table.n_q_listed + begin + r) * D;
#pragma unroll
          for (int d = 0; d < D; ++d) {
            sum[d] = sums[QuerySums<T>::index(r, d)];
            if (n_tiles > 1 && !first_keys) sum[d] += so_far[d];
            if (!last_keys) so_far[d] = sum[d];
          }
          if (!last_keys) continue;
          uint4* to = reinterpret_cast<uint4*>(args.gradients.q + row * args.gradients.row_stride + share.head * D);
#pragma unroll
          for (int c = 0; c < D / 8; ++c) {
            uint32_t pairs[4];
#pragma unroll
            for (int j = 0; j < 4; ++j)
              pairs[j] = pack<T>(sum[8 * c + 2 * j] * args.scale, sum[8 * c + 2 * j + 1] * args.scale);
            to[c] = {pairs[0], pairs[1], pairs[2], pairs[3]};
          }
        }
      }
      if (active) warp.store(args, first, k_range.end, share.head);
    }
  }
}

}  // namespace

bool fits_fused_backward(Stream stream) {
  int most = 0;
  check_cuda(cudaDeviceGetAttribute(&most, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), kOp);
  return static_cast<size_t>(most) >= kSharedBytes;
}

template <typename T>
void fused_backward(Backward<T> args, const Workspace& workspace, Stream stream) {
  args.division = {args.size.heads, 1, args.table.n_patches * args.size.heads};
  launch(kOp, fused_kernel<T>, blocks_of(args.division), kThreads, kSharedBytes, stream, args,
         workspace.take<float>(args.size.heads * args.table.n_q_listed * D));
}

template void fused_backward<__nv_bfloat16>(Backward<__nv_bfloat16>, const Workspace&, Stream);
template void fused_backward<__half>(Backward<__half>, const Workspace&, Stream);

}  // namespace gsim3d::cuda
