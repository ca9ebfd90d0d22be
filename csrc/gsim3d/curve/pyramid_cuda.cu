// The stages of a pyramid. Rows are sorted along the four curves once: a code without its lowest bits is the code of the
// coarser cell, so the lists of a stage are those of the stage before without the rows that pooling joins, and merging
// clouds in time interleaves runs that are sorted already.
#include <algorithm>
#include <bit>
#include <cstring>
#include <cub/block/block_scan.cuh>
#include <utility>
#include <vector>

#include "gsim3d/curve/curve.h"
#include "gsim3d/curve/pyramid_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = kPyramidThreads;
constexpr const char* kOp = "build_pyramid";
constexpr int kPlanThreads = 1024;

// What a call finds out about its input before the first stage.
struct Intake {
  uint64_t* extent;     // [6], lowest and highest position an axis as ordered bits; release only
  uint32_t* top;        // [1], largest cell coordinate
  uint64_t* cells;      // [n_rows], x, y, z
  uint32_t* awake;      // [n_rows + 1]
  uint32_t* start;      // [n_rows + 1], rows awake before
  uint32_t* cloud_id;   // [n_clouds]
  uint32_t* rows;       // [room], input rows that take part
};

int log2_of(int64_t power_of_two) { return std::countr_zero(static_cast<uint64_t>(power_of_two)); }

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

template <typename T>
__global__ void cells_kernel(PyramidClouds<T> clouds, double grid_size, bool release, Intake intake, int64_t* status) {
  const int64_t i = thread_index();
  if (i == 0) intake.awake[clouds.n_rows] = 0;
  uint32_t top = 0;
  if (i < clouds.n_rows) {
    const int64_t q = segment_of(clouds.cu_rows, clouds.n_clouds, i), scene = clouds.scene[q];
    const T* p = clouds.positions + 3 * i;
    bool awake = inside(scene, clouds.n_scenes);
    uint64_t cell = 0;
    for (int a = 0; a < 3 && awake; ++a) {
      double v;
      if (release) {
        const T corner = static_cast<T>(from_ordered(intake.extent[a]));
        v = static_cast<double>(trunc((p[a] - corner) / static_cast<T>(grid_size)));
      } else {
        v = floor((static_cast<double>(p[a]) - clouds.origin[3 * scene + a]) / grid_size);
      }
      awake = v >= 0 && v < 65536;
      if (!awake) break;
      cell = cell << 16 | static_cast<uint64_t>(v);
      top = max(top, static_cast<uint32_t>(v));
    }
    intake.cells[i] = cell;
    intake.awake[i] = awake;
    if (!awake) top = 0;
  }
  if (!release) return;
  if (i == 0 && intake.extent[0] <= intake.extent[3])
    for (int a = 0; a < 3; ++a) {
      const T low = static_cast<T>(from_ordered(intake.extent[a]));
      const T high = static_cast<T>(from_ordered(intake.extent[3 + a]));
      if ((high - low) / static_cast<T>(grid_size) >= T(32768)) *status |= kTooWide;
    }
  top = __reduce_max_sync(kFullWarp, top);
  if (threadIdx.x % kWarp == 0) atomicMax(intake.top, top);
}

// Ids count the clouds that have rows, by scene and slot. One thread a cloud compares it with all others.
template <typename T>
__global__ void order_clouds_kernel(PyramidClouds<T> clouds, int64_t slot_bits, Intake intake, StageArrays stage,
                                    int64_t* status, int64_t* stage_counts) {
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
      if (present > 65536) atomicOr(reinterpret_cast<unsigned long long*>(status), 1ull * kTooManyClouds);
    }
  }
  if (!good) atomicOr(reinterpret_cast<unsigned long long*>(status), 1ull * kBadClouds);
}

