// The stages of a pyramid. Rows are sorted along the four curves once: a code without its lowest bits is the code of
// the coarser cell, so the lists of a stage are those of the stage before without the rows that pooling joins, and
// merging clouds in time interleaves runs that are sorted already.
#include <algorithm>
#include <bit>
#include <cstring>
#include <utility>
#include <vector>

#include "gsim3d/curve/curve.h"
#include "gsim3d/curve/pyramid_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = kPyramidThreads;
constexpr const char* kOp = "build_pyramid";

int log2_of(int64_t power_of_two) { return std::countr_zero(static_cast<uint64_t>(power_of_two)); }

// Cells and codes of the rows that take part.
template <bool kWholeDepth>
__global__ void encode_kernel(int64_t n, const int64_t* __restrict__ cu_rows, int64_t n_clouds, Intake intake,
                              Build build, uint64_t* __restrict__ codes) {
  const int64_t i = thread_index();
  if (i >= n) return;
  const uint64_t cell = intake.cells[i];
  if (cell == ~uint64_t{0}) return;
  const int64_t to = intake.start[i];
  const uint64_t id = intake.cloud_id[segment_of(cu_rows, n_clouds, i)];
  const uint32_t x = cell >> 32, y = cell >> 16 & kAxisMask, z = cell & kAxisMask;
  build.input_rows[to] = static_cast<uint32_t>(i);
  build.stages[0].cells[to] = id << 48 | cell;
  const int depth = build.depth[0];
  const uint64_t high = id << 3 * depth;
#pragma unroll
  for (int c = 0; c < kCurves; ++c)
    codes[c * build.room + to] = high | curve_code(static_cast<Curve>(c), x, y, z, kWholeDepth ? kMaxDepth : depth);
}

// Orders rows of equal codes by position, then by row: each row of a run counts those before it.
template <typename T>
__global__ void order_ties_kernel(Build build, const uint32_t* __restrict__ sorted, const T* __restrict__ positions) {
  const int64_t i = thread_index(), n = build.counts[count_at(0, kRows)];
  if (i >= n) return;
  const int64_t list = blockIdx.y * build.room;
  const uint64_t* codes = build.stages[0].codes + list;
  sorted += list;
  const uint64_t code = codes[i];
  int64_t begin = i, end = i + 1;
  while (begin > 0 && codes[begin - 1] == code) --begin;
  while (end < n && codes[end] == code) ++end;
  const uint32_t row = sorted[i];
  int64_t rank = 0;
  if (end - begin > 1) {
    const T* p = positions + 3 * int64_t{build.input_rows[row]};
    const T x = p[0], y = p[1], z = p[2];
    for (int64_t j = begin; j < end; ++j) {
      const uint32_t other = sorted[j];
      const T* q = positions + 3 * int64_t{build.input_rows[other]};
      const bool before = q[0] != x ? q[0] < x : q[1] != y ? q[1] < y : q[2] != z ? q[2] < z : other < row;
      rank += before;
    }
  }
  build.stages[0].rows[list + begin + rank] = row;
}

// The lists of a stage, by the clouds and rows of the stage before, and the stage's rows: the first row of every
// cluster in every list. Tiles of the four lists, one after another.
__global__ void __launch_bounds__(kThreads)
    pool_kernel(Build build, int64_t s, uint64_t* __restrict__ codes, uint32_t* __restrict__ rows,
                uint32_t* __restrict__ cluster_of_row) {
  const int64_t tiles = tiles_of(build.room), ticket = tile_of(build.tickets);
  const int64_t list = ticket / tiles, tile = ticket % tiles, at = list * build.room;
  const StageArrays &before = build.stages[s - 1], &stage = build.stages[s];
  const int64_t n = build.counts[count_at(s - 1, kRows)], begin = tile * kScanTile + threadIdx.x;
  if (n == 0 && ticket == 0 && threadIdx.x == 0) stage.cu_cluster[0] = stage.run_starts[0] = 0;
  if (tile * kScanTile >= n) return;
  const int drop = build.drop[s], shift = 3 * drop, space = 3 * build.depth[s];
  const bool numbers_rows = list == before.curves[0];
  bool first[kScanItems];
  uint64_t code[kScanItems], earlier[kScanItems];
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    const int64_t i = begin + j * kThreads;
    code[j] = i < n ? before.codes[at + i] >> shift : 0;
    earlier[j] = i > 0 && i < n ? before.codes[at + i - 1] >> shift : 0;
    first[j] = i < n && (i == 0 || code[j] != earlier[j]);
  }
  uint32_t earlier_firsts[kScanItems];
  const uint32_t up_to = number_tile(first, tile, build.published + list * tiles, earlier_firsts);
