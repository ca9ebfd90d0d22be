// Who takes part in a pyramid, and the clouds of every stage.
#include <cstring>
#include <cub/block/block_scan.cuh>
#include <vector>

#include "gsim3d/curve/curve_math.h"
#include "gsim3d/curve/pyramid_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = kPyramidThreads;
constexpr const char* kOp = "build_pyramid";
constexpr int kPlanThreads = 1024;

// Bits whose unsigned order is the order of doubles.
__device__ __forceinline__ uint64_t ordered_bits(double v) {
  const uint64_t bits = static_cast<uint64_t>(__double_as_longlong(v));
  return bits >> 63 ? ~bits : bits | uint64_t{1} << 63;
}
GSIM3D_HD double from_ordered(uint64_t bits) {
  const uint64_t own = bits >> 63 ? bits & ~(uint64_t{1} << 63) : ~bits;
  double v;
  memcpy(&v, &own, sizeof(v));
  return v;
}

template <typename T>
__global__ void extent_kernel(const T* __restrict__ positions, int64_t n, uint64_t* extent) {
  const int64_t i = thread_index();
  uint64_t low[3] = {~uint64_t{0}, ~uint64_t{0}, ~uint64_t{0}}, high[3] = {0, 0, 0};
  if (i < n) {
    const T* p = positions + 3 * i;
    if (isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2]))
      for (int a = 0; a < 3; ++a) low[a] = high[a] = ordered_bits(static_cast<double>(p[a]));
  }
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    for (int offset = kWarp / 2; offset > 0; offset /= 2) {
      low[a] = min(low[a], __shfl_xor_sync(kFullWarp, low[a], offset));
      high[a] = max(high[a], __shfl_xor_sync(kFullWarp, high[a], offset));
    }
    if (threadIdx.x % kWarp == 0 && low[a] <= high[a]) {
      atomicMin(reinterpret_cast<unsigned long long*>(extent + a), static_cast<unsigned long long>(low[a]));
      atomicMax(reinterpret_cast<unsigned long long*>(extent + 3 + a), static_cast<unsigned long long>(high[a]));
    }
  }
}

// Cell of a position; false where the row sleeps.
template <typename T>
__device__ __forceinline__ bool cell_of(const PyramidClouds<T>& clouds, int64_t i, double grid_size, bool release,
                                        double n_cells, const uint64_t* extent, uint64_t& cell, uint32_t& top) {
  const int64_t scene = clouds.scene[segment_of(clouds.cu_rows, clouds.n_clouds, i)];
  if (!inside(scene, clouds.n_scenes)) return false;
  const T* p = clouds.positions + 3 * i;
  uint32_t largest = 0;
  for (int a = 0; a < 3; ++a) {
    double v;
    if (release)
      v = static_cast<double>(trunc((p[a] - static_cast<T>(from_ordered(extent[a]))) / static_cast<T>(grid_size)));
    else
      v = floor((static_cast<double>(p[a]) - clouds.origin[3 * scene + a]) / grid_size);
    if (!(v >= 0 && v < n_cells)) return false;
    cell = cell << 16 | static_cast<uint64_t>(v);
    largest = max(largest, static_cast<uint32_t>(v));
  }
  top = max(top, largest);
  return true;
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    cells_kernel(PyramidClouds<T> clouds, double grid_size, bool release, double n_cells, Intake intake, Build build) {
  const int64_t tile = tile_of(build.tickets), begin = tile * kScanTile + threadIdx.x, n = clouds.n_rows;
  uint32_t top = 0;
  bool awake[kScanItems];
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    const int64_t i = begin + j * kThreads;
    uint64_t cell = 0;
    awake[j] = i < n && cell_of(clouds, i, grid_size, release, n_cells, intake.extent, cell, top);
    if (i < n) intake.cells[i] = awake[j] ? cell : ~uint64_t{0};
  }
  uint32_t before[kScanItems];
  const uint32_t up_to = number_tile(awake, tile, build.published, before);
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    const int64_t i = begin + j * kThreads;
    if (i < n) intake.start[i] = before[j];
    if (i == n) intake.start[n] = up_to;
  }
  top = __reduce_max_sync(kFullWarp, top);
  if (threadIdx.x % kWarp == 0 && top > 0) atomicMax(intake.top, top);
  if (!release || tile > 0 || threadIdx.x > 0 || intake.extent[0] > intake.extent[3]) return;
  for (int a = 0; a < 3; ++a) {
    const T low = static_cast<T>(from_ordered(intake.extent[a])),
            high = static_cast<T>(from_ordered(intake.extent[3 + a]));
    if ((high - low) / static_cast<T>(grid_size) >= T(32768)) *build.counts |= kTooWide;
  }
}

