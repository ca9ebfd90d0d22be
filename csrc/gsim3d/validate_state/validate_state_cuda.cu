// A block looks at a piece of rows, copies them, sanitizes its copy and leaves a partial record of each cloud in the
// piece; a second kernel joins the partial records of a cloud in order, of many looks at once.
#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/core/pack.cuh"
#include "gsim3d/validate_state/validate_state_math.h"

namespace gsim3d::cuda {
namespace {

using namespace state_validation;  // NOLINT: this file is its other half

constexpr const char* kValidate = "validate_state";
constexpr int kPiece = kStatePiece;  // rows of a block, one a thread
constexpr int kWarps = kPiece / kWarp;
constexpr int kBatch = 4;             // packs that a thread reads before it looks at the first
constexpr int kTeams = 1024 / kWarp;  // that share the partial records of a cloud
static_assert(record_columns(kMaxStateFields) <= kWarp);

// One field of a piece as a run of numbers, 16 bytes a read where its addresses allow it: copies it and says whether a
// number that this thread read is out of bounds.
template <typename T>
__device__ bool look_at_field(const T* __restrict__ values, T* __restrict__ copy, int64_t count, T low, T high) {
  constexpr int kSize = 16 / sizeof(T);
  using Read = Pack<T, kSize>;
  const bool aligned = (reinterpret_cast<uintptr_t>(values) | reinterpret_cast<uintptr_t>(copy)) % sizeof(Read) == 0;
  const int64_t n_packs = aligned ? count / kSize : 0;
  const auto* packs = reinterpret_cast<const Read*>(values);
  bool good = true;
  for (int64_t first = threadIdx.x; first < n_packs; first += kBatch * kPiece) {
    Read read[kBatch];
#pragma unroll
    for (int b = 0; b < kBatch; ++b) {
      if (first + b * kPiece < n_packs) read[b] = packs[first + b * kPiece];
    }
#pragma unroll
    for (int b = 0; b < kBatch; ++b) {
      const int64_t at = first + b * kPiece;
      if (at < n_packs) {
        if (copy != nullptr) reinterpret_cast<Read*>(copy)[at] = read[b];
#pragma unroll
        for (int i = 0; i < kSize; ++i) good &= read[b].lane[i] >= low && read[b].lane[i] <= high;
      }
    }
  }
  for (int64_t i = n_packs * kSize + threadIdx.x; i < count; i += kPiece) {
    const T value = values[i];
    if (copy != nullptr) copy[i] = value;
    good &= value >= low && value <= high;
  }
  return !good;
}

// What rows of one cloud in a piece add up to.
template <typename T>
struct Sums {
  double added[3] = {0, 0, 0};
  T low[3], high[3];

