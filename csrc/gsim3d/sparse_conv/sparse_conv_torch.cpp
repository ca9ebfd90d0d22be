#include <optional>
#include <type_traits>

#include "gsim3d/core/half.h"
#include "gsim3d/sparse_conv/sparse_conv.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// The index tensors of a call, contiguous and checked, and their view for the core.
struct Geometry {
  Tensor row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out, cu_taps;
  SparseConvMap map;

  Geometry(const char* op, const Tensor& x, int64_t kernel_size, bool first, const Tensor& row_voxel_,
           const Tensor& voxel_rows_, const Tensor& cu_voxel_rows_, const Tensor& tap_in_, const Tensor& tap_out_,
           const Tensor& cu_taps_, const std::optional<Tensor>& plan = std::nullopt)
      : row_voxel(rows_of(row_voxel_)),
        voxel_rows(rows_of(voxel_rows_)),
        cu_voxel_rows(rows_of(cu_voxel_rows_)),
        tap_in(rows_of(tap_in_)),
        tap_out(rows_of(tap_out_)),
        cu_taps(rows_of(cu_taps_)) {
    const auto check_index = [&](const char* name, const Tensor& tensor) {
      check_dtype(op, name, tensor, ScalarType::Long);
      check_device(op, name, tensor, x);
    };
    check_index("row_voxel", row_voxel);
    check_index("voxel_rows", voxel_rows);
    check_index("cu_voxel_rows", cu_voxel_rows);
    check_index("tap_in", tap_in);
    check_index("tap_out", tap_out);
    check_index("cu_taps", cu_taps);
    const int64_t n_rows = x.size(0);
    check_shape(op, "row_voxel", row_voxel, {n_rows}, "[N]");
    check_shape(op, "voxel_rows", voxel_rows, {n_rows}, "[N]");
    check(cu_voxel_rows.dim() == 1 && cu_voxel_rows.size(0) >= 1, op, ": cu_voxel_rows must be [V + 1]; got ",
          shape_of(cu_voxel_rows));
    check_shape(op, "tap_in", tap_in, {-1}, "[L]");
    check_shape(op, "tap_out", tap_out, {tap_in.size(0)}, "[L] like tap_in");
    check_shape(op, "cu_taps", cu_taps, {kernel_size * kernel_size * kernel_size + 1}, "[K^3 + 1]");
    map = {data<int64_t>(row_voxel),
           data<int64_t>(voxel_rows),
           data<int64_t>(cu_voxel_rows),
           data<int64_t>(tap_in),
           data<int64_t>(tap_out),
           data<int64_t>(cu_taps),
           n_rows,
           cu_voxel_rows.size(0) - 1,
           tap_in.size(0),
           kernel_size,
           first};
    if (plan) {
      check_dtype(op, "plan", *plan, ScalarType::Int);
      check_device(op, "plan", *plan, x);
      check_shape(op, "plan", *plan, {sparse_conv_plan_size(n_rows, kernel_size)}, "that of sparse_conv_plan");
      check(plan->is_contiguous(), op, ": plan must be contiguous");
      map.plan = data<int32_t>(*plan);
      check(reinterpret_cast<uintptr_t>(map.plan) % 16 == 0, op, ": plan must begin at a multiple of 16 bytes");
    }
    // On a GPU the lists stay where they are: kernels skip what is out of range.
    if (!x.is_cuda()) cpu::check_sparse_conv_map(op, map, torch_parallel());
  }
};

// Calls f.template operator()<T>(): float or double, on CUDA also the 16-bit types.
template <typename F>
void dispatch(const char* op, const char* name, const Tensor& tensor, const F& f) {
  if constexpr (kWithCuda) {
    if (tensor.is_cuda() && tensor.scalar_type() == ScalarType::Half) return f.template operator()<Float16>();
    if (tensor.is_cuda() && tensor.scalar_type() == ScalarType::BFloat16) return f.template operator()<BFloat16>();
  }
  dispatch_float(op, name, tensor, f);
}

