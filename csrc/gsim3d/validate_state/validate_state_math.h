// What is wrong with one row, what stands in for it, and how columns of records are joined. For host and device.
#pragma once

#include <cmath>

#include "gsim3d/core/platform.h"
#include "gsim3d/validate_state/validate_state.h"

namespace gsim3d::state_validation {

constexpr double kLargest = 3.4028234663852886e38;  // of float32

struct RowState {
  int32_t status;
  double energy;  // half the squared displacement
};

// Bits of the fields that are out of bounds.
template <typename T>
GSIM3D_HD int32_t faults_of_fields(const StateRows<T>& rows, int64_t row) {
  int32_t faults = 0;
  for (int f = 0; f < rows.n_fields; ++f) {
    const int64_t width = rows.width[f];
    const T* values = rows.fields[f] + row * width;
    bool good = true;
    for (int64_t i = 0; i < width; ++i) good &= values[i] >= rows.low[f] && values[i] <= rows.high[f];
    faults |= good ? 0 : 1 << f;
  }
  return faults;
}

// `faults`: those of its fields. `origin`: of the row's scene; null: there is none, and no workspace.
template <typename T>
GSIM3D_HD RowState look_at_row(const StateRows<T>& rows, int64_t row, int32_t faults, const double* origin) {
  RowState state{faults, 0};
  if (faults & 1) return state;
  const T* position = rows.fields[0] + row * 3;
  if (origin != nullptr && rows.grid_size > 0) {
    bool within = true;
    for (int i = 0; i < 3; ++i) {
      const double cell = (static_cast<double>(position[i]) - origin[i]) / rows.grid_size;
      within &= cell >= 0 && cell < kWorkspaceCells;
    }
    state.status |= within ? 0 : kOutside;
  }
  if (rows.previous[0] != nullptr) {
    double squared = 0;
    for (int i = 0; i < 3; ++i) {
      const double step = static_cast<double>(position[i]) - static_cast<double>(rows.previous[0][row * 3 + i]);
      squared += step * step;
    }
    state.status |= squared <= rows.max_step * rows.max_step ? 0 : kFast;
    state.energy = squared / 2;
  }
  return state;
}

// Rows outside the workspace keep their numbers.
GSIM3D_HD bool keeps_numbers(int32_t status) { return (status & ((kOutside - 1) | kFast)) == 0; }

// Number i of field f in place of a row's own.
template <typename T>
GSIM3D_HD T stand_in(const StateRows<T>& rows, const SanitizedRows<T>& sanitized, int32_t status, const double* origin,
                     int f, int64_t row, int64_t i) {
  if (f == 1 && (status & (kOutside - 1))) return 0;
  if (rows.previous[f] != nullptr) return rows.previous[f][row * rows.width[f] + i];
  if (f == 0) return origin == nullptr ? T{0} : static_cast<T>(origin[i]);
  return i == 0 ? sanitized.neutral[f] : T{0};
}

template <typename T>
GSIM3D_HD void sanitize_row(const StateRows<T>& rows, const SanitizedRows<T>& sanitized, int32_t status,
                            const double* origin, int64_t row) {
  if (status != 0) sanitized.activity[row] = kAsleep;
  if (keeps_numbers(status)) return;
  for (int f = 0; f < rows.n_fields; ++f)
    for (int64_t i = 0; i < rows.width[f]; ++i)
      sanitized.fields[f][row * rows.width[f] + i] = stand_in(rows, sanitized, status, origin, f, row, i);
}

// The bit of kind k: the fields, kOutside, kFast.
GSIM3D_HD int32_t bit_of(int kind, int n_fields) {
  return kind < n_fields ? 1 << kind : kind == n_fields ? kOutside : kFast;
}

enum class Join { kSum, kLeast, kLargest };

GSIM3D_HD Join join_of(int column, int n_fields) {
  const int sums = 2 * (n_fields + 2);
  if (column < sums) return column % 2 ? Join::kLeast : Join::kSum;
  return column < sums + 3 ? Join::kSum : column < sums + 6 ? Join::kLeast : Join::kLargest;
}

// The value of a column where there are no rows. The first row is n_rows for none, until the record is complete.
GSIM3D_HD double start_of(int column, int n_fields, int64_t n_rows) {
  if (column < 2 * (n_fields + 2)) return column % 2 ? static_cast<double>(n_rows) : 0;
  const Join join = join_of(column, n_fields);
  return join == Join::kSum ? 0 : join == Join::kLeast ? kLargest : -kLargest;
}

GSIM3D_HD double join(Join how, double a, double b) {
  if (how == Join::kSum) return a + b;
  return how == Join::kLeast ? (b < a ? b : a) : (b > a ? b : a);
}

GSIM3D_HD double finished(int column, int n_fields, int64_t n_rows, double value) {
  const bool is_first = column < 2 * (n_fields + 2) && column % 2;
  return is_first && value >= static_cast<double>(n_rows) ? -1 : value;
}

}  // namespace gsim3d::state_validation
