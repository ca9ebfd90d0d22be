#include "gsim3d/plane_sweep/plane_sweep.h"

#include <cmath>
#include <limits>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/plane_sweep/plane_sweep_math.h"

namespace gsim3d::cpu {
namespace {

using namespace plane_sweep_math;

// Channels are padded with zeros to whole vectors of 64 bytes.
template <typename T>
constexpr int64_t kLanes = 64 / sizeof(T);
template <typename T>
struct Vector {
  typedef T type __attribute__((vector_size(64), aligned(alignof(T)), may_alias));
};

constexpr int64_t kPixelsPerChunk = 128;   // one chunk of pixels is about 50 us of work
constexpr int64_t kChannelsPerChunk = 64;  // of one source image in the backward pass

template <typename T>
int64_t padded(int64_t channels) {
  return (channels + kLanes<T> - 1) / kLanes<T> * kLanes<T>;
}

// [n, rows, cols] -> [n, cols, padded rows], zeros in the padding.
template <typename T>
void to_pixels(const T* planes, int64_t n, int64_t rows, int64_t cols, T* pixels, const Parallel& parallel) {
  const int64_t stride = padded<T>(rows);
  parallel.range(n * cols, 256, [&](int64_t begin, int64_t end) {
    for (int64_t at = begin; at < end; ++at) {
      const T* from = planes + at / cols * rows * cols + at % cols;
      T* to = pixels + at * stride;
      for (int64_t r = 0; r < rows; ++r) to[r] = from[r * cols];
      for (int64_t r = rows; r < stride; ++r) to[r] = T(0);
    }
  });
}

// [n, cols, padded rows] -> [n, rows, cols].
template <typename T>
void to_planes(const T* pixels, int64_t n, int64_t rows, int64_t cols, T* planes, const Parallel& parallel) {
  const int64_t stride = padded<T>(rows);
  parallel.range(n * rows, 8, [&](int64_t begin, int64_t end) {
    for (int64_t at = begin; at < end; ++at) {
      const T* from = pixels + at / rows * cols * stride + at % rows;
      T* to = planes + at * cols;
      for (int64_t c = 0; c < cols; ++c) to[c] = from[c * stride];
    }
  });
}

template <typename T>
T dot(const T* a, const T* b, int64_t n) {
  using V = typename Vector<T>::type;
  V sum = {};
  for (int64_t c = 0; c < n; c += kLanes<T>)
    sum += *reinterpret_cast<const V*>(a + c) * *reinterpret_cast<const V*>(b + c);
  for (int64_t width = kLanes<T> / 2; width > 0; width /= 2)
    for (int64_t lane = 0; lane < width; ++lane) sum[lane] += sum[lane + width];
  return sum[0];
}

template <typename T>
void add_scaled(T* to, const T* from, T factor, int64_t n) {
  using V = typename Vector<T>::type;
  for (int64_t c = 0; c < n; c += kLanes<T>)
    *reinterpret_cast<V*>(to + c) += *reinterpret_cast<const V*>(from + c) * factor;
}

// What one thread needs for one pixel after another.
template <typename T>
class Walker {
 public:
  Walker(const PlaneSweep<T>& sweep)
      : sweep_(sweep),
        stride_(static_cast<int32_t>(table_stride(sweep.width))),
        outside_(static_cast<int32_t>(outside_corner(sweep.height, sweep.width))),
        corners_(sweep.n_depths),
        fx_(sweep.n_depths),
        fy_(sweep.n_depths),
        depths_(sweep.n_depths),
        table_(table_size(sweep.height, sweep.width), T(0)),
        stamp_(table_.size(), kBorder),
        pixel_(table_.size(), -1) {
    for (int64_t v = 0; v < sweep.height; ++v)
      for (int64_t u = 0; u < sweep.width; ++u) {
        const int64_t at = (v + 1) * stride_ + u + 1;
        stamp_[at] = 0;
        pixel_[at] = static_cast<int32_t>(v * sweep.width + u);
      }
  }

  void start_image(int64_t image) {
    for (int64_t k = 0; k < sweep_.n_depths; ++k) depths_[k] = T(1) / sweep_.inverse_depths[image * sweep_.n_depths + k];
  }

