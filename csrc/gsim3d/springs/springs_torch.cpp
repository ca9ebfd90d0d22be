#include "gsim3d/springs/springs.h"

#include <tuple>

#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// Checked, contiguous arguments of both ops.
struct SpringTensors {
  const char* op;
  Tensor state;
  const Tensor neighbors, cu_springs, sources, cu_sources, lengths, stiffness, damping, grip, external;
  double seconds, ground, power;
  int64_t substeps, n, n_springs, interval, n_kept;

  SpringTensors(const char* op_, const Tensor& state_, const Tensor& neighbors_, const Tensor& cu_springs_,
                const Tensor& sources_, const Tensor& cu_sources_, const Tensor& lengths_, const Tensor& stiffness_,
                const Tensor& damping_, const Tensor& grip_, const Tensor& external_, double seconds_,
                int64_t substeps_, double ground_, double power_)
      : op(op_), state(rows_of(state_)), neighbors(rows_of(neighbors_)), cu_springs(rows_of(cu_springs_)),
        sources(rows_of(sources_)), cu_sources(rows_of(cu_sources_)), lengths(rows_of(lengths_)),
        stiffness(rows_of(stiffness_)), damping(rows_of(damping_)), grip(rows_of(grip_)),
        external(rows_of(external_)), seconds(seconds_), ground(ground_), power(power_), substeps(substeps_) {
    check_shape(op, "state", state, {2, -1, 3}, "[2, N, 3]");
    check_shape(op, "neighbors", neighbors, {-1}, "[S]");
    n = state.size(1), n_springs = neighbors.size(0);
    check_shape(op, "cu_springs", cu_springs, {n + 1}, "[N + 1]");
    check_shape(op, "sources", sources, {n_springs}, "[S]");
    check_shape(op, "cu_sources", cu_sources, {n + 1}, "[N + 1]");
    check_shape(op, "lengths", lengths, {n_springs}, "[S]");
    check_shape(op, "stiffness", stiffness, {n_springs}, "[S]");
    check_shape(op, "damping", damping, {n_springs}, "[S]");
    check_shape(op, "grip", grip, {n}, "[N]");
    check_shape(op, "external", external, {n, 3}, "[N, 3]");
    for (const Tensor* list : {&neighbors, &cu_springs, &sources, &cu_sources}) {
      check_dtype(op, "lists of springs", *list, ScalarType::Long);
      check_device(op, "lists of springs", *list, state);
    }
    for (const Tensor* value : {&lengths, &stiffness, &damping, &grip, &external}) {
      check_dtype(op, "lengths, stiffness, damping, grip and external", *value, state.scalar_type());
      check_device(op, "lengths, stiffness, damping, grip and external", *value, state);
    }
    check(seconds > 0 && seconds < 1e15, op, ": seconds must be positive and finite; got ", seconds);
    check(substeps > 0 && substeps <= 1000000, op, ": substeps must be 1 to 1000000; got ", substeps);
    check(power >= 0 && power < 1e15, op, ": power must be at least 0 and finite; got ", power);
    check(ground < 1e15, op, ": ground must be a height in metres; got ", ground);
    interval = spring_interval(substeps), n_kept = (substeps - 1) / interval;
  }

  SpringSources lists() const { return {data<int64_t>(sources), data<int64_t>(cu_sources)}; }

  template <typename T>
  SpringScene<T> scene() const {
    return {data<int64_t>(neighbors), data<int64_t>(cu_springs), data<T>(lengths), data<T>(stiffness), data<T>(damping),
            data<T>(grip), data<T>(external), n, n_springs, substeps, static_cast<T>(seconds / substeps),
            static_cast<T>(ground), static_cast<T>(power)};
  }
  template <typename T>
  SpringStates<T> states(Tensor& kept, Tensor& last, Tensor& between) {
    return {mutable_data<T>(state),   mutable_data<T>(kept), mutable_data<T>(last),
            mutable_data<T>(between), substeps,              interval,
            6 * n};
  }
};

