// Grid pooling and unpooling: reductions of feature rows over segments, and the way back.
//
// A segment list says which rows belong together: segment s holds rows[cu_rows[s]] .. rows[cu_rows[s + 1] - 1]. A row
// is in at most one segment, so every result element has one owner and every sum runs in the order of the list: the
// same bits for any number of threads. T is float or double.
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"

namespace gsim3d {

struct Segments {
  const int64_t* rows;     // [R], each in [0, n_rows), none twice
  const int64_t* cu_rows;  // [n_segments + 1], ascending from 0 to at most R; rows listed behind are in no segment
  int64_t n_segments;
  int64_t n_listed;  // R
  int64_t n_rows;    // rows of the feature matrix
};

namespace cpu {

// Throws ArgumentError unless `segments` is well formed. `op` starts the message.
void check_segments(const char* op, const Segments& segments);

// out[s, c] = max over the segment of x[row, c]; argmax[s, c] = the first row that attains it. Empty segment: 0 and -1.
// A NaN in x wins its maximum and is passed on.
template <typename T>
void pool_max(const T* x,  // [n_rows, channels]
              const Segments& segments, int64_t channels,
              T* out,           // [n_segments, channels]
              int64_t* argmax,  // [n_segments, channels]
              const Parallel& parallel);

// grad_x[argmax[s, c], c] = grad[s, c]; zero elsewhere.
template <typename T>
void pool_max_vjp(const T* grad,          // [n_segments, channels]
                  const int64_t* argmax,  // [n_segments, channels]
                  int64_t n_segments, int64_t n_rows, int64_t channels,
                  T* grad_x,  // [n_rows, channels]
                  const Parallel& parallel);

// out[s] = mean over the segment of x[row]; 0 for an empty segment.
template <typename T>
void pool_mean(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel);

template <typename T>
void pool_mean_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, const Parallel& parallel);

// out[row] = x[s] for every row of segment s; 0 for a row in no segment. Throws as check_segments does.
template <typename T>
void unpool(const T* x,  // [n_segments, channels]
            const Segments& segments, int64_t channels,
            T* out,  // [n_rows, channels]
            const Parallel& parallel);

// grad_x[s] = sum over the segment of grad[row], in the order of the list.
template <typename T>
void unpool_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, const Parallel& parallel);

}  // namespace cpu

// The same functions on the device of `stream`. A row outside [0, n_rows) is skipped, one that is not listed becomes 0.
namespace cuda {

template <typename T>
void pool_max(const T* x, const Segments& segments, int64_t channels, T* out, int64_t* argmax, Stream stream);

template <typename T>
void pool_max_vjp(const T* grad, const int64_t* argmax, int64_t n_segments, int64_t n_rows, int64_t channels, T* grad_x,
                  Stream stream);

template <typename T>
void pool_mean(const T* x, const Segments& segments, int64_t channels, T* out, Stream stream);

template <typename T>
void pool_mean_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, Stream stream);

template <typename T>
void unpool(const T* x, const Segments& segments, int64_t channels, T* out, Stream stream);

template <typename T>
void unpool_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, Stream stream);

}  // namespace cuda
}  // namespace gsim3d
