#include "gsim3d/plane_sweep/plane_sweep_line.cuh"

namespace gsim3d::cuda {
namespace {

using namespace plane_sweep_math;

constexpr int kMaxWarps = 8;
constexpr int kGroup = 16;                          // lanes that share a dot product
constexpr int kPiece = 8, kOwned = 2 * kPiece;     // source pixels whose gradients a warp holds
constexpr int kParts = 4, kTasks = kMaxWarps / kParts;  // warps that share them, and such groups of a block
constexpr int64_t kListBytes = int64_t{512} << 20;  // lines kept at once in the backward pass; more run in pieces

// kVectors elements of a feature, one load.
template <typename T, int kVectors>
struct alignas(sizeof(T) * kVectors < 16 ? sizeof(T) * kVectors : 16) Pack {
  T v[kVectors];
};

// Channels-last features: image i, pixel p at data + (i n_pixels + p) stride; stride is a multiple of a warp's packs.
template <typename T>
struct Pixels {
  T* data;
  int32_t stride;

  __device__ __forceinline__ T* at(const LineSizes& s, int64_t image, int32_t pixel) const {
    return data + (image * s.n_pixels + pixel) * stride;
  }
};

// [n, rows, cols] -> [n, cols, stride], zeros in the padding.
template <typename T>
__global__ void to_pixels_kernel(const T* __restrict__ planes, int64_t rows, int64_t cols, int64_t stride,
                                 int64_t col_tiles, T* __restrict__ pixels) {
  __shared__ T tile[32][33];
  const int64_t image = blockIdx.x / col_tiles, col0 = blockIdx.x % col_tiles * 32, row0 = int64_t{blockIdx.y} * 32;
  for (int r = threadIdx.y; r < 32; r += 8) {
    const int64_t row = row0 + r, col = col0 + threadIdx.x;
    tile[r][threadIdx.x] = row < rows && col < cols ? planes[(image * rows + row) * cols + col] : T(0);
  }
  __syncthreads();
  for (int c = threadIdx.y; c < 32; c += 8) {
    const int64_t col = col0 + c, row = row0 + threadIdx.x;
    if (col < cols && row < stride) pixels[(image * cols + col) * stride + row] = tile[threadIdx.x][c];
  }
}

// [n, cols, stride] -> [n, rows, cols].
template <typename T>
__global__ void to_planes_kernel(const T* __restrict__ pixels, int64_t rows, int64_t cols, int64_t stride,
                                 int64_t col_tiles, T* __restrict__ planes) {
  __shared__ T tile[32][33];
  const int64_t image = blockIdx.x / col_tiles, col0 = blockIdx.x % col_tiles * 32, row0 = int64_t{blockIdx.y} * 32;
  for (int c = threadIdx.y; c < 32; c += 8) {
    const int64_t col = col0 + c, row = row0 + threadIdx.x;
    tile[threadIdx.x][c] = row < rows && col < cols ? pixels[(image * cols + col) * stride + row] : T(0);
  }
  __syncthreads();
  for (int r = threadIdx.y; r < 32; r += 8) {
    const int64_t row = row0 + r, col = col0 + threadIdx.x;
    if (row < rows && col < cols) planes[(image * rows + row) * cols + col] = tile[r][threadIdx.x];
  }
}

// 1 / (number of sources * sqrt(C)).
template <typename T>
__device__ __forceinline__ T cost_scale(const Range& pairs, int64_t channels) {
  return T(1) / (static_cast<T>(pairs.end - pairs.begin) * sqrt(static_cast<T>(channels)));
}

// The forward pass gives a warp four neighbouring pixels: their lines run close to each other, so that a source pixel is
// loaded once for most of them. A lane holds one depth of each.
constexpr int kQuad = 4;
constexpr int kRows = 128;  // source pixels whose scores a warp holds at once

// Four neighbouring pixels of an image. The warps of a block take 2 x 4 of them where an image holds whole blocks of them,
// for the sake of the first-level cache.
struct Quad {
  int32_t u, v, width, height;