std::tuple<Tensor, Tensor> advance_springs(const Tensor& state, const Tensor& neighbors, const Tensor& cu_springs,
                                           const Tensor& sources, const Tensor& cu_sources, const Tensor& lengths,
                                           const Tensor& stiffness, const Tensor& damping, const Tensor& grip,
                                           const Tensor& external, double seconds, int64_t substeps, double ground,
                                           double power) {
  SpringTensors given("advance_springs", state, neighbors, cu_springs, sources, cu_sources, lengths, stiffness,
                      damping, grip, external, seconds, substeps, ground, power);
  Tensor last = empty(state, {2, given.n, 3}), kept = empty(state, {given.n_kept, 2, given.n, 3}),
         between = empty(state, {given.interval - 1, 2, given.n, 3});
  dispatch_float(given.op, "state", state, [&]<typename T>() {
    const SpringScene<T> scene = given.scene<T>();
    const SpringStates<T> states = given.states<T>(kept, last, between);
    if constexpr (kWithCuda)
      if (state.is_cuda()) return cuda::advance_springs(scene, states, current_stream(state));
    cpu::check_springs(given.op, scene, given.lists());
    cpu::advance_springs(scene, states, torch_parallel());
  });
  return {last, kept};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> advance_springs_backward(
    const Tensor& grad, const Tensor& last_, const Tensor& kept_, const Tensor& state, const Tensor& neighbors,
    const Tensor& cu_springs, const Tensor& sources, const Tensor& cu_sources, const Tensor& lengths,
    const Tensor& stiffness, const Tensor& damping, const Tensor& grip, const Tensor& external, double seconds,
    int64_t substeps, double ground, double power) {
  SpringTensors given("advance_springs_backward", state, neighbors, cu_springs, sources, cu_sources, lengths,
                      stiffness, damping, grip, external, seconds, substeps, ground, power);
  Tensor last = rows_of(last_), kept = rows_of(kept_), grad_state = torch::stable::clone(grad);
  check_shape(given.op, "grad", grad_state, {2, given.n, 3}, "[2, N, 3]");
  check_shape(given.op, "last", last, {2, given.n, 3}, "[2, N, 3]");
  check_shape(given.op, "kept", kept, {given.n_kept, 2, given.n, 3}, "[K, 2, N, 3]");
  for (const Tensor* value : {&grad_state, &last, &kept}) {
    check_dtype(given.op, "grad, last and kept", *value, state.scalar_type());
    check_device(given.op, "grad, last and kept", *value, state);
  }
  grad_state = rows_of(grad_state);
  Tensor grad_lengths = empty(state, {given.n_springs}), grad_stiffness = empty(state, {given.n_springs}),
         grad_damping = empty(state, {given.n_springs}), grad_grip = empty(state, {given.n}),
         grad_external = empty(state, {given.n, 3}), between = empty(state, {given.interval - 1, 2, given.n, 3});
  dispatch_float(given.op, "state", state, [&]<typename T>() {
    const SpringScene<T> scene = given.scene<T>();
    const SpringStates<T> states = given.states<T>(kept, last, between);
    const SpringGradients<T> grads{mutable_data<T>(grad_state),     mutable_data<T>(grad_lengths),
                                   mutable_data<T>(grad_stiffness), mutable_data<T>(grad_damping),
                                   mutable_data<T>(grad_grip),      mutable_data<T>(grad_external)};
    if constexpr (kWithCuda)
      if (state.is_cuda())
        return cuda::advance_springs_vjp(scene, given.lists(), states, grads, TensorWorkspace(state),
                                         current_stream(state));
    TensorWorkspace workspace(state);
    cpu::check_springs(given.op, scene, given.lists());
    cpu::advance_springs_vjp(scene, given.lists(), states, grads, workspace, torch_parallel());
  });
  return {grad_state, grad_lengths, grad_stiffness, grad_damping, grad_grip, grad_external};
}

void kernels(auto& m) {
  m.impl("advance_springs", TORCH_BOX(&advance_springs));
  m.impl("advance_springs_backward", TORCH_BOX(&advance_springs_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
