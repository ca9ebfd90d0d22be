// Inside of the CUDA rasterizer: projection, and the list of every tile in order of depth.
//
// Images are rendered in groups: whole images, as many as the scratch holds, or a run of the tiles of one large image.
// What fits is decided on the device, so nothing waits for it. Every (row, image) pair of a group owns a Record; every
// tile of 8 x 8 pixels owns a run of entries, one for each record that may touch it. Tiles of all images are numbered
// through. A phase is a function that any number of blocks may share.
#pragma once

#include <cmath>
#include <cstdint>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_math.h"

namespace gsim3d::raster {

using cuda::kFullWarp;
using cuda::kWarp;

constexpr int kBlock = 128;     // threads of a block in the phases that many blocks share
constexpr int kSpot = 8;        // pixels; side of the tiles of the lists
constexpr int kSortRun = 1024;  // entries sorted in shared memory at once
constexpr int32_t kNoImage = INT32_MAX;

// What a tile needs of one Gaussian in one image.
template <typename T>
struct alignas(16) Record {
  T x, y, slope, tight;  // pixels; Footprint, tight and loose times log2(e) / 2, as in the CPU's Splat
  T loose, opacity, z;
  uint16_t x0, x1;  // pixels that may see it, as PixelRect; x0 = x1 = 0 when it is left out
  T red, green, blue;
  uint16_t y0, y1;
};

// Tiles [x0, x1) x [y0, y1) of an image.
struct Spots {
  int x0, x1, y0, y1;
  __device__ int count() const { return (x1 - x0) * (y1 - y0); }
  // How many of them come before tile (x, y), row by row.
  __device__ int before(int x, int y) const {
    const int rows = min(max(y - y0, 0), y1 - y0), columns = min(max(x - x0, 0), x1 - x0);
    return rows * (x1 - x0) + (y >= y0 && y < y1 ? columns : 0);
  }
};

template <typename T>
__device__ __forceinline__ Spots spots_of(const Record<T>& record) {
  if (record.x0 >= record.x1) return {0, 0, 0, 0};
  return {record.x0 / kSpot, (record.x1 + kSpot - 1) / kSpot, record.y0 / kSpot, (record.y1 + kSpot - 1) / kSpot};
}

// A record's place in a tile's list: by the bits of its positive depth, which ascend with it, then by pair, which
// ascends with the row.
template <typename T>
struct Entry;

template <>
struct Entry<float> {
  uint64_t word;
  __device__ static Entry make(float z, uint32_t pair) { return {uint64_t{__float_as_uint(z)} << 32 | pair}; }
  __device__ static Entry last() { return {~uint64_t{0}}; }
  __device__ uint32_t pair() const { return static_cast<uint32_t>(word); }
  __device__ bool operator<(const Entry& other) const { return word < other.word; }
};

template <>
struct alignas(16) Entry<double> {
  uint64_t key;
  uint64_t row;
  __device__ static Entry make(double z, uint32_t pair) {
    return {static_cast<uint64_t>(__double_as_longlong(z)), pair};
  }
  __device__ static Entry last() { return {~uint64_t{0}, ~uint64_t{0}}; }
  __device__ uint32_t pair() const { return static_cast<uint32_t>(row); }
  __device__ bool operator<(const Entry& other) const {
    return key < other.key || (key == other.key && row < other.row);
  }
};

struct Cloud {
  int64_t chunk_begin;  // chunks of kBlock rows of all clouds before
  int32_t first;        // first image that shows it, or kNoImage
};

template <typename T>
struct View {
  Camera<T> camera;
  int64_t row_begin, row_end;  // empty when the camera or the cloud cannot be rendered
  int32_t next;                // the next image of the same cloud, or kNoImage
};
static_assert(sizeof(View<float>) == 112 && sizeof(View<double>) == 200);  // gsim3d/ops/raster.py counts with them

// The group in work; on the device.
struct Group {
  int64_t first, last;            // images
  int64_t spot_begin, spot_end;   // tiles: of all of these images, or a run of one image's
  int x_begin, y_begin, x_end, y_end;  // of tiles spot_begin and spot_end
  bool resumed, finished;         // the first image was begun by an earlier group; the last one is completed
  bool rows_are_good;             // cu_rows runs from 0 to N without descending

