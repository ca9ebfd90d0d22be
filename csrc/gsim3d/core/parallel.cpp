#include "gsim3d/core/parallel.h"

#include <atomic>
#include <condition_variable>
#include <thread>
#include <vector>

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

}  // namespace

Parallel thread_pool() {
  static Pool pool;
  return {run_pool, &pool};
}

Parallel serial() { return {run_serial, nullptr}; }

}  // namespace gsim3d
