#include <optional>
#include <type_traits>

#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// Calls f.template operator()<In, Out>() for the dtypes of the two tensors.
template <typename F>
void dispatch(const char* op, const Tensor& x, ScalarType out, const F& f) {
  const ScalarType in = x.scalar_type();
  if constexpr (kWithCuda) {
    const auto low = [&]<typename T>(ScalarType type) {
      if (in == type && out == type) return f.template operator()<T, T>(), true;
      if (in == type && out == ScalarType::Float) return f.template operator()<T, float>(), true;
      if (in == ScalarType::Float && out == type) return f.template operator()<float, T>(), true;
      return false;
    };
    if (x.is_cuda() && (low.template operator()<Float16>(ScalarType::Half) ||
                        low.template operator()<BFloat16>(ScalarType::BFloat16)))
      return;
  }
  check(in == out && (in == ScalarType::Float || in == ScalarType::Double), op,
        ": x and the result must be float32 or float64", x.is_cuda() ? ", or one of them float16 or bfloat16" : "",
        "; got ", dtype_name(in), " and ", dtype_name(out));
  if (in == ScalarType::Float) f.template operator()<float, float>();
  else f.template operator()<double, double>();
}

ScalarType sum_type(const Tensor& x) {
  return x.scalar_type() == ScalarType::Double ? ScalarType::Double : ScalarType::Float;
}

void check_channels(const char* op, const char* name, const Tensor& tensor, const Tensor& x) {
  check_dtype(op, name, tensor, sum_type(x));
  check_device(op, name, tensor, x);
  check_shape(op, name, tensor, {x.size(1)}, "[C]");
}

std::tuple<Tensor, Tensor> row_norm(const Tensor& x_, const Tensor& weight_, const Tensor& bias_,
                                    const std::optional<Tensor>& residual_, double eps, ScalarType dtype) {
  const char* op = "row_norm";
  check_shape(op, "x", x_, {-1, -1}, "[N, C]");
  const Tensor x = rows_of(x_), weight = rows_of(weight_), bias = rows_of(bias_);
  check_channels(op, "weight", weight, x);
  check_channels(op, "bias", bias, x);
  check(eps > 0, op, ": eps must be positive; got ", eps);
  const RowNormShape shape{x.size(0), x.size(1)};
  std::optional<Tensor> residual;
  if (residual_) {
    residual = rows_of(*residual_);
    check_shape(op, "residual", *residual, {shape.n_rows, shape.channels}, "[N, C] like x");
    check_dtype(op, "residual", *residual, dtype);
    check_device(op, "residual", *residual, x);
  }
  Tensor out = empty(x, {shape.n_rows, shape.channels}, dtype), stats = empty(x, {shape.n_rows, 2}, sum_type(x));
  dispatch(op, x, dtype, [&]<typename In, typename Out>() {
    using S = Sum<In>;
    const Out* added = residual ? data<Out>(*residual) : nullptr;
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::row_norm<In, Out>(data<In>(x), data<S>(weight), data<S>(bias), added, shape, eps,
                                       mutable_data<Out>(out), mutable_data<S>(stats), current_stream(x));
    if constexpr (std::is_same_v<In, Out> && std::is_floating_point_v<In>)
      cpu::row_norm<In>(data<In>(x), data<In>(weight), data<In>(bias), added, shape, eps, mutable_data<In>(out),
                        mutable_data<In>(stats), torch_parallel());
  });
  return {out, stats};
}

std::tuple<Tensor, Tensor, Tensor> row_norm_backward(const Tensor& grad_, const Tensor& x_, const Tensor& weight_,
                                                     const Tensor& stats_) {
  const char* op = "row_norm_backward";
  const Tensor grad = rows_of(grad_), x = rows_of(x_), weight = rows_of(weight_), stats = rows_of(stats_);
  check_shape(op, "x", x, {-1, -1}, "[N, C]");
  const RowNormShape shape{x.size(0), x.size(1)};
  check_shape(op, "grad", grad, {shape.n_rows, shape.channels}, "[N, C] like x");
  check_device(op, "grad", grad, x);
  check_channels(op, "weight", weight, x);
  check_shape(op, "stats", stats, {shape.n_rows, 2}, "[N, 2]");
  check_dtype(op, "stats", stats, sum_type(x));
  check_device(op, "stats", stats, x);
  Tensor grad_x = empty(x, {shape.n_rows, shape.channels}), grad_weight = empty(weight, {shape.channels}),
         grad_bias = empty(weight, {shape.channels});
  dispatch(op, x, grad.scalar_type(), [&]<typename In, typename Out>() {
    using S = Sum<In>;
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::row_norm_vjp<In, Out>(data<Out>(grad), data<In>(x), data<S>(weight), data<S>(stats), shape,
                                           mutable_data<In>(grad_x), mutable_data<S>(grad_weight),
                                           mutable_data<S>(grad_bias), TensorWorkspace(x), current_stream(x));
    if constexpr (std::is_same_v<In, Out> && std::is_floating_point_v<In>)
      cpu::row_norm_vjp<In>(data<In>(grad), data<In>(x), data<In>(weight), data<In>(stats), shape,
                            mutable_data<In>(grad_x), mutable_data<In>(grad_weight), mutable_data<In>(grad_bias),
                            torch_parallel());
  });
  return {grad_x, grad_weight, grad_bias};
}

void kernels(auto& m) {
  m.impl("row_norm", TORCH_BOX(&row_norm));
  m.impl("row_norm_backward", TORCH_BOX(&row_norm_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
