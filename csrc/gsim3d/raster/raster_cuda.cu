// The forward pass on CUDA, and what both passes know of the state between them.
#include "gsim3d/raster/raster_launch.cuh"

namespace gsim3d::cuda {
namespace {

template <typename T>
__global__ void __launch_bounds__(kOneBlock) plan_kernel(Job<T> job) {
  plan(job);
  __syncthreads();
  choose_images(job);
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock) project_kernel(Job<T> job) {
  project_rows<T, kTerms>(job);
}

template <typename T>
__global__ void __launch_bounds__(kOneBlock) offsets_kernel(Job<T> job) {
  find_offsets(job);
}

template <typename T>
__global__ void __launch_bounds__(kBlock) scatter_kernel(Job<T> job) {
  scatter_rows(job);
}

template <typename T>
__global__ void __launch_bounds__(kBlock) sort_kernel(Job<T> job) {
  __shared__ Entry<T> shared[kSortRun];
  sort_lists(job, shared);
}

template <typename T, bool kFade>
__global__ void __launch_bounds__(kBlock) blend_kernel(Job<T> job, RasterImages<T> images) {
  blend_spots<T, kFade>(job, images, of_warp<BlendShared<T>>());
}

template <typename T, int kTerms, bool kFade>
__global__ void __launch_bounds__(kBlock) further_kernel(Job<T> first, Job<T> job, RasterImages<T> images) {
  if (!go_on(first, job)) return;
  while (next_group<T, kTerms>(job)) {
    blend_spots<T, kFade>(job, images, of_warp<BlendShared<T>>());
    cooperative_groups::this_grid().sync();
  }
}

}  // namespace

template <typename T>
int64_t raster_state_bytes(const RasterScene<T>& scene, int64_t max_pairs, int64_t max_entries) {
  Arena kept, scratch;
  first_job(scene, {nullptr, max_pairs, max_entries}, kept, scratch);
  return kept.used();
}

template <typename T>
void raster_forward(const RasterScene<T>& scene, const RasterImages<T>& images, const RasterState& state,
                    const Workspace& workspace, Stream stream) {
  check_options(scene);
  check_state(scene, state);
  if (scene.n_images == 0) return;
  Arena kept(state.memory), count;
  further_job(first_job(scene, state, kept, count), count);
  Arena scratch(workspace.take<unsigned char>(count.used()));
  kept = Arena(state.memory);
  const Job<T> job = first_job(scene, state, kept, scratch);
  const Job<T> further = further_job(job, scratch);

  const int64_t n_spots = scene.n_images * job.n_spots;
  fill_zero(kRaster, job.cursor, n_spots + scene.n_images, stream);
  launch(kRaster, plan_kernel<T>, 1, kOneBlock, 0, stream, job);
  dispatch_sh(scene.sh_terms, [&](auto terms) {
    launch(kRaster, project_kernel<T, decltype(terms)::value>, grid_of_chunks(scene), kBlock, 0, stream, job);
  });
  launch(kRaster, offsets_kernel<T>, 1, kOneBlock, 0, stream, job);
  launch(kRaster, scatter_kernel<T>, grid_of_chunks(scene), kBlock, 0, stream, job);
  launch(kRaster, sort_kernel<T>, grid_for(n_spots, 1), kBlock, 0, stream, job);
  const size_t shared_bytes = kWarps * sizeof(BlendShared<T>);
  dispatch_fade(scene.cutoff, [&](auto fade) {
    constexpr bool kFade = decltype(fade)::value;
    launch(kRaster, blend_kernel<T, kFade>, grid_for(n_spots, kWarps), kBlock, shared_bytes, stream, job, images);
    dispatch_sh(scene.sh_terms, [&](auto terms) {
      launch_together(further_kernel<T, decltype(terms)::value, kFade>,
                      std::max(shared_bytes, kSortRun * sizeof(Entry<T>)), stream, job, further, images);
    });
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template int64_t raster_state_bytes<T>(const RasterScene<T>&, int64_t, int64_t);                                    \
  template void raster_forward<T>(const RasterScene<T>&, const RasterImages<T>&, const RasterState&, const Workspace&, \
                                  Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
