// Inside of the CUDA rasterizer: records of all pairs, and the number of entries of every tile.
#pragma once

#include <type_traits>

#include "gsim3d/raster/raster_walk.cuh"

namespace gsim3d::raster {

template <typename T>
struct Gaussian {
  T mean[3], quat[4], scale[3], opacity;
  Axes<T> axes;

  __device__ Gaussian(const RasterScene<T>& s, int64_t row) {
    for (int i = 0; i < 3; ++i) mean[i] = s.means[3 * row + i];
    for (int i = 0; i < 4; ++i) quat[i] = s.quats[4 * row + i];
    for (int i = 0; i < 3; ++i) scale[i] = s.scales[3 * row + i];
    opacity = s.opacities[row];
    axes = axes_of(quat, scale);
  }

  __device__ bool is_good() const {
    bool good = opacity >= 0 && opacity <= 1;
    for (int i = 0; i < 3; ++i) good &= usable(mean[i]) && usable(scale[i]) && scale[i] >= 0;
    for (int i = 0; i < 4; ++i) good &= isfinite(quat[i]);
    return good;
  }
};

// One that is projected already.
template <typename T>
struct FlatGaussian {
  T mean[2], conic[3], depth, opacity;

  __device__ FlatGaussian(const RasterScene<T>& s, int64_t row) {
    for (int i = 0; i < 2; ++i) mean[i] = s.means2d[2 * row + i];
    for (int i = 0; i < 3; ++i) conic[i] = s.conics[3 * row + i];
    depth = s.depths[row], opacity = s.opacities[row];
  }

  __device__ bool is_good() const {
    return opacity >= 0 && opacity <= 1 && usable(mean[0]) && usable(mean[1]) && usable(depth) && depth > 0 &&
           conic_is_good(conic[0], conic[1], conic[2]);
  }
};

template <typename T, int kTerms>
using GaussianOf = std::conditional_t<kTerms == kProjected, FlatGaussian<T>, Gaussian<T>>;

template <typename T, int kTerms>
__device__ PixelRect make_record(const RasterScene<T>& s, const Camera<T>&, const FlatGaussian<T>& gaussian, T level,
                                 T strength, const T* color, Record<T>& record) {
  const T *mean = gaussian.mean, *conic = gaussian.conic;
  const Covariance<T> covariance = covariance_of_conic(conic[0], conic[1], conic[2]);
  const Footprint<T> shape = footprint_of_conic(conic[0], conic[1], conic[2]);
  if (!isfinite(covariance.determinant) || !(shape.loose > 0)) return {};
  const PixelRect bounds = pixel_bounds(mean[0], mean[1], covariance.xx, covariance.yy, covariance.determinant, level,
                                        s.width, s.height, false);
  if (bounds.x0 >= bounds.x1) return {};
  record.x = mean[0], record.y = mean[1], record.z = gaussian.depth, record.slope = shape.slope;
  record.tight = fast_sqrt(shape.tight * T(kLog2eHalf)), record.loose = fast_sqrt(shape.loose * T(kLog2eHalf));
  record.strength = strength;
  record.x0 = bounds.x0, record.x1 = bounds.x1, record.y0 = bounds.y0, record.y1 = bounds.y1;
  record.red = color[0], record.green = color[1], record.blue = color[2];
  return bounds;
}

// Empty bounds where the Gaussian is not seen; the record is then unset. The CPU refuses rows that are not good; here
// they are left out.
template <typename T, int kTerms>
__device__ PixelRect make_record(const RasterScene<T>& s, const Camera<T>& camera, const Gaussian<T>& gaussian,
                                 T level, T strength, const T* coefficients, Record<T>& record) {
  const Projection<T> p = project(camera, gaussian.mean, gaussian.axes);
  if (!(p.z > camera.near_plane) || !isfinite(p.determinant)) return {};
  const PixelRect bounds = pixel_bounds(p.x, p.y, p.xx, p.yy, p.determinant, level, s.width, s.height,
                                        s.cutoff == RasterCutoff::kTile3Sigma);
  if (bounds.x0 >= bounds.x1) return {};
  const T inverse = fast_reciprocal(p.yy);  // as footprint_of, but for rounding
  record.x = p.x, record.y = p.y, record.z = p.z, record.slope = p.xy * inverse;
  record.tight = fast_sqrt(p.yy / p.determinant * T(kLog2eHalf)), record.loose = fast_sqrt(inverse * T(kLog2eHalf));
  record.strength = strength;
  record.x0 = bounds.x0, record.x1 = bounds.x1, record.y0 = bounds.y0, record.y1 = bounds.y1;
  if constexpr (kTerms > 0) {
    T basis[kTerms], color[3];
    sh_basis<kTerms>(view_direction(camera, p.point).unit, basis);
    sh_color<kTerms>(basis, coefficients, color);
    record.red = color[0], record.green = color[1], record.blue = color[2];
  } else {
    record.red = coefficients[0], record.green = coefficients[1], record.blue = coefficients[2];
  }
  return bounds;
}

// A chunk of rows of a matrix with kColumns columns in shared memory, read and written by the block as a whole.
template <typename T, int kColumns>
class SharedRows {
 public:
  static constexpr int kStride = kColumns | 1;  // odd: the same column of 32 rows lies in 32 banks
  static constexpr size_t kBytes = sizeof(T) * kBlock * kStride;

