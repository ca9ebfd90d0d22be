// Voxels, convolution maps and attention patches of one stage.
#include <algorithm>
#include <vector>

#include "gsim3d/curve/curve.h"
#include "gsim3d/curve/pyramid.h"

namespace gsim3d::cpu {
namespace {

constexpr int64_t kRowGrain = 16384;
constexpr int64_t kVoxelChunk = 4096;  // voxels whose neighbours one task looks up
constexpr uint64_t kAxisMask = 0xffff;

// A voxel and its neighbour at a tap; 32 bits suffice because radix_sort takes fewer than 2^32 rows.
struct Pair {
  uint32_t tap, voxel, neighbour;
};

uint64_t voxel_key(int64_t cloud, const int64_t* cell) {
  return static_cast<uint64_t>(cloud) << 48 | static_cast<uint64_t>(cell[0]) << 32 |
         static_cast<uint64_t>(cell[1]) << 16 | static_cast<uint64_t>(cell[2]);
}

// Calls found(p, neighbour, kz) for every voxel p in [begin, end) and every occupied cell at (dx, dy, kz - radius) from
// it with kz < kz_end. Keys ascend, so the column of cells that p reads moves forward with p and one cursor serves all.
template <typename F>
void sweep_column(const VoxelKeys& voxels, int64_t begin, int64_t end, int64_t dx, int64_t dy, int64_t radius,
                  int64_t kz_end, const F& found) {
  const uint64_t* keys = voxels.keys;
  const uint64_t step = (static_cast<uint64_t>(dx) << 32) + (static_cast<uint64_t>(dy) << 16);
  const int64_t top = static_cast<int64_t>(kAxisMask);
  int64_t cursor = -1;
  for (int64_t p = begin; p < end; ++p) {
    const int64_t x = static_cast<int64_t>(keys[p] >> 32 & kAxisMask) + dx;
    const int64_t y = static_cast<int64_t>(keys[p] >> 16 & kAxisMask) + dy;
    if (x < 0 || x > top || y < 0 || y > top) continue;
    const int64_t z = static_cast<int64_t>(keys[p] & kAxisMask), last = std::min(z - radius + kz_end - 1, top);
    if (last < 0) continue;
    const uint64_t column = (keys[p] & ~kAxisMask) + step;
    const uint64_t low = column + static_cast<uint64_t>(std::max<int64_t>(z - radius, 0));
    const uint64_t high = column + static_cast<uint64_t>(last);
    if (cursor < 0) cursor = std::lower_bound(keys, keys + voxels.n, low) - keys;
    while (cursor < voxels.n && keys[cursor] < low) ++cursor;
    for (int64_t q = cursor; q < voxels.n && keys[q] <= high; ++q)
      found(p, q, static_cast<int64_t>(keys[q] & kAxisMask) - z + radius);
  }
}

// Calls found(tap, p, neighbour) for the taps before the centre.
template <typename F>
void sweep_first_half(const VoxelKeys& voxels, int64_t begin, int64_t end, int64_t kernel_size, const F& found) {
  const int64_t radius = kernel_size / 2;
  for (int64_t column = 0; column <= radius * kernel_size + radius; ++column) {
    const bool centre = column == radius * kernel_size + radius;
    if (centre && radius == 0) continue;
    sweep_column(voxels, begin, end, column / kernel_size - radius, column % kernel_size - radius, radius,
                 centre ? radius : kernel_size,
                 [&](int64_t p, int64_t q, int64_t kz) { found(column * kernel_size + kz, p, q); });
  }
}

}  // namespace

VoxelKeys append_voxels(const int64_t* grid, const int64_t* cloud, int64_t n, const Arrays& arrays,
                        const Workspace& workspace, const Parallel& parallel) {
  uint64_t* keys = workspace.take<uint64_t>(n);
  uint64_t* sorted = workspace.take<uint64_t>(n);
  parallel.range(n, kRowGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) keys[i] = voxel_key(cloud[i], grid + 3 * i);
  });
  int64_t* row_voxel = arrays.append({n});
  int64_t* voxel_rows = arrays.append({n});
  radix_sort(&keys, 1, n, &voxel_rows, nullptr, &sorted, workspace, parallel);

  uint64_t* voxel_keys = keys;  // the unsorted keys are not needed any more
  int64_t n_voxels = 0;
  for (int64_t i = 0; i < n; ++i) {
    if (i == 0 || sorted[i] != sorted[i - 1]) voxel_keys[n_voxels++] = sorted[i];
    row_voxel[voxel_rows[i]] = n_voxels - 1;
  }
  int64_t* cu = arrays.append({n_voxels + 1});
  for (int64_t i = 0, v = 0; i < n; ++i)
    if (i == 0 || sorted[i] != sorted[i - 1]) cu[v++] = i;
  cu[n_voxels] = n;
  return {voxel_keys, n_voxels};
}

