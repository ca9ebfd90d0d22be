// Plane-sweep cost volume of multi-view stereo.
//
// Pixel (u, v) of image i at candidate depth d lands in its source image j at
//     q = A [u, v, 1] d + b,   (x, y) = (q_x, q_y) / max(q_z, kMinDepth),
// all in array-index coordinates (the centre of the first pixel is 0, 0). Its cost is the mean over the sources of
// <f_i(u, v), f_j(x, y)> / sqrt(C) with f_j interpolated bilinearly and zero outside the image.
//
// Interpolation is linear, so dot products are interpolated instead of features: each pixel of i meets each pixel of j
// at most once, however many depths land beside it, and no warped volume exists. T is float or double.
#pragma once

#include <cstdint>
#include <limits>

#include "gsim3d/core/check.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

// One pair is one source of one image; image i owns pairs cu_src[i] .. cu_src[i + 1] - 1.
template <typename T>
struct PlaneSweep {
  const T* homographies;      // [n_pairs, 3, 3], A of each pair
  const T* translations;      // [n_pairs, 3], b of each pair, metres
  const T* inverse_depths;    // [n_images, n_depths], 1 / metres, positive
  const int64_t* src_images;  // [n_pairs], each in [0, n_images)
  const int64_t* cu_src;      // [n_images + 1], ascending from 0 to n_pairs
  int64_t n_images, n_pairs, n_depths, channels, height, width;
};

// Throws ArgumentError unless there is a channel and pixels can be counted in 32 bits.
template <typename T>
void check_sizes(const char* op, const PlaneSweep<T>& sweep) {
  check(sweep.channels > 0, op, ": features must have at least one channel; got 0");
  check((sweep.height + 3) * (sweep.width + 2) < std::numeric_limits<int32_t>::max(), op,
        ": features must have fewer than 2^31 pixels; got ", sweep.height, " x ", sweep.width);
}

namespace cpu {

// Throws ArgumentError as check_sizes, and unless offsets and images are in range, geometry is finite and inverse
// depths are positive.
template <typename T>
void check_plane_sweep(const char* op, const PlaneSweep<T>& sweep);

// An image without sources has cost 0.
template <typename T>
void plane_sweep(const T* features,  // [n_images, channels, height, width]
                 const PlaneSweep<T>& sweep,
                 T* cost,  // [n_images, n_depths, height, width]
                 const Workspace& workspace, const Parallel& parallel);

// Gradient of the features, both as reference and as source. Every element has one owner that adds in the order of
// pairs, pixels and depths.
template <typename T>
void plane_sweep_vjp(const T* grad,      // [n_images, n_depths, height, width]
                     const T* features,  // [n_images, channels, height, width]
                     const PlaneSweep<T>& sweep,
                     T* grad_features,  // [n_images, channels, height, width]
                     const Workspace& workspace, const Parallel& parallel);

}  // namespace cpu

// The same functions on the device of `stream`. A pair whose source is out of range counts as seeing nothing.
namespace cuda {

template <typename T>
void plane_sweep(const T* features, const PlaneSweep<T>& sweep, T* cost, const Workspace& workspace, Stream stream);

template <typename T>
void plane_sweep_vjp(const T* grad, const T* features, const PlaneSweep<T>& sweep, T* grad_features,
                     const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
