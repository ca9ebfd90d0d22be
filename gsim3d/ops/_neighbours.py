"""Pairs of neighbouring cells of sparse convolutions with any kernel, from lists of cells."""

from typing import NamedTuple

import torch
from torch import Tensor

Axes = tuple[int, int, int]
BITS, MAX_KERNEL = 16, 31  # of a coordinate; edge of the largest cube of taps


class Cells(NamedTuple):
    """The different ones of a list of cells, ascending by (batch, x, y, z), and which row has which.

    keys: int64 [V]. row_voxel, rows, cu_rows: as :class:`gsim3d.ops.Voxels`.
    """

    keys: Tensor
    row_voxel: Tensor
    rows: Tensor
    cu_rows: Tensor


class Geometry(NamedTuple):
    """What :meth:`gsim3d.ops.KernelMap.from_indices` names: see there."""

    voxels: list[Tensor]
    edge: int
    pairs: list[Tensor]
    kernel: Axes
    outputs: Tensor | None


def geometry(indices, kernel_size, stride, padding, dilation, spatial_shape) -> Geometry:
    """The geometry of a convolution over a list of cells; arguments as of KernelMap.from_indices."""
    kernel, dilations = per_axis("kernel_size", kernel_size, 1), per_axis("dilation", dilation, 1)
    paddings, cells = per_axis("padding", padding, 0), cells_of(check_indices(indices))
    edge = max(kernel) if stride is None else cube_of(kernel)
    if edge > MAX_KERNEL:
        raise ValueError(f"from_indices: kernel_size must be at most {MAX_KERNEL}; got {kernel_size!r}")
    if stride is None:
        if any(k % 2 == 0 for k in kernel):
            raise ValueError(f"from_indices: kernel_size must be odd where there is no stride; got {kernel_size!r}")
        if any(paddings) or spatial_shape is not None:
            raise ValueError("from_indices: padding and spatial_shape are of a convolution with stride; give one, or 1")
        return Geometry(list(cells[1:]), edge, list(submanifold_pairs(cells.keys, kernel, dilations)), kernel, None)
    extent = None if spatial_shape is None else per_axis("spatial_shape", spatial_shape, 1)
    strides = per_axis("stride", stride, 1)
    outputs, *pairs = strided_pairs(cells.keys, kernel, strides, paddings, dilations, extent)
    own = torch.arange(outputs.shape[0], device=outputs.device)
    n, n_voxels = indices.shape[0], cells.keys.shape[0]
    behind = own + n_voxels, own + n, own + n + 1
    voxels = [torch.cat(parts) for parts in zip(cells[1:], behind, strict=True)]
    return Geometry(voxels, edge, pairs, kernel, outputs)


def per_axis(name: str, value: int | tuple[int, ...], least: int) -> Axes:
    """``value`` for each axis. Raises TypeError or ValueError, naming the argument."""
    values = tuple(value) if isinstance(value, (tuple, list)) else (value,) * 3
    if len(values) != 3 or not all(isinstance(v, int) and not isinstance(v, bool) for v in values):
        raise TypeError(f"from_indices: {name} must be a whole number or three; got {value!r}")
    if min(values) < least:
        raise ValueError(f"from_indices: {name} must be at least {least}; got {value!r}")
    return values


def check_indices(indices: Tensor) -> Tensor:
    """``indices`` as int64. Raises TypeError or ValueError where they are not cells."""
    if not isinstance(indices, Tensor) or indices.dtype not in (torch.int32, torch.int64):
        got = indices.dtype if isinstance(indices, Tensor) else type(indices).__name__
        raise TypeError(f"from_indices: indices must be an int32 or int64 tensor; got {got}")
    if indices.dim() != 2 or indices.shape[1] != 4:
        raise ValueError(f"from_indices: indices must be [N, 4], batch, x, y, z; got {list(indices.shape)}")
    if indices.shape[0]:
        low, high = (int(v) for v in torch.aminmax(indices))
        if low < 0 or high >= 1 << (BITS - 1):
            raise ValueError(f"from_indices: indices must be in [0, 2^{BITS - 1}); got {low} .. {high}")
    return indices.long()