  __device__ __forceinline__ Quad(int32_t task, const LineSizes& s) : width(s.width), height(s.height) {
    const int32_t columns = (s.width + 1) / 2, rows = (s.height + 1) / 2;
    int32_t column = task % columns, row = task / columns;
    if (columns % 4 == 0 && rows % 2 == 0) {
      const int32_t block = task / 8, across = columns / 4;
      column = block % across * 4 + task % 4;
      row = block / across * 2 + task / 4 % 2;
    }
    u = 2 * column;
    v = 2 * row;
  }
  __device__ __forceinline__ bool holds(int j) const { return u + j % 2 < width && v + j / 2 < height; }
  __device__ __forceinline__ int32_t pixel(int j) const { return (v + j / 2) * width + u + j % 2; }
};

int64_t quads_of(const LineSizes& s) {
  return static_cast<int64_t>((s.height + 1) / 2) * ((s.width + 1) / 2);
}

// Shared memory of a warp. Flags are done with when the list is made.
template <typename T>
struct QuadMemory {
  uint8_t* touched;  // [n_words, 32]
  int32_t* list;     // [kRows]
  T* scores;         // [kRows + 1, kQuad], the last 0
  uint32_t* bits;    // [n_words]
  uint16_t* before;  // [n_words]
};

template <typename T>
GSIM3D_HD int64_t quad_bytes(const LineSizes& s) {
  const int64_t flags = s.n_words * 32, rows = kRows * sizeof(int32_t) + (kRows + 1) * kQuad * sizeof(T);
  return (flags > rows ? flags : rows) + aligned_bytes(s.n_words * sizeof(uint32_t)) +
         aligned_bytes(s.n_words * sizeof(uint16_t));
}

template <typename T>
__device__ __forceinline__ QuadMemory<T> carve_quad(char* at, const LineSizes& s) {
  QuadMemory<T> memory;
  char* end = at + quad_bytes<T>(s);
  memory.touched = reinterpret_cast<uint8_t*>(at);
  memory.scores = carve<T>(at, (kRows + 1) * kQuad);
  memory.list = carve<int32_t>(at, kRows);
  at = end - aligned_bytes(s.n_words * sizeof(uint32_t)) - aligned_bytes(s.n_words * sizeof(uint16_t));
  memory.bits = carve<uint32_t>(at, s.n_words);
  memory.before = carve<uint16_t>(at, s.n_words);
  return memory;
}

// f(side, source pixel) for the corners of a sample.
template <typename T, typename F>
__device__ __forceinline__ void for_corners(const Sample<T>& sample, const LineSizes& s, const F& f) {
#pragma unroll
  for (int side = 0; side < 4; ++side)
    if (sample.corners >> side & 1) f(side, sample.first + (side & 1) + (side >> 1) * s.width);
}

// Marks the source pixels that the samples touch; returns how many they are, the same in every lane.
template <typename T>
__device__ __forceinline__ int32_t mark(const Sample<T> (&samples)[kQuad], const LineSizes& s,
                                        const QuadMemory<T>& memory) {
  int32_t touches = 0;
#pragma unroll
  for (int j = 0; j < kQuad; ++j) touches |= samples[j].corners;
  if (!__any_sync(kFullWarp, touches != 0)) return 0;
  clear_flags(memory.touched, s);
#pragma unroll
  for (int j = 0; j < kQuad; ++j) for_corners(samples[j], s, [&](int, int32_t q) { memory.touched[q] = 1; });
  __syncwarp();
  const int32_t count = list_flags(memory.touched, s, memory.bits, memory.before);
  __syncwarp();
  return count;
}

// What a lane holds of 32 kVectors channels that kGroup lanes share.
template <typename T, int kVectors>
struct Share {
  static constexpr int kWidth = kVectors == 1 ? 2 : 4, kPacks = 2 * kVectors / kWidth;
  Pack<T, kWidth> packs[kPacks];

