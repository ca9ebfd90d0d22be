#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <new>
#include <type_traits>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/core/simd.h"
#include "gsim3d/patch_attn/patch_attn.h"
#include "gsim3d/patch_attn/patch_attn_math.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kTile = 64;       // queries and keys of a tile: dot products and weights fit the L1 cache
constexpr int64_t kSlotLanes = 16;  // rows of key gradients are padded to it: whole vectors on every machine
constexpr int64_t kWholePatch = std::numeric_limits<int64_t>::max() / 2;
constexpr int64_t kTaskWork = 1 << 20;  // queries x keys x dim that pay for handing a task to a thread
constexpr int64_t kTasks = 64;          // long patches are cut until there are about so many tasks

namespace baseline {
using namespace simd::baseline;
#include "gsim3d/patch_attn/patch_attn_tile.inc"
}  // namespace baseline

#ifdef GSIM3D_SIMD_X86
GSIM3D_SIMD_AVX512_BEGIN
namespace avx512 {
using namespace simd::avx512;
#include "gsim3d/patch_attn/patch_attn_tile.inc"
}  // namespace avx512
GSIM3D_SIMD_AVX512_END
#else
namespace avx512 = baseline;
#endif

template <typename T>
class Scratch {
 public:
  explicit Scratch(int64_t count)
      : data_(static_cast<T*>(::operator new(static_cast<size_t>(count) * sizeof(T), std::align_val_t{64}))) {}
  ~Scratch() { ::operator delete(data_, std::align_val_t{64}); }
  Scratch(const Scratch&) = delete;
  Scratch& operator=(const Scratch&) = delete;
  T* get() const { return data_; }

 private:
  T* data_;
};

// Patches [begin, end) with all their queries, or some queries of one patch.
struct Task {
  int64_t patch_begin, patch_end, q_begin, q_end, n_keys;  // n_keys: of the largest patch
};

// Each task packs the keys of its patches again, so a task has many queries unless there are few tasks.
int64_t queries_of_task(const PatchTable& table, int64_t heads) {
  const int64_t share = table.n_q_listed * heads / kTasks / kTile * kTile;
  return std::clamp<int64_t>(share, 2 * kTile, 16 * kTile);
}

// Small patches share a task; a large one is cut into tasks of at most `most_queries`.
std::vector<Task> make_tasks(const PatchTable& table, int64_t dim, int64_t most_queries) {
  std::vector<Task> tasks;
  int64_t work = 0;  // of the last task
  for (int64_t p = 0; p < table.n_patches; ++p) {
    const int64_t q_end = table.cu_q[p + 1], n_keys = table.cu_k[p + 1] - table.cu_k[p];
    const int64_t work_here = (q_end - table.cu_q[p]) * n_keys * dim;
    if (!tasks.empty() && work + work_here <= kTaskWork) {
      tasks.back().patch_end = p + 1;
      tasks.back().q_end = q_end;
      tasks.back().n_keys = std::max(tasks.back().n_keys, n_keys);
      work += work_here;
      continue;
    }
    int64_t q_begin = table.cu_q[p];
    do {
      const int64_t stop = std::min(q_end, q_begin + most_queries);
      tasks.push_back({p, p + 1, q_begin, stop, n_keys});
      q_begin = stop;
    } while (q_begin < q_end);
    work = q_end - table.cu_q[p] > most_queries ? kTaskWork : work_here;
  }
  return tasks;
}

template <typename Run>
void run_tasks(const Run& run, int64_t most_queries, const Parallel& parallel) {
  const int64_t heads = run.size.heads;
  const std::vector<Task> tasks = make_tasks(run.table, run.size.dim, most_queries);
  parallel.chunks(static_cast<int64_t>(tasks.size()) * heads, [&](int64_t chunk) {
    const Task& task = tasks[chunk / heads];
    const Scratch<typename Run::Scalar> scratch(Run::scratch_size(task.n_keys, run.size.dim));
    for (int64_t p = task.patch_begin; p < task.patch_end; ++p)
      run.patch(p, std::max(task.q_begin, run.table.cu_q[p]), std::min(task.q_end, run.table.cu_q[p + 1]),
                chunk % heads, scratch.get());
  });
}

template <typename T>
void clear(T* x, int64_t n, const Parallel& parallel) {
  parallel.range(n, 1 << 16, [&](int64_t begin, int64_t end) { std::fill(x + begin, x + end, T(0)); });
}

// Entries of kv_rows by row: row r is listed at slots[cu[r]] .. slots[cu[r + 1] - 1], ascending.
struct RowSlots {
  std::vector<int64_t> cu, slots;

  explicit RowSlots(const PatchTable& table) : cu(table.n_k + 2, 0), slots(table.cu_k[table.n_patches]) {
    const int64_t n_listed = table.cu_k[table.n_patches];
    for (int64_t i = 0; i < n_listed; ++i) ++cu[table.kv_rows[i] + 2];
    for (int64_t r = 0; r < table.n_k; ++r) cu[r + 2] += cu[r + 1];
    for (int64_t i = 0; i < n_listed; ++i) slots[cu[table.kv_rows[i] + 1]++] = i;
  }
};

