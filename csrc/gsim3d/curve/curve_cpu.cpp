#include "gsim3d/curve/curve.h"

#include <bit>
#include <cstring>
#include <vector>

#include "gsim3d/core/check.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kBlock = 512;              // cells encoded at once: their scratch stays in the first-level cache
constexpr int64_t kEncodeGrain = 16 * kBlock;
constexpr int kDigitBits = 8;                // 256 open destinations fit the first-level cache
constexpr int kDigits = 1 << kDigitBits;
constexpr int kMaxPasses = 64 / kDigitBits;
constexpr int64_t kSortChunk = 65536;        // a longer row is cut into chunks that threads share

struct Block {
  uint32_t a[kBlock], b[kBlock], c[kBlock];
  uint64_t code[kBlock];
};

// Splits cells into axes; the return value has a bit set above bit 15 where a coordinate has one, also for negatives.
int64_t load_block(const int64_t* grid, int64_t n, bool trans, Block& block) {
  uint32_t* first = trans ? block.b : block.a;
  uint32_t* second = trans ? block.a : block.b;
  int64_t seen = 0;
  for (int64_t i = 0; i < n; ++i) {
    seen |= grid[3 * i] | grid[3 * i + 1] | grid[3 * i + 2];
    first[i] = static_cast<uint32_t>(grid[3 * i]);
    second[i] = static_cast<uint32_t>(grid[3 * i + 1]);
    block.c[i] = static_cast<uint32_t>(grid[3 * i + 2]);
  }
  return seen;
}

void encode_block(Block& block, int64_t n, bool hilbert, int depth) {
  for (int level = hilbert ? depth - 1 : 0; level > 0; --level) {
#pragma omp simd
    for (int64_t i = 0; i < n; ++i) transpose_level(block.a[i], block.b[i], block.c[i], level);
  }
#pragma omp simd
  for (int64_t i = 0; i < n; ++i) block.code[i] = interleave(block.a[i], block.b[i], block.c[i]);
  if (hilbert) {
#pragma omp simd
    for (int64_t i = 0; i < n; ++i) block.code[i] = gray_to_binary(block.code[i]);
  }
}

bool is_hilbert(Curve curve) { return curve == Curve::kHilbert || curve == Curve::kHilbertTrans; }
bool is_trans(Curve curve) { return curve == Curve::kZTrans || curve == Curve::kHilbertTrans; }

[[noreturn]] void fail_cell(const int64_t* grid, int64_t row, int64_t depth) {
  for (int64_t i = row;; ++i)
    for (int axis = 0; axis < 3; ++axis)
      check(grid[3 * i + axis] >= 0 && grid[3 * i + axis] < int64_t{1} << depth,
            "curve_encode: grid must be in [0, ", int64_t{1} << depth, ") at depth ", depth, "; got ",
            grid[3 * i + axis], " at row ", i, ", axis ", axis);
}

}  // namespace

void check_curve(int64_t curve, int64_t depth, int64_t shift) {
  check(curve >= 0 && curve < kCurves, "curve_encode: curve must be 0 (z), 1 (z-trans), 2 (hilbert) or 3 ",
        "(hilbert-trans); got ", curve);
  check(depth >= 1 && depth <= kMaxDepth, "curve_encode: depth must be in [1, ", kMaxDepth, "]; got ", depth);
  check(shift >= 3 * depth && shift <= 62, "curve_encode: shift must be in [3 depth, 62] = [", 3 * depth, ", 62]; got ",
        shift);
}