// The clouds of a stage from those of the stage before: one block, a chunk of clouds at a time.
__global__ void merge_clouds_kernel(StageArrays before, StageArrays stage, int merged_bits, const int64_t* clouds_before,
                                    int64_t* clouds) {
  using Scan = cub::BlockScan<uint32_t, kPlanThreads>;
  __shared__ typename Scan::TempStorage storage;
  const int64_t n = *clouds_before;
  uint32_t ids = 0;
  for (int64_t begin = 0; begin < n; begin += kPlanThreads) {
    const int64_t c = begin + threadIdx.x;
    uint32_t first = 0;
    if (c < n)
      first = c == 0 || before.scene[c] != before.scene[c - 1] ||
              before.slot[c] >> merged_bits != before.slot[c - 1] >> merged_bits;
    uint32_t id, total;
    Scan(storage).InclusiveSum(first, id, total);
    id += ids - 1;
    if (c < n) before.merged[c] = id;
    if (first) {
      stage.scene[id] = before.scene[c];
      stage.slot[id] = before.slot[c] >> merged_bits;
      stage.members[id] = static_cast<uint32_t>(c);
    }
    ids += total;
    __syncthreads();
  }
  if (threadIdx.x > 0) return;
  stage.members[ids] = static_cast<uint32_t>(n);
  *clouds = ids;
}

// The published depth follows the extent; where a stride drops more bits than are left, it drops none. A malformed call
// goes on without rows until the host sees its status.
__global__ void plan_depths_kernel(const uint32_t* top, Levels levels, int64_t n_stages, int64_t* counts) {
  if (*counts != 0) counts[count_at(0, kRows)] = 0;
  int depth = top ? min(33 - __clz(*top), kMaxDepth) : kMaxDepth;
  for (int64_t s = 0; s < n_stages; ++s) {
    if (*counts != 0) counts[count_at(s, kClouds)] = 0;
    if (levels.drop[s] > depth) levels.drop[s] = 0;
    depth -= levels.drop[s];
    levels.depth[s] = depth;
  }
}

__global__ void encode_kernel(int64_t n, int64_t room, Intake intake, const int64_t* cu_rows, int64_t n_clouds,
                              const int32_t* depth_of_stage, StageArrays stage, uint64_t* __restrict__ codes) {
  const int64_t i = thread_index();
  if (i >= n || !intake.awake[i]) return;
  const int64_t to = intake.start[i];
  const uint64_t id = intake.cloud_id[segment_of(cu_rows, n_clouds, i)], cell = intake.cells[i];
  const uint32_t x = cell >> 32, y = cell >> 16 & kAxisMask, z = cell & kAxisMask;
  const int depth = *depth_of_stage;
  intake.rows[to] = static_cast<uint32_t>(i);
  stage.cells[to] = id << 48 | cell;
  const uint64_t high = id << (3 * depth);
#pragma unroll
  for (int c = 0; c < kCurves; ++c) codes[c * room + to] = high | curve_code(static_cast<Curve>(c), x, y, z, depth);
}

// Orders rows of equal codes by position, then by row: each row of a run counts those before it.
template <typename T>
__global__ void order_ties_kernel(const uint64_t* __restrict__ codes, const uint32_t* __restrict__ sorted,
                                  const uint32_t* __restrict__ input_rows, const T* __restrict__ positions, int64_t room,
                                  const int64_t* n_rows, uint32_t* __restrict__ rows) {
  const int64_t at = thread_index(), n = *n_rows, i = at % room, list = at - i;
  if (at >= kCurves * room || i >= n) return;
  codes += list;
  sorted += list;
  const uint64_t code = codes[i];
  int64_t begin = i, end = i + 1;
  while (begin > 0 && codes[begin - 1] == code) --begin;
  while (end < n && codes[end] == code) ++end;
  const uint32_t row = sorted[i];
  int64_t rank = 0;
  if (end - begin > 1) {
    const T* p = positions + 3 * int64_t{input_rows[row]};
    const T x = p[0], y = p[1], z = p[2];
    for (int64_t j = begin; j < end; ++j) {
      const uint32_t other = sorted[j];
      const T* q = positions + 3 * int64_t{input_rows[other]};
      const bool before = q[0] != x ? q[0] < x : q[1] != y ? q[1] < y : q[2] != z ? q[2] < z : other < row;
      rank += before;
    }
  }
  rows[list + begin + rank] = row;
}

// Marks the first row of every cluster in every list.
__global__ void flag_clusters_kernel(StageArrays before, int64_t room, const int64_t* n_rows, const int32_t* drop,
                                     uint32_t* __restrict__ flags) {
  const int64_t at = thread_index(), i = at % room;
  if (at > kCurves * room) return;
  const int shift = 3 * *drop;
  flags[at] = at < kCurves * room && i < *n_rows &&
              (i == 0 || before.codes[at] >> shift != before.codes[at - 1] >> shift);
}

