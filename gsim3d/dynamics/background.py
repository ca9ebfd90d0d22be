"""A background that is computed once: frozen rows read each other only, the others read both.

The network runs over the background alone, one cloud a scene in the newest time slot, with cells, clusters, patches and
curves of its own. Three things are kept of that run, for as long as the background stays:

* of every convolution a field: what the background adds to it in every cell that has background within reach. A moving row
  looks up its cell: a tap adds the mean of the moving rows of a neighbour cell and the mean of its frozen rows.
* of every attention the keys and values. A moving row attends to its own patch, as without a background, and to the one
  background patch in whose interval of the curve it lies, in one softmax.
* the places of both: sorted keys, found by binary search.

Clusters and merged time slots hold moving rows only. So a step costs what the moving rows cost, nothing has a size that
depends on where they are, and a scene without background is computed as by the symmetric model.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import torch
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.ops.curve import CURVES, KernelMap, PatchTable, Pyramid, Stage, Voxels
from gsim3d.types import Particles

_ops = torch.ops.gsim3d
DEPTH = 16  # levels of the curves at stage 0, and bits of a cell along an axis
SPACE_BITS = 3 * DEPTH  # below the scene in a key
NOWHERE = torch.iinfo(torch.int64).max  # a key behind all others
ALL_CURVES = (0, 1, 2, 3)


@dataclass(frozen=True)
class Field:
    """Where a convolution meets the background: D cells, the last of them nowhere.

    cells: int64 [D], keys, ascending.   occupied: int64 [V], the cells of the background's voxels.
    voxels, kernel_map: from the occupied cells to all.
    """

    cells: Tensor
    occupied: Tensor
    voxels: Voxels
    kernel_map: KernelMap


@dataclass(frozen=True)
class Surroundings:
    """The places of the background at one stage.

    fields: by kernel size.
    first: int64 [4, P], the key at which each patch begins along each serialization; the first of a scene at its lowest.
    patches: its keys, of each serialization.
    """

    fields: dict[int, Field]
    first: Tensor
    patches: tuple[PatchTable, ...]


@dataclass(frozen=True)
class Background:
    """What moving rows read of the background, through all calls of a rollout.

    curves, depths: of each stage: which curves the run uses, as do calls that read it, and how many levels they have.
    places: of each stage; none where no row is seen.
    fields: [D, C] of every convolution, by module.   keys: (k, v) [N, H, C / H] of every attention, by module.
    """

    curves: tuple[tuple[int, ...], ...]
    depths: tuple[int, ...]
    places: tuple[Surroundings, ...]
    fields: dict[nn.Module, Tensor] = field(default_factory=dict)
    keys: dict[nn.Module, tuple[Tensor, Tensor]] = field(default_factory=dict)

    @classmethod
    def around(
        cls,
        pyramid: Pyramid,
        particles: Particles,
        strides: Sequence[int],
        curves: tuple[tuple[int, ...], ...] | None = None,
    ) -> Background:
        """The places of ``particles``, of which ``pyramid`` is the geometry; nothing is kept of the network yet."""
        curves = (ALL_CURVES,) * len(pyramid.stages) if curves is None else curves
        depths = tuple(DEPTH + 1 - n.bit_length() for n in accumulate((1, *strides), operator.mul))
        if pyramid.rows.shape[0] == 0:
            return cls(curves, depths, ())
        rooms = zip(pyramid.stages, row_scenes(pyramid, particles), depths, curves, strict=True)
        return cls(curves, depths, tuple(_surroundings(*room) for room in rooms))

    def recorders(self, pyramid: Pyramid) -> list[Recorder]:
        """What the run over the background is given, for each stage."""
        return [Recorder(self, places, stage) for places, stage in zip(self.places, pyramid.stages)]

    def readers(self, pyramid: Pyramid, particles: Particles) -> list[Reader]:
        """What a call over moving ``particles`` is given, for each stage; nothing waits for the device."""
        rooms = zip(self.places, pyramid.stages, row_scenes(pyramid, particles), self.depths, self.curves)
        return [Reader(self, *room) for room in rooms]


class Recorder:
    """Keeps what moving rows will read of one stage of the run over the background."""

    def __init__(self, background: Background, places: Surroundings, stage: Stage):
        self.background, self.places, self.stage = background, places, stage

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        """``out``, which ``conv`` made of ``x``."""
        at, voxels = self.places.fields[conv.kernel_size], self.stage.voxels
        means = ops.pool_mean(x, voxels.rows, voxels.cu_rows, check=False)
        x = means.new_zeros(at.cells.shape[0], means.shape[1]).index_copy(0, at.occupied, means)
        around = torch.ones_like(conv.weight[:1, ..., :1])  # the centre tap reads a row itself
        around[0, *[conv.kernel_size // 2] * 3] = 0
        field = ops.sparse_conv(x, conv.weight * around, None, at.voxels, at.kernel_map, check=False)
        # A block that is computed again in the backward pass does the same again, and leaves what was kept.
        self.background.fields.setdefault(conv, field)
        return out

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        self.background.keys.setdefault(attention, (k, v))
        return ops.patch_attention(q, k, v, patches, check=False)


class Reader:
    """Adds to one stage of a call over moving rows what they read of the background."""

    def __init__(
        self,
        background: Background,
        places: Surroundings,
        stage: Stage,
        scene: Tensor,
        depth: int,
        curves: tuple[int, ...],
    ):
        self.background = background
        self.cells = {size: _cell_of(at.cells, _cell_keys(scene, stage.grid)) for size, at in places.fields.items()}
        self.patches = _overlapping(places, stage, scene, depth, curves)

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        return out + self.background.fields[conv].index_select(0, self.cells[conv.kernel_size]).to(out.dtype)

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        keys, values = (part.to(q.dtype) for part in self.background.keys[attention])
        return joint_attention(q, k, v, keys, values, patches, self.patches[row])


def row_scenes(pyramid: Pyramid, particles: Particles) -> list[Tensor]:
    """int64 [N] for each stage: the scene of every row, anything for rows of a given capacity that are none."""
    input_scene = particles.cloud_scene[particles.row_cloud()]
    scenes = [_first_of(input_scene, pyramid.rows, pyramid.cu_rows)]
    for stage in pyramid.stages[1:]:
        scenes.append(_first_of(scenes[-1], stage.cluster.rows, stage.cluster.cu_rows))
    return scenes


def joint_attention(
    q: Tensor, k: Tensor, v: Tensor, other_k: Tensor, other_v: Tensor, patches: PatchTable, other_patches: PatchTable
) -> Tensor:
    """Attention of every query to its keys in both tables, in one softmax; arguments as :func:`ops.patch_attention`."""
    return _JointAttention.apply(q, k, v, other_k, other_v, patches, other_patches)


class _JointAttention(torch.autograd.Function):
    @staticmethod
    def forward(ctx, q, k, v, other_k, other_v, patches, other_patches):
        scale = q.shape[-1] ** -0.5
        out, stats = _ops.patch_attention.default(q, k, v, *_lists(patches), scale)
        other, other_stats = _ops.patch_attention.default(q, other_k, other_v, *_lists(other_patches), scale)
        out, stats = _joined(out, stats, other, other_stats, scale)
        ctx.save_for_backward(q, k, v, other_k, other_v, out, stats)
        ctx.patches, ctx.scale = (patches, other_patches), scale
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        q, k, v, other_k, other_v, out, stats = ctx.saved_tensors
        # Each table's part of the gradient follows from its own keys and the result over both.
        mine, others = (
            _ops.patch_attention_backward.default(grad, q, *keys, out, stats, *_lists(table), ctx.scale)
            for keys, table in zip(((k, v), (other_k, other_v)), ctx.patches, strict=True)
        )
        return mine[0] + others[0], *mine[1:], *others[1:], None, None


def _joined(out: Tensor, stats: Tensor, other: Tensor, other_stats: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Results of two softmaxes as that of one over the keys of both. Stats: largest product; sum of exponentials."""
    (top, total), (other_top, other_total) = stats.unbind(-1), other_stats.unbind(-1)
    other_top = torch.where(other_total > 0, other_top, top)
    largest = torch.maximum(top, other_top)
    total = total * ((top - largest) * scale).exp()
    other_total = other_total * ((other_top - largest) * scale).exp()
    both = total + other_total
    share = (other_total / both.clamp(min=torch.finfo(both.dtype).tiny))[..., None]
    joined = out * (1 - share) + other * share  # no fused product: its bits would depend on how threads share the rows
    return joined.to(out.dtype), torch.stack([largest, both], -1)


