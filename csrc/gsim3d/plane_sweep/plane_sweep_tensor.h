// The float32 sweep on tensor cores, for the CUDA backend.
#pragma once

#include "gsim3d/plane_sweep/plane_sweep.h"

namespace gsim3d::cuda {

// plane_sweep of this namespace. Throws ArgumentError where a tile and its lists do not fit the shared memory of a
// block. A feature that is not finite spoils what it is summed with, and gradients of the pixels of a tile together.
void tensor_sweep(const char* op, const float* features, const PlaneSweep<float>& sweep, float* cost,
                  const Workspace& workspace, Stream stream);

void tensor_sweep_vjp(const char* op, const float* grad, const float* features, const PlaneSweep<float>& sweep,
                      float* grad_features, const Workspace& workspace, Stream stream);

}  // namespace gsim3d::cuda
