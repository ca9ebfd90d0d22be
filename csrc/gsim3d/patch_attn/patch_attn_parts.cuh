// What every CUDA kernel of patch attention shares: the work of a block, and where gradients of keys go.
#pragma once

#include <cstdint>
#include <limits>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/half.cuh"
#include "gsim3d/patch_attn/patch_attn.h"
#include "gsim3d/patch_attn/patch_attn_math.h"

namespace gsim3d::cuda {

// A block computes one head of some rows of one patch: of its `splits` blocks, block s takes groups s, s + splits, ...
// of `group` rows. Heads are neighbours, so that blocks in flight read the same lines of memory.
struct Share {
  int64_t patch, head, split;
};
struct Division {
  int64_t heads, splits, n_shares;

  __device__ __forceinline__ Share at(int64_t i) const {
    return {i / (heads * splits), i % heads, i / heads % splits};
  }
};

// As few blocks as possible, for each reads the whole other side of its patch (about an eighth of the work on a group),
// but enough to keep the `resident` ones that the GPU runs at a time busy to the end.
inline Division divide(int64_t n_patches, int64_t n_listed, int64_t group, int64_t heads, int64_t resident) {
  const int64_t groups = n_patches > 0 ? (n_listed + n_patches * group - 1) / (n_patches * group) : 1;
  int64_t best = 1, least = std::numeric_limits<int64_t>::max();
  for (int64_t splits = 1; splits < 2 * groups; splits *= 2) {
    const int64_t rounds = (n_patches * heads * splits + resident - 1) / resident;
    const int64_t cost = rounds * (8 * ((groups + splits - 1) / splits) + 1);
    if (cost < least) {
      best = splits;
      least = cost;
    }
  }
  return {heads, best, n_patches * heads * best};
}
// Groups of all patches one after another, whatever number of queries each patch has. Patch p begins at group
// cu_q[p] / group + p: it has as many places as it can have groups, the last of which may be empty. A block computes
// one group: the step to its next one is beyond any list.
inline Division divide_by_queries(int64_t n_patches, int64_t n_listed, int64_t group, int64_t heads) {
  const int64_t groups = n_patches > 0 ? n_listed / group + n_patches : 0;
  return {heads, groups + 1, groups * heads};
}
template <int kThreads>
__device__ __forceinline__ Share share_by_queries(const PatchTable& table, int64_t i, int64_t group, int64_t heads) {
  const int64_t place = i / heads;
  const auto begin_of = [&](int64_t p) { return min(max(table.cu_q[p], int64_t{0}), table.n_q_listed) / group + p; };
  int64_t count = 0;  // of patches that begin no later
  for (int64_t first = 0; first < table.n_patches; first += kThreads) {
    const int64_t p = first + threadIdx.x;
    count += __syncthreads_count(p < table.n_patches && begin_of(p) <= place);
    if (count < first + kThreads) break;
  }
  const int64_t patch = max(count - 1, int64_t{0});
  return {patch, i % heads, max(place - begin_of(patch), int64_t{0})};
}
inline int64_t multiprocessors(const char* what, Stream stream) {
  int count = 0;
  check_cuda(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, stream.device), what);
  return count;
}
inline unsigned blocks_of(const Division& division) {
  return static_cast<unsigned>(division.n_shares < 0x7fffffff ? division.n_shares : 0x7fffffff);
}

// How often a row is listed as a key, and where first and last. Made by integer minima and sums, so the order in which
// threads arrive does not show. Memory starts as all ones.
struct RowUses {
  unsigned long long* first;       // [n_k], slot in kv_rows
  unsigned long long* minus_last;  // [n_k], ~slot
  int* count_less_one;             // [n_k]
};

// Where gradients go. Those of a key listed once are written at once, the others are summed over their slots later.
template <typename T>
struct Gradients {
  T* q;                // [n_q, H, D]
  T* k;                // [n_k, H, D]
  T* v;                // [n_k, H, D]
  int64_t row_stride;  // of all three
  Sum<T>* slots;       // [n_k_listed, H, 2, D], only slots of rows listed more than once are written
  const int* count_less_one;

  __device__ __forceinline__ bool at_once(int64_t row) const { return count_less_one[row] == 0; }
  __device__ __forceinline__ Sum<T>* slot(int64_t slot, int64_t head, const AttentionSize& size) const {
    return slots + (slot * size.heads + head) * 2 * size.dim;
  }
};

}  // namespace gsim3d::cuda