#pragma unroll
  for (int j = 0; j < kScanItems; ++j) {
    const int64_t i = begin + j * kThreads;
    if (i >= n) continue;
    const uint32_t row = before.rows[at + i], id = earlier_firsts[j] + first[j] - 1;
    const uint64_t cloud = code[j] >> space;
    if (numbers_rows) cluster_of_row[row] = id;
    if (first[j]) {
      codes[at + id] = code[j];
      rows[at + id] = row;
      if (list == 0 && (i == 0 || cloud != earlier[j] >> space)) stage.run_starts[cloud] = id;
    }
    if (first[j] && numbers_rows) {
      const uint64_t cell = before.cells[row];
      const uint64_t x = (cell >> 32 & kAxisMask) >> drop, y = (cell >> 16 & kAxisMask) >> drop,
                     z = (cell & kAxisMask) >> drop;
      stage.cells[id] = uint64_t{before.merged[cloud]} << 48 | x << 32 | y << 16 | z;
      stage.cu_cluster[id] = static_cast<uint32_t>(i);
      if (stage.time_index)
        stage.time_index[id] = static_cast<uint32_t>(before.slot[cloud] & ((int64_t{1} << stage.merged_bits) - 1));
    }
    if (i < n - 1) continue;
    if (numbers_rows) {
      stage.cu_cluster[up_to] = static_cast<uint32_t>(n);
      build.counts[count_at(s, kRows)] = up_to;
    }
    if (list == 0) stage.run_starts[build.counts[count_at(s - 1, kClouds)]] = up_to;
  }
}

// Gives the entries of a stage's lists their new rows; where clouds become one, interleaves their runs. Equal codes
// keep the order of the clouds, which is that of rows.
__global__ void merge_kernel(Build build, int64_t s, const uint64_t* __restrict__ run_codes,
                             const uint32_t* __restrict__ run_rows, const uint32_t* __restrict__ cluster_of_row) {
  const int64_t i = thread_index(), list = blockIdx.y * build.room;
  if (i >= build.counts[count_at(s, kRows)]) return;
  const StageArrays &before = build.stages[s - 1], &stage = build.stages[s];
  run_codes += list;
  const uint32_t row = cluster_of_row[run_rows[list + i]];
  const int bits = 3 * build.depth[s];
  const uint64_t mask = (uint64_t{1} << bits) - 1, code = run_codes[i], space = code & mask;
  const uint32_t own = static_cast<uint32_t>(code >> bits), id = before.merged[own];
  const uint32_t first_run = stage.members[id], last_run = stage.members[id + 1];
  int64_t to = stage.run_starts[first_run] + i - stage.run_starts[own];
  for (uint32_t run = first_run; run < last_run; ++run) {
    if (run == own) continue;
    const int64_t begin = stage.run_starts[run], end = stage.run_starts[run + 1];
    to += partition_point(begin, end,
                          [&](int64_t j) {
                            const uint64_t other = run_codes[j] & mask;
                            return run < own ? other <= space : other < space;
                          }) -
          begin;
  }
  stage.codes[list + to] = uint64_t{id} << bits | space;
  stage.rows[list + to] = row;
}

