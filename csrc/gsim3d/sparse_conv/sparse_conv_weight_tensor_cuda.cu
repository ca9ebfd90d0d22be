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
constexpr int kRowBytes = 128, kHalfBytes = kDepth * kRowBytes;

template <typename E, int kSide>
struct alignas(128) Memory {  // at a multiple of 1024 bytes
  E grads[kStages][kSide * kDepth];
  E inputs[kStages][kSide * kDepth];
  const E* grad_rows[kListed];  // null: no pair
  const E* input_rows[kListed];
};

// The sums of a warp, 16 outputs by eight inputs each, as the tensor cores lay them out. Of a wide block each group of
// four warps has 64 outputs and all inputs, of a narrow one all outputs and 32 inputs.
template <int kSide>
constexpr int kSums = kSide == kHalf ? 4 : kSide / 8;
template <int kSide>
using Sums = float[kSums<kSide>][4];

// A thread copies 16 bytes of every kApart-th row of a stage, for one of the factors. Sixty-four columns of all rows
// lie together.
template <typename E, int kSide>
struct Copy {
  static constexpr int kChunks = kSide / 8, kApart = kThreads / kChunks;
  static_assert(kApart % 8 == 0);  // the rows of a thread have one permutation of chunks
  const int row;
  const uint32_t to;
  const bool inside;
  const E* const anywhere;
  const int32_t column;

  __device__ Copy(uint32_t memory, int thread, int32_t first, int32_t columns, const E* anywhere)
      : row(thread / kChunks),
        to(memory + thread % kChunks / 8 * kHalfBytes + chunk_offset<kHalf>(row, thread % 8) * sizeof(E)),
        inside(first + thread % kChunks * 8 < columns),
        anywhere(anywhere),
        column(inside ? first + thread % kChunks * 8 : 0) {}

  __device__ void copy(const E* const* rows, int stage) const {
#pragma unroll
    for (int i = 0; i < kDepth / kApart; ++i) {
      const E* from = rows[row + i * kApart];
      const bool real = from != nullptr;
      copy_async(to + stage * kSide / kHalf * kHalfBytes + i * kApart * kRowBytes,
                 (real ? from : anywhere) + column, real && inside);
    }
  }
};

// Queues sums += grads^T inputs over a stage at these addresses. The sums are there after finish_stage.
template <typename E, int kSide>
__device__ __forceinline__ void start_stage(Factor grads, Factor inputs, Sums<kSide>& sums) {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  fence_sums(sums);
  start_group_products();
#pragma unroll
  for (int k = 0; k < kDepth; k += 16)
    multiply_add_group<E, true>(moved(grads, k * kRowBytes), moved(inputs, k * kRowBytes), sums);
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
    for (int j = 0; j < kSums<kSide>; j += 2) {
      uint32_t right[4];
      load_matrices_transposed((b ^ (j % 8 * 16)) + j / 8 * kHalfBytes + k * kRowBytes, right);
      multiply_add<E>(left, right[0], right[1], sums[j]);
      multiply_add<E>(left, right[2], right[3], sums[j + 1]);
    }
  }
#endif
}

template <int kGroups>
__device__ __forceinline__ void finish_stage(float (&sums)[kGroups][4]) {
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  wait_for_group_products<0>();
  fence_sums(sums);
#endif
}

