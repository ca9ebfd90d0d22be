#include <algorithm>

#include "gsim3d/background/background.h"
#include "gsim3d/background/background_math.h"
#include "gsim3d/core/check.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kGrain = 4096;  // rows that pay for handing a task to a thread

void check_overlap(const Overlap& overlap) {
  const char* op = "overlapping_patches";
  check(overlap.patch_size >= 1, op, ": patch_size must be at least 1; got ", overlap.patch_size);
  check(overlap.cu_k[0] == 0 && overlap.cu_k[overlap.n_patches] <= overlap.n_keys, op,
        ": cu_k must run from 0 to at most M=", overlap.n_keys, "; got ", overlap.cu_k[0], " .. ",
        overlap.cu_k[overlap.n_patches]);
  for (int64_t p = 0; p < overlap.n_patches; ++p) {
    const int64_t count = overlap.cu_k[p + 1] - overlap.cu_k[p];
    check(count >= 0 && count <= overlap.patch_size, op, ": cu_k must give each patch 0 to patch_size=",
          overlap.patch_size, " keys; got ", count, " at ", p);
  }
  check(overlap.cu_clouds[0] == 0 && overlap.cu_clouds[overlap.n_clouds] <= overlap.n_rows, op,
        ": cu_clouds must run from 0 to at most N=", overlap.n_rows, "; got ", overlap.cu_clouds[0], " .. ",
        overlap.cu_clouds[overlap.n_clouds]);
  for (int64_t c = 0; c < overlap.n_clouds; ++c)
    check(overlap.cu_clouds[c] <= overlap.cu_clouds[c + 1], op, ": cu_clouds must not descend; got ",
          overlap.cu_clouds[c], " then ", overlap.cu_clouds[c + 1], " at ", c);
  for (int64_t i = 0; i < overlap.n_curves * overlap.n_rows; ++i)
    check(overlap.order[i] >= 0 && overlap.order[i] < overlap.n_rows, op,
          ": order must be in [0, N) with N=", overlap.n_rows, "; got ", overlap.order[i], " at ", i);
  for (int64_t curve = 0; curve < overlap.n_curves; ++curve)
    for (int64_t c = 0; c < overlap.n_clouds; ++c)
      for (int64_t i = overlap.cu_clouds[c] + 1; i < overlap.cu_clouds[c + 1]; ++i) {
        const int64_t* codes = overlap.codes + curve * overlap.n_rows;
        const int64_t* order = overlap.order + curve * overlap.n_rows;
        check(codes[order[i - 1]] <= codes[order[i]], op,
              ": order must be by ascending code inside a cloud; it is not at ", i, " of curve ", curve);
      }
}

// Of one curve. `patch` [n_rows] and `begin` [n_patches + 2] are scratch.
void cut(const Overlap& overlap, const QueryParts& parts, int64_t curve, int64_t* patch, int64_t* begin) {
  const int64_t n_patches = overlap.n_patches, n_parts = overlap.n_parts(), n_listed = overlap.n_listed();
  const int64_t n_real = overlap.cu_clouds[overlap.n_clouds];
  const int64_t* codes = overlap.codes + curve * overlap.n_rows;
  const int64_t* order = overlap.order + curve * overlap.n_rows;
  const int64_t* keys = overlap.kv_rows + curve * overlap.n_keys;
  int64_t* q_rows = parts.q_rows + curve * overlap.n_rows;
  int64_t* kv_rows = parts.kv_rows + curve * n_listed;
  int64_t* cu_q = parts.cu_q + curve * (n_parts + 1);
  int64_t* cu_k = parts.cu_k + curve * (n_parts + 1);

  std::fill_n(begin, n_patches + 2, int64_t{0});
  for (int64_t i = 0; i < n_real; ++i) {
    patch[i] = background::patch_of(overlap.first + curve * n_patches, n_patches, codes[order[i]]);
    ++begin[patch[i] + 1];
  }
  for (int64_t p = 0; p <= n_patches; ++p) begin[p + 1] += begin[p];
  int64_t part = 0, n_keys = 0;
  for (int64_t p = 0; p < n_patches; ++p)
    for (int64_t i = 0; i < overlap.parts_of(begin[p + 1] - begin[p]); ++i) {
      cu_q[part] = begin[p] + i * overlap.patch_size, cu_k[part++] = n_keys;
      n_keys = std::copy(keys + overlap.cu_k[p], keys + overlap.cu_k[p + 1], kv_rows + n_keys) - kv_rows;
    }
  std::fill(cu_q + part, cu_q + n_parts + 1, begin[n_patches]);
  std::fill(cu_k + part, cu_k + n_parts + 1, n_keys);
  std::fill(kv_rows + n_keys, kv_rows + n_listed, int64_t{0});
  for (int64_t i = 0; i < n_real; ++i) q_rows[begin[patch[i]]++] = order[i];
  std::copy(order + n_real, order + overlap.n_rows, q_rows + n_real);
}

}  // namespace

void row_scenes(const RowChain& chain, const Parallel& parallel) {
  for (int64_t s = 0; s < chain.n_stages; ++s)
    parallel.range(chain.n_rows[s], kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row) chain.scene[s][row] = background::scene_of(chain, s, row);
    });
}

void find_cells(const int64_t* cells, int64_t n_cells, const int64_t* scene, const int64_t* grid, int64_t n,
                int64_t* places, const Parallel& parallel) {
  parallel.range(n, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      places[i] = background::place_of(cells, n_cells, background::cell_key(scene[i], grid + 3 * i));
  });
}

template <typename T>
void add_cells(const T* x, const T* field, const int64_t* places, int64_t n, int64_t n_cells, int64_t channels, T* out,
               const Parallel& parallel) {
  for (int64_t i = 0; i < n; ++i)
    check(places[i] >= 0 && places[i] < n_cells, "add_cells: places must be in [0, D) with D=", n_cells, "; got ",
          places[i], " at ", i);
  parallel.range(n, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const T* own = x + i * channels;
      const T* there = field + places[i] * channels;
      T* sum = out + i * channels;
#pragma omp simd
      for (int64_t c = 0; c < channels; ++c) sum[c] = own[c] + there[c];
    }
  });
}

template void add_cells<float>(const float*, const float*, const int64_t*, int64_t, int64_t, int64_t, float*,
                               const Parallel&);
template void add_cells<double>(const double*, const double*, const int64_t*, int64_t, int64_t, int64_t, double*,
                                const Parallel&);

void overlapping_patches(const Overlap& overlap, const QueryParts& parts, const Workspace& workspace,
                         const Parallel& parallel) {
  check_overlap(overlap);
  const int64_t n = overlap.n_rows, n_begins = overlap.n_patches + 2;
  int64_t* patch = workspace.take<int64_t>(overlap.n_curves * n);
  int64_t* begin = workspace.take<int64_t>(overlap.n_curves * n_begins);
  parallel.chunks(overlap.n_curves,
                  [&](int64_t curve) { cut(overlap, parts, curve, patch + curve * n, begin + curve * n_begins); });
}

}  // namespace gsim3d::cpu
