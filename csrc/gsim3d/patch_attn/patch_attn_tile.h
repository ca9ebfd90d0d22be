// Part of patch_attn_cpu.cpp, which includes it once for each instruction set: all arithmetic of patch attention.
//
// A tile is kTile queries x kTile keys. Its matrices lie in panels whose rows are kTile long, lanes along the row:
// dimensions x queries, dimensions x keys, keys x queries. So softmax runs down the lanes, one query each, and all
// products are the same loop: C[i, :] += sum_s A(i, s) B[s, :]. An element of C is one chain of fma over s, whatever
// the width of the vectors and the blocking.

template <typename T>
using Exp2 = patch_attn::Exp2<T>;
template <typename T>
using Softmax = patch_attn::Softmax<T>;

// M rows x N vectors of C, kept in registers. A(i, s) = a[i kARow + s kAStep].
template <typename T, int M, int N, bool kAdd, int64_t kARow, int64_t kAStep>
GSIM3D_SIMD_INLINE void product_block(int64_t steps, const T* a, const T* b, int64_t b_step, T* c, int64_t c_row) {
  Lanes<T> sum[M][N];
#pragma GCC unroll 16
  for (int i = 0; i < M; ++i)
#pragma GCC unroll 4
    for (int j = 0; j < N; ++j) sum[i][j] = kAdd ? load(c + i * c_row + j * W<T>) : Lanes<T>{};
  for (int64_t s = 0; s < steps; ++s) {
    Lanes<T> row[N];
#pragma GCC unroll 4
    for (int j = 0; j < N; ++j) row[j] = load(b + s * b_step + j * W<T>);
#pragma GCC unroll 16
    for (int i = 0; i < M; ++i) {
      const Lanes<T> factor = fill(a[i * kARow + s * kAStep]);
#pragma GCC unroll 4
      for (int j = 0; j < N; ++j) sum[i][j] = fma(factor, row[j], sum[i][j]);
    }
  }
#pragma GCC unroll 16
  for (int i = 0; i < M; ++i)
#pragma GCC unroll 4
    for (int j = 0; j < N; ++j) store(c + i * c_row + j * W<T>, sum[i][j]);
}

template <typename T, int N, bool kAdd, int64_t kARow, int64_t kAStep>
void product_strip(int64_t rows, int64_t steps, const T* a, const T* b, int64_t b_step, T* c, int64_t c_row) {
  constexpr int kTall = N == 4 ? 4 : kRegisters / (4 * N);
  int64_t i = 0;
  for (; i + kTall <= rows; i += kTall)
    product_block<T, kTall, N, kAdd, kARow, kAStep>(steps, a + i * kARow, b, b_step, c + i * c_row, c_row);
  if constexpr (kTall > 4)
    for (; i + 4 <= rows; i += 4)
      product_block<T, 4, N, kAdd, kARow, kAStep>(steps, a + i * kARow, b, b_step, c + i * c_row, c_row);
  for (; i < rows; ++i)
    product_block<T, 1, N, kAdd, kARow, kAStep>(steps, a + i * kARow, b, b_step, c + i * c_row, c_row);
}

// C [rows, columns] = A B, or C += A B; columns is a multiple of the vector width.
template <typename T, bool kAdd, int64_t kARow, int64_t kAStep>
void product(int64_t rows, int64_t columns, int64_t steps, const T* a, const T* b, int64_t b_step, T* c, int64_t c_row) {
  int64_t j = 0;
  if constexpr (kRegisters == 32)
    for (; j + 4 * W<T> <= columns; j += 4 * W<T>)
      product_strip<T, 4, kAdd, kARow, kAStep>(rows, steps, a, b + j, b_step, c + j, c_row);
  for (; j + 2 * W<T> <= columns; j += 2 * W<T>)
    product_strip<T, 2, kAdd, kARow, kAStep>(rows, steps, a, b + j, b_step, c + j, c_row);
  for (; j < columns; j += W<T>)
    product_strip<T, 1, kAdd, kARow, kAStep>(rows, steps, a, b + j, b_step, c + j, c_row);
}

