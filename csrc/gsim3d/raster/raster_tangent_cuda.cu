// Forward mode on CUDA: derivatives of the images along tangents of the arguments. The lists are those of the forward
// pass, the records and what is blended are numbers that carry a derivative.
#include "gsim3d/raster/raster_launch.cuh"

namespace gsim3d::cuda {
namespace {

// The number of the forward pass, with another's derivative.
template <typename T>
__device__ Dual<T> with(T value, const Dual<T>& other) {
  return dual(value, other.along[0]);
}

// As make_record.
template <typename T, int kTerms>
__device__ Record<Dual<T>> tangent_of(const Record<T>& r, const DualRow<T, kTerms>& of) {
  const Projection<Dual<T>>& p = of.projection;
  const T half = T(kLog2eHalf);
  return {.x = with(r.x, p.x),
          .y = with(r.y, p.y),
          .slope = with(r.slope, of.shape.slope),
          .tight = with(r.tight, projection::root(of.shape.tight * half)),
          .loose = with(r.loose, projection::root(of.shape.loose * half)),
          .strength = with(r.strength, of.opacity * (2 * half / of.opacity.value)),
          .z = with(r.z, p.z),
          .x0 = r.x0,
          .x1 = r.x1,
          .red = with(r.red, of.color[0]),
          .green = with(r.green, of.color[1]),
          .blue = with(r.blue, of.color[2]),
          .y0 = r.y0,
          .y1 = r.y1};
}

// Records of the group's pairs that are seen; the others stay unset, as theirs.
template <typename T, int kTerms>
__device__ void project_tangents(const Job<T>& job, const RasterTangents<T>& tangents, Record<Dual<T>>* records) {
  const int64_t last = job.group->last, n_chunks = count_chunks(job);
  for (int64_t chunk = blockIdx.x; chunk < n_chunks; chunk += gridDim.x) {
    const Rows rows(job, chunk);
    if (!rows.inside) continue;
    for (int64_t image = rows.first_image; image < last; image = job.views[image].next) {
      const int64_t pair = job.pair_begin[image] + rows.row - job.views[image].row_begin;
      const PixelRect bounds = job.bounds[pair];
      if (bounds.x0 >= bounds.x1) continue;
      const DualRow<T, kTerms> of(job.scene, tangents, dual_camera(job.scene, tangents, image), rows.row);
      store_record(tangent_of(job.records[pair], of), records + pair);
    }
  }
}

template <typename T, int kTerms>
__global__ void __launch_bounds__(kBlock) project_tangents_kernel(Job<T> job, RasterTangents<T> tangents,
                                                                  Record<Dual<T>>* records) {
  project_tangents<T, kTerms>(job, tangents, records);
}

template <typename T, bool kFade, bool kWithFeatures>
__global__ void __launch_bounds__(kWarp) blend_tangents_kernel(Job<T> job, Seen<Dual<T>> seen, RasterImages<T> images) {
  blend_tiles<kFade>(job, seen, images, of_warp<BlendShared<Dual<T>, kWithFeatures>>());
}

template <typename T, bool kFade>
__global__ void __launch_bounds__(kBlock) further_tangents_kernel(Job<T> first, Job<T> job, RasterTangents<T> tangents,
                                                                  Record<Dual<T>>* records, RasterImages<T> images) {
  if (!go_on(first, job)) return;
  while (next_group(job)) {
    dispatch_terms(job.scene.sh_terms, [&](auto terms) {
      constexpr int kTerms = decltype(terms)::value;
      if constexpr (kTerms >= 0) project_tangents<T, kTerms>(job, tangents, records);
    });
    cooperative_groups::this_grid().sync();
    blend_tiles<kFade>(job, Seen<Dual<T>>{records, tangents}, images, of_warp<BlendShared<Dual<T>, true>>());
    cooperative_groups::this_grid().sync();
  }
}

}  // namespace

template <typename T>
void raster_tangent(const RasterScene<T>& scene, const RasterTangents<T>& tangents, const RasterImages<T>& images,
                    const RasterLimits& limits, void* state, const Workspace& workspace, Stream stream) {
  check_options(scene);
  check_limits(scene, limits);
  if (scene.n_images == 0) return;
  Arena kept(state), unused, count;
  const Job<T> job = first_job(scene, limits, kept, unused);
  further_job(job, count);
  count.take<Record<Dual<T>>>(limits.pairs);
  Arena scratch(workspace.take<unsigned char>(count.used()));
  const Job<T> further = further_job(job, scratch);
  auto* const records = scratch.take<Record<Dual<T>>>(limits.pairs);  // no group has more

  dispatch_sh(scene.sh_terms, [&](auto terms) {
    constexpr int kTerms = decltype(terms)::value;
    if constexpr (kTerms >= 0)
      launch(kRaster, project_tangents_kernel<T, kTerms>, grid_of_chunks(scene), kBlock, 0, stream, job, tangents,
             records);
  });
  dispatch_blend(scene, [&](auto fade, auto with_features) {
    constexpr bool kFade = decltype(fade)::value, kWithFeatures = decltype(with_features)::value;
    launch(kRaster, blend_tangents_kernel<T, kFade, kWithFeatures>,
           grid_for(scene.n_images * job.n_tiles * kQuarters, 1), kWarp, sizeof(BlendShared<Dual<T>, kWithFeatures>),
           stream, job, Seen<Dual<T>>{records, tangents}, images);
  });
  const auto rest = [&](auto fade) {
    launch_together(further_tangents_kernel<T, decltype(fade)::value>,
                    std::max({kWarps * sizeof(BlendShared<Dual<T>, true>), kSortBytes<T, kBlock>, kRowBytes<T, 16>}),
                    stream, job, further, tangents, records, images);
  };
  scene.cutoff == RasterCutoff::kSmooth ? rest(std::true_type{}) : rest(std::false_type{});
}

#define GSIM3D_INSTANTIATE(T)                                                                                         \
  template void raster_tangent<T>(const RasterScene<T>&, const RasterTangents<T>&, const RasterImages<T>&,            \
                                  const RasterLimits&, void*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