// Ids count the clouds that have rows, by scene and slot. One thread a cloud compares it with all others.
template <typename T>
__global__ void order_clouds_kernel(PyramidClouds<T> clouds, int64_t slot_bits, Intake intake, Build build) {
  const StageArrays& stage = build.stages[0];
  int64_t* stage_counts = build.counts + count_at(0, kRows);
  unsigned long long* status = reinterpret_cast<unsigned long long*>(build.counts);
  const int64_t q = thread_index(), n = clouds.n_clouds;
  const auto rows_of = [&](int64_t c) {
    const Range range = range_of(clouds.cu_rows, c, clouds.n_rows);
    return intake.start[range.end] - intake.start[range.begin];
  };
  bool good = true;
  if (q == 0) {
    good = clouds.cu_rows[0] == 0 && clouds.cu_rows[n] == clouds.n_rows;
    stage_counts[kRows] = intake.start[clouds.n_rows];
  }
  for (int64_t i = q; i < 3 * clouds.n_scenes; i += int64_t{gridDim.x} * kThreads)
    good &= static_cast<bool>(isfinite(clouds.origin[i]));
  if (q < n) {
    const int64_t scene = clouds.scene[q], slot = clouds.slot[q];
    good &= clouds.cu_rows[q] <= clouds.cu_rows[q + 1] && inside(scene, clouds.n_scenes) &&
            inside(slot, int64_t{1} << slot_bits);
    const uint32_t own = rows_of(q);
    uint32_t rank = 0, present = 0, start = 0;
    for (int64_t c = 0; c < n; ++c) {
      const int64_t other = clouds.scene[c];
      const bool same = other == scene, before = same ? clouds.slot[c] < slot : other < scene;
      good &= c == q || !same || clouds.slot[c] != slot;
      const uint32_t count = rows_of(c);
      present += count > 0;
      if (!before) continue;
      rank += count > 0;
      start += count;
    }
    intake.cloud_id[q] = rank;
    if (own > 0) {
      stage.scene[rank] = scene;
      stage.slot[rank] = slot;
      stage.members[rank] = rank;
      stage.run_starts[rank] = start;
    }
    if (q == 0) {
      stage.members[present] = present;
      stage.run_starts[present] = intake.start[clouds.n_rows];
      stage_counts[kClouds] = present;
      if (present > 65536) atomicOr(status, 1ull * kTooManyClouds);
    }
  }
  if (!good) atomicOr(status, 1ull * kBadClouds);
}

// The clouds of every stage from those of the stage before, and how many levels codes keep: one block, a chunk of
// clouds at a time. A malformed call goes on without rows until the host sees its status.
__global__ void __launch_bounds__(kPlanThreads)
    plan_stages_kernel(Build build, const uint32_t* top, bool release, int given_depth) {
  using Scan = cub::BlockScan<uint32_t, kPlanThreads>;
  __shared__ typename Scan::TempStorage storage;
  const bool good = build.counts[0] == 0;
  if (threadIdx.x == 0) {
    // The published depth follows the extent; where a stride drops more bits than are left, it drops none. Ours has 16
    // levels, of which those that are zero in all codes need no room below the cloud.
    int dropped = 0;
    for (int64_t s = 0; s < build.n_stages; ++s) dropped += build.drop[s];
    int depth = release ? min(33 - __clz(*top), kMaxDepth) : max(32 - __clz(*top), dropped);
    if (given_depth > 0) depth = given_depth;
    for (int64_t s = 0; s < build.n_stages; ++s) {
      if (build.drop[s] > depth) build.drop[s] = 0;
      depth -= build.drop[s];
      build.depth[s] = depth;
    }
    if (!good) build.counts[count_at(0, kRows)] = build.counts[count_at(0, kClouds)] = 0;
  }
  __syncthreads();
  int64_t n = good ? build.counts[count_at(0, kClouds)] : 0;
  for (int64_t s = 1; s < build.n_stages; ++s) {
    const StageArrays &before = build.stages[s - 1], &stage = build.stages[s];
    const int bits = stage.merged_bits;
    uint32_t ids = 0;
    for (int64_t begin = 0; begin < n; begin += kPlanThreads) {
      const int64_t c = begin + threadIdx.x;
      uint32_t first = 0;
      if (c < n)
        first =
            c == 0 || before.scene[c] != before.scene[c - 1] || before.slot[c] >> bits != before.slot[c - 1] >> bits;
      uint32_t id, total;
      Scan(storage).InclusiveSum(first, id, total);
      id += ids - 1;
      if (c < n) before.merged[c] = id;
      if (first) {
        stage.scene[id] = before.scene[c];
        stage.slot[id] = before.slot[c] >> bits;
        stage.members[id] = static_cast<uint32_t>(c);
      }
      ids += total;
      __syncthreads();
    }
    if (threadIdx.x == 0) {
      stage.members[ids] = static_cast<uint32_t>(n);
      build.counts[count_at(s, kClouds)] = ids;
    }
    n = ids;
    __syncthreads();
  }
}

}  // namespace

