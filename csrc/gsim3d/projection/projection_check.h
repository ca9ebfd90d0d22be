// What both backends check of the arguments before they start: all that needs no look at the data.
#pragma once

#include <cmath>
#include <type_traits>

#include "gsim3d/core/check.h"
#include "gsim3d/projection/projection.h"

namespace gsim3d::projection {

template <typename T>
void check_options(const ProjectionScene<T>& s) {
  constexpr const char* kOp = "project_gaussians";
  check(s.width >= 1 && s.height >= 1, kOp, ": width and height must be positive; got ", s.width, " and ", s.height);
  check(s.near_plane >= 0 && s.far_plane > s.near_plane, kOp,
        ": near_plane must not be negative and far_plane must be beyond it; got ", s.near_plane, " and ", s.far_plane);
  check(std::isfinite(s.dilation) && s.dilation >= 0, kOp, ": dilation must not be negative; got ", s.dilation);
  check(std::isfinite(s.radius_clip), kOp, ": radius_clip must be finite; got ", s.radius_clip);
  const auto lens = static_cast<int64_t>(s.lens);
  check(lens >= 0 && lens <= 3, kOp, ": lens must be 0 (pinhole), 1 (orthographic), 2 (opencv) or 3 (fisheye); got ",
        lens);
}

// Calls f(std::integral_constant<int, terms>).
template <typename F>
void dispatch_terms(int64_t terms, const F& f) {
  switch (terms) {
    case 1: return f(std::integral_constant<int, 1>{});
    case 4: return f(std::integral_constant<int, 4>{});
    case 9: return f(std::integral_constant<int, 9>{});
    case 16: return f(std::integral_constant<int, 16>{});
    case 25: return f(std::integral_constant<int, 25>{});
    default: check(false, "sh_to_color: sh must have 1, 4, 9, 16 or 25 coefficients (degree 0 to 4); got ", terms);
  }
}

}  // namespace gsim3d::projection
