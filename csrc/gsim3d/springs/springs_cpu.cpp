#include <algorithm>

#include "gsim3d/core/check.h"
#include "gsim3d/springs/springs.h"
#include "gsim3d/springs/springs_math.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kGrain = 32;  // anchors

void check_offsets(const char* op, const char* name, const int64_t* cu, int64_t n, int64_t count) {
  bool ok = cu[0] == 0 && cu[n] == count;
  for (int64_t i = 0; i < n && ok; ++i) ok = cu[i] <= cu[i + 1];
  check(ok, op, ": ", name, " must ascend from 0 to the number of springs, ", count);
}

template <typename T>
void substep(const SpringScene<T>& s, const T* from, T* to, const Parallel& parallel) {
  parallel.range(s.n, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      T pull[3] = {};
      springs::add_pulls(s, from, i, 0, 1, pull);
      springs::finish_substep(s, from, i, pull, to);
    }
  });
}

}  // namespace

template <typename T>
void check_springs(const char* op, const SpringScene<T>& s, const SpringSources& sources) {
  check_offsets(op, "cu_springs", s.cu_springs, s.n, s.n_springs);
  check_offsets(op, "cu_sources", sources.cu_sources, s.n, s.n_springs);
  for (int64_t e = 0; e < s.n_springs; ++e) {
    check(s.neighbors[e] >= 0 && s.neighbors[e] < s.n, op, ": neighbors must be in [0, N) with N=", s.n, "; got ",
          s.neighbors[e]);
    check(s.lengths[e] > T(0), op, ": lengths must be positive; got ", s.lengths[e], " of spring ", e);
  }
  for (int64_t i = 0; i < s.n; ++i)
    for (int64_t p = sources.cu_sources[i]; p < sources.cu_sources[i + 1]; ++p) {
      const int64_t e = sources.sources[p];
      const bool ascends = p == sources.cu_sources[i] || sources.sources[p - 1] < e;
      check(e >= 0 && e < s.n_springs && ascends && s.neighbors[e] == i, op,
            ": sources must list the springs that end at each anchor, ascending, as SpringLists.from_neighbors does; not so at ", p);
    }
}

template <typename T>
void advance_springs(const SpringScene<T>& s, const SpringStates<T>& states, const Parallel& parallel) {
  for (int64_t t = 0; t < s.substeps; ++t) substep(s, states.at(t), states.at(t + 1), parallel);
}

template <typename T>
void advance_springs_vjp(const SpringScene<T>& s, const SpringSources& sources, const SpringStates<T>& states,
                         const SpringGradients<T>& grads, const Workspace& workspace, const Parallel& parallel) {
  const springs::Incoming<T> in = springs::take_incoming(s, sources, workspace);
  parallel.range(s.n_springs, 64 * kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) springs::fill_incoming(s, sources.sources, p, in);
    for (T* sums : {grads.lengths, grads.stiffness, grads.damping}) std::fill(sums + begin, sums + end, T(0));
  });
  std::fill_n(grads.grip, s.n, T(0));
  std::fill_n(grads.external, 3 * s.n, T(0));
  T* pulls = workspace.take<T>(3 * s.n);
  for (int64_t t = s.substeps; t-- > 0;) {
    if (t + 1 == s.substeps || (t + 1) % states.interval == 0)
      for (int64_t u = t - t % states.interval; u < t; ++u) substep(s, states.at(u), states.at(u + 1), parallel);
    const T *state = states.at(t), *next = states.at(t + 1);
    for (int64_t i = 0; i < s.n; ++i) springs::pull_gradient(s, next, grads.state, i, pulls);
    parallel.range(s.n, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        T sums[9] = {};
        springs::add_pulls_vjp(s, in, state, pulls, i, 0, 1, sums, grads);
        springs::finish_substep_vjp(s, state, next, i, sums, grads);
      }
    });
  }
}

#define GSIM3D_INSTANTIATE(T)                                                                            \
  template void check_springs<T>(const char*, const SpringScene<T>&, const SpringSources&);              \
  template void advance_springs<T>(const SpringScene<T>&, const SpringStates<T>&, const Parallel&);      \
  template void advance_springs_vjp<T>(const SpringScene<T>&, const SpringSources&, const SpringStates<T>&, \
                                       const SpringGradients<T>&, const Workspace&, const Parallel&);
GSIM3D_INSTANTIATE(float)
GSIM3D_INSTANTIATE(double)
#undef GSIM3D_INSTANTIATE

}  // namespace gsim3d::cpu
