// A thread, or L neighbouring ones for head dims above 16, owns a few rows: queries in the forward pass and for their
// own gradient, keys for theirs. It walks over the rows of the other side, which the block keeps in shared memory a
// tile at a time, so all sums run in the order of the lists. Every block owns what it writes.
#include <utility>

#include <cuda_bf16.h>
#include <cuda_fp16.h>

#include "gsim3d/patch_attn/patch_attn_simple.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kDims = 16;  // of a head, a thread

// 2^(slope x) for x <= 0, as the CPU finds it; see patch_attn::Exp2. The last step is a product, so that a NaN passes.
template <typename C, int... kTerm>
__device__ __forceinline__ C horner(C f, std::integer_sequence<int, kTerm...>) {
  constexpr int kTerms = sizeof...(kTerm);
  constexpr C terms[] = {patch_attn::Exp2<C>::kP[kTerms - 1 - kTerm]...};
  C p = terms[0];
#pragma unroll
  for (int i = 1; i < kTerms; ++i) p = fma(p, f, terms[i]);
  return fma(p, f, C(1));
}
template <typename C>
__device__ __forceinline__ C weight(C x, const patch_attn::Softmax<C>& softmax) {
  using E = patch_attn::Exp2<C>;
  const C kept = x < softmax.lowest ? softmax.lowest : x;
  const C whole = fma(kept, softmax.slope, C(E::kRound));
  const C p = horner(fma(kept, softmax.slope, C(E::kRound) - whole), std::make_integer_sequence<int, E::kTerms>());
  if constexpr (sizeof(C) == 4) return p * __int_as_float(__float_as_int(whole) << E::kMantissaBits);
  else return p * __longlong_as_double(__double_as_longlong(whole) << E::kMantissaBits);
}

// Thread `part` of L holds the dims 4 (j L + part) + e: neighbours read neighbouring quads of a row.
template <int L>
__device__ __forceinline__ int dim_of(int part, int i) {
  return 4 * (i / 4 * L + part) + i % 4;
}

template <int L, typename T, typename C>
__device__ __forceinline__ void load_row(const T* row, int part, int64_t dim, C (&x)[kDims]) {
#pragma unroll
  for (int i = 0; i < kDims; ++i) {
    const int d = dim_of<L>(part, i);
    x[i] = row != nullptr && d < dim ? static_cast<C>(row[d]) : C(0);
  }
}
template <int L, typename T, typename C>
__device__ __forceinline__ void store_row(T* row, int part, int64_t dim, const C (&x)[kDims], C factor) {
#pragma unroll
  for (int i = 0; i < kDims; ++i) {
    const int d = dim_of<L>(part, i);
    if (d < dim) row[d] = static_cast<T>(x[i] * factor);
  }
}
template <typename C>
struct alignas(4 * sizeof(C)) Quad {
  C x[4];
};
template <int L, typename C>
__device__ __forceinline__ void read_tile(const C* row, int part, C (&x)[kDims]) {
#pragma unroll
  for (int j = 0; j < kDims / 4; ++j) {
    const Quad<C> quad = reinterpret_cast<const Quad<C>*>(row)[j * L + part];
#pragma unroll
    for (int e = 0; e < 4; ++e) x[4 * j + e] = quad.x[e];
  }
}

template <int L, typename C>
__device__ __forceinline__ C dot(const C (&a)[kDims], const C (&b)[kDims]) {
  C sum = 0;
#pragma unroll
  for (int i = 0; i < kDims; ++i) sum = fma(a[i], b[i], sum);
#pragma unroll
  for (int lane = 1; lane < L; lane *= 2) sum += __shfl_xor_sync(kFullWarp, sum, lane);
  return sum;
}
template <typename C>
__device__ __forceinline__ void add_scaled(C factor, const C (&x)[kDims], C (&sum)[kDims]) {
#pragma unroll
  for (int i = 0; i < kDims; ++i) sum[i] = fma(factor, x[i], sum[i]);
}

// R rows a thread group.
template <typename C, int L>
struct Shape {
  static constexpr int kRows = sizeof(C) == 4 ? 2 : 1;
  static constexpr int kGroup = kThreads / L * kRows;
  static constexpr int kTileRows = 64 / L;
  static constexpr int kWidth = kDims * L;  // of a row in shared memory, zeros beyond the head's dims
  static constexpr size_t kSharedBytes = kTileRows * (2 * kWidth + 3) * sizeof(C);
};