template <typename T>
constexpr bool kOnCpu = std::is_floating_point_v<T>;

void check_weight(const char* op, const Tensor& weight) {
  check(weight.dim() == 5 && weight.size(1) == weight.size(2) && weight.size(1) == weight.size(3), op,
        ": weight must be [C_out, K, K, K, C_in]; got ", shape_of(weight));
  cpu::check_sparse_conv_kernel(op, weight.size(1));
}

Tensor sparse_conv(const Tensor& x_, const Tensor& weight_, const std::optional<Tensor>& bias_, const Tensor& row_voxel,
                   const Tensor& voxel_rows, const Tensor& cu_voxel_rows, const Tensor& tap_in, const Tensor& tap_out,
                   const Tensor& cu_taps, bool first, const std::optional<Tensor>& plan) {
  const char* op = "sparse_conv";
  check_shape(op, "x", x_, {-1, -1}, "[N, C_in]");
  check_weight(op, weight_);
  const int64_t c_in = x_.size(1), c_out = weight_.size(0);
  check(weight_.size(4) == c_in, op, ": weight must be [C_out, K, K, K, C_in] with C_in=", c_in, " from x; got ",
        shape_of(weight_));
  check_dtype(op, "weight", weight_, x_.scalar_type());
  check_device(op, "weight", weight_, x_);
  const Tensor x = rows_of(x_), weight = rows_of(weight_), bias = bias_ ? rows_of(*bias_) : x;
  if (bias_) {
    check_shape(op, "bias", bias, {c_out}, "[C_out]");
    check_dtype(op, "bias", bias, x.scalar_type());
    check_device(op, "bias", bias, x);
  }
  const Geometry geometry(op, x, weight.size(1), first, row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out,
                          cu_taps, plan);
  Tensor out = empty(x, {x.size(0), c_out});
  dispatch(op, "x", x, [&]<typename T>() {
    TensorWorkspace workspace(x);
    const T* start = bias_ ? data<T>(bias) : nullptr;
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::sparse_conv(data<T>(x), data<T>(weight), start, geometry.map, c_in, c_out, mutable_data<T>(out),
                                 workspace, current_stream(x));
    if constexpr (kOnCpu<T>)
      cpu::sparse_conv(data<T>(x), data<T>(weight), start, geometry.map, c_in, c_out, mutable_data<T>(out), workspace,
                       torch_parallel());
  });
  return out;
}

Tensor sparse_conv_grad_input(const Tensor& grad_, const Tensor& weight_, const Tensor& row_voxel,
                              const Tensor& voxel_rows, const Tensor& cu_voxel_rows, const Tensor& tap_in,
                              const Tensor& tap_out, const Tensor& cu_taps, bool first,
                              const std::optional<Tensor>& plan) {
  const char* op = "sparse_conv_grad_input";
  check_weight(op, weight_);
  check_shape(op, "grad", grad_, {-1, weight_.size(0)}, "[N, C_out]");
  check_dtype(op, "weight", weight_, grad_.scalar_type());
  check_device(op, "weight", weight_, grad_);
  const Tensor grad = rows_of(grad_), weight = rows_of(weight_);
  const int64_t n_rows = grad.size(0), c_in = weight.size(4);
  const Geometry geometry(op, grad, weight.size(1), first, row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out,
                          cu_taps, plan);
  Tensor grad_x = empty(grad, {n_rows, c_in});
  dispatch(op, "grad", grad, [&]<typename T>() {
    TensorWorkspace workspace(grad);
    if constexpr (kWithCuda)
      if (grad.is_cuda())
        return cuda::sparse_conv_vjp_input(data<T>(grad), data<T>(weight), geometry.map, c_in, weight.size(0),
                                           mutable_data<T>(grad_x), workspace, current_stream(grad));
    if constexpr (kOnCpu<T>)
      cpu::sparse_conv_vjp_input(data<T>(grad), data<T>(weight), geometry.map, c_in, weight.size(0),
                                 mutable_data<T>(grad_x), workspace, torch_parallel());
  });
  return grad_x;
}

