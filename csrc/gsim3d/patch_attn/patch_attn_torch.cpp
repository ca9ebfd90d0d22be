#include <algorithm>
#include <type_traits>

#include "gsim3d/core/half.h"
#include "gsim3d/patch_attn/patch_attn.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// Heads are read in place, also inside a larger tensor, as long as a head's channels lie together.
Tensor heads_of(const Tensor& x) { return x.size(2) <= 1 || x.stride(2) == 1 ? x : torch::stable::contiguous(x); }

// Calls f.template operator()<T>(): float or double, on CUDA also the 16-bit types.
template <typename F>
void dispatch(const char* op, const Tensor& q, const F& f) {
  if constexpr (kWithCuda) {
    if (q.is_cuda() && q.scalar_type() == ScalarType::Half) return f.template operator()<Float16>();
    if (q.is_cuda() && q.scalar_type() == ScalarType::BFloat16) return f.template operator()<BFloat16>();
  }
  dispatch_float(op, "q", q, f);
}

template <typename T>
constexpr bool kOnCpu = std::is_floating_point_v<T>;

// The softmax of 16-bit numbers is float32.
ScalarType stats_type(const Tensor& q) {
  const ScalarType type = q.scalar_type();
  return type == ScalarType::Half || type == ScalarType::BFloat16 ? ScalarType::Float : type;
}

template <typename T>
HeadRows<T> view_of(const Tensor& x) {
  return {data<T>(x), x.stride(0), x.stride(1)};
}

struct Inputs {
  Tensor q, k, v, q_rows, kv_rows, cu_q, cu_k;
  PatchTable table;
  AttentionSize size;
};

Inputs inputs_of(const char* op, const Tensor& q, const Tensor& k, const Tensor& v, const Tensor& q_rows,
                 const Tensor& kv_rows, const Tensor& cu_q, const Tensor& cu_k, double scale) {
  check_shape(op, "q", q, {-1, -1, -1}, "[Nq, H, D]");
  check_shape(op, "k", k, {-1, q.size(1), q.size(2)}, "[Nk, H, D]");
  check_shape(op, "v", v, {k.size(0), q.size(1), q.size(2)}, "[Nk, H, D]");
  check_dtype(op, "k", k, q.scalar_type());
  check_dtype(op, "v", v, q.scalar_type());
  check_device(op, "k", k, q);
  check_device(op, "v", v, q);
  const std::pair<const char*, const Tensor&> lists[] = {
      {"q_rows", q_rows}, {"kv_rows", kv_rows}, {"cu_q", cu_q}, {"cu_k", cu_k}};
  for (const auto& [name, list] : lists) {
    check_dtype(op, name, list, ScalarType::Long);
    check_device(op, name, list, q);
    check(list.dim() == 1, op, ": ", name, " must have one dimension; got ", shape_of(list));
  }
  check(cu_q.size(0) >= 1, op, ": cu_q must be [P + 1]; got ", shape_of(cu_q));
  check_shape(op, "cu_k", cu_k, {cu_q.size(0)}, "[P + 1]");
  Inputs in{heads_of(q),   heads_of(k),   heads_of(v), rows_of(q_rows), rows_of(kv_rows),
            rows_of(cu_q), rows_of(cu_k), {},          {}};
  in.table = {data<int64_t>(in.q_rows),
              data<int64_t>(in.kv_rows),
              data<int64_t>(in.cu_q),
              data<int64_t>(in.cu_k),
              cu_q.size(0) - 1,
              q_rows.size(0),
              kv_rows.size(0),
              q.size(0),
              k.size(0)};
  in.size = {q.size(1), q.size(2), scale};
  cpu::check_attention_size(op, in.size);
  // On a GPU the lists stay where they are: kernels skip what is out of range.
  if (!q.is_cuda()) cpu::check_patch_table(op, in.table);
  return in;
}

