// The forward pass on CUDA.
#include "gsim3d/raster/raster_launch.cuh"

namespace gsim3d::cuda {
namespace {

// The first block plans, the others clear the counters.
template <typename T>
__global__ void __launch_bounds__(kOneBlock) plan_kernel(Job<T> job) {
  if (blockIdx.x > 0) {
    const int64_t n = n_counters(job);
    const int64_t step = (gridDim.x - 1) * int64_t{kOneBlock};
    for (int64_t i = (blockIdx.x - 1) * int64_t{kOneBlock} + threadIdx.x; i < n; i += step) job.counters[i] = 0;
    return;
  }
  plan(job);
  __syncthreads();
  choose_images(job);
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock, 8) project_kernel(Job<T> job) {
  project_rows<T, kTerms>(job, dynamic_memory);
}

template <typename T>
__global__ void __launch_bounds__(kOneBlock) offsets_kernel(Job<T> job) {
  find_offsets(job);
}

template <typename T>
__global__ void __launch_bounds__(kBlock, 8) scatter_kernel(Job<T> job) {
  find_order(job);
  scatter_rows(job);
}

template <typename T, int kThreads>
__global__ void __launch_bounds__(kThreads, 1024 / kThreads) sort_kernel(Job<T> job) {
  sort_lists<kThreads>(job, reinterpret_cast<Entry<T>*>(dynamic_memory));
}

template <typename T, bool kFade, bool kWithFeatures>
__global__ void __launch_bounds__(kWarp, 32) blend_kernel(Job<T> job, RasterImages<T> images) {
  blend_tiles<kFade>(job, Seen<T>{job.records}, images, of_warp<BlendShared<T, kWithFeatures>>());
}

template <typename T, bool kFade>
__global__ void __launch_bounds__(kBlock) further_kernel(Job<T> first, Job<T> job, RasterImages<T> images) {
  if (!go_on(first, job)) return;
  while (next_group(job)) {
    blend_tiles<kFade>(job, Seen<T>{job.records}, images, of_warp<BlendShared<T, true>>());
    cooperative_groups::this_grid().sync();
  }
}

}  // namespace

template <typename T>
int64_t raster_state_bytes(const RasterScene<T>& scene, const RasterLimits& limits) {
  Arena kept, scratch;
  first_job(scene, limits, kept, scratch);
  return kept.used();
}

template <typename T>
void raster_forward(const RasterScene<T>& scene, const RasterImages<T>& images, const RasterLimits& limits, void* state,
                    const Workspace& workspace, Stream stream) {
  check_options(scene);
  check_limits(scene, limits);
  if (scene.n_images == 0) return;
  Arena kept(state), count;
  further_job(first_job(scene, limits, kept, count), count);
  Arena scratch(workspace.take<unsigned char>(count.used()));
  kept = Arena(state);
  const Job<T> job = first_job(scene, limits, kept, scratch);
  const Job<T> further = further_job(job, scratch);

  const int64_t n_tiles = scene.n_images * job.n_tiles;
  launch(kRaster, plan_kernel<T>, 1 + grid_for(n_counters(job), 4 * kOneBlock), kOneBlock, 0, stream, job);
  dispatch_sh(scene.sh_terms, [&](auto terms) {
    constexpr int kTerms = decltype(terms)::value;
    launch(kRaster, project_kernel<T, kTerms>, grid_of_chunks(scene), kBlock, kRowBytes<T, kTerms>, stream, job);
  });
  launch(kRaster, offsets_kernel<T>, 1, kOneBlock, 0, stream, job);
  // It also puts tiles in order, which their kernels need when there are no rows, too.
  launch(kRaster, scatter_kernel<T>, std::max(1u, grid_of_chunks(scene)), kBlock, 0, stream, job);
  const auto sort = [&](auto threads) {
    constexpr int kThreads = decltype(threads)::value;
    launch(kRaster, sort_kernel<T, kThreads>, grid_for(n_tiles, 1), kThreads, kSortBytes<T, kThreads>, stream, job);
  };
  constexpr int64_t kFewRows = 512;  // of a cloud for each tile: most lists are short
  if (scene.n_rows < kFewRows * scene.n_clouds * job.n_tiles)
    sort(std::integral_constant<int, kSortBlock / 2>{});
  else
    sort(std::integral_constant<int, kSortBlock>{});
  dispatch_blend(scene, [&](auto fade, auto with_features) {
    constexpr bool kFade = decltype(fade)::value, kWithFeatures = decltype(with_features)::value;
    launch(kRaster, blend_kernel<T, kFade, kWithFeatures>, grid_for(n_tiles * kQuarters, 1), kWarp,
           sizeof(BlendShared<T, kWithFeatures>), stream, job, images);
    launch_together(further_kernel<T, kFade>,
                    std::max({kWarps * sizeof(BlendShared<T, true>), kSortBytes<T, kBlock>, kRowBytes<T, 16>}),
                    stream, job, further, images);
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template int64_t raster_state_bytes<T>(const RasterScene<T>&, const RasterLimits&);                                 \
  template void raster_forward<T>(const RasterScene<T>&, const RasterImages<T>&, const RasterLimits&, void*,          \
                                  const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
