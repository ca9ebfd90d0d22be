// Parallel loops, scratch memory and pooling without torch.
#include <array>
#include <atomic>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "expect.h"
#include "gsim3d/core/check.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/workspace.h"
#include "gsim3d/pool/pool.h"

using namespace gsim3d;

static void every_chunk_runs_once() {
  for (int64_t n : {0, 1, 7, 1000}) {
    std::vector<std::atomic<int>> calls(static_cast<size_t>(n));
    thread_pool().range(n, 3, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) ++calls[static_cast<size_t>(i)];
    });
    for (auto& count : calls) EXPECT(count == 1);
  }
}

static void nested_loops_finish() {
  std::atomic<int> total{0};
  thread_pool().chunks(8, [&](int64_t) { thread_pool().chunks(8, [&](int64_t) { ++total; }); });
  EXPECT(total == 64);
}

static void an_exception_reaches_the_caller() {
  bool caught = false;
  try {
    thread_pool().chunks(16, [](int64_t chunk) { check(chunk != 5, "test: chunk must not be 5; got ", chunk); });
  } catch (const ArgumentError& error) {
    caught = std::string(error.what()) == "test: chunk must not be 5; got 5";
  }
  EXPECT(caught);
}

static void scratch_is_aligned() {
  HeapWorkspace heap;
  Workspace workspace = heap;
  auto* first = workspace.take<char>(1);
  auto* second = workspace.take<double>(9);
  EXPECT(reinterpret_cast<uintptr_t>(first) % 64 == 0);
  EXPECT(reinterpret_cast<uintptr_t>(second) % 64 == 0);
}

static void pooling() {
  const std::array<float, 8> x{1, 2, 5, 1, 3, 9, 4, 4};
  const std::array<int64_t, 4> rows{0, 1, 3, 2}, cu{0, 2, 2, 4};
  const Segments segments{rows.data(), cu.data(), 3, 4, 4};
  std::array<float, 6> out{};
  std::array<int64_t, 6> argmax{};
  cpu::pool_max(x.data(), segments, 2, out.data(), argmax.data(), thread_pool());
  EXPECT((out == std::array<float, 6>{5, 2, 0, 0, 4, 9}));
  EXPECT((argmax == std::array<int64_t, 6>{1, 0, -1, -1, 3, 2}));
  cpu::pool_mean(x.data(), segments, 2, out.data(), serial());
  EXPECT_NEAR(out[0], 3.0, 0);
  EXPECT_NEAR(out[5], 6.5, 0);
}

int main() {
  every_chunk_runs_once();
  nested_loops_finish();
  an_exception_reaches_the_caller();
  scratch_is_aligned();
  pooling();
  return failures();
}
