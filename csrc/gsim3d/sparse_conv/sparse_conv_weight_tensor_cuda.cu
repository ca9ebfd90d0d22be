// The weight gradient on tensor cores: for every block of pairs of a tap, grads^T inputs of the gathered rows.
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"
#include "gsim3d/sparse_conv/sparse_conv_mma.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / kWarp;
constexpr int kDepth = 64;     // pairs of one stage
constexpr int kListed = 1024;  // pairs whose rows are looked up at a time
constexpr int kStages = 3;
constexpr int kWarpColumns = 32;

template <typename E>
struct PairRows {
  const E* out;  // null: no pair
  const E* in;
};

template <typename E, int kSide>
struct alignas(128) Memory {
  E grads[kStages][kDepth * kSide];
  E inputs[kStages][kDepth * kSide];
  PairRows<E> pairs[kListed];
};

// One block: kSide x kSide of the outer products of a block of pairs.
template <typename E, int kSide>
__global__ void __launch_bounds__(kThreads, 2) multiply_pairs(OuterProducts<E> products, int32_t column_tiles) {
  constexpr int kWarpsAcross = kSide / kWarpColumns, kWarpsDown = kWarps / kWarpsAcross;
  constexpr int kBlocks = kSide / 16 / kWarpsDown;  // blocks of 16 outputs of one warp
  constexpr int kChunks = kSide / 8, kPairsApart = kThreads / kChunks;

  extern __shared__ __align__(128) char raw[];
  auto& memory = *reinterpret_cast<Memory<E, kSide>*>(raw);
  const int thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  const int warp_down = warp / kWarpsAcross, warp_across = warp % kWarpsAcross;
  const int32_t co = blockIdx.y / column_tiles * kSide, ci = blockIdx.y % column_tiles * kSide;
  const PairBlock block = pair_block(products, blockIdx.x);

  // Where this thread copies 16 bytes of every kPairsApart-th pair to, and where this warp's first matrices lie.
  constexpr uint32_t kRowBytes = kSide * sizeof(E), kStageBytes = kDepth * kRowBytes;
  static_assert(kPairsApart % 8 == 0 && (kBlocks == 1 || kBlocks == 4));  // one permutation of chunks for all accesses
  const int pair = thread / kChunks, chunk = thread % kChunks;
  const uint32_t to_grads = shared_address(memory.grads[0] + chunk_offset<kSide>(pair, chunk));
  const uint32_t to_inputs = shared_address(memory.inputs[0] + chunk_offset<kSide>(pair, chunk));
  const bool left = co + chunk * 8 < products.c_out, right = ci + chunk * 8 < products.c_in;
  const int32_t left_column = left ? co + chunk * 8 : 0, right_column = right ? ci + chunk * 8 : 0;
  const uint32_t from_grads = shared_address(
      memory.grads[0] + chunk_offset<kSide>(lane / 16 * 8 + lane % 8, warp_down * kBlocks * 2 + lane / 8 % 2));
  const uint32_t from_inputs = shared_address(
      memory.inputs[0] + chunk_offset<kSide>(lane / 8 % 2 * 8 + lane % 8, warp_across * kWarpColumns / 8 + lane / 16));

  int32_t n_listed = 0;
  const auto copy_stage = [&](int32_t p0, int stage) {
    if (p0 < n_listed) {
#pragma unroll
      for (int i = 0; i < kDepth / kPairsApart; ++i) {
        const PairRows<E> rows = memory.pairs[p0 + pair + i * kPairsApart];  // the list ends with whole stages
        const bool real = rows.out != nullptr;
        copy_async(to_grads + stage * kStageBytes + i * kPairsApart * kRowBytes,
                   (real ? rows.out : products.grads.rows) + left_column, real && left);
        copy_async(to_inputs + stage * kStageBytes + i * kPairsApart * kRowBytes,
                   (real ? rows.in : products.inputs.rows) + right_column, real && right);
      }
    }
    close_copies();
  };

  float sums[kBlocks][kWarpColumns / 8][4] = {};
  for (int64_t begin = block.pairs.begin; begin < block.pairs.end; begin += kListed) {
    n_listed = static_cast<int32_t>(min(block.pairs.end - begin, int64_t{kListed}));
    __syncthreads();
    for (int32_t i = thread; i < (n_listed + kDepth - 1) / kDepth * kDepth; i += kThreads) {
      const PairSources rows = i < n_listed ? pair_sources(products, block.tap, begin + i) : PairSources{-1, -1};
      memory.pairs[i] = {rows.out < 0 ? nullptr : products.grads.at(rows.out),
                         rows.out < 0 ? nullptr : products.inputs.at(rows.in)};
    }
    __syncthreads();
    for (int stage = 0; stage < kStages - 1; ++stage) copy_stage(stage * kDepth, stage);
    for (int32_t p0 = 0, stage = 0; p0 < n_listed; p0 += kDepth, stage = stage + 1 == kStages ? 0 : stage + 1) {
      wait_for_copies<kStages - 2>();
      __syncthreads();
      copy_stage(p0 + (kStages - 1) * kDepth, stage == 0 ? kStages - 1 : stage - 1);
      const uint32_t a_stage = from_grads + stage * kStageBytes, b_stage = from_inputs + stage * kStageBytes;
#pragma unroll
      for (int k = 0; k < kDepth; k += 16) {
        uint32_t b[kWarpColumns / 16][4];
#pragma unroll
        for (int j = 0; j < kWarpColumns / 16; ++j)
          load_matrices_transposed((b_stage ^ (j * 32)) + k * kRowBytes, b[j]);
#pragma unroll
        for (int i = 0; i < kBlocks; ++i) {
          uint32_t a[4];
          load_matrices_transposed((a_stage ^ (i * 32)) + k * kRowBytes, a);
#pragma unroll
          for (int j = 0; j < kWarpColumns / 8; ++j)
            multiply_add<E>(a, b[j / 2][j % 2 * 2], b[j / 2][j % 2 * 2 + 1], sums[i][j]);
        }
      }
    }
    wait_for_copies<0>();
  }

  float* to = products.partials + static_cast<int64_t>(blockIdx.x) * products.c_out * products.c_in;
#pragma unroll
  for (int i = 0; i < kBlocks; ++i)
#pragma unroll
    for (int h = 0; h < 2; ++h)
#pragma unroll
      for (int j = 0; j < kWarpColumns / 8; ++j) {
        const int32_t o = co + (warp_down * kBlocks + i) * 16 + lane / 4 + h * 8;
        const int32_t n = ci + warp_across * kWarpColumns + j * 8 + lane % 4 * 2;
        if (o < products.c_out && n < products.c_in)  // c_in is even
          *reinterpret_cast<float2*>(to + static_cast<int64_t>(o) * products.c_in + n) =
              float2{sums[i][j][2 * h], sums[i][j][2 * h + 1]};
      }
}

}  // namespace

template <typename E>
void outer_products_tensor(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream) {
  const auto queue = [&]<int kSide>() {
    const unsigned columns = blocks_for(op, products.c_in, kSide);
    const dim3 blocks(blocks_for(op, n_blocks, 1), blocks_for(op, products.c_out, kSide) * columns);
    launch(op, multiply_pairs<E, kSide>, blocks, kThreads, sizeof(Memory<E, kSide>), stream, products,
           static_cast<int32_t>(columns));
  };
  if (products.c_in > 64 || products.c_out > 64)
    queue.template operator()<128>();
  else
    queue.template operator()<64>();
}

template void outer_products_tensor<__half>(const char*, const OuterProducts<__half>&, int64_t, Stream);
template void outer_products_tensor<__nv_bfloat16>(const char*, const OuterProducts<__nv_bfloat16>&, int64_t, Stream);

}  // namespace gsim3d::cuda::conv
