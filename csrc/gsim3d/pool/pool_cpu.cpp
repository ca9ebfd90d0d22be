#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/core/simd.h"
#include "gsim3d/pool/pool.h"

namespace gsim3d::cpu {
namespace {

// Elements one chunk should touch: enough to pay for handing it to a thread (about 20 us of work).
constexpr int64_t kElementsPerChunk = 32768;

int64_t grain(int64_t n, int64_t n_listed, int64_t channels) {
  const int64_t per_item = std::max<int64_t>(1, channels * std::max<int64_t>(1, n_listed / std::max<int64_t>(1, n)));
  return std::max<int64_t>(1, kElementsPerChunk / per_item);
}

template <typename F>
void for_segments(const Segments& segments, int64_t channels, const Parallel& parallel, const F& f) {
  parallel.range(segments.n_segments, grain(segments.n_segments, segments.n_listed, channels),
                 [&](int64_t begin, int64_t end) {
                   for (int64_t s = begin; s < end; ++s) f(s, segments.cu_rows[s], segments.cu_rows[s + 1]);
                 });
}

// What check_segments asks, without messages and many times faster.
bool well_formed(const Segments& segments) {
  const auto& [rows, cu, n_segments, n_listed, n_rows] = segments;
  bool good = n_listed <= n_rows && cu[0] == 0 && cu[n_segments] <= n_listed;
  for (int64_t s = 0; s < n_segments; ++s) good &= cu[s] <= cu[s + 1];
  for (int64_t i = 0; i < n_listed; ++i) good &= static_cast<uint64_t>(rows[i]) < static_cast<uint64_t>(n_rows);
  if (!good) return false;
  std::vector<uint64_t> seen(static_cast<size_t>(n_rows / 64 + 1), 0);
  uint64_t again = 0;
  for (int64_t i = 0; i < n_listed; ++i) {
    const uint64_t row = static_cast<uint64_t>(rows[i]), bit = uint64_t{1} << (row % 64);
    again |= seen[row / 64] & bit;
    seen[row / 64] |= bit;
  }
  return !again;
}

// Columns of N vectors. Where a lane is won is kept as a 32-bit row for float; pool_max checks that rows fit.
template <typename T, int N>
void max_columns(const T* x, const int64_t* rows, int64_t count, int64_t channels, T* out, int64_t* argmax) {
  using namespace simd::baseline;
  using Index = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  Lanes<T> best[N];
  Bits<T> where[N];
  for (int j = 0; j < N; ++j) {
    best[j] = load(x + rows[0] * channels + j * W<T>);
    where[j] = Bits<T>{} + static_cast<Index>(rows[0]);
  }
  for (int64_t i = 1; i < count; ++i) {
    const Bits<T> row = Bits<T>{} + static_cast<Index>(rows[i]);
    for (int j = 0; j < N; ++j) {
      const Lanes<T> value = load(x + rows[i] * channels + j * W<T>);
      const Bits<T> wins = (value > best[j]) | ((value != value) & (best[j] == best[j]));
      best[j] = wins ? value : best[j];
      where[j] = wins ? row : where[j];
    }
  }
  for (int j = 0; j < N; ++j) {
    store(out + j * W<T>, best[j]);
    for (int lane = 0; lane < W<T>; ++lane) argmax[j * W<T> + lane] = where[j][lane];
  }
}

template <typename T>
void max_column(const T* x, const int64_t* rows, int64_t count, int64_t channels, T* out, int64_t* argmax) {
  *out = x[rows[0] * channels];
  *argmax = rows[0];
  for (int64_t i = 1; i < count; ++i) {
    const T value = x[rows[i] * channels];
    if (value > *out || (value != value && *out == *out)) {
      *out = value;
      *argmax = rows[i];
    }
  }
}

}  // namespace

void check_segments(const char* op, const Segments& segments) {
  const auto& [rows, cu, n_segments, n_listed, n_rows] = segments;
  check(n_rows >= 0, op, ": n_rows must not be negative; got ", n_rows);
  if (well_formed(segments)) return;
  check(n_listed <= n_rows, op, ": rows must list each of the N=", n_rows, " rows at most once; got ", n_listed,
        " entries");
  check(cu[0] == 0 && cu[n_segments] <= n_listed, op, ": cu_rows must run from 0 to at most len(rows)=", n_listed,
        "; got ", cu[0], " .. ", cu[n_segments]);
  for (int64_t s = 0; s < n_segments; ++s)
    check(cu[s] <= cu[s + 1], op, ": cu_rows must not descend; got ", cu[s], " then ", cu[s + 1], " at ", s);
  std::vector<char> seen(static_cast<size_t>(n_rows), 0);
  for (int64_t i = 0; i < n_listed; ++i) {
    check(rows[i] >= 0 && rows[i] < n_rows, op, ": rows must be in [0, N) with N=", n_rows, "; got ", rows[i], " at ",
          i);
    check(!seen[rows[i]], op, ": rows must list a row at most once; got ", rows[i], " again at ", i);
    seen[rows[i]] = 1;
  }
}

template <typename T>
void pool_max(const T* x, const Segments& segments, int64_t channels, T* out, int64_t* argmax,
              const Parallel& parallel) {
  check(segments.n_rows <= std::numeric_limits<int32_t>::max(), "pool_max: x must have fewer than 2^31 rows; got ",
        segments.n_rows);
  constexpr int64_t width = simd::baseline::W<T>;
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    T* best = out + s * channels;
    int64_t* where = argmax + s * channels;
    if (begin == end) {
      std::fill_n(best, channels, T(0));
      std::fill_n(where, channels, int64_t{-1});
      return;
    }
    const int64_t* rows = segments.rows + begin;
    int64_t c = 0;
    for (; c + 2 * width <= channels; c += 2 * width)
      max_columns<T, 2>(x + c, rows, end - begin, channels, best + c, where + c);
    for (; c < channels; ++c) max_column(x + c, rows, end - begin, channels, best + c, where + c);
  });
}

