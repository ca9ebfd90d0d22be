// Forward pass in 16-bit numbers on the tensor cores.
//
// A block keeps the keys and values of a tile in shared memory, for head dim 16 those of a whole patch of 1024. A warp
// takes 16 or 32 queries and walks over the keys 16 at a time; scores and weights never leave its registers, and a
// column of ones in the product with the values gives the sum of weights. In place of a running maximum it starts with
// the largest score of the first 16 keys: weights may then exceed 1, which float32 and bfloat16 can hold. Where the sum
// shows that they went too far, the warp starts again with a running maximum.
#include "gsim3d/core/overlap.cuh"
#include "gsim3d/patch_attn/patch_attn_mma_tile.cuh"
#include "gsim3d/patch_attn/patch_attn_softmax.cuh"
#include "gsim3d/patch_attn/patch_attn_tensor.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kWarps = 8, kThreads = kWarps * kWarp;
constexpr int kBlocks = 2;  // of a multiprocessor at a time
constexpr const char* kOp = "patch_attention";

template <int D>
struct Shape {
  static constexpr int kRowTiles = D < 64 ? 2 : 1;           // of 16 queries, a warp
  static constexpr int kGroup = kWarps * 16 * kRowTiles;     // queries of a block at a time
  static constexpr int kTileRows = 16384 / D;                // keys in shared memory
  static constexpr int kTileBytes = kTileRows * D * 2;
  static constexpr int kParts = 4;  // work starts when one has arrived
  static constexpr size_t kSharedBytes = 2 * kTileBytes + kTileRows;
};

template <typename T>
struct Forward {
  HeadRows<T> q, k, v;
  PatchTable table;
  Division division;
  float slope, sign;
  T* out;        // [n_q, H, D]
  float* stats;  // [n_q, H, 2]
};

template <typename T, int D>
class Warp {
  static constexpr int M = Shape<D>::kRowTiles, kUnroll = D == 16 ? 4 : 2;
  static constexpr bool kMultiplies = D == 16;  // wider heads wait for the tensor cores, not for exponentials

 public:
  __device__ __forceinline__ Warp(const Forward<T>& args, uint32_t keys, uint32_t values, const uint8_t* valid)
      : slope_(args.slope), valid_(valid), keys_(keys), values_(values) {}

  // Asks for queries, for which start() waits.
  __device__ __forceinline__ void load_queries(const Forward<T>& args, int64_t first, int64_t end, int64_t head) {
#pragma unroll
    for (int m = 0; m < M; ++m) {
      const RowPair<T> rows = find_rows(args.q, args.table.q_rows, first + 16 * m, end, args.table.n_q, head);
#pragma unroll
      for (int s = 0; s < D / 16; ++s) load_fragment(rows, s, q_[m][s]);
    }
  }

  __device__ __forceinline__ void start(float sign) {
    if (sign < 0) {
#pragma unroll
      for (int m = 0; m < M; ++m)
#pragma unroll
        for (int s = 0; s < D / 16; ++s) negate(q_[m][s]);
    }
    reset();
  }

  __device__ __forceinline__ void reset() {
    clear(out_);
    clear(sum_);
#pragma unroll
    for (int m = 0; m < M; ++m) largest_[m][0] = largest_[m][1] = -FLT_MAX;
  }

  // Takes the largest score of the first 16 keys. False where scores are so large that the fast way loses accuracy.
  __device__ __forceinline__ bool start_fast() {
    float s[M][2][4];
    find_scores(0, s);
    bool good = true;
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const float top = fmaxf(fmaxf(s[m][0][2 * h], s[m][0][2 * h + 1]), fmaxf(s[m][1][2 * h], s[m][1][2 * h + 1]));
        largest_[m][h] = largest_of_row(top);
        good = good && fabsf(largest_[m][h] * slope_) <= kLargestShift;
      }
    return __all_sync(kFullWarp, good);
  }

  __device__ __forceinline__ void fast_steps(int begin, int end) {
    const float slope = slope_ / kMultipliedRange;
    float shift[M][2], multiplied_shift[M][2];
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        shift[m][h] = -largest_[m][h] * slope_;
        multiplied_shift[m][h] = (shift[m][h] - kMultipliedLow) / kMultipliedRange;
      }
