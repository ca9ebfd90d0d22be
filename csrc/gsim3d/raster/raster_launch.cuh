// Inside of the CUDA rasterizer: memory of a call, the kernels that make lists, and how kernels are launched.
//
// The first group of images runs as one kernel a phase. Whatever did not fit into it (seldom anything) is left to one
// cooperative kernel that repeats all phases with scratch of its own until no tile is left: the host never needs to
// know how much there is, and the result does not depend on the size of the scratch.
#pragma once

#include <cooperative_groups.h>

#include <algorithm>
#include <map>
#include <utility>

#include "gsim3d/raster/raster_blend.cuh"
#include "gsim3d/raster/raster_check.h"
#include "gsim3d/raster/raster_sort.cuh"

namespace gsim3d::cuda {

using namespace raster;  // NOLINT: this is its other half

constexpr const char* kRaster = "rasterize_gaussians";
constexpr int kOneBlock = 1024;  // threads of the phases of one block

// Hands out aligned parts of one block of memory; without memory it counts what is needed.
class Arena {
 public:
  explicit Arena(void* memory = nullptr) : memory_(static_cast<unsigned char*>(memory)) {}

  template <typename T>
  T* take(int64_t count) {
    auto* at = memory_ ? reinterpret_cast<T*>(memory_ + used_) : nullptr;
    used_ += (count * static_cast<int64_t>(sizeof(T)) + 63) / 64 * 64;
    return at;
  }
  int64_t used() const { return used_; }

 private:
  unsigned char* memory_;
  int64_t used_ = 0;
};

// Arrays of a group; those that the backward pass reads again are kept.
template <typename T>
void take_group(Job<T>& job, Arena& kept, Arena& scratch) {
  const int64_t n_images = job.scene.n_images, n_tiles = n_images * job.n_tiles;
  job.group = kept.take<Group>(1);
  job.pair_begin = kept.take<int32_t>(n_images);
  job.bounds = kept.take<PixelRect>(job.limits.pairs);
  job.records = kept.take<Record<T>>(job.limits.pairs);
  job.slot_begin = kept.take<uint32_t>(job.limits.pairs);
  job.order = kept.take<uint32_t>(n_tiles);
  job.lists = kept.take<List>(n_tiles * kQuarters);
  job.listed = kept.take<uint32_t>(job.limits.slots);
  job.counters = scratch.take<uint32_t>(n_counters(job));
  job.slot_count = reinterpret_cast<unsigned long long*>(job.counters);
  job.slot_cursor = reinterpret_cast<uint32_t*>(job.slot_count + n_images);
  job.list_cursor = job.slot_cursor + n_images;
  job.cursor = job.list_cursor + n_images;
  job.covered = job.scene.active ? job.cursor + n_tiles : nullptr;
  job.bins = scratch.take<uint32_t>(kBins);
  job.tile_begin = scratch.take<uint32_t>(n_tiles + 1);
  job.depths = scratch.take<T>(job.limits.pairs);
  job.entries = scratch.take<Entry<T>>(job.limits.entries);
  job.spare = scratch.take<Entry<T>>(job.limits.entries);
}

// The job of the first group; its arrays are in `state`.
template <typename T>
Job<T> first_job(const RasterScene<T>& s, const RasterLimits& limits, Arena& kept, Arena& scratch) {
  Job<T> job{};
  job.scene = s;
  job.tiles_x = (s.width + kTile - 1) / kTile;
  job.n_tiles = job.tiles_x * ((s.height + kTile - 1) / kTile);
  job.limits = limits;
  job.views = kept.take<View<T>>(s.n_images);
  job.clouds = kept.take<Cloud>(s.n_clouds);
  take_group(job, kept, scratch);
  return job;
}

// The job of all further groups, with arrays of its own.
template <typename T>
Job<T> further_job(const Job<T>& first, Arena& scratch) {
  const RasterLimits& given = first.limits;
  const int64_t n_rows = first.scene.n_rows;
  constexpr int64_t kPairs = int64_t{1} << 20, kEntries = int64_t{1} << 22;
  Job<T> job = first;
  job.limits.pairs = std::max(n_rows, std::min(given.pairs, kPairs));
  job.limits.entries = std::max(n_rows, std::min(given.entries, kEntries));
  job.limits.slots = std::max(kQuarters * n_rows, std::min(given.slots, kEntries));
  take_group(job, scratch, scratch);
  return job;
}

// Blocks of the phases that take rows, or tiles by block or by warp; never more than a grid holds.
inline unsigned grid_for(int64_t n, int64_t per_block) {
  return static_cast<unsigned>(std::min<int64_t>((n + per_block - 1) / per_block, 1 << 20));
}

// Chunks of rows are not shared by clouds.
template <typename T>
unsigned grid_of_chunks(const RasterScene<T>& s) {
  return grid_for(s.n_rows + std::min(s.n_clouds, s.n_rows) * (kBlock - 1), kBlock);
}

// As many blocks as are resident together, so that they may wait for each other. Their number is asked for once.
template <typename... Formal>
void launch_together(void (*kernel)(Formal...), size_t shared_bytes, Stream stream, Formal... arguments) {
  thread_local std::map<std::pair<const void*, int32_t>, unsigned> known;
  const auto* code = reinterpret_cast<const void*>(kernel);
  unsigned& blocks = known[{code, stream.device}];
  if (blocks == 0) {
    int per_processor = 0, processors = 0;
    check_cuda(cudaFuncSetAttribute(code, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(shared_bytes)),
               kRaster);
    check_cuda(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&per_processor, kernel, kBlock, shared_bytes), kRaster);
    check_cuda(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, stream.device), kRaster);
    blocks = per_processor * processors;
  }
  void* pointers[] = {&arguments...};
  check_cuda(cudaLaunchCooperativeKernel(code, dim3(blocks), dim3(kBlock), pointers, shared_bytes, native(stream)),
             kRaster);
}

