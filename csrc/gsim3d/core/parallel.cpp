#include "gsim3d/core/parallel.h"

#include <atomic>
#include <condition_variable>
#include <memory>
#include <thread>
#include <vector>

#if __has_include(<pthread.h>)
#include <pthread.h>
#endif

namespace gsim3d {
namespace {

// Workers sleep until a job arrives; the calling thread works too. A job started from inside a worker, or while another
// thread's job runs, is done by its caller alone, so nesting cannot deadlock.
class Pool {
 public:
  Pool() {
    const unsigned extra = std::max(1u, std::thread::hardware_concurrency()) - 1;
    for (unsigned i = 0; i < extra; ++i) workers_.emplace_back([this] { work(); });
  }

  ~Pool() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (auto& worker : workers_) worker.join();
  }

  void run(int64_t n_chunks, Parallel::Body body, void* state) {
    std::unique_lock<std::mutex> owner(owner_, std::try_to_lock);
    if (!owner.owns_lock() || workers_.empty()) {
      for (int64_t chunk = 0; chunk < n_chunks; ++chunk) body(state, chunk);
      return;
    }
    {
      std::lock_guard<std::mutex> lock(mutex_);
      body_ = body;
      state_ = state;
      n_chunks_ = n_chunks;
      next_.store(0);
      busy_ = static_cast<int64_t>(workers_.size());
      ++job_;
    }
    wake_.notify_all();
    drain();
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return busy_ == 0; });
  }

 private:
  void drain() {
    for (int64_t chunk = next_.fetch_add(1); chunk < n_chunks_; chunk = next_.fetch_add(1)) body_(state_, chunk);
  }

  void work() {
    uint64_t seen = 0;
    for (;;) {
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return stop_ || job_ != seen; });
        if (stop_) return;
        seen = job_;
      }
      drain();
      std::lock_guard<std::mutex> lock(mutex_);
      if (--busy_ == 0) done_.notify_one();
    }
  }

  std::mutex owner_, mutex_;
  std::condition_variable wake_, done_;
  std::vector<std::thread> workers_;
  Parallel::Body body_ = nullptr;
  void* state_ = nullptr;
  int64_t n_chunks_ = 0, busy_ = 0;
  std::atomic<int64_t> next_{0};
  uint64_t job_ = 0;
  bool stop_ = false;
};

void run_pool(void* pool, int64_t n_chunks, Parallel::Body body, void* state) {
  static_cast<Pool*>(pool)->run(n_chunks, body, state);
}

void run_serial(void*, int64_t n_chunks, Parallel::Body body, void* state) {
  for (int64_t chunk = 0; chunk < n_chunks; ++chunk) body(state, chunk);
}

// Never destroyed: workers sleep until the process ends, and in a forked child there is none that could be joined.
std::atomic<Pool*> shared_pool{nullptr};
std::atomic<bool> forked{false};

#if __has_include(<pthread.h>)
// The child of a fork has one thread, and locks as they were at that moment: it makes another pool.
const int on_fork = pthread_atfork(nullptr, nullptr, [] {
  shared_pool.store(nullptr);
  forked.store(true);
});
#endif

}  // namespace

Parallel thread_pool() {
  Pool* pool = shared_pool.load();
  if (pool == nullptr) {
    auto made = std::make_unique<Pool>();
    if (shared_pool.compare_exchange_strong(pool, made.get())) pool = made.release();
  }
  return {run_pool, pool};
}

bool is_forked() { return forked.load(); }

Parallel serial() { return {run_serial, nullptr}; }

}  // namespace gsim3d
