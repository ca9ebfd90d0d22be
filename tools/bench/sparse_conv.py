"""Sparse convolution over occupied cells, against the faster of two plain torch forms."""

import time

import torch
from harness import Bench, with_gradients

from gsim3d.ops import KernelMap, PyramidSpec, Voxels, build_pyramid, sparse_conv

KERNEL, TAPS = 3, 27


def occupied_cells(n: int, neighbours: float, seed: int = 0) -> tuple[Voxels, KernelMap]:
    """Geometry of n rows, one a cell, with about that many occupied cells among the 26 around each."""
    generator = torch.Generator().manual_seed(seed)
    side = round((n * (TAPS - 1) / neighbours) ** (1 / 3))
    cells = torch.randperm(side**3, generator=generator)[:n]
    grid = torch.stack([cells // side**2, cells // side % side, cells % side], 1)
    spec = PyramidSpec(1.0, 0, (), (), (1024,), ((KERNEL,),))
    zero = torch.zeros(1, dtype=torch.int64)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    stage = build_pyramid(grid + 0.5, torch.tensor([0, n]), zero, zero, origin, spec).stages[0]
    return stage.voxels, stage.kernel_maps[KERNEL]


def gather_multiply_scatter(voxels, kernel_map):
    """Per tap: index_select, mm, index_add."""
    rows, cu = voxels.rows, kernel_map.cu_taps.tolist()
    inputs, outputs = rows[kernel_map.tap_in], rows[kernel_map.tap_out]

    def plain(x, weight, bias):
        taps = weight.permute(1, 2, 3, 4, 0).reshape(TAPS, x.shape[1], -1)
        out = torch.addmm(bias, x, taps[TAPS // 2])
        for t in range(TAPS):
            pairs = slice(cu[t], cu[t + 1])
            if cu[t] < cu[t + 1]:
                out.index_add_(0, outputs[pairs], x.index_select(0, inputs[pairs]) @ taps[t])
        return out

    return plain


def gather_all_multiply(voxels, kernel_map):
    """One index_select of the neighbours of all taps (a zero row where there is none), one mm."""
    n, rows = len(voxels.rows), voxels.rows
    counts = kernel_map.cu_taps.diff()
    tap = torch.repeat_interleave(torch.arange(TAPS), counts)
    table = torch.full((n, TAPS), n)
    table[rows[kernel_map.tap_out], tap] = rows[kernel_map.tap_in]
    table[:, TAPS // 2] = torch.arange(n)
    table = table.reshape(-1)

    def plain(x, weight, bias):
        padded = torch.cat([x, x.new_zeros(1, x.shape[1])])
        return torch.addmm(bias, padded.index_select(0, table).reshape(n, -1), weight.reshape(weight.shape[0], -1).T)

    return plain


def seconds(f, repeats: int = 3) -> float:
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        f()
        best = min(best, time.perf_counter() - start)
    return best


def main():
    bench = Bench("sparse_conv")
    for n, channels, neighbours in (
        (16384, 64, 2),
        (16384, 64, 10),
        (16384, 128, 2),
        (16384, 128, 10),
        (4096, 256, 10),
    ):
        voxels, kernel_map = occupied_cells(n, neighbours)
        generator = torch.Generator().manual_seed(1)
        x = torch.randn(n, channels, generator=generator)
        weight = torch.randn(channels, KERNEL, KERNEL, KERNEL, channels, generator=generator) / (TAPS * channels) ** 0.5
        inputs = [x, weight, torch.randn(channels, generator=generator)]

        def ours(x, weight, bias):
            return sparse_conv(x, weight, bias, voxels, kernel_map)

        forms = [form(voxels, kernel_map) for form in (gather_multiply_scatter, gather_all_multiply)]
        title = f"{n // 1024}k x {channels}, {len(kernel_map.tap_in) / n:.1f} neighbours"
        plain = min(forms, key=lambda f: seconds(lambda: f(*inputs)))
        bench.compare(f"{title}: fwd", lambda: ours(*inputs), lambda: plain(*inputs))
        runs = with_gradients(inputs, ours, *forms)
        bench.compare(f"{title}: fwd+bwd", runs[0], min(runs[1:], key=seconds))
    bench.finish()


if __name__ == "__main__":
    main()