  __device__ __forceinline__ void load(const T* __restrict__ from) {
#pragma unroll
    for (int e = 0; e < kPacks; ++e)
      packs[e] = reinterpret_cast<const Pack<T, kWidth>*>(from)[threadIdx.x % kGroup + e * kGroup];
  }
};

// scores[r, j] (+)= <own pixel j, source pixel list[r]> over 32 kVectors channels, which start at `source`.
template <typename T, int kVectors>
__device__ __forceinline__ void add_dots(const Share<T, kVectors> (&own)[kQuad], const T* __restrict__ source,
                                         int32_t stride, const int32_t* list, int32_t count, bool first, T* scores) {
  using Part = Share<T, kVectors>;
  constexpr int kGroups = kWarp / kGroup;
  constexpr int kTogether = 4;  // source pixels of a group in flight
  const int lane = threadIdx.x % kWarp, group = lane / kGroup;
  const bool upper_half = lane & 8, odd_pair = lane & 4;
  for (int32_t r0 = 0; r0 < count; r0 += kTogether * kGroups) {
    Part other[kTogether];
#pragma unroll
    for (int t = 0; t < kTogether; ++t)
      other[t].load(source + int64_t{list[min(r0 + t * kGroups + group, count - 1)]} * stride);
#pragma unroll
    for (int t = 0; t < kTogether; ++t) {
      T sums[kQuad];
#pragma unroll
      for (int j = 0; j < kQuad; ++j) {
        sums[j] = 0;
#pragma unroll
        for (int e = 0; e < Part::kPacks; ++e)
#pragma unroll
          for (int c = 0; c < Part::kWidth; ++c) sums[j] += own[j].packs[e].v[c] * other[t].packs[e].v[c];
      }
      // Lanes exchange halves of what they hold, so that every four lanes end with one pixel's sum.
      T a = upper_half ? sums[2] : sums[0], b = upper_half ? sums[3] : sums[1];
      a += __shfl_xor_sync(kFullWarp, upper_half ? sums[0] : sums[2], 8);
      b += __shfl_xor_sync(kFullWarp, upper_half ? sums[1] : sums[3], 8);
      T sum = odd_pair ? b : a;
      sum += __shfl_xor_sync(kFullWarp, odd_pair ? a : b, 4);
      sum += __shfl_xor_sync(kFullWarp, sum, 2);
      sum += __shfl_xor_sync(kFullWarp, sum, 1);
      const int32_t r = r0 + t * kGroups + group;
      if (lane % 4 == 0 && r < count) {
        T& score = scores[r * kQuad + lane % kGroup / 4];
        score = first ? sum : score + sum;
      }
    }
  }
}

template <typename T, int kVectors>
__global__ void __launch_bounds__(kMaxWarps* kWarp, 2)
    forward_kernel(Pixels<const T> pixels, PlaneSweep<T> sweep, LineSizes s, int64_t quads, T* __restrict__ cost) {
  extern __shared__ __align__(16) char shared[];
  const int lane = threadIdx.x % kWarp;
  const int64_t task = (int64_t{blockIdx.x} * blockDim.x + threadIdx.x) / kWarp;
  if (task >= sweep.n_images * quads) return;
  const int64_t image = task / quads;
  const Quad quad(static_cast<int32_t>(task % quads), s);
  const QuadMemory<T> memory = carve_quad<T>(shared + threadIdx.x / kWarp * quad_bytes<T>(s), s);

  Share<T, kVectors> own[kQuad];
  int32_t held = -1;  // the block of channels in `own`
  const Range pairs = range_of(sweep.cu_src, image, sweep.n_pairs);
  const T scale = pairs.begin < pairs.end ? cost_scale<T>(pairs, sweep.channels) : T(0);
  for (int32_t k0 = 0; k0 < s.n_depths; k0 += kWarp) {
    const int32_t k = k0 + lane;
    const T depth = k < s.n_depths ? T(1) / sweep.inverse_depths[image * s.n_depths + k] : T(0);
    T costs[kQuad] = {};
    for (int64_t pair = pairs.begin; pair < pairs.end; ++pair) {
      const int64_t source = sweep.src_images[pair];
      if (!inside(source, sweep.n_images)) continue;
      Sample<T> samples[kQuad];
#pragma unroll
      for (int j = 0; j < kQuad; ++j) {
        const Ray<T> ray = source_ray(sweep.homographies + 9 * pair, static_cast<T>(quad.u + j % 2),
                                       static_cast<T>(quad.v + j / 2));
        samples[j] = sample_at(sweep, s, pair, ray, depth);
        if (k >= s.n_depths || !quad.holds(j)) samples[j].corners = 0;
      }
      __syncwarp();
      const int32_t count = mark(samples, s, memory);
      for (int32_t first = 0; first < count; first += kRows) {
        const int32_t rows = min(count - first, kRows);
        // Places in the list, 16 bits each; the last is that of a score that is 0.
        uint2 places[kQuad];
#pragma unroll
        for (int j = 0; j < kQuad; ++j) {
          uint32_t own_places[4] = {kRows, kRows, kRows, kRows};
          for_corners(samples[j], s, [&](int side, int32_t q) {
            const int32_t rank = memory.before[q >> 5] + __popc(memory.bits[q >> 5] & ((1u << (q & 31)) - 1)) - first;
            if (rank < 0 || rank >= rows) return;
            memory.list[rank] = q;
            own_places[side] = rank;
          });
          places[j] = make_uint2(own_places[0] | own_places[1] << 16, own_places[2] | own_places[3] << 16);
        }
        if (lane < kQuad) memory.scores[kRows * kQuad + lane] = 0;
        __syncwarp();
        for (int32_t c = 0; c < pixels.stride; c += kWarp * kVectors) {
          if (held != c) {
#pragma unroll
            for (int j = 0; j < kQuad; ++j) own[j].load(pixels.at(s, image, quad.pixel(quad.holds(j) ? j : 0)) + c);
            held = c;
          }
          add_dots<T, kVectors>(own, pixels.at(s, source, 0) + c, pixels.stride, memory.list, rows, c == 0,
                                memory.scores);
        }
        __syncwarp();
#pragma unroll
        for (int j = 0; j < kQuad; ++j) {
          const T* scores = memory.scores + j;
          const T top_left = scores[(places[j].x & 0xffff) * kQuad], top_right = scores[(places[j].x >> 16) * kQuad];
          const T bottom_left = scores[(places[j].y & 0xffff) * kQuad], bottom_right = scores[(places[j].y >> 16) * kQuad];
          costs[j] += interpolate(top_left, top_right, bottom_left, bottom_right, samples[j].fx, samples[j].fy);
        }
        __syncwarp();
      }
    }
#pragma unroll
    for (int j = 0; j < kQuad; ++j)
      if (k < s.n_depths && quad.holds(j)) cost[(image * s.n_depths + k) * s.n_pixels + quad.pixel(j)] = costs[j] * scale;
  }
}

// The lines of pixels [first_pixel, first_pixel + n_pixels) for pairs [first_pair, first_pair + n_pairs), as the pass
// over references leaves them for the pass over sources.
template <typename T>
struct Lines {
  uint32_t* bits;    // [n_pairs, n_pixels, n_words]
  uint16_t* before;  // [n_pairs, n_pixels, n_words]
  uint32_t* words;   // [n_pairs, n_words / 32, n_pixels], a bit for each word that is not zero
  T* weights;        // [n_pairs, n_pixels, capacity], gradients of the scores
  int64_t first_pair, n_pairs;
  int32_t first_pixel, n_pixels;