#pragma unroll kUnroll
    for (int step = begin; step < end; ++step) {
      float s[M][2][4];
      find_scores(step, s);
      uint32_t p[M][4];
#pragma unroll
      for (int m = 0; m < M; ++m) {
#pragma unroll
        for (int i = 0; i < 8; ++i) {
          float& x = s[m][i / 4][i % 4];
          x = kMultiplies && i == 7 ? multiplied_weight(x, slope, multiplied_shift[m][i % 4 / 2])
                                    : fast_weight(x, slope_, shift[m][i % 4 / 2]);
        }
        pack_tile<T>(s[m], p[m]);
      }
      add_values(step, p);
    }
  }

  // A running maximum, and keys that do not take part.
  __device__ __forceinline__ void careful_step(int step) {
    float s[M][2][4];
    find_scores(step, s);
    const uint8_t* valid = valid_ + step * kStep + 2 * (threadIdx.x % 4);
    const bool taken[4] = {valid[0] != 0, valid[1] != 0, valid[8] != 0, valid[9] != 0};
    uint32_t p[M][4];
#pragma unroll
    for (int m = 0; m < M; ++m) {
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        float top = largest_[m][h];
#pragma unroll
        for (int i = 0; i < 4; ++i)
          if (taken[i]) top = fmaxf(top, s[m][i / 2][2 * h + i % 2]);
        top = largest_of_row(top);
        const float shrink =
            largest_[m][h] == -FLT_MAX ? 0.0f : careful_weight(largest_[m][h], top, slope_, 0.0f);
        largest_[m][h] = top;
#pragma unroll
        for (int i = 0; i < 4; ++i) {
          float& x = s[m][i / 2][2 * h + i % 2];
          x = taken[i] ? careful_weight(x, top, slope_, 0.0f) : 0.0f;
        }
#pragma unroll
        for (int i = 2 * h; i < 2 * h + 2; ++i) {
          sum_[m][i] *= shrink;
#pragma unroll
          for (int c = 0; c < D / 8; ++c) out_[m][c][i] *= shrink;
        }
      }
      pack_tile<T>(s[m], p[m]);
    }
    add_values(step, p);
  }

  __device__ __forceinline__ bool is_good() const {
    bool good = true;
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        good = good && sum_[m][i] >= 0.25f && sum_[m][i] <= 0x1p100f;
#pragma unroll
        for (int c = 0; c < D / 8; ++c) good = good && fabsf(out_[m][c][i]) <= FLT_MAX;
      }
    return __all_sync(kFullWarp, good);
  }

  // Asks for the rows that store() writes.
  __device__ __forceinline__ void load_rows(const Forward<T>& args, int64_t first, int64_t end) {
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const int64_t i = first + 16 * m + threadIdx.x % kWarp / 4 + 8 * h;
        rows_[m][h] = i < end ? args.table.q_rows[i] : -1;
      }
  }

  // Goes on with the softmax that store() would overwrite. Rows without a key in this call are left out of it.
  __device__ __forceinline__ void join(const Forward<T>& args, int64_t head) {
    const int t = threadIdx.x % 4;
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        if (!inside(rows_[m][h], args.table.n_q)) continue;
        const int64_t place = rows_[m][h] * args.division.heads + head;
        const float2 other = *reinterpret_cast<const float2*>(args.stats + 2 * place);
        float& sum = sum_[m][2 * h];
        if (sum == 0) rows_[m][h] = -1;
        if (sum == 0 || other.y == 0) continue;
        const float top = other.x < largest_[m][h] ? largest_[m][h] : other.x;
        const float own = careful_weight(largest_[m][h], top, slope_, 0.0f);
        const float before = other.y * careful_weight(other.x, top, slope_, 0.0f);
        sum = fmaf(sum, own, before);
        largest_[m][h] = top;
        const T* out = args.out + place * D + 2 * t;
#pragma unroll
        for (int c = 0; c < D / 8; ++c) {
          const float2 there = unpack<T>(*reinterpret_cast<const uint32_t*>(out + 8 * c));
          out_[m][c][2 * h] = fmaf(before, there.x, out_[m][c][2 * h] * own);
          out_[m][c][2 * h + 1] = fmaf(before, there.y, out_[m][c][2 * h + 1] * own);
        }
      }
    __syncwarp();  // lanes that share a row have read its stats
  }

  __device__ __forceinline__ void store(const Forward<T>& args, int64_t head) const {
    const int t = threadIdx.x % 4;
#pragma unroll
    for (int m = 0; m < M; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const int64_t row = rows_[m][h];
        if (!inside(row, args.table.n_q)) continue;
        const int64_t place = row * args.division.heads + head;
        const float sum = sum_[m][2 * h], share = sum == 0 ? 0.0f : 1.0f / sum;
        T* out = args.out + place * D + 2 * t;
#pragma unroll
        for (int c = 0; c < D / 8; ++c)
          *reinterpret_cast<uint32_t*>(out + 8 * c) =
              pack<T>(out_[m][c][2 * h] * share, out_[m][c][2 * h + 1] * share);
        if (t == 0) *reinterpret_cast<float2*>(args.stats + 2 * place) = {sum == 0 ? 0.0f : largest_[m][h], sum};
      }
  }

 private:
  __device__ __forceinline__ void find_scores(int step, float (&s)[M][2][4]) const {
    clear(s);
    multiply_by_rows<T, D, M>(q_, keys_, step, s);
  }

  __device__ __forceinline__ void add_values(int step, const uint32_t (&p)[M][4]) {
    constexpr uint32_t kOnes = std::is_same_v<T, __nv_bfloat16> ? 0x3f803f80u : 0x3c003c00u;
    multiply_by_columns<T, D, M>(p, values_, step, out_);
#pragma unroll
    for (int m = 0; m < M; ++m) mma<T>(sum_[m], p[m], kOnes, kOnes);
  }

  float slope_;
  const uint8_t* valid_;
  uint32_t keys_, values_;
  uint32_t q_[M][D / 16][4];
  int64_t rows_[M][2];
  float out_[M][D / 8][4], sum_[M][4], largest_[M][2];
};