std::tuple<Tensor, Tensor> sparse_conv_grad_weight(const Tensor& grad_, const Tensor& x_, int64_t kernel_size,
                                                   const Tensor& row_voxel, const Tensor& voxel_rows,
                                                   const Tensor& cu_voxel_rows, const Tensor& tap_in,
                                                   const Tensor& tap_out, const Tensor& cu_taps, bool first,
                                                   bool rounded) {
  const char* op = "sparse_conv_grad_weight";
  cpu::check_sparse_conv_kernel(op, kernel_size);
  check_shape(op, "x", x_, {-1, -1}, "[N, C_in]");
  check_shape(op, "grad", grad_, {x_.size(0), -1}, "[N, C_out]");
  check_dtype(op, "x", x_, grad_.scalar_type());
  check_device(op, "x", x_, grad_);
  const Tensor grad = rows_of(grad_), x = rows_of(x_);
  const int64_t c_in = x.size(1), c_out = grad.size(1);
  const Geometry geometry(op, x, kernel_size, first, row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out,
                          cu_taps);
  const bool narrow = grad.scalar_type() == ScalarType::Half || grad.scalar_type() == ScalarType::BFloat16;
  const ScalarType dtype = narrow && !rounded ? ScalarType::Float : grad.scalar_type();
  Tensor grad_weight = empty(grad, {c_out, kernel_size, kernel_size, kernel_size, c_in}, dtype);
  Tensor grad_bias = empty(grad, {c_out}, dtype);
  dispatch(op, "grad", grad, [&]<typename T>() {
    TensorWorkspace workspace(grad);
    if constexpr (kWithCuda) {
      const auto run = [&]<typename R>() {
        cuda::sparse_conv_vjp_weight(data<T>(grad), data<T>(x), geometry.map, c_in, c_out, mutable_data<R>(grad_weight),
                                     mutable_data<R>(grad_bias), workspace, current_stream(grad));
      };
      if (grad.is_cuda()) return rounded ? run.template operator()<T>() : run.template operator()<Sum<T>>();
    }
    if constexpr (kOnCpu<T>)
      cpu::sparse_conv_vjp_weight(data<T>(grad), data<T>(x), geometry.map, c_in, c_out, mutable_data<T>(grad_weight),
                                  mutable_data<T>(grad_bias), workspace, torch_parallel());
  });
  return {grad_weight, grad_bias};
}

Tensor sparse_conv_plan(const Tensor& row_voxel, const Tensor& voxel_rows, const Tensor& cu_voxel_rows,
                        const Tensor& tap_in, const Tensor& tap_out, const Tensor& cu_taps, int64_t kernel_size) {
  const char* op = "sparse_conv_plan";
  cpu::check_sparse_conv_kernel(op, kernel_size);
  check(row_voxel.dim() == 1, op, ": row_voxel must be [N]; got ", shape_of(row_voxel));
  const Geometry geometry(op, row_voxel, kernel_size, false, row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out,
                          cu_taps);
  check(row_voxel.is_cuda(), op, ": only convolutions on CUDA have a plan; got tensors on ", device_of(row_voxel));
  Tensor plan = empty(row_voxel, {sparse_conv_plan_size(row_voxel.size(0), kernel_size)}, ScalarType::Int);
  if constexpr (kWithCuda) {
    TensorWorkspace workspace(row_voxel);
    cuda::sparse_conv_plan(geometry.map, mutable_data<int32_t>(plan), workspace, current_stream(row_voxel));
  }
  return plan;
}

void kernels(auto& m) {
  m.impl("sparse_conv_plan", TORCH_BOX(&sparse_conv_plan));
  m.impl("sparse_conv", TORCH_BOX(&sparse_conv));
  m.impl("sparse_conv_grad_input", TORCH_BOX(&sparse_conv_grad_input));
  m.impl("sparse_conv_grad_weight", TORCH_BOX(&sparse_conv_grad_weight));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
