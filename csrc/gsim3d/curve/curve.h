// Codes of cells along space-filling curves, and a stable sort of 64-bit codes.
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"
#include "gsim3d/curve/curve_math.h"

namespace gsim3d {
namespace cpu {

// Throws ArgumentError unless 0 <= curve < 4, 1 <= depth <= 16 and 3 depth <= shift <= 62.
void check_curve(int64_t curve, int64_t depth, int64_t shift);

// codes[i] = cloud[i] << shift | curve_code(curve, grid[i], depth). Throws ArgumentError as check_curve, and unless
// every cell is in [0, 2^depth) and every cloud in [0, 2^(63 - shift)).
void curve_encode(const int64_t* grid,   // [n, 3]
                  const int64_t* cloud,  // [n]
                  int64_t n, int64_t curve, int64_t depth, int64_t shift,
                  int64_t* codes,  // [n]
                  const Parallel& parallel);

// The codes of n cells at depth `depth` along all four curves, with `cloud << 3 depth` above them. Cells and clouds are
// trusted.
void encode_all(const int64_t* grid, const int64_t* cloud, int64_t n, int depth,
                uint64_t* const codes[kCurves],  // [n] each
                const Parallel& parallel);

// Stable ascending sort of each of `rows` rows of n keys: order[r, i] is the index of the i-th smallest key of row r.
// n < 2^32.
void radix_sort(const uint64_t* const* keys,  // [rows] pointers to [n]
                int64_t rows, int64_t n,
                int64_t* const* order,      // [rows] pointers to [n]
                int64_t* const* inverse,    // [rows] pointers to [n], inverse[r][order[r][i]] = i; or null
                uint64_t* const* sorted,    // [rows] pointers to [n], the keys in order; or null
                const Workspace& workspace, const Parallel& parallel);

// radix_sort of signed codes [rows, n].
void curve_sort(const int64_t* codes, int64_t rows, int64_t n, int64_t* order, int64_t* inverse,
                const Workspace& workspace, const Parallel& parallel);

}  // namespace cpu

// The same functions on the device of `stream`. A row with a cell or cloud out of range has code 0.
namespace cuda {

// Codes along several curves at once.
void curve_encode(const int64_t* grid, const int64_t* cloud, int64_t n,
                  const int64_t* curves,  // [n_curves]
                  int64_t n_curves, int64_t depth, int64_t shift,
                  int64_t* codes,  // [n_curves, n]
                  Stream stream);

void curve_sort(const int64_t* codes, int64_t rows, int64_t n, int64_t* order, int64_t* inverse,
                const Workspace& workspace, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
