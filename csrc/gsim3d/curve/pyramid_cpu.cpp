#include "gsim3d/curve/pyramid.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/curve/curve.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kRowGrain = 8192;
constexpr int64_t kSerializations = 4;
constexpr int64_t kMaxKernelSize = 15;
constexpr int64_t kMaxSlotBits = 32;
constexpr double kCells = 65536;                       // cells an axis
constexpr int64_t kMaxClouds = int64_t{1} << 16;       // what 64-bit codes have room for above 48 bits of space
constexpr int64_t kReleaseCells = int64_t{1} << 15;    // the published depth keeps one spare bit of 16

using Key = std::pair<int64_t, int64_t>;  // scene, slot

// One stage while it is being built.
struct Stage {
  int64_t n = 0;
  int depth = kMaxDepth;
  int64_t* grid = nullptr;   // [n, 3]
  int64_t* cloud = nullptr;  // [n]
  uint64_t* codes[kCurves];  // [n], cloud << 3 depth | code
  int64_t* order = nullptr;  // [4, n]
  std::vector<Key> clouds;   // ascending
  const uint64_t* sorted0 = nullptr;  // codes of serialization row 0, in order
};

bool is_power_of_two(int64_t v) { return v > 0 && std::has_single_bit(static_cast<uint64_t>(v)); }
int log2_of(int64_t v) { return std::countr_zero(static_cast<uint64_t>(v)); }

// f(q, begin, end) for each piece of a cloud in rows [begin, end).
template <typename T, typename F>
void for_cloud_rows(const PyramidClouds<T>& clouds, int64_t begin, int64_t end, const F& f) {
  int64_t q = std::upper_bound(clouds.cu_rows, clouds.cu_rows + clouds.n_clouds + 1, begin) - clouds.cu_rows - 1;
  for (; begin < end; ++q) {
    const int64_t stop = std::min(end, clouds.cu_rows[q + 1]);
    if (begin < stop) f(q, begin, stop);
    begin = std::max(begin, stop);
  }
}

// The published cells: truncated in the dtype of the positions, from the minimum over all rows of the call.
template <typename T>
std::array<T, 3> minimum_corner(const PyramidClouds<T>& clouds, double grid_size) {
  constexpr T inf = std::numeric_limits<T>::infinity();
  std::array<T, 3> low{inf, inf, inf}, high{-inf, -inf, -inf};
  for (int64_t i = 0; i < clouds.n_rows; ++i) {
    const T* p = clouds.positions + 3 * i;
    if (!(std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]))) continue;
    for (int a = 0; a < 3; ++a) {
      low[a] = std::min(low[a], p[a]);
      high[a] = std::max(high[a], p[a]);
    }
  }
  check_extent(low.data(), high.data(), grid_size);
  return low;
}

// Cell of a position; false where the row sleeps.
template <typename T>
bool cell_of(const T* p, const double* origin, const T* corner, double grid_size, int64_t n_cells, int64_t* cell) {
  for (int a = 0; a < 3; ++a) {
    const double v = corner ? static_cast<double>(std::trunc((p[a] - corner[a]) / T(grid_size)))
                            : std::floor((static_cast<double>(p[a]) - origin[a]) / grid_size);
    if (!(v >= 0 && v < static_cast<double>(n_cells))) return false;
    cell[a] = static_cast<int64_t>(v);
  }
  return true;
}