// Rows of the new stage, in the order of one list of the stage before. `sums`: flags before each place.
__global__ void make_rows_kernel(StageArrays before, StageArrays stage, int64_t list, int64_t room, int merged_bits,
                                 const uint32_t* __restrict__ sums, const int64_t* rows_before, const int32_t* drop,
                                 const int32_t* depth_before, uint32_t* __restrict__ cluster_of_row, int64_t* n_rows) {
  const int64_t i = thread_index(), n = *rows_before;
  sums += list * room;
  const uint64_t* codes = before.codes + list * room;
  if (i == 0) {
    const uint32_t clusters = sums[n] - sums[0];
    stage.cu_cluster[clusters] = static_cast<uint32_t>(n);
    *n_rows = clusters;
  }
  if (i >= n) return;
  const int shift = 3 * *drop;
  const bool first = i == 0 || codes[i] >> shift != codes[i - 1] >> shift;
  const uint32_t id = sums[i] - sums[0] + first - 1, row = before.rows[list * room + i];
  cluster_of_row[row] = id;
  if (!first) return;
  const uint32_t cloud = static_cast<uint32_t>(codes[i] >> (3 * *depth_before));
  const uint64_t cell = before.cells[row];
  const uint32_t x = (cell >> 32 & kAxisMask) >> *drop, y = (cell >> 16 & kAxisMask) >> *drop;
  stage.cells[id] = uint64_t{before.merged[cloud]} << 48 | uint64_t{x} << 32 | uint64_t{y} << 16 |
                    (cell & kAxisMask) >> *drop;
  stage.cu_cluster[id] = static_cast<uint32_t>(i);
  if (stage.time_index)
    stage.time_index[id] = static_cast<uint32_t>(before.slot[cloud] & ((int64_t{1} << merged_bits) - 1));
}

// The lists of the new stage, still by the clouds of the stage before.
__global__ void make_lists_kernel(StageArrays before, int64_t room, const uint32_t* __restrict__ sums,
                                  const uint32_t* __restrict__ cluster_of_row, const int64_t* rows_before,
                                  const int64_t* clouds_before, const int32_t* drop, const int32_t* depth_before,
                                  uint32_t* __restrict__ run_starts, uint64_t* __restrict__ codes,
                                  uint32_t* __restrict__ rows) {
  const int64_t at = thread_index(), i = at % room, list = at - i, n = *rows_before;
  if (at >= kCurves * room) return;
  if (at == 0) run_starts[*clouds_before] = sums[n] - sums[0];
  if (i >= n) return;
  const int shift = 3 * *drop;
  const uint64_t code = before.codes[at] >> shift, earlier = i > 0 ? before.codes[at - 1] >> shift : 0;
  if (i > 0 && code == earlier) return;
  const int64_t to = sums[at] - sums[list];
  codes[list + to] = code;
  rows[list + to] = cluster_of_row[before.rows[at]];
  const int space = 3 * *depth_before - shift;
  if (list == 0 && (i == 0 || code >> space != earlier >> space)) run_starts[code >> space] = static_cast<uint32_t>(to);
}

// Interleaves the runs of the clouds that become one. Equal codes keep the order of the clouds, which is that of rows.
__global__ void merge_runs_kernel(StageArrays before, StageArrays stage, int64_t room,
                                  const uint64_t* __restrict__ run_codes, const uint32_t* __restrict__ run_rows,
                                  const int64_t* n_rows, const int32_t* depth) {
  const int64_t at = thread_index(), i = at % room, list = at - i;
  if (at >= kCurves * room || i >= *n_rows) return;
  run_codes += list;
  const int bits = 3 * *depth;
  const uint64_t mask = (uint64_t{1} << bits) - 1, code = run_codes[i], space = code & mask;
  const uint32_t own = static_cast<uint32_t>(code >> bits), id = before.merged[own];
  int64_t to = stage.run_starts[stage.members[id]] + i - stage.run_starts[own];
  for (uint32_t run = stage.members[id]; run < stage.members[id + 1]; ++run) {
    if (run == own) continue;
    const int64_t begin = stage.run_starts[run], end = stage.run_starts[run + 1];
    to += partition_point(begin, end, [&](int64_t j) {
            const uint64_t other = run_codes[j] & mask;
            return run < own ? other <= space : other < space;
          }) - begin;
  }
  stage.codes[list + to] = uint64_t{id} << bits | space;
  stage.rows[list + to] = run_rows[list + i];
}

