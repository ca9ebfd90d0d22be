// Pyramids whose arrays have given sizes: made to fit, then copied into larger arrays.
#include <algorithm>
#include <bit>
#include <utility>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/curve/pyramid.h"

namespace gsim3d::cpu {
namespace {

using Array = std::vector<int64_t>;

// Arrays that fit what they hold, in the order in which they were made.
struct Fitted {
  std::vector<Array> arrays;

  static int64_t* append(void* raw, const int64_t* sizes, int64_t dims) {
    int64_t count = 1;
    for (int64_t d = 0; d < dims; ++d) count *= sizes[d];
    auto& arrays = static_cast<Fitted*>(raw)->arrays;
    return arrays.emplace_back(static_cast<size_t>(count)).data();
  }
};

struct Map {
  const Array *tap_in, *tap_out, *cu_taps;
};
struct Stage {
  const Array *cu_cluster, *time_index, *grid, *cloud, *cu_clouds, *order, *cu_q, *cu_k, *kv_rows, *row_voxel,
      *voxel_rows, *cu_voxel_rows;
  std::vector<Map> maps;
};

// Names for arrays that lie in the order that pyramid.h states, from that of stage 0 on.
std::vector<Stage> stages_of(const Array* next, const PyramidSpec& spec) {
  std::vector<Stage> stages;
  int64_t slot_bits = spec.slot_bits;
  for (int64_t s = 0; s < spec.n_stages; ++s) {
    Stage stage{};
    int64_t merged = 0;
    if (s > 0) {
      merged = std::min<int64_t>(std::countr_zero(static_cast<uint64_t>(spec.merge_windows[s - 1])), slot_bits);
      stage.cu_cluster = next++;
    }
    slot_bits -= merged;
    if (merged > 0) stage.time_index = next++;
    for (const Array** array : {&stage.grid, &stage.cloud, &stage.cu_clouds, &stage.order, &stage.cu_q, &stage.cu_k,
                                &stage.kv_rows, &stage.row_voxel, &stage.voxel_rows, &stage.cu_voxel_rows})
      *array = next++;
    for (int64_t k = spec.cu_kernels[s]; k < spec.cu_kernels[s + 1]; ++k, next += 3)
      stage.maps.push_back({next, next + 1, next + 2});
    stages.push_back(std::move(stage));
  }
  return stages;
}

int64_t size(const Array* array) { return static_cast<int64_t>(array->size()); }

// The counts of a pyramid, in the order of PyramidSpec::capacity.
Array counts_of(const std::vector<Stage>& stages) {
  Array counts;
  for (const Stage& stage : stages)
    counts.insert(counts.end(), {size(stage.cloud), size(stage.cu_clouds) - 1, size(stage.cu_q) - 1,
                                 size(stage.kv_rows) / 4});
  for (const Stage& stage : stages)
    for (const Map& map : stage.maps) counts.push_back(size(map.tap_in));
  return counts;
}

// Copies the first entries of an array into one of another size.
class Copier {
 public:
  explicit Copier(const Arrays& arrays) : arrays_(arrays) {}

  // `rows` rows of n values, behind which filler(i) follows up to column `to_n`.
  template <typename F>
  void list(const Array* from, int64_t rows, int64_t n, int64_t to_n, const F& filler) const {
    int64_t* to = rows == 1 ? arrays_.append({to_n}) : arrays_.append({rows, to_n});
    const int64_t from_n = size(from) / rows;
    for (int64_t r = 0; r < rows; ++r) {
      std::copy_n(from->data() + r * from_n, n, to + r * to_n);
      for (int64_t i = n; i < to_n; ++i) to[r * to_n + i] = filler(i);
    }
  }
  // Offsets of n segments and, behind them, of empty ones.
  void offsets(const Array* from, int64_t n, int64_t to_n) const {
    list(from, 1, n + 1, to_n + 1, [&](int64_t) { return (*from)[n]; });
  }
  int64_t* append(std::initializer_list<int64_t> sizes) const { return arrays_.append(sizes); }

