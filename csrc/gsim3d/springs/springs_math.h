// Substeps of springs.h, anchor by anchor, for host and device, each VJP below its forward.
//
// Loops over springs take (lane, lanes): a warp shares them on a GPU, and adds its sums before it goes on.
#pragma once

#include <cmath>

#include "gsim3d/core/platform.h"
#include "gsim3d/springs/springs.h"

namespace gsim3d::springs {

constexpr double kSlack = 1e-6;  // metres of extension that count as 0

template <typename T>
struct Spring {
  T length, stiffness, damping;
};

// extension * (1 + |strain|)^power, and its derivatives.
template <typename T>
struct Tension {
  T value, by_distance, by_length;
};
template <typename T>
GSIM3D_HD Tension<T> tension(T distance, T length, T power) {
  const T extension = distance - length;
  if (std::abs(extension) < T(kSlack)) return {T(0), T(0), T(0)};
  if (power == T(0)) return {extension, T(1), T(-1)};
  const T strain = extension / length, base = T(1) + std::abs(strain);
  const T hardening = power == T(0.5) ? std::sqrt(base) : std::pow(base, power);
  const T slope = power * hardening / base * std::abs(strain);  // extension * d hardening / d distance
  return {extension * hardening, hardening + slope, -hardening - slope * distance / length};
}

// Adds the acceleration by a spring; its neighbour is `apart` from the anchor and `faster`. Anchors in one place: none.
template <typename T>
GSIM3D_HD void add_pull(const T apart[3], const T faster[3], const Spring<T>& spring, T power, T sum[3]) {
  const T distance = std::sqrt(apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]);
  if (!(distance > T(0))) return;
  const T along[3] = {apart[0] / distance, apart[1] / distance, apart[2] / distance};
  const T closing = faster[0] * along[0] + faster[1] * along[1] + faster[2] * along[2];
  const T pull = spring.stiffness * tension(distance, spring.length, power).value + spring.damping * closing;
  for (int d = 0; d < 3; ++d) sum[d] += pull * along[d];
}

// `grad` is that of the acceleration; of `apart` and `faster` it is added `sign` times to `sums`, of the spring to
// `own` where that is wanted.
template <typename T>
GSIM3D_HD void add_pull_vjp(const T grad[3], const T apart[3], const T faster[3], const Spring<T>& spring, T power,
                            T sign, T sums[6], Spring<T>* own) {
  const T distance = std::sqrt(apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]);
  if (!(distance > T(0))) return;
  const T along[3] = {apart[0] / distance, apart[1] / distance, apart[2] / distance};
  const T closing = faster[0] * along[0] + faster[1] * along[1] + faster[2] * along[2];
  const Tension<T> t = tension(distance, spring.length, power);
  const T pull = spring.stiffness * t.value + spring.damping * closing;
  const T grad_pull = grad[0] * along[0] + grad[1] * along[1] + grad[2] * along[2];
  const T grad_closing = spring.damping * grad_pull, grad_distance = spring.stiffness * t.by_distance * grad_pull;
  T grad_along[3];
  for (int d = 0; d < 3; ++d) grad_along[d] = pull * grad[d] + grad_closing * faster[d];
  const T radial = pull * grad_pull + grad_closing * closing;  // grad_along . along
  for (int d = 0; d < 3; ++d) {
    sums[d] += sign * (grad_distance * along[d] + (grad_along[d] - radial * along[d]) / distance);
    sums[3 + d] += sign * grad_closing * along[d];
  }
  if (own) {
    own->length += spring.stiffness * t.by_length * grad_pull;
    own->stiffness += t.value * grad_pull;
    own->damping += closing * grad_pull;
  }
}

// [begin, end) of row i of offsets that nothing has checked.
struct Span {
  int64_t begin, end;
};
GSIM3D_HD Span span_of(const int64_t* cu, int64_t i, int64_t n) {
  const auto clamped = [](int64_t x, int64_t low, int64_t high) { return x < low ? low : x > high ? high : x; };
  const int64_t begin = clamped(cu[i], 0, n);
  return {begin, clamped(cu[i + 1], begin, n)};
}

template <typename T>
GSIM3D_HD void between(const T* state, int64_t n, int64_t from, int64_t to, T apart[3], T faster[3]) {
  for (int d = 0; d < 3; ++d) {
    apart[d] = state[3 * to + d] - state[3 * from + d];
    faster[d] = state[3 * (n + to) + d] - state[3 * (n + from) + d];
  }
}

template <typename T>
GSIM3D_HD Spring<T> spring_of(const SpringScene<T>& s, int64_t e) {
  return {s.lengths[e], s.stiffness[e], s.damping[e]};
}

// Adds the accelerations of anchor i by its springs lane, lane + lanes, ...
template <typename T>
GSIM3D_HD void add_pulls(const SpringScene<T>& s, const T* state, int64_t i, int lane, int lanes, T sum[3]) {
  const Span span = span_of(s.cu_springs, i, s.n_springs);
  for (int64_t e = span.begin + lane; e < span.end; e += lanes) {
    const int64_t j = s.neighbors[e];
    if (j < 0 || j >= s.n) continue;
    T apart[3], faster[3];
    between(state, s.n, i, j, apart, faster);
    add_pull(apart, faster, spring_of(s, e), s.power, sum);
  }
}

