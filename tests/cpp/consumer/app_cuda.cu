#include <cstdio>

#include "gsim3d/pool/pool.h"

int main() {
  float *x, *out;  // [3 rows, 1 channel], [2 segments, 1 channel]
  int64_t *rows, *cu;
  if (cudaMallocManaged(&x, 12) || cudaMallocManaged(&out, 8) || cudaMallocManaged(&rows, 24) ||
      cudaMallocManaged(&cu, 24))
    return std::puts("no GPU"), 1;
  x[0] = 1, x[1] = 5, x[2] = 3, rows[0] = 0, rows[1] = 1, rows[2] = 2, cu[0] = 0, cu[1] = 2, cu[2] = 3;
  gsim3d::cuda::pool_mean(x, {rows, cu, 2, 3, 3}, 1, out, {nullptr, 0});
  if (cudaDeviceSynchronize()) return std::puts("the kernel failed"), 1;
  std::printf("%g %g\n", out[0], out[1]);  // 3 3
}
