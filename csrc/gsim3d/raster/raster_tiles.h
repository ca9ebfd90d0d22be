// Inside of the CPU rasterizer: images are rendered in groups; every (row, image) pair of a group becomes a Splat,
// every tile of 16 x 16 pixels gets the list of the splats that touch it, and a tile blends its list in order of
// depth.
#pragma once

#include <vector>

#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_simd.h"

namespace gsim3d::raster {

// What a tile needs of one Gaussian in one image.
template <typename T>
struct alignas(64) Splat {
  T x, y;                // pixels
  T slope, tight, loose;  // Footprint, the last two times log2(e) / 2, so that alpha = opacity 2^-(...)
  T opacity;
  T level;  // log2(255 opacity) and a little: the exponent beyond which alpha < 1/255
  T z;
  T color[3];
  PixelRect bounds;  // pixels that may see it; empty when it is left out
};

// Sort key: bits of a positive depth, which ascend with it.
template <typename T>
struct KeyOf;
template <>
struct KeyOf<float> {
  using Type = uint32_t;
};
template <>
struct KeyOf<double> {
  using Type = uint64_t;
};

template <typename T>
struct Instance {
  typename KeyOf<T>::Type key;
  uint32_t row;  // of the image's cloud, counted from its first
};

// A run of rows of one cloud in one image: the unit of work of projection and binning.
struct Chunk {
  int64_t image;
  int64_t begin, end;  // rows
  int64_t pair;        // index of the first row's splat in the group
};

// Rows of an image that were left out; see RasterImages::unusable.
struct Unusable {
  int64_t count = 0, first = -1;
};

// A group: images [first, last) and scratch for them, reused from group to group.
template <typename T>
struct Group {
  int64_t first = 0, last = 0;
  int64_t tiles_x = 0, tiles_y = 0;
  std::vector<Chunk> chunks;         // by image, then by row
  std::vector<int64_t> image_chunk;  // [last - first + 1] first chunk of each image
  std::vector<int64_t> image_pair;   // [last - first + 1] first pair of each image
  std::vector<Camera<T>> cameras;    // [last - first]
  std::vector<Unusable> unusable;    // [last - first]
  Splat<T>* splats = nullptr;        // [pairs]
  int64_t* cursor = nullptr;         // [chunks, tiles] counts, then write positions
  int64_t* tile_begin = nullptr;     // [images * tiles + 1] into instances
  Instance<T>* instances = nullptr;  // by image, tile, row
  // Backward pass: instances of one pair in a row, so that one owner sums their gradients.
  int64_t* pair_begin = nullptr;  // [pairs + 1] into positions
  int64_t* positions = nullptr;   // index into instances
  int64_t n_instances = 0;

  // Ends the group in front of its image number `image`, which begins the next group.
  void cut(int64_t image) {
    last = first + image;
    chunks.resize(static_cast<size_t>(image_chunk[image]));
    image_chunk.resize(static_cast<size_t>(image) + 1);
    image_pair.resize(static_cast<size_t>(image) + 1);
    cameras.resize(static_cast<size_t>(image));
    unusable.resize(static_cast<size_t>(image));
  }

  int64_t n_tiles() const { return tiles_x * tiles_y; }
  int64_t n_pairs() const { return image_pair.back(); }
};

// Memory that is taken once for the largest group and used again by the others.
class Scratch {
 public:
  explicit Scratch(const Workspace& workspace) : workspace_(workspace) {}

  template <typename U>
  U* take(size_t slot, int64_t count) {
    if (slots_.size() <= slot) slots_.resize(slot + 1);
    auto& [memory, bytes] = slots_[slot];
    const size_t wanted = static_cast<size_t>(count) * sizeof(U);
    if (memory == nullptr || bytes < wanted) {
      memory = workspace_.take<U>(count);
      bytes = wanted;
    }
    return static_cast<U*>(memory);
  }

 private:
  const Workspace& workspace_;
  std::vector<std::pair<void*, size_t>> slots_;
};

// Calls f(rows, n) for blocks of kLanes<T> rows of [begin, end); the last block repeats its last row, n says how many
// count.
template <typename T, typename F>
void for_row_blocks(int64_t begin, int64_t end, const F& f) {
  for (int64_t row = begin; row < end; row += kLanes<T>) {
    int64_t rows[kLanes<T>];
    for (int lane = 0; lane < kLanes<T>; ++lane) rows[lane] = std::min(row + lane, end - 1);
    f(rows, static_cast<int>(std::min<int64_t>(kLanes<T>, end - row)));
  }
}

// Column `column` of the listed rows of a row-major matrix with `width` columns.
template <typename T>
Simd<T> gather(const T* matrix, const int64_t* rows, int64_t width, int64_t column) {
  alignas(32) T lanes[kLanes<T>];
  for (int lane = 0; lane < kLanes<T>; ++lane) lanes[lane] = matrix[rows[lane] * width + column];
  return load<Simd<T>>(lanes);
}

// Throws ArgumentError for what cannot be rendered; writes zeros to all gradients.
template <typename T>
void check_scene(const RasterScene<T>& scene);
template <typename T>
void clear_grads(const RasterScene<T>& scene, const RasterSceneGrads<T>& grads);

// Next group of images after group.last: splats, lists, and with `backward` the way back from pairs to instances.
// False when no image is left.
template <typename T>
bool next_group(const RasterScene<T>& scene, bool backward, Scratch& scratch, const Parallel& parallel,
                Group<T>& group);

// Blends every tile of the group.
template <typename T>
void blend_group(const RasterScene<T>& scene, const Group<T>& group, const RasterImages<T>& images,
                 const Parallel& parallel);

// Gradients of one instance: Moments (5), sum v, colour (3), depth, features, and two of |mean| where they are wanted.
constexpr int kSlotFixed = 10;

// Writes the gradients of every instance to its slot, and adds those of the background.
template <typename T>
void blend_group_vjp(const RasterScene<T>& scene, const Group<T>& group, const RasterImageGrads<T>& image_grads,
                     T* slots,            // [n_instances, kSlotFixed + feature columns]
                     T* tile_background,  // [images * tiles, 3] scratch
                     T* grad_background,  // [n_images, 3] or null
                     bool absolute,       // as of RasterSceneGrads
                     const Parallel& parallel);

// Scratch slots.
enum : size_t { kSplats, kCursor, kTileBegin, kInstances, kPairBegin, kPositions, kSlots, kBackground, kViewmats };

}  // namespace gsim3d::raster
