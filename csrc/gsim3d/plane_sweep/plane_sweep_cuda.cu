// Dispatch, and the float64 sweep: lines of pixels in plain arithmetic.
#include <type_traits>

#include "gsim3d/plane_sweep/plane_sweep_backward.cuh"
#include "gsim3d/plane_sweep/plane_sweep_tensor.h"

namespace gsim3d::cuda {
namespace {

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
          const T bottom_left = scores[(places[j].y & 0xffff) * kQuad],
                  bottom_right = scores[(places[j].y >> 16) * kQuad];
          costs[j] += interpolate(top_left, top_right, bottom_left, bottom_right, samples[j].fx, samples[j].fy);
        }
        __syncwarp();
      }
    }
#pragma unroll
    for (int j = 0; j < kQuad; ++j)
      if (k < s.n_depths && quad.holds(j))
        cost[(image * s.n_depths + k) * s.n_pixels + quad.pixel(j)] = costs[j] * scale;
  }
}

// Warps of a block whose lines fit in shared memory together.
template <typename T>
int64_t warps_for(const char* op, int64_t bytes, const PlaneSweep<T>& sweep, Stream stream) {
  return std::min<int64_t>(kMaxWarps, check_shared_bytes(op, bytes, sweep, stream) / bytes);
}

template <typename T>
void check_depths(const char* op, const PlaneSweep<T>& sweep) {
  check_sizes(op, sweep);
  check(sweep.n_depths < 1 << 14, op, ": inverse_depths must have fewer than 2^14 depths; got ", sweep.n_depths);
}

template <typename T>
Pixels<T> take_pixels(const PlaneSweep<T>& sweep, const Workspace& workspace) {
  const int64_t stride = (sweep.channels + kWarp - 1) / kWarp * kWarp;
  return {workspace.take<T>(sweep.n_images * sweep.height * sweep.width * stride), static_cast<int32_t>(stride)};
}

dim3 transpose_grid(const char* op, int64_t n_images, int64_t n_pixels, int64_t stride) {
  return {blocks_for(op, n_images * ((n_pixels + 31) / 32), 1), static_cast<unsigned>(stride / 32)};
}

template <typename T>
Pixels<const T> make_pixels(const char* op, const T* features, const PlaneSweep<T>& sweep,
                            const Workspace& workspace, Stream stream) {
  const Pixels<T> pixels = take_pixels(sweep, workspace);
  const int64_t n_pixels = sweep.height * sweep.width;
  launch(op, to_pixels_kernel<T>, transpose_grid(op, sweep.n_images, n_pixels, pixels.stride), dim3(32, 8), 0, stream,
         features, sweep.channels, n_pixels, pixels.stride, (n_pixels + 31) / 32, pixels.data);
  return {pixels.data, pixels.stride};
}

constexpr int kVectors = 1;  // doubles of a lane; more would not fit its registers

void line_sweep(const char* op, const double* features, const PlaneSweep<double>& sweep, double* cost,
                const Workspace& workspace, Stream stream) {
  using T = double;
  const LineSizes s = line_sizes(sweep);
  const int64_t bytes = quad_bytes<T>(s), warps = warps_for(op, bytes, sweep, stream), quads = quads_of(s);
  const Pixels<const T> pixels = make_pixels(op, features, sweep, workspace, stream);
  launch(op, forward_kernel<T, kVectors>, blocks_for(op, sweep.n_images * quads, warps),
         static_cast<unsigned>(warps * kWarp), warps * bytes, stream, pixels, sweep, s, quads, cost);
}

void line_sweep_vjp(const char* op, const double* grad, const double* features, const PlaneSweep<double>& sweep,
                    double* grad_features, const Workspace& workspace, Stream stream) {
  using T = double;
  const LineSizes s = line_sizes(sweep);
  const int64_t bytes = lines_bytes<T>(s), warps = warps_for(op, bytes, sweep, stream), quads = quads_of(s);
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
  const Pixels<const T> pixels = make_pixels(op, features, sweep, workspace, stream);
  const Pixels<T> grad_pixels = take_pixels(sweep, workspace);
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
}

}  // namespace

template <typename T>
void plane_sweep(const T* features, const PlaneSweep<T>& sweep, T* cost, const Workspace& workspace, Stream stream) {
  const char* op = "plane_sweep";
  check_depths(op, sweep);
  if (sweep.n_images * sweep.height * sweep.width * sweep.n_depths == 0) return;
  if constexpr (std::is_same_v<T, float>)
    tensor_sweep(op, features, sweep, cost, workspace, stream);
  else
    line_sweep(op, features, sweep, cost, workspace, stream);
}

template <typename T>
void plane_sweep_vjp(const T* grad, const T* features, const PlaneSweep<T>& sweep, T* grad_features,
                     const Workspace& workspace, Stream stream) {
  const char* op = "plane_sweep_backward";
  check_depths(op, sweep);
  const int64_t n_pixels = sweep.n_images * sweep.height * sweep.width;
  if (sweep.n_pairs == 0 || sweep.n_depths == 0)
    return fill_zero(op, grad_features, n_pixels * sweep.channels, stream);
  if (n_pixels == 0) return;
  if constexpr (std::is_same_v<T, float>)
    tensor_sweep_vjp(op, grad, features, sweep, grad_features, workspace, stream);
  else
    line_sweep_vjp(op, grad, features, sweep, grad_features, workspace, stream);
}

#define GSIM3D_INSTANTIATE(T)                                                                 \
  template void plane_sweep<T>(const T*, const PlaneSweep<T>&, T*, const Workspace&, Stream); \
  template void plane_sweep_vjp<T>(const T*, const T*, const PlaneSweep<T>&, T*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
