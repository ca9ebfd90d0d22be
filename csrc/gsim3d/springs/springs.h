// Anchors of mass 1 on springs: substeps of semi-implicit Euler above a ground.
//
// An anchor feels the springs of its own list; the graph is directed. Every sum belongs to one anchor or spring and runs
// in the order of the lists: equal bits for any number of threads. T is float or double.
//
// Of n substeps the states after every sqrt(n)-th are kept; the backward pass computes those between them again.
#pragma once

#include <cstdint>

#include "gsim3d/core/parallel.h"
#include "gsim3d/core/platform.h"
#include "gsim3d/core/stream.h"
#include "gsim3d/core/workspace.h"

namespace gsim3d {

// A state is [2, n, 3]: positions (m) and velocities (m/s).
template <typename T>
struct SpringScene {
  const int64_t* neighbors;   // [n_springs], the anchor that a spring pulls its own towards
  const int64_t* cu_springs;  // [n + 1]
  const T *lengths, *stiffness, *damping;  // [n_springs] at rest in m, 1/s^2, 1/s
  const T *grip, *external;                // [n] factor of tangential velocity on the ground, [n, 3] m/s^2
  int64_t n, n_springs, substeps;
  T h, ground, power;  // s of a substep, m (-inf: there is none), exponent of the hardening

  GSIM3D_HD int64_t state_size() const { return 6 * n; }
};

// The same springs by the anchor they end at.
struct SpringSources {
  const int64_t *sources, *cu_sources;  // [n_springs] numbers of springs, [n + 1]
};

// Substeps between two states that are kept.
inline int64_t spring_interval(int64_t substeps) {
  int64_t interval = 1;
  while (interval * interval < substeps) ++interval;
  return interval;
}

// Where the state before substep t is. The forward pass writes all but `first`; the backward pass only `between`.
template <typename T>
struct SpringStates {
  T *first, *kept, *last, *between;  // a state; [(substeps - 1) / interval]; a state; [interval - 1]
  int64_t substeps, interval, size;

  GSIM3D_HD T* at(int64_t t) const {
    if (t == 0) return first;
    if (t == substeps) return last;
    return t % interval ? between + (t % interval - 1) * size : kept + (t / interval - 1) * size;
  }
};

template <typename T>
struct SpringGradients {
  T* state;  // in: of the last state; out: of the first
  T *lengths, *stiffness, *damping, *grip, *external;
};

namespace cpu {

// Throws ArgumentError unless lists and lengths are well formed. `op` starts the message.
template <typename T>
void check_springs(const char* op, const SpringScene<T>& scene, const SpringSources& sources);

template <typename T>
void advance_springs(const SpringScene<T>& scene, const SpringStates<T>& states, const Parallel& parallel);

template <typename T>
void advance_springs_vjp(const SpringScene<T>& scene, const SpringSources& sources, const SpringStates<T>& states,
                         const SpringGradients<T>& grads, const Workspace& workspace, const Parallel& parallel);

}  // namespace cpu

// The same on the device of `stream`, one launch each. Springs whose numbers are out of range take no part.
namespace cuda {

template <typename T>
void advance_springs(const SpringScene<T>& scene, const SpringStates<T>& states, Stream stream);

template <typename T>
void advance_springs_vjp(const SpringScene<T>& scene, const SpringSources& sources, const SpringStates<T>& states,
                         const SpringGradients<T>& grads, const Workspace& workspace, Stream stream);

}  // namespace cuda

}  // namespace gsim3d
