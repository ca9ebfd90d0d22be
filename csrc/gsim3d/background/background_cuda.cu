// Rows of a cloud come in the order of their codes, so the patches around them ascend: where a cloud's rows of a patch
// begin is written by the row that is first there, and nothing has to be sorted.
#include <algorithm>

#include "gsim3d/background/background_math.h"
#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/half.cuh"
#include "gsim3d/core/pack.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kCutThreads = 1024;  // one block a curve
constexpr const char* kOverlap = "overlapping_patches";

__global__ void __launch_bounds__(kThreads) row_scenes_kernel(RowChain chain) {
  const int64_t s = blockIdx.y, row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row < chain.n_rows[s]) chain.scene[s][row] = background::scene_of(chain, s, row);
}

__global__ void __launch_bounds__(kThreads)
    find_cells_kernel(const int64_t* __restrict__ cells, int64_t n_cells, const int64_t* __restrict__ scene,
                      const int64_t* __restrict__ grid, int64_t n, int64_t* __restrict__ places) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) places[i] = background::place_of(cells, n_cells, background::cell_key(scene[i], grid + 3 * i));
}

template <typename T, int N>
__global__ void __launch_bounds__(kThreads)
    add_cells_kernel(const T* __restrict__ x, const T* __restrict__ field, const int64_t* __restrict__ places,
                     int64_t n, int64_t n_cells, int64_t packs, T* __restrict__ out) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x, row = i / packs;
  if (row >= n) return;
  const int64_t place = places[row];
  auto sum = reinterpret_cast<const Pack<T, N>*>(x)[i];
  if (inside(place, n_cells)) {
    const auto there = reinterpret_cast<const Pack<T, N>*>(field)[place * packs + i - row * packs];
#pragma unroll
    for (int j = 0; j < N; ++j)
      sum.lane[j] = static_cast<T>(static_cast<Sum<T>>(sum.lane[j]) + static_cast<Sum<T>>(there.lane[j]));
  }
  reinterpret_cast<Pack<T, N>*>(out)[i] = sum;
}

// Queries of one curve on their way to parts. A bucket is a patch, or behind the last one the rows without a patch.
struct Cut {
  Overlap overlap;
  QueryParts parts;
  int64_t n_parts, n_buckets;
  int64_t* bucket;  // [n_curves, n_rows], of the row at each place of the order
  int64_t* starts;  // [n_curves, n_clouds, n_buckets + 1]: the place at which a cloud's rows of each bucket begin
  int64_t* begin;   // [n_curves, n_buckets, n_clouds]: where they go
  int64_t* parent;  // [n_curves, n_parts]: the patch of a part, or -1

  __device__ __forceinline__ int64_t n_real() const {
    return overlap.n_clouds > 0 ? min(max(overlap.cu_clouds[overlap.n_clouds], int64_t{0}), overlap.n_rows) : 0;
  }
  __device__ __forceinline__ Range cloud(int64_t c) const { return range_of(overlap.cu_clouds, c, overlap.n_rows); }
  __device__ __forceinline__ int64_t cloud_of(int64_t place) const {
    const int64_t c = background::count_below<true>(overlap.cu_clouds, overlap.n_clouds + 1, place) - 1;
    return min(max(c, int64_t{0}), overlap.n_clouds - 1);
  }
  __device__ __forceinline__ int64_t* starts_of(int64_t curve, int64_t c) const {
    return starts + (curve * overlap.n_clouds + c) * (n_buckets + 1);
  }
  __device__ __forceinline__ int64_t bucket_at(int64_t curve, int64_t place) const {
    const int64_t row = overlap.order[curve * overlap.n_rows + place];
    if (!inside(row, overlap.n_rows)) return overlap.n_patches;
    return background::patch_of(overlap.first + curve * overlap.n_patches, overlap.n_patches,
                                overlap.codes[curve * overlap.n_rows + row]);
  }
};

__global__ void __launch_bounds__(kThreads) find_buckets_kernel(Cut cut) {
  const int64_t curve = blockIdx.y, place = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (place >= cut.n_real()) return;
  const int64_t c = cut.cloud_of(place);
  const Range cloud = cut.cloud(c);
  const int64_t own = cut.bucket_at(curve, place);
  cut.bucket[curve * cut.overlap.n_rows + place] = own;
  int64_t* starts = cut.starts_of(curve, c);
  const int64_t before = place > cloud.begin ? cut.bucket_at(curve, place - 1) : -1;
  for (int64_t b = before + 1; b <= own; ++b) starts[b] = place;
  if (place == cloud.end - 1)
    for (int64_t b = own + 1; b <= cut.n_buckets; ++b) starts[b] = cloud.end;
}

