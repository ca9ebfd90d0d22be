#include "gsim3d/pool/pool.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

Segments segments_of(const char* op, const Tensor& x, const Tensor& rows, const Tensor& cu_rows, int64_t n_rows) {
  check_dtype(op, "rows", rows, ScalarType::Long);
  check_dtype(op, "cu_rows", cu_rows, ScalarType::Long);
  check_device(op, "rows", rows, x);
  check_device(op, "cu_rows", cu_rows, x);
  check_shape(op, "rows", rows, {-1}, "[R]");
  check(cu_rows.dim() == 1 && cu_rows.size(0) >= 1, op, ": cu_rows must be [M + 1]; got ", shape_of(cu_rows));
  check(n_rows >= 0, op, ": n_rows must not be negative; got ", n_rows);
  return {data<int64_t>(rows), data<int64_t>(cu_rows), cu_rows.size(0) - 1, rows.size(0), n_rows};
}

// On a GPU the lists stay where they are: kernels skip what is out of range.
Segments checked_segments(const char* op, const Tensor& x, const Tensor& rows, const Tensor& cu_rows, int64_t n_rows) {
  const Segments segments = segments_of(op, x, rows, cu_rows, n_rows);
  if (!x.is_cuda()) cpu::check_segments(op, segments);
  return segments;
}

std::tuple<Tensor, Tensor> pool_max(const Tensor& x_, const Tensor& rows_, const Tensor& cu_rows_) {
  const char* op = "pool_max";
  check_shape(op, "x", x_, {-1, -1}, "[N, C]");
  const Tensor x = rows_of(x_), rows = rows_of(rows_), cu_rows = rows_of(cu_rows_);
  const Segments segments = checked_segments(op, x, rows, cu_rows, x.size(0));
  Tensor out = empty(x, {segments.n_segments, x.size(1)});
  Tensor argmax = empty(x, {segments.n_segments, x.size(1)}, ScalarType::Long);
  dispatch_float(op, "x", x, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::pool_max(data<T>(x), segments, x.size(1), mutable_data<T>(out), mutable_data<int64_t>(argmax),
                              current_stream(x));
    cpu::pool_max(data<T>(x), segments, x.size(1), mutable_data<T>(out), mutable_data<int64_t>(argmax),
                  torch_parallel());
  });
  return {out, argmax};
}

Tensor pool_max_backward(const Tensor& grad_, const Tensor& argmax_, int64_t n_rows) {
  const char* op = "pool_max_backward";
  const Tensor grad = rows_of(grad_), argmax = rows_of(argmax_);
  check_shape(op, "grad", grad, {-1, -1}, "[M, C]");
  check_dtype(op, "argmax", argmax, ScalarType::Long);
  check_device(op, "argmax", argmax, grad);
  check(n_rows >= 0, op, ": n_rows must not be negative; got ", n_rows);
  check_shape(op, "argmax", argmax, {grad.size(0), grad.size(1)}, "[M, C]");
  Tensor grad_x = empty(grad, {n_rows, grad.size(1)});
  dispatch_float(op, "grad", grad, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (grad.is_cuda())
        return cuda::pool_max_vjp(data<T>(grad), data<int64_t>(argmax), grad.size(0), n_rows, grad.size(1),
                                  mutable_data<T>(grad_x), current_stream(grad));
    cpu::pool_max_vjp(data<T>(grad), data<int64_t>(argmax), grad.size(0), n_rows, grad.size(1), mutable_data<T>(grad_x),
                      torch_parallel());
  });
  return grad_x;
}

Tensor pool_mean(const Tensor& x_, const Tensor& rows_, const Tensor& cu_rows_) {
  const char* op = "pool_mean";
  check_shape(op, "x", x_, {-1, -1}, "[N, C]");
  const Tensor x = rows_of(x_), rows = rows_of(rows_), cu_rows = rows_of(cu_rows_);
  const Segments segments = checked_segments(op, x, rows, cu_rows, x.size(0));
  Tensor out = empty(x, {segments.n_segments, x.size(1)});
  dispatch_float(op, "x", x, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (x.is_cuda()) return cuda::pool_mean(data<T>(x), segments, x.size(1), mutable_data<T>(out), current_stream(x));
    cpu::pool_mean(data<T>(x), segments, x.size(1), mutable_data<T>(out), torch_parallel());
  });
  return out;
}

Tensor pool_mean_backward(const Tensor& grad_, const Tensor& rows_, const Tensor& cu_rows_, int64_t n_rows) {
  const char* op = "pool_mean_backward";
  check_shape(op, "grad", grad_, {-1, -1}, "[M, C]");
  const Tensor grad = rows_of(grad_), rows = rows_of(rows_), cu_rows = rows_of(cu_rows_);
  const Segments segments = checked_segments(op, grad, rows, cu_rows, n_rows);
  check_shape(op, "grad", grad, {segments.n_segments, -1}, "[M, C]");
  Tensor grad_x = empty(grad, {n_rows, grad.size(1)});
  dispatch_float(op, "grad", grad, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (grad.is_cuda())
        return cuda::pool_mean_vjp(data<T>(grad), segments, grad.size(1), mutable_data<T>(grad_x),
                                   current_stream(grad));
    cpu::pool_mean_vjp(data<T>(grad), segments, grad.size(1), mutable_data<T>(grad_x), torch_parallel());
  });
  return grad_x;
}

Tensor unpool(const Tensor& x_, const Tensor& rows_, const Tensor& cu_rows_, int64_t n_rows) {
  const char* op = "unpool";
  check_shape(op, "x", x_, {-1, -1}, "[M, C]");
  const Tensor x = rows_of(x_), rows = rows_of(rows_), cu_rows = rows_of(cu_rows_);
  const Segments segments = segments_of(op, x, rows, cu_rows, n_rows);
  check_shape(op, "x", x, {segments.n_segments, -1}, "[M, C]");
  Tensor out = empty(x, {n_rows, x.size(1)});
  dispatch_float(op, "x", x, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (x.is_cuda()) return cuda::unpool(data<T>(x), segments, x.size(1), mutable_data<T>(out), current_stream(x));
    cpu::unpool(data<T>(x), segments, x.size(1), mutable_data<T>(out), torch_parallel());
  });
  return out;
}

Tensor unpool_backward(const Tensor& grad_, const Tensor& rows_, const Tensor& cu_rows_) {
  const char* op = "unpool_backward";
  check_shape(op, "grad", grad_, {-1, -1}, "[N, C]");
  const Tensor grad = rows_of(grad_), rows = rows_of(rows_), cu_rows = rows_of(cu_rows_);
  const Segments segments = checked_segments(op, grad, rows, cu_rows, grad.size(0));
  Tensor grad_x = empty(grad, {segments.n_segments, grad.size(1)});
  dispatch_float(op, "grad", grad, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (grad.is_cuda())
        return cuda::unpool_vjp(data<T>(grad), segments, grad.size(1), mutable_data<T>(grad_x), current_stream(grad));
    cpu::unpool_vjp(data<T>(grad), segments, grad.size(1), mutable_data<T>(grad_x), torch_parallel());
  });
  return grad_x;
}

void kernels(auto& m) {
  m.impl("pool_max", TORCH_BOX(&pool_max));
  m.impl("pool_max_backward", TORCH_BOX(&pool_max_backward));
  m.impl("pool_mean", TORCH_BOX(&pool_mean));
  m.impl("pool_mean_backward", TORCH_BOX(&pool_mean_backward));
  m.impl("unpool", TORCH_BOX(&unpool));
  m.impl("unpool_backward", TORCH_BOX(&unpool_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