// Rows that take part, and their cells and clouds. Ids count the clouds that have rows, by scene and slot.
template <typename T>
Stage first_stage(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const int64_t** rows_out,
                  const Arrays& arrays, const Workspace& workspace, const Parallel& parallel) {
  std::array<T, 3> corner{};
  if (spec.release) corner = minimum_corner(clouds, spec.grid_size);
  const int64_t n_cells = spec.depth > 0 ? int64_t{1} << spec.depth : kCells;
  int64_t* cells = workspace.take<int64_t>(3 * clouds.n_rows);
  uint8_t* awake = workspace.take<uint8_t>(clouds.n_rows);
  const int64_t n_chunks = (clouds.n_rows + kRowGrain - 1) / kRowGrain;
  std::vector<int64_t> start(static_cast<size_t>(n_chunks + 1), 0);
  parallel.range(clouds.n_rows, kRowGrain, [&](int64_t begin, int64_t end) {
    for_cloud_rows(clouds, begin, end, [&](int64_t q, int64_t first, int64_t last) {
      const double* origin = clouds.origin + 3 * clouds.scene[q];
      for (int64_t i = first; i < last; ++i) {
        awake[i] = cell_of(clouds.positions + 3 * i, origin, spec.release ? corner.data() : nullptr, spec.grid_size,
                           n_cells, cells + 3 * i);
        start[begin / kRowGrain + 1] += awake[i];
      }
    });
  });
  for (int64_t chunk = 0; chunk < n_chunks; ++chunk) start[chunk + 1] += start[chunk];

  Stage stage;
  stage.n = start[n_chunks];
  std::vector<std::pair<Key, int64_t>> present;
  for (int64_t q = 0; q < clouds.n_clouds; ++q)
    if (std::any_of(awake + clouds.cu_rows[q], awake + clouds.cu_rows[q + 1], [](uint8_t a) { return a != 0; }))
      present.push_back({{clouds.scene[q], clouds.slot[q]}, q});
  check(static_cast<int64_t>(present.size()) <= kMaxClouds, "build_pyramid: at most ", kMaxClouds,
        " clouds may have rows; got ", present.size());
  std::sort(present.begin(), present.end());
  std::vector<int64_t> id(static_cast<size_t>(clouds.n_clouds), 0);
  for (const auto& [key, q] : present) {
    id[q] = static_cast<int64_t>(stage.clouds.size());
    stage.clouds.push_back(key);
  }

  int64_t* rows = arrays.append({stage.n});
  int64_t* cu_rows = arrays.append({stage.n + 1});
  std::iota(cu_rows, cu_rows + stage.n + 1, int64_t{0});
  stage.grid = arrays.append({stage.n, 3});
  stage.cloud = arrays.append({stage.n});
  parallel.range(clouds.n_rows, kRowGrain, [&](int64_t begin, int64_t end) {
    int64_t to = start[begin / kRowGrain];
    for_cloud_rows(clouds, begin, end, [&](int64_t q, int64_t first, int64_t last) {
      for (int64_t i = first; i < last; ++i) {
        if (!awake[i]) continue;
        rows[to] = i;
        std::copy_n(cells + 3 * i, 3, stage.grid + 3 * to);
        stage.cloud[to++] = id[q];
      }
    });
  });
  *rows_out = rows;
  if (spec.release) {
    int64_t top = 0;
    for (int64_t i = 0; i < 3 * stage.n; ++i) top = std::max(top, stage.grid[i]);
    stage.depth = std::bit_width(static_cast<uint64_t>(top)) + 1;
  }
  if (spec.depth > 0) stage.depth = static_cast<int>(spec.depth);
  for (auto& codes : stage.codes) codes = workspace.take<uint64_t>(stage.n);
  encode_all(stage.grid, stage.cloud, stage.n, stage.depth, stage.codes, parallel);
  return stage;
}

int64_t* append_cu_clouds(const Stage& stage, const Arrays& arrays) {
  const int64_t n_clouds = static_cast<int64_t>(stage.clouds.size());
  int64_t* cu = arrays.append({n_clouds + 1});
  std::fill_n(cu, n_clouds + 1, 0);
  for (int64_t i = 0; i < stage.n; ++i) ++cu[stage.cloud[i] + 1];
  for (int64_t c = 0; c < n_clouds; ++c) cu[c + 1] += cu[c];
  return cu;
}

// Sorts the stage along its four curves.
void append_order(Stage& stage, const int64_t* curves, const Arrays& arrays, const Workspace& workspace,
                  const Parallel& parallel) {
  stage.order = arrays.append({kSerializations, stage.n});
  const uint64_t* keys[kSerializations];
  int64_t* order[kSerializations];
  uint64_t* sorted[kSerializations];
  for (int64_t r = 0; r < kSerializations; ++r) {
    keys[r] = stage.codes[curves[r]];
    order[r] = stage.order + r * stage.n;
    sorted[r] = workspace.take<uint64_t>(stage.n);
  }
  radix_sort(keys, kSerializations, stage.n, order, nullptr, sorted, workspace, parallel);
  stage.sorted0 = sorted[0];
}

// Orders rows of equal codes by position, so that the order of the input rows does not matter.
template <typename T>
void order_ties(const Stage& stage, const int64_t* curves, const T* positions, const int64_t* rows,
                const Parallel& parallel) {
  parallel.chunks(kSerializations, [&](int64_t r) {
    const uint64_t* codes = stage.codes[curves[r]];
    int64_t* order = stage.order + r * stage.n;
    for (int64_t begin = 0, end = 0; begin < stage.n; begin = end) {
      for (end = begin + 1; end < stage.n && codes[order[end]] == codes[order[begin]];) ++end;
      if (end - begin < 2) continue;
      std::sort(order + begin, order + end, [&](int64_t i, int64_t j) {
        const T *p = positions + 3 * rows[i], *q = positions + 3 * rows[j];
        for (int a = 0; a < 3; ++a)
          if (p[a] != q[a]) return p[a] < q[a];
        return i < j;
      });
    }
  });
}