// In capacity mode: what was found; where it does not fit, or the call is malformed, the pyramid becomes empty.
__global__ void settle_counts_kernel(Build build, const int64_t* __restrict__ capacity, int64_t* __restrict__ found) {
  const int64_t n_stages = build.n_stages, pairs = capacity_of_pairs(n_stages, 0), n = pairs + build.n_maps;
  bool too_large = false;
  for (int64_t i = threadIdx.x; i < n; i += kThreads) {
    constexpr int64_t kEach = capacity_at(1, Counted::kRows);
    const int64_t count = i < pairs ? build.counts[count_at(i / kEach, static_cast<Count>(i % kEach))]
                                    : 2 * build.counts[pairs_at(n_stages, i - pairs)];
    found[1 + i] = count;
    too_large |= count > capacity[i];
  }
  const int64_t problems = build.counts[0] | (__syncthreads_or(too_large) ? kTooLarge : 0);
  if (threadIdx.x == 0) found[0] = problems;
  if (problems == 0) return;
  for (int64_t i = 1 + threadIdx.x; i < pairs_at(n_stages, build.n_maps); i += kThreads) build.counts[i] = 0;
}

// The input rows that sleep, behind those that take part.
__global__ void write_sleepers_kernel(Build build, Intake intake, int64_t n, const int64_t* __restrict__ found,
                                      int64_t* __restrict__ rows) {
  const int64_t i = thread_index();
  if (i >= n) return;
  if (found[0] != 0)
    rows[i] = i;
  else if (intake.cells[i] == ~uint64_t{0})
    rows[build.counts[count_at(0, kRows)] + i - intake.start[i]] = i;
}

__global__ void write_rows_kernel(Build build, const StageResults* results) {
  const int64_t i = thread_index(), s = blockIdx.y, room = build.room;
  const StageArrays& stage = build.stages[s];
  const StageResults& to = results[s];
  const int64_t* own = build.counts + count_at(s, kRows);
  const int64_t n = own[kRows], n_voxels = own[kVoxels];
  if (to.cu_input_rows && i <= to.n_rows) to.cu_input_rows[i] = min(i, n);
  if (to.cu_cluster && i <= to.n_rows) to.cu_cluster[i] = stage.cu_cluster[min(i, n)];
  if (i <= to.n_voxels)
    to.cu_voxel_rows[i] = i <= n_voxels ? int64_t{stage.cu_voxels[i]} : min(n + i - n_voxels, to.n_rows);
  if (i >= to.n_rows) return;
  const bool real = i < n;
  if (to.input_rows && real) to.input_rows[i] = build.input_rows[i];
  if (to.time_index) to.time_index[i] = real ? stage.time_index[i] : 0;
  const uint64_t cell = real ? stage.cells[i] : 0;
  to.cloud[i] = static_cast<int64_t>(cell >> 48);
  to.grid[3 * i] = static_cast<int64_t>(cell >> 32 & kAxisMask);
  to.grid[3 * i + 1] = static_cast<int64_t>(cell >> 16 & kAxisMask);
  to.grid[3 * i + 2] = static_cast<int64_t>(cell & kAxisMask);
#pragma unroll
  for (int r = 0; r < kSerializations; ++r)
    to.order[r * to.n_rows + i] = real ? int64_t{stage.rows[stage.curves[r] * room + i]} : i;
  to.row_voxel[i] = real ? int64_t{stage.row_voxel[i]} : n_voxels + i - n;
  to.voxel_rows[i] = real ? int64_t{stage.voxel_rows[i]} : i;
}

// Hands out one block of device memory in pieces: measured first, then taken.
class Pieces {
 public:
  template <typename T>
  T* take(int64_t count) {
    T* const here = reinterpret_cast<T*>(base_ + at_);
    at_ += (count * static_cast<int64_t>(sizeof(T)) + 255) / 256 * 256;
    return here;
  }
  int64_t size() const { return at_; }
  void start(char* base) {
    base_ = base;
    at_ = 0;
  }

 private:
  char* base_ = nullptr;
  int64_t at_ = 0;
};

// Everything that lives from the first kernel to the last.
struct Scratch {
  std::vector<StageArrays> stages;
  std::vector<MapArrays> maps;
  std::vector<int32_t> drop;
  Build build;
  Intake intake;
  uint64_t* run_codes;  // [4, room]
  uint32_t* run_rows;   // [4, room]
  uint32_t* cluster_of_row;
  int64_t n_map_counts, zeros;  // bytes to clear from build.counts on
  char *tables, *results;       // where the tables of the first kernels begin, and those of the last
  int64_t* capacity;
  StageResults* stage_results;
  MapResults* map_results;
};