 private:
  const Arrays& arrays_;
};

constexpr auto zero = [](int64_t) { return int64_t{0}; };
constexpr auto place = [](int64_t i) { return i; };

// The input rows, those that take part first.
void copy_rows(const Array& awake, int64_t n, int64_t n_rows, const Copier& copier) {
  int64_t* rows = copier.append({n_rows});
  int64_t* behind = std::copy_n(awake.data(), n, rows);
  for (int64_t row = 0, next = 0; row < n_rows; ++row) {
    if (next < n && awake[next] == row)
      ++next;
    else
      *behind++ = row;
  }
  int64_t* cu_rows = copier.append({n_rows + 1});
  for (int64_t i = 0; i <= n_rows; ++i) cu_rows[i] = std::min(i, n);
}

void copy_stage(const Stage& stage, const int64_t* counts, const int64_t* capacity, bool fits, const Copier& copier) {
  const auto count = [&](Counted what) { return fits ? counts[static_cast<int64_t>(what)] : 0; };
  const auto room = [&](Counted what) { return capacity[static_cast<int64_t>(what)]; };
  const int64_t n = count(Counted::kRows), to_n = room(Counted::kRows);
  const int64_t n_voxels = fits ? size(stage.cu_voxel_rows) - 1 : 0;
  if (stage.cu_cluster) copier.offsets(stage.cu_cluster, n, to_n);
  if (stage.time_index) copier.list(stage.time_index, 1, n, to_n, zero);
  int64_t* grid = copier.append({to_n, 3});
  std::fill(std::copy_n(stage.grid->data(), 3 * n, grid), grid + 3 * to_n, int64_t{0});
  copier.list(stage.cloud, 1, n, to_n, zero);
  copier.offsets(stage.cu_clouds, count(Counted::kClouds), room(Counted::kClouds));
  copier.list(stage.order, 4, n, to_n, place);
  copier.offsets(stage.cu_q, count(Counted::kPatches), room(Counted::kPatches));
  copier.offsets(stage.cu_k, count(Counted::kPatches), room(Counted::kPatches));
  copier.list(stage.kv_rows, 4, count(Counted::kKeys), room(Counted::kKeys), zero);
  copier.list(stage.row_voxel, 1, n, to_n, [&](int64_t i) { return n_voxels + i - n; });
  copier.list(stage.voxel_rows, 1, n, to_n, place);
  copier.list(stage.cu_voxel_rows, 1, n_voxels + 1, to_n + 2,
              [&](int64_t i) { return std::min(n + i - n_voxels, to_n); });
}

}  // namespace

void check_capacity(const PyramidSpec& spec, int64_t n_rows) {
  if (!spec.capacity) return;
  const char* op = "build_pyramid";
  for (int64_t i = 0; i < capacity_of_pairs(spec.n_stages, spec.cu_kernels[spec.n_stages]); ++i)
    check(spec.capacity[i] >= 0, op, ": capacity must not be negative; got ", spec.capacity[i], " at ", i);
  check(spec.capacity[0] == n_rows, op, ": capacity must be made for the N=", n_rows, " rows of positions; got ",
        spec.capacity[0]);
}

template <typename T>
void build_given(const PyramidClouds<T>& clouds, const PyramidSpec& spec, const Arrays& arrays,
                 const Workspace& workspace, const Parallel& parallel) {
  check_capacity(spec, clouds.n_rows);
  PyramidSpec fitting = spec;
  fitting.capacity = nullptr, fitting.rounded = false;
  Fitted fitted;
  build_pyramid(clouds, fitting, {&Fitted::append, &fitted}, workspace, parallel);

  const std::vector<Stage> stages = stages_of(fitted.arrays.data() + 2, spec);
  const Array counts = counts_of(stages);
  Array rounded = counts;
  round_counts(rounded.data(), spec.n_stages, size(&rounded), clouds.n_rows);
  const int64_t* capacity = spec.rounded ? rounded.data() : spec.capacity;
  bool fits = true;
  for (size_t i = 0; i < counts.size(); ++i) fits &= counts[i] <= capacity[i];
  const Copier copier(arrays);
  copy_rows(fitted.arrays[0], fits ? counts[0] : 0, clouds.n_rows, copier);
  for (int64_t s = 0, k = 0; s < spec.n_stages; ++s) {
    const int64_t at = capacity_at(s, Counted::kRows);
    copy_stage(stages[s], counts.data() + at, capacity + at, fits, copier);
    for (const Map& map : stages[s].maps) {
      const int64_t n = fits ? size(map.tap_in) : 0, to_n = capacity[capacity_of_pairs(spec.n_stages, k++)];
      copier.list(map.tap_in, 1, n, to_n, zero);
      copier.list(map.tap_out, 1, n, to_n, zero);
      copier.list(map.cu_taps, 1, fits ? size(map.cu_taps) : 0, size(map.cu_taps), zero);
    }
  }
  int64_t* found = arrays.append({1 + static_cast<int64_t>(counts.size())});
  found[0] = fits ? 0 : kTooLarge;
  std::copy(counts.begin(), counts.end(), found + 1);
}

template void build_given<float>(const PyramidClouds<float>&, const PyramidSpec&, const Arrays&, const Workspace&,
                                 const Parallel&);
template void build_given<double>(const PyramidClouds<double>&, const PyramidSpec&, const Arrays&, const Workspace&,
                                  const Parallel&);

}  // namespace gsim3d::cpu
