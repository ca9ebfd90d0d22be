// A warp an anchor; all substeps in one launch of blocks that are resident together and wait for each other.
#include <cooperative_groups.h>

#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/springs/springs.h"
#include "gsim3d/springs/springs_math.h"

namespace gsim3d::cuda {
namespace {

constexpr int kMostThreads = 512;

template <typename T, int kCount>
__device__ void add_lanes(T (&sums)[kCount]) {
  for (T& sum : sums)
    for (int other = kWarp / 2; other > 0; other /= 2) sum += __shfl_xor_sync(kFullWarp, sum, other);
}

// f(i, lane) for all anchors, by whole warps.
template <typename F>
__device__ void each_anchor(int64_t n, const F& f) {
  const int64_t warps = static_cast<int64_t>(gridDim.x) * blockDim.x / kWarp;
  const int64_t warp = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  for (int64_t i = warp; i < n; i += warps) f(i, static_cast<int>(threadIdx.x % kWarp));
}

// f(k) for k in [0, count), a thread each.
template <typename F>
__device__ void each(int64_t count, const F& f) {
  const int64_t threads = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t k = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; k < count; k += threads) f(k);
}

template <typename T>
__device__ void substep(const SpringScene<T>& s, const T* from, T* to) {
  each_anchor(s.n, [&](int64_t i, int lane) {
    T pull[3] = {};
    springs::add_pulls(s, from, i, lane, kWarp, pull);
    add_lanes(pull);
    if (lane == 0) springs::finish_substep(s, from, i, pull, to);
  });
  cooperative_groups::this_grid().sync();
}

template <typename T>
__global__ void __launch_bounds__(kMostThreads) springs_kernel(SpringScene<T> s, SpringStates<T> states) {
  for (int64_t t = 0; t < s.substeps; ++t) substep(s, states.at(t), states.at(t + 1));
}

template <typename T>
__global__ void __launch_bounds__(kMostThreads)
    springs_vjp_kernel(SpringScene<T> s, const int64_t* sources, springs::Incoming<T> in, SpringStates<T> states,
                       SpringGradients<T> grads, T* pulls) {
  const auto grid = cooperative_groups::this_grid();
  each(s.n_springs, [&](int64_t p) {
    springs::fill_incoming(s, sources, p, in);
    grads.lengths[p] = grads.stiffness[p] = grads.damping[p] = T(0);
  });
  each(s.n, [&](int64_t i) {
    grads.grip[i] = T(0);
    for (int d = 0; d < 3; ++d) grads.external[3 * i + d] = T(0);
    springs::pull_gradient(s, states.last, grads.state, i, pulls);
  });
  grid.sync();
  for (int64_t t = s.substeps; t-- > 0;) {
    if (t + 1 == s.substeps || (t + 1) % states.interval == 0)
      for (int64_t u = t - t % states.interval; u < t; ++u) substep(s, states.at(u), states.at(u + 1));
    const T *state = states.at(t), *next = states.at(t + 1);
    const T* now = pulls + (s.substeps - 1 - t) % 2 * 3 * s.n;
    T* before = pulls + (s.substeps - t) % 2 * 3 * s.n;  // of the substep before this one
    each_anchor(s.n, [&](int64_t i, int lane) {
      T sums[9] = {};
      springs::add_pulls_vjp(s, in, state, now, i, lane, kWarp, sums, grads);
      add_lanes(sums);
      if (lane == 0) {
        springs::finish_substep_vjp(s, state, next, i, sums, grads);
        springs::pull_gradient(s, state, grads.state, i, before);
      }
    });
    grid.sync();
  }
}

// About a block a multiprocessor, and no more than are resident together.
template <typename... Formal>
void launch_together(const char* op, void (*kernel)(Formal...), int64_t n, Stream stream, Formal... arguments) {
  int processors = 0, per_processor = 0;
  check_cuda(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, stream.device), op);
  const int warps = static_cast<int>(std::clamp<int64_t>((n + processors - 1) / processors, 1, kMostThreads / kWarp));
  check_cuda(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&per_processor, kernel, warps * kWarp, 0), op);
  const int64_t blocks = std::min<int64_t>((n + warps - 1) / warps, int64_t{per_processor} * processors);
  void* pointers[] = {&arguments...};
  check_cuda(cudaLaunchCooperativeKernel(reinterpret_cast<const void*>(kernel), dim3(static_cast<unsigned>(blocks)),
                                         dim3(static_cast<unsigned>(warps * kWarp)), pointers, 0, native(stream)),
             op);
}

}  // namespace

template <typename T>
void advance_springs(const SpringScene<T>& scene, const SpringStates<T>& states, Stream stream) {
  if (scene.n > 0) launch_together("advance_springs", springs_kernel<T>, scene.n, stream, scene, states);
}

template <typename T>
void advance_springs_vjp(const SpringScene<T>& scene, const SpringSources& sources, const SpringStates<T>& states,
                         const SpringGradients<T>& grads, const Workspace& workspace, Stream stream) {
  if (scene.n == 0) return;
  const springs::Incoming<T> in = springs::take_incoming(scene, sources, workspace);
  launch_together("advance_springs_backward", springs_vjp_kernel<T>, scene.n, stream, scene, sources.sources, in,
                  states, grads, workspace.take<T>(2 * 3 * scene.n));
}

#define GSIM3D_INSTANTIATE(T)                                                                               \
  template void advance_springs<T>(const SpringScene<T>&, const SpringStates<T>&, Stream);                  \
  template void advance_springs_vjp<T>(const SpringScene<T>&, const SpringSources&, const SpringStates<T>&, \
                                       const SpringGradients<T>&, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
