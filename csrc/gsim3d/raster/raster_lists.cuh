// Inside of the CUDA rasterizer: projection, and which Gaussians each tile of 16 x 16 pixels may see.
//
// Images are rendered in groups: whole images, as many as the scratch holds, or a run of the tiles of one large image.
// What fits is decided on the device, so nothing waits for it. Every (row, image) pair of a group owns a Record; every
// tile owns a run of entries, one for each record whose bounds touch it. Tiles of all images are numbered through. A
// tile has four quarters of 8 x 8 pixels; for the backward pass a pair owns a slot for each quarter that its bounds
// touch. A phase is a function that any number of blocks may share.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_math.h"

namespace gsim3d::raster {

using cuda::kFullWarp;
using cuda::kWarp;

constexpr int kBlock = 128;  // threads of a block in the phases that many blocks share
constexpr int kQuarter = 8;  // pixels
constexpr int kQuarters = 4;
constexpr int kBins = 64;  // of tiles by the lengths of their lists
constexpr int kBinWidth = 64;  // entries
constexpr int32_t kNoImage = INT32_MAX;

// What a tile needs of one Gaussian in one image. alpha = 2^(strength - (tight u)^2 - (loose dy)^2), u = dx - slope dy.
// V is T, or Dual<T> in forward mode.
template <typename V>
struct alignas(16) Record {
  V x, y, slope, tight;  // pixels; tight and loose are square roots of Footprint's times log2(e) / 2
  V loose, strength, z;
  uint16_t x0, x1;  // PixelRect
  V red, green, blue;
  uint16_t y0, y1;
};

// A record in words of 16 bytes, into which the compiler would not put fields of different types.
template <typename T>
__device__ __forceinline__ void store_record(const Record<T>& record, Record<T>* to) {
  uint4 words[sizeof(Record<T>) / sizeof(uint4)];
  memcpy(words, &record, sizeof(record));
  for (size_t i = 0; i < sizeof(record) / sizeof(uint4); ++i) reinterpret_cast<uint4*>(to)[i] = words[i];
}
template <typename T>
__device__ __forceinline__ void load_record(const Record<T>* from, Record<T>& record) {
  uint4 words[sizeof(Record<T>) / sizeof(uint4)];
  for (size_t i = 0; i < sizeof(record) / sizeof(uint4); ++i) words[i] = reinterpret_cast<const uint4*>(from)[i];
  memcpy(&record, words, sizeof(record));
}

// Squares [x0, x1) x [y0, y1) of an image: tiles or quarters.
struct Squares {
  int x0, x1, y0, y1;
  __device__ int count() const { return (x1 - x0) * (y1 - y0); }
  // How many of them come before (x, y), row by row.
  __device__ int before(int x, int y) const {
    const int rows = min(max(y - y0, 0), y1 - y0), columns = min(max(x - x0, 0), x1 - x0);
    return rows * (x1 - x0) + (y >= y0 && y < y1 ? columns : 0);
  }
};

__device__ __forceinline__ Squares squares_of(const PixelRect& r, int side) {
  if (r.x0 >= r.x1) return {0, 0, 0, 0};
  return {r.x0 / side, (r.x1 + side - 1) / side, r.y0 / side, (r.y1 + side - 1) / side};
}

// The quarters of tile (x, y) that are among `quarters`: bit 2 * row + column.
__device__ __forceinline__ uint32_t quarters_of_tile(const Squares& quarters, int x, int y) {
  const uint32_t columns = (2 * x >= quarters.x0 ? 1u : 0u) | (2 * x + 1 < quarters.x1 ? 2u : 0u);
  return (2 * y >= quarters.y0 ? columns : 0u) | (2 * y + 1 < quarters.y1 ? columns << 2 : 0u);
}

// What an entry says beside its depth: the pair, which ascends with the row, and the quarters that it touches.
__device__ __forceinline__ uint32_t word_of(uint32_t pair, uint32_t quarters) { return pair << kQuarters | quarters; }
__device__ __forceinline__ uint32_t pair_of(uint32_t word) { return word >> kQuarters; }

// Sorts by the bits of the positive depth, which ascend with it, then by pair.
template <typename T>
struct Entry;

template <>
struct Entry<float> {
  uint64_t key;
  __device__ static Entry make(float z, uint32_t word) { return {uint64_t{__float_as_uint(z)} << 32 | word}; }
  __device__ static Entry last() { return {~uint64_t{0}}; }
  __device__ uint32_t word() const { return static_cast<uint32_t>(key); }
  __device__ bool operator<(const Entry& other) const { return key < other.key; }
};

template <>
struct alignas(16) Entry<double> {
  uint64_t key, low;
  __device__ static Entry make(double z, uint32_t word) {
    return {static_cast<uint64_t>(__double_as_longlong(z)), word};
  }
  __device__ static Entry last() { return {~uint64_t{0}, ~uint64_t{0}}; }
  __device__ uint32_t word() const { return static_cast<uint32_t>(low); }
  __device__ bool operator<(const Entry& other) const {
    return key < other.key || (key == other.key && low < other.low);
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

// The list of a quarter of a tile.
struct List {
  uint32_t begin, n;
};

// The group in work; on the device.
struct Group {
  int64_t first, last;           // images
  int64_t tile_begin, tile_end;  // of all of these images, or a run of one image's
  int x_begin, y_begin, x_end, y_end;  // places of tiles tile_begin and tile_end
  bool in_parts;           // a run of tiles of an image that is too large for a group
  bool resumed, finished;  // an earlier group has begun the image; this one completes it
  bool rows_are_good;      // cu_rows runs from 0 to N without descending

  __device__ bool has(int64_t tile) const { return tile >= tile_begin && tile < tile_end; }
  // Slots of a pair in this group, tile by tile. Of whole images one for each of the quarters, else four for each tile.
  __device__ int n_slots(const Squares& tiles, const Squares& quarters) const {
    if (!in_parts) return quarters.count();
    return kQuarters * ((finished ? tiles.count() : tiles.before(x_end, y_end)) -
                        (resumed ? tiles.before(x_begin, y_begin) : 0));
  }
  // Which of them belongs to a quarter of tile (x, y).
  __device__ int slot(const Squares& tiles, const Squares& quarters, int x, int y, int quarter) const {
    if (in_parts) return kQuarters * (tiles.before(x, y) - (resumed ? tiles.before(x_begin, y_begin) : 0)) + quarter;
    const int left = max(2 * x, quarters.x0), right = min(2 * x + 2, quarters.x1);
    const int top = max(2 * y, quarters.y0), bottom = min(2 * y + 2, quarters.y1);
    const int before = (top - quarters.y0) * (quarters.x1 - quarters.x0) + (bottom - top) * (left - quarters.x0);
    return before + (2 * y + quarter / 2 - top) * (right - left) + 2 * x + quarter % 2 - left;
  }
};

// Everything the phases read and write; passed to kernels by value. `views` and `clouds` are made once; the rest
// belongs to the group in work.
template <typename T>
struct Job {
  RasterScene<T> scene;
  int64_t tiles_x, n_tiles;  // in a row of tiles, in an image
  cuda::RasterLimits limits;  // what the arrays below hold
  View<T>* views;            // [n_images]
  Cloud* clouds;             // [n_clouds]
  Group* group;
  int32_t* pair_begin;     // [n_images] index of the first row's record
  PixelRect* bounds;       // [pairs]
  T* depths;               // [pairs] z of the records
  Record<T>* records;      // [pairs]; unset where the bounds are empty
  uint32_t* slot_begin;    // [pairs] first of the pair's slots
  uint32_t* bins;          // [kBins] tiles in bins of longer lists, then places handed out
  uint32_t* order;         // [n_images * n_tiles] tiles, counted from the group's first, long lists first
  List* lists;             // [n_images * n_tiles, kQuarters]
  uint32_t* listed;        // [slots] pairs, list by list in order of depth
  uint32_t* cursor;        // [n_images * n_tiles] counts, then write positions
  uint32_t* covered;       // [n_images * n_tiles] counts also of tiles that are not active; null where all are
  uint32_t* counters;      // `cursor`, `covered` and all that end in _count or _cursor: zeros when a group starts
  unsigned long long* slot_count;  // [n_images] slots of all pairs, then those of the images before
  uint32_t* slot_cursor;   // [n_images] handed out
  uint32_t* tile_begin;    // [n_images * n_tiles + 1] into entries
  uint32_t* list_cursor;   // [n_images] places of `listed` handed out; an image has as many as slots
  Entry<T>* entries;       // [entries]
  Entry<T>* spare;         // [entries]

  __device__ bool is_active(int64_t tile) const { return !scene.active || scene.active[tile]; }
  // Slots of an image begin behind those of the images before it in the group.
  __device__ uint32_t first_slot(int64_t image, const Group& in) const {
    return in.in_parts ? 0 : static_cast<uint32_t>(slot_count[image]);
  }
};

// Words of Job::counters.
template <typename T>
GSIM3D_HD int64_t n_counters(const Job<T>& job) {
  return job.scene.n_images * (2 + 1 + 1 + job.n_tiles * (job.scene.active ? 2 : 1));
}

// ---- plan: cameras and the images of each cloud; one block --------------------------------------------------------

template <typename T>
__device__ bool camera_is_good(const T* viewmat, const T* K) {
  bool good = true;
  for (int i = 0; i < 12; ++i) good &= usable(viewmat[i]);
  for (int i = 0; i < 9; ++i) good &= usable(K[i]);
  return good && K[0] > 0 && K[4] > 0 && K[3] == 0 && K[6] == 0 && K[7] == 0 && K[8] == 1;
}

// Inclusive sum over the lanes of a warp.
template <typename V>
__device__ V warp_sum(V value) {
  for (int step = 1; step < kWarp; step *= 2) {
    const V other = __shfl_up_sync(kFullWarp, value, step);
    if (static_cast<int>(threadIdx.x % kWarp) >= step) value += other;
  }
  return value;
}

// Inclusive sum over the threads of a block of up to 1024; `total` is the sum over all of them.
__device__ inline uint64_t block_sum(uint64_t value, uint64_t& total) {
  __shared__ uint64_t warp_sums[kWarp];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  value = warp_sum(value);
  __syncthreads();
  if (lane == kWarp - 1) warp_sums[warp] = value;
  __syncthreads();
  const int n_warps = static_cast<int>(blockDim.x) / kWarp;
  if (warp == 0) {
    const uint64_t sum = warp_sum(lane < n_warps ? warp_sums[lane] : 0);
    warp_sums[lane] = sum;
  }
  __syncthreads();
  total = warp_sums[n_warps - 1];
  return value + (warp > 0 ? warp_sums[warp - 1] : 0);
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
    if (!good || !cuda::inside(cloud, s.n_clouds)) continue;
    if (s.sh_terms != kProjected) {
      if (!camera_is_good(s.viewmats + 16 * i, s.Ks + 9 * i)) continue;
      view.camera = make_camera(s.viewmats + 16 * i, s.Ks + 9 * i, s.width, s.height, s.near_plane,
                                s.jacobian == RasterJacobian::kClamped);
    }
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
  const int64_t begin = job.group->tile_end, first = begin / job.n_tiles;
  const bool resumed = begin % job.n_tiles != 0;
  uint64_t pairs = 0;
  int64_t last = first;
  for (int64_t base = first; base < job.scene.n_images; base += blockDim.x) {
    const int64_t i = base + threadIdx.x;
    const bool inside = i < job.scene.n_images;
    const uint64_t n = inside ? job.views[i].row_end - job.views[i].row_begin : 0;
    uint64_t total;
    const uint64_t end = pairs + block_sum(n, total);
    const bool fits = inside && end <= static_cast<uint64_t>(job.limits.pairs);
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
  group.tile_begin = begin;
  group.x_begin = static_cast<int>(begin % job.n_tiles % job.tiles_x);
  group.y_begin = static_cast<int>(begin % job.n_tiles / job.tiles_x);
  group.resumed = resumed;
}

// ---- rows: a block takes a chunk of rows of one cloud, a thread a row ---------------------------------------------

struct Rows {
  int64_t begin;  // of the block
  int count;
  int64_t row;  // of the thread
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
    begin = s.cu_rows[low] + (chunk - job.clouds[low].chunk_begin) * kBlock;
    count = static_cast<int>(min(s.cu_rows[low + 1] - begin, int64_t{kBlock}));
    row = begin + threadIdx.x;
    inside = static_cast<int>(threadIdx.x) < count;
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

}  // namespace gsim3d::raster
