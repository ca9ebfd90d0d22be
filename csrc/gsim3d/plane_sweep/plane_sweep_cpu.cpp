#include "gsim3d/plane_sweep/plane_sweep.h"

#include <cmath>
#include <limits>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/plane_sweep/plane_sweep_math.h"

namespace gsim3d::cpu {
namespace {

using namespace plane_sweep_math;

// One vector register of the baseline; channels are padded with zeros to whole vectors.
template <typename T>
constexpr int64_t kLanes = 32 / sizeof(T);
template <typename T>
struct VectorOf {
  typedef T type __attribute__((vector_size(32), aligned(alignof(T)), may_alias));
};
template <typename T>
using Vector = typename VectorOf<T>::type;

template <typename T>
const Vector<T>& load(const T* from) {
  return *reinterpret_cast<const Vector<T>*>(from);
}
template <typename T>
Vector<T>& at(T* to) {
  return *reinterpret_cast<Vector<T>*>(to);
}

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

// out[i] = <a, b[i]>: four at a time hide each other's latency and share the loads of a.
template <typename T>
void dot_four(const T* a, const T* const (&b)[4], int64_t n, T (&out)[4]) {
  Vector<T> s0 = {}, s1 = {}, s2 = {}, s3 = {};
  for (int64_t c = 0; c < n; c += kLanes<T>) {
    const Vector<T> va = load(a + c);
    s0 += va * load(b[0] + c);
    s1 += va * load(b[1] + c);
    s2 += va * load(b[2] + c);
    s3 += va * load(b[3] + c);
  }
  const Vector<T> sums[4] = {s0, s1, s2, s3};
  for (int i = 0; i < 4; ++i) {
    out[i] = sums[i][0];
    for (int64_t lane = 1; lane < kLanes<T>; ++lane) out[i] += sums[i][lane];
  }
}

// to[c] += factor * from[c].
template <typename T>
void add_scaled(T* to, const T* from, T factor, int64_t n) {
  for (int64_t c = 0; c < n; c += kLanes<T>) at(to + c) += load(from + c) * factor;
}

// to[c] += sum over i of factors[i] * rows[places[i] * stride + c].
template <typename T>
void add_scaled_rows(T* to, const T* rows, const int32_t* places, const T* factors, int64_t count, int64_t stride) {
  for (int64_t c = 0; c < stride; c += kLanes<T>) {
    Vector<T> sum = at(to + c);
    for (int64_t i = 0; i < count; ++i) sum += load(rows + places[i] * stride + c) * factors[i];
    at(to + c) = sum;
  }
}

// Follows one pixel after another along its line of samples in a source image.
template <typename T>
class Walker {
 public:
  explicit Walker(const PlaneSweep<T>& sweep)
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
        const int64_t place = (v + 1) * stride_ + u + 1;
        stamp_[place] = 0;
        pixel_[place] = static_cast<int32_t>(v * sweep.width + u);
      }
  }

  void start_image(int64_t image) {
    const T* inverse = sweep_.inverse_depths + image * sweep_.n_depths;
    for (int64_t k = 0; k < sweep_.n_depths; ++k) depths_[k] = T(1) / inverse[k];
  }

  // costs[k] += score at depth k. feature: [stride], source: [height * width, stride].
  void add_costs(int64_t pair, int64_t pixel, const T* feature, const T* source, int64_t stride, T* costs) {
    locate(pair, pixel);
    for_cells([&](int32_t corner) {
      touch(corner);
      touch(corner + 1);
      touch(corner + stride_);
      touch(corner + stride_ + 1);
    });
    const int64_t count = static_cast<int64_t>(touched_.size());
    for (int64_t first = 0; first < count; first += 4) {
      int32_t places[4];
      const T* rows[4];
      T scores[4];
      for (int64_t i = 0; i < 4; ++i) {
        places[i] = touched_[std::min(first + i, count - 1)];
        rows[i] = source + pixel_[places[i]] * stride;
      }
      dot_four(feature, rows, stride, scores);
      for (int64_t i = 0; i < 4; ++i) table_[places[i]] = scores[i];
    }
    const T* GSIM3D_RESTRICT table = table_.data();
    for (int64_t k = 0; k < sweep_.n_depths; ++k) {
      const T* top = table + corners_[k];
      costs[k] += interpolate(top[0], top[1], top[stride_], top[stride_ + 1], fx_[k], fy_[k]);
    }
  }

