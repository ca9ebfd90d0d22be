// Scratch memory for the core. The caller owns it: torch's binding hands out tensors, C++ callers use HeapWorkspace.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

namespace gsim3d {

class Workspace {
 public:
  // Returns `bytes` bytes aligned to 64, valid until the owner of `state` releases them.
  using Allocate = void* (*)(void* state, size_t bytes);

  Workspace(Allocate allocate, void* state) : allocate_(allocate), state_(state) {}

  template <typename T>
  T* take(int64_t count) const {
    return static_cast<T*>(allocate_(state_, static_cast<size_t>(count > 0 ? count : 1) * sizeof(T)));
  }

 private:
  Allocate allocate_;
  void* state_;
};

// Keeps what it hands out until it is destroyed.
class HeapWorkspace {
 public:
  operator Workspace() { return {&HeapWorkspace::allocate, this}; }

 private:
  static void* allocate(void* raw, size_t bytes) {
    auto& blocks = static_cast<HeapWorkspace*>(raw)->blocks_;
    blocks.emplace_back(new char[bytes + 64]);
    auto address = reinterpret_cast<uintptr_t>(blocks.back().get());
    return reinterpret_cast<void*>((address + 63) & ~uintptr_t{63});
  }

  std::vector<std::unique_ptr<char[]>> blocks_;
};

}  // namespace gsim3d