  __device__ __forceinline__ int64_t slot(int64_t pair, int32_t pixel) const {
    return (pair - first_pair) * n_pixels + pixel - first_pixel;
  }
  __device__ __forceinline__ uint32_t* words_of(const LineSizes& s, int64_t pair, int32_t pixel, int32_t at) const {
    return words + ((pair - first_pair) * ((s.n_words + 31) / 32) + at) * n_pixels + pixel - first_pixel;
  }
};

// Memory of score_gradients: it begins where the flags lie, which are done with by then.
template <typename T>
GSIM3D_HD int64_t gradient_bytes(const LineSizes& s) {
  return 2 * aligned_bytes(s.capacity * sizeof(int32_t)) + aligned_bytes(s.capacity * sizeof(T));
}

__device__ __forceinline__ bool holds(const ushort4& places, uint16_t place) {
  return places.x == place || places.y == place || places.z == place || places.w == place;
}

// weights[r] = gradient of the score with source pixel list[r]: the samples that touch it, in order.
template <typename T>
__device__ void score_gradients(const Line<T>& line, const LineSizes& s, int32_t count, const T* grads, T scale,
                                int32_t* low, int32_t* high, T* weights) {
  const int lane = threadIdx.x % kWarp;
  for (int32_t r = lane; r < count; r += kWarp) {
    low[r] = s.n_depths;
    high[r] = -1;
  }
  __syncwarp();
  const uint16_t none = static_cast<uint16_t>(s.capacity);
  for (int32_t k = lane; k < s.n_depths; k += kWarp) {
    const ushort4 own = line.places[k], nowhere = make_ushort4(none, none, none, none);
    const ushort4 earlier = k > 0 ? line.places[k - 1] : nowhere;
    const ushort4 later = k + 1 < s.n_depths ? line.places[k + 1] : nowhere;
    const auto note = [&](uint16_t place) {
      if (place == none) return;
      if (!holds(earlier, place)) atomicMin(low + place, k);
      if (!holds(later, place)) atomicMax(high + place, k);
    };
    note(own.x);
    note(own.y);
    note(own.z);
    note(own.w);
  }
  __syncwarp();
  for (int32_t r = lane; r < count; r += kWarp) {
    T sum = 0;
    for (int32_t k = low[r]; k <= high[r]; ++k) {
      const ushort4 at = line.places[k];
      if (!holds(at, static_cast<uint16_t>(r))) continue;
      const T lower = grads[k] * line.fy[k], part = r == at.x || r == at.y ? grads[k] - lower : lower;
      const T further = part * line.fx[k];
      sum += r == at.y || r == at.w ? further : part - further;
    }
    weights[r] = sum * scale;
  }
  __syncwarp();
}

template <typename T>
GSIM3D_HD int64_t lines_bytes(const LineSizes& s) {
  return line_bytes<T>(s, gradient_bytes<T>(s)) + aligned_bytes(s.n_depths * sizeof(T));
}

// One warp traces the lines of one pixel and keeps them with the gradients of their scores.
template <typename T>
__global__ void __launch_bounds__(kMaxWarps* kWarp)
    lines_kernel(const T* __restrict__ grad, PlaneSweep<T> sweep, LineSizes s, Lines<T> lines) {
  extern __shared__ __align__(16) char shared[];
  const int lane = threadIdx.x % kWarp;
  const int64_t at = (int64_t{blockIdx.x} * blockDim.x + threadIdx.x) / kWarp;
  if (at >= sweep.n_images * lines.n_pixels) return;
  const int64_t image = at / lines.n_pixels;
  const int32_t pixel = lines.first_pixel + static_cast<int32_t>(at % lines.n_pixels);
  char* memory = shared + threadIdx.x / kWarp * lines_bytes<T>(s);
  const Line<T> line = carve_line<T>(memory, s, gradient_bytes<T>(s));
  char* after_flags = reinterpret_cast<char*>(line.touched);
  int32_t* low = carve<int32_t>(after_flags, s.capacity);
  int32_t* high = carve<int32_t>(after_flags, s.capacity);
  T* weights = carve<T>(after_flags, s.capacity);
  T* grads = carve<T>(memory, s.n_depths);
  for (int32_t k = lane; k < s.n_depths; k += kWarp) grads[k] = grad[(image * s.n_depths + k) * s.n_pixels + pixel];

  const Range pairs = range_of(sweep.cu_src, image, sweep.n_pairs);
  const T scale = cost_scale<T>(pairs, sweep.channels);
  const int64_t end = min(pairs.end, lines.first_pair + lines.n_pairs);
  for (int64_t pair = max(pairs.begin, lines.first_pair); pair < end; ++pair) {
    __syncwarp();
    const bool known = inside(sweep.src_images[pair], sweep.n_images);
    const int32_t count = known ? trace(sweep, s, image, pair, pixel, line) : 0;
    const int64_t slot = lines.slot(pair, pixel);
    for (int32_t begin = 0; begin < s.n_words; begin += kWarp) {
      const int32_t w = begin + lane;
      const uint32_t bits = count > 0 && w < s.n_words ? line.bits[w] : 0;
      if (bits) {
        lines.bits[slot * s.n_words + w] = bits;
        lines.before[slot * s.n_words + w] = line.before[w];
      }
      const uint32_t words = __ballot_sync(kFullWarp, bits != 0);
      if (lane == 0) *lines.words_of(s, pair, pixel, begin / kWarp) = words;
    }
    if (count == 0) continue;
    score_gradients(line, s, count, grads, scale, low, high, weights);
    for (int32_t r = lane; r < count; r += kWarp) lines.weights[slot * s.capacity + r] = weights[r];
  }
}

// One warp owns 32 kVectors channels of four neighbouring pixels as references and gathers from their sources, by pairs,
// then by source pixels.
constexpr int kGathered = 256;  // source pixels whose weights a warp holds at once

template <typename T>
GSIM3D_HD int64_t gather_bytes() {
  return kGathered * (sizeof(int32_t) + kQuad * sizeof(T));
}

template <typename T, int kVectors>
__global__ void __launch_bounds__(kMaxWarps* kWarp, sizeof(T) == 4 ? 3 : 2)
    gather_kernel(Pixels<const T> pixels, PlaneSweep<T> sweep, LineSizes s, Lines<T> lines, int64_t quads, bool add,
                  Pixels<T> grad_pixels) {
  using Own = Pack<T, kVectors>;
  extern __shared__ __align__(16) char shared[];
  const int lane = threadIdx.x % kWarp;
  const int64_t task = (int64_t{blockIdx.x} * blockDim.x + threadIdx.x) / kWarp;
  if (task >= sweep.n_images * quads) return;
  const int64_t image = task / quads;
  const Quad quad(static_cast<int32_t>(task % quads), s);
  const int32_t channel = (blockIdx.y * kWarp + lane) * kVectors;
  char* memory = shared + threadIdx.x / kWarp * gather_bytes<T>();
  T* weights = carve<T>(memory, kGathered * kQuad);
  int32_t* list = carve<int32_t>(memory, kGathered);
  bool here[kQuad];
#pragma unroll
  for (int j = 0; j < kQuad; ++j)
    here[j] = quad.holds(j) && inside(int64_t{quad.pixel(j)} - lines.first_pixel, lines.n_pixels);

  Own sums[kQuad] = {};
  const Range pairs = range_of(sweep.cu_src, image, sweep.n_pairs);
  const int64_t end = min(pairs.end, lines.first_pair + lines.n_pairs);
  for (int64_t pair = max(pairs.begin, lines.first_pair); pair < end; ++pair) {
    const int64_t source = sweep.src_images[pair];
    if (!inside(source, sweep.n_images)) continue;
    const T* from = pixels.at(s, source, 0) + channel;
    int32_t held = 0;
    const auto flush = [&] {
      __syncwarp();
#pragma unroll 4
      for (int32_t r = 0; r < held; ++r) {
        const Own other = *reinterpret_cast<const Own*>(from + int64_t{list[r]} * pixels.stride);
        const Pack<T, kQuad> weight = *reinterpret_cast<const Pack<T, kQuad>*>(weights + r * kQuad);
#pragma unroll
        for (int j = 0; j < kQuad; ++j)
#pragma unroll
          for (int v = 0; v < kVectors; ++v) sums[j].v[v] += weight.v[j] * other.v[v];
      }
      __syncwarp();
      held = 0;
    };
    for (int32_t begin = 0; begin < s.n_words; begin += kWarp) {
      const int32_t w = begin + lane;
      uint32_t bits[kQuad], before[kQuad], any = 0;
#pragma unroll
      for (int j = 0; j < kQuad; ++j) {
        bits[j] = before[j] = 0;
        if (!here[j]) continue;
        const int64_t slot = lines.slot(pair, quad.pixel(j));
        if (*lines.words_of(s, pair, quad.pixel(j), begin / kWarp) >> lane & 1) {
          bits[j] = lines.bits[slot * s.n_words + w];
          before[j] = lines.before[slot * s.n_words + w];
        }
        any |= bits[j];
      }
      // A lane lists the pixels of its word; a round takes as many words as fit.
      for (unsigned waiting = __ballot_sync(kFullWarp, any != 0); waiting;) {
        const int32_t own = waiting >> lane & 1 ? __popc(any) : 0;
        int32_t up_to = own;
#pragma unroll
        for (int offset = 1; offset < kWarp; offset *= 2) {
          const int32_t earlier = __shfl_up_sync(kFullWarp, up_to, offset);
          if (lane >= offset) up_to += earlier;
        }
        const bool fits = held + up_to <= kGathered;
        const unsigned taken = __ballot_sync(kFullWarp, fits) & waiting;
        if (own > 0 && fits) {
          int32_t r = held + up_to - own;
          for (uint32_t rest = any; rest; rest &= rest - 1, ++r) {
            const int bit = __ffs(rest) - 1;
            list[r] = w * 32 + bit;
#pragma unroll
            for (int j = 0; j < kQuad; ++j) {
              const int32_t rank = before[j] + __popc(bits[j] & ((1u << bit) - 1));
              const bool touches = bits[j] >> bit & 1 && rank < s.capacity;
              weights[r * kQuad + j] = touches ? lines.weights[lines.slot(pair, quad.pixel(j)) * s.capacity + rank] : T(0);
            }
          }
        }
        if (taken) held += __shfl_sync(kFullWarp, up_to, 31 - __clz(taken));
        waiting &= ~taken;
        if (waiting) flush();
      }
    }
    flush();
  }
#pragma unroll
  for (int j = 0; j < kQuad; ++j) {
    if (!here[j]) continue;
    Own* to = reinterpret_cast<Own*>(grad_pixels.at(s, image, quad.pixel(j)) + channel);
    if (add) {
      const Own earlier = *to;
#pragma unroll
      for (int v = 0; v < kVectors; ++v) sums[j].v[v] += earlier.v[v];
    }
    *to = sums[j];
  }
}

// The source pixels of a task: two pieces of kPiece neighbours, one above the other where rows hold whole pieces. A piece
// lies inside a word. -1: none.
struct Pieces {
  int32_t at[2];

