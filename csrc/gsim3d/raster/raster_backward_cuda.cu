// The backward pass on CUDA. It starts from the lists of the first group that the forward pass has kept.
#include "gsim3d/raster/raster_gather.cuh"
#include "gsim3d/raster/raster_launch.cuh"

namespace gsim3d::cuda {
namespace {

template <typename T, bool kFade>
__global__ void __launch_bounds__(kBlock) blend_vjp_kernel(Job<T> job, RasterImageGrads<T> grads, Slots<T> slots) {
  blend_spots_vjp<T, kFade>(job, grads, slots.entries, slots.backgrounds, of_warp<BlendGradShared<T>>());
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock) gather_viewmats_kernel(Job<T> job, Slots<T> slots) {
  gather_viewmats<T, kTerms>(job, slots);
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock) gather_rows_kernel(Job<T> job, Slots<T> slots, RasterSceneGrads<T> grads) {
  gather_rows<T, kTerms>(job, slots, grads);
}

template <typename T>
__global__ void __launch_bounds__(kBlock) gather_images_kernel(Job<T> job, Slots<T> slots, RasterSceneGrads<T> grads) {
  gather_images(job, slots, grads);
}

template <typename T, int kTerms, bool kFade>
__global__ void __launch_bounds__(kBlock) further_vjp_kernel(Job<T> first, Job<T> job, RasterImageGrads<T> image_grads,
                                                             Slots<T> slots, RasterSceneGrads<T> grads) {
  if (!go_on(first, job)) return;
  const auto grid = cooperative_groups::this_grid();
  while (next_group<T, kTerms>(job)) {
    blend_spots_vjp<T, kFade>(job, image_grads, slots.entries, slots.backgrounds, of_warp<BlendGradShared<T>>());
    grid.sync();
    if (slots.viewmats) gather_viewmats<T, kTerms>(job, slots);
    grid.sync();
    gather_rows<T, kTerms>(job, slots, grads);
    gather_images(job, slots, grads);
    grid.sync();
  }
}

template <typename T>
Slots<T> take_slots(const Job<T>& first, const Job<T>& further, bool viewmats, Arena& scratch) {
  const RasterScene<T>& s = first.scene;
  Slots<T> slots{};
  slots.entries = scratch.take<T>(std::max(first.max_entries, further.max_entries) * (kSlotFixed + s.n_features));
  slots.unfinished = scratch.take<T>(s.n_rows * kSlotFixed);
  slots.backgrounds = scratch.take<T>(s.n_images * first.n_spots * 3);
  if (viewmats) slots.viewmats = scratch.take<T>(s.n_images * kViewmatParts * 12);
  return slots;
}

}  // namespace

template <typename T>
void raster_backward(const RasterScene<T>& scene, const RasterImageGrads<T>& image_grads,
                     const RasterSceneGrads<T>& grads, const RasterState& state, const Workspace& workspace,
                     Stream stream) {
  check_options(scene);
  check_state(scene, state);
  fill_zero(kRaster, grads.features, scene.n_rows * scene.n_features, stream);
  if (scene.n_images == 0) {
    fill_zero(kRaster, grads.means, scene.n_rows * 3, stream);
    fill_zero(kRaster, grads.quats, scene.n_rows * 4, stream);
    fill_zero(kRaster, grads.scales, scene.n_rows * 3, stream);
    fill_zero(kRaster, grads.opacities, scene.n_rows, stream);
    fill_zero(kRaster, grads.color, scene.n_rows * std::max<int64_t>(1, scene.sh_terms) * 3, stream);
    return;
  }
  const bool viewmats = grads.viewmats != nullptr;
  Arena kept(state.memory), unused, count;
  const Job<T> job = first_job(scene, state, kept, unused);
  take_slots(job, further_job(job, count), viewmats, count);
  Arena scratch(workspace.take<unsigned char>(count.used()));
  const Job<T> further = further_job(job, scratch);
  const Slots<T> slots = take_slots(job, further, viewmats, scratch);

  const size_t shared_bytes = kWarps * sizeof(BlendGradShared<T>);
  dispatch_fade(scene.cutoff, [&](auto fade) {
    constexpr bool kFade = decltype(fade)::value;
    launch(kRaster, blend_vjp_kernel<T, kFade>, grid_for(scene.n_images * job.n_spots, kWarps), kBlock, shared_bytes,
           stream, job, image_grads, slots);
    dispatch_sh(scene.sh_terms, [&](auto terms) {
      constexpr int kTerms = decltype(terms)::value;
      if (viewmats)
        launch(kRaster, gather_viewmats_kernel<T, kTerms>, grid_for(scene.n_images * kViewmatParts, 1), kBlock, 0,
               stream, job, slots);
      launch(kRaster, gather_rows_kernel<T, kTerms>, grid_of_chunks(scene), kBlock, 0, stream, job, slots, grads);
      launch(kRaster, gather_images_kernel<T>, grid_for(scene.n_images, 1), kBlock, 0, stream, job, slots, grads);
      launch_together(further_vjp_kernel<T, kTerms, kFade>, std::max(shared_bytes, kSortRun * sizeof(Entry<T>)),
                      stream, job, further, image_grads, slots, grads);
    });
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                      \
  template void raster_backward<T>(const RasterScene<T>&, const RasterImageGrads<T>&, const RasterSceneGrads<T>&,  \
                                   const RasterState&, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