  __device__ explicit SharedRows(unsigned char* memory) : memory_(reinterpret_cast<T*>(memory)) {}
  __device__ T* mine() const { return memory_ + threadIdx.x * kStride; }

  __device__ void load(const T* rows, int count) const {
    __syncthreads();
    for (int i = threadIdx.x; i < count * kColumns; i += kBlock) at(i) = rows[i];
    __syncthreads();
  }
  __device__ void store(T* rows, int count) const {
    __syncthreads();
    for (int i = threadIdx.x; i < count * kColumns; i += kBlock) rows[i] = at(i);
    __syncthreads();
  }

 private:
  __device__ T& at(int i) const { return memory_[i / kColumns * kStride + i % kColumns]; }

  T* memory_;
};

template <int kTerms>
constexpr int kColorColumns = kTerms > 0 ? kTerms * 3 : 3;

// Counts the entries of every tile of an image that the bounds of a warp touch.
template <typename T>
__device__ void count_tiles(const Job<T>& job, int64_t image, const PixelRect& bounds, Walked<Nothing>* memory) {
  const int64_t first_tile = image * job.n_tiles;
  WarpTiles<Nothing> tiles(bounds, memory);
  tiles.share({});
  for (int base = 0; base < tiles.total; base += kWarp) {
    const auto place = tiles.at(base);
    const auto tile = static_cast<uint32_t>(place.y * job.tiles_x + place.x);
    const unsigned same = tiles.lanes_of(tile, place.used);
    if (__ffs(same) - 1 == static_cast<int>(threadIdx.x % kWarp)) {
      const auto n = static_cast<uint32_t>(__popc(same));
      if (job.is_active(first_tile + tile)) atomicAdd(job.cursor + first_tile + tile, n);
      if (job.covered) atomicAdd(job.covered + first_tile + tile, n);
    }
  }
}

// One array for all numbers of SH terms.
__device__ inline Walked<Nothing>* walked_memory() {
  __shared__ Walked<Nothing> walked[kBlock];
  return walked;
}

// `memory`: SharedRows of the colours.
template <typename T, int kTerms>
__device__ void project_rows(const Job<T>& job, unsigned char* memory) {
  const RasterScene<T>& s = job.scene;
  constexpr int kColumns = kColorColumns<kTerms>;
  Walked<Nothing>* const walked = walked_memory();
  const SharedRows<T, kColumns> colors(memory);
  const int64_t last = job.group->last, n_chunks = count_chunks(job);
  const int lane = threadIdx.x % kWarp;
  for (int64_t chunk = blockIdx.x; chunk < n_chunks; chunk += gridDim.x) {
    const Rows rows(job, chunk);
    if (rows.first_image >= last) continue;
    colors.load(s.color + rows.begin * kColumns, rows.count);
    const T* coefficients = colors.mine();
    const int64_t row = rows.inside ? rows.row : rows.begin;
    const GaussianOf<T, kTerms> gaussian(s, row);
    bool good = rows.inside && gaussian.is_good();
    for (int i = 0; i < kColumns && good; ++i) good &= usable(coefficients[i]);
    for (int64_t i = 0; i < s.n_features; ++i) good &= usable(s.features[row * s.n_features + i]);
    const bool may_show = good && gaussian.opacity >= T(kMinAlpha);
    const T level = level_of(gaussian.opacity), strength = log2(gaussian.opacity);
    for (int64_t image = rows.first_image; image < last; image = job.views[image].next) {
      const View<T>& view = job.views[image];
      const int64_t pair = job.pair_begin[image] + row - view.row_begin;
      PixelRect bounds{};
      if (may_show) {
        Record<T> record;
        bounds = make_record<T, kTerms>(s, view.camera, gaussian, level, strength, coefficients, record);
        if (bounds.x0 < bounds.x1) store_record(record, job.records + pair), job.depths[pair] = record.z;
      }
      if (rows.inside) job.bounds[pair] = bounds;
      count_tiles(job, image, bounds, walked + threadIdx.x / kWarp * kWarp);
      const uint32_t slots = __reduce_add_sync(kFullWarp, static_cast<uint32_t>(squares_of(bounds, kQuarter).count()));
      if (lane == 0 && slots) atomicAdd(job.slot_count + image, static_cast<unsigned long long>(slots));
    }
  }
}

}  // namespace gsim3d::raster