  // costs[k * step] += score at depth k, for all depths of one pixel and one source.
  void add_costs(int64_t pair, int64_t pixel, const T* feature, const T* source, int64_t channels, T* costs, int64_t step) {
    locate(pair, pixel);
    ++epoch_;
    int32_t corner = outside_;
    T s00 = T(0), s01 = T(0), s10 = T(0), s11 = T(0);
    for (int64_t k = 0; k < sweep_.n_depths; ++k) {
      if (corners_[k] == outside_) continue;
      if (corners_[k] != corner) {
        corner = corners_[k];
        s00 = score(corner, feature, source, channels);
        s01 = score(corner + 1, feature, source, channels);
        s10 = score(corner + stride_, feature, source, channels);
        s11 = score(corner + stride_ + 1, feature, source, channels);
      }
      costs[k * step] += interpolate(s00, s01, s10, s11, fx_[k], fy_[k]);
    }
  }

  // Calls f(source pixel, gradient of its score) for the source pixels that the costs of one pixel read.
  template <typename F>
  void for_score_grads(int64_t pair, int64_t pixel, const T* grads, int64_t step, const F& f) {
    locate(pair, pixel);
    ++epoch_;
    touched_.clear();
    int32_t corner = outside_;
    T g00 = T(0), g01 = T(0), g10 = T(0), g11 = T(0);
    const auto flush = [&] {
      if (corner == outside_) return;
      add_grad(corner, g00);
      add_grad(corner + 1, g01);
      add_grad(corner + stride_, g10);
      add_grad(corner + stride_ + 1, g11);
    };
    for (int64_t k = 0; k < sweep_.n_depths; ++k) {
      if (corners_[k] == outside_) continue;
      if (corners_[k] != corner) {
        flush();
        corner = corners_[k];
        g00 = g01 = g10 = g11 = T(0);
      }
      interpolate_vjp(g00, g01, g10, g11, fx_[k], fy_[k], grads[k * step]);
    }
    flush();
    for (const int32_t at : touched_) f(pixel_[at], table_[at]);
  }

 private:
  static constexpr int64_t kBorder = std::numeric_limits<int64_t>::max();  // always up to date, always 0

  void locate(int64_t pair, int64_t pixel) {
    const T* b = sweep_.translations + 3 * pair;
    const Ray<T> ray = source_ray(sweep_.homographies + 9 * pair, static_cast<T>(pixel % sweep_.width),
                                  static_cast<T>(pixel / sweep_.width));
    const T b_local[3] = {b[0], b[1], b[2]};
    const int32_t height = static_cast<int32_t>(sweep_.height), width = static_cast<int32_t>(sweep_.width);
    const T* GSIM3D_RESTRICT depths = depths_.data();
    int32_t* GSIM3D_RESTRICT corners = corners_.data();
    T* GSIM3D_RESTRICT fx = fx_.data();
    T* GSIM3D_RESTRICT fy = fy_.data();
#pragma omp simd
    for (int64_t k = 0; k < sweep_.n_depths; ++k) {
      const Cell<T> cell = sample_cell(ray, b_local, depths[k], height, width);
      corners[k] = cell.corner;
      fx[k] = cell.fx;
      fy[k] = cell.fy;
    }
  }

  T score(int32_t at, const T* feature, const T* source, int64_t channels) {
    if (stamp_[at] < epoch_) {
      stamp_[at] = epoch_;
      table_[at] = dot(feature, source + pixel_[at] * channels, channels);
    }
    return table_[at];
  }

  void add_grad(int32_t at, T grad) {
    if (stamp_[at] == kBorder) return;
    if (stamp_[at] < epoch_) {
      stamp_[at] = epoch_;
      table_[at] = grad;
      touched_.push_back(at);
    } else {
      table_[at] += grad;
    }
  }

