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
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) sum[i][j] = kAdd ? load(c + i * c_row + j * W<T>) : Lanes<T>{};
  for (int64_t s = 0; s < steps; ++s) {
    Lanes<T> row[N];
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) row[j] = load(b + s * b_step + j * W<T>);
#pragma GCC unroll 16
    for (int i = 0; i < M; ++i) {
      const Lanes<T> factor = fill(a[i * kARow + s * kAStep]);
#pragma GCC unroll 2
      for (int j = 0; j < N; ++j) sum[i][j] = fma(factor, row[j], sum[i][j]);
    }
  }
#pragma GCC unroll 16
  for (int i = 0; i < M; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) store(c + i * c_row + j * W<T>, sum[i][j]);
}

template <typename T, int N, bool kAdd, int64_t kARow, int64_t kAStep>
void product_strip(int64_t rows, int64_t steps, const T* a, const T* b, int64_t b_step, T* c, int64_t c_row) {
  constexpr int kTall = N == 2 ? kRegisters / 4 : 8;  // the sums fill half of the registers
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
void product(int64_t rows, int64_t columns, int64_t steps, const T* a, const T* b, int64_t b_step, T* c,
             int64_t c_row) {
  int64_t j = 0;
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

// The part of softmax_step for N vectors of queries; side by side they hide the latency of their maxima and sums.
template <typename T, int N>
GSIM3D_SIMD_INLINE void softmax_columns(int64_t n_keys, int64_t dim, const Softmax<T>& softmax, T* dots, T* largest,
                                        T* sum, T* out) {
  const Lanes<T> slope = fill(softmax.slope), lowest = fill(softmax.lowest);
  Lanes<T> top[N], total[N], shrink[N];
  for (int j = 0; j < N; ++j) top[j] = load(largest + j * W<T>);
  for (int64_t i = 0; i < n_keys; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) top[j] = max_keeping_nan(load(dots + i * kTile + j * W<T>), top[j]);
  for (int j = 0; j < N; ++j) {
    shrink[j] = weight<T>(load(largest + j * W<T>) - top[j], slope, lowest);
    total[j] = load(sum + j * W<T>) * shrink[j];
    store(largest + j * W<T>, top[j]);
  }
  for (int64_t i = 0; i < n_keys; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) {
      T* at = dots + i * kTile + j * W<T>;
      const Lanes<T> p = weight<T>(load(at) - top[j], slope, lowest);
      store(at, p);
      total[j] += p;
    }
  for (int j = 0; j < N; ++j) store(sum + j * W<T>, total[j]);
  for (int64_t d = 0; d < dim; ++d)
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) {
      T* at = out + d * kTile + j * W<T>;
      store(at, load(at) * shrink[j]);
    }
}

// Dot products to weights, in place, and the running softmax: `largest` and `sum` [columns], `out` [dim, columns].
template <typename T>
void softmax_step(int64_t n_keys, int64_t columns, int64_t dim, const Softmax<T>& softmax, T* dots, T* largest, T* sum,
                  T* out) {
  int64_t j = 0;
  for (; j + 2 * W<T> <= columns; j += 2 * W<T>)
    softmax_columns<T, 2>(n_keys, dim, softmax, dots + j, largest + j, sum + j, out + j);
  for (; j < columns; j += W<T>)
    softmax_columns<T, 1>(n_keys, dim, softmax, dots + j, largest + j, sum + j, out + j);
}

// In place: dot products to weights; <grad, value> in `slopes` to the gradient of the dot product divided by scale.
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

// to[c][r] = from[r][c] for 4 x 4 elements.
template <typename T>
GSIM3D_SIMD_INLINE void transpose_quads(const T* const (&from)[4], T* const (&to)[4]) {
  typedef T Quad __attribute__((vector_size(4 * sizeof(T))));
  typedef std::conditional_t<sizeof(T) == 4, int32_t, int64_t> Index __attribute__((vector_size(4 * sizeof(T))));
  Quad row[4];
  for (int r = 0; r < 4; ++r) std::memcpy(&row[r], from[r], sizeof(Quad));
  const Quad low02 = __builtin_shuffle(row[0], row[2], Index{0, 4, 1, 5});
  const Quad high02 = __builtin_shuffle(row[0], row[2], Index{2, 6, 3, 7});
  const Quad low13 = __builtin_shuffle(row[1], row[3], Index{0, 4, 1, 5});
  const Quad high13 = __builtin_shuffle(row[1], row[3], Index{2, 6, 3, 7});
  const Quad column[4] = {
      __builtin_shuffle(low02, low13, Index{0, 4, 1, 5}), __builtin_shuffle(low02, low13, Index{2, 6, 3, 7}),
      __builtin_shuffle(high02, high13, Index{0, 4, 1, 5}), __builtin_shuffle(high02, high13, Index{2, 6, 3, 7})};
  for (int c = 0; c < 4; ++c) std::memcpy(to[c], &column[c], sizeof(Quad));
}

// Rows of dim elements, row(i) for i in [0, n), as a panel [dim, kTile]; lanes beyond the rows become 0.
template <typename T, typename Row>
void rows_to_panel(const Row& row, int64_t n, int64_t dim, T* panel) {
  if (n < kTile) std::fill_n(panel, dim * kTile, T(0));
  int64_t i = 0;
  for (; i + 4 <= n; i += 4)
    for (int64_t d = 0; d < dim; d += 4) {
      T* to = panel + d * kTile + i;
      transpose_quads<T>({row(i) + d, row(i + 1) + d, row(i + 2) + d, row(i + 3) + d},
                         {to, to + kTile, to + 2 * kTile, to + 3 * kTile});
    }
  for (; i < n; ++i)
    for (int64_t d = 0; d < dim; ++d) panel[d * kTile + i] = row(i)[d];
}

template <typename T, typename Row>
void panel_to_rows(const T* panel, int64_t n, int64_t dim, const Row& row) {
  int64_t i = 0;
  for (; i + 4 <= n; i += 4)
    for (int64_t d = 0; d < dim; d += 4) {
      const T* from = panel + d * kTile + i;
      transpose_quads<T>({from, from + kTile, from + 2 * kTile, from + 3 * kTile},
                         {row(i) + d, row(i + 1) + d, row(i + 2) + d, row(i + 3) + d});
    }
  for (; i < n; ++i)
    for (int64_t d = 0; d < dim; ++d) row(i)[d] = panel[d * kTile + i];
}

// One head of listed rows.
template <typename T>
struct ListedRows {
  HeadRows<T> x;
  const int64_t* rows;
  int64_t head;

  const T* operator()(int64_t i) const { return x.at(rows[i], head); }
};

// The same rows of a result [N, H, D].
template <typename T>
struct ResultRows {
  T* x;
  AttentionSize size;
  const int64_t* rows;
  int64_t head;

  T* operator()(int64_t i) const { return x + (rows[i] * size.heads + head) * size.dim; }
};

// Rows of a packed matrix.
template <typename T>
struct PackedRows {
  T* x;
  int64_t stride;

  T* operator()(int64_t i) const { return x + i * stride; }
};

template <typename T>
void rows_to_panels(const HeadRows<T>& x, const int64_t* rows, int64_t n, int64_t head, int64_t dim, T* panels) {
  for (int64_t i = 0; i < n; i += kTile)
    rows_to_panel(ListedRows<T>{x, rows + i, head}, std::min(kTile, n - i), dim, panels + i * dim);
}

// panel[d, :] *= factor, a number a lane.
template <typename T>
void scale_panel(int64_t dim, const T* factor, T* panel) {
  for (int64_t d = 0; d < dim; ++d)
    for (int64_t j = 0; j < kTile; j += W<T>)
      store(panel + d * kTile + j, load(panel + d * kTile + j) * load(factor + j));
}

template <typename T>
struct Forward {
  using Scalar = T;
  HeadRows<T> q, k, v;
  PatchTable table;
  AttentionSize size;
  bool joins;
  T* out;
  T* stats;

  static int64_t scratch_size(int64_t n_keys, int64_t dim) {
    return 2 * dim * whole_vectors(n_keys, kTile) + kTile * (2 * dim + kTile + 4);
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
    if (joins && n_keys == 0) return;
    rows_to_panels(k, table.kv_rows + table.cu_k[p], n_keys, head, dim, keys);
    rows_to_panels(v, table.kv_rows + table.cu_k[p], n_keys, head, dim, values);
    for (int64_t begin = q_begin; begin < q_end; begin += kTile) {
      const int64_t n = std::min(kTile, q_end - begin), columns = whole_vectors(n, W<T>);
      const int64_t* rows = table.q_rows + begin;
      rows_to_panel(ListedRows<T>{q, rows, head}, n, dim, queries);
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
      if (joins) join(rows, n, head, softmax, queries, result, largest, sum);
      for (int64_t i = 0; i < n; ++i) {
        T* pair = stats + (rows[i] * size.heads + head) * 2;
        pair[0] = sum[i] == T(0) ? T(0) : largest[i];
        pair[1] = sum[i];
      }
      for (int64_t i = 0; i < kTile; ++i) largest[i] = sum[i] == T(0) ? T(0) : T(1) / sum[i];
      scale_panel(dim, largest, result);
      panel_to_rows(result, n, dim, ResultRows<T>{out, size, rows, head});
    }
  }

  // Adds what `out` and `stats` hold of the queries; `panel` and the two rows behind `sum` are scratch.
  void join(const int64_t* rows, int64_t n, int64_t head, const Softmax<T>& softmax, T* panel, T* result, T* largest,
            T* sum) const {
    T* before = sum + kTile;  // differences to the largest of both, then weights
    T* own = before + kTile;
    std::fill_n(before, 2 * kTile, T(0));
    for (int64_t i = 0; i < n; ++i) {
      const T* pair = stats + (rows[i] * size.heads + head) * 2;
      const T top = pair[1] == T(0) || pair[0] < largest[i] ? largest[i] : pair[0];
      before[i] = pair[1] == T(0) ? T(0) : pair[0] - top;
      own[i] = largest[i] - top;
      largest[i] = top;
    }
    const Lanes<T> slope = fill(softmax.slope), lowest = fill(softmax.lowest);
    for (int64_t i = 0; i < 2 * kTile; i += W<T>) store(before + i, weight<T>(load(before + i), slope, lowest));
    for (int64_t i = 0; i < n; ++i) {
      before[i] *= stats[(rows[i] * size.heads + head) * 2 + 1];
      sum[i] = sum[i] * own[i] + before[i];
    }
    rows_to_panel(ListedRows<T>{{out, size.heads * size.dim, size.dim}, rows, head}, n, size.dim, panel);
    scale_panel(size.dim, own, result);
    scale_panel(size.dim, before, panel);
    for (int64_t i = 0; i < size.dim * kTile; ++i) result[i] += panel[i];
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
    rows_to_panels(k, table.kv_rows + first_key, n_keys, head, dim, keys);
    rows_to_panels(v, table.kv_rows + first_key, n_keys, head, dim, values);
    for (int64_t begin = q_begin; begin < q_end; begin += kTile) {
      const int64_t n = std::min(kTile, q_end - begin), columns = whole_vectors(n, W<T>);
      const int64_t* rows = table.q_rows + begin;
      pack_queries(rows, n, head, query_rows, grad_rows, largest);
      rows_to_panel(PackedRows<T>{query_rows, wide}, n, dim, queries);
      rows_to_panel(PackedRows<T>{grad_rows, wide}, n, dim, grads);
      for (int64_t i = 0; i < dim * kTile; ++i) queries[i] *= softmax.sign;
      find_delta(rows, n, head, grads, result, delta);
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
      for (int64_t i = 0; i < dim * kTile; ++i) result[i] *= static_cast<T>(size.scale);
      panel_to_rows(result, n, dim, ResultRows<T>{grad_q, size, rows, head});
    }
  }

  // Rows of queries and of output gradients. The latter are divided by the sum of weights, so that the weights need not
  // be.
  void pack_queries(const int64_t* rows, int64_t n, int64_t head, T* query_rows, T* grad_rows, T* largest) const {
    const int64_t dim = size.dim, wide = padded(dim);
    for (int64_t i = 0; i < n; ++i) {
      const T* query = q.at(rows[i], head);
      const T* slope = grad.at(rows[i], head);
      const T* pair = stats + (rows[i] * size.heads + head) * 2;
      const T share = T(1) / pair[1];
      largest[i] = pair[0];
      for (int64_t d = 0; d < dim; ++d) query_rows[i * wide + d] = query[d];
      for (int64_t d = 0; d < dim; ++d) grad_rows[i * wide + d] = slope[d] * share;
      std::fill(query_rows + i * wide + dim, query_rows + (i + 1) * wide, T(0));
      std::fill(grad_rows + i * wide + dim, grad_rows + (i + 1) * wide, T(0));
    }
    std::fill(largest + n, largest + kTile, T(0));
  }

  // delta = <out, gradient / sum of weights>; `panel` is scratch.
  void find_delta(const int64_t* rows, int64_t n, int64_t head, const T* grads, T* panel, T* delta) const {
    rows_to_panel(ListedRows<T>{{out, size.heads * size.dim, size.dim}, rows, head}, n, size.dim, panel);
    for (int64_t j = 0; j < kTile; j += W<T>) {
      Lanes<T> total{};
      for (int64_t d = 0; d < size.dim; ++d)
        total = fma(load(grads + d * kTile + j), load(panel + d * kTile + j), total);
      store(delta + j, total);
    }
  }
};