def _lists(patches: PatchTable) -> tuple[Tensor, ...]:
    return patches.q_rows, patches.kv_rows, patches.cu_q, patches.cu_k


# ---- places ----


def _first_of(values: Tensor, rows: Tensor, cu_rows: Tensor) -> Tensor:
    """The value of the first row of each segment; of empty ones, any."""
    if rows.shape[0] == 0:
        return values[:0]
    return values[rows[cu_rows[:-1].clamp(max=rows.shape[0] - 1)]]


def _cell_keys(scene: Tensor, grid: Tensor) -> Tensor:
    x, y, z = grid.unbind(1)
    return scene << SPACE_BITS | x << 2 * DEPTH | y << DEPTH | z


def _shifted(keys: Tensor, offsets: Tensor, depth: int) -> tuple[Tensor, Tensor]:
    """Keys [..., V] of the cells [..., 3] further; whether they lie inside the 2^depth cells along each axis."""
    inside = True
    for axis, shift in enumerate((2 * DEPTH, DEPTH, 0)):
        step = offsets[..., axis, None]
        place = (keys >> shift & (1 << DEPTH) - 1) + step
        inside = (place >= 0) & (place < 1 << depth) & inside
        keys = keys + (step << shift)
    return keys, inside


def _surroundings(stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]) -> Surroundings:
    voxels = stage.voxels
    lowest = voxels.rows[voxels.cu_rows[:-1]]
    keys = _cell_keys(scene[lowest], stage.grid[lowest])
    fields = {size: _field(keys, size, depth) for size in stage.kernel_maps}
    starts = stage.patches[0].cu_q[:-1]
    first = stage.order[:, starts]
    codes = _codes(stage, scene, depth, curves).gather(1, first)
    of_scene = scene[first]
    opens = torch.ones_like(first, dtype=torch.bool)
    opens[:, 1:] = of_scene[:, 1:] != of_scene[:, :-1]
    codes = torch.where(opens, of_scene << SPACE_BITS, codes)
    return Surroundings(fields, codes, stage.patches)