// The sum over the threads before this one, and that over all.
struct Sums {
  int64_t before, all;
};
__device__ __forceinline__ Sums block_sums(int64_t value, int64_t* shared /* [kCutThreads / kWarp] */) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  int64_t sum = value;
#pragma unroll
  for (int offset = 1; offset < kWarp; offset *= 2) {
    const int64_t from = __shfl_up_sync(kFullWarp, sum, offset);
    if (lane >= offset) sum += from;
  }
  if (lane == kWarp - 1) shared[warp] = sum;
  __syncthreads();
  Sums sums{sum - value, 0};
#pragma unroll
  for (int w = 0; w < kCutThreads / kWarp; ++w) {
    if (w < warp) sums.before += shared[w];
    sums.all += shared[w];
  }
  __syncthreads();
  return sums;
}

__global__ void __launch_bounds__(kCutThreads) make_parts_kernel(Cut cut) {
  __shared__ int64_t shared[kCutThreads / kWarp];
  const Overlap& overlap = cut.overlap;
  const int64_t curve = blockIdx.x, n_clouds = overlap.n_clouds;
  int64_t* begin = cut.begin + curve * cut.n_buckets * n_clouds;
  int64_t* cu_q = cut.parts.cu_q + curve * (cut.n_parts + 1);
  int64_t* cu_k = cut.parts.cu_k + curve * (cut.n_parts + 1);
  int64_t* parent = cut.parent + curve * cut.n_parts;

  int64_t total = 0;
  for (int64_t first = 0; first < cut.n_buckets * n_clouds; first += kCutThreads) {
    const int64_t i = first + threadIdx.x, c = i % n_clouds, b = i / n_clouds;
    int64_t count = 0;
    if (b < cut.n_buckets) {
      const Range cloud = cut.cloud(c);
      const int64_t* starts = cut.starts_of(curve, c) + b;
      if (cloud.begin < cloud.end) count = min(max(starts[1] - starts[0], int64_t{0}), cloud.end - cloud.begin);
    }
    const Sums sums = block_sums(count, shared);
    if (b < cut.n_buckets) begin[i] = total + sums.before;
    total += sums.all;
  }
  __syncthreads();

  const auto begin_of = [&](int64_t p) { return n_clouds > 0 ? min(begin[p * n_clouds], overlap.n_rows) : 0; };
  int64_t n_used = 0, n_keys = 0;
  for (int64_t first = 0; first < overlap.n_patches; first += kCutThreads) {
    const int64_t p = first + threadIdx.x;
    const bool valid = p < overlap.n_patches;
    const int64_t queries = valid ? begin_of(p) : 0, n = valid ? begin_of(p + 1) - queries : 0;
    const int64_t n_parts = overlap.parts_of(n);
    Range keys{0, 0};
    if (valid) keys = range_of(overlap.cu_k, p, overlap.n_keys);
    const int64_t per_part = keys.end - keys.begin;
    const Sums parts = block_sums(n_parts, shared), listed = block_sums(n_parts * per_part, shared);
    for (int64_t i = 0; i < n_parts; ++i) {
      const int64_t part = n_used + parts.before + i;
      if (part >= cut.n_parts) break;
      cu_q[part] = queries + i * overlap.patch_size;
      cu_k[part] = n_keys + listed.before + i * per_part;
      parent[part] = p;
    }
    n_used += parts.all;
    n_keys += listed.all;
  }
  for (int64_t part = min(n_used, cut.n_parts) + threadIdx.x; part <= cut.n_parts; part += kCutThreads) {
    cu_q[part] = begin_of(overlap.n_patches);
    cu_k[part] = n_keys;
    if (part < cut.n_parts) parent[part] = -1;
  }
}

