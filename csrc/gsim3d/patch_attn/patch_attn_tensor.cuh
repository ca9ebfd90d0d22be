// Patch attention in 16-bit numbers on the tensor cores, for head dims 16, 32 and 64. Rows of q, k, v and the gradient
// of the result start at multiples of 16 bytes. T is __nv_bfloat16 or __half.
#pragma once

#include "gsim3d/patch_attn/patch_attn_parts.cuh"

namespace gsim3d::cuda {

// Rows of `out` and `stats` that no patch with keys lists become 0, or with `joins` stay as they are.
template <typename T>
void tensor_forward(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                    const AttentionSize& size, bool joins, T* out, float* stats, Stream stream);

// Writes the gradients of queries that some patch with keys lists, and those of all slots of kv_rows in patches.
template <typename T>
void tensor_backward(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                     const T* out, const float* stats, const PatchTable& table, const AttentionSize& size,
                     const Gradients<T>& gradients, const Workspace& workspace, Stream stream);

}  // namespace gsim3d::cuda
