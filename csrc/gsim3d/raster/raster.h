// 3D Gaussian splatting: projection of packed Gaussians into pinhole images, and front-to-back blending.
//
// One call renders I images; image i shows the rows of cloud image_cloud[i]. For a pixel centre p = (x + 0.5, y + 0.5):
//   mu, Sigma = projection of the mean and (J W) R S S R^T (J W)^T + 0.3 I      (EWA splatting)
//   alpha_n = min(0.99, opacity_n exp(-(p - mu)^T Sigma^-1 (p - mu) / 2)), left out where below 1/255
//   T_n = prod_{m < n} (1 - alpha_m) over the Gaussians in front, sorted by camera z, ties by row
//   color = sum_n alpha_n T_n color_n + T_end background; depth, features: the same sums of camera z, of feature rows
// A pixel ends before the first Gaussian that would bring T below 1e-4. Same bits for any number of threads.
//
// Sources: Zwicker et al., EWA splatting (2002); Kerbl et al., 3D Gaussian splatting (2023); conventions of gsplat
// (Apache-2.0).
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

enum class RasterCutoff : int64_t {
  kExact = 0,       // every pixel where alpha >= 1/255
  kTile3Sigma = 1,  // of those, the pixels of the 16 x 16 tiles that a square of 3 standard deviations touches
  kSmooth = 2,      // alpha fades to 0 between 2/255 and 1/255: once differentiable everywhere, for tests of gradients
};

// Where J, the derivative of the image coordinates, is taken for Gaussians centred outside of the image.
enum class RasterJacobian : int64_t {
  kExact = 0,    // at the centre: an image is what a larger one of the same camera has there
  kClamped = 1,  // at most 0.15 of the image outside of it, as 3DGS and gsplat do
};

constexpr int kProjected = -1;  // in place of RasterScene::sh_terms: the rows are projected, each for one image

template <typename T>
struct RasterScene {
  const T* means;       // [n_rows, 3] metres, world
  const T* quats;       // [n_rows, 4] (w, x, y, z), any length; shorter than 1e-6: identity, no gradient
  const T* scales;      // [n_rows, 3] metres, standard deviations
  const T* opacities;   // [n_rows] in [0, 1]
  const T* color;       // [n_rows, sh_terms, 3], or [n_rows, 3] with sh_terms = 0
  const T* features;    // [n_rows, n_features]
  const T* background;  // [n_images, 3]
  const T* viewmats;    // [n_images, 4, 4] world to camera; x right, y down, z forward
  const T* Ks;          // [n_images, 3, 3] pixels: [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]
  const int64_t* image_cloud;  // [n_images]
  const int64_t* cu_rows;      // [n_clouds + 1]
  int64_t n_rows, n_clouds, n_images;
  int64_t sh_terms;  // 0, 1, 4, 9, 16 or kProjected
  int64_t n_features, width, height;
  T near_plane;  // metres; Gaussians whose centre is not beyond it are left out
  RasterCutoff cutoff;
  RasterJacobian jacobian = RasterJacobian::kExact;
  // Of projected rows, in place of means, quats, scales, viewmats and Ks. A row whose conic is not positive definite,
  // or whose depth is not positive, is left out.
  const T* means2d = nullptr;  // [n_rows, 2] pixels
  const T* conics = nullptr;   // [n_rows, 3] xx, xy, yy of the inverse covariance, px^-2
  const T* depths = nullptr;   // [n_rows] metres
  // [n_images, tiles] of kTile x kTile pixels, row by row: where false, the background alone is shown. Null: all true.
  const bool* active = nullptr;
};

// What makes a row unusable; bits. Such a row is left out of the images, and its gradients are 0.
enum RasterFault : int64_t {
  kFaultMeans = 1,        // not finite, or beyond kLargest
  kFaultQuats = 2,        // not finite
  kFaultScales = 4,       // the same, or negative
  kFaultOpacities = 8,    // not in [0, 1]
  kFaultColor = 16,       // not finite, or beyond kLargest
  kFaultFeatures = 32,    // not finite, or beyond kLargest
  kFaultProjection = 64,  // in front of the camera, but its projection overflows
  kFaultTiles = 128,      // not of a row: all Gaussians of the image together touch 2^31 tiles or more; none is drawn
  kFaultCamera = 256,     // not of a row: camera or cloud of the image is none (CUDA; the CPU throws)
};
constexpr int kFaultBits = 9, kRowFaults = 7;  // the first ones are of rows
constexpr const char* kFaultTexts[kFaultBits] = {
    "not finite or beyond 1e15",
    "not finite",
    "negative, not finite or beyond 1e15",
    "outside [0, 1]",
    "not finite or beyond 1e15",
    "not finite or beyond 1e15",
    "too large, the projection overflows",
    "too large, together they touch 2^31 tiles or more",
    "not a camera, or it shows no cloud",
};