// Fills `out` and `stats`, or with `joins` goes on with what they hold.
void attend(const char* op, const Inputs& in, bool joins, Tensor& out, Tensor& stats) {
  dispatch(op, in.q, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (in.q.is_cuda())
        return cuda::patch_attention(view_of<T>(in.q), view_of<T>(in.k), view_of<T>(in.v), in.table, in.size, joins,
                                     mutable_data<T>(out), mutable_data<cuda::StatsOf<T>>(stats), current_stream(in.q));
    if constexpr (kOnCpu<T>)
      cpu::patch_attention(view_of<T>(in.q), view_of<T>(in.k), view_of<T>(in.v), in.table, in.size, joins,
                           mutable_data<T>(out), mutable_data<T>(stats), torch_parallel());
  });
}

std::tuple<Tensor, Tensor> patch_attention(const Tensor& q, const Tensor& k, const Tensor& v, const Tensor& q_rows,
                                           const Tensor& kv_rows, const Tensor& cu_q, const Tensor& cu_k,
                                           double scale) {
  const char* op = "patch_attention";
  const Inputs in = inputs_of(op, q, k, v, q_rows, kv_rows, cu_q, cu_k, scale);
  Tensor out = empty(q, {q.size(0), q.size(1), q.size(2)});
  Tensor stats = empty(q, {q.size(0), q.size(1), 2}, stats_type(q));
  attend(op, in, false, out, stats);
  return {out, stats};
}

std::tuple<Tensor, Tensor> joint_attention(const Tensor& q, const Tensor& k, const Tensor& v, const Tensor& other_k,
                                           const Tensor& other_v, const Tensor& q_rows, const Tensor& kv_rows,
                                           const Tensor& cu_q, const Tensor& cu_k, const Tensor& other_q_rows,
                                           const Tensor& other_kv_rows, const Tensor& other_cu_q,
                                           const Tensor& other_cu_k, double scale) {
  const char* op = "joint_attention";
  const Inputs own = inputs_of(op, q, k, v, q_rows, kv_rows, cu_q, cu_k, scale);
  const Inputs other =
      inputs_of("joint_attention: other table", q, other_k, other_v, other_q_rows, other_kv_rows, other_cu_q,
                other_cu_k, scale);
  Tensor out = empty(q, {q.size(0), q.size(1), q.size(2)});
  Tensor stats = empty(q, {q.size(0), q.size(1), 2}, stats_type(q));
  attend(op, own, false, out, stats);
  attend(op, other, true, out, stats);
  return {out, stats};
}

// What the backward pass reads beside the inputs.
struct Outputs {
  Tensor grad, out, stats;
};

Outputs outputs_of(const char* op, const Tensor& grad, const Tensor& out, const Tensor& stats, const Tensor& q) {
  check_shape(op, "grad", grad, {q.size(0), q.size(1), q.size(2)}, "[Nq, H, D]");
  check_shape(op, "out", out, {q.size(0), q.size(1), q.size(2)}, "[Nq, H, D]");
  check_shape(op, "stats", stats, {q.size(0), q.size(1), 2}, "[Nq, H, 2]");
  check_dtype(op, "grad", grad, q.scalar_type());
  check_dtype(op, "out", out, q.scalar_type());
  check_dtype(op, "stats", stats, stats_type(q));
  check_device(op, "grad", grad, q);
  check_device(op, "out", out, q);
  check_device(op, "stats", stats, q);
  return {heads_of(grad), rows_of(out), rows_of(stats)};
}

