"""Sparse convolution over occupied cells, against the faster of two plain torch forms; on a GPU also against spconv.

The cases are voxels of a closed surface in random order: "surface" is one voxel thick, as after pooling, with
about 10 occupied cells of 27 around each (itself included); "sparse" has points far apart, as at the finest stage.
"""

import dataclasses
import math

import torch
from harness import Bench

from gsim3d.ops import KernelMap, Voxels, sparse_conv

KERNEL, TAPS = 3, 27


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
    tap = torch.repeat_interleave(torch.arange(TAPS), counts).to(rows.device)
    table = torch.full((n, TAPS), n, device=rows.device)
    table[rows[kernel_map.tap_out], tap] = rows[kernel_map.tap_in]
    table[:, TAPS // 2] = torch.arange(n, device=rows.device)
    table = table.reshape(-1)

    def plain(x, weight, bias):
        padded = torch.cat([x, x.new_zeros(1, x.shape[1])])
        return torch.addmm(bias, padded.index_select(0, table).reshape(n, -1), weight.reshape(weight.shape[0], -1).T)

    return plain


def surface_cells(n: int, kind: str, device: torch.device, seed: int = 3) -> torch.Tensor:
    """int32 [n, 3], no cell twice."""
    generator = torch.Generator(device=device).manual_seed(seed)
    u = torch.nn.functional.normalize(torch.randn(3 * n, 3, generator=generator, device=device), dim=-1)
    radius = math.sqrt(n / (4 * math.pi)) * (0.98 if kind == "surface" else 3.2)
    bumps = 1 + 0.15 * torch.sin(5 * u[:, :1]) * torch.cos(4 * u[:, 1:2])
    cells = (u * radius * bumps).round().int()
    cells = torch.unique(cells - cells.min(0)[0], dim=0)
    while cells.shape[0] < n:
        more = torch.randint(0, int(cells.max()) + 1, (n, 3), generator=generator, device=device, dtype=torch.int32)
        cells = torch.unique(torch.cat([cells, more]), dim=0)
    return cells[torch.randperm(cells.shape[0], generator=generator, device=device)[:n]].contiguous()


def tables_of(cells: torch.Tensor) -> tuple[Voxels, KernelMap]:
    """The geometry of cells without duplicates, by a search among their sorted keys."""
    side = int(cells.max()) + 3
    key = ((cells[:, 0].long() + 1) * side + cells[:, 1] + 1) * side + cells[:, 2] + 1
    keys, rows = torch.sort(key)
    reach = range(-(KERNEL // 2), KERNEL // 2 + 1)
    tap_in, tap_out, counts = [], [], [0]
    for offset in ((x * side + y) * side + z for x in reach for y in reach for z in reach):
        at = torch.searchsorted(keys, keys + offset).clamp_max(len(keys) - 1)
        written = torch.nonzero((keys[at] == keys + offset) & (offset != 0))[:, 0]
        tap_in.append(at[written])
        tap_out.append(written)
        counts.append(counts[-1] + len(written))
    voxels = Voxels(torch.argsort(rows), rows, torch.arange(len(keys) + 1, device=cells.device))
    return voxels, KernelMap(KERNEL, torch.cat(tap_in), torch.cat(tap_out), torch.tensor(counts, device=cells.device))


def with_plan(voxels: Voxels, kernel_map: KernelMap) -> KernelMap:
    """The map with its plan, which all blocks of a stage share, like spconv's cached map."""
    taps = kernel_map.tap_in, kernel_map.tap_out, kernel_map.cu_taps
    plan = torch.ops.gsim3d.sparse_conv_plan(
        voxels.row_voxel, voxels.rows, voxels.cu_rows, *taps, kernel_map.kernel_size
    )
    return dataclasses.replace(kernel_map, plan=plan)


def spconv_form(cells: torch.Tensor, channels: int, dtype: torch.dtype):
    """spconv's SubMConv3d as a function of (x, weight, bias), its map cached; None where spconv cannot do it."""
    if dtype == torch.bfloat16:
        return None
    try:
        import spconv.pytorch as spconv
    except ImportError:
        return None
    conv = spconv.SubMConv3d(channels, channels, KERNEL, bias=True, indice_key="map").cuda().to(dtype)
    indices = torch.cat([torch.zeros(len(cells), 1, dtype=torch.int32, device="cuda"), cells], 1).contiguous()
    shape = (cells.max(0)[0] + 97).tolist()
    values = torch.zeros(len(cells), channels, dtype=dtype, device="cuda")
    cache = conv(spconv.SparseConvTensor(values.requires_grad_(), indices, shape, 1)).indice_dict

    def run(x, weight, bias):
        del conv._parameters["weight"], conv._parameters["bias"]
        conv._parameters.update(weight=weight, bias=bias)
        tensor = spconv.SparseConvTensor(x, indices, shape, 1)
        tensor.indice_dict = cache
        return conv(tensor).features

    return run


CPU_CASES = tuple((n, c, kind, torch.float32) for kind in ("sparse", "surface") for n, c in ((16384, 64), (4096, 256)))
GPU_CASES = (
    (65536, 64, "sparse", torch.float16),
    (65536, 32, "surface", torch.float16),
    (65536, 64, "surface", torch.float16),
    (262144, 128, "surface", torch.float16),
    (16384, 512, "surface", torch.float16),
    (16384, 512, "surface", torch.bfloat16),
    (65536, 64, "surface", torch.float32),
)
GOALS = {  # limit in ms, ratio to spconv
    (65536, 64, "sparse"): (0.004, 10),
    (262144, 128, "surface"): (0.10, 2),
    (16384, 512, "surface"): (0.10, 2),
}


def check(inputs: list[torch.Tensor], ours, plain) -> None:
    """Against float64, at most twice the error of plain torch in the same dtype."""
    with torch.no_grad():
        exact = plain(*(t.double() for t in inputs))
        error, of_plain = (float((f(*inputs).double() - exact).abs().max()) for f in (ours, plain))
    if error > 2 * of_plain:
        raise AssertionError(f"{tuple(inputs[0].shape)}: error {error:.1e}, plain torch {of_plain:.1e}")


def case(bench: Bench, n: int, channels: int, kind: str, dtype: torch.dtype) -> None:
    cells = surface_cells(n, kind, bench.device)
    voxels, kernel_map = tables_of(cells)
    planned = with_plan(voxels, kernel_map) if bench.device.type == "cuda" else kernel_map
    generator = torch.Generator(device=bench.device).manual_seed(channels)
    x = 0.5 * torch.randn(n, channels, generator=generator, device=bench.device)
    weight = torch.randn(channels, KERNEL, KERNEL, KERNEL, channels, generator=generator, device=bench.device)
    inputs = [x, weight / (TAPS * channels) ** 0.5, torch.randn(channels, generator=generator, device=bench.device)]
    inputs = [t.to(dtype) for t in inputs]
    forms = {"torch": gather_multiply_scatter(voxels, kernel_map)}
    if bench.device.type == "cpu":
        forms["one product"] = gather_all_multiply(voxels, kernel_map)
    elif (spconv := spconv_form(cells, channels, dtype)) is not None:
        forms["spconv"] = spconv

    def ours(x, weight, bias):
        return sparse_conv(x, weight, bias, voxels, planned)

    if bench.device.type == "cuda":
        check(inputs, ours, forms["torch"])
    limit, ratio = GOALS.get((n, channels, kind), (None, None))
    name = f"{n // 1024}k x {channels}, {len(kernel_map.tap_in) / n + 1:.1f} neighbours"
    exact = 1e-5 if dtype == torch.float32 and bench.device.type == "cpu" else None
    limits = (limit, 3 * limit if limit else None)
    bench.passes(name, inputs, ours, forms, tolerance=exact, ratio=ratio, limits_ms=limits)


def main():
    bench = Bench("sparse_conv")
    for options in GPU_CASES if bench.device.type == "cuda" else CPU_CASES:
        case(bench, *options)
    bench.finish()


if __name__ == "__main__":
    main()