// The rows of the other side in shared memory.
template <typename C, int L>
struct Tile {
  using S = Shape<C, L>;
  C* a;        // [kTileRows, kWidth]
  C* b;        // [kTileRows, kWidth]
  C* largest;  // [kTileRows] each
  C* delta;
  C* taken;  // 1, or 0 for a row that takes no part

  __device__ __forceinline__ explicit Tile(void* shared)
      : a(static_cast<C*>(shared)),
        b(a + S::kTileRows * S::kWidth),
        largest(b + S::kTileRows * S::kWidth),
        delta(largest + S::kTileRows),
        taken(delta + S::kTileRows) {}

  // Listed rows of two matrices, the second times share(row) where it is given.
  template <typename T, typename ShareOf>
  __device__ __forceinline__ void fill(const HeadRows<T>& from_a, const HeadRows<T>& from_b, const int64_t* rows, int n,
                                       int64_t n_rows, int64_t head, int64_t dim, const ShareOf& share) const {
    for (int i = threadIdx.x; i < S::kTileRows * S::kWidth; i += kThreads) {
      const int r = i / S::kWidth, d = i % S::kWidth;
      const int64_t row = r < n ? rows[r] : -1;
      const bool wanted = inside(row, n_rows);
      a[i] = wanted && d < dim ? static_cast<C>(from_a.at(row, head)[d]) : C(0);
      b[i] = wanted && d < dim ? static_cast<C>(from_b.at(row, head)[d]) * share(row) : C(0);
      if (d == 0) taken[r] = wanted;
    }
  }
};

template <typename T>
struct Work {
  HeadRows<T> grad, q, k, v, out_rows;
  PatchTable table;
  AttentionSize size;
  Division division;
  patch_attn::Softmax<Sum<T>> softmax;
  T* out;
  Sum<T>* stats;
  Sum<T>* deltas;  // [H, n_q_listed]
  Gradients<T> gradients;
};

// The rows of a thread group, in groups of kGroup: body(first, end of the patch's slots).
struct Slots {
  int64_t begin, end, step;
};
template <int kGroup>
__device__ __forceinline__ Slots slots_of(const Range& range, const Share& share, const Division& division) {
  return {range.begin + share.split * kGroup, range.end, division.splits * kGroup};
}

// body(group, slots, keys, head) for every group of queries that a block owns, with the keys of their patch.
template <int kGroup, typename T, typename Body>
__device__ __forceinline__ void for_query_groups(const Work<T>& work, const Body& body) {
  const PatchTable& table = work.table;
  for (int64_t i = blockIdx.x; i < work.division.n_shares; i += gridDim.x) {
    const Share share = work.division.at(i);
    const Range keys = range_of(table.cu_k, share.patch, table.n_k_listed);
    const Slots slots = slots_of<kGroup>(range_of(table.cu_q, share.patch, table.n_q_listed), share, work.division);
    if (keys.begin == keys.end) continue;
    for (int64_t group = slots.begin; group < slots.end; group += slots.step) body(group, slots, keys, share.head);
  }
}

// body(n) for keys and values, n rows of them in the tile at a time. All threads of a block call it.
template <typename T, int L, typename Body>
__device__ __forceinline__ void for_key_tiles(const Work<T>& work, const Tile<Sum<T>, L>& tile, const Range& keys,
                                              int64_t head, const Body& body) {
  constexpr int kTileRows = Shape<Sum<T>, L>::kTileRows;
  for (int64_t first = keys.begin; first < keys.end; first += kTileRows) {
    const int n = static_cast<int>(min(keys.end - first, int64_t{kTileRows}));
    __syncthreads();
    tile.fill(work.k, work.v, work.table.kv_rows + first, n, work.table.n_k, head, work.size.dim,
              [](int64_t) { return Sum<T>(1); });
    __syncthreads();
    body(n);
  }
}

// The running softmax of a query goes on with the result of another one, given as it is stored.
template <typename C>
__device__ __forceinline__ void join(C other_largest, C other_sum, const C (&other)[kDims],
                                     const patch_attn::Softmax<C>& softmax, C& largest, C& sum, C (&result)[kDims]) {
  if (other_sum == 0) return;
  const C top = sum != 0 && other_largest < largest ? largest : other_largest;
  const C own = sum == 0 ? C(0) : weight(largest - top, softmax);
  const C before = other_sum * weight(other_largest - top, softmax);
#pragma unroll
  for (int i = 0; i < kDims; ++i) result[i] = fma(before, other[i], result[i] * own);
  sum = sum * own + before;
  largest = top;
}

