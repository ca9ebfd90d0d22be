// Space-filling curves as integer arithmetic: host, device and compile time.
//
// A code holds 3 bits a level, 16 levels at most. All four curves have the prefix property: code >> 3 is the code of
// cell >> 1 at depth - 1, so pooling by 2 is a shift. "trans" curves exchange x and y.
#pragma once

#include <cstdint>
#include <initializer_list>

#include "gsim3d/core/platform.h"

namespace gsim3d {

enum class Curve : int { kZ = 0, kZTrans = 1, kHilbert = 2, kHilbertTrans = 3 };

constexpr int kCurves = 4;
constexpr int kMaxDepth = 16;  // bits an axis; cells lie in [0, 2^16)

// Bit i of v (16 bits) moves to bit 3 i.
constexpr GSIM3D_HD uint64_t spread_bits(uint64_t v) {
  v = (v | (v << 16)) & 0x0000ff0000ffull;
  v = (v | (v << 8)) & 0x00f00f00f00full;
  v = (v | (v << 4)) & 0x0c30c30c30c3ull;
  v = (v | (v << 2)) & 0x249249249249ull;
  return v;
}

// Every triple of bits holds one bit of a, b, c, from high to low.
constexpr GSIM3D_HD uint64_t interleave(uint32_t a, uint32_t b, uint32_t c) {
  return (spread_bits(a) << 2) | (spread_bits(b) << 1) | spread_bits(c);
}

// Binary number of a Gray code: bit i is the parity of bits i and above.
constexpr GSIM3D_HD uint64_t gray_to_binary(uint64_t v) {
  v ^= v >> 1;
  v ^= v >> 2;
  v ^= v >> 4;
  v ^= v >> 8;
  v ^= v >> 16;
  v ^= v >> 32;
  return v;
}

// One level of Skilling's transform (AIP Conf. Proc. 707, 2004), which turns the axes into the transposed Hilbert index
// from the highest level down: an axis whose bit is set inverts the lower bits of the first axis, otherwise it swaps
// them with its own.
constexpr GSIM3D_HD void transpose_level(uint32_t& a, uint32_t& b, uint32_t& c, int level) {
  const uint32_t low = (1u << level) - 1;
  a ^= low & (0u - ((a >> level) & 1u));
  const uint32_t set_b = 0u - ((b >> level) & 1u);
  const uint32_t swap_b = (a ^ b) & low & ~set_b;
  a ^= (low & set_b) | swap_b;
  b ^= swap_b;
  const uint32_t set_c = 0u - ((c >> level) & 1u);
  const uint32_t swap_c = (a ^ c) & low & ~set_c;
  a ^= (low & set_c) | swap_c;
  c ^= swap_c;
}

constexpr GSIM3D_HD uint64_t z_code(uint32_t a, uint32_t b, uint32_t c) { return interleave(a, b, c); }

// Depends on depth: equal for depth and depth + 3, different in between.
constexpr GSIM3D_HD uint64_t hilbert_code(uint32_t a, uint32_t b, uint32_t c, int depth) {
  for (int level = depth - 1; level > 0; --level) transpose_level(a, b, c, level);
  return gray_to_binary(interleave(a, b, c));
}

constexpr GSIM3D_HD uint64_t curve_code(Curve curve, uint32_t x, uint32_t y, uint32_t z, int depth) {
  switch (curve) {
    case Curve::kZ: return z_code(x, y, z);
    case Curve::kZTrans: return z_code(y, x, z);
    case Curve::kHilbert: return hilbert_code(x, y, z, depth);
    case Curve::kHilbertTrans: return hilbert_code(y, x, z, depth);
  }
  return 0;
}

// A broken bit trick does not compile.
namespace proof {

constexpr bool spreads_every_bit() {
  for (int i = 0; i < kMaxDepth; ++i)
    if (spread_bits(uint64_t{1} << i) != uint64_t{1} << (3 * i)) return false;
  return spread_bits(0xffff) == 0x249249249249ull;
}
static_assert(spreads_every_bit());
static_assert(z_code(1, 0, 0) == 4 && z_code(0, 1, 0) == 2 && z_code(0, 0, 1) == 1);
static_assert(curve_code(Curve::kZTrans, 1, 0, 0, 16) == 2);
static_assert(gray_to_binary(0b110) == 0b100 && gray_to_binary(0b10000) == 0b11111);

// A Hilbert curve visits every cell of a cube once and moves to a face neighbour each time.
template <int depth>
constexpr bool visits_neighbours(Curve curve) {
  constexpr int side = 1 << depth, cells = side * side * side;
  int at[cells] = {};
  for (int i = 0; i < cells; ++i) at[i] = -1;
  for (int i = 0; i < cells; ++i) {
    const uint64_t code = curve_code(curve, i / (side * side), i / side % side, i % side, depth);
    if (code >= cells || at[code] >= 0) return false;
    at[code] = i;
  }
  for (int i = 1; i < cells; ++i) {
    int distance = 0;
    for (int step : {1, side, side * side}) {
      const int d = at[i] / step % side - at[i - 1] / step % side;
      distance += d < 0 ? -d : d;
    }
    if (distance != 1) return false;
  }
  return true;
}
static_assert(visits_neighbours<1>(Curve::kHilbert) && visits_neighbours<2>(Curve::kHilbert));
static_assert(visits_neighbours<3>(Curve::kHilbert) && visits_neighbours<3>(Curve::kHilbertTrans));

constexpr bool prefixes_hold() {
  uint32_t state = 1;
  for (int i = 0; i < 64; ++i) {
    uint32_t cell[3] = {};
    for (uint32_t& v : cell) v = (state = state * 1664525u + 1013904223u) >> 16;
    for (int curve = 0; curve < kCurves; ++curve)
      for (int k = 1; k < kMaxDepth; k += 4)
        if (curve_code(Curve(curve), cell[0], cell[1], cell[2], kMaxDepth) >> (3 * k) !=
            curve_code(Curve(curve), cell[0] >> k, cell[1] >> k, cell[2] >> k, kMaxDepth - k))
          return false;
  }
  return true;
}
static_assert(prefixes_hold());

}  // namespace proof

}  // namespace gsim3d
