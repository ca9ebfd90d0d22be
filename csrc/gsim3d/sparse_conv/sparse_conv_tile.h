// Part of sparse_conv_cpu.cpp, which includes it once for each instruction set: the matrix products.
//
// Right factors lie in panels of kPanel columns: panel j holds rows of kPanel columns, one after another, padded with
// zeros. An element of a product is one chain of fma, whatever the width of the vectors and the blocking.

template <typename T>
constexpr int64_t kPanel = 2 * W<T>;
constexpr int kTall = kRegisters == 16 ? 6 : 8;  // rows of a block of sums in registers

// Writes the weights of one tap as panels of outputs: B[ci, co].
template <typename T>
void pack_by_output(const T* weight, int64_t taps, int64_t tap, int64_t c_in, int64_t c_out, T* panels) {
  for (int64_t co0 = 0; co0 < c_out; co0 += kPanel<T>, panels += c_in * kPanel<T>)
    for (int64_t lane = 0; lane < kPanel<T>; ++lane) {
      const T* from = weight + ((co0 + lane) * taps + tap) * c_in;
      const bool inside = co0 + lane < c_out;
      for (int64_t ci = 0; ci < c_in; ++ci) panels[ci * kPanel<T> + lane] = inside ? from[ci] : T(0);
    }
}

// Writes the transposed weights of one tap as panels of inputs: B[co, ci].
template <typename T>
void pack_by_input(const T* weight, int64_t taps, int64_t tap, int64_t c_in, int64_t c_out, T* panels) {
  for (int64_t ci0 = 0; ci0 < c_in; ci0 += kPanel<T>) {
    const int64_t width = std::min(kPanel<T>, c_in - ci0);
    for (int64_t co = 0; co < c_out; ++co, panels += kPanel<T>) {
      std::copy_n(weight + (co * taps + tap) * c_in + ci0, width, panels);
      std::fill(panels + width, panels + kPanel<T>, T(0));
    }
  }
}

// M rows x N vectors of c[i] += sum_k a[i][k] B[k, :]; c[i] holds whole vectors.
template <typename T, int M, int N>
GSIM3D_SIMD_INLINE void rows_block(int64_t depth, const T* const* a_rows, const T* b, T* const* c) {
  Lanes<T> sum[M][N];
  const T* a[M];
#pragma GCC unroll 16
  for (int i = 0; i < M; ++i) {
    a[i] = a_rows[i];
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) sum[i][j] = load(c[i] + j * W<T>);
  }
  for (int64_t k = 0; k < depth; ++k, b += kPanel<T>) {
    Lanes<T> row[N];
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) row[j] = load(b + j * W<T>);
#pragma GCC unroll 16
    for (int i = 0; i < M; ++i) {
      const Lanes<T> factor = fill(a[i][k]);
#pragma GCC unroll 2
      for (int j = 0; j < N; ++j) sum[i][j] = fma(factor, row[j], sum[i][j]);
    }
  }
#pragma GCC unroll 16
  for (int i = 0; i < M; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < N; ++j) store(c[i] + j * W<T>, sum[i][j]);
}

// M rows of one panel, of which `width` columns exist in c.
template <typename T, int M>
void rows_of_panel(int64_t depth, int64_t width, const T* const* a, const T* b, T* const* c, int64_t column) {
  T* to[M];
  for (int i = 0; i < M; ++i) to[i] = c[i] + column;
  if (width == kPanel<T>) return rows_block<T, M, 2>(depth, a, b, to);
  if (width == W<T>) return rows_block<T, M, 1>(depth, a, b, to);
  T edge[M][kPanel<T>] = {};
  T* edges[M];
  for (int i = 0; i < M; ++i) {
    edges[i] = edge[i];
    std::copy_n(to[i], width, edge[i]);
  }
  if (width < W<T>) rows_block<T, M, 1>(depth, a, b, edges);
  else rows_block<T, M, 2>(depth, a, b, edges);
  for (int i = 0; i < M; ++i) std::copy_n(edge[i], width, to[i]);
}

