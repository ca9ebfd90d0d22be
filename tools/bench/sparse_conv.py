"""Sparse convolution over occupied cells, against the faster of two plain torch forms; on a GPU also against spconv.

The GPU's cases are voxels of a closed surface in random order: "surface" is one voxel thick, as after pooling, with
about 10 occupied cells of 27 around each (itself included); "sparse" has points far apart, as at the finest stage.
"""

import dataclasses
import math

import torch
from harness import Bench, best_seconds, with_gradients

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


def surface_cells(n: int, kind: str, seed: int = 3) -> torch.Tensor:
    """int32 [n, 3] on the GPU, no cell twice."""
    generator = torch.Generator(device="cuda").manual_seed(seed)
    u = torch.nn.functional.normalize(torch.randn(3 * n, 3, generator=generator, device="cuda"), dim=-1)
    radius = math.sqrt(n / (4 * math.pi)) * (0.98 if kind == "surface" else 3.2)
    bumps = 1 + 0.15 * torch.sin(5 * u[:, :1]) * torch.cos(4 * u[:, 1:2])
    cells = (u * radius * bumps).round().int()
    cells = torch.unique(cells - cells.min(0)[0], dim=0)
    while cells.shape[0] < n:
        more = torch.randint(0, int(cells.max()) + 1, (n, 3), generator=generator, device="cuda", dtype=torch.int32)
        cells = torch.unique(torch.cat([cells, more]), dim=0)
    return cells[torch.randperm(cells.shape[0], generator=generator, device="cuda")[:n]].contiguous()


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


def gpu(bench):
    """Correctness of 16-bit types: against float64, at most twice the error of plain torch in the same dtype."""
    goals = {  # limit in ms, ratio to spconv
        (65536, 64, "sparse"): (0.004, 10),
        (262144, 128, "surface"): (0.10, 2),
        (16384, 512, "surface"): (0.10, 2),
    }
    for n, channels, kind, dtype in (
        (65536, 64, "sparse", torch.float16),
        (65536, 32, "surface", torch.float16),
        (65536, 64, "surface", torch.float16),
        (262144, 128, "surface", torch.float16),
        (16384, 512, "surface", torch.float16),
        (16384, 512, "surface", torch.bfloat16),
        (65536, 64, "surface", torch.float32),
    ):
        cells = surface_cells(n, kind)
        voxels, kernel_map = tables_of(cells)
        planned = with_plan(voxels, kernel_map)
        generator = torch.Generator(device="cuda").manual_seed(channels)
        x = 0.5 * torch.randn(n, channels, generator=generator, device="cuda")
        weight = torch.randn(channels, KERNEL, KERNEL, KERNEL, channels, generator=generator, device="cuda")
        inputs = [x, weight / (TAPS * channels) ** 0.5, torch.randn(channels, generator=generator, device="cuda")]
        inputs = [t.to(dtype) for t in inputs]
        forms = {"torch": gather_multiply_scatter(voxels, kernel_map)}
        if (spconv := spconv_form(cells, channels, dtype)) is not None:
            forms["spconv"] = spconv

        def ours(x, weight, bias):
            return sparse_conv(x, weight, bias, voxels, planned)

        runs = with_gradients(inputs, ours, *forms.values())
        exact, wide = [], [t.double() for t in inputs]
        with torch.no_grad():
            exact.append(forms["torch"](*wide))
        errors = [float((run()[0].double() - exact[0]).abs().max()) for run in runs]
        if errors[0] > 2 * errors[1]:
            raise AssertionError(f"{n} x {channels}: error {errors[0]:.1e}, plain torch {errors[1]:.1e}")
        case = f"{n // 1024}k x {channels}, {len(kernel_map.tap_in) / n + 1:.1f} neighbours"
        limit, ratio = goals.get((n, channels, kind), (None, None))
        dtype_name = str(dtype).split(".")[1]
        forward = {name: lambda f=f: f(*inputs) for name, f in forms.items()}
        bench.gpu(f"{case}: fwd", dtype_name, lambda: ours(*inputs), forward,
                  target_ratio=ratio, limit_ms=limit, tolerance=None)  # fmt: skip
        bench.gpu(f"{case}: fwd+bwd", dtype_name, runs[0], dict(zip(forms, runs[1:])),
                  target_ratio=ratio, limit_ms=3 * limit if limit else None, tolerance=None)  # fmt: skip


def main():
    bench = Bench("sparse_conv")
    if bench.device.type == "cuda":
        gpu(bench)
        return bench.finish()
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
        plain = min(forms, key=lambda f: best_seconds(lambda: f(*inputs)))
        bench.compare(f"{title}: fwd", lambda: ours(*inputs), lambda: plain(*inputs))
        runs = with_gradients(inputs, ours, *forms)
        bench.compare(f"{title}: fwd+bwd", runs[0], min(runs[1:], key=best_seconds))
    bench.finish()


if __name__ == "__main__":
    main()