  const PlaneSweep<T>& sweep_;
  const int32_t stride_, outside_;
  std::vector<int32_t> corners_;
  std::vector<T> fx_, fy_, depths_;
  std::vector<T> table_;
  std::vector<int64_t> stamp_;  // the pixel for which table_ was last filled
  std::vector<int32_t> pixel_;  // of the source image; -1 on the border
  std::vector<int32_t> touched_;
  int64_t epoch_ = 0;
};

// 1 / (number of sources * sqrt(C)).
template <typename T>
T cost_scale(const PlaneSweep<T>& sweep, int64_t image) {
  const int64_t n_sources = sweep.cu_src[image + 1] - sweep.cu_src[image];
  return T(1) / (static_cast<T>(n_sources) * std::sqrt(static_cast<T>(sweep.channels)));
}

// f(image, first pixel, end pixel) over all chunks of all images.
template <typename T, typename F>
void for_pixel_chunks(const PlaneSweep<T>& sweep, const Parallel& parallel, const F& f) {
  const int64_t n_pixels = sweep.height * sweep.width;
  const int64_t per_image = (n_pixels + kPixelsPerChunk - 1) / kPixelsPerChunk;
  parallel.chunks(sweep.n_images * per_image, [&](int64_t chunk) {
    const int64_t begin = chunk % per_image * kPixelsPerChunk;
    f(chunk / per_image, begin, std::min(n_pixels, begin + kPixelsPerChunk));
  });
}

}  // namespace

template <typename T>
void check_plane_sweep(const char* op, const PlaneSweep<T>& sweep) {
  const int64_t n = sweep.n_images;
  check(sweep.channels > 0, op, ": features must have at least one channel; got 0");
  check(table_size(sweep.height, sweep.width) < std::numeric_limits<int32_t>::max(), op,
        ": features must have fewer than 2^31 pixels; got ", sweep.height, " x ", sweep.width);
  check(sweep.cu_src[0] == 0 && sweep.cu_src[n] == sweep.n_pairs, op, ": cu_src must run from 0 to len(src_images)=",
        sweep.n_pairs, "; got ", sweep.cu_src[0], " .. ", sweep.cu_src[n]);
  for (int64_t i = 0; i < n; ++i)
    check(sweep.cu_src[i] <= sweep.cu_src[i + 1], op, ": cu_src must not descend; got ", sweep.cu_src[i], " then ",
          sweep.cu_src[i + 1], " at ", i);
  for (int64_t p = 0; p < sweep.n_pairs; ++p) {
    check(sweep.src_images[p] >= 0 && sweep.src_images[p] < n, op, ": src_images must be in [0, I) with I=", n, "; got ",
          sweep.src_images[p], " at ", p);
    for (int64_t e = 0; e < 9; ++e)
      check(std::isfinite(sweep.homographies[9 * p + e]), op, ": homographies must be finite; got ",
            sweep.homographies[9 * p + e], " in pair ", p);
    for (int64_t e = 0; e < 3; ++e)
      check(std::isfinite(sweep.translations[3 * p + e]), op, ": translations must be finite; got ",
            sweep.translations[3 * p + e], " in pair ", p);
  }
  for (int64_t e = 0; e < n * sweep.n_depths; ++e)
    check(std::isfinite(sweep.inverse_depths[e]) && sweep.inverse_depths[e] > 0, op,
          ": inverse_depths must be positive and finite; got ", sweep.inverse_depths[e], " in image ",
          e / sweep.n_depths);
}

template <typename T>
void plane_sweep(const T* features, const PlaneSweep<T>& sweep, T* cost, const Workspace& workspace,
                 const Parallel& parallel) {
  const int64_t n_pixels = sweep.height * sweep.width, stride = padded<T>(sweep.channels);
  T* pixels = workspace.take<T>(sweep.n_images * n_pixels * stride);
  to_pixels(features, sweep.n_images, sweep.channels, n_pixels, pixels, parallel);
  for_pixel_chunks(sweep, parallel, [&](int64_t image, int64_t begin, int64_t end) {
    T* out = cost + image * sweep.n_depths * n_pixels;
    for (int64_t k = 0; k < sweep.n_depths; ++k) std::fill(out + k * n_pixels + begin, out + k * n_pixels + end, T(0));
    if (sweep.cu_src[image] == sweep.cu_src[image + 1]) return;
    Walker<T> walker(sweep);
    walker.start_image(image);
    const T scale = cost_scale(sweep, image);
    std::vector<T> costs(sweep.n_depths);
    for (int64_t pixel = begin; pixel < end; ++pixel) {
      std::fill(costs.begin(), costs.end(), T(0));
      const T* feature = pixels + (image * n_pixels + pixel) * stride;
      for (int64_t pair = sweep.cu_src[image]; pair < sweep.cu_src[image + 1]; ++pair)
        walker.add_costs(pair, pixel, feature, pixels + sweep.src_images[pair] * n_pixels * stride, stride, costs.data(), 1);
      for (int64_t k = 0; k < sweep.n_depths; ++k) out[k * n_pixels + pixel] = costs[k] * scale;
    }
  });
}

template <typename T>
void plane_sweep_vjp(const T* grad, const T* features, const PlaneSweep<T>& sweep, T* grad_features,
                     const Workspace& workspace, const Parallel& parallel) {
  const int64_t n_pixels = sweep.height * sweep.width, stride = padded<T>(sweep.channels), n = sweep.n_images;
  T* pixels = workspace.take<T>(n * n_pixels * stride);
  T* grad_pixels = workspace.take<T>(n * n_pixels * stride);
  T* grad_costs = workspace.take<T>(n * n_pixels * padded<T>(sweep.n_depths));
  to_pixels(features, n, sweep.channels, n_pixels, pixels, parallel);
  to_pixels(grad, n, sweep.n_depths, n_pixels, grad_costs, parallel);
  const int64_t grad_stride = padded<T>(sweep.n_depths);

  // Each image as reference: a pixel gathers from its sources.
  for_pixel_chunks(sweep, parallel, [&](int64_t image, int64_t begin, int64_t end) {
    T* out = grad_pixels + image * n_pixels * stride;
    std::fill(out + begin * stride, out + end * stride, T(0));
    if (sweep.cu_src[image] == sweep.cu_src[image + 1]) return;
    Walker<T> walker(sweep);
    walker.start_image(image);
    const T scale = cost_scale(sweep, image);
    for (int64_t pixel = begin; pixel < end; ++pixel)
      for (int64_t pair = sweep.cu_src[image]; pair < sweep.cu_src[image + 1]; ++pair) {
        const T* source = pixels + sweep.src_images[pair] * n_pixels * stride;
        walker.for_score_grads(pair, pixel, grad_costs + (image * n_pixels + pixel) * grad_stride, 1,
                               [&](int64_t at, T weight) {
                                 add_scaled(out + pixel * stride, source + at * stride, weight * scale, stride);
                               });
      }
  });

  // Each image as source: the owner of its channels collects from every pair that reads it.
  const int64_t blocks = (stride + kChannelsPerChunk - 1) / kChannelsPerChunk;
  parallel.chunks(n * blocks, [&](int64_t chunk) {
    const int64_t source = chunk / blocks, first = chunk % blocks * kChannelsPerChunk;
    const int64_t count = std::min(kChannelsPerChunk, stride - first);
    T* out = grad_pixels + source * n_pixels * stride + first;
    Walker<T> walker(sweep);
    for (int64_t image = 0; image < n; ++image)
      for (int64_t pair = sweep.cu_src[image]; pair < sweep.cu_src[image + 1]; ++pair) {
        if (sweep.src_images[pair] != source) continue;
        walker.start_image(image);
        const T scale = cost_scale(sweep, image);
        for (int64_t pixel = 0; pixel < n_pixels; ++pixel) {
          const T* feature = pixels + (image * n_pixels + pixel) * stride + first;
          walker.for_score_grads(pair, pixel, grad_costs + (image * n_pixels + pixel) * grad_stride, 1,
                                 [&](int64_t at, T weight) {
                                   add_scaled(out + at * stride, feature, weight * scale, count);
                                 });
        }
      }
  });
  to_planes(grad_pixels, n, sweep.channels, n_pixels, grad_features, parallel);
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template void check_plane_sweep<T>(const char*, const PlaneSweep<T>&);                                             \
  template void plane_sweep<T>(const T*, const PlaneSweep<T>&, T*, const Workspace&, const Parallel&);               \
  template void plane_sweep_vjp<T>(const T*, const T*, const PlaneSweep<T>&, T*, const Workspace&, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
