#include "gsim3d/decode/decode.h"

#include <tuple>
#include <type_traits>

#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

constexpr int kLargestDegree = 3;
constexpr double kLargestScale = 1e15;  // metres, as of any number that an op reads

// Calls f.template operator()<T>() for the dtype of the rows.
template <typename F>
void dispatch_rows(const char* op, const Tensor& raw, const F& f) {
  if constexpr (kWithCuda) {
    if (raw.is_cuda() && raw.scalar_type() == ScalarType::Half) return f.template operator()<Float16>();
    if (raw.is_cuda() && raw.scalar_type() == ScalarType::BFloat16) return f.template operator()<BFloat16>();
  }
  dispatch_float(op, "raw", raw, f);
}

template <typename T>
constexpr bool kOnCpu = std::is_same_v<T, float> || std::is_same_v<T, double>;

ScalarType wide_type(const Tensor& raw) {
  return raw.scalar_type() == ScalarType::Double ? ScalarType::Double : ScalarType::Float;
}

DecodeShape check_rows(const char* op, const Tensor& raw, const Tensor& readings, int64_t degree, double scale_min,
                       double scale_max) {
  check_shape(op, "raw", raw, {-1, -1}, "[N, C]");
  check(degree >= -1 && degree <= kLargestDegree, op, ": degree must be -1 to 3; got ", degree);
  int terms = -1;
  for (int d = -1; d <= kLargestDegree; ++d)
    if (raw.size(1) == 3 * (d + 1) * (d + 1) + 7) terms = (d + 1) * (d + 1);
  check(terms >= (degree + 1) * (degree + 1), op,
        ": raw must have 3 K + 7 columns with K = 0, 1, 4, 9 or 16, at least ", (degree + 1) * (degree + 1),
        "; got ", raw.size(1));
  check(scale_min >= 0 && scale_max >= scale_min && scale_max <= kLargestScale, op,
        ": scale_min and scale_max must rise from 0 to at most ", kLargestScale, "; got ", scale_min, " and ",
        scale_max);
  check_dtype(op, "readings", readings, wide_type(raw));
  check_device(op, "readings", readings, raw);
  check_shape(op, "readings", readings, {kReadings}, "what harmonics are read with");
  return {raw.size(0), terms, static_cast<int>(degree), scale_min, scale_max};
}

std::tuple<Tensor, Tensor, Tensor> decode_gaussians(const Tensor& raw_, const Tensor& readings_, int64_t degree,
                                                    double scale_min, double scale_max) {
  const char* op = "decode_gaussians";
  const Tensor raw = rows_of(raw_), readings = rows_of(readings_);
  const DecodeShape shape = check_rows(op, raw, readings, degree, scale_min, scale_max);
  Tensor quats = empty(readings, {shape.n_rows, 4}), scales = empty(readings, {shape.n_rows, 3}),
         sh = empty(readings, {shape.n_rows, shape.kept_terms(), 3});
  dispatch_rows(op, raw, [&]<typename T>() {
    using S = Sum<T>;
    const Decoded<S> out{mutable_data<S>(quats), mutable_data<S>(scales), mutable_data<S>(sh)};
    if constexpr (kWithCuda)
      if (raw.is_cuda()) return cuda::decode<T>(data<T>(raw), data<S>(readings), shape, out, current_stream(raw));
    if constexpr (kOnCpu<T>) cpu::decode<T>(data<T>(raw), data<T>(readings), shape, out, torch_parallel());
  });
  return {quats, scales, sh};
}

Tensor decode_gaussians_backward(const Tensor& grad_quats_, const Tensor& grad_scales_, const Tensor& grad_sh_,
                                 const Tensor& raw_, const Tensor& readings_, int64_t degree, double scale_min,
                                 double scale_max) {
  const char* op = "decode_gaussians_backward";
  const Tensor raw = rows_of(raw_), readings = rows_of(readings_), grad_quats = rows_of(grad_quats_),
               grad_scales = rows_of(grad_scales_), grad_sh = rows_of(grad_sh_);
  const DecodeShape shape = check_rows(op, raw, readings, degree, scale_min, scale_max);
  check_shape(op, "grad_quats", grad_quats, {shape.n_rows, 4}, "[N, 4]");
  check_shape(op, "grad_scales", grad_scales, {shape.n_rows, 3}, "[N, 3]");
  check_shape(op, "grad_sh", grad_sh, {shape.n_rows, shape.kept_terms(), 3}, "[N, K, 3]");
  for (const Tensor* grad : {&grad_quats, &grad_scales, &grad_sh}) {
    check_dtype(op, "gradients", *grad, wide_type(raw));
    check_device(op, "gradients", *grad, raw);
  }
  Tensor grad_raw = empty(raw, {shape.n_rows, shape.columns()});
  dispatch_rows(op, raw, [&]<typename T>() {
    using S = Sum<T>;
    const DecodedGradients<S> grads{data<S>(grad_quats), data<S>(grad_scales), data<S>(grad_sh)};
    T* out = mutable_data<T>(grad_raw);
    if constexpr (kWithCuda)
      if (raw.is_cuda())
        return cuda::decode_vjp<T>(data<T>(raw), data<S>(readings), shape, grads, out, current_stream(raw));
    if constexpr (kOnCpu<T>) cpu::decode_vjp<T>(data<T>(raw), data<T>(readings), shape, grads, out, torch_parallel());
  });
  return grad_raw;
}

void kernels(auto& m) {
  m.impl("decode_gaussians", TORCH_BOX(&decode_gaussians));
  m.impl("decode_gaussians_backward", TORCH_BOX(&decode_gaussians_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
