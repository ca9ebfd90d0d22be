// A thread takes a pair on the way there, and a row with all its images on the way back.
#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/projection/projection_check.h"
#include "gsim3d/projection/projection_math.h"

namespace gsim3d::cuda {
namespace {

using namespace projection;  // NOLINT: this is its other half

constexpr const char* kProject = "project_gaussians";
constexpr const char* kShColor = "sh_to_color";
constexpr int kThreads = 128;
constexpr int64_t kParts = 64;  // blocks that share the rows of an image

// An image whose cloud is none shows no rows.
template <typename T>
__device__ View<T> device_view(const ProjectionScene<T>& s, int64_t image) {
  const int64_t cloud = s.image_cloud[image];
  if (!inside(cloud, s.n_clouds)) return view_of(s, image, int64_t{0}, int64_t{0});
  Range rows = range_of(s.cu_rows, cloud, s.n_rows);
  const int64_t pair = s.cu_pairs[image];
  if (pair < 0 || pair > s.n_pairs) return view_of(s, image, int64_t{0}, int64_t{0});
  rows.end = min(rows.end, rows.begin + s.n_pairs - pair);  // no pair is written outside of the arrays
  return view_of(s, image, rows.begin, rows.end);
}

// A pair that no image has holds zeros.
template <typename T>
__global__ void __launch_bounds__(kThreads) project_kernel(ProjectionScene<T> s, ProjectionPairs<T> pairs) {
  const int64_t step = int64_t{gridDim.x} * kThreads;
  for (int64_t pair = int64_t{blockIdx.x} * kThreads + threadIdx.x; pair < s.n_pairs; pair += step) {
    int64_t image = 0, end = s.n_images;  // the last image whose pairs begin at or before this one
    while (end - image > 1) {
      const int64_t middle = (image + end) / 2;
      (s.cu_pairs[middle] <= pair ? image : end) = middle;
    }
    if (s.n_images > 0) {
      const View<T> view = device_view(s, image);
      const int64_t row = view.row_begin + pair - view.pair_begin;
      if (row >= view.row_begin && row < view.row_end) {
        write_pair(s, view, row, pairs);
        continue;
      }
    }
    for (int i = 0; i < 2; ++i) pairs.means2d[2 * pair + i] = 0, pairs.radii[2 * pair + i] = 0;
    for (int i = 0; i < 3; ++i) pairs.conics[3 * pair + i] = 0;
    pairs.depths[pair] = 0, pairs.compensations[pair] = 0;
  }
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    project_rows_vjp_kernel(ProjectionScene<T> s, ProjectionPairGrads<T> pair_grads, ProjectionSceneGrads<T> grads) {
  const int64_t step = int64_t{gridDim.x} * kThreads;
  for (int64_t row = int64_t{blockIdx.x} * kThreads + threadIdx.x; row < s.n_rows; row += step) {
    const Shape<T> shape = shape_of(s, row);
    RowGrad<T> grad{};
    for (int64_t image = 0; image < s.n_images; ++image) {
      const int64_t cloud = s.image_cloud[image];
      if (!inside(cloud, s.n_clouds) || row < s.cu_rows[cloud] || row >= s.cu_rows[cloud + 1]) continue;
      const View<T> view = device_view(s, image);
      if (row >= view.row_begin && row < view.row_end)
        read_pair_vjp(s, view, row, shape, pair_grads, grad, static_cast<T*>(nullptr), static_cast<T*>(nullptr));
    }
    write_row_grad(grads, row, shape, grad);
  }
}

// parts [n_images, kParts, kCameraValues]: sums over the rows of a part in a fixed order.
template <typename T>
__global__ void __launch_bounds__(kThreads)
    project_cameras_vjp_kernel(ProjectionScene<T> s, ProjectionPairGrads<T> pair_grads, bool of_lens, T* parts) {
  __shared__ T shared[kThreads / kWarp][kCameraValues];
  for (int64_t image = blockIdx.y; image < s.n_images; image += gridDim.y) {
    const View<T> view = device_view(s, image);
    T sums[kCameraValues] = {};
    for (int64_t row = view.row_begin + int64_t{blockIdx.x} * kThreads + threadIdx.x; row < view.row_end;
         row += kParts * kThreads) {
      const Shape<T> shape = shape_of(s, row);
      RowGrad<T> unused{};
      read_pair_vjp(s, view, row, shape, pair_grads, unused, sums, of_lens ? sums + 12 : nullptr);
    }
    for (int i = 0; i < kCameraValues; ++i)
      for (int offset = kWarp / 2; offset > 0; offset /= 2) sums[i] += __shfl_down_sync(kFullWarp, sums[i], offset);
    __syncthreads();
    if (threadIdx.x % kWarp == 0)
      for (int i = 0; i < kCameraValues; ++i) shared[threadIdx.x / kWarp][i] = sums[i];
    __syncthreads();
    if (threadIdx.x < kCameraValues) {
      T sum = 0;
      for (int w = 0; w < kThreads / kWarp; ++w) sum += shared[w][threadIdx.x];
      parts[(image * kParts + blockIdx.x) * kCameraValues + threadIdx.x] = sum;
    }
  }
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    sum_cameras_kernel(int64_t n_images, const T* parts, ProjectionSceneGrads<T> grads) {
  for (int64_t image = int64_t{blockIdx.x} * kThreads + threadIdx.x; image < n_images;
       image += int64_t{gridDim.x} * kThreads) {
    T sums[kCameraValues] = {};
    for (int64_t part = 0; part < kParts; ++part)
      for (int i = 0; i < kCameraValues; ++i) sums[i] += parts[(image * kParts + part) * kCameraValues + i];
    write_camera_grad(grads, image, sums);
  }
}

// A thread takes a row of a batch, with all views.
template <typename T, int kTerms>
__global__ void __launch_bounds__(kThreads) sh_kernel(const T* directions, const T* sh, T* color, ShSizes n) {
  const int64_t total = n.n_batches * n.n_views * n.n_rows, step = int64_t{gridDim.x} * kThreads;
  for (int64_t at = int64_t{blockIdx.x} * kThreads + threadIdx.x; at < total; at += step) {
    const int64_t row = at / (n.n_views * n.n_rows) * n.n_rows + at % n.n_rows;
    sh_row<T, kTerms>(directions + 3 * at, sh + row * kTerms * n.n_channels, n.n_channels, color + at * n.n_channels);
  }
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kThreads)
    sh_vjp_kernel(const T* grad, const T* directions, const T* sh, T* grad_directions, T* grad_sh, ShSizes n) {
  const int64_t rows = n.n_batches * n.n_rows, width = kTerms * n.n_channels, step = int64_t{gridDim.x} * kThreads;
  for (int64_t row = int64_t{blockIdx.x} * kThreads + threadIdx.x; row < rows; row += step) {
    for (int64_t i = 0; i < width; ++i) grad_sh[row * width + i] = 0;
    for (int64_t v = 0; v < n.n_views; ++v) {
      const int64_t at = (row / n.n_rows * n.n_views + v) * n.n_rows + row % n.n_rows;
      sh_row_vjp<T, kTerms>(directions + 3 * at, sh + row * width, n.n_channels, grad + at * n.n_channels,
                            grad_directions + 3 * at, grad_sh + row * width);
    }
  }
}

unsigned blocks_of(int64_t n) {
  return static_cast<unsigned>(std::min<int64_t>((n + kThreads - 1) / kThreads, 1 << 20));
}
unsigned images_of(int64_t n) { return static_cast<unsigned>(std::min<int64_t>(n, 65535)); }

}  // namespace

template <typename T>
void project_forward(const ProjectionScene<T>& s, const ProjectionPairs<T>& pairs, Stream stream) {
  check_options(s);
  launch(kProject, project_kernel<T>, blocks_of(s.n_pairs), kThreads, 0, stream, s, pairs);
}

template <typename T>
void project_backward(const ProjectionScene<T>& s, const ProjectionPairGrads<T>& pair_grads,
                      const ProjectionSceneGrads<T>& grads, const Workspace& workspace, Stream stream) {
  check_options(s);
  launch(kProject, project_rows_vjp_kernel<T>, blocks_of(s.n_rows), kThreads, 0, stream, s, pair_grads, grads);
  if ((!grads.viewmats && !grads.Ks) || s.n_images == 0) return;
  T* parts = workspace.take<T>(s.n_images * kParts * kCameraValues);
  launch(kProject, project_cameras_vjp_kernel<T>, dim3(kParts, images_of(s.n_images)), kThreads, 0, stream, s,
         pair_grads, grads.Ks != nullptr, parts);
  launch(kProject, sum_cameras_kernel<T>, blocks_of(s.n_images), kThreads, 0, stream, s.n_images, parts, grads);
}

template <typename T>
void sh_forward(const T* directions, const T* sh, T* color, const ShSizes& n, Stream stream) {
  dispatch_terms(n.n_terms, [&](auto terms) {
    launch(kShColor, sh_kernel<T, decltype(terms)::value>, blocks_of(n.n_batches * n.n_views * n.n_rows), kThreads, 0,
           stream, directions, sh, color, n);
  });
}

template <typename T>
void sh_backward(const T* grad, const T* directions, const T* sh, T* grad_directions, T* grad_sh, const ShSizes& n,
                 Stream stream) {
  dispatch_terms(n.n_terms, [&](auto terms) {
    launch(kShColor, sh_vjp_kernel<T, decltype(terms)::value>, blocks_of(n.n_batches * n.n_rows), kThreads, 0, stream,
           grad, directions, sh, grad_directions, grad_sh, n);
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                \
  template void project_forward<T>(const ProjectionScene<T>&, const ProjectionPairs<T>&, Stream);            \
  template void project_backward<T>(const ProjectionScene<T>&, const ProjectionPairGrads<T>&,                \
                                    const ProjectionSceneGrads<T>&, const Workspace&, Stream);               \
  template void sh_forward<T>(const T*, const T*, T*, const ShSizes&, Stream);                               \
  template void sh_backward<T>(const T*, const T*, const T*, T*, T*, const ShSizes&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