// One block: kSide x kSide of the outer products of a block of pairs. All tiles of a block of pairs are begun one after
// another: they read the same rows.
template <typename E, int kSide>
__global__ void __launch_bounds__(kThreads, 2)
    multiply_pairs(OuterProducts<E> products, int32_t tiles, int32_t column_tiles) {
  constexpr bool kNarrow = kSide == kHalf;
  constexpr int kStageBytes = kSide / kHalf * kHalfBytes;
  extern __shared__ __align__(1024) char raw[];
  auto& memory = *reinterpret_cast<Memory<E, kSide>*>(raw);
  const int thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp, group = warp / 4;
  const int32_t tile = blockIdx.x % tiles, co = tile / column_tiles * kSide, ci = tile % column_tiles * kSide;
  const int64_t index = blockIdx.x / tiles;
  const PairBlock block = pair_block(products, index);

  const uint32_t grads = shared_address(memory.grads), inputs = shared_address(memory.inputs);
  const Copy<E, kSide> left(grads, thread, co, products.c_out, products.grads.rows);
  const Copy<E, kSide> right(inputs, thread, ci, products.c_in, products.inputs.rows);
  const Factor group_grads = factor_at(grads + (kNarrow ? 0 : group * kHalfBytes));
  const Factor group_inputs = kNarrow ? factor_at(inputs + group * kRowBytes / 2) : factor_at(inputs, kHalfBytes);

  int32_t n_listed = 0;
  const auto copy_stage = [&](int32_t p0, int stage) {
    if (p0 < n_listed) {  // the list ends with whole stages
      left.copy(memory.grad_rows + p0, stage);
      right.copy(memory.input_rows + p0, stage);
    }
    close_copies();
  };

  Sums<kSide> sums{};
  for (int64_t begin = block.pairs.begin; begin < block.pairs.end; begin += kListed) {
    n_listed = static_cast<int32_t>(min(block.pairs.end - begin, int64_t{kListed}));
    __syncthreads();
    for (int32_t i = thread; i < (n_listed + kDepth - 1) / kDepth * kDepth; i += kThreads) {
      const PairSources rows = i < n_listed ? pair_sources(products, block.tap, begin + i) : PairSources{-1, -1};
      memory.grad_rows[i] = rows.out < 0 ? nullptr : products.grads.at(rows.out);
      memory.input_rows[i] = rows.out < 0 ? nullptr : products.inputs.at(rows.in);
    }
    __syncthreads();
    for (int stage = 0; stage < kStages - 1; ++stage) copy_stage(stage * kDepth, stage);
    for (int32_t p0 = 0, stage = 0; p0 < n_listed; p0 += kDepth, stage = stage + 1 == kStages ? 0 : stage + 1) {
      wait_for_copies<kStages - 2>();
      publish_copies();
      __syncthreads();
      start_stage<E, kSide>(moved(group_grads, stage * kStageBytes), moved(group_inputs, stage * kStageBytes), sums);
      copy_stage(p0 + (kStages - 1) * kDepth, stage == 0 ? kStages - 1 : stage - 1);
      finish_stage(sums);
    }
    wait_for_copies<0>();
  }

  const bool direct = products.partials == nullptr;
  float* to = direct ? static_cast<float*>(products.result)
                     : products.partials + index * products.c_out * products.c_in;
  const int32_t n_rows = direct ? products.result_rows : products.c_out;
  const int32_t first_out = co + (kNarrow ? 0 : group * kHalf) + warp % 4 * 16 + lane / 4;
  const int32_t first_in = ci + (kNarrow ? group * kHalf / 2 : 0) + lane % 4 * 2;
#pragma unroll
  for (int h = 0; h < 2; ++h)
#pragma unroll
    for (int j = 0; j < kSums<kSide>; ++j) {
      const int32_t o = first_out + h * 8, n = first_in + j * 8;
      const float low = sums[j][2 * h], high = sums[j][2 * h + 1];
      if (o >= n_rows || n >= products.c_in) continue;  // c_in is even
      const int64_t row = direct ? static_cast<int64_t>(o) * products.taps + block.tap : o;
      const int64_t at = row * products.c_in + n;
      if (direct && products.rounded)
        *reinterpret_cast<uint32_t*>(static_cast<E*>(products.result) + at) = pair_of<E>(low, high);
      else
        *reinterpret_cast<float2*>(to + at) = float2{low, high};
    }
}

}  // namespace

template <typename E>
void outer_products_tensor(const char* op, const OuterProducts<E>& products, int64_t n_blocks, Stream stream) {
  const auto queue = [&]<int kSide>() {
    const int64_t columns = blocks_for(op, products.c_in, kSide);
    const int64_t tiles = blocks_for(op, products.c_out, kSide) * columns;
    launch(op, multiply_pairs<E, kSide>, blocks_for(op, n_blocks * tiles, 1), kThreads, sizeof(Memory<E, kSide>),
           stream, products, tiles, columns);
  };
  if (products.c_in > 64 || products.c_out > 64)
    queue.template operator()<128>();
  else
    queue.template operator()<64>();
}

template void outer_products_tensor<__half>(const char*, const OuterProducts<__half>&, int64_t, Stream);
template void outer_products_tensor<__nv_bfloat16>(const char*, const OuterProducts<__nv_bfloat16>&, int64_t, Stream);

}  // namespace gsim3d::cuda::conv
