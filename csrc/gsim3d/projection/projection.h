// Projection of packed 3D Gaussians into images, on its own: what a blending of 2D Gaussians takes, with gradients.
//
// An image i shows the rows of cloud image_cloud[i]; each is a pair of the call. Pairs of an image follow one another
// from cu_pairs[i] on, in the order of rows. For a mean m in the camera's frame and the lens u(m), with J = du/dm:
//   mean2d = u(m),  covariance = J W R S S R^T W^T J^T + dilation I,  conic = covariance^-1,  depth = z of m
//   compensation = sqrt(det(covariance without dilation) / det(covariance))            (Mip-Splatting)
// A pair that is not seen holds zeros and has no gradient: outside of (near, far), beyond the lens's monotone radius,
// too faint, too small, outside of the image, or made of numbers that cannot be used. Same bits for any number of threads.
//
// Sources: Zwicker et al., EWA splatting (2002); Yu et al., Mip-Splatting (2024); OpenCV's camera models; conventions
// of gsplat (Apache-2.0).
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

enum class Lens : int64_t {
  kPinhole = 0,
  kOrthographic = 1,  // x and y in metres times the focal lengths
  kOpenCV = 2,        // k1, k2, p1, p2, k3, k4, k5, k6
  kFisheye = 3,       // k1, k2, k3, k4 of the equidistant model
};

constexpr int kDistortion = 8;

template <typename T>
struct ProjectionScene {
  const T* means;      // [n_rows, 3] metres, world
  const T* quats;      // [n_rows, 4] (w, x, y, z), any length; null with covars
  const T* scales;     // [n_rows, 3] metres; null with covars
  const T* covars;     // [n_rows, 3, 3] m^2, in place of quats and scales; the upper half is read
  const T* opacities;  // [n_rows], or null: pairs too faint to show are left out, and radii end where alpha < 1/255
  const T* viewmats;   // [n_images, 4, 4] world to camera
  const T* Ks;         // [n_images, 3, 3] pixels: [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]
  const T* distortion;  // [n_images, kDistortion], or null: none
  const T* limits;      // [n_images] largest tangent (OpenCV) or angle (fisheye) that is drawn, or null
  const int64_t* image_cloud;  // [n_images]
  const int64_t* cu_rows;      // [n_clouds + 1]
  const int64_t* cu_pairs;     // [n_images + 1]
  int64_t n_rows, n_clouds, n_images, n_pairs;
  int64_t width, height;
  T near_plane, far_plane;  // metres
  T radius_clip;            // pixels: pairs with both radii up to it are left out
  T dilation;               // px^2
  Lens lens;
  bool clamped;      // of a pinhole: J is taken at most 0.15 of the image outside of it
  bool antialiased;  // opacities are multiplied by the compensation before they are blended
};

template <typename T>
struct ProjectionPairs {
  T* means2d;        // [n_pairs, 2] pixels
  T* conics;         // [n_pairs, 3] xx, xy, yy of the inverse covariance, px^-2
  T* depths;         // [n_pairs] metres
  int32_t* radii;    // [n_pairs, 2] pixels, 0: not seen
  T* compensations;  // [n_pairs]
};

template <typename T>
struct ProjectionPairGrads {
  const T* means2d;  // null, like the others but radii: zeros
  const T* conics;
  const T* depths;
  const int32_t* radii;  // values of the forward pass
  const T* compensations;
};

// Null where not wanted, but for means.
template <typename T>
struct ProjectionSceneGrads {
  T* means;
  T* quats;
  T* scales;
  T* covars;      // symmetric
  T* viewmats;    // of the 12 upper entries taken as free numbers, the last row is 0
  T* Ks;          // of fx, skew, cx, fy and cy
  T* distortion;  // with Ks
};

// Colours of spherical harmonics: max(0, 0.5 + sum_k basis_k(direction) sh_k).
//   directions [n_batches, n_views, n_rows, 3] of any length, sh [n_batches, n_rows, n_terms, n_channels],
//   color [n_batches, n_views, n_rows, n_channels]; n_terms 1, 4, 9, 16 or 25
struct ShSizes {
  int64_t n_batches, n_views, n_rows, n_terms, n_channels;
};

namespace cpu {

template <typename T>
void project_forward(const ProjectionScene<T>& scene, const ProjectionPairs<T>& pairs, const Parallel& parallel);

template <typename T>
void project_backward(const ProjectionScene<T>& scene, const ProjectionPairGrads<T>& pair_grads,
                      const ProjectionSceneGrads<T>& grads, const Workspace& workspace, const Parallel& parallel);

template <typename T>
void sh_forward(const T* directions, const T* sh, T* color, const ShSizes& sizes, const Parallel& parallel);

template <typename T>
void sh_backward(const T* grad, const T* directions, const T* sh, T* grad_directions, T* grad_sh, const ShSizes& sizes,
                 const Parallel& parallel);

}  // namespace cpu

// The same functions on device memory; nothing waits for the device. Lists are not checked: an image whose cloud is
// none shows nothing.
namespace cuda {


template <typename T>
void project_forward(const ProjectionScene<T>& scene, const ProjectionPairs<T>& pairs, Stream stream);

template <typename T>
void project_backward(const ProjectionScene<T>& scene, const ProjectionPairGrads<T>& pair_grads,
                      const ProjectionSceneGrads<T>& grads, const Workspace& workspace, Stream stream);

template <typename T>
void sh_forward(const T* directions, const T* sh, T* color, const ShSizes& sizes, Stream stream);

template <typename T>
void sh_backward(const T* grad, const T* directions, const T* sh, T* grad_directions, T* grad_sh, const ShSizes& sizes,
                 Stream stream);

}  // namespace cuda
}  // namespace gsim3d