void curve_encode(const int64_t* grid, const int64_t* cloud, int64_t n, int64_t curve_id, int64_t depth, int64_t shift,
                  int64_t* codes, const Parallel& parallel) {
  check_curve(curve_id, depth, shift);
  const Curve curve = static_cast<Curve>(curve_id);
  const int64_t clouds = int64_t{1} << (63 - shift);
  parallel.range(n, kEncodeGrain, [&](int64_t chunk_begin, int64_t chunk_end) {
    Block block;
    for (int64_t begin = chunk_begin; begin < chunk_end; begin += kBlock) {
      const int64_t count = std::min(kBlock, chunk_end - begin);
      if (load_block(grid + 3 * begin, count, is_trans(curve), block) >> depth != 0) fail_cell(grid, begin, depth);
      encode_block(block, count, is_hilbert(curve), static_cast<int>(depth));
      for (int64_t i = 0; i < count; ++i) {
        const int64_t id = cloud[begin + i];
        check(id >= 0 && id < clouds, "curve_encode: cloud must be in [0, ", clouds, ") at shift ", shift, "; got ", id,
              " at row ", begin + i);
        codes[begin + i] = (id << shift) | static_cast<int64_t>(block.code[i]);
      }
    }
  });
}

void encode_all(const int64_t* grid, const int64_t* cloud, int64_t n, int depth, uint64_t* const codes[kCurves],
                const Parallel& parallel) {
  parallel.range(n, kEncodeGrain, [&](int64_t chunk_begin, int64_t chunk_end) {
    Block block;
    for (int64_t begin = chunk_begin; begin < chunk_end; begin += kBlock) {
      const int64_t count = std::min(kBlock, chunk_end - begin);
      for (int id = 0; id < kCurves; ++id) {
        const Curve curve = static_cast<Curve>(id);
        load_block(grid + 3 * begin, count, is_trans(curve), block);
        encode_block(block, count, is_hilbert(curve), depth);
        for (int64_t i = 0; i < count; ++i)
          codes[id][begin + i] = (static_cast<uint64_t>(cloud[begin + i]) << (3 * depth)) | block.code[i];
      }
    }
  });
}

namespace {

// Two copies of (key, index) that the passes move between.
struct SortScratch {
  uint64_t* keys[2];
  uint32_t* index[2];
  uint32_t* counts;  // [n_chunks, kDigits]
};

SortScratch take_scratch(const Workspace& workspace, int64_t n, int64_t n_chunks) {
  SortScratch scratch;
  for (int i = 0; i < 2; ++i) {
    scratch.keys[i] = workspace.take<uint64_t>(n);
    scratch.index[i] = workspace.take<uint32_t>(n);
  }
  scratch.counts = workspace.take<uint32_t>(n_chunks * kDigits);
  return scratch;
}

// Lowest bits of the digits that hold every bit in which two keys differ: constant bits cost no pass.
int plan_passes(uint64_t differs, int* shifts) {
  int n = 0;
  while (differs != 0) {
    const int shift = std::countr_zero(differs);
    shifts[n++] = shift;
    differs = shift + kDigitBits >= 64 ? 0 : differs >> (shift + kDigitBits) << (shift + kDigitBits);
  }
  return n;
}

void finish(const uint64_t* keys, const uint32_t* index, int64_t n, int64_t* order, int64_t* inverse,
            uint64_t* sorted) {
  for (int64_t i = 0; i < n; ++i) order[i] = index ? index[i] : i;
  if (inverse)
    for (int64_t i = 0; i < n; ++i) inverse[order[i]] = i;
  if (sorted) std::memcpy(sorted, keys, sizeof(uint64_t) * n);
}

void sort_row(const uint64_t* keys, int64_t n, int64_t* order, int64_t* inverse, uint64_t* sorted, int64_t n_chunks,
              const SortScratch& scratch, const Parallel& parallel) {
  if (n == 0) return;
  uint64_t differs = 0, descends = 0;
  for (int64_t i = 1; i < n; ++i) {
    differs |= keys[i] ^ keys[0];
    descends |= keys[i] < keys[i - 1];
  }
  if (!descends) return finish(keys, nullptr, n, order, inverse, sorted);

  int shifts[kMaxPasses];
  const int n_passes = plan_passes(differs, shifts);
  const int64_t per_chunk = (n + n_chunks - 1) / n_chunks;
  const uint64_t* from_keys = keys;
  const uint32_t* from_index = nullptr;
  for (int pass = 0; pass < n_passes; ++pass) {
    const int shift = shifts[pass];
    uint64_t* to_keys = scratch.keys[pass % 2];
    uint32_t* to_index = scratch.index[pass % 2];
    parallel.chunks(n_chunks, [&](int64_t chunk) {
      uint32_t* count = scratch.counts + chunk * kDigits;
      std::fill_n(count, kDigits, 0u);
      const int64_t end = std::min(n, (chunk + 1) * per_chunk);
      for (int64_t i = chunk * per_chunk; i < end; ++i) ++count[(from_keys[i] >> shift) & (kDigits - 1)];
    });
    uint32_t start = 0;
    for (int digit = 0; digit < kDigits; ++digit)
      for (int64_t chunk = 0; chunk < n_chunks; ++chunk) {
        uint32_t& count = scratch.counts[chunk * kDigits + digit];
        const uint32_t next = start + count;
        count = start;
        start = next;
      }
    parallel.chunks(n_chunks, [&](int64_t chunk) {
      uint32_t* next = scratch.counts + chunk * kDigits;
      const int64_t end = std::min(n, (chunk + 1) * per_chunk);
      for (int64_t i = chunk * per_chunk; i < end; ++i) {
        const uint32_t to = next[(from_keys[i] >> shift) & (kDigits - 1)]++;
        to_keys[to] = from_keys[i];
        to_index[to] = from_index ? from_index[i] : static_cast<uint32_t>(i);
      }
    });
    from_keys = to_keys;
    from_index = to_index;
  }
  finish(from_keys, from_index, n, order, inverse, sorted);
}

}  // namespace