template <typename T>
void pool_max_vjp(const T* grad, const int64_t* argmax, int64_t n_segments, int64_t n_rows, int64_t channels, T* grad_x,
                  const Parallel& parallel) {
  parallel.range(n_rows, grain(n_rows, n_rows, channels), [&](int64_t begin, int64_t end) {
    std::fill(grad_x + begin * channels, grad_x + end * channels, T(0));
  });
  // A row is in one segment only, so two segments never write the same element.
  parallel.range(n_segments, grain(n_segments, n_segments, channels), [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s)
      for (int64_t c = 0; c < channels; ++c) {
        const int64_t row = argmax[s * channels + c];
        check(row >= -1 && row < n_rows, "pool_max_backward: argmax must be in [-1, N) with N=", n_rows, "; got ", row);
        if (row >= 0) grad_x[row * channels + c] = grad[s * channels + c];
      }
  });
}

namespace {

template <typename T, bool kMean>
void add_up(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel) {
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    T* sum = out + s * channels;
    if (begin == end) {
      std::fill_n(sum, channels, T(0));
      return;
    }
    std::copy_n(x + segments.rows[begin] * channels, channels, sum);
    for (int64_t i = begin + 1; i < end; ++i) {
      const T* value = x + segments.rows[i] * channels;
      for (int64_t c = 0; c < channels; ++c) sum[c] += value[c];
    }
    if (!kMean || end - begin < 2) return;
    const T count = static_cast<T>(end - begin);
    for (int64_t c = 0; c < channels; ++c) sum[c] /= count;
  });
}

}  // namespace

template <typename T>
void pool_mean(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel) {
  add_up<T, true>(x, segments, channels, out, parallel);
}

template <typename T>
void pool_mean_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, const Parallel& parallel) {
  if (segments.cu_rows[segments.n_segments] < segments.n_rows)
    parallel.range(segments.n_rows, grain(segments.n_rows, segments.n_rows, channels), [&](int64_t begin, int64_t end) {
      std::fill(grad_x + begin * channels, grad_x + end * channels, T(0));
    });
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    if (begin == end) return;
    const T* value = grad + s * channels;
    T* first = grad_x + segments.rows[begin] * channels;
    const T count = static_cast<T>(end - begin);
    for (int64_t c = 0; c < channels; ++c) first[c] = value[c] / count;
    for (int64_t i = begin + 1; i < end; ++i)
      std::memcpy(grad_x + segments.rows[i] * channels, first, sizeof(T) * channels);
  });
}

// Rows are written in their order, which memory likes better than the order of segments. Listing the owner of each row
// tells whether the list is well formed on the way.
template <typename T>
void unpool(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel) {
  const auto& [rows, cu, n_segments, n_listed, n_rows] = segments;
  check(n_segments <= std::numeric_limits<int32_t>::max(), "unpool: x must have fewer than 2^31 rows; got ",
        n_segments);
  bool good = n_rows >= 0 && n_listed <= n_rows && cu[0] == 0 && cu[n_segments] <= n_listed;
  std::vector<int32_t> owner(good ? static_cast<size_t>(n_rows) : 0, -1);
  for (int64_t s = 0; good && s < n_segments; ++s) {
    const int64_t end = cu[s + 1];
    good = cu[s] <= end && end <= n_listed;
    for (int64_t i = cu[s]; good && i < end; ++i) {
      good = static_cast<uint64_t>(rows[i]) < static_cast<uint64_t>(n_rows) && owner[rows[i]] < 0;
      if (good) owner[rows[i]] = static_cast<int32_t>(s);
    }
  }
  for (int64_t i = good ? cu[n_segments] : n_listed; good && i < n_listed; ++i)
    good = static_cast<uint64_t>(rows[i]) < static_cast<uint64_t>(n_rows) && owner[rows[i]] < 0;
  if (!good) check_segments("unpool", segments);
  parallel.range(n_rows, grain(n_rows, n_rows, channels), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      if (owner[row] >= 0) std::memcpy(out + row * channels, x + owner[row] * channels, sizeof(T) * channels);
      else std::fill_n(out + row * channels, channels, T(0));
    }
  });
}

template <typename T>
void unpool_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, const Parallel& parallel) {
  add_up<T, false>(grad, segments, channels, grad_x, parallel);
}

#define GSIM3D_INSTANTIATE(T)                                                                              \
  template void pool_max<T>(const T*, const Segments&, int64_t, T*, int64_t*, const Parallel&);            \
  template void pool_max_vjp<T>(const T*, const int64_t*, int64_t, int64_t, int64_t, T*, const Parallel&); \
  template void pool_mean<T>(const T*, const Segments&, int64_t, T*, const Parallel&);                     \
  template void pool_mean_vjp<T>(const T*, const Segments&, int64_t, T*, const Parallel&);                 \
  template void unpool<T>(const T*, const Segments&, int64_t, T*, const Parallel&);                        \
  template void unpool_vjp<T>(const T*, const Segments&, int64_t, T*, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
