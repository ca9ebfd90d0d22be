// What both backends check of the arguments before they start: all that needs no look at the data.
#pragma once

#include <cmath>
#include <type_traits>

#include "gsim3d/core/check.h"
#include "gsim3d/raster/raster.h"

namespace gsim3d::raster {

constexpr int64_t kMaxPixels = 65535;  // pixel bounds of a Gaussian are 16-bit numbers

template <typename T>
void check_options(const RasterScene<T>& s) {
  constexpr const char* kOp = "rasterize_gaussians";
  check(s.width >= 1 && s.height >= 1 && s.width <= kMaxPixels && s.height <= kMaxPixels, kOp,
        ": width and height must be in [1, ", kMaxPixels, "]; got ", s.width, " and ", s.height);
  const int64_t terms = s.sh_terms;
  check(terms == kProjected || terms == 0 || terms == 1 || terms == 4 || terms == 9 || terms == 16, kOp,
        ": sh must have 1, 4, 9 or 16 coefficients (degree 0 to 3); got ", s.sh_terms);
  check(std::isfinite(s.near_plane) && s.near_plane > 0, kOp, ": near_plane must be positive; got ", s.near_plane);
  const auto cutoff = static_cast<int64_t>(s.cutoff);
  check(cutoff >= 0 && cutoff <= 2, kOp, ": cutoff must be 0 (exact), 1 (tile3sigma) or 2 (smooth); got ", cutoff);
  const auto jacobian = static_cast<int64_t>(s.jacobian);
  check(jacobian >= 0 && jacobian <= 1, kOp, ": jacobian must be 0 (exact) or 1 (clamped); got ", jacobian);
}

template <typename T>
void check_limits(const RasterScene<T>& s, const cuda::RasterLimits& limits) {
  constexpr const char* kOp = "rasterize_gaussians";
  constexpr int64_t kMaxPairs = int64_t{1} << 28;
  check(s.n_rows <= kMaxPairs && s.n_images < INT32_MAX, kOp, ": at most 2^28 rows and 2^31 - 2 images; got ", s.n_rows,
        " and ", s.n_images);
  const auto check_range = [kOp](const char* name, int64_t value, int64_t least, int64_t most) {
    check(value >= least && value <= most, kOp, ": ", name, " must be in [", least, ", ", most, "]; got ", value);
  };
  check_range("max_pairs", limits.pairs, s.n_rows, kMaxPairs);
  check_range("max_entries", limits.entries, s.n_rows, INT32_MAX);
  check_range("max_slots", limits.slots, 4 * s.n_rows, INT32_MAX);
}

// Calls f(std::integral_constant<int, terms>) for the number of SH terms of the scene (0: given colours; kProjected).
template <typename F>
void dispatch_sh(int64_t terms, const F& f) {
  switch (terms) {
    case kProjected: return f(std::integral_constant<int, kProjected>{});
    case 0: return f(std::integral_constant<int, 0>{});
    case 1: return f(std::integral_constant<int, 1>{});
    case 4: return f(std::integral_constant<int, 4>{});
    case 9: return f(std::integral_constant<int, 9>{});
    default: return f(std::integral_constant<int, 16>{});
  }
}

}  // namespace gsim3d::raster