void check_offsets(const char* op, const char* name, const int64_t* cu, int64_t n_patches, int64_t n_listed) {
  check(cu[0] == 0 && cu[n_patches] <= n_listed, op, ": ", name,
        " must run from 0 to at most the number of listed rows, ", n_listed, "; got ", cu[0], " .. ", cu[n_patches]);
  for (int64_t p = 0; p < n_patches; ++p)
    check(cu[p] <= cu[p + 1], op, ": ", name, " must not descend; got ", cu[p], " then ", cu[p + 1], " at ", p);
}

}  // namespace

void check_patch_table(const char* op, const PatchTable& table) {
  check_offsets(op, "cu_q", table.cu_q, table.n_patches, table.n_q_listed);
  check_offsets(op, "cu_k", table.cu_k, table.n_patches, table.n_k_listed);
  std::vector<char> seen(static_cast<size_t>(table.n_q), 0);
  for (int64_t i = 0; i < table.n_q_listed; ++i) {
    const int64_t row = table.q_rows[i];
    check(row >= 0 && row < table.n_q, op, ": q_rows must be in [0, N) with N=", table.n_q, " from q; got ", row,
          " at ", i);
    check(!seen[row], op, ": q_rows must list a row at most once; got ", row, " again at ", i);
    seen[row] = 1;
  }
  for (int64_t i = 0; i < table.n_k_listed; ++i)
    check(table.kv_rows[i] >= 0 && table.kv_rows[i] < table.n_k, op, ": kv_rows must be in [0, N) with N=", table.n_k,
          " from k; got ", table.kv_rows[i], " at ", i);
}

void check_attention_size(const char* op, const AttentionSize& size) {
  check(size.dim >= 4 && size.dim <= kMaxHeadDim && size.dim % 4 == 0, op,
        ": head dim must be a multiple of 4 from 4 to ", kMaxHeadDim, "; got ", size.dim);
  check(std::abs(size.scale) <= 1e30, op, ": scale must be finite, at most 1e30 in size; got ", size.scale);
}

template <typename T>
void patch_attention(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                     const AttentionSize& size, bool joins, T* out, T* stats, const Parallel& parallel) {
  if (!joins && table.cu_q[table.n_patches] < table.n_q) {
    clear(out, table.n_q * size.heads * size.dim, parallel);
    clear(stats, table.n_q * size.heads * 2, parallel);
  }
  const int64_t most_queries = queries_of_task(table, size.heads);
  if (simd::use_avx512())
    run_tasks(avx512::Forward<T>{q, k, v, table, size, joins, out, stats}, most_queries, parallel);
  else
    run_tasks(baseline::Forward<T>{q, k, v, table, size, joins, out, stats}, most_queries, parallel);
}

template <typename T>
void patch_attention_vjp(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                         const T* out, const T* stats, const PatchTable& table, const AttentionSize& size,
                         T* const (&grads)[3], const Workspace& workspace, const Parallel& parallel) {
  const int64_t dim = size.dim, heads = size.heads, wide = baseline::Backward<T>::padded(dim);
  T* key_slots = workspace.take<T>(heads * table.n_k_listed * wide);
  T* value_slots = workspace.take<T>(heads * table.n_k_listed * wide);
  if (table.cu_q[table.n_patches] < table.n_q) clear(grads[0], table.n_q * heads * dim, parallel);
  if (simd::use_avx512())
    run_tasks(avx512::Backward<T>{grad, q, k, v, out, stats, table, size, grads[0], key_slots, value_slots},
              kWholePatch, parallel);
  else
    run_tasks(baseline::Backward<T>{grad, q, k, v, out, stats, table, size, grads[0], key_slots, value_slots},
              kWholePatch, parallel);

  const RowSlots listed(table);
  const T scale = static_cast<T>(size.scale);
  parallel.range(table.n_k, (1 << 14) / std::max<int64_t>(1, heads * dim) + 1, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row)
      for (int64_t head = 0; head < heads; ++head) {
        T* grad_k = grads[1] + (row * heads + head) * dim;
        T* grad_v = grads[2] + (row * heads + head) * dim;
        std::fill_n(grad_k, dim, T(0));
        std::fill_n(grad_v, dim, T(0));
        for (int64_t i = listed.cu[row]; i < listed.cu[row + 1]; ++i) {
          const int64_t at = (head * table.n_k_listed + listed.slots[i]) * wide;
          for (int64_t d = 0; d < dim; ++d) grad_k[d] += key_slots[at + d];
          for (int64_t d = 0; d < dim; ++d) grad_v[d] += value_slots[at + d];
        }
        for (int64_t d = 0; d < dim; ++d) grad_k[d] *= scale;
      }
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template void patch_attention<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const PatchTable&,     \
                                   const AttentionSize&, bool, T*, T*, const Parallel&);                              \
  template void patch_attention_vjp<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, \
                                       const T*, const T*, const PatchTable&, const AttentionSize&, T* const (&)[3],  \
                                       const Workspace&, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