// kJoins: goes on with the softmax that `out` and `stats` hold, over the same queries.
template <typename T, int L, bool kJoins>
__global__ void __launch_bounds__(kThreads) forward_kernel(Work<T> work) {
  using C = Sum<T>;
  using S = Shape<C, L>;
  constexpr int R = S::kRows;
  extern __shared__ uint4 shared[];
  const Tile<C, L> tile(shared);
  const PatchTable& table = work.table;
  const int64_t dim = work.size.dim, heads = work.size.heads;
  const int part = threadIdx.x % L;
  for_query_groups<S::kGroup>(work, [&](int64_t group, const Slots& slots, const Range& keys, int64_t head) {
    C query[R][kDims], result[R][kDims] = {}, largest[R], sum[R] = {};
    int64_t rows[R];
#pragma unroll
    for (int r = 0; r < R; ++r) {
      const int64_t slot = group + threadIdx.x / L * R + r;
      rows[r] = slot < slots.end ? table.q_rows[slot] : -1;
      if (!inside(rows[r], table.n_q)) rows[r] = -1;
      load_row<L>(rows[r] < 0 ? nullptr : work.q.at(rows[r], head), part, dim, query[r]);
      largest[r] = work.softmax.kLowestNumber;
    }
    for_key_tiles<T, L>(work, tile, keys, head, [&](int n) {
      constexpr int kAhead = 4;
      for (int j = 0; j < n; j += kAhead) {
        C s[R][kAhead];
#pragma unroll
        for (int a = 0; a < kAhead; ++a) {
          C key[kDims];
          read_tile<L>(tile.a + (j + a) * S::kWidth, part, key);
#pragma unroll
          for (int r = 0; r < R; ++r) s[r][a] = work.softmax.sign * dot<L>(query[r], key);
        }
#pragma unroll
        for (int r = 0; r < R; ++r) {
          C top = largest[r];
#pragma unroll
          for (int a = 0; a < kAhead; ++a)
            if (tile.taken[j + a] != 0 && !(s[r][a] <= top)) top = s[r][a];
          if (top != largest[r]) {
            const C shrink = weight(largest[r] - top, work.softmax);
            sum[r] *= shrink;
#pragma unroll
            for (C& x : result[r]) x *= shrink;
            largest[r] = top;
          }
        }
#pragma unroll
        for (int a = 0; a < kAhead; ++a) {
          if (tile.taken[j + a] == 0) continue;
          C value[kDims];
          read_tile<L>(tile.b + (j + a) * S::kWidth, part, value);
#pragma unroll
          for (int r = 0; r < R; ++r) {
            const C p = weight(s[r][a] - largest[r], work.softmax);
            sum[r] += p;
            add_scaled(p, value, result[r]);
          }
        }
      }
    });
    if constexpr (kJoins) {
#pragma unroll
      for (int r = 0; r < R; ++r) {
        if (rows[r] < 0) continue;
        const int64_t place = rows[r] * heads + head;
        C before[kDims];
        load_row<L>(work.out + place * dim, part, dim, before);
        join(work.stats[2 * place], work.stats[2 * place + 1], before, work.softmax, largest[r], sum[r], result[r]);
      }
      __syncwarp();  // lanes that share a row have read its stats
    }
#pragma unroll
    for (int r = 0; r < R; ++r) {
      if (rows[r] < 0) continue;
      const int64_t place = rows[r] * heads + head;
      store_row<L>(work.out + place * dim, part, dim, result[r], sum[r] == 0 ? C(0) : C(1) / sum[r]);
      if (part == 0) work.stats[2 * place] = sum[r] == 0 ? C(0) : largest[r];
      if (part == 0) work.stats[2 * place + 1] = sum[r];
    }
  });
}

// What gradients are divided by instead of the weights; 0 for a query that saw no key.
template <typename C>
__device__ __forceinline__ C one_by(C sum_of_weights) {
  return sum_of_weights == 0 ? C(0) : C(1) / sum_of_weights;
}