void append_kernel_map(const VoxelKeys& voxels, int64_t kernel_size, const Arrays& arrays, const Parallel& parallel) {
  const int64_t n_taps = kernel_size * kernel_size * kernel_size, half = n_taps / 2;
  const int64_t n_chunks = (voxels.n + kVoxelChunk - 1) / kVoxelChunk;
  std::vector<std::vector<Pair>> found(static_cast<size_t>(n_chunks));
  std::vector<int64_t> next(static_cast<size_t>(n_chunks * half), 0);  // first counts, then where each chunk writes
  parallel.chunks(n_chunks, [&](int64_t chunk) {
    std::vector<Pair>& pairs = found[chunk];
    pairs.reserve(4 * kVoxelChunk);
    int64_t* count = next.data() + chunk * half;
    sweep_first_half(voxels, chunk * kVoxelChunk, std::min(voxels.n, (chunk + 1) * kVoxelChunk), kernel_size,
                     [&](uint32_t tap, uint32_t p, uint32_t q) {
                       pairs.push_back({tap, p, q});
                       ++count[tap];
                     });
  });

  std::vector<int64_t> cu(static_cast<size_t>(n_taps + 1), 0);
  for (int64_t tap = 0; tap < half; ++tap) {
    int64_t start = cu[tap];
    for (int64_t chunk = 0; chunk < n_chunks; ++chunk) {
      const int64_t count = next[chunk * half + tap];
      next[chunk * half + tap] = start;
      start += count;
    }
    cu[tap + 1] = start;
  }
  cu[half + 1] = cu[half];
  for (int64_t tap = half + 1; tap < n_taps; ++tap) {
    const int64_t mirror = n_taps - 1 - tap;
    cu[tap + 1] = cu[tap] + cu[mirror + 1] - cu[mirror];
  }

  int64_t* tap_in = arrays.append({cu[n_taps]});
  int64_t* tap_out = arrays.append({cu[n_taps]});
  int64_t* cu_taps = arrays.append({n_taps + 1});
  std::copy(cu.begin(), cu.end(), cu_taps);
  // A pair seen from its other end belongs to the mirrored tap; neighbours at one offset ascend with the voxel, so both
  // lists come out ascending.
  parallel.chunks(n_chunks, [&](int64_t chunk) {
    int64_t* to = next.data() + chunk * half;
    for (const auto [tap, p, q] : found[chunk]) {
      const int64_t at = to[tap]++;
      const int64_t mirrored = cu[n_taps - 1 - tap] + at - cu[tap];
      tap_in[at] = q;
      tap_out[at] = p;
      tap_in[mirrored] = p;
      tap_out[mirrored] = q;
    }
  });
}

void append_patches(const int64_t* cu_clouds, int64_t n_clouds, const int64_t* order, int64_t n, int64_t patch_size,
                    const Arrays& arrays) {
  std::vector<int64_t> first_key;  // sorted position of each patch's first key
  std::vector<int64_t> cu_q{0}, cu_k{0};
  for (int64_t c = 0; c < n_clouds; ++c)
    for (int64_t begin = cu_clouds[c]; begin < cu_clouds[c + 1]; begin += patch_size) {
      const int64_t end = std::min(begin + patch_size, cu_clouds[c + 1]);
      first_key.push_back(std::max(cu_clouds[c], end - patch_size));
      cu_q.push_back(end);
      cu_k.push_back(cu_k.back() + end - first_key.back());
    }
  const int64_t n_patches = static_cast<int64_t>(first_key.size()), n_keys = cu_k.back();
  std::copy(cu_q.begin(), cu_q.end(), arrays.append({n_patches + 1}));
  std::copy(cu_k.begin(), cu_k.end(), arrays.append({n_patches + 1}));
  int64_t* kv_rows = arrays.append({4, n_keys});
  for (int64_t r = 0; r < 4; ++r)
    for (int64_t p = 0; p < n_patches; ++p)
      std::copy_n(order + r * n + first_key[p], cu_k[p + 1] - cu_k[p], kv_rows + r * n_keys + cu_k[p]);
}

}  // namespace gsim3d::cpu