  __device__ __forceinline__ Pieces(int32_t task, const LineSizes& s) {
    const int32_t n = (s.n_pixels + kPiece - 1) / kPiece, columns = s.width / kPiece;
    const bool whole = s.width % kPiece == 0;
    at[0] = whole ? task / columns * 2 * columns + task % columns : 2 * task;
    at[1] = at[0] + (whole ? columns : 1);
    if (at[1] >= n) at[1] = -1;
  }
};

int64_t n_tasks(const LineSizes& s) {
  if (s.width % kPiece == 0) return static_cast<int64_t>((s.height + 1) / 2) * (s.width / kPiece);
  return ((s.n_pixels + kPiece - 1) / kPiece + 1) / 2;
}

// The image that owns a pair: the last whose pairs begin at or before it; -1 where the offsets say none.
template <typename T>
__device__ __forceinline__ int64_t owner_of(const PlaneSweep<T>& sweep, int64_t pair) {
  int64_t image = 0, past = sweep.n_images;
  while (past - image > 1) {
    const int64_t middle = (image + past) / 2;
    (sweep.cu_src[middle] <= pair ? image : past) = middle;
  }
  const Range owned = range_of(sweep.cu_src, image, sweep.n_pairs);
  return pair >= owned.begin && pair < owned.end ? image : -1;
}

template <typename T, int kVectors>
constexpr int64_t source_bytes() {
  return int64_t{kTasks} * kOwned * kWarp * kVectors * sizeof(T);
}

// kParts warps own 32 kVectors channels of kOwned pixels as sources and add what every kept line gives them, by pairs, then
// by pixels; each warp takes every kParts-th run of 32 pixels, and their sums are added in order.
template <typename T, int kVectors>
__global__ void __launch_bounds__(kMaxWarps* kWarp)
    source_kernel(Pixels<const T> pixels, PlaneSweep<T> sweep, LineSizes s, Lines<T> lines, int64_t tasks_per_image,
                  Pixels<T> grad_pixels) {
  using Own = Pack<T, kVectors>;
  extern __shared__ __align__(16) char shared[];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, part = warp % kParts;
  const int64_t at = int64_t{blockIdx.x} * kTasks + warp / kParts;
  const bool works = at < sweep.n_images * tasks_per_image;
  const int64_t source = works ? at / tasks_per_image : -1;
  const Pieces pieces(works ? static_cast<int32_t>(at % tasks_per_image) : 0, s);
  const int32_t channel = (blockIdx.y * kWarp + lane) * kVectors;

  Own sums[kOwned] = {};
  for (int64_t pair = lines.first_pair; pair < lines.first_pair + lines.n_pairs; ++pair) {
    if (sweep.src_images[pair] != source) continue;
    const int64_t image = works ? owner_of(sweep, pair) : -1;
    if (image < 0) continue;
    for (int32_t first = part * kWarp; first < lines.n_pixels; first += kParts * kWarp) {
      const int32_t pixel = lines.first_pixel + first + lane;
      unsigned bits = 0;
      T weights[kOwned] = {};
      const bool valid = first + lane < lines.n_pixels;
      const int64_t slot = lines.slot(pair, pixel);
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        if (pieces.at[half] < 0) continue;
        const int32_t word = pieces.at[half] * kPiece / 32, shift = pieces.at[half] * kPiece % 32;
        const bool listed = valid && *lines.words_of(s, pair, pixel, word / 32) >> word % 32 & 1;
        if (!__any_sync(kFullWarp, listed)) continue;
        const uint32_t all = listed ? lines.bits[slot * s.n_words + word] : 0;
        const unsigned own = all >> shift & ((1u << kPiece) - 1);
        if (!__any_sync(kFullWarp, own != 0)) continue;
        if (own == 0) continue;
        bits |= own << half * kPiece;
        int32_t rank = lines.before[slot * s.n_words + word] + __popc(all & ((1u << shift) - 1));
#pragma unroll
        for (int q = 0; q < kPiece; ++q)
          if (own >> q & 1 && rank < s.capacity) weights[half * kPiece + q] = lines.weights[slot * s.capacity + rank++];
      }
      const T* from = pixels.at(s, image, lines.first_pixel + first) + channel;
      // Two at a time, so that one load waits while the other's sums are formed.
      for (unsigned hits = __ballot_sync(kFullWarp, bits != 0); hits;) {
        const int one = __ffs(hits) - 1;
        hits &= hits - 1;
        const int two = hits ? __ffs(hits) - 1 : one;
        const Own first_feature = *reinterpret_cast<const Own*>(from + int64_t{one} * pixels.stride);
        const Own second_feature = *reinterpret_cast<const Own*>(from + int64_t{two} * pixels.stride);
        const auto add = [&](int hit, unsigned touched, const Own& feature) {
#pragma unroll
          for (int half = 0; half < 2; ++half) {
            if (!(touched >> half * kPiece & ((1u << kPiece) - 1))) continue;
#pragma unroll
            for (int q = half * kPiece; q < (half + 1) * kPiece; ++q) {
              if (!(touched >> q & 1)) continue;
              const T weight = __shfl_sync(kFullWarp, weights[q], hit);
#pragma unroll
              for (int v = 0; v < kVectors; ++v) sums[q].v[v] += weight * feature.v[v];
            }
          }
        };
        add(one, __shfl_sync(kFullWarp, bits, one), first_feature);
        if (hits) add(two, __shfl_sync(kFullWarp, bits, two), second_feature);
        hits &= hits - 1;
      }
    }
  }

