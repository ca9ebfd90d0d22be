// Patch attention with plain multiply-adds, for every dtype and head dim: exact float32, float64, and 16-bit numbers
// whose head dim the tensor cores do not take. T is float, double, __nv_bfloat16 or __half.
#pragma once

#include "gsim3d/patch_attn/patch_attn_parts.cuh"

namespace gsim3d::cuda {

// Writes the rows of `out` and `stats` that some patch with keys lists; with `joins` what they hold takes part.
template <typename T>
void simple_forward(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                    const AttentionSize& size, bool joins, T* out, Sum<T>* stats, Stream stream);

// Writes the gradients of queries that some patch with keys lists, and those of all slots of kv_rows in patches.
template <typename T>
void simple_backward(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                     const T* out, const Sum<T>* stats, const PatchTable& table, const AttentionSize& size,
                     const Gradients<T>& gradients, const Workspace& workspace, Stream stream);

}  // namespace gsim3d::cuda
