// The backward pass on CUDA. It starts from the lists of the first group that the forward pass has kept.
#include "gsim3d/raster/raster_gather.cuh"
#include "gsim3d/raster/raster_launch.cuh"

namespace gsim3d::cuda {
namespace {

template <typename T, bool kFade, bool kWithFeatures, bool kAbsolute>
__global__ void __launch_bounds__(kWarp) blend_vjp_kernel(Job<T> job, RasterImageGrads<T> grads, Slots<T> slots) {
  blend_tiles_vjp<T, kFade, kAbsolute>(job, grads, slots, of_warp<BlendGradShared<T, kWithFeatures>>());
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock) gather_viewmats_kernel(Job<T> job, Slots<T> slots) {
  gather_viewmats<T, kTerms>(job, slots);
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock, 4) gather_rows_kernel(Job<T> job, Slots<T> slots, RasterSceneGrads<T> grads) {
  gather_rows<T, kTerms>(job, slots, grads, dynamic_memory);
}

template <typename T>
__global__ void __launch_bounds__(kOneBlock) gather_images_kernel(Job<T> job, Slots<T> slots,
                                                                  RasterSceneGrads<T> grads) {
  gather_images(job, slots, grads);
}

template <typename T>
__device__ void gather_any(const Job<T>& job, const Slots<T>& slots, const RasterSceneGrads<T>& grads) {
  dispatch_terms(job.scene.sh_terms, [&](auto terms) {
    constexpr int kTerms = decltype(terms)::value;
    if constexpr (kTerms != kProjected)
      if (slots.viewmats) gather_viewmats<T, kTerms>(job, slots);
    cooperative_groups::this_grid().sync();
    gather_rows<T, kTerms>(job, slots, grads, dynamic_memory);
  });
}

template <typename T, bool kFade>
__global__ void __launch_bounds__(kBlock) further_vjp_kernel(Job<T> first, Job<T> job, RasterImageGrads<T> image_grads,
                                                             Slots<T> slots, RasterSceneGrads<T> grads) {
  if (!go_on(first, job)) return;
  const auto grid = cooperative_groups::this_grid();
  while (next_group(job)) {
    for (int64_t i = int64_t{blockIdx.x} * kBlock + threadIdx.x; i < job.limits.slots; i += int64_t{gridDim.x} * kBlock)
      slots.live[i] = 0;
    grid.sync();
    if (grads.absolute)
      blend_tiles_vjp<T, kFade, true>(job, image_grads, slots, of_warp<BlendGradShared<T, true>>());
    else
      blend_tiles_vjp<T, kFade, false>(job, image_grads, slots, of_warp<BlendGradShared<T, true>>());
    grid.sync();
    gather_any(job, slots, grads);
    gather_images(job, slots, grads);
    grid.sync();
  }
}

template <typename T>
Slots<T> take_slots(const Job<T>& first, const Job<T>& further, const RasterSceneGrads<T>& grads, Arena& scratch) {
  const RasterScene<T>& s = first.scene;
  const int64_t n = std::max(first.limits.slots, further.limits.slots);
  Slots<T> slots{};
  slots.sums = scratch.take<SlotSums<T>>(n);
  slots.n_columns = grads.feature_columns(s.n_features);
  slots.features = scratch.take<T>(n * slots.n_columns);
  slots.live = scratch.take<unsigned char>(n);
  slots.unfinished = scratch.take<SlotSums<T>>(s.n_rows);
  slots.backgrounds = scratch.take<T>(s.n_images * first.n_tiles * kQuarters * 3);
  if (grads.viewmats) slots.viewmats = scratch.take<T>(s.n_images * kViewmatParts * 12);
  return slots;
}

}  // namespace

template <typename T>
void raster_backward(const RasterScene<T>& scene, const RasterImageGrads<T>& image_grads,
                     const RasterSceneGrads<T>& grads, const RasterLimits& limits, void* state,
                     const Workspace& workspace, Stream stream) {
  check_options(scene);
  check_limits(scene, limits);
  fill_zero(kRaster, grads.features, scene.n_rows * grads.feature_columns(scene.n_features), stream);
  if (scene.n_images == 0) {
    fill_zero(kRaster, grads.means, scene.n_rows * 3, stream);
    fill_zero(kRaster, grads.quats, scene.n_rows * 4, stream);
    fill_zero(kRaster, grads.scales, scene.n_rows * 3, stream);
    fill_zero(kRaster, grads.opacities, scene.n_rows, stream);
    fill_zero(kRaster, grads.color, scene.n_rows * std::max<int64_t>(1, scene.sh_terms) * 3, stream);
    return;
  }
  const bool viewmats = grads.viewmats != nullptr;
  Arena kept(state), unused, count;
  const Job<T> job = first_job(scene, limits, kept, unused);
  take_slots(job, further_job(job, count), grads, count);
  Arena scratch(workspace.take<unsigned char>(count.used()));
  const Job<T> further = further_job(job, scratch);
  const Slots<T> slots = take_slots(job, further, grads, scratch);

  fill_zero(kRaster, slots.live, limits.slots, stream);
  dispatch_blend(scene, [&](auto fade, auto with_features) {
    constexpr bool kFade = decltype(fade)::value, kWithFeatures = decltype(with_features)::value;
    const unsigned grid = grid_for(scene.n_images * job.n_tiles * kQuarters, 1);
    if (grads.absolute)
      launch(kRaster, blend_vjp_kernel<T, kFade, true, true>, grid, kWarp, sizeof(BlendGradShared<T, true>), stream,
             job, image_grads, slots);
    else
      launch(kRaster, blend_vjp_kernel<T, kFade, kWithFeatures, false>, grid, kWarp,
             sizeof(BlendGradShared<T, kWithFeatures>), stream, job, image_grads, slots);
  });
  dispatch_sh(scene.sh_terms, [&](auto terms) {
    constexpr int kTerms = decltype(terms)::value;
    if constexpr (kTerms != kProjected)
      if (viewmats)
        launch(kRaster, gather_viewmats_kernel<T, kTerms>, grid_for(scene.n_images * kViewmatParts, 1), kBlock, 0,
               stream, job, slots);
    launch(kRaster, gather_rows_kernel<T, kTerms>, grid_of_chunks(scene), kBlock, 2 * kRowBytes<T, kTerms>, stream,
           job, slots, grads);
  });
  if (grads.background || viewmats)
    launch(kRaster, gather_images_kernel<T>, grid_for(scene.n_images, 1), kOneBlock, 0, stream, job, slots, grads);
  const auto rest = [&](auto fade) {
    launch_together(further_vjp_kernel<T, decltype(fade)::value>,
                    std::max({kWarps * sizeof(BlendGradShared<T, true>), kSortBytes<T, kBlock>,
                              2 * kRowBytes<T, 16>}),
                    stream, job, further, image_grads, slots, grads);
  };
  scene.cutoff == RasterCutoff::kSmooth ? rest(std::true_type{}) : rest(std::false_type{});
}

#define GSIM3D_INSTANTIATE(T)                                                                                      \
  template void raster_backward<T>(const RasterScene<T>&, const RasterImageGrads<T>&, const RasterSceneGrads<T>&,  \
                                   const RasterLimits&, void*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