void lay_out(const PyramidSpec& spec, int64_t n_clouds, Pieces& pieces, Scratch& scratch) {
  Build& build = scratch.build;
  const int64_t room = build.room, n_stages = spec.n_stages, tiles = tiles_of(room + 1);
  const int64_t begin = pieces.size();
  build.counts = pieces.take<int64_t>(pairs_at(n_stages, build.n_maps));
  scratch.intake.top = pieces.take<uint32_t>(1);
  // One ticket and one list of tiles for every scan: rows awake, four lists a step, voxels of every stage.
  const int64_t n_scans = n_stages + 1, n_lists = 1 + kCurves * (n_stages - 1) + n_stages;
  build.tickets = pieces.take<uint32_t>(n_scans);
  build.published = pieces.take<uint32_t>(n_lists * tiles);
  scratch.zeros = pieces.size() - begin;
  build.depth = pieces.take<int32_t>(n_stages);
  scratch.tables = pieces.take<char>(0);
  build.drop = pieces.take<int32_t>(n_stages);
  build.stages = pieces.take<StageArrays>(n_stages);
  build.maps = pieces.take<MapArrays>(build.n_maps);
  scratch.capacity = pieces.take<int64_t>(capacity_of_pairs(n_stages, build.n_maps));
  scratch.results = pieces.take<char>(0);
  scratch.stage_results = pieces.take<StageResults>(n_stages);
  scratch.map_results = pieces.take<MapResults>(build.n_maps);
  build.found = pieces.take<uint32_t>(scratch.n_map_counts);
  build.starts = pieces.take<uint32_t>(scratch.n_map_counts);
  build.input_rows = pieces.take<uint32_t>(room);
  scratch.intake.extent = pieces.take<uint64_t>(6);
  scratch.intake.cells = pieces.take<uint64_t>(room);
  scratch.intake.start = pieces.take<uint32_t>(room + 1);
  scratch.intake.cloud_id = pieces.take<uint32_t>(n_clouds);
  scratch.run_codes = pieces.take<uint64_t>(kCurves * room);
  scratch.run_rows = pieces.take<uint32_t>(kCurves * room);
  scratch.cluster_of_row = pieces.take<uint32_t>(room);
  uint64_t* cells = pieces.take<uint64_t>(n_stages * room);
  uint64_t* sorted = pieces.take<uint64_t>(n_stages * room);
  uint32_t* voxel_rows = pieces.take<uint32_t>(n_stages * room);
  for (int64_t s = 0; s < n_stages; ++s) {
    StageArrays& stage = scratch.stages[s];
    stage.cells = cells + s * room;
    stage.sorted = sorted + s * room;
    stage.voxel_rows = voxel_rows + s * room;
    stage.codes = pieces.take<uint64_t>(kCurves * room);
    stage.rows = pieces.take<uint32_t>(kCurves * room);
    stage.cu_cluster = pieces.take<uint32_t>(room + 1);
    stage.time_index = stage.merged_bits > 0 ? pieces.take<uint32_t>(room) : nullptr;
    stage.row_voxel = pieces.take<uint32_t>(room);
    stage.cu_voxels = pieces.take<uint32_t>(room + 1);
    stage.voxels = pieces.take<uint64_t>(room);
    stage.scene = pieces.take<int64_t>(n_clouds);
    stage.slot = pieces.take<int64_t>(n_clouds);
    for (uint32_t** table :
         {&stage.merged, &stage.members, &stage.run_starts, &stage.cu_clouds, &stage.cu_patches, &stage.cu_keys})
      *table = pieces.take<uint32_t>(n_clouds + 1);
  }
}