  // Of the tiles of a record those of this group: how many, and which place tile (x, y) has among them.
  __device__ int count(const Spots& spots) const {
    return (finished ? spots.count() : spots.before(x_end, y_end)) - (resumed ? spots.before(x_begin, y_begin) : 0);
  }
  __device__ int place(const Spots& spots, int x, int y) const {
    return spots.before(x, y) - (resumed ? spots.before(x_begin, y_begin) : 0);
  }
};

// Everything the phases read and write; passed to kernels by value. `views` and `clouds` are made once; the rest
// belongs to the group in work.
template <typename T>
struct Job {
  RasterScene<T> scene;
  int64_t spots_x, n_spots;        // tiles in a row of tiles, in an image
  int64_t max_pairs, max_entries;  // what the arrays below hold; both at least n_rows and below 2^31
  View<T>* views;                  // [n_images]
  Cloud* clouds;                   // [n_clouds]
  Group* group;
  int32_t* pair_begin;      // [n_images] index of the first row's record
  Record<T>* records;       // [max_pairs]
  uint32_t* slot_begin;     // [max_pairs] first of the pair's slots of the backward pass
  uint32_t* slot_cursor;    // [n_images] slots handed out
  uint32_t* spot_begin;     // [n_images * n_spots + 1] into entries
  uint32_t* cursor;         // [n_images * n_spots] counts, then write positions
  Entry<T>* entries;        // [max_entries]
  Entry<T>* spare;          // [max_entries]
};

// ---- plan: cameras and the images of each cloud; one block --------------------------------------------------------

template <typename T>
__device__ bool camera_is_good(const T* viewmat, const T* K) {
  bool good = true;
  for (int i = 0; i < 12; ++i) good &= isfinite(viewmat[i]);
  for (int i = 0; i < 9; ++i) good &= isfinite(K[i]);
  return good && K[0] > 0 && K[4] > 0 && K[3] == 0 && K[6] == 0 && K[7] == 0 && K[8] == 1;
}

// Inclusive sum over the threads of a block of up to 1024; `total` is the sum over all of them.
__device__ inline uint64_t block_sum(uint64_t value, uint64_t& total) {
  __shared__ uint64_t warp_sums[kWarp];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  for (int step = 1; step < kWarp; step *= 2) {
    const uint64_t other = __shfl_up_sync(kFullWarp, value, step);
    if (lane >= step) value += other;
  }
  __syncthreads();
  if (lane == kWarp - 1) warp_sums[warp] = value;
  __syncthreads();
  uint64_t before = 0;
  total = 0;
  for (int w = 0; w < static_cast<int>(blockDim.x) / kWarp; ++w) {
    before += w < warp ? warp_sums[w] : 0;
    total += warp_sums[w];
  }
  return value + before;
}

template <typename T>
__device__ void plan(const Job<T>& job) {
  const RasterScene<T>& s = job.scene;
  bool good = s.cu_rows[0] == 0 && s.cu_rows[s.n_clouds] == s.n_rows;
  for (int64_t q = threadIdx.x; q < s.n_clouds; q += blockDim.x) good &= s.cu_rows[q] <= s.cu_rows[q + 1];
  good = __syncthreads_and(good);
  if (threadIdx.x == 0) *job.group = Group{.rows_are_good = good};
  uint64_t before = 0;
  for (int64_t base = 0; base < s.n_clouds; base += blockDim.x) {
    const int64_t q = base + threadIdx.x;
    const uint64_t n = good && q < s.n_clouds ? (s.cu_rows[q + 1] - s.cu_rows[q] + kBlock - 1) / kBlock : 0;
    uint64_t total;
    const uint64_t end = before + block_sum(n, total);
    if (q < s.n_clouds) job.clouds[q] = {static_cast<int64_t>(end - n), kNoImage};
    before += total;
  }
  __syncthreads();
  for (int64_t i = threadIdx.x; i < s.n_images; i += blockDim.x) {
    View<T>& view = job.views[i];
    view = {};
    view.next = kNoImage;
    const int64_t cloud = s.image_cloud[i];
    if (!good || !cuda::inside(cloud, s.n_clouds) || !camera_is_good(s.viewmats + 16 * i, s.Ks + 9 * i)) continue;
    view.camera = make_camera(s.viewmats + 16 * i, s.Ks + 9 * i, s.width, s.height, s.near_plane);
    view.row_begin = s.cu_rows[cloud], view.row_end = s.cu_rows[cloud + 1];
    atomicMin(&job.clouds[cloud].first, static_cast<int32_t>(i));
  }
  __syncthreads();
  for (int64_t i = threadIdx.x; i < s.n_images; i += blockDim.x) {
    View<T>& view = job.views[i];
    if (view.row_begin == view.row_end) continue;
    int64_t j = i + 1;
    while (j < s.n_images && !(s.image_cloud[j] == s.image_cloud[i] && job.views[j].row_end > 0)) ++j;
    if (j < s.n_images) view.next = static_cast<int32_t>(j);
  }
}

// ---- choose: the images after the last group whose pairs fit; one block --------------------------------------------

template <typename T>
__device__ void choose_images(const Job<T>& job) {
  const int64_t begin = job.group->spot_end, first = begin / job.n_spots;
  const bool resumed = begin % job.n_spots != 0;
  uint64_t pairs = 0;
  int64_t last = first;
  for (int64_t base = first; base < job.scene.n_images; base += blockDim.x) {
    const int64_t i = base + threadIdx.x;
    const bool inside = i < job.scene.n_images;
    const uint64_t n = inside ? job.views[i].row_end - job.views[i].row_begin : 0;
    uint64_t total;
    const uint64_t end = pairs + block_sum(n, total);
    const bool fits = inside && end <= static_cast<uint64_t>(job.max_pairs);
    if (fits) job.pair_begin[i] = static_cast<int32_t>(end - n);
    const int n_fit = __syncthreads_count(fits);
    last = base + n_fit;
    if (n_fit < static_cast<int>(blockDim.x)) break;
    pairs += total;
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  Group& group = *job.group;
  group.first = first, group.last = resumed ? first + 1 : last;
  group.spot_begin = begin;
  group.x_begin = static_cast<int>(begin % job.n_spots % job.spots_x);
  group.y_begin = static_cast<int>(begin % job.n_spots / job.spots_x);
  group.resumed = resumed;
}

// ---- rows: a block takes a chunk of rows of one cloud, a thread a row ---------------------------------------------

struct Rows {
  int64_t row;
  bool inside;
  int64_t first_image;  // of the group, that shows the cloud; kNoImage: none

  template <typename T>
  __device__ Rows(const Job<T>& job, int64_t chunk) {
    const RasterScene<T>& s = job.scene;
    int64_t low = 0, high = s.n_clouds;  // the last cloud that begins at or before the chunk
    while (high - low > 1) {
      const int64_t middle = (low + high) / 2;
      if (job.clouds[middle].chunk_begin <= chunk)
        low = middle;
      else
        high = middle;
    }
    row = s.cu_rows[low] + (chunk - job.clouds[low].chunk_begin) * kBlock + threadIdx.x;
    inside = row < s.cu_rows[low + 1];
    first_image = job.clouds[low].first;
    while (first_image < job.group->first) first_image = job.views[first_image].next;
  }
};

// Chunks of all clouds.
template <typename T>
__device__ int64_t count_chunks(const Job<T>& job) {
  const int64_t last = job.scene.n_clouds - 1;
  if (last < 0 || !job.group->rows_are_good) return 0;
  return job.clouds[last].chunk_begin + (job.scene.n_rows - job.scene.cu_rows[last] + kBlock - 1) / kBlock;
}

// ---- project: records of all pairs, and the number of entries of every tile ---------------------------------------

template <typename T>
struct Gaussian {
  T mean[3], quat[4], scale[3], opacity;

  __device__ Gaussian(const RasterScene<T>& s, int64_t row) {
    for (int i = 0; i < 3; ++i) mean[i] = s.means[3 * row + i];
    for (int i = 0; i < 4; ++i) quat[i] = s.quats[4 * row + i];
    for (int i = 0; i < 3; ++i) scale[i] = s.scales[3 * row + i];
    opacity = s.opacities[row];
  }

  __device__ bool is_good() const {
    bool good = opacity >= 0 && opacity <= 1;
    for (int i = 0; i < 3; ++i) good &= isfinite(mean[i]) && isfinite(scale[i]) && scale[i] >= 0;
    for (int i = 0; i < 4; ++i) good &= isfinite(quat[i]);
    return good;
  }
};

// The CPU refuses rows that are not good; here they are left out.
template <typename T, int kTerms>
__device__ Record<T> record_of(const RasterScene<T>& s, const Camera<T>& camera, const Gaussian<T>& gaussian,
                               const T* coefficients) {
  Record<T> record{};
  const Projection<T> p = project(camera, gaussian.mean, gaussian.quat, gaussian.scale);
  if (!(p.z > camera.near_plane) || !isfinite(p.determinant)) return record;
  const Footprint<T> shape = footprint_of(p.xy, p.yy, p.determinant);
  record.x = p.x, record.y = p.y, record.z = p.z;
  record.slope = shape.slope, record.tight = shape.tight * T(kLog2eHalf), record.loose = shape.loose * T(kLog2eHalf);
  record.opacity = gaussian.opacity;
  const PixelRect bounds = pixel_bounds(p.x, p.y, p.xx, p.yy, p.determinant, level_of(gaussian.opacity), s.width,
                                        s.height, s.cutoff == RasterCutoff::kTile3Sigma);
  record.x0 = bounds.x0, record.x1 = bounds.x1, record.y0 = bounds.y0, record.y1 = bounds.y1;
  if constexpr (kTerms > 0) {
    T basis[kTerms], color[3];
    sh_basis<kTerms>(view_direction(camera, p.point).unit, basis);
    sh_color<kTerms>(basis, coefficients, color);
    record.red = color[0], record.green = color[1], record.blue = color[2];
  } else {
    record.red = coefficients[0], record.green = coefficients[1], record.blue = coefficients[2];
  }
  return record;
}

template <typename T, int kTerms>
__device__ void project_rows(const Job<T>& job) {
  const RasterScene<T>& s = job.scene;
  constexpr int kColumns = kTerms > 0 ? kTerms * 3 : 3;
  const int64_t last = job.group->last, n_chunks = count_chunks(job);
  for (int64_t chunk = blockIdx.x; chunk < n_chunks; chunk += gridDim.x) {
    const Rows rows(job, chunk);
    if (!rows.inside || rows.first_image >= last) continue;
    const int64_t row = rows.row;
    const Gaussian<T> gaussian(s, row);
    T coefficients[kColumns];
    bool good = gaussian.is_good();
    for (int i = 0; i < kColumns; ++i) {
      coefficients[i] = s.color[row * kColumns + i];
      good &= isfinite(coefficients[i]);
    }
    for (int64_t i = 0; i < s.n_features; ++i) good &= isfinite(s.features[row * s.n_features + i]);
    const bool may_show = good && gaussian.opacity >= T(kMinAlpha);
    for (int64_t image = rows.first_image; image < last; image = job.views[image].next) {
      const View<T>& view = job.views[image];
      Record<T> record{};
      if (may_show) record = record_of<T, kTerms>(s, view.camera, gaussian, coefficients);
      job.records[job.pair_begin[image] + row - view.row_begin] = record;
      const Spots spots = spots_of(record);
      uint32_t* counts = job.cursor + image * job.n_spots;
      for (int y = spots.y0; y < spots.y1; ++y)
        for (int x = spots.x0; x < spots.x1; ++x) atomicAdd(counts + y * job.spots_x + x, 1u);
    }
  }
}

// ---- offsets: where each tile's list begins, and how many tiles fit; one block ------------------------------------

template <typename T>
__device__ void find_offsets(const Job<T>& job) {
  __shared__ unsigned long long images_fit, spots_fit;  // ends of the tiles that fit: of whole images, of any
  Group& group = *job.group;
  const int64_t begin = group.spot_begin, end = group.last * job.n_spots;
  if (threadIdx.x == 0) images_fit = spots_fit = begin;
  uint64_t before = 0;
  constexpr int kItems = 8;
  for (int64_t base = begin; base < end; base += int64_t{blockDim.x} * kItems) {
    const int64_t mine = base + int64_t{threadIdx.x} * kItems;
    uint32_t counts[kItems];
    uint64_t sum = 0, total;
    for (int i = 0; i < kItems; ++i) {
      counts[i] = mine + i < end ? job.cursor[mine + i] : 0;
      sum += counts[i];
    }
    uint64_t position = before + block_sum(sum, total) - sum;
    int64_t spot = begin, image = begin;
    for (int i = 0; i < kItems; ++i) {
      if (mine + i >= end) break;
      job.spot_begin[mine + i] = job.cursor[mine + i] = static_cast<uint32_t>(position);
      position += counts[i];
      if (position > static_cast<uint64_t>(job.max_entries)) continue;
      spot = mine + i + 1;
      if (spot % job.n_spots == 0) image = spot;
    }
    atomicMax(&spots_fit, static_cast<unsigned long long>(spot));
    atomicMax(&images_fit, static_cast<unsigned long long>(image));
    before += total;
    if (mine < end && mine + kItems >= end) job.spot_begin[end] = static_cast<uint32_t>(position);
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  group.spot_end = static_cast<int64_t>(images_fit > static_cast<unsigned long long>(begin) ? images_fit : spots_fit);
  group.last = (group.spot_end + job.n_spots - 1) / job.n_spots;
  group.finished = group.spot_end % job.n_spots == 0;
  group.x_end = static_cast<int>(group.spot_end % job.n_spots % job.spots_x);
  group.y_end = static_cast<int>(group.spot_end % job.n_spots / job.spots_x);
}

// ---- scatter: every record writes its entries; their order is whatever it is --------------------------------------

// Inclusive sum over the lanes of a warp.
__device__ inline int warp_sum(int value) {
  for (int step = 1; step < kWarp; step *= 2) {
    const int other = __shfl_up_sync(kFullWarp, value, step);
    if (static_cast<int>(threadIdx.x % kWarp) >= step) value += other;
  }
  return value;
}

template <typename T>
__device__ void scatter_rows(const Job<T>& job) {
  const Group group = *job.group;
  const int64_t n_chunks = count_chunks(job);
  for (int64_t chunk = blockIdx.x; chunk < n_chunks; chunk += gridDim.x) {
    const Rows rows(job, chunk);
    for (int64_t image = rows.first_image; image < group.last; image = job.views[image].next) {
      const int64_t pair = job.pair_begin[image] + rows.row - job.views[image].row_begin;
      Record<T> record{};
      if (rows.inside) record = job.records[pair];
      const Spots spots = spots_of(record);
      // An image has as many slots as entries.
      const int n = group.count(spots), end = warp_sum(n);
      uint32_t slot = 0;
      if (threadIdx.x % kWarp == kWarp - 1 && end > 0)
        slot = job.spot_begin[max(group.spot_begin, image * job.n_spots)] +
               atomicAdd(job.slot_cursor + image, static_cast<uint32_t>(end));
      slot = __shfl_sync(kFullWarp, slot, kWarp - 1);
      if (n == 0) continue;
      job.slot_begin[pair] = slot + end - n;
      const Entry<T> entry = Entry<T>::make(record.z, static_cast<uint32_t>(pair));
      for (int y = spots.y0; y < spots.y1; ++y)
        for (int x = spots.x0; x < spots.x1; ++x) {
          const int64_t spot = image * job.n_spots + y * job.spots_x + x;
          if (spot >= group.spot_begin && spot < group.spot_end)
            job.entries[atomicAdd(job.cursor + spot, 1u)] = entry;
        }
    }
  }
}

// ---- sort: entries of every tile; one block a tile at a time ------------------------------------------------------

// Bitonic, in shared memory. n <= kSortRun.
template <typename T>
__device__ void sort_run(Entry<T>* list, int n, Entry<T>* shared) {
  int size = 1;
  while (size < n) size *= 2;
  for (int i = threadIdx.x; i < size; i += blockDim.x) shared[i] = i < n ? list[i] : Entry<T>::last();
  __syncthreads();
  for (int run = 2; run <= size; run *= 2)
    for (int step = run / 2; step > 0; step /= 2) {
      for (int i = threadIdx.x; i < size / 2; i += blockDim.x) {
        const int low = 2 * (i & ~(step - 1)) | (i & (step - 1)), high = low | step;
        const Entry<T> a = shared[low], b = shared[high];
        if ((b < a) == ((low & run) == 0)) shared[low] = b, shared[high] = a;
      }
      __syncthreads();
    }
  for (int i = threadIdx.x; i < n; i += blockDim.x) list[i] = shared[i];
  __syncthreads();
}

// Merges pairs of sorted runs of `run` entries; each thread finds where its outputs begin in both.
template <typename T>
__device__ void merge_runs(const Entry<T>* from, Entry<T>* to, int64_t n, int64_t run) {
  constexpr int kItems = 16;  // divides 2 * run, so that a thread's outputs are of one pair of runs
  for (int64_t begin = int64_t{threadIdx.x} * kItems; begin < n; begin += int64_t{blockDim.x} * kItems) {
    const int64_t base = begin / (2 * run) * (2 * run);
    const Entry<T>* a = from + base;
    const int64_t n_a = min(run, n - base);
    const Entry<T>* b = a + n_a;
    const int64_t n_b = min(run, n - base - n_a);
    const int64_t skip = begin - base;
    int64_t low = max(int64_t{0}, skip - n_b), high = min(skip, n_a);
    while (low < high) {
      const int64_t middle = (low + high) / 2;
      if (a[middle] < b[skip - 1 - middle])
        low = middle + 1;
      else
        high = middle;
    }
    int64_t i = low, j = skip - low;
    for (int k = 0; k < kItems && i + j < n_a + n_b; ++k)
      to[base + skip + k] = j >= n_b || (i < n_a && a[i] < b[j]) ? a[i++] : b[j++];
  }
  __syncthreads();
}

template <typename T>
__device__ void sort_lists(const Job<T>& job, Entry<T>* shared) {
  const int64_t end = job.group->spot_end;
  for (int64_t task = job.group->spot_begin + blockIdx.x; task < end; task += gridDim.x) {
    const int64_t begin = job.spot_begin[task], n = job.spot_begin[task + 1] - begin;
    Entry<T>* list = job.entries + begin;
    Entry<T>* other = job.spare + begin;
    for (int64_t i = 0; i < n; i += kSortRun)
      sort_run<T>(list + i, static_cast<int>(min(n - i, int64_t{kSortRun})), shared);
    for (int64_t run = kSortRun; run < n; run *= 2) {
      merge_runs<T>(list, other, n, run);
      Entry<T>* swapped = list;
      list = other, other = swapped;
    }
    if (list != job.entries + begin)
      for (int64_t i = threadIdx.x; i < n; i += blockDim.x) other[i] = list[i];
    __syncthreads();
  }
}

}  // namespace gsim3d::raster