  Own* total = reinterpret_cast<Own*>(shared) + warp / kParts * kOwned * kWarp + lane;
  for (int turn = 0; turn < kParts; ++turn) {
    if (turn == part) {
#pragma unroll
      for (int q = 0; q < kOwned; ++q) {
        Own sum = turn > 0 ? total[q * kWarp] : Own{};
#pragma unroll
        for (int v = 0; v < kVectors; ++v) sum.v[v] += sums[q].v[v];
        total[q * kWarp] = sum;
      }
    }
    __syncthreads();
  }
  if (!works) return;
  for (int q = part; q < kOwned; q += kParts) {
    const int32_t piece = pieces.at[q / kPiece], pixel = piece * kPiece + q % kPiece;
    if (piece < 0 || pixel >= s.n_pixels) continue;
    Own* to = reinterpret_cast<Own*>(grad_pixels.at(s, source, pixel) + channel);
    Own sum = *to;
#pragma unroll
    for (int v = 0; v < kVectors; ++v) sum.v[v] += total[q * kWarp].v[v];
    *to = sum;
  }
}

// Warps of a block whose lines fit in shared memory together.
int64_t warps_for(const char* op, int64_t bytes, const LineSizes& s, Stream stream) {
  int limit = 0;
  check_cuda(cudaDeviceGetAttribute(&limit, cudaDevAttrMaxSharedMemoryPerBlockOptin, stream.device), op);
  check(bytes <= limit, op, ": features and depths must be small enough for one pixel's line to fit ", limit,
        " bytes of shared memory; got ", s.height, " x ", s.width, " pixels and ", s.n_depths, " depths");
  return std::min<int64_t>(kMaxWarps, limit / bytes);
}

template <typename T>
void check_lines(const char* op, const PlaneSweep<T>& sweep) {
  check_sizes(op, sweep);
  check(sweep.n_depths < 1 << 14, op, ": inverse_depths must have fewer than 2^14 depths; got ", sweep.n_depths);
}

template <typename T>
Pixels<T> take_pixels(const PlaneSweep<T>& sweep, int vectors, const Workspace& workspace) {
  const int64_t block = kWarp * vectors, stride = (sweep.channels + block - 1) / block * block;
  return {workspace.take<T>(sweep.n_images * sweep.height * sweep.width * stride), static_cast<int32_t>(stride)};
}

dim3 transpose_grid(const char* op, int64_t n_images, int64_t n_pixels, int64_t stride) {
  return {blocks_for(op, n_images * ((n_pixels + 31) / 32), 1), static_cast<unsigned>(stride / 32)};
}

template <typename T>
Pixels<const T> make_pixels(const char* op, const T* features, const PlaneSweep<T>& sweep, int vectors,
                            const Workspace& workspace, Stream stream) {
  const Pixels<T> pixels = take_pixels(sweep, vectors, workspace);
  const int64_t n_pixels = sweep.height * sweep.width;
  launch(op, to_pixels_kernel<T>, transpose_grid(op, sweep.n_images, n_pixels, pixels.stride), dim3(32, 8), 0, stream,
         features, sweep.channels, n_pixels, pixels.stride, (n_pixels + 31) / 32, pixels.data);
  return {pixels.data, pixels.stride};
}

// f with kVectors = 1, 2 or 4 as a constant: a warp's packs should not be wider than the features, or than registers hold.
template <typename T, typename F>
void for_vectors(int64_t channels, const F& f) {
  if constexpr (sizeof(T) > 4) {
    f.template operator()<1>();
  } else {
    if (channels <= kWarp) return f.template operator()<1>();
    if (channels <= 2 * kWarp) return f.template operator()<2>();
    f.template operator()<4>();
  }
}

}  // namespace