// 2^(slope x) for x <= 0; see patch_attn::Exp2. The last step is a product, so that a NaN passes.
template <typename T>
GSIM3D_SIMD_INLINE Lanes<T> weight(const Lanes<T>& x, const Lanes<T>& slope, const Lanes<T>& lowest) {
  using E = Exp2<T>;
  const Lanes<T> kept = max_keeping_nan(x, lowest);
  const Lanes<T> whole = fma(kept, slope, fill(E::kRound));
  const Lanes<T> f = fma(kept, slope, fill(E::kRound) - whole);
  Lanes<T> p = fill(E::kP[E::kTerms - 1]);
#pragma GCC unroll 16
  for (int i = E::kTerms - 2; i >= 0; --i) p = fma(p, f, fill(E::kP[i]));
  p = fma(p, f, fill(T(1)));
  return p * reinterpret_cast<Lanes<T>>(reinterpret_cast<Bits<T>>(whole) << E::kMantissaBits);
}

// Dot products to weights, in place, and the running softmax: `largest` and `sum` [columns], `out` [dim, columns].
template <typename T>
void softmax_step(int64_t n_keys, int64_t columns, int64_t dim, const Softmax<T>& softmax, T* dots, T* largest, T* sum,
                  T* out) {
  const Lanes<T> slope = fill(softmax.slope), lowest = fill(softmax.lowest);
  for (int64_t j = 0; j < columns; j += W<T>) {
    const Lanes<T> before = load(largest + j);
    Lanes<T> top = before;
    for (int64_t i = 0; i < n_keys; ++i) top = max_keeping_nan(load(dots + i * kTile + j), top);
    const Lanes<T> shrink = weight<T>(before - top, slope, lowest);
    Lanes<T> total = load(sum + j) * shrink;
    for (int64_t i = 0; i < n_keys; ++i) {
      const Lanes<T> p = weight<T>(load(dots + i * kTile + j) - top, slope, lowest);
      store(dots + i * kTile + j, p);
      total += p;
    }
    store(largest + j, top);
    store(sum + j, total);
    for (int64_t d = 0; d < dim; ++d) store(out + d * kTile + j, load(out + d * kTile + j) * shrink);
  }
}

// weights: dot products to weights; slopes: <grad, value> to the gradient of the dot product divided by scale; in place.
template <typename T>
void softmax_vjp_step(int64_t n_keys, int64_t columns, const Softmax<T>& softmax, const T* largest, const T* delta,
                      T* weights, T* slopes) {
  const Lanes<T> slope = fill(softmax.slope), lowest = fill(softmax.lowest);
  for (int64_t i = 0; i < n_keys; ++i)
    for (int64_t j = 0; j < columns; j += W<T>) {
      const int64_t at = i * kTile + j;
      const Lanes<T> p = weight<T>(load(weights + at) - load(largest + j), slope, lowest);
      store(weights + at, p);
      store(slopes + at, p * (load(slopes + at) - load(delta + j)));
    }
}

inline int64_t whole_vectors(int64_t n, int64_t width) { return (n + width - 1) / width * width; }

// Rows of a head as panels [dim, kTile]; lanes beyond the rows are 0.
template <typename T>
void pack_panel(const HeadRows<T>& x, const int64_t* rows, int64_t n, int64_t head, int64_t dim, T* panel) {
  for (int64_t i = 0; i < n; ++i) {
    const T* row = x.at(rows[i], head);
    for (int64_t d = 0; d < dim; ++d) panel[d * kTile + i] = row[d];
  }
  for (int64_t d = 0; d < dim && n < kTile; ++d) std::fill(panel + d * kTile + n, panel + (d + 1) * kTile, T(0));
}

template <typename T>
void pack_panels(const HeadRows<T>& x, const int64_t* rows, int64_t n, int64_t head, int64_t dim, T* panels) {
  for (int64_t i = 0; i < n; i += kTile)
    pack_panel(x, rows + i, std::min(kTile, n - i), head, dim, panels + i * dim);
}

