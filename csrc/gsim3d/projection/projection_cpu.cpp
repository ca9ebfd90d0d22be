#include <algorithm>
#include <vector>

#include "gsim3d/projection/projection_check.h"
#include "gsim3d/projection/projection_math.h"

namespace gsim3d::cpu {
namespace {

using namespace projection;  // NOLINT: this is its other half

constexpr const char* kOp = "project_gaussians";
constexpr int64_t kRowsPerChunk = 1024;

template <typename T>
std::vector<View<T>> checked_views(const ProjectionScene<T>& s) {
  check_options(s);
  check(s.cu_rows[0] == 0 && s.cu_rows[s.n_clouds] == s.n_rows, kOp, ": cu_rows must run from 0 to N=", s.n_rows,
        "; got ", s.cu_rows[0], " .. ", s.cu_rows[s.n_clouds]);
  for (int64_t q = 0; q < s.n_clouds; ++q)
    check(s.cu_rows[q] <= s.cu_rows[q + 1], kOp, ": cu_rows must not descend; got ", s.cu_rows[q], " then ",
          s.cu_rows[q + 1], " at ", q);
  std::vector<View<T>> views;
  int64_t pair = 0;
  for (int64_t i = 0; i < s.n_images; ++i) {
    const int64_t cloud = s.image_cloud[i];
    check(cloud >= 0 && cloud < s.n_clouds, kOp, ": image_cloud must be in [0, Q) with Q=", s.n_clouds, "; got ", cloud,
          " for image ", i);
    for (int j = 0; j < 12; ++j)
      check(raster::usable(s.viewmats[16 * i + j]), kOp, ": viewmats must be finite and at most 1e15; got ",
            s.viewmats[16 * i + j], " for image ", i);
    const T* K = s.Ks + 9 * i;
    for (int j = 0; j < 9; ++j)
      check(raster::usable(K[j]), kOp, ": Ks must be finite and at most 1e15; got ", K[j], " for image ", i);
    check(K[0] > 0 && K[4] > 0, kOp, ": focal lengths in Ks must be positive; got ", K[0], " and ", K[4],
          " for image ", i);
    for (int j = 0; s.distortion && j < kDistortion; ++j)
      check(raster::usable(s.distortion[kDistortion * i + j]), kOp, ": distortion must be finite; got ",
            s.distortion[kDistortion * i + j], " for image ", i);
    check(s.cu_pairs[i] == pair, kOp, ": cu_pairs must begin at 0 and count the rows of each image's cloud; got ",
          s.cu_pairs[i], " for image ", i);
    views.push_back(view_of(s, i, s.cu_rows[cloud], s.cu_rows[cloud + 1]));
    pair += s.cu_rows[cloud + 1] - s.cu_rows[cloud];
  }
  check(s.cu_pairs[s.n_images] == pair && s.n_pairs == pair, kOp, ": n_pairs must be ", pair, "; got ", s.n_pairs);
  return views;
}

// A run of rows of one cloud.
struct Chunk {
  int64_t cloud, begin, end;
};

template <typename T>
std::vector<Chunk> chunks_of(const ProjectionScene<T>& s) {
  std::vector<Chunk> chunks;
  for (int64_t q = 0; q < s.n_clouds; ++q)
    for (int64_t row = s.cu_rows[q]; row < s.cu_rows[q + 1]; row += kRowsPerChunk)
      chunks.push_back({q, row, std::min(s.cu_rows[q + 1], row + kRowsPerChunk)});
  return chunks;
}

}  // namespace

template <typename T>
void project_forward(const ProjectionScene<T>& s, const ProjectionPairs<T>& pairs, const Parallel& parallel) {
  const std::vector<View<T>> views = checked_views(s);
  const std::vector<Chunk> chunks = chunks_of(s);
  parallel.chunks(static_cast<int64_t>(chunks.size()), [&](int64_t c) {
    const Chunk& chunk = chunks[c];
    for (int64_t i = 0; i < s.n_images; ++i) {
      if (s.image_cloud[i] != chunk.cloud) continue;
      for (int64_t row = chunk.begin; row < chunk.end; ++row) write_pair(s, views[i], row, pairs);
    }
  });
}

template <typename T>
void project_backward(const ProjectionScene<T>& s, const ProjectionPairGrads<T>& pair_grads,
                      const ProjectionSceneGrads<T>& grads, const Workspace& workspace, const Parallel& parallel) {
  const std::vector<View<T>> views = checked_views(s);
  const std::vector<Chunk> chunks = chunks_of(s);
  const auto n_chunks = static_cast<int64_t>(chunks.size());
  const bool of_cameras = grads.viewmats || grads.Ks;
  T* parts = nullptr;  // [chunks, images, kCameraValues]
  if (of_cameras) {
    const int64_t n = n_chunks * s.n_images * kCameraValues;
    parts = workspace.take<T>(std::max<int64_t>(1, n));
    std::fill_n(parts, n, T(0));
  }
  parallel.chunks(n_chunks, [&](int64_t c) {
    const Chunk& chunk = chunks[c];
    for (int64_t row = chunk.begin; row < chunk.end; ++row) {
      const Shape<T> shape = shape_of(s, row);
      RowGrad<T> grad{};
      for (int64_t i = 0; i < s.n_images; ++i) {
        if (s.image_cloud[i] != chunk.cloud) continue;
        T* part = of_cameras ? parts + (c * s.n_images + i) * kCameraValues : nullptr;
        read_pair_vjp(s, views[i], row, shape, pair_grads, grad, part, grads.Ks ? part + 12 : nullptr);
      }
      write_row_grad(grads, row, shape, grad);
    }
  });
  for (int64_t i = 0; i < s.n_images && of_cameras; ++i) {
    T sums[kCameraValues] = {};
    for (int64_t c = 0; c < n_chunks; ++c)
      for (int v = 0; v < kCameraValues; ++v) sums[v] += parts[(c * s.n_images + i) * kCameraValues + v];
    write_camera_grad(grads, i, sums);
  }
}

template <typename T>
void sh_forward(const T* directions, const T* sh, T* color, const ShSizes& n, const Parallel& parallel) {
  dispatch_terms(n.n_terms, [&](auto terms) {
    constexpr int kTerms = decltype(terms)::value;
    const int64_t rows = n.n_batches * n.n_rows;
    parallel.chunks((rows + kRowsPerChunk - 1) / kRowsPerChunk, [&](int64_t c) {
      for (int64_t row = c * kRowsPerChunk; row < std::min(rows, (c + 1) * kRowsPerChunk); ++row)
        for (int64_t v = 0; v < n.n_views; ++v) {
          const int64_t at = (row / n.n_rows * n.n_views + v) * n.n_rows + row % n.n_rows;
          sh_row<T, kTerms>(directions + 3 * at, sh + row * kTerms * n.n_channels, n.n_channels,
                            color + at * n.n_channels);
        }
    });
  });
}

template <typename T>
void sh_backward(const T* grad, const T* directions, const T* sh, T* grad_directions, T* grad_sh, const ShSizes& n,
                 const Parallel& parallel) {
  dispatch_terms(n.n_terms, [&](auto terms) {
    constexpr int kTerms = decltype(terms)::value;
    const int64_t rows = n.n_batches * n.n_rows, width = kTerms * n.n_channels;
    parallel.chunks((rows + kRowsPerChunk - 1) / kRowsPerChunk, [&](int64_t c) {
      for (int64_t row = c * kRowsPerChunk; row < std::min(rows, (c + 1) * kRowsPerChunk); ++row) {
        std::fill_n(grad_sh + row * width, width, T(0));
        for (int64_t v = 0; v < n.n_views; ++v) {
          const int64_t at = (row / n.n_rows * n.n_views + v) * n.n_rows + row % n.n_rows;
          sh_row_vjp<T, kTerms>(directions + 3 * at, sh + row * width, n.n_channels, grad + at * n.n_channels,
                                grad_directions + 3 * at, grad_sh + row * width);
        }
      }
    });
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                      \
  template void project_forward<T>(const ProjectionScene<T>&, const ProjectionPairs<T>&, const Parallel&);         \
  template void project_backward<T>(const ProjectionScene<T>&, const ProjectionPairGrads<T>&,                      \
                                    const ProjectionSceneGrads<T>&, const Workspace&, const Parallel&);            \
  template void sh_forward<T>(const T*, const T*, T*, const ShSizes&, const Parallel&);                            \
  template void sh_backward<T>(const T*, const T*, const T*, T*, T*, const ShSizes&, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
