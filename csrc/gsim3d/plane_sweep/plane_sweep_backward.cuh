// The backward pass of the sweep: lines with the gradients of their scores, what references gather, what sources get.
#pragma once

#include "gsim3d/plane_sweep/plane_sweep_quad.cuh"

namespace gsim3d::cuda {
namespace {

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
    if (owner_of(sweep, pair) != image) continue;  // of images whose pairs overlap, one keeps its lines
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

// One warp owns 32 kVectors channels of four neighbouring pixels as references and gathers from their sources, by
// pairs, then by source pixels.
constexpr int kGathered = 256;  // source pixels whose weights a warp holds at once

template <typename T>
GSIM3D_HD int64_t gather_bytes() {
  return kGathered * (sizeof(int32_t) + kQuad * sizeof(T));
}

template <typename T, int kVectors>
__global__ void __launch_bounds__(kMaxWarps* kWarp, sizeof(T) == 4 ? 3 : 2)
    gather_kernel(Pixels<const T> pixels, PlaneSweep<T> sweep, LineSizes s, Lines<T> lines, int64_t quads, bool add,
                  Pixels<T> grad_pixels) {
  using Own = Feature<T, kVectors>;
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
    if (!inside(source, sweep.n_images) || owner_of(sweep, pair) != image) continue;
    const T* from = pixels.at(s, source, 0) + channel;
    int32_t held = 0;
    const auto flush = [&] {
      __syncwarp();
#pragma unroll 4
      for (int32_t r = 0; r < held; ++r) {
        const Own other = *reinterpret_cast<const Own*>(from + int64_t{list[r]} * pixels.stride);
        const Feature<T, kQuad> weight = *reinterpret_cast<const Feature<T, kQuad>*>(weights + r * kQuad);
#pragma unroll
        for (int j = 0; j < kQuad; ++j)
#pragma unroll
          for (int v = 0; v < kVectors; ++v) sums[j].lane[v] += weight.lane[j] * other.lane[v];
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
              weights[r * kQuad + j] =
                  touches ? lines.weights[lines.slot(pair, quad.pixel(j)) * s.capacity + rank] : T(0);
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
      for (int v = 0; v < kVectors; ++v) sums[j].lane[v] += earlier.lane[v];
    }
    *to = sums[j];
  }
}

// The source pixels of a task: two pieces of kPiece neighbours, one above the other where rows hold whole pieces. A
// piece lies inside a word. -1: none.
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

template <typename T, int kVectors>
constexpr int64_t source_bytes() {
  return int64_t{kTasks} * kOwned * kWarp * kVectors * sizeof(T);
}

// kParts warps own 32 kVectors channels of kOwned pixels as sources and add what every kept line gives them, by pairs,
// then by pixels; each warp takes every kParts-th run of 32 pixels, and their sums are added in order.
template <typename T, int kVectors>
__global__ void __launch_bounds__(kMaxWarps* kWarp)
    source_kernel(Pixels<const T> pixels, PlaneSweep<T> sweep, LineSizes s, Lines<T> lines, int64_t tasks_per_image,
                  Pixels<T> grad_pixels) {
  using Own = Feature<T, kVectors>;
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
              for (int v = 0; v < kVectors; ++v) sums[q].lane[v] += weight * feature.lane[v];
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
        for (int v = 0; v < kVectors; ++v) sum.lane[v] += sums[q].lane[v];
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
    for (int v = 0; v < kVectors; ++v) sum.lane[v] += total[q * kWarp].lane[v];
    *to = sum;
  }
}

}  // namespace
}  // namespace gsim3d::cuda