// The state of anchor i behind a substep, given the acceleration by its springs.
template <typename T>
GSIM3D_HD void finish_substep(const SpringScene<T>& s, const T* state, int64_t i, const T pull[3], T* to) {
  T x[3], v[3];
  for (int d = 0; d < 3; ++d) {
    v[d] = state[3 * (s.n + i) + d] + s.h * (pull[d] + s.external[3 * i + d]);
    x[d] = state[3 * i + d] + s.h * v[d];
  }
  if (x[2] <= s.ground) {
    v[0] *= s.grip[i];
    v[1] *= s.grip[i];
    v[2] = T(0);
    x[2] = s.ground;
  }
  for (int d = 0; d < 3; ++d) {
    to[3 * i + d] = x[d];
    to[3 * (s.n + i) + d] = v[d];
  }
}

// The springs that end at each anchor, in the order of `sources`: who feels them, and what they are.
template <typename T>
struct Incoming {
  const int64_t* cu;  // [n + 1]
  int64_t* owners;    // [n_springs], -1: none
  T *lengths, *stiffness, *damping;
};

template <typename T>
Incoming<T> take_incoming(const SpringScene<T>& s, const SpringSources& sources, const Workspace& workspace) {
  const int64_t count = s.n_springs;
  return {sources.cu_sources, workspace.take<int64_t>(count), workspace.take<T>(count), workspace.take<T>(count),
          workspace.take<T>(count)};
}

// Fills entry p of `in`.
template <typename T>
GSIM3D_HD void fill_incoming(const SpringScene<T>& s, const int64_t* sources, int64_t p, const Incoming<T>& in) {
  const int64_t e = sources[p];
  int64_t low = 0, high = s.n + 1;  // the first offset behind e
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (s.cu_springs[middle] <= e) low = middle + 1;
    else high = middle;
  }
  const bool ok = e >= 0 && e < s.n_springs && low > 0 && low <= s.n;
  in.owners[p] = ok ? low - 1 : -1;
  in.lengths[p] = ok ? s.lengths[e] : T(1);
  in.stiffness[p] = ok ? s.stiffness[e] : T(0);
  in.damping[p] = ok ? s.damping[e] : T(0);
}

// Adds to `sums` the acceleration of anchor i (3), and the gradient of its position and velocity by springs (6); to
// `grads` that of its own springs. `pulls` [n, 3] is the gradient of all accelerations.
template <typename T>
GSIM3D_HD void add_pulls_vjp(const SpringScene<T>& s, const Incoming<T>& in, const T* state, const T* pulls, int64_t i,
                             int lane, int lanes, T sums[9], const SpringGradients<T>& grads) {
  T apart[3], faster[3];
  const Span span = span_of(s.cu_springs, i, s.n_springs);
  for (int64_t e = span.begin + lane; e < span.end; e += lanes) {
    const int64_t j = s.neighbors[e];
    if (j < 0 || j >= s.n) continue;
    between(state, s.n, i, j, apart, faster);
    add_pull(apart, faster, spring_of(s, e), s.power, sums);
    Spring<T> own{grads.lengths[e], grads.stiffness[e], grads.damping[e]};
    add_pull_vjp(pulls + 3 * i, apart, faster, spring_of(s, e), s.power, T(-1), sums + 3, &own);
    grads.lengths[e] = own.length;
    grads.stiffness[e] = own.stiffness;
    grads.damping[e] = own.damping;
  }
  const Span ending = span_of(in.cu, i, s.n_springs);
  for (int64_t p = ending.begin + lane; p < ending.end; p += lanes) {
    const int64_t owner = in.owners[p];
    if (owner < 0) continue;
    between(state, s.n, owner, i, apart, faster);
    const Spring<T> spring{in.lengths[p], in.stiffness[p], in.damping[p]};
    add_pull_vjp<T>(pulls + 3 * owner, apart, faster, spring, s.power, T(1), sums + 3, nullptr);
  }
}

// Gradients x, v of anchor i behind a substep that ended at height z -> before the ground; of its acceleration: h * v.
template <typename T>
GSIM3D_HD void contact_vjp(const SpringScene<T>& s, int64_t i, T z, T x[3], T v[3]) {
  if (z <= s.ground) {
    v[0] *= s.grip[i];
    v[1] *= s.grip[i];
    v[2] = x[2] = T(0);
  }
  for (int d = 0; d < 3; ++d) v[d] += s.h * x[d];
}

// The gradient of the acceleration of anchor i in the substep that ended in `state`.
template <typename T>
GSIM3D_HD void pull_gradient(const SpringScene<T>& s, const T* state, const T* grad, int64_t i, T* pulls) {
  T x[3], v[3];
  for (int d = 0; d < 3; ++d) {
    x[d] = grad[3 * i + d];
    v[d] = grad[3 * (s.n + i) + d];
  }
  contact_vjp(s, i, state[3 * i + 2], x, v);
  for (int d = 0; d < 3; ++d) pulls[3 * i + d] = s.h * v[d];
}

// Takes grads.state of anchor i from `next` to `state`, given the sums of add_pulls_vjp.
template <typename T>
GSIM3D_HD void finish_substep_vjp(const SpringScene<T>& s, const T* state, const T* next, int64_t i, const T sums[9],
                                  const SpringGradients<T>& grads) {
  T x[3], v[3];
  for (int d = 0; d < 3; ++d) {
    x[d] = grads.state[3 * i + d];
    v[d] = grads.state[3 * (s.n + i) + d];
  }
  if (next[3 * i + 2] <= s.ground)
    for (int d = 0; d < 2; ++d)
      grads.grip[i] += v[d] * (state[3 * (s.n + i) + d] + s.h * (sums[d] + s.external[3 * i + d]));
  contact_vjp(s, i, next[3 * i + 2], x, v);
  for (int d = 0; d < 3; ++d) {
    grads.external[3 * i + d] += s.h * v[d];
    grads.state[3 * i + d] = x[d] + sums[3 + d];
    grads.state[3 * (s.n + i) + d] = v[d] + sums[6 + d];
  }
}

}  // namespace gsim3d::springs
