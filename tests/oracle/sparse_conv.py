"""Float64 references for sparse convolution: a dictionary of voxels, and a dense conv3d."""

import torch
from torch import Tensor


def voxel_dictionary(cells: Tensor) -> dict[tuple, list[int]]:
    """Rows of each occupied cell, ascending; ``cells`` int64 [N, 4] are (cloud, x, y, z)."""
    table: dict[tuple, list[int]] = {}
    for row, cell in enumerate(cells.tolist()):
        table.setdefault(tuple(cell), []).append(row)
    return table


def kernel_tables(cells: Tensor, kernel_size: int) -> tuple[Tensor, ...]:
    """(row_voxel, rows, cu_rows, tap_in, tap_out, cu_taps), int64, of the cells; voxels in ascending order of cells."""
    table = voxel_dictionary(cells)
    voxels = sorted(table)
    index = {cell: v for v, cell in enumerate(voxels)}
    row_voxel = torch.tensor([index[tuple(cell)] for cell in cells.tolist()], dtype=torch.int64)
    rows = torch.tensor([row for cell in voxels for row in table[cell]], dtype=torch.int64)
    counts = [len(table[cell]) for cell in voxels]
    tap_in, tap_out, cu_taps = [], [], [0]
    reach = range(-(kernel_size // 2), kernel_size // 2 + 1)
    for dx, dy, dz in ((dx, dy, dz) for dx in reach for dy in reach for dz in reach):
        for v, (cloud, x, y, z) in enumerate(voxels):
            u = index.get((cloud, x + dx, y + dy, z + dz))
            if u is not None and (dx, dy, dz) != (0, 0, 0):
                tap_in.append(u)
                tap_out.append(v)
        cu_taps.append(len(tap_in))
    cu_rows = torch.cumsum(torch.tensor([0, *counts]), 0)
    return row_voxel, rows, cu_rows, *(torch.tensor(t, dtype=torch.int64) for t in (tap_in, tap_out, cu_taps))


def sparse_conv(x: Tensor, weight: Tensor, bias: Tensor | None, cells: Tensor, duplicates: str) -> Tensor:
    """Tap by tap, neighbours from a dictionary of voxels; differentiable in x, weight, bias."""
    table = voxel_dictionary(cells)
    radius = weight.shape[1] // 2
    out = x @ weight[:, radius, radius, radius].T
    out = out if bias is None else out + bias
    reach = range(-radius, radius + 1)
    for offset in ((dx, dy, dz) for dx in reach for dy in reach for dz in reach if (dx, dy, dz) != (0, 0, 0)):
        read = x.new_zeros(len(cells), len(cells))  # read[p, q]: how much of row q row p sees through this tap
        for row, (cloud, *cell) in enumerate(cells.tolist()):
            neighbours = table.get((cloud, *(c + d for c, d in zip(cell, offset))), [])
            neighbours = neighbours if duplicates == "mean" else neighbours[:1]
            read[row, neighbours] = 1 / max(1, len(neighbours))
        dx, dy, dz = (d + radius for d in offset)
        out = out + read @ x @ weight[:, dx, dy, dz].T
    return out


def racing_conv(x: Tensor, weight: Tensor, bias: Tensor | None, voxels, kernel_map, rule: str) -> Tensor:
    """Where rows share a voxel, what spconv's kernels compute in one of the orders that their threads may take.

    "native": taps before the centre add every row of the neighbour voxel into the first row of a voxel, taps after it
    give every row the first row of the neighbour. "implicit": taps before the centre give every row the first row of
    the neighbour, taps after it give the first row only the last row of the neighbour. The centre reads its own row.
    """
    size = weight.shape[1]
    n_voxels = len(voxels.cu_rows) - 1
    first, last = voxels.rows[voxels.cu_rows[:-1]], voxels.rows[voxels.cu_rows[1:] - 1]
    total = torch.zeros(n_voxels, x.shape[1], dtype=x.dtype).index_add(0, voxels.row_voxel, x)
    out = x @ weight[:, size // 2, size // 2, size // 2].T
    out = out if bias is None else out + bias
    taps = weight.permute(1, 2, 3, 4, 0).flatten(0, 2)
    for tap, (a, b) in enumerate(zip(kernel_map.cu_taps[:-1].tolist(), kernel_map.cu_taps[1:].tolist(), strict=True)):
        source, target = kernel_map.tap_in[a:b], kernel_map.tap_out[a:b]
        early = tap < size**3 // 2
        if rule == "native":
            values = total[source] if early else x[first[source]]
        else:
            values = x[first[source]] if early else x[last[source]]
        to_first_row = early if rule == "native" else not early
        if to_first_row:
            out = out.index_add(0, first[target], values @ taps[tap])
        else:
            at_voxel = torch.zeros(n_voxels, weight.shape[0], dtype=x.dtype).index_add(0, target, values @ taps[tap])
            out = out + at_voxel[voxels.row_voxel]
    return out


def dense_conv(x: Tensor, weight: Tensor, bias: Tensor | None, cells: Tensor) -> Tensor:
    """conv3d of the cells of one cloud in a zero volume, read at the cells; cells without duplicates."""
    cx, cy, cz = (cells[:, 1:] - cells[:, 1:].amin(0)).T
    size = [int(c.amax()) + 1 for c in (cx, cy, cz)]
    flat = (cx * size[1] + cy) * size[2] + cz
    volume = x.new_zeros(x.shape[1], size[0] * size[1] * size[2]).index_copy(1, flat, x.T)
    kernel = weight.permute(0, 4, 1, 2, 3)
    full = torch.nn.functional.conv3d(volume.reshape(1, -1, *size), kernel, bias, padding=weight.shape[1] // 2)[0]
    return full[:, cx, cy, cz].T