// delta = <out, the divided gradient>.
template <typename T, int L>
__global__ void __launch_bounds__(kThreads) query_kernel(Work<T> work) {
  using C = Sum<T>;
  using S = Shape<C, L>;
  constexpr int R = S::kRows;
  extern __shared__ uint4 shared[];
  const Tile<C, L> tile(shared);
  const PatchTable& table = work.table;
  const int64_t dim = work.size.dim, heads = work.size.heads;
  const int part = threadIdx.x % L;
  for_query_groups<S::kGroup>(work, [&](int64_t group, const Slots& slots, const Range& keys, int64_t head) {
    C query[R][kDims], grad[R][kDims], result[R][kDims] = {}, largest[R], delta[R];
    int64_t rows[R];
#pragma unroll
    for (int r = 0; r < R; ++r) {
      const int64_t slot = group + threadIdx.x / L * R + r;
      rows[r] = slot < slots.end ? table.q_rows[slot] : -1;
      const bool wanted = inside(rows[r], table.n_q);
      if (!wanted) rows[r] = -1;
      const int64_t place = wanted ? rows[r] * heads + head : 0;
      load_row<L>(wanted ? work.q.at(rows[r], head) : nullptr, part, dim, query[r]);
      load_row<L>(wanted ? work.grad.at(rows[r], head) : nullptr, part, dim, grad[r]);
      load_row<L>(wanted ? work.out_rows.at(rows[r], head) : nullptr, part, dim, result[r]);
      largest[r] = wanted ? work.stats[2 * place] : C(0);
      const C one_by_sum = wanted ? one_by(work.stats[2 * place + 1]) : C(0);
#pragma unroll
      for (C& x : grad[r]) x *= one_by_sum;
      delta[r] = dot<L>(grad[r], result[r]);
      if (slot < slots.end && part == 0) work.deltas[head * table.n_q_listed + slot] = delta[r];
#pragma unroll
      for (C& x : result[r]) x = 0;
    }
    for_key_tiles<T, L>(work, tile, keys, head, [&](int n) {
      for (int j = 0; j < n; ++j) {
        if (tile.taken[j] == 0) continue;
        C key[kDims], value[kDims];
        read_tile<L>(tile.a + j * S::kWidth, part, key);
        read_tile<L>(tile.b + j * S::kWidth, part, value);
#pragma unroll
        for (int r = 0; r < R; ++r) {
          const C p = weight(work.softmax.sign * dot<L>(query[r], key) - largest[r], work.softmax);
          add_scaled(p * (dot<L>(grad[r], value) - delta[r]), key, result[r]);
        }
      }
    });
#pragma unroll
    for (int r = 0; r < R; ++r)
      if (rows[r] >= 0)
        store_row<L>(work.gradients.q + rows[r] * work.gradients.row_stride + head * dim, part, dim, result[r],
                     static_cast<C>(work.size.scale));
  });
}

template <typename T, int L>
__global__ void __launch_bounds__(kThreads) key_kernel(Work<T> work) {
  using C = Sum<T>;
  using S = Shape<C, L>;
  extern __shared__ uint4 shared[];
  const Tile<C, L> tile(shared);
  const PatchTable& table = work.table;
  const int64_t dim = work.size.dim, heads = work.size.heads;
  const int part = threadIdx.x % L;
  constexpr int kGroup = kThreads / L;
  for (int64_t i = blockIdx.x; i < work.division.n_shares; i += gridDim.x) {
    const Share share = work.division.at(i);
    const Range queries = range_of(table.cu_q, share.patch, table.n_q_listed);
    const Slots slots = slots_of<kGroup>(range_of(table.cu_k, share.patch, table.n_k_listed), share, work.division);
    for (int64_t group = slots.begin; group < slots.end; group += slots.step) {
      const int64_t slot = group + threadIdx.x / L;
      int64_t row = slot < slots.end ? table.kv_rows[slot] : -1;
      if (!inside(row, table.n_k)) row = -1;
      C key[kDims], value[kDims], grad_k[kDims] = {}, grad_v[kDims] = {};
      load_row<L>(row < 0 ? nullptr : work.k.at(row, share.head), part, dim, key);
      load_row<L>(row < 0 ? nullptr : work.v.at(row, share.head), part, dim, value);
      for (int64_t first = queries.begin; first < queries.end; first += S::kTileRows) {
        const int n = static_cast<int>(min(queries.end - first, int64_t{S::kTileRows}));
        __syncthreads();
        tile.fill(work.q, work.grad, table.q_rows + first, n, table.n_q, share.head, dim,
                  [&](int64_t r) { return one_by(work.stats[2 * (r * heads + share.head) + 1]); });
        for (int r = threadIdx.x; r < n; r += kThreads) {
          const int64_t query = table.q_rows[first + r];
          tile.largest[r] = inside(query, table.n_q) ? work.stats[2 * (query * heads + share.head)] : C(0);
          tile.delta[r] = work.deltas[share.head * table.n_q_listed + first + r];
        }
        __syncthreads();
        for (int j = 0; j < n; ++j) {
          if (tile.taken[j] == 0) continue;
          C query[kDims], grad[kDims];
          read_tile<L>(tile.a + j * S::kWidth, part, query);
          read_tile<L>(tile.b + j * S::kWidth, part, grad);
          const C p = weight(work.softmax.sign * dot<L>(query, key) - tile.largest[j], work.softmax);
          add_scaled(p, grad, grad_v);
          add_scaled(p * (dot<L>(grad, value) - tile.delta[j]), query, grad_k);
        }
      }
      if (row < 0) continue;
      const C scale = static_cast<C>(work.size.scale);
      const int64_t place = row * work.gradients.row_stride + share.head * dim;
      if (work.gradients.at_once(row)) {
        store_row<L>(work.gradients.k + place, part, dim, grad_k, scale);
        store_row<L>(work.gradients.v + place, part, dim, grad_v, C(1));
      } else {
        C* to = work.gradients.slot(slot, share.head, work.size);
        store_row<L>(to, part, dim, grad_k, scale);
        store_row<L>(to + dim, part, dim, grad_v, C(1));
      }
    }
  }
}