Scratch make_scratch(const PyramidSpec& spec, int64_t room, int64_t n_clouds, const Workspace& workspace) {
  Scratch scratch;
  Build& build = scratch.build;
  build.n_stages = spec.n_stages;
  build.n_maps = spec.cu_kernels[spec.n_stages];
  build.room = room;
  build.n_warps = (room + kWarp - 1) / kWarp;
  int64_t slot_bits = spec.slot_bits, n_counts = 0;
  for (int64_t s = 0; s < spec.n_stages; ++s) {
    StageArrays stage{};
    stage.patch_size = spec.patch_sizes[s];
    stage.merged_bits =
        s > 0 ? static_cast<int32_t>(std::min<int64_t>(log2_of(spec.merge_windows[s - 1]), slot_bits)) : 0;
    slot_bits -= stage.merged_bits;
    for (int64_t r = 0; r < kSerializations; ++r)
      stage.curves[r] = static_cast<int32_t>(spec.curves[s * kSerializations + r]);
    scratch.stages.push_back(stage);
    scratch.drop.push_back(s > 0 ? log2_of(spec.strides[s - 1]) : 0);
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k) {
      const int64_t size = spec.kernel_sizes[k];
      scratch.maps.push_back({n_counts, static_cast<int32_t>(s), static_cast<int32_t>(size)});
      n_counts += size * size * size / 2 * build.n_warps;
    }
  }
  check(n_counts * kWarp < int64_t{1} << 32, kOp, ": ", room, " rows are too many for these kernel_sizes");
  scratch.n_map_counts = n_counts + 1;
  Pieces pieces;
  lay_out(spec, n_clouds, pieces, scratch);
  pieces.start(workspace.take<char>(pieces.size()));
  lay_out(spec, n_clouds, pieces, scratch);
  return scratch;
}

// A kernel's arguments as a way to the device: a copy from host memory would read it again in every replay of a graph.
struct Parcel {
  static constexpr size_t kBytes = 3968;  // arguments hold 4 KB
  uint32_t words[kBytes / sizeof(uint32_t)];
};
__global__ void unpack_kernel(const __grid_constant__ Parcel parcel, uint32_t n_words, uint32_t* to) {
  for (uint32_t i = threadIdx.x; i < n_words; i += kThreads) to[i] = parcel.words[i];
}

// Tables made on the host, on their way to neighbouring places in device memory.
class Tables {
 public:
  explicit Tables(char* begin) : begin_(begin) {}

  template <typename T>
  void add(const std::vector<T>& from, const T* to) {
    const size_t at = reinterpret_cast<const char*>(to) - begin_, size = from.size() * sizeof(T);
    bytes_.resize(at + (size + 7) / 8 * 8);
    if (size > 0) std::memcpy(bytes_.data() + at, from.data(), size);
  }

  void send(Stream stream) const {
    for (size_t at = 0; at < bytes_.size(); at += Parcel::kBytes) {
      Parcel parcel;
      const size_t size = std::min(Parcel::kBytes, bytes_.size() - at);
      std::memcpy(parcel.words, bytes_.data() + at, size);
      launch(kOp, unpack_kernel, 1, kThreads, 0, stream, parcel, static_cast<uint32_t>(size / sizeof(uint32_t)),
             reinterpret_cast<uint32_t*>(begin_ + at));
    }
  }

 private:
  char* begin_;
  std::vector<char> bytes_;
};

// The arrays of the results, in the order that pyramid.h states.
struct Results {
  std::vector<StageResults> stages;
  std::vector<MapResults> maps;
  int64_t* found = nullptr;
  int64_t most = 0;  // threads that reach every element of every array but those of pairs
};

