// Features of the sweep as halves: a row for each pixel, and fragments of tiles.
#pragma once

#include "gsim3d/core/overlap.cuh"
#include "gsim3d/plane_sweep/plane_sweep_tile.cuh"

namespace gsim3d::cuda {
namespace {

// A 16 x 16 matrix of halves as multiply_add takes it: four pairs of a lane side by side.
constexpr int kFragment = 8 * kWarp;

// Features as halves, and what their scales are undone by.
struct SweepHalves {
  const __half* rows;     // [n_images, n_pixels, 2, channels], high and low
  const __half* tiles;    // [n_images, n_tiles, channels / 16, 2, 2, kFragment]: high, low; 16 channels x 16 pixels
  const float* inverses;  // [n_images]
};

// largest[image, part]: bits of the largest finite magnitude among the values of a part of the image.
__global__ void __launch_bounds__(512) largest_kernel(const float* __restrict__ values, int64_t n /* of an image */,
                                                      uint32_t* __restrict__ largest) {
  __shared__ uint32_t shared[16];
  let_next_begin();
  uint32_t own = 0;
  values += int64_t{blockIdx.x / kParts} * n;
  constexpr int64_t step = int64_t{kParts} * 512;
  constexpr int kLoads = 8;
  for (int64_t first = blockIdx.x % kParts * 512 + threadIdx.x; first < n; first += kLoads * step) {
    uint32_t loaded[kLoads];
#pragma unroll
    for (int load = 0; load < kLoads; ++load)
      loaded[load] = first + load * step < n ? __float_as_uint(values[first + load * step]) & 0x7fffffffu : 0;
#pragma unroll
    for (int load = 0; load < kLoads; ++load)
      if (loaded[load] < 0x7f800000u) own = max(own, loaded[load]);
  }
  own = __reduce_max_sync(kFullWarp, own);
  if (threadIdx.x % kWarp == 0) shared[threadIdx.x / kWarp] = own;
  __syncthreads();
  if (threadIdx.x >= kWarp) return;
  own = __reduce_max_sync(kFullWarp, threadIdx.x < 16 ? shared[threadIdx.x] : 0);
  if (threadIdx.x == 0) largest[blockIdx.x] = own;
}

// A block takes 32 channels of a tile of [n_images, channels, n_pixels]. tiles: null where they are not wanted.
__global__ void __launch_bounds__(kTileThreads)
    to_halves_kernel(const float* __restrict__ features, int64_t channels, TileSizes s,
                     const uint32_t* largest /* still written when this begins */, float* __restrict__ inverses,
                     __half* __restrict__ rows, __half* __restrict__ tiles) {
  __shared__ float held[32][kTile + 1];
  const int64_t image = blockIdx.x / s.n_tiles;
  const int32_t tile = blockIdx.x % s.n_tiles, first = blockIdx.y * 32;
  const int lane = threadIdx.x % kWarp, eighth = threadIdx.x % 8 * 4, row = threadIdx.x / 8;
  const TilePixel pixel(tile, s);
  let_next_begin();
  for (int c = threadIdx.x / kWarp; c < 32; c += kTileWarps) {
    const bool here = pixel.here && first + c < channels;
    const int64_t plane = image * channels + first + c;
    held[c][lane] = here ? features[plane * s.n_pixels + pixel.v * s.width + pixel.u] : 0.0f;
  }
  wait_for_previous();
  const HalfScale scale(largest_of(largest + image * kParts));
  if (tile == 0 && first == 0 && threadIdx.x == 0) inverses[image] = scale.inverse;
  __syncthreads();
  const auto halves = [&](float x, float y) { return Halves(x * scale.scale, y * scale.scale); };
  const int32_t u = tile % s.columns * kTileWidth + row % kTileWidth;
  const int32_t v = tile / s.columns * kTileHeight + row / kTileWidth;
  if (u < s.width && v < s.height) {
    const Halves a = halves(held[eighth][row], held[eighth + 1][row]);
    const Halves b = halves(held[eighth + 2][row], held[eighth + 3][row]);
    __half* to = rows + (image * s.n_pixels + v * s.width + u) * 2 * s.channels + first + eighth;
    *reinterpret_cast<uint2*>(to) = make_uint2(a.high, b.high);
    *reinterpret_cast<uint2*>(to + s.channels) = make_uint2(a.low, b.low);
  }
  // Pixels 8 t + 4 i + .. of the tile stand for columns 2 t, 2 t + 1, 2 t + 8 and 2 t + 9 of fragment i.
  if (tiles && threadIdx.x < 4 * kWarp) {
    const int part = threadIdx.x / kWarp, fragment = part % 2;
    const int c = part / 2 * 16 + lane / 4, p = lane % 4 * 8 + fragment * 4;
    const Halves a = halves(held[c][p], held[c][p + 1]), b = halves(held[c + 8][p], held[c + 8][p + 1]);
    const Halves d = halves(held[c][p + 2], held[c][p + 3]), e = halves(held[c + 8][p + 2], held[c + 8][p + 3]);
    const int64_t sixteenth = ((image * s.n_tiles + tile) * s.channels + first) / 16 + part / 2;
    uint4* to = reinterpret_cast<uint4*>(tiles) + (sixteenth * 4 + fragment) * kWarp + lane;
    to[0] = make_uint4(a.high, b.high, d.high, e.high);
    to[2 * kWarp] = make_uint4(a.low, b.low, d.low, e.low);
  }
}

// Halves of the features, and on demand tile by tile.
SweepHalves make_halves(const char* op, const float* features, const PlaneSweep<float>& sweep, const TileSizes& s,
                        bool with_tiles, const Workspace& workspace, Stream stream) {
  uint32_t* largest = workspace.take<uint32_t>(sweep.n_images * kParts);
  float* inverses = workspace.take<float>(sweep.n_images);
  __half* rows = workspace.take<__half>(sweep.n_images * s.n_pixels * 2 * s.channels);
  __half* tiles = with_tiles ? workspace.take<__half>(sweep.n_images * s.n_tiles * kTile * 2 * s.channels) : nullptr;
  launch(op, largest_kernel, blocks_for(op, sweep.n_images * kParts, 1), 512, 0, stream, features,
         sweep.channels * s.n_pixels, largest);
  launch_overlapping(op, to_halves_kernel,
                     dim3(blocks_for(op, sweep.n_images * s.n_tiles, 1), static_cast<unsigned>(s.channels / 32)),
                     kTileThreads, 0, stream, features, sweep.channels, s, largest, inverses, rows, tiles);
  return {rows, tiles, inverses};
}

}  // namespace
}  // namespace gsim3d::cuda
