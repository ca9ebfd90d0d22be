// Attention inside patches of a serialized order: every query row attends to the key rows of its patch.
//
//   out[q] = sum_k softmax_k(scale <query[q], key[k]>) value[k],   q in q_rows[cu_q[p] ..], k in kv_rows[cu_k[p] ..]
//
// The score matrix is never stored: tiles of 64 queries x 64 keys stay in the L1 cache, with a running maximum and sum
// a query. Bits do not depend on the number of threads, on the instruction set, on other patches or on the numbering of
// the rows, only on the order of the keys inside a patch. T is float or double, on CUDA also Float16 or BFloat16.
//
// A NaN in a query row reaches its own result; in a key or value row, the queries of the patches that list it.
#pragma once

#include <cstdint>
#include <type_traits>

#include "gsim3d/core/half.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/platform.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

// Patch p: queries q_rows[cu_q[p]] .. q_rows[cu_q[p + 1] - 1], keys kv_rows[cu_k[p]] .. kv_rows[cu_k[p + 1] - 1].
struct PatchTable {
  const int64_t* q_rows;   // [n_q_listed], each in [0, n_q), none twice
  const int64_t* kv_rows;  // [n_k_listed], each in [0, n_k); a row may be listed by several patches
  const int64_t* cu_q;     // [n_patches + 1], ascending from 0 to at most n_q_listed; rows behind are in no patch
  const int64_t* cu_k;     // [n_patches + 1], ascending from 0 to at most n_k_listed
  int64_t n_patches;
  int64_t n_q_listed, n_k_listed;
  int64_t n_q, n_k;  // rows of the query matrix, rows of the key and value matrices
};

// Rows of heads [N, H, D] inside a larger tensor, for example one of the three parts of a qkv tensor. D is contiguous.
template <typename T>
struct HeadRows {
  const T* data;
  int64_t row_stride, head_stride;  // in elements

  GSIM3D_HD const T* at(int64_t row, int64_t head) const { return data + row * row_stride + head * head_stride; }
};

struct AttentionSize {
  int64_t heads;  // H
  int64_t dim;    // D, a multiple of 4 from 4 to 256
  double scale;   // finite
};

namespace cpu {

constexpr int64_t kMaxHeadDim = 256;

// Throw ArgumentError unless the table or the size is well formed. `op` starts the message.
void check_patch_table(const char* op, const PatchTable& table);
void check_attention_size(const char* op, const AttentionSize& size);

// A query row that no patch lists, or whose patch has no keys, gets 0. With `joins`, out and stats hold the attention
// of the same queries to other keys, and become that to both in one softmax; such a row then keeps what it has.
template <typename T>
void patch_attention(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                     const AttentionSize& size, bool joins,
                     T* out,    // [n_q, H, D]
                     T* stats,  // [n_q, H, 2]: largest <query, key> of the patch (times -1 where scale < 0) and the sum
                                // of exp(scale (<query, key> - largest)); what patch_attention_vjp needs
                     const Parallel& parallel);

// Gradients of patch_attention. A key row in several patches receives the sum over its slots in the order of kv_rows.
template <typename T>
void patch_attention_vjp(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                         const T* out, const T* stats, const PatchTable& table, const AttentionSize& size,
                         T* const (&grads)[3],  // of q [n_q, H, D], k [n_k, H, D] and v [n_k, H, D]
                         const Workspace& workspace, const Parallel& parallel);

}  // namespace cpu

// The same functions on the device of `stream`; sums and softmax of 16-bit numbers are float32. A slot whose row is out
// of range is skipped. Bits do not depend on timing, but differ from those of the CPU.
namespace cuda {

template <typename T>
using StatsOf = std::conditional_t<sizeof(T) == 2, float, T>;

// Where the gradients of q [n_q, H, D], k and v [n_k, H, D] go: rows of H D numbers, row_stride apart.
template <typename T>
struct GradientRows {
  T *q, *k, *v;
  int64_t row_stride;
};

template <typename T>
void patch_attention(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                     const AttentionSize& size, bool joins, T* out, StatsOf<T>* stats, Stream stream);

template <typename T>
void patch_attention_vjp(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                         const T* out, const StatsOf<T>* stats, const PatchTable& table, const AttentionSize& size,
                         const GradientRows<T>& grads, const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