void radix_sort(const uint64_t* const* keys, int64_t rows, int64_t n, int64_t* const* order, int64_t* const* inverse,
                uint64_t* const* sorted, const Workspace& workspace, const Parallel& parallel) {
  check(n < int64_t{1} << 32, "radix_sort: rows must have fewer than 2^32 keys; got ", n);
  const auto of = [](auto* const* pointers, int64_t r) { return pointers ? pointers[r] : nullptr; };
  if (n <= 2 * kSortChunk) {
    std::vector<SortScratch> scratch;
    for (int64_t r = 0; r < rows; ++r) scratch.push_back(take_scratch(workspace, n, 1));
    parallel.chunks(rows, [&](int64_t r) {
      sort_row(keys[r], n, order[r], of(inverse, r), of(sorted, r), 1, scratch[r], serial());
    });
    return;
  }
  const int64_t n_chunks = (n + kSortChunk - 1) / kSortChunk;
  const SortScratch scratch = take_scratch(workspace, n, n_chunks);
  for (int64_t r = 0; r < rows; ++r)
    sort_row(keys[r], n, order[r], of(inverse, r), of(sorted, r), n_chunks, scratch, parallel);
}

void curve_sort(const int64_t* codes, int64_t rows, int64_t n, int64_t* order, int64_t* inverse,
                const Workspace& workspace, const Parallel& parallel) {
  constexpr uint64_t kSign = uint64_t{1} << 63;  // unsigned order of the flipped codes is signed order of the codes
  uint64_t* keys = workspace.take<uint64_t>(rows * n);
  parallel.range(rows * n, kSortChunk, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) keys[i] = static_cast<uint64_t>(codes[i]) ^ kSign;
  });
  std::vector<const uint64_t*> key_rows;
  std::vector<int64_t*> order_rows, inverse_rows;
  for (int64_t r = 0; r < rows; ++r) {
    key_rows.push_back(keys + r * n);
    order_rows.push_back(order + r * n);
    inverse_rows.push_back(inverse + r * n);
  }
  radix_sort(key_rows.data(), rows, n, order_rows.data(), inverse_rows.data(), nullptr, workspace, parallel);
}

}  // namespace gsim3d::cpu