// Pools equal prefixes of serialization row 0, then merges slots. Updates slot_bits, the bits of a slot that are left.
Stage next_stage(const Stage& before, int64_t stride, int64_t window, int64_t* slot_bits, const Arrays& arrays,
                 const Workspace& workspace, const Parallel& parallel) {
  Stage stage;
  int drop = log2_of(stride);
  if (drop > before.depth) drop = 0;  // published models do not pool then; their depth follows the extent
  stage.depth = before.depth - drop;
  const uint64_t* sorted = before.sorted0;
  int64_t n = 0;
  const auto starts = [&](int64_t i) { return i == 0 || sorted[i] >> (3 * drop) != sorted[i - 1] >> (3 * drop); };
  for (int64_t i = 0; i < before.n; ++i) n += starts(i);
  stage.n = n;
  int64_t* cu_cluster = arrays.append({n + 1});
  for (int64_t i = 0, to = 0; i < before.n; ++i)
    if (starts(i)) cu_cluster[to++] = i;
  cu_cluster[n] = before.n;

  const int merged = static_cast<int>(std::min<int64_t>(log2_of(window), *slot_bits));
  *slot_bits -= merged;
  std::vector<int64_t> id;
  for (const auto& [scene, slot] : before.clouds) {
    const Key key{scene, slot >> merged};
    if (stage.clouds.empty() || stage.clouds.back() != key) stage.clouds.push_back(key);
    id.push_back(static_cast<int64_t>(stage.clouds.size()) - 1);
  }

  int64_t* time_index = merged > 0 ? arrays.append({n}) : nullptr;
  stage.grid = arrays.append({n, 3});
  stage.cloud = arrays.append({n});
  for (auto& codes : stage.codes) codes = workspace.take<uint64_t>(n);
  const uint64_t space = (uint64_t{1} << (3 * stage.depth)) - 1;
  parallel.range(n, kRowGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t member = before.order[cu_cluster[i]];
      const int64_t cloud = before.cloud[member];
      for (int a = 0; a < 3; ++a) stage.grid[3 * i + a] = before.grid[3 * member + a] >> drop;
      stage.cloud[i] = id[cloud];
      if (time_index) time_index[i] = before.clouds[cloud].second & ((int64_t{1} << merged) - 1);
      for (int c = 0; c < kCurves; ++c)
        stage.codes[c][i] = static_cast<uint64_t>(id[cloud]) << (3 * stage.depth) |
                            (before.codes[c][member] >> (3 * drop) & space);
    }
  });
  return stage;
}

}  // namespace

void check_spec(const PyramidSpec& spec) {
  const char* op = "build_pyramid";
  check(std::isfinite(spec.grid_size) && spec.grid_size > 0, op, ": grid_size must be positive; got ", spec.grid_size);
  check(spec.slot_bits >= 0 && spec.slot_bits <= kMaxSlotBits, op, ": slot_bits must be in [0, ", kMaxSlotBits,
        "]; got ", spec.slot_bits);
  check(spec.depth >= 0 && spec.depth <= kMaxDepth, op, ": depth must be in [1, ", kMaxDepth, "]; got ", spec.depth);
  check(spec.depth == 0 || !spec.release, op, ": depth must not be given with release, which has one of its own");
  int bits = 0;
  for (int64_t s = 0; s + 1 < spec.n_stages; ++s) {
    check(is_power_of_two(spec.strides[s]), op, ": strides must be powers of two; got ", spec.strides[s]);
    check(is_power_of_two(spec.merge_windows[s]), op, ": merge_windows must be powers of two; got ",
          spec.merge_windows[s]);
    bits += log2_of(spec.strides[s]);
  }
  check(spec.release || bits < kMaxDepth, op, ": strides must multiply to at most 2^15; got 2^", bits);
  for (int64_t s = 0; s < spec.n_stages; ++s) {
    check(spec.patch_sizes[s] > 0, op, ": patch_sizes must be positive; got ", spec.patch_sizes[s]);
    for (int64_t r = 0; r < kSerializations; ++r) {
      const int64_t curve = spec.curves[s * kSerializations + r];
      check(curve >= 0 && curve < kCurves, op, ": curves must be in [0, 4); got ", curve);
    }
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k)
      check(spec.kernel_sizes[k] % 2 == 1 && spec.kernel_sizes[k] > 0 && spec.kernel_sizes[k] <= kMaxKernelSize, op,
            ": kernel_sizes must be odd and in [1, ", kMaxKernelSize, "]; got ", spec.kernel_sizes[k]);
  }
}