// Blocks write the keys of a part each; those behind them the queries.
__global__ void __launch_bounds__(kThreads) write_parts_kernel(Cut cut) {
  const Overlap& overlap = cut.overlap;
  const int64_t curve = blockIdx.y;
  if (blockIdx.x < cut.n_parts) {
    const int64_t room = overlap.n_listed();
    const int64_t* cu_k = cut.parts.cu_k + curve * (cut.n_parts + 1);
    int64_t* kv_rows = cut.parts.kv_rows + curve * room;
    const int64_t p = cut.parent[curve * cut.n_parts + blockIdx.x];
    if (p >= 0) {
      const Range keys = range_of(overlap.cu_k, p, overlap.n_keys);
      for (int64_t i = keys.begin + threadIdx.x; i < keys.end; i += kThreads) {
        const int64_t to = cu_k[blockIdx.x] + i - keys.begin;
        if (to < room) kv_rows[to] = overlap.kv_rows[curve * overlap.n_keys + i];
      }
    }
    const int64_t first = cu_k[cut.n_parts] + blockIdx.x * kThreads + threadIdx.x;
    for (int64_t i = first; i < room; i += cut.n_parts * kThreads) kv_rows[i] = 0;
    return;
  }
  const int64_t place = (blockIdx.x - cut.n_parts) * kThreads + threadIdx.x;
  if (place >= overlap.n_rows) return;
  int64_t to = place;
  if (place < cut.n_real()) {
    const int64_t b = cut.bucket[curve * overlap.n_rows + place], c = cut.cloud_of(place);
    to = cut.begin[(curve * cut.n_buckets + b) * overlap.n_clouds + c] + place - cut.starts_of(curve, c)[b];
  }
  if (inside(to, overlap.n_rows))
    cut.parts.q_rows[curve * overlap.n_rows + to] = overlap.order[curve * overlap.n_rows + place];
}

}  // namespace

void row_scenes(const RowChain& chain, Stream stream) {
  const char* op = "row_scenes";
  int64_t most = 0;
  for (int64_t s = 0; s < chain.n_stages; ++s) most = chain.n_rows[s] > most ? chain.n_rows[s] : most;
  const auto n_stages = static_cast<unsigned>(chain.n_stages);
  launch(op, row_scenes_kernel, dim3(blocks_for(op, most, kThreads), n_stages), kThreads, 0, stream, chain);
}

void find_cells(const int64_t* cells, int64_t n_cells, const int64_t* scene, const int64_t* grid, int64_t n,
                int64_t* places, Stream stream) {
  launch("find_cells", find_cells_kernel, blocks_for("find_cells", n, kThreads), kThreads, 0, stream, cells, n_cells,
         scene, grid, n, places);
}

template <typename T>
void add_cells(const T* x, const T* field, const int64_t* places, int64_t n, int64_t n_cells, int64_t channels, T* out,
               Stream stream) {
  const char* op = "add_cells";
  const auto run = [&]<int N>() {
    const int64_t packs = channels / N;
    launch(op, add_cells_kernel<Native<T>, N>, blocks_for(op, n * packs, kThreads), kThreads, 0, stream,
           reinterpret_cast<const Native<T>*>(x), reinterpret_cast<const Native<T>*>(field), places, n, n_cells, packs,
           reinterpret_cast<Native<T>*>(out));
  };
  constexpr int kPack = 16 / sizeof(T);
  const auto address = [](const void* p) { return reinterpret_cast<uintptr_t>(p); };
  const auto bits = address(x) | address(field) | address(out);
  if (bits % 16 == 0 && channels % kPack == 0) run.template operator()<kPack>();
  else run.template operator()<1>();
}

#define GSIM3D_INSTANTIATE(T) \
  template void add_cells<T>(const T*, const T*, const int64_t*, int64_t, int64_t, int64_t, T*, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(Float16)
GSIM3D_INSTANTIATE(BFloat16)
#undef GSIM3D_INSTANTIATE

void overlapping_patches(const Overlap& overlap, const QueryParts& parts, const Workspace& workspace, Stream stream) {
  Cut cut{overlap, parts, overlap.n_parts(), overlap.n_patches + 1};
  cut.bucket = workspace.take<int64_t>(overlap.n_curves * overlap.n_rows);
  cut.starts = workspace.take<int64_t>(overlap.n_curves * overlap.n_clouds * (cut.n_buckets + 1));
  cut.begin = workspace.take<int64_t>(overlap.n_curves * cut.n_buckets * overlap.n_clouds);
  cut.parent = workspace.take<int64_t>(overlap.n_curves * cut.n_parts);
  const auto n_curves = static_cast<unsigned>(overlap.n_curves);
  const unsigned row_blocks = blocks_for(kOverlap, overlap.n_rows, kThreads);
  launch(kOverlap, find_buckets_kernel, dim3(row_blocks, n_curves), kThreads, 0, stream, cut);
  launch(kOverlap, make_parts_kernel, n_curves, kCutThreads, 0, stream, cut);
  if (cut.n_parts == 0) fill_zero(kOverlap, parts.kv_rows, overlap.n_curves * overlap.n_listed(), stream);
  launch(kOverlap, write_parts_kernel,
         dim3(blocks_for(kOverlap, cut.n_parts + static_cast<int64_t>(row_blocks), 1), n_curves), kThreads, 0, stream,
         cut);
}

}  // namespace gsim3d::cuda