// `counts`: what the arrays hold, in the order of spec.capacity; `n_voxels` of every stage.
Results append_results(const PyramidSpec& spec, const int64_t* counts, const int64_t* n_voxels, const Scratch& scratch,
                       const Arrays& arrays) {
  Results results;
  for (int64_t s = 0; s < spec.n_stages; ++s) {
    const int64_t* own = counts + capacity_at(s, Counted::kRows);
    const int64_t n = own[kRows];
    StageResults to{};
    to.n_rows = n;
    to.n_clouds = own[kClouds];
    to.n_patches = own[kPatches];
    to.n_keys = own[kKeys];
    to.n_voxels = n_voxels[s];
    if (s == 0) {
      to.input_rows = arrays.append({n});
      to.cu_input_rows = arrays.append({n + 1});
    }
    if (s > 0) to.cu_cluster = arrays.append({n + 1});
    if (scratch.stages[s].time_index) to.time_index = arrays.append({n});
    to.grid = arrays.append({n, 3});
    to.cloud = arrays.append({n});
    to.cu_clouds = arrays.append({own[kClouds] + 1});
    to.order = arrays.append({kSerializations, n});
    to.cu_q = arrays.append({own[kPatches] + 1});
    to.cu_k = arrays.append({own[kPatches] + 1});
    to.kv_rows = arrays.append({kSerializations, own[kKeys]});
    to.row_voxel = arrays.append({n});
    to.voxel_rows = arrays.append({n});
    to.cu_voxel_rows = arrays.append({to.n_voxels + 1});
    results.stages.push_back(to);
    results.most = std::max({results.most, n + 1, to.n_clouds + 1, to.n_patches + 1, to.n_keys, to.n_voxels + 1});
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k) {
      const int64_t n_taps = spec.kernel_sizes[k] * spec.kernel_sizes[k] * spec.kernel_sizes[k];
      const int64_t n_pairs = counts[capacity_of_pairs(spec.n_stages, k)];
      int64_t* tap_in = arrays.append({n_pairs});
      int64_t* tap_out = arrays.append({n_pairs});
      results.maps.push_back({tap_in, tap_out, arrays.append({n_taps + 1}), n_pairs});
      results.most = std::max(results.most, n_taps + 1);
    }
  }
  if (spec.capacity || spec.rounded)
    results.found = arrays.append({1 + capacity_of_pairs(spec.n_stages, spec.cu_kernels[spec.n_stages])});
  return results;
}

// Arrays of the sizes that the caller has given, and a pyramid that fits them.
template <typename T>
Results append_given(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const int64_t* capacity,
                     const Scratch& scratch, const Arrays& arrays, Stream stream) {
  std::vector<int64_t> n_voxels;
  for (int64_t s = 0; s < spec.n_stages; ++s) n_voxels.push_back(capacity[capacity_at(s, Counted::kRows)] + 1);
  Results results = append_results(spec, capacity, n_voxels.data(), scratch, arrays);
  launch(kOp, settle_counts_kernel, 1, kThreads, 0, stream, scratch.build, scratch.capacity, results.found);
  launch(kOp, write_sleepers_kernel, blocks_of(clouds.n_rows), kThreads, 0, stream, scratch.build, scratch.intake,
         clouds.n_rows, results.found, results.stages[0].input_rows);
  return results;
}

// Arrays of the sizes that the device has counted, which it is asked for, or of these sizes rounded.
template <typename T>
Results append_counted(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Scratch& scratch,
                       const Arrays& arrays, Stream stream) {
  const int64_t n_stages = spec.n_stages, n_maps = scratch.build.n_maps;
  std::vector<int64_t> found(static_cast<size_t>(pairs_at(n_stages, n_maps)));
  check_cuda(cudaMemcpyAsync(found.data(), scratch.build.counts, found.size() * sizeof(int64_t), cudaMemcpyDeviceToHost,
                             native(stream)),
             kOp);
  check_cuda(cudaStreamSynchronize(native(stream)), kOp);
  if (found[0] != 0) raise_status(found[0], clouds, spec, scratch.intake, stream);
  std::vector<int64_t> counts, n_voxels;
  for (int64_t s = 0; s < n_stages; ++s) {
    const int64_t* own = found.data() + count_at(s, kRows);
    counts.insert(counts.end(), own, own + capacity_at(1, Counted::kRows));
    n_voxels.push_back(own[kVoxels]);
  }
  for (int64_t k = 0; k < n_maps; ++k) counts.push_back(2 * found[pairs_at(n_stages, k)]);
  if (spec.rounded) {
    round_counts(counts.data(), n_stages, static_cast<int64_t>(counts.size()), clouds.n_rows);
    Tables tables(reinterpret_cast<char*>(scratch.capacity));
    tables.add(counts, scratch.capacity);
    tables.send(stream);
    return append_given(clouds, spec, counts.data(), scratch, arrays, stream);
  }
  return append_results(spec, counts.data(), n_voxels.data(), scratch, arrays);
}

}  // namespace

