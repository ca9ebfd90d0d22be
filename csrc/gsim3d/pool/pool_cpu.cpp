#include <cstring>
#include <vector>

#include "gsim3d/core/check.h"
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

}  // namespace

void check_segments(const char* op, const Segments& segments) {
  const auto& [rows, cu, n_segments, n_listed, n_rows] = segments;
  check(n_listed <= n_rows, op, ": rows must list each of the N=", n_rows, " rows at most once; got ", n_listed,
        " entries");
  check(cu[0] == 0 && cu[n_segments] == n_listed, op, ": cu_rows must run from 0 to len(rows)=", n_listed, "; got ", cu[0],
        " .. ", cu[n_segments]);
  for (int64_t s = 0; s < n_segments; ++s)
    check(cu[s] <= cu[s + 1], op, ": cu_rows must not descend; got ", cu[s], " then ", cu[s + 1], " at ", s);
  std::vector<char> seen(static_cast<size_t>(n_rows), 0);
  for (int64_t i = 0; i < n_listed; ++i) {
    check(rows[i] >= 0 && rows[i] < n_rows, op, ": rows must be in [0, N) with N=", n_rows, "; got ", rows[i], " at ", i);
    check(!seen[rows[i]], op, ": rows must list a row at most once; got ", rows[i], " again at ", i);
    seen[rows[i]] = 1;
  }
}

template <typename T>
void pool_max(const T* x, const Segments& segments, int64_t channels, T* out, int64_t* argmax, const Parallel& parallel) {
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    T* best = out + s * channels;
    int64_t* where = argmax + s * channels;
    if (begin == end) {
      std::fill_n(best, channels, T(0));
      std::fill_n(where, channels, int64_t{-1});
      return;
    }
    std::memcpy(best, x + segments.rows[begin] * channels, sizeof(T) * channels);
    std::fill_n(where, channels, segments.rows[begin]);
    for (int64_t i = begin + 1; i < end; ++i) {
      const int64_t row = segments.rows[i];
      const T* value = x + row * channels;
      for (int64_t c = 0; c < channels; ++c) {
        const bool wins = value[c] > best[c] || (value[c] != value[c] && best[c] == best[c]);
        best[c] = wins ? value[c] : best[c];
        where[c] = wins ? row : where[c];
      }
    }
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
        if (row >= 0) grad_x[row * channels + c] = grad[s * channels + c];
      }
  });
}

template <typename T>
void unpool_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, const Parallel& parallel) {
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    T* sum = grad_x + s * channels;
    std::fill_n(sum, channels, T(0));
    for (int64_t i = begin; i < end; ++i) {
      const T* value = grad + segments.rows[i] * channels;
      for (int64_t c = 0; c < channels; ++c) sum[c] += value[c];
    }
  });
}

template <typename T>
void pool_mean(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel) {
  unpool_vjp(x, segments, channels, out, parallel);
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    if (end - begin < 2) return;
    const T count = static_cast<T>(end - begin);
    for (int64_t c = 0; c < channels; ++c) out[s * channels + c] /= count;
  });
}

namespace {

template <typename T, bool kMean>
void spread(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel) {
  if (segments.n_listed < segments.n_rows)
    parallel.range(segments.n_rows, grain(segments.n_rows, segments.n_rows, channels), [&](int64_t begin, int64_t end) {
      std::fill(out + begin * channels, out + end * channels, T(0));
    });
  for_segments(segments, channels, parallel, [&](int64_t s, int64_t begin, int64_t end) {
    const T* value = x + s * channels;
    const T count = kMean ? static_cast<T>(end - begin) : T(1);
    for (int64_t i = begin; i < end; ++i) {
      T* row = out + segments.rows[i] * channels;
      for (int64_t c = 0; c < channels; ++c) row[c] = kMean ? value[c] / count : value[c];
    }
  });
}

}  // namespace

template <typename T>
void pool_mean_vjp(const T* grad, const Segments& segments, int64_t channels, T* grad_x, const Parallel& parallel) {
  spread<T, true>(grad, segments, channels, grad_x, parallel);
}

template <typename T>
void unpool(const T* x, const Segments& segments, int64_t channels, T* out, const Parallel& parallel) {
  spread<T, false>(x, segments, channels, out, parallel);
}

#define GSIM3D_INSTANTIATE(T)                                                                                          \
  template void pool_max<T>(const T*, const Segments&, int64_t, T*, int64_t*, const Parallel&);                       \
  template void pool_max_vjp<T>(const T*, const int64_t*, int64_t, int64_t, int64_t, T*, const Parallel&);            \
  template void pool_mean<T>(const T*, const Segments&, int64_t, T*, const Parallel&);                                \
  template void pool_mean_vjp<T>(const T*, const Segments&, int64_t, T*, const Parallel&);                            \
  template void unpool<T>(const T*, const Segments&, int64_t, T*, const Parallel&);                                   \
  template void unpool_vjp<T>(const T*, const Segments&, int64_t, T*, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
