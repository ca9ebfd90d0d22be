// Pieces of rows are looked at in parallel; a piece that holds rows of several clouds has a partial record of each.
#include <algorithm>
#include <type_traits>

#include "gsim3d/core/check.h"
#include "gsim3d/validate_state/validate_state_math.h"

namespace gsim3d::cpu {
namespace {

using namespace state_validation;  // NOLINT: this file is its other half

constexpr int64_t kPiece = kStatePiece;

void check_offsets(const char* op, const int64_t* cu_rows, int64_t n_clouds, int64_t n_rows) {
  check(cu_rows[0] == 0 && cu_rows[n_clouds] == n_rows, op, ": cu_rows must run from 0 to N=", n_rows, "; got ",
        cu_rows[0], " .. ", cu_rows[n_clouds]);
  for (int64_t q = 0; q < n_clouds; ++q)
    check(cu_rows[q] <= cu_rows[q + 1], op, ": cu_rows must not descend; got ", cu_rows[q], " then ", cu_rows[q + 1],
          " at ", q);
}

template <typename T>
void check_rows(const StateRows<T>& r) {
  constexpr const char* kOp = "validate_state";
  check_offsets(kOp, r.cu_rows, r.n_clouds, r.n_rows);
  for (int64_t q = 0; q < r.n_clouds; ++q)
    check(r.cloud_scene[q] >= 0 && r.cloud_scene[q] < r.n_scenes, kOp, ": cloud_scene must be in [0, B) with B=",
          r.n_scenes, "; got ", r.cloud_scene[q], " at ", q);
}

// Whether every value of rows [begin, end) is in bounds; quick, as it nearly always is.
template <typename T>
bool all_in_bounds(const StateRows<T>& rows, int64_t begin, int64_t end) {
  using Mask = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  Mask out = 0;
  for (int f = 0; f < rows.n_fields; ++f) {
    const T *values = rows.fields[f] + begin * rows.width[f], low = rows.low[f], high = rows.high[f];
    const int64_t n = (end - begin) * rows.width[f];
#pragma omp simd reduction(| : out)
    for (int64_t i = 0; i < n; ++i)
      out |= (values[i] >= low ? Mask{0} : Mask{1}) | (values[i] <= high ? Mask{0} : Mask{1});
  }
  return out == 0;
}

template <typename T>
void look_at_rows(const StateRows<T>& rows, const SanitizedRows<T>& sanitized, int64_t cloud, int64_t begin,
                  int64_t end, int32_t* status, double* record) {
  const int n_kinds = rows.n_fields + 2, columns = record_columns(rows.n_fields);
  for (int c = 0; c < columns; ++c) record[c] = start_of(c, rows.n_fields, rows.n_rows);
  double* sums = record + 2 * n_kinds;
  const double* origin = rows.origin + 3 * rows.cloud_scene[cloud];
  const bool clean = all_in_bounds(rows, begin, end), sanitizes = sanitized.activity != nullptr;
  if (sanitizes) {
    std::copy(rows.activity + begin, rows.activity + end, sanitized.activity + begin);
    for (int f = 0; f < rows.n_fields; ++f) {
      const int64_t first = begin * rows.width[f];
      std::copy(rows.fields[f] + first, rows.fields[f] + end * rows.width[f], sanitized.fields[f] + first);
    }
  }
  for (int64_t row = begin; row < end; ++row) {
    const RowState state = look_at_row(rows, row, clean ? 0 : faults_of_fields(rows, row), origin);
    const bool asleep = rows.activity[row] == kAsleep;
    status[row] = asleep ? 0 : state.status;
    if (!(state.status & 2)) sums[2] += static_cast<double>(rows.fields[1][row]);
    if (asleep) continue;
    if (state.status == 0) {
      sums[0] += 1;
      sums[1] += state.energy;
      for (int i = 0; i < 3; ++i) {
        const auto position = static_cast<double>(rows.fields[0][row * 3 + i]);
        sums[3 + i] = std::min(sums[3 + i], position), sums[6 + i] = std::max(sums[6 + i], position);
      }
      continue;
    }
    if (sanitizes) sanitize_row(rows, sanitized, state.status, origin, row);
    for (int k = 0; k < n_kinds; ++k)
      if (state.status & bit_of(k, rows.n_fields)) {
        record[2 * k] += 1;
        record[2 * k + 1] = std::min(record[2 * k + 1], static_cast<double>(row));
      }
  }
}

}  // namespace

template <typename T>
void validate_state(const StateRows<T>& rows, const SanitizedRows<T>& sanitized, int32_t* status, double* parts,
                const Parallel& parallel) {
  check_rows(rows);
  const int columns = record_columns(rows.n_fields);
  const int64_t n_pieces = (rows.n_rows + kPiece - 1) / kPiece;
  parallel.chunks(n_pieces, [&](int64_t piece) {
    const int64_t begin = piece * kPiece, end = std::min(rows.n_rows, begin + kPiece);
    int64_t cloud = std::upper_bound(rows.cu_rows, rows.cu_rows + rows.n_clouds + 1, begin) - rows.cu_rows - 1;
    for (; cloud < rows.n_clouds && rows.cu_rows[cloud] < end; ++cloud) {
      const int64_t from = std::max(begin, rows.cu_rows[cloud]), to = std::min(end, rows.cu_rows[cloud + 1]);
      if (from < to) look_at_rows(rows, sanitized, cloud, from, to, status, parts + (piece + cloud) * columns);
    }
  });
}

void join_records(const StatePartials& look) {
  check_offsets("join_records", look.cu_rows, look.n_clouds, look.n_rows);
  const int columns = record_columns(look.n_fields);
  for (int64_t q = 0; q < look.n_clouds; ++q) {
    const int64_t begin = look.cu_rows[q], end = look.cu_rows[q + 1];
    for (int c = 0; c < columns; ++c) {
      double value = start_of(c, look.n_fields, look.n_rows);
      for (int64_t piece = begin / kPiece; begin < end && piece <= (end - 1) / kPiece; ++piece)
        value = join(join_of(c, look.n_fields), value, look.parts[(piece + q) * columns + c]);
      look.record[q * columns + c] = finished(c, look.n_fields, look.n_rows, value);
    }
  }
}

#define GSIM3D_INSTANTIATE(T) \
  template void validate_state<T>(const StateRows<T>&, const SanitizedRows<T>&, int32_t*, double*, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
