"""Codes along four curves and their order, against plain torch."""

import torch
from harness import Bench

from gsim3d.ops import CURVES, curve_encode, curve_sort

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
    inverse = torch.empty_like(order).scatter_(1, order, torch.arange(codes.shape[1]).expand_as(order).contiguous())
    return order, inverse


def ours(grid, cloud):
    codes = torch.stack([curve_encode(grid, cloud, curve) for curve in CURVES])
    return codes, curve_sort(codes)


def plain(grid, cloud):
    codes = torch.stack([plain_code(grid, cloud, curve) for curve in CURVES])
    return codes, plain_sort(codes)


def surface(n_clouds, rows, seed=0):
    """Points on wavy sheets a metre wide: what depth maps see."""
    generator = torch.Generator().manual_seed(seed)
    xy = torch.rand(n_clouds * rows, 2, generator=generator)
    return torch.cat([xy, 0.3 + 0.1 * torch.sin(6 * xy.sum(1, keepdim=True))], 1)


def main():
    bench = Bench("curve")
    for n in (65536, 262144):
        grid = torch.floor(surface(4, n // 4) / 0.004).long()
        cloud = torch.arange(4).repeat_interleave(n // 4)
        codes = ours(grid, cloud)[0]
        bench.compare(f"4 codes of {n // 1024}k points", lambda: ours(grid, cloud)[0], lambda: plain(grid, cloud)[0])
        bench.compare(f"4 sorts and inverses of {n // 1024}k", lambda: curve_sort(codes), lambda: plain_sort(codes))
        bench.compare(f"4 codes, sorts, inverses of {n // 1024}k", lambda: ours(grid, cloud), lambda: plain(grid, cloud))
    bench.finish()


if __name__ == "__main__":
    main()