def cells_of(indices: Tensor) -> Cells:
    """The cells of indices int64 [N, 4]."""
    keys, row_voxel, counts = torch.unique(_keys(indices), return_inverse=True, return_counts=True)
    rows = torch.argsort(row_voxel, stable=True)
    return Cells(keys, row_voxel, rows, torch.cat([counts.new_zeros(1), counts.cumsum(0)]))


def submanifold_pairs(keys: Tensor, kernel: Axes, dilation: Axes) -> tuple[Tensor, Tensor, Tensor]:
    """tap_in, tap_out, cu_taps: tap_in is the voxel at the tap's offset from tap_out. Taps count those of the smallest
    cube around the kernel; the centre has none."""
    cube, offsets = max(kernel), _taps(kernel, keys.device)
    centre = torch.tensor([k // 2 for k in kernel], device=keys.device)
    steps = (offsets - centre) * torch.tensor(dilation, device=keys.device)
    place, found = _find(keys, _indices(keys)[None], steps[:, None])
    found &= (steps != 0).any(1)[:, None]
    tap, tap_out = found.nonzero().unbind(1)
    shift = torch.tensor([(cube - k) // 2 for k in kernel], device=keys.device)
    slot = ((offsets + shift) * torch.tensor([cube * cube, cube, 1], device=keys.device)).sum(1)
    return place[tap, tap_out], tap_out, _offsets(slot[tap], cube)


def strided_pairs(
    keys: Tensor, kernel: Axes, stride: Axes, padding: Axes, dilation: Axes, extent: Axes | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Output cells [M, 4], tap_in, tap_out, cu_taps: output o lies at input i where
    ``o stride + tap dilation - padding = i``. Voxels behind those of ``keys`` are the outputs."""
    device = keys.device
    each = (kernel, stride, padding, dilation)
    kernel_, stride_, padding_, dilation_ = (torch.tensor(values, device=device) for values in each)
    taps, cells = _taps(kernel, device), _indices(keys)
    scaled = cells[None, :, 1:] + padding_ - (taps * dilation_)[:, None]
    outputs = torch.div(scaled, stride_, rounding_mode="floor")
    good = ((scaled >= 0) & (outputs * stride_ == scaled)).all(-1)
    if extent is not None:
        reach = torch.tensor(extent, device=device) + 2 * padding_ - dilation_ * (kernel_ - 1) - 1
        size = torch.div(reach, stride_, rounding_mode="floor")
        good &= (outputs <= size).all(-1)
    tap, tap_in = good.nonzero().unbind(1)
    found = _keys(torch.cat([cells[tap_in, :1], outputs[tap, tap_in]], 1))
    made, tap_out = torch.unique(found, return_inverse=True)
    cube = cube_of(kernel)
    slot = tap + (tap >= cube**3 // 2)  # the centre of the cube stays empty: there a row reads itself
    return _indices(made), tap_in, keys.shape[0] + tap_out, _offsets(slot, cube)


def cube_of(kernel: Axes) -> int:
    """Edge of the smallest odd cube that has more taps than the kernel."""
    taps, cube = kernel[0] * kernel[1] * kernel[2], 3
    while cube**3 <= taps:
        cube += 2
    return cube


def _keys(indices: Tensor) -> Tensor:
    batch, x, y, z = indices.unbind(-1)
    return ((batch << BITS | x) << BITS | y) << BITS | z


def _indices(keys: Tensor) -> Tensor:
    mask = (1 << BITS) - 1
    return torch.stack([keys >> 3 * BITS, keys >> 2 * BITS & mask, keys >> BITS & mask, keys & mask], -1)


def _taps(kernel: Axes, device: torch.device) -> Tensor:
    return torch.cartesian_prod(*(torch.arange(k, device=device) for k in kernel))


def _find(keys: Tensor, cells: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
    moved = cells[..., 1:] + steps
    inside = ((moved >= 0) & (moved < 1 << BITS)).all(-1)
    wanted = _keys(torch.cat([cells[..., :1].expand(*moved.shape[:-1], 1), moved], -1))
    place = torch.searchsorted(keys, wanted).clamp(max=max(keys.shape[0] - 1, 0))
    return place, inside & (keys[place] == wanted if keys.shape[0] else inside)


def _offsets(slot: Tensor, cube: int) -> Tensor:
    return torch.searchsorted(slot, torch.arange(cube**3 + 1, device=slot.device))