// Calls f.operator()<L>() with the threads a row needs.
template <typename F>
void with_lanes(int64_t dim, const F& f) {
  if (dim <= kDims) f.template operator()<1>();
  else if (dim <= 2 * kDims) f.template operator()<2>();
  else if (dim <= 4 * kDims) f.template operator()<4>();
  else if (dim <= 8 * kDims) f.template operator()<8>();
  else f.template operator()<16>();
}

}  // namespace

template <typename T>
void simple_forward(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                    const AttentionSize& size, bool joins, T* out, Sum<T>* stats, Stream stream) {
  const char* op = "patch_attention";
  with_lanes(size.dim, [&]<int L>() {
    using S = Shape<Sum<T>, L>;
    const Division division = divide(table.n_patches, table.n_q_listed, S::kGroup, size.heads,
                                     4 * multiprocessors(op, stream));
    const Work<T> work{{}, q, k, v, {}, table, size, division, patch_attn::Softmax<Sum<T>>(size.scale), out, stats};
    const auto kernel = joins ? forward_kernel<T, L, true> : forward_kernel<T, L, false>;
    launch(op, kernel, blocks_of(division), kThreads, S::kSharedBytes, stream, work);
  });
}

template <typename T>
void simple_backward(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                     const T* out, const Sum<T>* stats, const PatchTable& table, const AttentionSize& size,
                     const Gradients<T>& gradients, const Workspace& workspace, Stream stream) {
  const char* op = "patch_attention_backward";
  const HeadRows<T> out_rows{out, size.heads * size.dim, size.dim};
  const int64_t resident = 4 * multiprocessors(op, stream);
  Work<T> work{grad, q, k, v, out_rows, table, size, {}, patch_attn::Softmax<Sum<T>>(size.scale), nullptr,
               const_cast<Sum<T>*>(stats), workspace.take<Sum<T>>(size.heads * table.n_q_listed), gradients};
  with_lanes(size.dim, [&]<int L>() {
    using S = Shape<Sum<T>, L>;
    work.division = divide(table.n_patches, table.n_q_listed, S::kGroup, size.heads, resident);
    launch(op, query_kernel<T, L>, blocks_of(work.division), kThreads, S::kSharedBytes, stream, work);
    work.division = divide(table.n_patches, table.n_k_listed, kThreads / L, size.heads, resident);
    launch(op, key_kernel<T, L>, blocks_of(work.division), kThreads, S::kSharedBytes, stream, work);
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                        \
  template void simple_forward<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const PatchTable&,     \
                                  const AttentionSize&, bool, T*, Sum<T>*, Stream);                                 \
  template void simple_backward<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&,   \
                                   const T*, const Sum<T>*, const PatchTable&, const AttentionSize&, \
                                   const Gradients<T>&, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(__nv_bfloat16)
GSIM3D_INSTANTIATE(__half)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