template <typename T>
void check_clouds(const PyramidClouds<T>& clouds, const PyramidSpec& spec) {
  const char* op = "build_pyramid";
  const int64_t* cu = clouds.cu_rows;
  check(cu[0] == 0 && cu[clouds.n_clouds] == clouds.n_rows, op, ": cu_rows must run from 0 to N=", clouds.n_rows,
        "; got ", cu[0], " .. ", cu[clouds.n_clouds]);
  std::vector<Key> keys;
  for (int64_t q = 0; q < clouds.n_clouds; ++q) {
    check(cu[q] <= cu[q + 1], op, ": cu_rows must not descend; got ", cu[q], " then ", cu[q + 1], " at ", q);
    check(clouds.scene[q] >= 0 && clouds.scene[q] < clouds.n_scenes, op, ": cloud_scene must be in [0, B) with B=",
          clouds.n_scenes, " from origin; got ", clouds.scene[q], " at ", q);
    check(clouds.slot[q] >= 0 && clouds.slot[q] < int64_t{1} << spec.slot_bits, op, ": cloud_slot must be in [0, ",
          int64_t{1} << spec.slot_bits, "); got ", clouds.slot[q], " at ", q);
    keys.emplace_back(clouds.scene[q], clouds.slot[q]);
  }
  std::sort(keys.begin(), keys.end());
  const auto twice = std::adjacent_find(keys.begin(), keys.end());
  if (twice != keys.end())
    detail::fail(op, ": cloud_slot must differ between the clouds of a scene; got slot ", twice->second,
                 " twice in scene ", twice->first);
  for (int64_t i = 0; i < 3 * clouds.n_scenes; ++i)
    check(std::isfinite(clouds.origin[i]), op, ": origin must be finite; got ", clouds.origin[i], " in scene ", i / 3);
}

template <typename T>
void check_extent(const T* low, const T* high, double grid_size) {
  for (int a = 0; a < 3; ++a)
    check(!((high[a] - low[a]) / T(grid_size) >= T(kReleaseCells)),
          "build_pyramid: with release, positions must span fewer than 2^15 cells of ", grid_size, " m; got ", low[a],
          " .. ", high[a], " m on axis ", a);
}

template <typename T>
void build_pyramid(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                   const Workspace& workspace, const Parallel& parallel) {
  check_spec(spec);
  check_clouds(clouds, spec);
  if (spec.capacity || spec.rounded) return build_given(clouds, spec, arrays, workspace, parallel);
  int64_t slot_bits = spec.slot_bits;
  const int64_t* rows = nullptr;
  Stage stage = first_stage(clouds, spec, &rows, arrays, workspace, parallel);
  for (int64_t s = 0; s < spec.n_stages; ++s) {
    if (s > 0)
      stage = next_stage(stage, spec.strides[s - 1], spec.merge_windows[s - 1], &slot_bits, arrays, workspace,
                         parallel);
    const int64_t* curves = spec.curves + s * kSerializations;
    const int64_t* cu_clouds = append_cu_clouds(stage, arrays);
    append_order(stage, curves, arrays, workspace, parallel);
    if (s == 0 && !spec.release) order_ties(stage, curves, clouds.positions, rows, parallel);
    append_patches(cu_clouds, static_cast<int64_t>(stage.clouds.size()), stage.order, stage.n, spec.patch_sizes[s],
                   arrays);
    const VoxelKeys voxels = append_voxels(stage.grid, stage.cloud, stage.n, arrays, workspace, parallel);
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k)
      append_kernel_map(voxels, spec.kernel_sizes[k], arrays, parallel);
  }
}

#define GSIM3D_INSTANTIATE(T)                                                      \
  template void check_clouds<T>(const PyramidClouds<T>&, const PyramidSpec&);       \
  template void check_extent<T>(const T*, const T*, double);                        \
  template void build_pyramid<T>(const PyramidClouds<T>&, const PyramidSpec&, const Arrays&, const Workspace&, \
                                 const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
