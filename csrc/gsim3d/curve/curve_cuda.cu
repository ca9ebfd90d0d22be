#include <algorithm>
#include <cub/device/device_scan.cuh>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/curve/curve.h"
#include "gsim3d/curve/curve_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;

// The curves of one launch.
constexpr int kTogether = 4;
struct Curves {
  int64_t id[kTogether];
  int count;
};

// A cell or cloud that does not fit its bits has code 0.
__global__ void encode_kernel(const int64_t* __restrict__ grid, const int64_t* __restrict__ cloud, int64_t n,
                              Curves curves, int depth, int shift, int64_t* __restrict__ codes) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  const int64_t x = grid[3 * i], y = grid[3 * i + 1], z = grid[3 * i + 2], id = cloud[i];
  const bool fits = static_cast<uint64_t>(x | y | z) >> depth == 0 && static_cast<uint64_t>(id) >> (63 - shift) == 0;
#pragma unroll
  for (int c = 0; c < kTogether; ++c) {
    if (c >= curves.count) break;
    // A constant depth unrolls the levels.
    const auto code_at = [&](int levels) {
      return curve_code(static_cast<Curve>(curves.id[c]), static_cast<uint32_t>(x), static_cast<uint32_t>(y),
                        static_cast<uint32_t>(z), levels);
    };
    const uint64_t code = depth == kMaxDepth ? code_at(kMaxDepth) : code_at(depth);
    codes[c * n + i] = fits ? (id << shift) | static_cast<int64_t>(code) : 0;
  }
}

}  // namespace

void curve_encode(const int64_t* grid, const int64_t* cloud, int64_t n, const int64_t* curves, int64_t n_curves,
                  int64_t depth, int64_t shift, int64_t* codes, Stream stream) {
  const char* op = "curve_encode";
  for (int64_t c = 0; c < n_curves; ++c) cpu::check_curve(curves[c], depth, shift);
  for (int64_t first = 0; first < n_curves; first += kTogether) {
    Curves own{{}, static_cast<int>(std::min<int64_t>(kTogether, n_curves - first))};
    std::copy_n(curves + first, own.count, own.id);
    launch(op, encode_kernel, blocks_for(op, n, kThreads), kThreads, 0, stream, grid, cloud, n, own, depth, shift,
           codes + first * n);
  }
}

void exclusive_sums(const char* op, const uint32_t* values, int64_t n, uint32_t* sums, const Workspace& workspace,
                    Stream stream) {
  size_t bytes = 0;
  check_cuda(cub::DeviceScan::ExclusiveSum(nullptr, bytes, values, sums, n, native(stream)), op);
  void* scratch = workspace.take<char>(static_cast<int64_t>(bytes));
  check_cuda(cub::DeviceScan::ExclusiveSum(scratch, bytes, values, sums, n, native(stream)), op);
}

void curve_sort(const int64_t* codes, int64_t rows, int64_t n, int64_t* order, int64_t* inverse,
                const Workspace& workspace, Stream stream) {
  sort_rows("curve_sort",
            {.keys = reinterpret_cast<const uint64_t*>(codes),
             .n_rows = rows,
             .room = n,
             .bits = 64,
             .flip = uint64_t{1} << 63,  // unsigned order of the flipped codes is signed order of the codes
             .order = order,
             .inverse = inverse},
            workspace, stream);
}

}  // namespace gsim3d::cuda
