#include <cstdio>
#include <vector>

#include "gsim3d/pool/pool.h"

int main() {
  const std::vector<float> x{1, 5, 3};         // [3 rows, 1 channel]
  const std::vector<int64_t> rows{0, 1, 2}, cu{0, 2, 3};
  std::vector<float> out(2);
  gsim3d::cpu::pool_mean(x.data(), {rows.data(), cu.data(), 2, 3, 3}, 1, out.data(), gsim3d::thread_pool());
  std::printf("%g %g\n", out[0], out[1]);  // 3 3
}
