// A block looks at a piece of rows and leaves a partial record of each cloud in it; a second kernel joins the partial
// records of a cloud in order.
#include <algorithm>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/sentinel/sentinel_math.h"

namespace gsim3d::cuda {
namespace {

using namespace sentinel;  // NOLINT: this file is its other half

constexpr const char* kWatch = "watch_rows";
constexpr int kThreads = 256, kWarps = kThreads / kWarp;
constexpr int64_t kPiece = 1024;  // rows of a block
constexpr int kTeams = kThreads / kWarp;  // that share the partial records of a cloud
static_assert(watched_columns(kMaxWatchedFields) <= kWarp);

// Joins the values of all threads in a fixed tree; thread 0 gets the result.
__device__ double join_block(Join how, double value) {
  __shared__ double of_warp[kWarps];
  for (int step = kWarp / 2; step > 0; step /= 2) value = join(how, value, __shfl_down_sync(kFullWarp, value, step));
  __syncthreads();
  if (threadIdx.x % kWarp == 0) of_warp[threadIdx.x / kWarp] = value;
  __syncthreads();
  if (threadIdx.x == 0)
    for (int w = 1; w < kWarps; ++w) value = join(how, value, of_warp[w]);
  return value;
}

template <typename T>
__global__ void __launch_bounds__(kThreads) look_kernel(WatchedRows<T> rows, int32_t* status, double* partial) {
  const int n_fields = rows.n_fields, n_kinds = n_fields + 2, columns = watched_columns(n_fields);
  const int64_t begin = blockIdx.x * kPiece, end = min(rows.n_rows, begin + kPiece);
  for (int64_t row = begin + threadIdx.x; row < end; row += kThreads) status[row] = 0;  // also those of no cloud
  __syncthreads();
  int64_t low = 0, high = rows.n_clouds;  // the last cloud that begins at or before the piece
  while (high - low > 1) {
    const int64_t middle = (low + high) / 2;
    (rows.cu_rows[middle] <= begin ? low : high) = middle;
  }
  for (int64_t cloud = low; cloud < rows.n_clouds && rows.cu_rows[cloud] < end; ++cloud) {
    const Range of_cloud = range_of(rows.cu_rows, cloud, rows.n_rows);
    const int64_t from = max(begin, of_cloud.begin), to = min(end, of_cloud.end);
    if (from >= to) continue;
    const int64_t scene = rows.cloud_scene[cloud];
    const double* origin = inside(scene, rows.n_scenes) ? rows.origin + 3 * scene : nullptr;
    double sums[kWatchedSums];
    for (int i = 0; i < kWatchedSums; ++i) sums[i] = start_of(2 * n_kinds + i, n_fields, rows.n_rows);
    int32_t seen = 0;
    for (int64_t row = from + threadIdx.x; row < to; row += kThreads) {
      const RowState state = look_at_row(rows, row, faults_of_fields(rows, row), origin);
      const bool asleep = rows.activity[row] == kAsleep;
      status[row] = asleep ? 0 : state.status;
      if (!(state.status & 2)) sums[2] += static_cast<double>(rows.fields[1][row]);
      if (asleep) continue;
      seen |= state.status;
      if (state.status) continue;
      sums[0] += 1;
      sums[1] += state.energy;
      for (int i = 0; i < 3; ++i) {
        const auto position = static_cast<double>(rows.fields[0][row * 3 + i]);
        sums[3 + i] = min(sums[3 + i], position), sums[6 + i] = max(sums[6 + i], position);
      }
    }
    double* record = partial + (blockIdx.x + cloud) * columns;
    for (int i = 0; i < kWatchedSums; ++i) {
      const double sum = join_block(join_of(2 * n_kinds + i, n_fields), sums[i]);
      if (threadIdx.x == 0) record[2 * n_kinds + i] = sum;
    }
    const bool any = __syncthreads_or(seen);
    for (int k = 0; k < n_kinds; ++k) {
      double count = 0, first = static_cast<double>(rows.n_rows);
      if (any) {
        for (int64_t row = from + threadIdx.x; row < to; row += kThreads)
          if (status[row] & bit_of(k, n_fields)) count += 1, first = min(first, static_cast<double>(row));
        count = join_block(Join::kSum, count), first = join_block(Join::kLeast, first);
      }
      if (threadIdx.x == 0) record[2 * k] = count, record[2 * k + 1] = first;
    }
  }
}

// A block takes a cloud, a lane a column, a warp a run of the cloud's partial records.
template <typename T>
__global__ void __launch_bounds__(kThreads) join_kernel(WatchedRows<T> rows, const double* partial, double* record) {
  __shared__ double of_team[kTeams][kWarp];
  const int columns = watched_columns(rows.n_fields), column = threadIdx.x % kWarp, team = threadIdx.x / kWarp;
  for (int64_t cloud = blockIdx.x; cloud < rows.n_clouds; cloud += gridDim.x) {
    const Range of_cloud = range_of(rows.cu_rows, cloud, rows.n_rows);
    const int64_t first = of_cloud.begin / kPiece;
    const int64_t n = of_cloud.begin < of_cloud.end ? (of_cloud.end - 1) / kPiece - first + 1 : 0;
    const int64_t share = (n + kTeams - 1) / kTeams, from = team * share, to = min(n, from + share);
    double value = 0;
    if (column < columns) {
      const Join how = join_of(column, rows.n_fields);
      value = start_of(column, rows.n_fields, rows.n_rows);
#pragma unroll 4
      for (int64_t i = from; i < to; ++i) value = join(how, value, partial[(first + i + cloud) * columns + column]);
    }
    of_team[team][column] = value;
    __syncthreads();
    if (team == 0 && column < columns) {
      for (int t = 1; t < kTeams; ++t) value = join(join_of(column, rows.n_fields), value, of_team[t][column]);
      record[cloud * columns + column] = finished(column, rows.n_fields, rows.n_rows, value);
    }
    __syncthreads();
  }
}

}  // namespace

template <typename T>
void watch_rows(const WatchedRows<T>& rows, int32_t* status, double* record, const Workspace& workspace,
                Stream stream) {
  const int64_t n_pieces = (rows.n_rows + kPiece - 1) / kPiece;
  const int64_t n_partial = (n_pieces + rows.n_clouds) * watched_columns(rows.n_fields);
  double* partial = workspace.take<double>(n_partial);
  check(n_pieces <= INT32_MAX, kWatch, ": at most 2^41 rows; got ", rows.n_rows);
  fill_zero(kWatch, partial, n_partial, stream);  // offsets that do not ascend leave some out
  launch(kWatch, look_kernel<T>, static_cast<unsigned>(n_pieces), kThreads, 0, stream, rows, status, partial);
  launch(kWatch, join_kernel<T>, static_cast<unsigned>(std::min<int64_t>(rows.n_clouds, 1 << 16)), kThreads, 0, stream,
         rows, static_cast<const double*>(partial), record);
}

#define GSIM3D_INSTANTIATE(T) \
  template void watch_rows<T>(const WatchedRows<T>&, int32_t*, double*, const Workspace&, Stream);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cuda
