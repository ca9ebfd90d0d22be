// The weight gradient on tensor cores: for every block of pairs of a tap, grads^T inputs of the gathered rows.
#include "gsim3d/sparse_conv/sparse_conv_device.cuh"
#include "gsim3d/sparse_conv/sparse_conv_mma.cuh"

namespace gsim3d::cuda::conv {
namespace {

constexpr int kThreads = 256;
constexpr int kDepth = 64;     // pairs of one stage
constexpr int kListed = 1024;  // pairs whose rows are looked up at a time
constexpr int kStages = 3;
constexpr int kHalf = 64;  // columns of a staged row: 128 bytes

template <typename E>
struct PairRows {
  const E* out;  // null: no pair
  const E* in;
};

template <typename E, int kSide>
struct alignas(128) Memory {  // at a multiple of 1024 bytes
  E grads[kStages][kSide / kHalf][kDepth * kHalf];
  E inputs[kStages][kSide / kHalf][kDepth * kHalf];
  PairRows<E> pairs[kListed];
};

// The sums of a warp, 16 outputs by kParts times 8 kGroups inputs, as the tensor cores lay them out. Of a wide block
// each group of four warps has 64 outputs and all inputs, of a narrow one all outputs and 32 inputs.
template <int kSide>
struct Sums {
  static constexpr int kParts = kSide / kHalf, kGroups = kSide == kHalf ? 4 : 8;
  float values[kParts][kGroups][4];
};

// Queues sums += grads^T inputs over a stage at these addresses. The sums are there after finish_stage.
template <typename E, int kSide>
__device__ __forceinline__ void start_stage(Factor grads, Factor inputs, Sums<kSide>& sums) {
  constexpr int kRowBytes = kHalf * sizeof(E), kHalfBytes = kDepth * kRowBytes;
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
#pragma unroll
  for (auto& part : sums.values) fence_sums(part);
  start_group_products();
#pragma unroll
  for (int k = 0; k < kDepth; k += 16)
#pragma unroll
    for (int p = 0; p < Sums<kSide>::kParts; ++p)
      multiply_add_group<E, true>(moved(grads, k * kRowBytes), moved(inputs, p * kHalfBytes + k * kRowBytes),
                                  sums.values[p]);
  close_group_products();
#else
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp % 4;
  const uint32_t a = grads + chunk_offset<kHalf>(lane / 16 * 8 + lane % 8, warp * 2 + lane / 8 % 2) * sizeof(E);
  const uint32_t columns = inputs % kRowBytes;  // where the group's inputs start in a row
  const uint32_t b =
      (inputs - columns + chunk_offset<kHalf>(lane / 8 % 2 * 8 + lane % 8, lane / 16) * sizeof(E)) ^ columns;
#pragma unroll
  for (int k = 0; k < kDepth; k += 16) {
    uint32_t left[4];
    load_matrices_transposed(a + k * kRowBytes, left);
#pragma unroll
    for (int p = 0; p < Sums<kSide>::kParts; ++p)
#pragma unroll
      for (int j = 0; j < Sums<kSide>::kGroups; j += 2) {
        uint32_t right[4];
        load_matrices_transposed((b ^ (j * 16)) + p * kHalfBytes + k * kRowBytes, right);
        multiply_add<E>(left, right[0], right[1], sums.values[p][j]);
        multiply_add<E>(left, right[2], right[3], sums.values[p][j + 1]);
      }
  }
#endif
}

template <int kSide>
__device__ __forceinline__ void finish_stage(Sums<kSide>& sums) {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  wait_for_group_products<0>();
#pragma unroll
  for (auto& part : sums.values) fence_sums(part);
#endif
}

// One block: kSide x kSide of the outer products of a block of pairs.
template <typename E, int kSide>
__global__ void __launch_bounds__(kThreads, 2) multiply_pairs(OuterProducts<E> products, int32_t column_tiles) {
  constexpr int kChunks = kSide / 8, kPairsApart = kThreads / kChunks;
  constexpr uint32_t kRowBytes = kHalf * sizeof(E), kHalfBytes = kDepth * kRowBytes;
  constexpr uint32_t kStageBytes = kSide / kHalf * kHalfBytes;
  static_assert(kPairsApart % 8 == 0);  // the pairs of a thread have one permutation of chunks

  extern __shared__ __align__(1024) char raw[];
  auto& memory = *reinterpret_cast<Memory<E, kSide>*>(raw);
  const int thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp, group = warp / 4;
  const int32_t co = blockIdx.y / column_tiles * kSide, ci = blockIdx.y % column_tiles * kSide;
  const PairBlock block = pair_block(products, blockIdx.x);

  // Where this thread copies 16 bytes of every kPairsApart-th pair to, and where its group's factors lie.
  const int pair = thread / kChunks, chunk = thread % kChunks;
  const uint32_t copied = chunk / 8 * kHalfBytes + chunk_offset<kHalf>(pair, chunk % 8) * sizeof(E);
  const uint32_t grads = shared_address(memory.grads), inputs = shared_address(memory.inputs);
  const bool left = co + chunk * 8 < products.c_out, right = ci + chunk * 8 < products.c_in;
  const int32_t left_column = left ? co + chunk * 8 : 0, right_column = right ? ci + chunk * 8 : 0;
  const Factor group_grads = factor_at(grads + (kSide == kHalf ? 0 : group * kHalfBytes));
  const Factor group_inputs = factor_at(inputs + (kSide == kHalf ? group * kRowBytes / 2 : 0));

  int32_t n_listed = 0;
  const auto copy_stage = [&](int32_t p0, int stage) {
    if (p0 < n_listed) {
#pragma unroll
      for (int i = 0; i < kDepth / kPairsApart; ++i) {
        const PairRows<E> rows = memory.pairs[p0 + pair + i * kPairsApart];  // the list ends with whole stages
        const bool real = rows.out != nullptr;
        const uint32_t to = copied + stage * kStageBytes + i * kPairsApart * kRowBytes;
        copy_async(grads + to, (real ? rows.out : products.grads.rows) + left_column, real && left);
        copy_async(inputs + to, (real ? rows.in : products.inputs.rows) + right_column, real && right);
      }
    }
    close_copies();
  };

  Sums<kSide> sums{};
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
      publish_copies();
      __syncthreads();
      start_stage<E, kSide>(moved(group_grads, stage * kStageBytes), moved(group_inputs, stage * kStageBytes), sums);
      copy_stage(p0 + (kStages - 1) * kDepth, stage == 0 ? kStages - 1 : stage - 1);
      finish_stage<kSide>(sums);
    }
    wait_for_copies<0>();
  }

