// Submanifold convolution over voxels: a row reads itself through the centre tap and the occupied neighbour voxels
// through the other taps. Rows of one voxel (duplicates) have their own outputs; a tap reads one value a voxel.
//
// Source: Graham et al., "3D semantic segmentation with submanifold sparse convolutional networks", 2018. T is float or
// double. The same bits for any number of threads and any vector width: an output is summed in the order of taps by
// chains of fma, a weight gradient is summed in fixed blocks of pairs that are added in a fixed tree.
// On CUDA T may also be Float16 or BFloat16 (core/half.h), with float sums.
#pragma once

#include <cstdint>

#include "gsim3d/core/half.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

// Which rows share a voxel, and which voxels a tap connects: y[tap_out[i]] += W[tap] x[tap_in[i]] for the pairs
// cu_taps[tap] <= i < cu_taps[tap + 1] of tap (kx * K + ky) * K + kz.
struct SparseConvMap {
  const int64_t* row_voxel;      // [n_rows], the voxel of each row
  const int64_t* voxel_rows;     // [n_rows], rows of voxel 0, of voxel 1, ...; ascending inside a voxel
  const int64_t* cu_voxel_rows;  // [n_voxels + 1], from 0 to n_rows; no voxel is empty but, where there are more voxels
                                 // than rows, the last ones
  const int64_t* tap_in;         // [n_pairs]; ascending inside a tap, as voxels are ordered by their cells
  const int64_t* tap_out;        // [n_pairs]; ascending inside a tap
  const int64_t* cu_taps;        // [K^3 + 1], from 0 to at most n_pairs; the centre tap has no pairs
  int64_t n_rows, n_voxels, n_pairs, kernel_size;
  bool first;  // taps read the lowest row of a voxel instead of the mean of its rows
  // What cuda::sparse_conv_plan wrote, or null. Only for lists in which every pair has its mirror image: tap t connects
  // voxels a, b exactly where tap K^3 - 1 - t connects b, a.
  const int32_t* plan = nullptr;
};

// Rows in the order in which the tensor cores take them, where each tap of each row reads, and which taps every group
// of rows has.
constexpr int64_t kConvGroupRows = 64, kConvPlanStep = 256;
inline int64_t sparse_conv_plan_size(int64_t n_rows, int64_t kernel_size) {
  const int64_t taps = kernel_size * kernel_size * kernel_size;
  const int64_t pitch = (n_rows + kConvPlanStep - 1) / kConvPlanStep * kConvPlanStep;
  return pitch * (taps + 1) + pitch / kConvGroupRows * ((taps + 31) / 32);
}

namespace cpu {

// Throws ArgumentError unless the kernel size is odd and sane.
void check_sparse_conv_kernel(const char* op, int64_t kernel_size);

// Throws ArgumentError unless `map` is well formed. `op` starts the message.
void check_sparse_conv_map(const char* op, const SparseConvMap& map, const Parallel& parallel);

// out[p] = bias + W_centre x[p] + sum over taps W_tap xbar[neighbour voxel of p].
template <typename T>
void sparse_conv(const T* x,       // [n_rows, c_in]
                 const T* weight,  // [c_out, K, K, K, c_in]
                 const T* bias,    // [c_out] or null
                 const SparseConvMap& map, int64_t c_in, int64_t c_out,
                 T* out,  // [n_rows, c_out]
                 const Workspace& workspace, const Parallel& parallel);

template <typename T>
void sparse_conv_vjp_input(const T* grad,    // [n_rows, c_out]
                           const T* weight,  // [c_out, K, K, K, c_in]
                           const SparseConvMap& map, int64_t c_in, int64_t c_out,
                           T* grad_x,  // [n_rows, c_in]
                           const Workspace& workspace, const Parallel& parallel);

template <typename T>
void sparse_conv_vjp_weight(const T* grad,  // [n_rows, c_out]
                            const T* x,     // [n_rows, c_in]
                            const SparseConvMap& map, int64_t c_in, int64_t c_out,
                            T* grad_weight,  // [c_out, K, K, K, c_in]
                            T* grad_bias,    // [c_out]
                            const Workspace& workspace, const Parallel& parallel);

}  // namespace cpu

// As on the CPU, with device memory and on a stream. Indices are not checked: pairs and rows out of range take no part,
// and rows that are not listed become 0.
namespace cuda {

// The tables of a map for 16-bit convolutions, which make them anew where the map has none.
void sparse_conv_plan(const SparseConvMap& map, int32_t* plan /* [sparse_conv_plan_size()] */,
                      const Workspace& workspace, Stream stream);

template <typename T>
void sparse_conv(const T* x, const T* weight, const T* bias, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                 T* out, const Workspace& workspace, Stream stream);

template <typename T>
void sparse_conv_vjp_input(const T* grad, const T* weight, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                           T* grad_x, const Workspace& workspace, Stream stream);

// R: Sum<T>, or T for results that are rounded once, from the whole sums.
template <typename T, typename R>
void sparse_conv_vjp_weight(const T* grad, const T* x, const SparseConvMap& map, int64_t c_in, int64_t c_out,
                            R* grad_weight, R* grad_bias, const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