// Dynamic shared memory of rows of colours.
template <typename T, int kTerms>
constexpr size_t kRowBytes = SharedRows<T, kColorColumns<kTerms>>::kBytes;

// Calls f(fade, with features) with two std::bool_constant.
template <typename T, typename F>
void dispatch_blend(const RasterScene<T>& s, const F& f) {
  const auto with = [&](auto fade) { s.n_features ? f(fade, std::true_type{}) : f(fade, std::false_type{}); };
  s.cutoff == RasterCutoff::kSmooth ? with(std::true_type{}) : with(std::false_type{});
}

extern __shared__ __align__(32) unsigned char dynamic_memory[];

// The part of the dynamic shared memory that belongs to the calling warp.
template <typename Shared>
__device__ Shared& of_warp() {
  return reinterpret_cast<Shared*>(dynamic_memory)[threadIdx.x / kWarp];
}

// Whether tiles are left after the first group; then `job` starts behind it. Every block calls it.
template <typename T>
__device__ bool go_on(const Job<T>& first, const Job<T>& job) {
  if (first.group->tile_end >= job.scene.n_images * job.n_tiles) return false;
  if (blockIdx.x == 0 && threadIdx.x == 0) *job.group = *first.group;
  cooperative_groups::this_grid().sync();
  return true;
}

// dispatch_sh within a kernel.
template <typename F>
__device__ void dispatch_terms(int64_t terms, const F& f) {
  switch (terms) {
    case kProjected: return f(std::integral_constant<int, kProjected>{});
    case 0: return f(std::integral_constant<int, 0>{});
    case 1: return f(std::integral_constant<int, 1>{});
    case 4: return f(std::integral_constant<int, 4>{});
    case 9: return f(std::integral_constant<int, 9>{});
    default: return f(std::integral_constant<int, 16>{});
  }
}

// Lists of the next group; false when no tile is left. Every block calls it.
template <typename T>
__device__ bool next_group(const Job<T>& job) {
  const auto grid = cooperative_groups::this_grid();
  if (job.group->tile_end >= job.scene.n_images * job.n_tiles) return false;
  grid.sync();
  if (blockIdx.x == 0) choose_images(job);
  grid.sync();
  const int64_t first = job.group->first, last = job.group->last, thread = int64_t{blockIdx.x} * kBlock + threadIdx.x;
  for (int64_t i = first * job.n_tiles + thread; i < last * job.n_tiles; i += int64_t{gridDim.x} * kBlock)
    job.cursor[i] = 0;
  for (int64_t i = first * job.n_tiles + thread; job.covered && i < last * job.n_tiles; i += int64_t{gridDim.x} * kBlock)
    job.covered[i] = 0;
  for (int64_t i = first + thread; i < last; i += int64_t{gridDim.x} * kBlock)
    job.slot_count[i] = 0, job.slot_cursor[i] = 0, job.list_cursor[i] = 0;
  grid.sync();
  dispatch_terms(job.scene.sh_terms,
                 [&](auto terms) { project_rows<T, decltype(terms)::value>(job, dynamic_memory); });
  grid.sync();
  if (blockIdx.x == 0) find_offsets(job);
  grid.sync();
  find_order(job);
  scatter_rows(job);
  grid.sync();
  sort_lists<kBlock>(job, reinterpret_cast<Entry<T>*>(dynamic_memory));
  grid.sync();
  return true;
}

}  // namespace gsim3d::cuda