// kJoins: goes on with the softmax that `out` and `stats` hold, over the same queries.
template <typename T, int D, bool kJoins>
__global__ void __launch_bounds__(kThreads, kBlocks) forward_kernel(Forward<T> args) {
  using S = Shape<D>;
  extern __shared__ uint4 shared[];
  uint8_t* valid = reinterpret_cast<uint8_t*>(shared) + 2 * S::kTileBytes;
  const uint32_t keys = shared_address(shared), values = keys + S::kTileBytes;
  const PatchTable& table = args.table;
  if constexpr (!kJoins) let_next_begin();  // what joins needs the result only where it stores
  for (int64_t i = blockIdx.x; i < args.division.n_shares; i += gridDim.x) {
    Share share;
    if constexpr (kJoins) {
      share = share_by_queries<kThreads>(table, i, S::kGroup, args.division.heads);
    } else {
      share = args.division.at(i);
    }
    const Range q_range = range_of(table.cu_q, share.patch, table.n_q_listed);
    const Range k_range = range_of(table.cu_k, share.patch, table.n_k_listed);
    const int64_t n_keys = k_range.end - k_range.begin, n_tiles = (n_keys + S::kTileRows - 1) / S::kTileRows;
    if (n_tiles == 0 || q_range.begin + share.split * S::kGroup >= q_range.end) continue;

    // Queues the copies of a tile; whether all its keys take part.
    const auto tile_size = [&](int64_t tile) {
      return static_cast<int>(min(n_keys - tile * S::kTileRows, int64_t{S::kTileRows}));
    };
    const auto load_tile = [&](int64_t tile) {
      const int64_t* rows = table.kv_rows + k_range.begin + tile * S::kTileRows;
      __syncthreads();
      const bool all_valid = copy_tiles<D, kThreads, S::kTileRows, S::kParts>(
          {args.k, args.v}, rows, tile_size(tile), table.n_k, share.head, {keys, values}, valid);
      return __syncthreads_and(all_valid) != 0;
    };

    const int64_t step = args.division.splits * S::kGroup;
    int64_t group = q_range.begin + share.split * S::kGroup;
    int64_t first = group + threadIdx.x / kWarp * 16 * S::kRowTiles;  // of the warp
    Warp<T, D> warp(args, keys, values, valid);
    warp.load_queries(args, first, q_range.end, share.head);
    // The one tile of a patch is on its way while the first queries are read, and then stays.
    bool arriving = n_tiles == 1, plain = arriving && load_tile(0);
    for (; group < q_range.end; group += step) {
      const bool active = first < q_range.end;
      warp.start(args.sign);
      bool good = true;
      for (int64_t tile = 0; tile < n_tiles; ++tile) {
        if (n_tiles > 1) {
          plain = load_tile(tile);
          arriving = true;
        }
        const int n = tile_size(tile), parts = arriving ? S::kParts : 1, part_steps = S::kTileRows / kStep / parts;
        for (int part = 0; part < parts; ++part) {
          if (arriving) {
            wait_for_copies(S::kParts - 1 - part);
            __syncthreads();
          }
          if (!active) continue;
          if (part == 0) good = good && plain && (tile > 0 || n < kStep || warp.start_fast());
          if (good) warp.fast_steps(part * part_steps, min((part + 1) * part_steps, n / kStep));
        }
        arriving = false;
        if (active && good && n % kStep != 0) warp.careful_step(n / kStep);
      }
      if (active) good = good && warp.is_good();
      if (n_tiles > 1 ? __syncthreads_or(!good) : !good) {
        if (!good) warp.reset();
        for (int64_t tile = 0; tile < n_tiles; ++tile) {
          if (n_tiles > 1) {
            load_tile(tile);
            wait_for_copies();
            __syncthreads();
          }
          if (!good)
            for (int step = 0; step * kStep < tile_size(tile); ++step) warp.careful_step(step);
        }
      }
      warp.load_rows(args, first, q_range.end);
      first += step;
      warp.load_queries(args, first, q_range.end, share.head);
      wait_for_previous();  // rows that no patch lists are being set to 0, or the softmax to join is being made
      if constexpr (kJoins) {
        if (active) warp.join(args, share.head);
      }
      if (active) warp.store(args, share.head);
    }
  }
  wait_for_previous();
}

