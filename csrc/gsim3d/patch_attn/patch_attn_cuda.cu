// Patch attention on a GPU: which kernels run, and gradients of rows that several slots list.
#include <algorithm>

#include "gsim3d/core/pack.cuh"
#include "gsim3d/patch_attn/patch_attn_simple.cuh"
#include "gsim3d/patch_attn/patch_attn_tensor.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kVector = 4;  // numbers written at once; a head has a multiple of it

template <typename T>
HeadRows<Native<T>> device(const HeadRows<T>& x) {
  return {reinterpret_cast<const Native<T>*>(x.data), x.row_stride, x.head_stride};
}
template <typename T>
Native<T>* device(T* x) {
  return reinterpret_cast<Native<T>*>(x);
}
template <typename T>
const Native<T>* device(const T* x) {
  return reinterpret_cast<const Native<T>*>(x);
}

// Copies of 16 bytes need rows that start at multiples of it.
template <typename T>
bool has_aligned_rows(const HeadRows<T>& x) {
  constexpr int64_t kUnit = 16 / sizeof(T);
  return reinterpret_cast<uintptr_t>(x.data) % 16 == 0 && x.row_stride % kUnit == 0 && x.head_stride % kUnit == 0;
}
template <typename T, typename... Rows>
bool fits_tensor_cores(const AttentionSize& size, const Rows&... rows) {
  return sizeof(T) == 2 && (size.dim == 16 || size.dim == 32 || size.dim == 64) && (has_aligned_rows(rows) && ...);
}

// Finds how keys are used and clears the gradients of the queries, `width` numbers a row.
template <typename T>
__global__ void prepare_kernel(PatchTable table, RowUses uses, T* grad_q, int64_t row_stride, int64_t width) {
  const int lane = threadIdx.x % kWarp;
  const int64_t slot = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t n_warps = static_cast<int64_t>(gridDim.x) * (kThreads / kWarp);
  for (int64_t row = slot / kWarp; row < table.n_q; row += n_warps)
    for (int64_t i = lane; i < width / kVector; i += kWarp)
      reinterpret_cast<Pack<T, kVector>*>(grad_q + row * row_stride)[i] = {};
  const int64_t end = min(table.cu_k[table.n_patches], table.n_k_listed);
  if (slot >= end || slot < table.cu_k[0]) return;
  const int64_t row = table.kv_rows[slot];
  if (!inside(row, table.n_k)) return;
  atomicMin(uses.first + row, static_cast<unsigned long long>(slot));
  atomicMin(uses.minus_last + row, ~static_cast<unsigned long long>(slot));
  atomicAdd(uses.count_less_one + row, 1);
}

// Rows listed several times lie side by side: few a warp, so that many warps share them.
constexpr int kRowsPerWarp = 4;

// A warp looks at kRowsPerWarp rows and works on those that no slot or several slots list.
template <typename T>
__global__ void finish_kernel(PatchTable table, AttentionSize size, RowUses uses, Gradients<T> gradients) {
  using C = Sum<T>;
  const int lane = threadIdx.x % kWarp;
  const int64_t first = (static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp * kRowsPerWarp;
  const int mine = lane < kRowsPerWarp && first + lane < table.n_k ? uses.count_less_one[first + lane] : 0;
  const int64_t width = size.heads * size.dim;
  for (unsigned left = __ballot_sync(kFullWarp, mine != 0); left != 0; left &= left - 1) {
    const int64_t row = first + __ffs(static_cast<int>(left)) - 1;
    const int count = uses.count_less_one[row] + 1;
    const int64_t begin = static_cast<int64_t>(uses.first[row]), last = static_cast<int64_t>(~uses.minus_last[row]);
#pragma unroll 2
    for (int64_t i = lane; i < width; i += kWarp) {
      const int64_t head = i / size.dim;
      C k = 0, v = 0;
      const auto add = [&](int64_t slot) {
        const C* from = gradients.slot(slot, head, size) + (i - head * size.dim);
        k += from[0];
        v += from[size.dim];
      };
      if (count > 0) add(begin);
      if (count > 2)
        for (int64_t slot = begin + 1; slot < last; ++slot)
          if (table.kv_rows[slot] == row) add(slot);
      if (count > 1) add(last);
      gradients.k[row * gradients.row_stride + i] = static_cast<T>(k);
      gradients.v[row * gradients.row_stride + i] = static_cast<T>(v);
    }
  }
}

}  // namespace

template <typename T>
void patch_attention(const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v, const PatchTable& table,
                     const AttentionSize& size, bool joins, T* out, StatsOf<T>* stats, Stream stream) {
  const char* op = "patch_attention";
  if constexpr (sizeof(T) == 2)
    if (fits_tensor_cores<T>(size, q, k, v))
      return tensor_forward(device(q), device(k), device(v), table, size, joins, device(out), stats, stream);
  if (!joins) {
    fill_zero(op, out, table.n_q * size.heads * size.dim, stream);
    fill_zero(op, stats, table.n_q * size.heads * 2, stream);
  }
  simple_forward(device(q), device(k), device(v), table, size, joins, device(out), stats, stream);
}

template <typename T>
void patch_attention_vjp(const HeadRows<T>& grad, const HeadRows<T>& q, const HeadRows<T>& k, const HeadRows<T>& v,
                         const T* out, const StatsOf<T>* stats, const PatchTable& table, const AttentionSize& size,
                         const GradientRows<T>& grads, const Workspace& workspace, Stream stream) {
  const char* op = "patch_attention_backward";
  const int64_t use_bytes = table.n_k * (2 * sizeof(unsigned long long) + sizeof(int));
  auto* use_memory = workspace.take<unsigned long long>(use_bytes / sizeof(unsigned long long) + 1);
  const RowUses uses{use_memory, use_memory + table.n_k, reinterpret_cast<int*>(use_memory + 2 * table.n_k)};
  check_cuda(cudaMemsetAsync(use_memory, 0xff, use_bytes, native(stream)), op);
  launch(op, prepare_kernel<Native<T>>, blocks_for(op, std::max(table.n_k_listed, table.n_q), kThreads), kThreads, 0,
         stream, table, uses, device(grads.q), grads.row_stride, size.heads * size.dim);

  using C = Sum<Native<T>>;
  const Gradients<Native<T>> gradients{device(grads.q), device(grads.k), device(grads.v), grads.row_stride,
                                       workspace.take<C>(table.n_k_listed * size.heads * 2 * size.dim),
                                       uses.count_less_one};
  bool done = false;
  if constexpr (sizeof(T) == 2)
    if (fits_tensor_cores<T>(size, grad, q, k, v, HeadRows<T>{out, size.heads * size.dim, size.dim})) {
      tensor_backward(device(grad), device(q), device(k), device(v), device(out), stats, table, size, gradients,
                      workspace, stream);
      done = true;
    }
  if (!done)
    simple_backward(device(grad), device(q), device(k), device(v), device(out), stats, table, size, gradients,
                    workspace, stream);
  launch(op, finish_kernel<Native<T>>, blocks_for(op, table.n_k, kThreads / kWarp * kRowsPerWarp), kThreads, 0, stream,
         table, size, uses, gradients);
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template void patch_attention<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const PatchTable&,     \
                                   const AttentionSize&, bool, T*, StatsOf<T>*, Stream);                              \
  template void patch_attention_vjp<T>(const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, const HeadRows<T>&, \
                                       const T*, const StatsOf<T>*, const PatchTable&, const AttentionSize&,          \
                                       const GradientRows<T>&, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
GSIM3D_INSTANTIATE(Float16)
GSIM3D_INSTANTIATE(BFloat16)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
