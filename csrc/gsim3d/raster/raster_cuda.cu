// The two entry points on CUDA. The first group of images runs as one kernel a phase. Whatever did not fit into it
// (seldom anything) is left to one cooperative kernel that repeats all phases until no tile is left: the host never
// needs to know how much there is, and the result does not depend on the size of the scratch.
#include <cooperative_groups.h>

#include <algorithm>

#include "gsim3d/raster/raster_check.h"
#include "gsim3d/raster/raster_gather.cuh"

namespace gsim3d::cuda {
namespace {

using namespace raster;  // NOLINT: this file is its other half

constexpr const char* kOp = "rasterize_gaussians";
constexpr int kOneBlock = 1024;  // threads of the phases of one block

// ---- kernels ------------------------------------------------------------------------------------------------------

template <typename T>
__global__ void plan_kernel(Job<T> job) {
  plan(job);
  __syncthreads();
  choose_images(job);
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock) project_kernel(Job<T> job) {
  project_rows<T, kTerms>(job);
}

template <typename T>
__global__ void offsets_kernel(Job<T> job) {
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

extern __shared__ __align__(16) unsigned char dynamic_memory[];

// The part of the dynamic shared memory that belongs to the calling warp.
template <typename Shared>
__device__ Shared& of_warp() {
  return reinterpret_cast<Shared*>(dynamic_memory)[threadIdx.x / kWarp];
}

template <typename T, bool kFade>
__global__ void __launch_bounds__(kBlock) blend_kernel(Job<T> job, RasterImages<T> images) {
  blend_spots<T, kFade>(job, images, of_warp<BlendShared<T>>());
}

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

// Lists of the next group; false when no tile is left. Every block calls it.
template <typename T, int kTerms>
__device__ bool next_group(const Job<T>& job, Entry<T>* shared) {
  const auto grid = cooperative_groups::this_grid();
  const int64_t end = job.scene.n_images * job.n_spots;
  if (job.group->spot_end >= end) return false;
  grid.sync();
  if (blockIdx.x == 0) choose_images(job);
  grid.sync();
  for (int64_t spot = job.group->first * job.n_spots + int64_t{blockIdx.x} * kBlock + threadIdx.x;
       spot < job.group->last * job.n_spots; spot += int64_t{gridDim.x} * kBlock)
    job.cursor[spot] = 0;
  grid.sync();
  project_rows<T, kTerms>(job);
  grid.sync();
  if (blockIdx.x == 0) find_offsets(job);
  grid.sync();
  scatter_rows(job);
  grid.sync();
  sort_lists(job, shared);
  grid.sync();
  return true;
}

template <typename T, int kTerms, bool kFade>
__global__ void __launch_bounds__(kBlock) rest_kernel(Job<T> job, RasterImages<T> images) {
  auto* shared = reinterpret_cast<Entry<T>*>(dynamic_memory);
  while (next_group<T, kTerms>(job, shared)) {
    blend_spots<T, kFade>(job, images, of_warp<BlendShared<T>>());
    cooperative_groups::this_grid().sync();
  }
}

template <typename T, int kTerms, bool kFade>
__global__ void __launch_bounds__(kBlock) rest_vjp_kernel(Job<T> job, RasterImageGrads<T> image_grads, Slots<T> slots,
                                                          RasterSceneGrads<T> grads) {
  auto* shared = reinterpret_cast<Entry<T>*>(dynamic_memory);
  const auto grid = cooperative_groups::this_grid();
  while (next_group<T, kTerms>(job, shared)) {
    blend_spots_vjp<T, kFade>(job, image_grads, slots.entries, slots.backgrounds, of_warp<BlendGradShared<T>>());
    grid.sync();
    if (slots.viewmats) gather_viewmats<T, kTerms>(job, slots);
    grid.sync();
    gather_rows<T, kTerms>(job, slots, grads);
    gather_images(job, slots, grads);
    grid.sync();
  }
}

// ---- launches -----------------------------------------------------------------------------------------------------

template <typename T>
Job<T> make_job(const RasterScene<T>& s, bool backward, const Workspace& workspace) {
  check_options(s);
  check(s.n_rows <= INT32_MAX && s.n_images < kNoImage, kOp, ": at most 2^31 - 1 rows and images; got ", s.n_rows,
        " and ", s.n_images);
  Job<T> job{};
  job.scene = s;
  job.spots_x = (s.width + kSpot - 1) / kSpot;
  job.n_spots = job.spots_x * ((s.height + kSpot - 1) / kSpot);
  const int64_t n_spots = s.n_images * job.n_spots;
  // Exact when all clouds are shown by equally many images.
  const int64_t views = (s.n_images + s.n_clouds - 1) / std::max<int64_t>(1, s.n_clouds);
  constexpr int64_t kManyPairs = int64_t{1} << 25, kMost = int64_t{1} << 30, kEntriesPerSpot = 512;
  job.max_pairs = std::max(s.n_rows, std::min(s.n_rows * views, kManyPairs));
  job.max_entries = std::max(s.n_rows, std::min(job.max_pairs * 3 / 2 + n_spots * kEntriesPerSpot, kMost));
  job.group = workspace.take<Group>(1);
  job.views = workspace.take<View<T>>(s.n_images);
  job.cloud_first = workspace.take<int32_t>(s.n_clouds);
  job.records = workspace.take<Record<T>>(job.max_pairs);
  job.slot_begin = backward ? workspace.take<uint32_t>(job.max_pairs) : nullptr;
  job.cursor = workspace.take<uint32_t>(n_spots);
  job.spot_begin = workspace.take<uint32_t>(n_spots + 1);
  job.entries = workspace.take<Entry<T>>(job.max_entries);
  job.spare = workspace.take<Entry<T>>(job.max_entries);
  return job;
}

// Blocks of the phases that take rows, or tiles by block or by warp; never more than a grid holds.
unsigned grid_for(int64_t n, int64_t per_block) {
  return static_cast<unsigned>(std::min<int64_t>((n + per_block - 1) / per_block, 1 << 20));
}

template <typename T>
void list_first_group(const Job<T>& job, Stream stream) {
  const int64_t n_spots = job.scene.n_images * job.n_spots;
  fill_zero(kOp, job.cursor, n_spots, stream);
  launch(kOp, plan_kernel<T>, 1, kOneBlock, 0, stream, job);
  dispatch_sh(job.scene.sh_terms, [&](auto terms) {
    launch(kOp, project_kernel<T, decltype(terms)::value>, grid_for(job.scene.n_rows, kBlock), kBlock, 0, stream, job);
  });
  launch(kOp, offsets_kernel<T>, 1, kOneBlock, 0, stream, job);
  launch(kOp, scatter_kernel<T>, grid_for(job.scene.n_rows, kBlock), kBlock, 0, stream, job);
  launch(kOp, sort_kernel<T>, grid_for(n_spots, 1), kBlock, 0, stream, job);
}

// As many blocks as are resident together, so that they may wait for each other.
template <typename... Formal>
void launch_together(void (*kernel)(Formal...), size_t shared_bytes, Stream stream, Formal... arguments) {
  check_cuda(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(shared_bytes)),
             kOp);
  int per_processor = 0, processors = 0;
  check_cuda(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&per_processor, kernel, kBlock, shared_bytes), kOp);
  check_cuda(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, stream.device), kOp);
  void* pointers[] = {&arguments...};
  check_cuda(cudaLaunchCooperativeKernel(reinterpret_cast<const void*>(kernel), dim3(per_processor * processors),
                                         dim3(kBlock), pointers, shared_bytes, native(stream)),
             kOp);
}