// The curve of each serialization row.
struct Curves {
  int32_t of_row[kSerializations];
};

__global__ void write_rows_kernel(StageArrays stage, int64_t n, int64_t room, Curves curves, int64_t* __restrict__ grid,
                                  int64_t* __restrict__ cloud, int64_t* __restrict__ order,
                                  int64_t* __restrict__ cu_cluster, int64_t* __restrict__ time_index) {
  const int64_t i = thread_index();
  if (cu_cluster && i <= n) cu_cluster[i] = stage.cu_cluster[i];
  if (i >= n) return;
  const uint64_t cell = stage.cells[i];
  cloud[i] = static_cast<int64_t>(cell >> 48);
  grid[3 * i] = static_cast<int64_t>(cell >> 32 & kAxisMask);
  grid[3 * i + 1] = static_cast<int64_t>(cell >> 16 & kAxisMask);
  grid[3 * i + 2] = static_cast<int64_t>(cell & kAxisMask);
  if (time_index) time_index[i] = stage.time_index[i];
#pragma unroll
  for (int r = 0; r < kSerializations; ++r) order[r * n + i] = stage.rows[curves.of_row[r] * room + i];
}

__global__ void widen_kernel(const uint32_t* __restrict__ from, int64_t n, int64_t* __restrict__ to) {
  const int64_t i = thread_index();
  if (i < n) to[i] = from[i];
}

// Raises what the CPU raises.
template <typename T>
[[noreturn]] void fail(int64_t status, const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Intake& intake,
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

// All arrays of the stages, in the order in which they are filled.
std::vector<StageArrays> take_stages(const PyramidSpec& spec, int64_t room, int64_t n_clouds, const Workspace& workspace) {
  std::vector<StageArrays> stages;
  uint64_t* cells = workspace.take<uint64_t>(spec.n_stages * room);
  uint32_t* voxel_rows = workspace.take<uint32_t>(spec.n_stages * room);
  for (int64_t s = 0; s < spec.n_stages; ++s) {
    uint32_t* tables = workspace.take<uint32_t>(6 * (n_clouds + 1));
    const auto table = [&] { return std::exchange(tables, tables + n_clouds + 1); };
    int64_t* keys = workspace.take<int64_t>(2 * n_clouds);
    StageArrays stage;
    stage.cells = cells + s * room;
    stage.codes = workspace.take<uint64_t>(kCurves * room);
    stage.rows = workspace.take<uint32_t>(kCurves * room);
    stage.cu_cluster = workspace.take<uint32_t>(room + 1);
    stage.time_index = nullptr;
    stage.scene = keys;
    stage.slot = keys + n_clouds;
    stage.merged = table();
    stage.members = table();
    stage.run_starts = table();
    stage.cu_clouds = table();
    stage.cu_patches = table();
    stage.cu_keys = table();
    stage.voxel_rows = voxel_rows + s * room;
    stage.row_voxel = workspace.take<uint32_t>(room);
    stage.cu_voxels = workspace.take<uint32_t>(room + 1);
    stage.voxels = workspace.take<uint64_t>(room);
    stages.push_back(stage);
  }
  return stages;
}

}  // namespace