  const bool direct = products.partials == nullptr;
  float* to = direct ? nullptr : products.partials + static_cast<int64_t>(blockIdx.x) * products.c_out * products.c_in;
  const int32_t n_rows = direct ? products.result_rows : products.c_out;
  const int32_t first_out = co + (kSide == kHalf ? 0 : group * kHalf) + warp % 4 * 16 + lane / 4;
  const int32_t first_in = ci + (kSide == kHalf ? group * kHalf / 2 : 0) + lane % 4 * 2;
#pragma unroll
  for (int h = 0; h < 2; ++h)
#pragma unroll
    for (int p = 0; p < Sums<kSide>::kParts; ++p)
#pragma unroll
      for (int j = 0; j < Sums<kSide>::kGroups; ++j) {
        const int32_t o = first_out + h * 8, n = first_in + p * kHalf + j * 8;
        const float low = sums.values[p][j][2 * h], high = sums.values[p][j][2 * h + 1];
        if (o >= n_rows || n >= products.c_in) continue;  // c_in is even
        float* row = direct ? products.result + (static_cast<int64_t>(o) * products.taps + block.tap) * products.c_in
                            : to + static_cast<int64_t>(o) * products.c_in;
        *reinterpret_cast<float2*>(row + n) = float2{low, high};
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
