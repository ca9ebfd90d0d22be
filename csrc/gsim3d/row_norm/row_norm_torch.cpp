#include <initializer_list>
#include <optional>
#include <tuple>
#include <type_traits>

#include "gsim3d/row_norm/row_norm.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

constexpr double kMinEps = 1e-30;

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

// Of smaller numbers the inverse root, or its products with weights and gradients, leave the range of float32.
void check_eps(const char* op, double eps) {
  check(eps >= kMinEps, op, ": eps must be at least ", kMinEps, "; got ", eps);
}

std::tuple<Tensor, Tensor> row_norm(const Tensor& x_, const Tensor& weight_, const Tensor& bias_,
                                    const std::optional<Tensor>& residual_, double eps, ScalarType dtype) {
  const char* op = "row_norm";
  check_shape(op, "x", x_, {-1, -1}, "[N, C]");
  const Tensor x = rows_of(x_), weight = rows_of(weight_), bias = rows_of(bias_);
  check_channels(op, "weight", weight, x);
  check_channels(op, "bias", bias, x);
  check_eps(op, eps);
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

// A tensor that may be absent, contiguous and checked.
class Optional {
 public:
  Optional(const char* op, const char* name, const std::optional<Tensor>& tensor, const Tensor& like, ScalarType type,
           std::initializer_list<int64_t> sizes, const char* wanted) {
    if (!tensor) return;
    value_ = rows_of(*tensor);
    check_shape(op, name, *value_, sizes, wanted);
    check_dtype(op, name, *value_, type);
    check_device(op, name, *value_, like);
  }
  explicit operator bool() const { return value_.has_value(); }
  template <typename T>
  const T* pointer() const {
    return value_ ? data<T>(*value_) : nullptr;
  }

 private:
  std::optional<Tensor> value_;
};

// Calls f.template operator()<T>() for the dtype of the branch; x has the dtype that its sums have.
template <typename F>
void dispatch_branch(const char* op, const Tensor& branch, const F& f) {
  if constexpr (kWithCuda) {
    if (branch.is_cuda() && branch.scalar_type() == ScalarType::Half) return f.template operator()<Float16>();
    if (branch.is_cuda() && branch.scalar_type() == ScalarType::BFloat16) return f.template operator()<BFloat16>();
  }
  dispatch_float(op, "branch", branch, f);
}

template <typename T>
constexpr bool kOnCpu = std::is_floating_point_v<T>;

std::tuple<Tensor, Tensor, Tensor, Tensor> residual_norm(const Tensor& x_, const Tensor& branch_,
                                                         const std::optional<Tensor>& keep_,
                                                         const std::optional<Tensor>& branch_weight_,
                                                         const std::optional<Tensor>& branch_bias_,
                                                         const std::optional<Tensor>& weight_,
                                                         const std::optional<Tensor>& bias_, double eps) {
  const char* op = "residual_norm";
  check_shape(op, "x", x_, {-1, -1}, "[N, C]");
  const int64_t n = x_.size(0), c = x_.size(1);
  check_shape(op, "branch", branch_, {n, c}, "[N, C] like x");
  const Tensor x = rows_of(x_), branch = rows_of(branch_);
  const ScalarType type = sum_type(branch);
  check_dtype(op, "x", x, type);
  check_device(op, "branch", branch, x);
  check(branch_weight_.has_value() == branch_bias_.has_value() && weight_.has_value() == bias_.has_value(), op,
        ": a norm needs both a weight and a bias");
  check_eps(op, eps);
  const Optional keep(op, "keep", keep_, x, type, {n, 1}, "[N, 1]");
  const Optional branch_weight(op, "branch_weight", branch_weight_, x, type, {c}, "[C]");
  const Optional branch_bias(op, "branch_bias", branch_bias_, x, type, {c}, "[C]");
  const Optional weight(op, "weight", weight_, x, type, {c}, "[C]"), bias(op, "bias", bias_, x, type, {c}, "[C]");
  const RowNormShape shape{n, c};
  Tensor sum = empty(x, {n, c}), out = empty(branch, {n, c});
  Tensor branch_stats = empty(x, {branch_weight ? n : 0, 2}), stats = empty(x, {weight ? n : 0, 2});
  dispatch_branch(op, branch, [&]<typename T>() {
    using S = Sum<T>;
    const NormWeights<S> branch_norm{branch_weight.pointer<S>(), branch_bias.pointer<S>()},
        norm{weight.pointer<S>(), bias.pointer<S>()};
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::residual_norm<T>(data<S>(x), data<T>(branch), keep.pointer<S>(), branch_norm, norm, shape, eps,
                                      mutable_data<S>(sum), mutable_data<T>(out), mutable_data<S>(branch_stats),
                                      mutable_data<S>(stats), current_stream(x));
    if constexpr (kOnCpu<T>)
      cpu::residual_norm<T>(data<T>(x), data<T>(branch), keep.pointer<T>(), branch_norm, norm, shape, eps,
                            mutable_data<T>(sum), mutable_data<T>(out), mutable_data<T>(branch_stats),
                            mutable_data<T>(stats), torch_parallel());
  });
  return {sum, out, branch_stats, stats};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> residual_norm_backward(
    const std::optional<Tensor>& grad_sum_, const std::optional<Tensor>& grad_out_, const Tensor& branch_,
    const Tensor& sum_, const std::optional<Tensor>& keep_, const std::optional<Tensor>& branch_weight_,
    const std::optional<Tensor>& weight_, const Tensor& branch_stats_, const Tensor& stats_) {
  const char* op = "residual_norm_backward";
  check_shape(op, "sum", sum_, {-1, -1}, "[N, C]");
  const int64_t n = sum_.size(0), c = sum_.size(1);
  check_shape(op, "branch", branch_, {n, c}, "[N, C] like sum");
  const Tensor sum = rows_of(sum_), branch = rows_of(branch_), branch_stats = rows_of(branch_stats_),
               stats = rows_of(stats_);
  const ScalarType type = sum_type(branch);
  check_dtype(op, "sum", sum, type);
  check_device(op, "branch", branch, sum);
  const Optional grad_sum(op, "grad_sum", grad_sum_, sum, type, {n, c}, "[N, C] like sum");
  const Optional grad_out(op, "grad_out", grad_out_, sum, branch.scalar_type(), {n, c}, "[N, C] like sum");
  const Optional keep(op, "keep", keep_, sum, type, {n, 1}, "[N, 1]");
  const Optional branch_weight(op, "branch_weight", branch_weight_, sum, type, {c}, "[C]");
  const Optional weight(op, "weight", weight_, sum, type, {c}, "[C]");
  check_shape(op, "branch_stats", branch_stats, {branch_weight ? n : 0, 2}, "[N, 2]");
  check_shape(op, "stats", stats, {weight ? n : 0, 2}, "[N, 2]");
  check_dtype(op, "branch_stats", branch_stats, type);
  check_dtype(op, "stats", stats, type);
  check_device(op, "branch_stats", branch_stats, sum);
  check_device(op, "stats", stats, sum);
  Tensor grad_x = empty(sum, {n, c}), grad_branch = empty(branch, {n, c}), branch_sum = empty(sum, {c});
  const int64_t c_branch = branch_weight ? c : 0, c_norm = weight ? c : 0;
  Tensor of_branch_weight = empty(sum, {c_branch}), of_branch_bias = empty(sum, {c_branch}),
         of_weight = empty(sum, {c_norm}), of_bias = empty(sum, {c_norm});
  dispatch_branch(op, branch, [&]<typename T>() {
    using S = Sum<T>;
    const NormGrads<S> branch_grads = branch_weight
        ? NormGrads<S>{mutable_data<S>(of_branch_weight), mutable_data<S>(of_branch_bias)} : NormGrads<S>{};
    const NormGrads<S> grads =
        weight ? NormGrads<S>{mutable_data<S>(of_weight), mutable_data<S>(of_bias)} : NormGrads<S>{};
    const RowNormShape shape{n, c};
    if constexpr (kWithCuda)
      if (sum.is_cuda())
        return cuda::residual_norm_vjp<T>(
            grad_sum.pointer<S>(), grad_out.pointer<T>(), data<T>(branch), data<S>(sum), keep.pointer<S>(),
            branch_weight.pointer<S>(), weight.pointer<S>(), data<S>(branch_stats), data<S>(stats), shape,
            mutable_data<S>(grad_x), mutable_data<T>(grad_branch), mutable_data<S>(branch_sum), branch_grads, grads,
            TensorWorkspace(sum), current_stream(sum));
    if constexpr (kOnCpu<T>)
      cpu::residual_norm_vjp<T>(grad_sum.pointer<T>(), grad_out.pointer<T>(), data<T>(branch), data<T>(sum),
                                keep.pointer<T>(), branch_weight.pointer<T>(), weight.pointer<T>(),
                                data<T>(branch_stats), data<T>(stats), shape, mutable_data<T>(grad_x),
                                mutable_data<T>(grad_branch), mutable_data<T>(branch_sum), branch_grads, grads,
                                torch_parallel());
  });
  return {grad_x, grad_branch, branch_sum, of_branch_weight, of_branch_bias, of_weight, of_bias};
}

Tensor linear_grad_bias(const Tensor& grad_) {
  const char* op = "linear_grad_bias";
  check_shape(op, "grad", grad_, {-1, -1}, "[N, C]");
  const Tensor grad = rows_of(grad_);
  Tensor out = empty(grad, {grad.size(1)}, sum_type(grad));
  dispatch_branch(op, grad, [&]<typename T>() {
    const RowNormShape shape{grad.size(0), grad.size(1)};
    if constexpr (kWithCuda)
      if (grad.is_cuda())
        return cuda::sum_rows<T>(data<T>(grad), shape, mutable_data<Sum<T>>(out), TensorWorkspace(grad),
                                 current_stream(grad));
    if constexpr (kOnCpu<T>) cpu::sum_rows<T>(data<T>(grad), shape, mutable_data<T>(out), torch_parallel());
  });
  return out;
}

void check_columns(const char* op, const Tensor& x, const Tensor& mean, const Tensor& scale, const Tensor& bias) {
  check_shape(op, "x", x, {-1, -1}, "[N, C]");
  check_channels(op, "mean", mean, x);
  check_channels(op, "scale", scale, x);
  check_channels(op, "bias", bias, x);
}

Tensor norm_gelu(const Tensor& x_, const Tensor& mean_, const Tensor& scale_, const Tensor& bias_, ScalarType dtype) {
  const char* op = "norm_gelu";
  const Tensor x = rows_of(x_), mean = rows_of(mean_), scale = rows_of(scale_), bias = rows_of(bias_);
  check_columns(op, x, mean, scale, bias);
  const RowNormShape shape{x.size(0), x.size(1)};
  Tensor out = empty(x, {shape.n_rows, shape.channels}, dtype);
  dispatch(op, x, dtype, [&]<typename In, typename Out>() {
    using S = Sum<In>;
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::norm_gelu<In, Out>(data<In>(x), data<S>(mean), data<S>(scale), data<S>(bias), shape,
                                        mutable_data<Out>(out), current_stream(x));
    if constexpr (std::is_same_v<In, Out> && kOnCpu<In>)
      cpu::norm_gelu<In>(data<In>(x), data<In>(mean), data<In>(scale), data<In>(bias), shape, mutable_data<In>(out),
                         torch_parallel());
  });
  return out;
}

std::tuple<Tensor, Tensor, Tensor> norm_gelu_backward(const Tensor& grad_, const Tensor& x_, const Tensor& mean_,
                                                      const Tensor& scale_, const Tensor& bias_) {
  const char* op = "norm_gelu_backward";
  const Tensor grad = rows_of(grad_), x = rows_of(x_), mean = rows_of(mean_), scale = rows_of(scale_),
               bias = rows_of(bias_);
  check_columns(op, x, mean, scale, bias);
  const RowNormShape shape{x.size(0), x.size(1)};
  check_shape(op, "grad", grad, {shape.n_rows, shape.channels}, "[N, C] like x");
  check_device(op, "grad", grad, x);
  Tensor grad_x = empty(x, {shape.n_rows, shape.channels}), grad_scale = empty(scale, {shape.channels}),
         grad_bias = empty(scale, {shape.channels});
  dispatch(op, x, grad.scalar_type(), [&]<typename In, typename Out>() {
    using S = Sum<In>;
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::norm_gelu_vjp<In, Out>(data<Out>(grad), data<In>(x), data<S>(mean), data<S>(scale), data<S>(bias),
                                            shape, mutable_data<In>(grad_x), mutable_data<S>(grad_scale),
                                            mutable_data<S>(grad_bias), TensorWorkspace(x), current_stream(x));
    if constexpr (std::is_same_v<In, Out> && kOnCpu<In>)
      cpu::norm_gelu_vjp<In>(data<In>(grad), data<In>(x), data<In>(mean), data<In>(scale), data<In>(bias), shape,
                             mutable_data<In>(grad_x), mutable_data<In>(grad_scale), mutable_data<In>(grad_bias),
                             torch_parallel());
  });
  return {grad_x, grad_scale, grad_bias};
}

void kernels(auto& m) {
  m.impl("row_norm", TORCH_BOX(&row_norm));
  m.impl("row_norm_backward", TORCH_BOX(&row_norm_backward));
  m.impl("residual_norm", TORCH_BOX(&residual_norm));
  m.impl("residual_norm_backward", TORCH_BOX(&residual_norm_backward));
  m.impl("linear_grad_bias", TORCH_BOX(&linear_grad_bias));
  m.impl("norm_gelu", TORCH_BOX(&norm_gelu));
  m.impl("norm_gelu_backward", TORCH_BOX(&norm_gelu_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