template <typename T, int M>
void last_rows_of_panel(int64_t rows, int64_t depth, int64_t width, const T* const* a, const T* b, T* const* c,
                        int64_t column) {
  if constexpr (M > 0) {
    if (rows == M) rows_of_panel<T, M>(depth, width, a, b, c, column);
    else last_rows_of_panel<T, M - 1>(rows, depth, width, a, b, c, column);
  }
}

// c[i][:] += sum_k a[i][k] B[k, :] for rows that lie anywhere; no row of c twice.
template <typename T>
void multiply_rows(int64_t rows, int64_t depth, int64_t columns, const T* const* a, const T* panels, T* const* c) {
  for (int64_t column = 0; column < columns; column += kPanel<T>, panels += depth * kPanel<T>) {
    const int64_t width = std::min(kPanel<T>, columns - column);
    int64_t i = 0;
    for (; i + kTall <= rows; i += kTall) rows_of_panel<T, kTall>(depth, width, a + i, panels, c + i, column);
    last_rows_of_panel<T, kTall - 1>(rows - i, depth, width, a + i, panels, c + i, column);
  }
}

// Copies columns [begin, begin + width) of `count` rows into panels of kWide columns.
template <typename T, int64_t kWide>
void gather_panels(int64_t count, const T* const* rows, int64_t begin, int64_t width, T* panels) {
  for (int64_t column = 0; column < width; column += kWide) {
    const int64_t here = std::min(kWide, width - column);
    if (here == kWide) {
      for (int64_t p = 0; p < count; ++p, panels += kWide)
        std::memcpy(panels, rows[p] + begin + column, sizeof(T) * kWide);
    } else {
      for (int64_t p = 0; p < count; ++p, panels += kWide) {
        std::copy_n(rows[p] + begin + column, here, panels);
        std::fill(panels + here, panels + kWide, T(0));
      }
    }
  }
}

// sum[r, j] += sum over pairs p of left[p][r0 + r] right[p][j0 + j]. sum has sum_row columns and whole blocks of rows.
template <typename T>
void add_outer_products(int64_t count, const T* const* left, int64_t r0, int64_t rows, const T* const* right,
                        int64_t j0, int64_t columns, T* left_panels, T* right_panels, T* sum, int64_t sum_row) {
  gather_panels<T, kTall>(count, left, r0, rows, left_panels);
  gather_panels<T, kPanel<T>>(count, right, j0, columns, right_panels);
  for (int64_t j = 0; j < columns; j += kPanel<T>)
    for (int64_t r = 0; r < rows; r += kTall) {
      const T* a = left_panels + r * count;
      const T* b = right_panels + j * count;
      T* c = sum + r * sum_row + j;
      Lanes<T> block[kTall][2];
#pragma GCC unroll 16
      for (int i = 0; i < kTall; ++i) {
        block[i][0] = load(c + i * sum_row);
        block[i][1] = load(c + i * sum_row + W<T>);
      }
      for (int64_t p = 0; p < count; ++p, a += kTall, b += kPanel<T>) {
        const Lanes<T> low = load(b), high = load(b + W<T>);
#pragma GCC unroll 16
        for (int i = 0; i < kTall; ++i) {
          const Lanes<T> factor = fill(a[i]);
          block[i][0] = fma(factor, low, block[i][0]);
          block[i][1] = fma(factor, high, block[i][1]);
        }
      }
#pragma GCC unroll 16
      for (int i = 0; i < kTall; ++i) {
        store(c + i * sum_row, block[i][0]);
        store(c + i * sum_row + W<T>, block[i][1]);
      }
    }
}

template <typename T>
constexpr Products<T> kProducts = {pack_by_output<T>, pack_by_input<T>, multiply_rows<T>, add_outer_products<T>};