// Few blocks, so that those of the next kernel find room at once.
__global__ void __launch_bounds__(kThreads) clear_kernel(uint2* out, int64_t n_out, uint2* stats, int64_t n_stats) {
  let_next_begin();
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads;
#pragma unroll 4
  for (int64_t i = first; i < n_out; i += step) out[i] = {0, 0};
  for (int64_t i = first; i < n_stats; i += step) stats[i] = {0, 0};
}

template <typename T, int D>
void run(Forward<T> args, int64_t heads, bool joins, Stream stream) {
  constexpr size_t kSharedBytes = Shape<D>::kSharedBytes;
  if (joins) {  // few patches may have nearly all queries
    args.division = divide_by_queries(args.table.n_patches, args.table.n_q_listed, Shape<D>::kGroup, heads);
    return launch_overlapping(kOp, forward_kernel<T, D, true>, blocks_of(args.division), kThreads, kSharedBytes, stream,
                              args);
  }
  args.division = divide(args.table.n_patches, args.table.n_q_listed, Shape<D>::kGroup, heads,
                         kBlocks * multiprocessors(kOp, stream));
  const int64_t n_stats = args.table.n_q * heads, n_out = n_stats * D * sizeof(T) / sizeof(uint2);
  // A multiprocessor changes how much shared memory it has only when it is empty: both kernels want the same.
  check_cuda(cudaFuncSetAttribute(clear_kernel, cudaFuncAttributePreferredSharedMemoryCarveout,
                                  cudaSharedmemCarveoutMaxShared),
             kOp);
  launch(kOp, clear_kernel, multiprocessors(kOp, stream), kThreads, 0, stream, reinterpret_cast<uint2*>(args.out),
         n_out, reinterpret_cast<uint2*>(args.stats), n_stats);
  launch_overlapping(kOp, forward_kernel<T, D, false>, blocks_of(args.division), kThreads, kSharedBytes, stream, args);
}

}  // namespace

template <typename T>
void tensor_forward(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                    const AttentionSize& size, bool joins, T* out, float* stats, Stream stream) {
  const patch_attn::Softmax<float> softmax(size.scale);
  Forward<T> args{q, k, v, table, {}, softmax.slope, softmax.sign, out, stats};
  if (size.dim == 16) run<T, 16>(args, size.heads, joins, stream);
  else if (size.dim == 32) run<T, 32>(args, size.heads, joins, stream);
  else run<T, 64>(args, size.heads, joins, stream);
}

template void tensor_forward<__nv_bfloat16>(const HeadRows<__nv_bfloat16>&, const HeadRows<__nv_bfloat16>&,
                                            const HeadRows<__nv_bfloat16>&, const PatchTable&, const AttentionSize&,
                                            bool, __nv_bfloat16*, float*, Stream);
template void tensor_forward<__half>(const HeadRows<__half>&, const HeadRows<__half>&, const HeadRows<__half>&,
                                     const PatchTable&, const AttentionSize&, bool, __half*, float*, Stream);

}  // namespace gsim3d::cuda
