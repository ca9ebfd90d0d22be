// Inside of the CUDA rasterizer: from records to the tiles and quarters that they touch.
#pragma once

#include "gsim3d/raster/raster_fast.cuh"
#include "gsim3d/raster/raster_lists.cuh"

namespace gsim3d::raster {

// The ellipse in which a record's alpha counts. It errs outwards only.
template <typename T>
struct Ellipse {
  T x, y;         // centre, counted from the first pixel's
  T slope;        // of the line through the centres of its rows
  T most, decay;  // a row is reached by sqrt(most - decay dy^2) on both sides of that line
  T turn;         // dy of the rightmost point
  T slack;

  Ellipse() = default;
  __device__ explicit Ellipse(const Record<T>& r) : x(r.x - T(0.5)), y(r.y - T(0.5)), slope(r.slope) {
    constexpr double kLog2MaxRatio = 7.994353436858858;  // log2(255)
    const T inverse = fast_reciprocal(r.tight * r.tight);
    most = (r.strength + T(kLog2MaxRatio + kLevelSlack)) * inverse;
    decay = r.loose * r.loose * inverse;
    const T scale = decay * (slope * slope + decay);
    turn = slope * fast_sqrt(most * fast_reciprocal(scale));
    slack = T(1e-6) * (abs_of(slope * turn) + abs_of(x) + fast_sqrt(most)) + T(kPixelSlack);
    constexpr T kHuge = T(1e30);  // of what cannot be computed nothing is left out
    if (!(most < kHuge && scale < kHuge && scale > 1 / kHuge)) turn = 0, slack = kHuge;
  }

  // Of the quarters of tile (tile_x, tile_y) in `quarters`, those that it touches.
  __device__ uint32_t touched(uint32_t quarters, int tile_x, int tile_y) const {
    const T left_column = T(tile_x * kTile);
#pragma unroll
    for (int row = 0; row < 2; ++row) {
      const T top = T(tile_y * kTile + row * kQuarter) - y, bottom = top + T(kQuarter - 1);
      const T right_dy = fmin(fmax(turn, top), bottom), left_dy = fmin(fmax(-turn, top), bottom);
      const T right = slope * right_dy + x + reach(right_dy), left = slope * left_dy + x - reach(left_dy);
      if (right < left_column || left > left_column + T(kQuarter - 1)) quarters &= ~(1u << 2 * row);
      if (right < left_column + T(kQuarter) || left > left_column + T(kTile - 1)) quarters &= ~(2u << 2 * row);
    }
    return quarters;
  }

 private:
  __device__ T reach(T dy) const { return fast_sqrt(fmax(most - decay * dy * dy, T(0))) + slack; }
};

// What a lane tells the others of its record: where its tiles are, and `Load`.
template <typename Load>
struct Walked {
  uint32_t begin;           // tiles of the records before
  uint32_t by_width;        // 2^32 / tiles in a row, a little less
  uint16_t x0, x1, y0, y1;  // quarters
  Load load;
};
struct Nothing {};

// The tiles of 32 records, shared evenly among the lanes of their warp: one step gives each lane a tile. All lanes
// take part. `memory`: of the warp.
template <typename Load>
class WarpTiles {
 public:
  int total;

  __device__ WarpTiles(const PixelRect& bounds, Walked<Load>* memory)
      : memory_(memory), tiles_(squares_of(bounds, kTile)), quarters_(squares_of(bounds, kQuarter)) {
    const int n = tiles_.count(), end = warp_sum(n);
    total = __shfl_sync(kFullWarp, end, kWarp - 1);
    begin_ = n > 0 ? static_cast<uint32_t>(end - n) : ~0u;
  }

  // Before the first at().
  __device__ void share(const Load& load) {
    constexpr float kBelow = 4294966016.0f;  // 2^32 less the error of the quotient
    const bool filled = begin_ != ~0u;
    const unsigned all_filled = __ballot_sync(kFullWarp, filled);
    const auto by_width = static_cast<uint32_t>(kBelow * fast_reciprocal(static_cast<float>(tiles_.x1 - tiles_.x0)));
    __syncwarp();
    if (filled)
      memory_[__popc(all_filled & ((1u << threadIdx.x % kWarp) - 1))] = {
          begin_, by_width, static_cast<uint16_t>(quarters_.x0), static_cast<uint16_t>(quarters_.x1),
          static_cast<uint16_t>(quarters_.y0), static_cast<uint16_t>(quarters_.y1), load};
    __syncwarp();
  }

  struct Place {
    bool used;
    const Walked<Load>* owner;
    int x, y;
    uint32_t quarters;  // of the tile, that the bounds touch
  };
  // Of place base + lane; base grows by 32 from call to call.
  __device__ Place at(int base) {
    const int lane = threadIdx.x % kWarp;
    const uint32_t offset = begin_ - static_cast<uint32_t>(base);
    const unsigned begins = __reduce_or_sync(kFullWarp, offset < kWarp ? 1u << offset : 0u);
    const Walked<Load>* owner = memory_ + n_begun_ + __popc(begins & (~0u >> (kWarp - 1 - lane))) - 1;
    n_begun_ += __popc(begins);
    const Squares quarters{owner->x0, owner->x1, owner->y0, owner->y1};
    const bool used = base + lane < total;
    const uint32_t place = used ? base + lane - owner->begin : 0, width = (quarters.x1 + 1) / 2 - quarters.x0 / 2;
    uint32_t row = __umulhi(place, owner->by_width), column = place - row * width;
    if (column >= width) column -= width, ++row;
    const int x = quarters.x0 / 2 + static_cast<int>(column), y = quarters.y0 / 2 + static_cast<int>(row);
    return {used, owner, x, y, used ? quarters_of_tile(quarters, x, y) : 0};
  }

  // Whether the Gaussians touch many tiles each. Then it pays to look at their ellipses, and hardly any lanes have an
  // entry of the same tile; if not, the ellipses would spare hardly any quarter.
  __device__ bool many() const { return total > 3 * kWarp; }
  // Lanes with the same tile as the calling one; of many only itself, since to find the few others costs more.
  __device__ unsigned lanes_of(uint32_t tile, bool used) const {
    if (many()) return used ? 1u << threadIdx.x % kWarp : 0;
    const unsigned same = __match_any_sync(kFullWarp, used ? tile : ~0u);
    return used ? same : 0;
  }

 private:
  Walked<Load>* memory_;
  Squares tiles_, quarters_;
  uint32_t begin_;
  int n_begun_ = 0;
};

}  // namespace gsim3d::raster
