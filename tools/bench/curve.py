"""Codes along four curves, their order, and all geometry of a network call, against plain torch."""

from functools import partial

import torch
from harness import Bench

from gsim3d.ops import CURVES, PyramidSpec, build_pyramid, curve_encode, curve_sort

DEPTH = 16


def spread_bits(v):
    for shift, mask in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        v = (v | (v << shift)) & mask
    return v


def plain_code(grid, cloud, curve):
    """Vectorised over rows: masks and shifts of whole columns."""
    x, y, z = grid.unbind(1)
    axes = [y, x, z] if curve.endswith("trans") else [x, y, z]
    if curve.startswith("hilbert"):
        for level in range(DEPTH - 1, 0, -1):
            low = (1 << level) - 1
            for a in range(3):
                flip = -((axes[a] >> level) & 1)
                swap = (axes[0] ^ axes[a]) & low & ~flip
                first = axes[0] ^ ((low & flip) | swap)
                axes[a] = first if a == 0 else axes[a] ^ swap
                axes[0] = first
    code = (spread_bits(axes[0]) << 2) | (spread_bits(axes[1]) << 1) | spread_bits(axes[2])
    if curve.startswith("hilbert"):
        for shift in (1, 2, 4, 8, 16, 32):
            code = code ^ (code >> shift)
    return (cloud << (3 * DEPTH)) | code


def plain_sort(codes):
    order = torch.argsort(codes, dim=1, stable=True)
    places = torch.arange(codes.shape[1], device=codes.device).expand_as(order).contiguous()
    inverse = torch.empty_like(order).scatter_(1, order, places)
    return order, inverse


def ours(grid, cloud):
    codes = curve_encode(grid, cloud, CURVES)
    return codes, curve_sort(codes)


def plain(grid, cloud):
    codes = torch.stack([plain_code(grid, cloud, curve) for curve in CURVES])
    return codes, plain_sort(codes)


def surface(n_clouds, rows, seed=0):
    """Points on wavy sheets a metre wide: what depth maps see."""
    generator = torch.Generator().manual_seed(seed)
    xy = torch.rand(n_clouds * rows, 2, generator=generator)
    return torch.cat([xy, 0.3 + 0.1 * torch.sin(6 * xy.sum(1, keepdim=True))], 1)


def plain_kernel_map(keys, kernel_size):
    """Pairs of neighbours by binary search in the sorted voxel keys (x, y, z with 17 bits each, one spare)."""
    reach = torch.arange(kernel_size, device=keys.device) - kernel_size // 2
    tap_in, tap_out = [], []
    for offset in ((reach[:, None, None] << 34) + (reach[:, None] << 17) + reach).flatten().tolist():
        wanted = keys + offset
        at = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
        hit = (keys[at] == wanted).nonzero()[:, 0] if offset else keys[:0]
        tap_in.append(at[hit])
        tap_out.append(hit)
    return [torch.cat(tap_in), torch.cat(tap_out)]


def plain_pyramid(grid, spec):
    """Cells, orders, clusters and convolution maps of one cloud whose points have a cell each."""
    results = []
    order, cloud = None, torch.zeros_like(grid[:, 0])
    codes = torch.stack([plain_code(grid, cloud, curve) for curve in CURVES])
    for s, kernel_sizes in enumerate(spec.kernel_sizes):
        if s > 0:
            drop = spec.strides[s - 1].bit_length() - 1
            _, counts = torch.unique_consecutive(codes[0][order[0]] >> (3 * drop), return_counts=True)
            first = order[0][counts.cumsum(0) - counts]
            grid, codes = grid[first] >> drop, codes[:, first] >> (3 * drop)
        order = torch.argsort(codes, dim=1, stable=True)
        keys, voxel_rows = ((grid[:, 0] << 34) + (grid[:, 1] << 17) + grid[:, 2]).sort()
        results += [grid, order, voxel_rows]
        for size in kernel_sizes:
            results += plain_kernel_map(keys, size)
    return results


def our_pyramid(positions, spec):
    offsets, zero = torch.tensor([0, len(positions)]), torch.zeros(1, dtype=torch.int64)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    clouds = [t.to(positions.device) for t in (offsets, zero, zero, origin)]
    results = []
    for stage in build_pyramid(positions, *clouds, spec).stages:
        results += [stage.grid, stage.order, stage.voxels.rows]
        for taps in stage.kernel_maps.values():
            results += [taps.tap_in, taps.tap_out]
    return results


def network_input(spec, n=65536):
    """Positions at the centres of different cells, shuffled."""
    cells = torch.unique(torch.floor(surface(1, n) / spec.grid_size).long(), dim=0)
    cells = cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(0))]
    return ((cells + 0.5) * spec.grid_size).float()


NETWORK = PyramidSpec(0.004, 0, (4, 2, 2, 2), (1, 1, 1, 1), (1024,) * 5, ((5, 3), (3,), (3,), (3,), (3,)))


def cases(device: torch.device):
    """(name, ours, plain, goals on a GPU)"""
    for n in (65536, 262144):
        if device.type == "cuda":
            generator = torch.Generator(device=device).manual_seed(n)
            grid = (torch.rand(n, 3, generator=generator, device=device) * 60000).long()
            cloud = torch.zeros(n, dtype=torch.int64, device=device)
        else:
            grid = torch.floor(surface(4, n // 4) / 0.004).long()
            cloud = torch.arange(4).repeat_interleave(n // 4)
        size = f"{n // 1024}k"
        codes = ours(grid, cloud)[0]
        goals = {"target_ratio": 60, "limit_ms": 0.02 * n / 262144}
        yield f"4 sorts and inverses of {size}", partial(curve_sort, codes), partial(plain_sort, codes), {}
        yield f"4 codes and their sorts, {size} points", partial(ours, grid, cloud), partial(plain, grid, cloud), goals
    positions = network_input(NETWORK).to(device)
    grid = torch.floor(positions.double() / NETWORK.grid_size).long()
    both = partial(our_pyramid, positions, NETWORK), partial(plain_pyramid, grid, NETWORK)
    yield f"geometry of 5 levels, {len(grid)} points", *both, {}


def main():
    bench = Bench("curve")
    for name, run, peer, goals in cases(bench.device):
        if bench.device.type == "cuda":
            bench.gpu(name, "int64", run, {"torch": peer}, tolerance=0, **goals)
        else:
            bench.compare(name, run, peer)
    bench.finish()


if __name__ == "__main__":
    main()
