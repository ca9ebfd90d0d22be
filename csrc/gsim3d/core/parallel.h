// How the core runs loops on several threads without owning a thread pool.
//
// The caller passes a Parallel: torch's binding wraps torch's own pool, numpy and C++ callers use
// gsim3d::thread_pool(). Work is cut into chunks whose borders depend on the problem only, never on the
// number of threads; that keeps every reduction bit-identical for any thread count.
#pragma once

#include <algorithm>
#include <cstdint>
#include <exception>
#include <mutex>

namespace gsim3d {

class Parallel {
 public:
  using Body = void (*)(void* state, int64_t chunk);
  // Calls body(state, chunk) once for each chunk in [0, n_chunks), in any order, on any thread; returns when all are
  // done. Body never throws.
  using Run = void (*)(void* pool, int64_t n_chunks, Body body, void* state);

  Parallel(Run run, void* pool) : run_(run), pool_(pool) {}

  // Runs f(chunk) for every chunk. The first exception thrown by a chunk is rethrown here.
  template <typename F>
  void chunks(int64_t n_chunks, const F& f) const {
    if (n_chunks <= 0) return;
    if (n_chunks == 1) {
      f(int64_t{0});
      return;
    }
    State<F> state{&f, {}, {}};
    run_(pool_, n_chunks, &State<F>::call, &state);
    if (state.error) std::rethrow_exception(state.error);
  }

  // Cuts [0, n) into pieces of `grain` elements and runs f(begin, end) for each piece.
  template <typename F>
  void range(int64_t n, int64_t grain, const F& f) const {
    if (n <= 0) return;
    chunks((n + grain - 1) / grain, [&](int64_t chunk) { f(chunk * grain, std::min(n, (chunk + 1) * grain)); });
  }

 private:
  template <typename F>
  struct State {
    const F* f;
    std::mutex mutex;
    std::exception_ptr error;

    static void call(void* raw, int64_t chunk) {
      auto* state = static_cast<State*>(raw);
      try {
        (*state->f)(chunk);
      } catch (...) {
        std::lock_guard<std::mutex> lock(state->mutex);
        if (!state->error) state->error = std::current_exception();
      }
    }
  };

  Run run_;
  void* pool_;
};

// A pool of std::thread workers shared by callers without torch; threads start on first use, and anew in a forked
// child.
Parallel thread_pool();
// Whether this process was forked from one that had loaded this library: the threads of any pool stayed behind.
bool is_forked();
// One thread: the loop runs where it is called.
Parallel serial();

}  // namespace gsim3d