template <typename T>
void build_pyramid(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                   const Workspace& workspace, Stream stream) {
  cpu::check_spec(spec);
  const int64_t n = clouds.n_rows, room = std::max<int64_t>(n, 1), n_stages = spec.n_stages;
  check(n < int64_t{1} << 29, kOp, ": positions must have fewer than 2^29 rows; got ", n);
  const int cloud_bits = std::bit_width(static_cast<uint64_t>(std::clamp<int64_t>(clouds.n_clouds - 1, 0, 65535)));
  const int64_t n_kernels = spec.cu_kernels[n_stages], n_counts = pairs_at(n_stages, n_kernels);
  const unsigned blocks = blocks_of(room), list_blocks = blocks_of(kCurves * room + 1);

  int64_t* counts = workspace.take<int64_t>(n_counts);
  fill_zero(kOp, counts, n_counts, stream);
  const auto count = [&](int64_t stage, Count what) { return counts + count_at(stage, what); };
  std::vector<StageArrays> stages = take_stages(spec, room, clouds.n_clouds, workspace);
  const Levels levels{workspace.take<int32_t>(n_stages), workspace.take<int32_t>(n_stages)};
  Intake intake{workspace.take<uint64_t>(6),
                workspace.take<uint32_t>(1),
                workspace.take<uint64_t>(room),
                workspace.take<uint32_t>(room + 1),
                workspace.take<uint32_t>(room + 1),
                workspace.take<uint32_t>(clouds.n_clouds),
                workspace.take<uint32_t>(room)};

  if (clouds.n_clouds == 0 && n > 0) fail(kBadClouds, clouds, spec, intake, stream);

  // Who takes part, and the clouds of every stage.
  fill_zero(kOp, intake.top, 1, stream);
  if (spec.release) {
    check_cuda(cudaMemsetAsync(intake.extent, 0xff, 3 * sizeof(uint64_t), native(stream)), kOp);
    fill_zero(kOp, intake.extent + 3, 3, stream);
    launch(kOp, extent_kernel<T>, blocks, kThreads, 0, stream, clouds.positions, n, intake.extent);
  }
  launch(kOp, cells_kernel<T>, blocks, kThreads, 0, stream, clouds, spec.grid_size, spec.release, intake, counts);
  exclusive_sums(kOp, intake.awake, n + 1, intake.start, workspace, stream);
  launch(kOp, order_clouds_kernel<T>, blocks_of(std::max<int64_t>(clouds.n_clouds, 1)), kThreads, 0, stream, clouds,
         spec.slot_bits, intake, stages[0], counts, count(0, kRows));
  std::vector<int> merged_bits(static_cast<size_t>(n_stages), 0);
  std::vector<int32_t> drops;
  int64_t slot_bits = spec.slot_bits;
  for (int64_t s = 0; s < n_stages; ++s) {
    drops.push_back(s > 0 ? log2_of(spec.strides[s - 1]) : 0);
    if (s == 0) continue;
    merged_bits[s] = static_cast<int>(std::min<int64_t>(log2_of(spec.merge_windows[s - 1]), slot_bits));
    slot_bits -= merged_bits[s];
    if (merged_bits[s] > 0) stages[s].time_index = workspace.take<uint32_t>(room);
    launch(kOp, merge_clouds_kernel, 1, kPlanThreads, 0, stream, stages[s - 1], stages[s], merged_bits[s],
           count(s - 1, kClouds), count(s, kClouds));
  }
  check_cuda(cudaMemcpyAsync(levels.drop, drops.data(), n_stages * sizeof(int32_t), cudaMemcpyHostToDevice, native(stream)),
             kOp);
  launch(kOp, plan_depths_kernel, 1, 1, 0, stream, spec.release ? intake.top : nullptr, levels, n_stages,
         counts);

  // The first stage: one sort a curve.
  uint64_t* run_codes = workspace.take<uint64_t>(kCurves * room);  // also the codes before the sort
  uint32_t* run_rows = workspace.take<uint32_t>(kCurves * room);
  launch(kOp, encode_kernel, blocks, kThreads, 0, stream, n, room, intake, clouds.cu_rows, clouds.n_clouds, levels.depth,
         stages[0], run_codes);
  sort_rows(kOp,
            {.keys = run_codes,
             .n_rows = kCurves,
             .room = room,
             .bits = 3 * kMaxDepth + cloud_bits,
             .sizes = count(0, kRows),
             .sorted = stages[0].codes,
             .index = spec.release ? stages[0].rows : run_rows},
            workspace, stream);
  if (!spec.release)
    launch(kOp, order_ties_kernel<T>, list_blocks, kThreads, 0, stream, stages[0].codes, run_rows, intake.rows,
           clouds.positions, room, count(0, kRows), stages[0].rows);

  // The others: lists of the stage before without the rows that pooling joins.
  uint32_t* flags = workspace.take<uint32_t>(kCurves * room + 1);
  uint32_t* sums = workspace.take<uint32_t>(kCurves * room + 1);
  uint32_t* cluster_of_row = workspace.take<uint32_t>(room);
  for (int64_t s = 1; s < n_stages; ++s) {
    const StageArrays& before = stages[s - 1];
    const StageArrays& stage = stages[s];
    const int32_t* drop = levels.drop + s;
    launch(kOp, flag_clusters_kernel, list_blocks, kThreads, 0, stream, before, room, count(s - 1, kRows), drop, flags);
    exclusive_sums(kOp, flags, kCurves * room + 1, sums, workspace, stream);
    launch(kOp, make_rows_kernel, blocks, kThreads, 0, stream, before, stage, spec.curves[(s - 1) * kSerializations], room,
           merged_bits[s], sums, count(s - 1, kRows), drop, levels.depth + s - 1, cluster_of_row, count(s, kRows));
    const bool merges = merged_bits[s] > 0;
    launch(kOp, make_lists_kernel, list_blocks, kThreads, 0, stream, before, room, sums, cluster_of_row,
           count(s - 1, kRows), count(s - 1, kClouds), drop, levels.depth + s - 1, stage.run_starts,
           merges ? run_codes : stage.codes, merges ? run_rows : stage.rows);
    if (merges)
      launch(kOp, merge_runs_kernel, list_blocks, kThreads, 0, stream, before, stage, room, run_codes, run_rows,
             count(s, kRows), levels.depth + s);
  }

  std::vector<MapArrays> maps(static_cast<size_t>(n_kernels));
  find_voxels(stages.data(), n_stages, room, cloud_bits, counts, workspace, stream);
  count_pairs(stages.data(), spec, room, counts, maps.data(), workspace, stream);
  for (int64_t s = 0; s < n_stages; ++s) count_patches(stages[s], spec.patch_sizes[s], count(s, kRows), stream);

  std::vector<int64_t> found(static_cast<size_t>(n_counts));
  check_cuda(cudaMemcpyAsync(found.data(), counts, n_counts * sizeof(int64_t), cudaMemcpyDeviceToHost, native(stream)),
             kOp);
  check_cuda(cudaStreamSynchronize(native(stream)), kOp);
  if (found[0] != 0) fail(found[0], clouds, spec, intake, stream);

  for (int64_t s = 0; s < n_stages; ++s) {
    const StageArrays& stage = stages[s];
    const int64_t* own = found.data() + count_at(s, kRows);
    const StageSizes sizes{own[kRows], own[kClouds], own[kPatches], own[kKeys], own[kVoxels]};
    if (s == 0)
      launch(kOp, widen_kernel, blocks_of(sizes.rows), kThreads, 0, stream, intake.rows, sizes.rows,
             arrays.append({sizes.rows}));
    int64_t* cu_cluster = s > 0 ? arrays.append({sizes.rows + 1}) : nullptr;
    int64_t* time_index = stage.time_index ? arrays.append({sizes.rows}) : nullptr;
    int64_t* grid = arrays.append({sizes.rows, 3});
    int64_t* cloud = arrays.append({sizes.rows});
    launch(kOp, widen_kernel, blocks_of(sizes.clouds + 1), kThreads, 0, stream, stage.cu_clouds, sizes.clouds + 1,
           arrays.append({sizes.clouds + 1}));
    int64_t* order = arrays.append({kSerializations, sizes.rows});
    Curves curves;
    for (int64_t r = 0; r < kSerializations; ++r)
      curves.of_row[r] = static_cast<int32_t>(spec.curves[s * kSerializations + r]);
    launch(kOp, write_rows_kernel, blocks_of(sizes.rows + 1), kThreads, 0, stream, stage, sizes.rows, room, curves, grid,
           cloud, order, cu_cluster, time_index);
    int64_t* cu_q = arrays.append({sizes.patches + 1});
    int64_t* cu_k = arrays.append({sizes.patches + 1});
    write_patches(stage, sizes, spec.patch_sizes[s], order, cu_q, cu_k, arrays.append({kSerializations, sizes.keys}),
                  stream);
    int64_t* row_voxel = arrays.append({sizes.rows});
    int64_t* voxel_rows = arrays.append({sizes.rows});
    write_voxels(stage, sizes, row_voxel, voxel_rows, arrays.append({sizes.voxels + 1}), stream);
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k) {
      const int64_t size = spec.kernel_sizes[k], n_pairs = 2 * found[pairs_at(n_stages, k)];
      int64_t* tap_in = arrays.append({n_pairs});
      int64_t* tap_out = arrays.append({n_pairs});
      write_pairs(stage, maps[k], sizes.voxels, n_pairs, tap_in, tap_out, arrays.append({size * size * size + 1}), stream);
    }
  }
}

template void build_pyramid<float>(const PyramidClouds<float>&, const PyramidSpec&, const Arrays&, const Workspace&,
                                   Stream);
template void build_pyramid<double>(const PyramidClouds<double>&, const PyramidSpec&, const Arrays&, const Workspace&,
                                    Stream);

}  // namespace gsim3d::cuda
