// Which rows the forward pass leaves out, image by image: integer sums and minima, so their order does not matter.
#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_lists.cuh"

namespace gsim3d::cuda {
namespace {

using namespace raster;  // NOLINT: this is a part of it

constexpr const char* kWatch = "rasterize_gaussians";
constexpr int kThreads = 128;

template <typename T>
__device__ bool all_usable(const T* values, int64_t count) {
  bool good = true;
  for (int64_t i = 0; i < count; ++i) good &= usable(values[i]);
  return good;
}

template <typename T>
__device__ int64_t faults_of_row(const RasterScene<T>& s, int64_t row) {
  const int64_t color_width = (s.sh_terms > 0 ? s.sh_terms : 1) * 3;
  const T* scales = s.scales + row * 3;
  int64_t faults = 0;
  bool finite = true;
  if (!all_usable(s.means + row * 3, 3)) faults |= kFaultMeans;
  for (int i = 0; i < 4; ++i) finite &= isfinite(s.quats[row * 4 + i]);
  if (!finite) faults |= kFaultQuats;
  if (!all_usable(scales, 3) || scales[0] < 0 || scales[1] < 0 || scales[2] < 0) faults |= kFaultScales;
  if (!(s.opacities[row] >= 0 && s.opacities[row] <= 1)) faults |= kFaultOpacities;
  if (!all_usable(s.color + row * color_width, color_width)) faults |= kFaultColor;
  if (!all_usable(s.features + row * s.n_features, s.n_features)) faults |= kFaultFeatures;
  return faults;
}

template <typename T>
__device__ bool overflows(const RasterScene<T>& s, int64_t row, int64_t image) {
  T mean[3], quat[4], scale[3];
  for (int i = 0; i < 3; ++i) mean[i] = s.means[3 * row + i];
  for (int i = 0; i < 4; ++i) quat[i] = s.quats[4 * row + i];
  for (int i = 0; i < 3; ++i) scale[i] = s.scales[3 * row + i];
  const Camera<T> camera =
      make_camera(s.viewmats + 16 * image, s.Ks + 9 * image, s.width, s.height, s.near_plane,
                  s.jacobian == RasterJacobian::kClamped);
  const Projection<T> p = project(camera, mean, axes_of(quat, scale));
  return p.z > camera.near_plane && !isfinite(p.determinant);
}

template <typename T>
__global__ void __launch_bounds__(kThreads) watch_cameras_kernel(RasterScene<T> s, int64_t* unusable) {
  for (int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x; i < s.n_images; i += int64_t{gridDim.x} * kThreads) {
    const bool good = inside(s.image_cloud[i], s.n_clouds) && camera_is_good(s.viewmats + 16 * i, s.Ks + 9 * i);
    unusable[2 * i] = good ? 0 : 1, unusable[2 * i + 1] = good ? -1 : int64_t{kFaultCamera};
  }
}

// A thread takes a row. Where there is no bad row yet, the first is -1: the largest unsigned number.
template <typename T>
__global__ void __launch_bounds__(kThreads) watch_kernel(RasterScene<T> s, int64_t* unusable) {
  for (int64_t row = int64_t{blockIdx.x} * kThreads + threadIdx.x; row < s.n_rows;
       row += int64_t{gridDim.x} * kThreads) {
    const int64_t of_row = faults_of_row(s, row);
    for (int64_t image = 0; image < s.n_images; ++image) {
      const int64_t cloud = s.image_cloud[image];
      if (unusable[2 * image + 1] == kFaultCamera || row < s.cu_rows[cloud] || row >= s.cu_rows[cloud + 1]) continue;
      const int64_t faults = of_row ? of_row : overflows(s, row, image) ? int64_t{kFaultProjection} : 0;
      if (!faults) continue;
      auto* counts = reinterpret_cast<unsigned long long*>(unusable + 2 * image);
      atomicAdd(counts, 1ull);
      atomicMin(counts + 1, static_cast<unsigned long long>(row << kFaultBits | faults));
    }
  }
}

}  // namespace

template <typename T>
void raster_watch(const RasterScene<T>& scene, int64_t* unusable, Stream stream) {
  if (scene.n_images == 0) return;
  const auto blocks = [](int64_t n) {
    return static_cast<unsigned>(std::min<int64_t>((n + kThreads - 1) / kThreads, 1 << 20));
  };
  launch(kWatch, watch_cameras_kernel<T>, blocks(scene.n_images), kThreads, 0, stream, scene, unusable);
  launch(kWatch, watch_kernel<T>, blocks(scene.n_rows), kThreads, 0, stream, scene, unusable);
}

#define GSIM3D_INSTANTIATE(T) template void raster_watch<T>(const RasterScene<T>&, int64_t*, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
