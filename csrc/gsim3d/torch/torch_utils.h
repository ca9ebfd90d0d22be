// What every *_torch.cpp needs: checks with one style of message, dtype dispatch, torch's thread pool and scratch
// memory. Written against torch's stable ABI (TORCH_TARGET_VERSION 2.11), so one binary serves torch 2.11 and later.
#pragma once

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#ifdef USE_CUDA
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#endif

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d::binding {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using Optional = std::optional<Tensor>;
using Sizes = torch::headeronly::IntHeaderOnlyArrayRef;

// Runs chunks on torch's intra-op pool; on one thread in a forked child, where that pool would wait for threads that
// are not there.
inline Parallel torch_parallel() {
  if (is_forked()) return serial();
  return {[](void*, int64_t n_chunks, Parallel::Body body, void* state) {
            torch::stable::parallel_for(0, n_chunks, 1, [&](int64_t begin, int64_t end) {
              for (int64_t chunk = begin; chunk < end; ++chunk) body(state, chunk);
            });
          },
          nullptr};
}

// Whether this build holds CUDA kernels. A binding serves both backends:
//   if constexpr (kWithCuda)
//     if (x.is_cuda()) return cuda::f(..., TensorWorkspace(x), current_stream(x));
//   cpu::f(..., torch_parallel());
// inside its dtype lambda, where the discarded branch is not instantiated.
#ifdef USE_CUDA
constexpr bool kWithCuda = true;
#else
constexpr bool kWithCuda = false;
#endif

// Torch's current stream on the device of a tensor; that device is the current one while the object lives.
class CurrentStream {
 public:
  explicit CurrentStream(int32_t device) : guard_(device), stream_{nullptr, device} {
#ifdef USE_CUDA
    if (aoti_torch_get_current_cuda_stream(device, &stream_.handle) != AOTI_TORCH_SUCCESS)
      throw std::runtime_error("torch gave no CUDA stream for device " + std::to_string(device));
#endif
  }
  operator Stream() const { return stream_; }

 private:
  torch::stable::accelerator::DeviceGuard guard_;
  Stream stream_;
};
inline CurrentStream current_stream(const Tensor& tensor) { return CurrentStream(tensor.get_device_index()); }

// GSIM3D_REGISTER(kernels): calls kernels(m), a generic function of m.impl(...) lines, once for every backend built.
#ifdef USE_CUDA
#define GSIM3D_REGISTER(kernels)                                 \
  STABLE_TORCH_LIBRARY_IMPL(gsim3d, CPU, m) { kernels(m); }      \
  STABLE_TORCH_LIBRARY_IMPL(gsim3d, CUDA, m) { kernels(m); }
#else
#define GSIM3D_REGISTER(kernels) \
  STABLE_TORCH_LIBRARY_IMPL(gsim3d, CPU, m) { kernels(m); }
#endif

inline std::string shape_of(const Tensor& tensor) {
  std::string text = "[";
  for (int64_t i = 0; i < tensor.dim(); ++i) text += (i ? ", " : "") + std::to_string(tensor.size(i));
  return text + "]";
}

// check_shape("pool_max", "x", x, {n, -1}, "[N, C]"): -1 accepts any size.
inline void check_shape(const char* op, const char* name, const Tensor& tensor, std::initializer_list<int64_t> sizes,
                        const char* wanted) {
  bool ok = tensor.dim() == static_cast<int64_t>(sizes.size());
  int64_t i = 0;
  for (int64_t size : sizes) {
    if (!ok) break;
    ok = size < 0 || tensor.size(i) == size;
    ++i;
  }
  if (ok) return;
  std::string expected = "[";
  i = 0;
  for (int64_t size : sizes) expected += (i++ ? ", " : "") + (size < 0 ? std::string("*") : std::to_string(size));
  detail::fail(op, ": ", name, " must be ", wanted, " = ", expected, "]; got ", shape_of(tensor));
}

inline const char* dtype_name(ScalarType type) {
  switch (type) {
    case ScalarType::Float: return "float32";
    case ScalarType::Double: return "float64";
    case ScalarType::Long: return "int64";
    case ScalarType::Int: return "int32";
    case ScalarType::Byte: return "uint8";
    case ScalarType::Bool: return "bool";
    case ScalarType::Half: return "float16";
    case ScalarType::BFloat16: return "bfloat16";
    default: return "another dtype";
  }
}

inline void check_dtype(const char* op, const char* name, const Tensor& tensor, ScalarType wanted) {
  check(tensor.scalar_type() == wanted, op, ": ", name, " must be ", dtype_name(wanted), "; got ",
        dtype_name(tensor.scalar_type()));
}

inline std::string device_of(const Tensor& tensor) {
  return tensor.is_cuda() ? "cuda:" + std::to_string(tensor.get_device_index()) : "cpu";
}

// Kernels read all tensors by pointer: one on another device would be read where it is not.
inline void check_device(const char* op, const char* name, const Tensor& tensor, const Tensor& like) {
  check(tensor.get_device_index() == like.get_device_index() && tensor.is_cuda() == like.is_cuda(), op, ": ", name,
        " must be on ", device_of(like), " like the first argument; got ", device_of(tensor));
}

// Where there is a tensor: its shape, and dtype and device of `like`.
inline void check_like(const char* op, const char* name, const Optional& tensor, std::initializer_list<int64_t> sizes,
                       const char* wanted, const Tensor& like) {
  if (!tensor) return;
  check_shape(op, name, *tensor, sizes, wanted);
  check_dtype(op, name, *tensor, like.scalar_type());
  check_device(op, name, *tensor, like);
}

// Contiguous, so that the core can read it by pointer.
inline Tensor rows_of(const Tensor& tensor) {
  return tensor.is_contiguous() ? tensor : torch::stable::contiguous(tensor);
}
inline Optional rows_of(const Optional& tensor) { return tensor ? Optional(rows_of(*tensor)) : tensor; }

// Calls f.template operator()<T>() with T = float or double, by the dtype of `tensor`.
template <typename F>
decltype(auto) dispatch_float(const char* op, const char* name, const Tensor& tensor, const F& f) {
  const auto type = tensor.scalar_type();
  check(type == ScalarType::Float || type == ScalarType::Double, op, ": ", name,
        " must be float32 or float64; got ", dtype_name(type));
  return type == ScalarType::Float ? f.template operator()<float>() : f.template operator()<double>();
}

template <typename T>
const T* data(const Tensor& tensor) {
  return static_cast<const T*>(tensor.data_ptr());
}
template <typename T>
const T* data_or_null(const Optional& tensor) {
  return tensor ? data<T>(*tensor) : nullptr;
}
template <typename T>
T* mutable_data(Tensor& tensor) {
  return static_cast<T*>(tensor.data_ptr());
}

// By a C function, not by the dispatcher, which takes longer than torch's allocator.
inline Tensor empty(const Tensor& like, Sizes sizes, ScalarType type) {
  std::vector<int64_t> strides(sizes.size(), 1);
  for (size_t i = sizes.size(); i-- > 1;) strides[i - 1] = strides[i] * std::max<int64_t>(1, sizes[i]);
  int32_t device;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_type(like.get(), &device));
  AtenTensorHandle made;
  TORCH_ERROR_CODE_CHECK(aoti_torch_empty_strided(
      static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(),
      torch::stable::detail::to<int32_t>(torch::stable::detail::from(type)), device, like.get_device_index(), &made));
  return Tensor(made);
}
inline Tensor empty(const Tensor& like, Sizes sizes) { return empty(like, sizes, like.scalar_type()); }

// Scratch in tensors on the device of `like`; freed with the object.
class TensorWorkspace {
 public:
  explicit TensorWorkspace(const Tensor& like) : like_(like) {}
  operator Workspace() { return {&TensorWorkspace::allocate, this}; }

 private:
  static void* allocate(void* raw, size_t bytes) {
    auto* self = static_cast<TensorWorkspace*>(raw);
    self->blocks_.push_back(empty(self->like_, {static_cast<int64_t>(bytes)}, ScalarType::Byte));
    return self->blocks_.back().data_ptr();
  }

  Tensor like_;
  std::vector<Tensor> blocks_;
};

}  // namespace gsim3d::binding
