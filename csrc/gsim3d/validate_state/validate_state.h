// One look at the rows of a state: which of them cannot be used, what stands in for them, and sums over each cloud.
//
// A row's status has bit f where a value of field f is below low[f], above high[f] or NaN; kOutside where its position
// is in no cell [0, 2^16) of its scene's workspace, kFast where it moved further than max_step. Field 0 is the
// position, field 1 the opacity; rows that are asleep have status 0. Sums are of float64, over fixed pieces of rows in
// order: the same bits for any number of threads.
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"

namespace gsim3d {

constexpr int kMaxStateFields = 9;
constexpr int32_t kOutside = 1 << 29, kFast = 1 << 30;
constexpr uint8_t kAsleep = 2;         // Particles.activity of gsim3d/state.py
constexpr double kWorkspaceCells = 65536;  // of a workspace along each axis: codes have 16 bits
// Columns of a record: count and first row (-1: none) of every field, of kOutside and of kFast; then how many rows are
// usable and awake, half their squared displacements, the opacities of all rows that have one in bounds, and the lowest
// and highest positions of the awake.
constexpr int kStateSums = 9;
constexpr const char* kStateSumNames[kStateSums] = {"awake", "kinetic_energy", "opacity_mass", "low_x", "low_y",
                                                        "low_z", "high_x", "high_y", "high_z"};
constexpr int record_columns(int n_fields) { return 2 * (n_fields + 2) + kStateSums; }

template <typename T>
struct StateRows {
  const T* fields[kMaxStateFields];  // [n_rows, width[f]]
  int64_t width[kMaxStateFields];    // 3, 1, ...
  T low[kMaxStateFields], high[kMaxStateFields];
  int n_fields;                          // 2 to kMaxStateFields
  const T* previous[kMaxStateFields];  // [n_rows, width[f]] one step before, or all null
  const uint8_t* activity;    // [n_rows]
  const int64_t* cu_rows;     // [n_clouds + 1]
  const int64_t* cloud_scene;  // [n_clouds] in [0, n_scenes)
  const double* origin;       // [n_scenes, 3] metres
  int64_t n_rows, n_clouds, n_scenes;
  double grid_size;  // metres, edge of a cell; 0: no workspace
  double max_step;   // metres
};

// The same rows, of which those with a status sleep. One with a fault of a field, or kFast, has the numbers of one
// step before; where there was none the corner of its workspace, and `neutral` followed by zeros. Opacity is 0 after a
// fault.
template <typename T>
struct SanitizedRows {
  T* fields[kMaxStateFields];  // [n_rows, width[f]]
  uint8_t* activity;             // [n_rows]; null: nothing is sanitized
  T neutral[kMaxStateFields];
};

// What looks leave of their sums: a partial record of every piece of rows, and of every cloud in it. A piece and a
// cloud that share rows ascend in one and never descend in the other, so that their sum names the pair.
constexpr int64_t record_parts(int64_t n_rows, int64_t n_clouds, int64_t piece) {
  const int64_t most = (n_rows + piece - 1) / piece + n_clouds - 1;
  return most > 0 ? most : 0;
}

// The parts of one look, and where its record goes.
struct StatePartials {
  const double* parts;     // [record_parts(n_rows, n_clouds, kStatePiece), record_columns(n_fields)]
  const int64_t* cu_rows;  // [n_clouds + 1]
  double* record;          // [n_clouds, record_columns(n_fields)]
  int64_t n_rows, n_clouds;
  int n_fields;
};

namespace cpu {

constexpr int64_t kStatePiece = 1024;  // rows

template <typename T>
void validate_state(const StateRows<T>& rows, const SanitizedRows<T>& sanitized,
                int32_t* status,  // [n_rows]
                double* parts,    // as in StatePartials
                const Parallel& parallel);

// Throws ArgumentError unless offsets ascend from 0 to n_rows.
void join_records(const StatePartials& look);

}  // namespace cpu

// Offsets and scenes are not checked; none is read out of bounds, the status of a row of no cloud is 0, and where
// offsets descend a record counts nothing.
namespace cuda {

constexpr int64_t kStatePiece = 128;  // few rows, so that small states too fill a GPU

template <typename T>
void validate_state(const StateRows<T>& rows, const SanitizedRows<T>& sanitized, int32_t* status, double* parts,
                Stream stream);

void join_records(const StatePartials* looks, int64_t n_looks, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
