#include <cub/device/device_scan.cuh>

#include "gsim3d/core/cuda_utils.cuh"
#include "gsim3d/curve/curve.h"
#include "gsim3d/curve/curve_device.cuh"

namespace gsim3d::cuda {
namespace {

constexpr int kThreads = 256;

// A cell or cloud that does not fit its bits has code 0.
template <Curve kCurve>
__global__ void encode_kernel(const int64_t* __restrict__ grid, const int64_t* __restrict__ cloud, int64_t n, int depth,
                              int shift, int64_t* __restrict__ codes) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  const int64_t x = grid[3 * i], y = grid[3 * i + 1], z = grid[3 * i + 2], id = cloud[i];
  const bool fits = static_cast<uint64_t>(x | y | z) >> depth == 0 && static_cast<uint64_t>(id) >> (63 - shift) == 0;
  const uint64_t code =
      curve_code(kCurve, static_cast<uint32_t>(x), static_cast<uint32_t>(y), static_cast<uint32_t>(z), depth);
  codes[i] = fits ? (id << shift) | static_cast<int64_t>(code) : 0;
}

}  // namespace

void curve_encode(const int64_t* grid, const int64_t* cloud, int64_t n, int64_t curve, int64_t depth, int64_t shift,
                  int64_t* codes, Stream stream) {
  cpu::check_curve(curve, depth, shift);
  const auto run = [&](auto kernel) {
    launch("curve_encode", kernel, blocks_for("curve_encode", n, kThreads), kThreads, 0, stream, grid, cloud, n, depth,
           shift, codes);
  };
  switch (static_cast<Curve>(curve)) {
    case Curve::kZ:
      return run(encode_kernel<Curve::kZ>);
    case Curve::kZTrans:
      return run(encode_kernel<Curve::kZTrans>);
    case Curve::kHilbert:
      return run(encode_kernel<Curve::kHilbert>);
    case Curve::kHilbertTrans:
      return run(encode_kernel<Curve::kHilbertTrans>);
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