std::tuple<Tensor, Tensor, Tensor> patch_attention_backward(const Tensor& grad, const Tensor& q, const Tensor& k,
                                                            const Tensor& v, const Tensor& out, const Tensor& stats,
                                                            const Tensor& q_rows, const Tensor& kv_rows,
                                                            const Tensor& cu_q, const Tensor& cu_k, double scale) {
  const char* op = "patch_attention_backward";
  const Inputs in = inputs_of(op, q, k, v, q_rows, kv_rows, cu_q, cu_k, scale);
  const Outputs of = outputs_of(op, grad, out, stats, q);
  Tensor grad_q = empty(q, {q.size(0), q.size(1), q.size(2)});
  Tensor grad_k = empty(k, {k.size(0), k.size(1), k.size(2)});
  Tensor grad_v = empty(k, {k.size(0), k.size(1), k.size(2)});
  dispatch(op, q, [&]<typename T>() {
    TensorWorkspace workspace(q);
    T* const grads[3] = {mutable_data<T>(grad_q), mutable_data<T>(grad_k), mutable_data<T>(grad_v)};
    if constexpr (kWithCuda)
      if (q.is_cuda())
        return cuda::patch_attention_vjp<T>(view_of<T>(of.grad), view_of<T>(in.q), view_of<T>(in.k), view_of<T>(in.v),
                                            data<T>(of.out), data<cuda::StatsOf<T>>(of.stats), in.table, in.size,
                                            {grads[0], grads[1], grads[2], q.size(1) * q.size(2)}, workspace,
                                            current_stream(q));
    if constexpr (kOnCpu<T>)
      cpu::patch_attention_vjp<T>(view_of<T>(of.grad), view_of<T>(in.q), view_of<T>(in.k), view_of<T>(in.v),
                                  data<T>(of.out), data<T>(of.stats), in.table, in.size, grads, workspace,
                                  torch_parallel());
  });
  return {grad_q, grad_k, grad_v};
}

Tensor patch_attention_backward_packed(const Tensor& grad, const Tensor& q, const Tensor& k, const Tensor& v,
                                       const Tensor& out, const Tensor& stats, const Tensor& q_rows,
                                       const Tensor& kv_rows, const Tensor& cu_q, const Tensor& cu_k, double scale) {
  const char* op = "patch_attention_backward_packed";
  const Inputs in = inputs_of(op, q, k, v, q_rows, kv_rows, cu_q, cu_k, scale);
  const Outputs of = outputs_of(op, grad, out, stats, q);
  const int64_t n = q.size(0), width = q.size(1) * q.size(2);
  check_shape(op, "k", k, {n, q.size(1), q.size(2)}, "[N, H, D] like q");
  Tensor packed = empty(q, {n, 3, q.size(1), q.size(2)});
  dispatch(op, q, [&]<typename T>() {
    TensorWorkspace workspace(q);
    T* const to = mutable_data<T>(packed);
    if constexpr (kWithCuda)
      if (q.is_cuda())
        return cuda::patch_attention_vjp<T>(view_of<T>(of.grad), view_of<T>(in.q), view_of<T>(in.k), view_of<T>(in.v),
                                            data<T>(of.out), data<cuda::StatsOf<T>>(of.stats), in.table, in.size,
                                            {to, to + width, to + 2 * width, 3 * width}, workspace, current_stream(q));
    if constexpr (kOnCpu<T>) {
      Tensor apart = empty(q, {3, n, width});
      T* const from = mutable_data<T>(apart);
      T* const grads[3] = {from, from + n * width, from + 2 * n * width};
      cpu::patch_attention_vjp<T>(view_of<T>(of.grad), view_of<T>(in.q), view_of<T>(in.k), view_of<T>(in.v),
                                  data<T>(of.out), data<T>(of.stats), in.table, in.size, grads, workspace,
                                  torch_parallel());
      for (int64_t row = 0; row < n; ++row)
        for (int i = 0; i < 3; ++i) std::copy_n(grads[i] + row * width, width, to + (3 * row + i) * width);
    }
  });
  return packed;
}

void kernels(auto& m) {
  m.impl("patch_attention", TORCH_BOX(&patch_attention));
  m.impl("joint_attention", TORCH_BOX(&joint_attention));
  m.impl("patch_attention_backward", TORCH_BOX(&patch_attention_backward));
  m.impl("patch_attention_backward_packed", TORCH_BOX(&patch_attention_backward_packed));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