template <typename T>
void build_pyramid(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                   const Workspace& workspace, Stream stream) {
  cpu::check_spec(spec);
  cpu::check_capacity(spec, clouds.n_rows);
  const int64_t n = clouds.n_rows, room = std::max<int64_t>(n, 1), n_stages = spec.n_stages;
  check(n < int64_t{1} << 29, kOp, ": positions must have fewer than 2^29 rows; got ", n);
  const int cloud_bits = std::bit_width(static_cast<uint64_t>(std::clamp<int64_t>(clouds.n_clouds - 1, 0, 65535)));
  Scratch scratch = make_scratch(spec, room, clouds.n_clouds, workspace);
  Build build = scratch.build;
  const Intake& intake = scratch.intake;
  if (clouds.n_clouds == 0 && n > 0) raise_status(kBadClouds, clouds, spec, intake, stream);

  fill_zero(kOp, reinterpret_cast<char*>(build.counts), scratch.zeros, stream);
  Tables tables(scratch.tables);
  tables.add(scratch.drop, build.drop);
  tables.add(scratch.stages, build.stages);
  tables.add(scratch.maps, build.maps);
  if (spec.capacity)
    tables.add(std::vector(spec.capacity, spec.capacity + capacity_of_pairs(n_stages, build.n_maps)), scratch.capacity);
  tables.send(stream);
  // Every scan has its own ticket and published counts.
  const auto next_scan = [&](int64_t lists) {
    ++build.tickets;
    build.published += lists * tiles_of(room + 1);
  };

  find_clouds(clouds, spec, intake, build, stream);
  next_scan(1);

  // The first stage: one sort of the four curves.
  launch(kOp, spec.release || spec.depth > 0 ? encode_kernel<false> : encode_kernel<true>, blocks_of(n), kThreads, 0,
         stream, n, clouds.cu_rows, clouds.n_clouds, intake, build, scratch.run_codes);
  sort_rows(kOp,
            {.keys = scratch.run_codes,
             .n_rows = kCurves,
             .room = room,
             .bits = 3 * kMaxDepth + cloud_bits,
             .sizes = build.counts + count_at(0, kRows),
             .sorted = scratch.stages[0].codes,
             .index = spec.release ? scratch.stages[0].rows : scratch.run_rows},
            workspace, stream);
  if (!spec.release)
    launch(kOp, order_ties_kernel<T>, dim3(blocks_of(n), kCurves), kThreads, 0, stream, build, scratch.run_rows,
           clouds.positions);

  // The others: lists of the stage before without the rows that pooling joins.
  for (int64_t s = 1; s < n_stages; ++s) {
    launch(kOp, pool_kernel, blocks_for(kOp, kCurves * tiles_of(room), 1), kThreads, 0, stream, build, s,
           scratch.run_codes, scratch.run_rows, scratch.cluster_of_row);
    next_scan(kCurves);
    launch(kOp, merge_kernel, dim3(blocks_of(n), kCurves), kThreads, 0, stream, build, s, scratch.run_codes,
           scratch.run_rows, scratch.cluster_of_row);
  }
  find_voxels(build, scratch.stages.data(), cloud_bits, workspace, stream);
  count_pairs(build, scratch.n_map_counts, workspace, stream);
  count_patches(build, stream);

  const Results results = spec.capacity ? append_given(clouds, spec, spec.capacity, scratch, arrays, stream)
                                         : append_counted(clouds, spec, scratch, arrays, stream);
  Tables places(scratch.results);
  places.add(results.stages, scratch.stage_results);
  places.add(results.maps, scratch.map_results);
  places.send(stream);
  launch(kOp, write_rows_kernel, dim3(blocks_of(results.most), static_cast<unsigned>(n_stages)), kThreads, 0, stream,
         build, scratch.stage_results);
  write_patches(build, scratch.stage_results, results.most, stream);
  write_pairs(build, scratch.map_results, results.most, stream);
}

template void build_pyramid<float>(const PyramidClouds<float>&, const PyramidSpec&, const Arrays&, const Workspace&,
                                   Stream);
template void build_pyramid<double>(const PyramidClouds<double>&, const PyramidSpec&, const Arrays&, const Workspace&,
                                    Stream);

}  // namespace gsim3d::cuda