template <typename F>
void dispatch_fade(RasterCutoff cutoff, const F& f) {
  cutoff == RasterCutoff::kSmooth ? f(std::true_type{}) : f(std::false_type{});
}

}  // namespace

template <typename T>
void raster_forward(const RasterScene<T>& scene, const RasterImages<T>& images, const Workspace& workspace,
                    Stream stream) {
  const Job<T> job = make_job(scene, false, workspace);
  if (scene.n_images == 0) return;
  list_first_group(job, stream);
  const size_t shared_bytes = kWarps * sizeof(BlendShared<T>);
  dispatch_fade(scene.cutoff, [&](auto fade) {
    launch(kOp, blend_kernel<T, decltype(fade)::value>, grid_for(scene.n_images * job.n_spots, kWarps), kBlock,
           shared_bytes, stream, job, images);
    dispatch_sh(scene.sh_terms, [&](auto terms) {
      launch_together(rest_kernel<T, decltype(terms)::value, decltype(fade)::value>,
                      std::max(shared_bytes, kSortRun * sizeof(Entry<T>)), stream, job, images);
    });
  });
}

template <typename T>
void raster_backward(const RasterScene<T>& scene, const RasterImageGrads<T>& image_grads,
                     const RasterSceneGrads<T>& grads, const Workspace& workspace, Stream stream) {
  const Job<T> job = make_job(scene, true, workspace);
  fill_zero(kOp, grads.means, scene.n_rows * 3, stream);
  fill_zero(kOp, grads.quats, scene.n_rows * 4, stream);
  fill_zero(kOp, grads.scales, scene.n_rows * 3, stream);
  fill_zero(kOp, grads.opacities, scene.n_rows, stream);
  fill_zero(kOp, grads.color, scene.n_rows * std::max<int64_t>(1, scene.sh_terms) * 3, stream);
  fill_zero(kOp, grads.features, scene.n_rows * scene.n_features, stream);
  fill_zero(kOp, grads.background, scene.n_images * 3, stream);
  if (grads.viewmats) fill_zero(kOp, grads.viewmats, scene.n_images * 16, stream);
  if (scene.n_images == 0) return;

  Slots<T> slots{};
  slots.entries = workspace.take<T>(job.max_entries * (kSlotFixed + scene.n_features));
  slots.unfinished = workspace.take<T>(scene.n_rows * kSlotFixed);
  slots.backgrounds = workspace.take<T>(scene.n_images * job.n_spots * 3);
  if (grads.viewmats) slots.viewmats = workspace.take<T>(scene.n_images * kViewmatParts * 12);
  list_first_group(job, stream);
  const size_t shared_bytes = kWarps * sizeof(BlendGradShared<T>);
  dispatch_fade(scene.cutoff, [&](auto fade) {
    constexpr bool kFade = decltype(fade)::value;
    launch(kOp, blend_vjp_kernel<T, kFade>, grid_for(scene.n_images * job.n_spots, kWarps), kBlock, shared_bytes,
           stream, job, image_grads, slots);
    dispatch_sh(scene.sh_terms, [&](auto terms) {
      constexpr int kTerms = decltype(terms)::value;
      if (grads.viewmats)
        launch(kOp, gather_viewmats_kernel<T, kTerms>, grid_for(scene.n_images * kViewmatParts, 1), kBlock, 0, stream,
               job, slots);
      launch(kOp, gather_rows_kernel<T, kTerms>, grid_for(scene.n_rows, kBlock), kBlock, 0, stream, job, slots, grads);
      launch(kOp, gather_images_kernel<T>, grid_for(scene.n_images, 1), kBlock, 0, stream, job, slots, grads);
      launch_together(rest_vjp_kernel<T, kTerms, kFade>, std::max(shared_bytes, kSortRun * sizeof(Entry<T>)), stream,
                      job, image_grads, slots, grads);
    });
  });
}

#define GSIM3D_INSTANTIATE(T)                                                                                        \
  template void raster_forward<T>(const RasterScene<T>&, const RasterImages<T>&, const Workspace&, Stream);          \
  template void raster_backward<T>(const RasterScene<T>&, const RasterImageGrads<T>&, const RasterSceneGrads<T>&,    \
                                   const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