  __device__ Sums() {
    for (int i = 0; i < 3; ++i) low[i] = static_cast<T>(kLargest), high[i] = static_cast<T>(-kLargest);
  }
  // Of a warp, in a fixed tree; lane 0 has it.
  __device__ void join_warp() {
#pragma unroll
    for (int step = kWarp / 2; step > 0; step /= 2) {
#pragma unroll
      for (int i = 0; i < 3; ++i) {
        added[i] += __shfl_down_sync(kFullWarp, added[i], step);
        low[i] = min(low[i], __shfl_down_sync(kFullWarp, low[i], step));
        high[i] = max(high[i], __shfl_down_sync(kFullWarp, high[i], step));
      }
    }
  }
  __device__ void store(double* sums) const {
    for (int i = 0; i < 3; ++i) {
      sums[i] = added[i];
      sums[3 + i] = static_cast<double>(low[i]), sums[6 + i] = static_cast<double>(high[i]);
    }
  }
};

template <typename T>
__global__ void __launch_bounds__(kPiece)
    look_kernel(const __grid_constant__ StateRows<T> rows, const __grid_constant__ SanitizedRows<T> sanitized,
                int32_t* status, double* parts) {
  constexpr int kKinds = kMaxStateFields + 2;
  __shared__ int32_t counts[kKinds], firsts[kKinds];
  __shared__ double of_warp[kWarps][kStateSums];
  const int n_fields = rows.n_fields, n_kinds = n_fields + 2, columns = record_columns(n_fields);
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * kPiece, end = min(rows.n_rows, begin + kPiece);
  const int64_t row = begin + threadIdx.x;
  const bool sanitizes = sanitized.activity != nullptr;
  bool bad = false;
  for (int f = 0; f < n_fields; ++f) {
    const int64_t width = rows.width[f], first = begin * width;
    bad |= look_at_field(rows.fields[f] + first, sanitizes ? sanitized.fields[f] + first : nullptr,
                         (end - begin) * width, rows.low[f], rows.high[f]);
  }
  const bool any_bad = __syncthreads_or(bad);  // also: what is sanitized is copied already
  const int32_t faults = any_bad && row < end ? faults_of_fields(rows, row) : 0;
  const uint8_t activity = row < end ? rows.activity[row] : kAsleep;
  if (row < end) {  // offsets that do not fit leave rows without a cloud
    status[row] = 0;
    if (sanitizes) sanitized.activity[row] = activity;
  }
  int64_t low = 0, high = rows.n_clouds;  // the last cloud that begins at or before the piece
  while (high - low > 1) {
    const int64_t middle = (low + high) / 2;
    (rows.cu_rows[middle] <= begin ? low : high) = middle;
  }
  for (int64_t cloud = low; cloud < rows.n_clouds && rows.cu_rows[cloud] < end; ++cloud) {
    const Range of_cloud = range_of(rows.cu_rows, cloud, rows.n_rows);
    const int64_t from = max(begin, of_cloud.begin), to = min(end, of_cloud.end);
    if (from >= to) continue;
    __syncthreads();
    if (threadIdx.x < n_kinds) counts[threadIdx.x] = 0, firsts[threadIdx.x] = kPiece;
    __syncthreads();
    Sums<T> sums;
    if (row >= from && row < to) {
      const int64_t scene = rows.cloud_scene[cloud];
      const double* origin = inside(scene, rows.n_scenes) ? rows.origin + 3 * scene : nullptr;
      const RowState state = look_at_row(rows, row, faults, origin);
      if (!(state.status & 2)) sums.added[2] = static_cast<double>(rows.fields[1][row]);
      if (activity != kAsleep && state.status == 0) {
        sums.added[0] = 1, sums.added[1] = state.energy;
        for (int i = 0; i < 3; ++i) sums.low[i] = sums.high[i] = rows.fields[0][row * 3 + i];
      } else if (activity != kAsleep) {
        status[row] = state.status;
        if (sanitizes) sanitize_row(rows, sanitized, state.status, origin, row);
        for (int k = 0; k < n_kinds; ++k) {
          if (!(state.status & bit_of(k, n_fields))) continue;
          atomicAdd(&counts[k], 1), atomicMin(&firsts[k], static_cast<int>(threadIdx.x));
        }
      }
    }
    sums.join_warp();
    if (threadIdx.x % kWarp == 0) sums.store(of_warp[threadIdx.x / kWarp]);
    __syncthreads();
    const int column = threadIdx.x, kind = column / 2;
    if (column >= columns) continue;
    double value = 0;
    if (kind >= n_kinds) {
      value = of_warp[0][column - 2 * n_kinds];
      for (int w = 1; w < kWarps; ++w) value = join(join_of(column, n_fields), value, of_warp[w][column - 2 * n_kinds]);
    } else if (column % 2 == 0) {
      value = counts[kind];
    } else {
      value = static_cast<double>(firsts[kind] == kPiece ? rows.n_rows : begin + firsts[kind]);
    }
    parts[(blockIdx.x + cloud) * columns + column] = value;
  }
}

constexpr int kLooks = 32;  // of a launch
struct Looks {
  StatePartials of[kLooks];
};

// A block takes a cloud of a look, a lane a column, a warp a run of the cloud's partial records.
__global__ void __launch_bounds__(kTeams* kWarp) join_kernel(const __grid_constant__ Looks looks) {
  __shared__ double of_team[kTeams][kWarp];
  const StatePartials& look = looks.of[blockIdx.y];
  const int columns = record_columns(look.n_fields), column = threadIdx.x % kWarp, team = threadIdx.x / kWarp;
  bool ascends = true;  // else some pairs of a piece and a cloud have no partial record
  for (int64_t q = threadIdx.x; q < look.n_clouds; q += kTeams * kWarp)
    ascends &= look.cu_rows[q] <= look.cu_rows[q + 1];
  ascends = __syncthreads_and(ascends);
  for (int64_t cloud = blockIdx.x; cloud < look.n_clouds; cloud += gridDim.x) {
    const Range of_cloud = range_of(look.cu_rows, cloud, look.n_rows);
    const int64_t first = of_cloud.begin / kPiece;
    const int64_t n = ascends && of_cloud.begin < of_cloud.end ? (of_cloud.end - 1) / kPiece - first + 1 : 0;
    const int64_t share = (n + kTeams - 1) / kTeams, from = team * share, to = min(n, from + share);
    double value = 0;
    if (column < columns) {
      const Join how = join_of(column, look.n_fields);
      value = start_of(column, look.n_fields, look.n_rows);
#pragma unroll 4
      for (int64_t i = from; i < to; ++i)
        value = join(how, value, look.parts[(first + i + cloud) * columns + column]);
    }
    of_team[team][column] = value;
    __syncthreads();
    if (team == 0 && column < columns) {
      for (int t = 1; t < kTeams; ++t) value = join(join_of(column, look.n_fields), value, of_team[t][column]);
      look.record[cloud * columns + column] = finished(column, look.n_fields, look.n_rows, value);
    }
    __syncthreads();
  }
}

}  // namespace

template <typename T>
void validate_state(const StateRows<T>& rows, const SanitizedRows<T>& sanitized, int32_t* status, double* parts,
                Stream stream) {
  launch(kValidate, look_kernel<T>, blocks_for(kValidate, rows.n_rows, kPiece), kPiece, 0, stream, rows, sanitized,
         status, parts);
}

void join_records(const StatePartials* all, int64_t n_looks, Stream stream) {
  for (int64_t first = 0; first < n_looks; first += kLooks) {
    Looks looks{};
    const int64_t n = std::min<int64_t>(n_looks - first, kLooks);
    int64_t most = 0;
    for (int64_t i = 0; i < n; ++i) looks.of[i] = all[first + i], most = std::max(most, all[first + i].n_clouds);
    const dim3 blocks(static_cast<unsigned>(std::min<int64_t>(most, 1 << 16)), static_cast<unsigned>(n));
    launch("join_records", join_kernel, blocks, kTeams * kWarp, 0, stream, looks);
  }
}

#define GSIM3D_INSTANTIATE(T) \
  template void validate_state<T>(const StateRows<T>&, const SanitizedRows<T>&, int32_t*, double*, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