template <typename T>
struct Forward {
  using Scalar = T;
  HeadRows<T> q, k, v;
  PatchTable table;
  AttentionSize size;
  T* out;
  T* stats;

  static int64_t scratch_size(int64_t n_keys, int64_t dim) {
    return 2 * dim * whole_vectors(n_keys, kTile) + kTile * (2 * dim + kTile + 2);
  }

  // Queries [q_begin, q_end) of patch p, one head.
  void patch(int64_t p, int64_t q_begin, int64_t q_end, int64_t head, T* scratch) const {
    const int64_t dim = size.dim, n_keys = table.cu_k[p + 1] - table.cu_k[p];
    const Softmax<T> softmax(size.scale);
    T* keys = scratch;
    T* values = keys + dim * whole_vectors(n_keys, kTile);
    T* queries = values + dim * whole_vectors(n_keys, kTile);
    T* result = queries + dim * kTile;
    T* dots = result + dim * kTile;
    T* largest = dots + kTile * kTile;
    T* sum = largest + kTile;
    pack_panels(k, table.kv_rows + table.cu_k[p], n_keys, head, dim, keys);
    pack_panels(v, table.kv_rows + table.cu_k[p], n_keys, head, dim, values);
    for (int64_t begin = q_begin; begin < q_end; begin += kTile) {
      const int64_t n = std::min(kTile, q_end - begin), columns = whole_vectors(n, W<T>);
      const int64_t* rows = table.q_rows + begin;
      pack_panel(q, rows, n, head, dim, queries);
      for (int64_t i = 0; i < dim * kTile; ++i) queries[i] *= softmax.sign;
      std::fill_n(result, dim * kTile, T(0));
      std::fill_n(largest, kTile, std::numeric_limits<T>::lowest());
      std::fill_n(sum, kTile, T(0));
      for (int64_t first = 0; first < n_keys; first += kTile) {
        const int64_t m = std::min(kTile, n_keys - first);
        product<T, false, 1, kTile>(m, columns, dim, keys + first * dim, queries, kTile, dots, kTile);
        softmax_step(m, columns, dim, softmax, dots, largest, sum, result);
        product<T, true, kTile, 1>(dim, columns, m, values + first * dim, dots, kTile, result, kTile);
      }
      for (int64_t i = 0; i < n; ++i) {
        T* to = out + (rows[i] * size.heads + head) * dim;
        for (int64_t d = 0; d < dim; ++d) to[d] = sum[i] == T(0) ? T(0) : result[d * kTile + i] / sum[i];
        T* pair = stats + (rows[i] * size.heads + head) * 2;
        pair[0] = sum[i] == T(0) ? T(0) : largest[i];
        pair[1] = sum[i];
      }
    }
  }
};

template <typename T>
struct Backward {
  using Scalar = T;
  HeadRows<T> grad, q, k, v;
  const T* out;
  const T* stats;
  PatchTable table;
  AttentionSize size;
  T* grad_q;
  T* key_slots;    // [H, n_k_listed, padded dim]: gradient of each entry of kv_rows, divided by scale
  T* value_slots;  // [H, n_k_listed, padded dim]

  static int64_t padded(int64_t dim) { return whole_vectors(dim, kSlotLanes); }
  static int64_t scratch_size(int64_t n_keys, int64_t dim) {
    return 2 * dim * whole_vectors(n_keys, kTile) + kTile * (3 * dim + 2 * padded(dim) + 2 * kTile + 2);
  }