template <typename T>
void find_clouds(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Intake& intake, const Build& build,
                 Stream stream) {
  const int64_t n = clouds.n_rows;
  if (spec.release) {
    check_cuda(cudaMemsetAsync(intake.extent, 0xff, 3 * sizeof(uint64_t), native(stream)), kOp);
    fill_zero(kOp, intake.extent + 3, 3, stream);
    launch(kOp, extent_kernel<T>, blocks_of(n), kThreads, 0, stream, clouds.positions, n, intake.extent);
  }
  launch(kOp, cells_kernel<T>, blocks_for(kOp, tiles_of(n + 1), 1), kThreads, 0, stream, clouds, spec.grid_size,
         spec.release, static_cast<double>(int64_t{1} << (spec.depth > 0 ? spec.depth : kMaxDepth)), intake, build);
  launch(kOp, order_clouds_kernel<T>, blocks_of(std::max<int64_t>(clouds.n_clouds, 1)), kThreads, 0, stream, clouds,
         spec.slot_bits, intake, build);
  launch(kOp, plan_stages_kernel, 1, kPlanThreads, 0, stream, build, intake.top, spec.release,
         static_cast<int>(spec.depth));
}

template <typename T>
void raise_status(int64_t status, const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Intake& intake,
                  Stream stream) {
  const auto copy = [&]<typename U>(const U* from, int64_t n) {
    std::vector<U> values(static_cast<size_t>(n));
    if (n > 0)
      check_cuda(cudaMemcpyAsync(values.data(), from, n * sizeof(U), cudaMemcpyDeviceToHost, native(stream)), kOp);
    check_cuda(cudaStreamSynchronize(native(stream)), kOp);
    return values;
  };
  if (status & kBadClouds) {
    const auto cu_rows = copy(clouds.cu_rows, clouds.n_clouds + 1);
    const auto scene = copy(clouds.scene, clouds.n_clouds), slot = copy(clouds.slot, clouds.n_clouds);
    const auto origin = copy(clouds.origin, 3 * clouds.n_scenes);
    PyramidClouds<T> on_host = clouds;
    on_host.cu_rows = cu_rows.data();
    on_host.scene = scene.data();
    on_host.slot = slot.data();
    on_host.origin = origin.data();
    cpu::check_clouds(on_host, spec);
  }
  if (status & kTooWide) {
    const auto extent = copy(intake.extent, 6);
    T low[3], high[3];
    for (int a = 0; a < 3; ++a) {
      low[a] = static_cast<T>(from_ordered(extent[a]));
      high[a] = static_cast<T>(from_ordered(extent[3 + a]));
    }
    cpu::check_extent(low, high, spec.grid_size);
  }
  detail::fail(kOp, ": at most 65536 clouds may have rows");
}

#define GSIM3D_INSTANTIATE(T)                                                                                     \
  template void find_clouds<T>(const PyramidClouds<T>&, const PyramidSpec&, const Intake&, const Build&, Stream); \
  template void raise_status<T>(int64_t, const PyramidClouds<T>&, const PyramidSpec&, const Intake&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