def _codes(stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]) -> Tensor:
    """int64 [4, N]: places along the serializations, scenes above them."""
    return ops.curve_encode(stage.grid, scene, [CURVES[c] for c in curves], depth=depth, shift=SPACE_BITS)


def _field(keys: Tensor, kernel_size: int, depth: int) -> Field:
    """keys: of the background's voxels, ascending."""
    reach = kernel_size // 2
    steps = torch.arange(-reach, reach + 1, device=keys.device)
    cells = keys
    for axis in range(3):
        offsets = torch.zeros(kernel_size, 3, dtype=torch.int64, device=keys.device)
        offsets[:, axis] = steps
        spread, inside = _shifted(cells, offsets, depth)
        cells = torch.unique(spread[inside])
    taps = torch.cartesian_prod(steps, steps, steps)
    seen_from, inside = _shifted(keys, -taps, depth)
    inside = inside & taps.any(1)[:, None]
    cells = torch.cat([cells, cells.new_full((1,), NOWHERE)])
    occupied = torch.searchsorted(cells, keys)
    tap_in, tap_out = occupied.expand_as(seen_from)[inside], torch.searchsorted(cells, seen_from[inside])
    cu_taps = torch.nn.functional.pad(inside.sum(1).cumsum(0), (1, 0))
    each = torch.arange(cells.shape[0] + 1, device=keys.device)
    return Field(cells, occupied, Voxels(each[:-1], each[:-1], each), KernelMap(kernel_size, tap_in, tap_out, cu_taps))


def _cell_of(cells: Tensor, keys: Tensor) -> Tensor:
    """The place of each key among ``cells``; the last one, which is nowhere, where it is not among them."""
    at = torch.searchsorted(cells, keys)
    return torch.where(cells[at] == keys, at, cells.shape[0] - 1)


def _overlapping(
    places: Surroundings, stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]
) -> tuple[PatchTable, ...]:
    """The patches of the background with the moving rows that lie in their intervals, of each serialization."""
    n_patches = places.first.shape[1]
    codes = _codes(stage, scene, depth, curves)
    patch = torch.searchsorted(places.first, codes, right=True) - 1
    of_scene = places.first.gather(1, patch.clamp(min=0)) >> SPACE_BITS == scene
    is_row = torch.arange(stage.n_rows, device=scene.device) < stage.cu_clouds[-1]
    patch = torch.where((patch >= 0) & of_scene & is_row, patch, n_patches)
    order, _ = ops.curve_sort(patch)
    bounds = torch.arange(n_patches + 1, device=scene.device).expand(len(curves), -1).contiguous()
    cu_q = torch.searchsorted(patch.gather(1, order), bounds)
    return tuple(PatchTable(order[r], own.kv_rows, cu_q[r], own.cu_k) for r, own in enumerate(places.patches))