  // Queries [q_begin, q_end), which are all of patch p, one head.
  void patch(int64_t p, int64_t q_begin, int64_t q_end, int64_t head, T* scratch) const {
    const int64_t dim = size.dim, wide = padded(dim), first_key = table.cu_k[p];
    const int64_t n_keys = table.cu_k[p + 1] - first_key;
    const Softmax<T> softmax(size.scale);
    T* keys = scratch;
    T* values = keys + dim * whole_vectors(n_keys, kTile);
    T* queries = values + dim * whole_vectors(n_keys, kTile);  // [dim, kTile], as all panels
    T* grads = queries + dim * kTile;
    T* result = grads + dim * kTile;
    T* query_rows = result + dim * kTile;  // [kTile, wide]
    T* grad_rows = query_rows + wide * kTile;
    T* weights = grad_rows + wide * kTile;  // [keys, queries]
    T* slopes = weights + kTile * kTile;
    T* largest = slopes + kTile * kTile;
    T* delta = largest + kTile;
    T* key_slot = key_slots + (head * table.n_k_listed + first_key) * wide;
    T* value_slot = value_slots + (head * table.n_k_listed + first_key) * wide;
    std::fill_n(key_slot, n_keys * wide, T(0));
    std::fill_n(value_slot, n_keys * wide, T(0));
    pack_panels(k, table.kv_rows + first_key, n_keys, head, dim, keys);
    pack_panels(v, table.kv_rows + first_key, n_keys, head, dim, values);
    for (int64_t begin = q_begin; begin < q_end; begin += kTile) {
      const int64_t n = std::min(kTile, q_end - begin), columns = whole_vectors(n, W<T>);
      const int64_t* rows = table.q_rows + begin;
      pack_queries(rows, n, head, softmax.sign, queries, grads, query_rows, grad_rows, largest, delta);
      std::fill_n(result, dim * kTile, T(0));
      for (int64_t first = 0; first < n_keys; first += kTile) {
        const int64_t m = std::min(kTile, n_keys - first);
        product<T, false, 1, kTile>(m, columns, dim, keys + first * dim, queries, kTile, weights, kTile);
        product<T, false, 1, kTile>(m, columns, dim, values + first * dim, grads, kTile, slopes, kTile);
        softmax_vjp_step(m, columns, softmax, largest, delta, weights, slopes);
        product<T, true, kTile, 1>(dim, columns, m, keys + first * dim, slopes, kTile, result, kTile);
        product<T, true, kTile, 1>(m, wide, n, slopes, query_rows, wide, key_slot + first * wide, wide);
        product<T, true, kTile, 1>(m, wide, n, weights, grad_rows, wide, value_slot + first * wide, wide);
      }
      for (int64_t i = 0; i < n; ++i) {
        T* to = grad_q + (rows[i] * size.heads + head) * dim;
        for (int64_t d = 0; d < dim; ++d) to[d] = result[d * kTile + i] * static_cast<T>(size.scale);
      }
    }
  }

  // Queries and output gradients, both as panels and as rows. Gradients are divided by the sum of weights, so that the
  // weights need not be; delta = <out, gradient>.
  void pack_queries(const int64_t* rows, int64_t n, int64_t head, T sign, T* queries, T* grads, T* query_rows,
                    T* grad_rows, T* largest, T* delta) const {
    const int64_t dim = size.dim, wide = padded(dim);
    std::fill_n(query_rows, n * wide, T(0));
    std::fill_n(grad_rows, n * wide, T(0));
    for (int64_t i = 0; i < n; ++i) {
      const T* query = q.at(rows[i], head);
      const T* slope = grad.at(rows[i], head);
      const T* result = out + (rows[i] * size.heads + head) * dim;
      const T* pair = stats + (rows[i] * size.heads + head) * 2;
      largest[i] = pair[0];
      delta[i] = T(0);
      for (int64_t d = 0; d < dim; ++d) {
        query_rows[i * wide + d] = query[d];
        queries[d * kTile + i] = query[d] * sign;
        grads[d * kTile + i] = grad_rows[i * wide + d] = slope[d] / pair[1];
        delta[i] += grad_rows[i * wide + d] * result[d];
      }
    }
    std::fill(largest + n, largest + kTile, T(0));
    std::fill(delta + n, delta + kTile, T(0));
    for (int64_t d = 0; d < dim && n < kTile; ++d) {
      std::fill(queries + d * kTile + n, queries + (d + 1) * kTile, T(0));
      std::fill(grads + d * kTile + n, grads + (d + 1) * kTile, T(0));
    }
  }
};