template <typename T>
void plane_sweep(const T* features, const PlaneSweep<T>& sweep, T* cost, const Workspace& workspace, Stream stream) {
  const char* op = "plane_sweep";
  check_lines(op, sweep);
  const LineSizes s = line_sizes(sweep);
  if (sweep.n_images * s.n_pixels * s.n_depths == 0) return;
  const int64_t bytes = quad_bytes<T>(s), warps = warps_for(op, bytes, s, stream);
  const int64_t quads = quads_of(s);
  for_vectors<T>(sweep.channels, [&]<int kVectors>() {
    const Pixels<const T> pixels = make_pixels(op, features, sweep, kVectors, workspace, stream);
    launch(op, forward_kernel<T, kVectors>, blocks_for(op, sweep.n_images * quads, warps),
           static_cast<unsigned>(warps * kWarp), warps * bytes, stream, pixels, sweep, s, quads, cost);
  });
}

template <typename T>
void plane_sweep_vjp(const T* grad, const T* features, const PlaneSweep<T>& sweep, T* grad_features,
                     const Workspace& workspace, Stream stream) {
  const char* op = "plane_sweep_backward";
  check_lines(op, sweep);
  const LineSizes s = line_sizes(sweep);
  if (sweep.n_pairs == 0 || s.n_depths == 0)
    return fill_zero(op, grad_features, sweep.n_images * sweep.channels * s.n_pixels, stream);
  if (sweep.n_images * s.n_pixels == 0) return;
  const int64_t bytes = lines_bytes<T>(s), warps = warps_for(op, bytes, s, stream), quads = quads_of(s);
  const int64_t summary = (s.n_words + 31) / 32;
  const int64_t line =
      s.n_words * (sizeof(uint32_t) + sizeof(uint16_t)) + summary * sizeof(uint32_t) + s.capacity * sizeof(T);
  const int64_t room = std::max<int64_t>(kListBytes / line, 1), per_pair = std::min<int64_t>(room, s.n_pixels);
  const int64_t pairs = std::min(std::max<int64_t>(room / s.n_pixels, 1), sweep.n_pairs);
  const bool whole = pairs == sweep.n_pairs && per_pair == s.n_pixels;
  const int64_t tasks = n_tasks(s);
  Lines<T> lines{
      workspace.take<uint32_t>(pairs * per_pair * s.n_words), workspace.take<uint16_t>(pairs * per_pair * s.n_words),
      workspace.take<uint32_t>(pairs * per_pair * summary), workspace.take<T>(pairs * per_pair * s.capacity)};
  for_vectors<T>(sweep.channels, [&]<int kVectors>() {
    const Pixels<const T> pixels = make_pixels(op, features, sweep, kVectors, workspace, stream);
    const Pixels<T> grad_pixels = take_pixels(sweep, kVectors, workspace);
    const unsigned blocks_of_channels = pixels.stride / (kWarp * kVectors);
    if (!whole) fill_zero(op, grad_pixels.data, sweep.n_images * s.n_pixels * pixels.stride, stream);
    for (lines.first_pair = 0; lines.first_pair < sweep.n_pairs; lines.first_pair += pairs) {
      lines.n_pairs = std::min(pairs, sweep.n_pairs - lines.first_pair);
      for (int64_t pixel = 0; pixel < s.n_pixels; pixel += per_pair) {
        lines.first_pixel = static_cast<int32_t>(pixel);
        lines.n_pixels = static_cast<int32_t>(std::min(per_pair, s.n_pixels - pixel));
        launch(op, lines_kernel<T>, blocks_for(op, sweep.n_images * lines.n_pixels, warps),
               static_cast<unsigned>(warps * kWarp), warps * bytes, stream, grad, sweep, s, lines);
        launch(op, gather_kernel<T, kVectors>,
               dim3(blocks_for(op, sweep.n_images * quads, kMaxWarps), blocks_of_channels), kMaxWarps * kWarp,
               kMaxWarps * gather_bytes<T>(), stream, pixels, sweep, s, lines, quads, !whole, grad_pixels);
        launch(op, source_kernel<T, kVectors>,
               dim3(blocks_for(op, sweep.n_images * tasks, kTasks), blocks_of_channels), kMaxWarps * kWarp,
               source_bytes<T, kVectors>(), stream, pixels, sweep, s, lines, tasks, grad_pixels);
      }
    }
    launch(op, to_planes_kernel<T>, transpose_grid(op, sweep.n_images, s.n_pixels, pixels.stride), dim3(32, 8), 0,
           stream, grad_pixels.data, sweep.channels, s.n_pixels, pixels.stride, (s.n_pixels + 31) / 32, grad_features);
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                 \
  template void plane_sweep<T>(const T*, const PlaneSweep<T>&, T*, const Workspace&, Stream); \
  template void plane_sweep_vjp<T>(const T*, const T*, const PlaneSweep<T>&, T*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