  // The source pixels that the costs of one pixel read, and scale times the gradients of their scores.
  void find_score_grads(int64_t pair, int64_t pixel, const T* grads, T scale) {
    locate(pair, pixel);
    int64_t k = 0;
    T g00, g01, g10, g11;
    for_cells([&](int32_t corner) {
      while (corners_[k] != corner) ++k;  // samples outside
      g00 = g01 = g10 = g11 = T(0);
      for (; k < sweep_.n_depths && corners_[k] == corner; ++k)
        interpolate_vjp(g00, g01, g10, g11, fx_[k], fy_[k], grads[k]);
      add_grad(corner, g00);
      add_grad(corner + 1, g01);
      add_grad(corner + stride_, g10);
      add_grad(corner + stride_ + 1, g11);
    });
    weights_.resize(touched_.size());
    for (size_t i = 0; i < touched_.size(); ++i) {
      weights_[i] = table_[touched_[i]] * scale;
      touched_[i] = pixel_[touched_[i]];
    }
  }

  int64_t count() const { return static_cast<int64_t>(touched_.size()); }
  const int32_t* pixels() const { return touched_.data(); }
  const T* weights() const { return weights_.data(); }

 private:
  static constexpr int64_t kBorder = std::numeric_limits<int64_t>::max();  // always up to date

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

  // f(corner) for every run of samples in one cell inside the image; starts a new list of touched pixels.
  template <typename F>
  void for_cells(const F& f) {
    ++epoch_;
    touched_.clear();
    int32_t last = outside_;
    for (int64_t k = 0; k < sweep_.n_depths; ++k) {
      const int32_t corner = corners_[k];
      if (corner != last && corner != outside_) f(corner);
      last = corner;
    }
  }

  void touch(int32_t place) {
    if (stamp_[place] >= epoch_) return;
    stamp_[place] = epoch_;
    touched_.push_back(place);
  }

  // The border collects what is not asked for.
  void add_grad(int32_t place, T grad) {
    if (stamp_[place] < epoch_) {
      stamp_[place] = epoch_;
      table_[place] = T(0);
      touched_.push_back(place);
    }
    table_[place] += grad;
  }

  const PlaneSweep<T>& sweep_;
  const int32_t stride_, outside_;
  std::vector<int32_t> corners_;
  std::vector<T> fx_, fy_, depths_;
  std::vector<T> table_;         // scores, 0 on the border; or gradients of scores
  std::vector<int64_t> stamp_;   // the step at which table_ was last filled
  std::vector<int32_t> pixel_;   // of the source image; -1 on the border
  std::vector<int32_t> touched_;
  std::vector<T> weights_;
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
  check_sizes(op, sweep);
  check(sweep.cu_src[0] == 0 && sweep.cu_src[n] == sweep.n_pairs, op, ": cu_src must run from 0 to len(src_images)=",
        sweep.n_pairs, "; got ", sweep.cu_src[0], " .. ", sweep.cu_src[n]);
  for (int64_t i = 0; i < n; ++i)
    check(sweep.cu_src[i] <= sweep.cu_src[i + 1], op, ": cu_src must not descend; got ", sweep.cu_src[i], " then ",
          sweep.cu_src[i + 1], " at ", i);
  for (int64_t p = 0; p < sweep.n_pairs; ++p) {
    const int64_t source = sweep.src_images[p];
    check(source >= 0 && source < n, op, ": src_images must be in [0, I) with I=", n, "; got ", source, " at ", p);
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
        walker.add_costs(pair, pixel, feature, pixels + sweep.src_images[pair] * n_pixels * stride, stride,
                         costs.data());
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
        walker.find_score_grads(pair, pixel, grad_costs + (image * n_pixels + pixel) * grad_stride, scale);
        add_scaled_rows(out + pixel * stride, source, walker.pixels(), walker.weights(), walker.count(), stride);
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
          walker.find_score_grads(pair, pixel, grad_costs + (image * n_pixels + pixel) * grad_stride, scale);
          for (int64_t i = 0; i < walker.count(); ++i)
            add_scaled(out + walker.pixels()[i] * stride, feature, walker.weights()[i], count);
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