template <typename T>
struct RasterImages {
  T* color;          // [n_images, height, width, 3]
  T* alpha;          // [n_images, height, width]
  T* depth;          // [n_images, height, width] sum of weight * camera z, metres
  T* features;       // [n_images, height, width, n_features]
  T* transmittance;  // [n_images, height, width] T_end, kept for the backward pass
  int32_t* last;     // [n_images, height, width] entries of the tile's list in front of the pixel's end; kept the same way
  int64_t* unusable;  // [n_images, 2] how many rows were left out, and row << 9 | faults of the first, -1: none. Null:
                      // not wanted
};

template <typename T>
struct RasterImageGrads {
  const T* color;  // null, like the next three: zeros; not for second derivatives
  const T* alpha;
  const T* depth;
  const T* features;
  const T* transmittance;  // values of the forward pass
  const int32_t* last;     // values of the forward pass
};

template <typename T>
struct RasterSceneGrads {
  T* means;
  T* quats;
  T* scales;
  T* opacities;
  T* color;
  T* features;  // [n_rows, n_features], or with `absolute` two more columns
  T* background;  // null: not wanted
  T* viewmats;  // of the 12 upper entries taken as free numbers, the last row is 0; null: not wanted
  // Of projected rows.
  T* means2d = nullptr;
  T* conics = nullptr;
  T* depths = nullptr;
  // Whether the last two columns of `features` are sums over pixels of what each adds to |gradient| of means2d.
  bool absolute = false;

  int64_t feature_columns(int64_t n_features) const { return n_features + (absolute ? 2 : 0); }
};

// A direction of the arguments of the same names; null: 0.
template <typename T>
struct RasterTangents {
  const T* means;
  const T* quats;
  const T* scales;
  const T* opacities;
  const T* color;
  const T* features;
  const T* background;
  const T* viewmats;
};

namespace cpu {

// Throws ArgumentError for cameras and offsets that cannot be rendered. Rows that cannot are left out and counted.
template <typename T>
void raster_forward(const RasterScene<T>& scene, const RasterImages<T>& images, const Workspace& workspace,
                    const Parallel& parallel);

// Vector-Jacobian product of raster_forward; fills every array of `grads`. A Gaussian has no gradient through a pixel
// where its alpha is cut to 0.99.
template <typename T>
void raster_backward(const RasterScene<T>& scene, const RasterImageGrads<T>& image_grads,
                     const RasterSceneGrads<T>& grads, const Workspace& workspace, const Parallel& parallel);

// Derivatives along `tangents`: of the images (color, alpha, depth and features are written) and, unless `grads` is
// null, of every gradient that raster_backward gives for `image_grads` (of which transmittance and last are not read).
template <typename T>
void raster_tangent(const RasterScene<T>& scene, const RasterTangents<T>& tangents,
                    const RasterImageGrads<T>& image_grads, const RasterImages<T>& images,
                    const RasterSceneGrads<T>* grads, const Workspace& workspace, const Parallel& parallel);

}  // namespace cpu

// The same functions on device memory. Nothing waits for the device, so its arrays are not checked: an image with a bad
// camera or cloud shows its background, a background that is not finite counts as black, and gradients of both are 0.
// Rows that cannot be rendered are left out; raster_watch counts them. Same bits from run to run.
namespace cuda {

// How much one call holds at once. Of the images, as many as stay within all three are rendered together and kept in
// `state` for the backward pass; the others are made where they are needed: slower, equal but for rounding.
struct RasterLimits {
  int64_t pairs;    // of a Gaussian and an image that shows its cloud; in [n_rows, 2^28]
  int64_t entries;  // of a Gaussian and a tile of 16 x 16 pixels that its bounds touch; in [n_rows, 2^31)
  int64_t slots;    // of a Gaussian and a quarter of a tile that its bounds touch; in [4 n_rows, 2^31)
};

// Device memory that the forward pass fills and the backward pass reads.
template <typename T>
int64_t raster_state_bytes(const RasterScene<T>& scene, const RasterLimits& limits);

template <typename T>
void raster_forward(const RasterScene<T>& scene, const RasterImages<T>& images, const RasterLimits& limits, void* state,
                    const Workspace& workspace, Stream stream);

// RasterImages::unusable, which raster_forward does not touch here. One look at every row and its projections.
template <typename T>
void raster_watch(const RasterScene<T>& scene, int64_t* unusable, Stream stream);

template <typename T>
void raster_backward(const RasterScene<T>& scene, const RasterImageGrads<T>& image_grads,
                     const RasterSceneGrads<T>& grads, const RasterLimits& limits, void* state,
                     const Workspace& workspace, Stream stream);

// Derivatives along `tangents` of color, alpha, depth and features, whose arrays in `images` are written.
template <typename T>
void raster_tangent(const RasterScene<T>& scene, const RasterTangents<T>& tangents, const RasterImages<T>& images,
                    const RasterLimits& limits, void* state, const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
