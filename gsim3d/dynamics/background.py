"""A background that is computed once: frozen rows read each other only, the others read both.

The network runs over the background alone, one cloud a scene in the newest time slot, with cells, clusters, patches and
curves of its own. Three things are kept of that run, for as long as the background stays:

* of every convolution a field: what the background adds to it in every cell that has background within reach. A moving
  row looks up its cell: a tap adds the mean of the moving rows of a neighbour cell and the mean of its frozen rows.
* of every attention the keys and values. A moving row attends to its own patch, as without a background, and to the one
  background patch in whose interval of the curve it lies, in one softmax.
* the places of both: sorted keys, found by binary search.

Clusters and merged time slots hold moving rows only. So a step costs what the moving rows cost, nothing has a size that
depends on where they are, and a scene without background is computed as by the symmetric model.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import torch
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.branches import Branches
from gsim3d.ops.curve import CURVES, KernelMap, PatchTable, Pyramid, PyramidSpec, Stage, Voxels
from gsim3d.types import Particles

_ops = torch.ops.gsim3d
DEPTH = 16  # levels of the curves at stage 0, and bits of a cell along an axis
SPACE_BITS = 3 * DEPTH  # below the scene in a key
NOWHERE = torch.iinfo(torch.int64).max  # a key behind all others
ALL_CURVES = (0, 1, 2, 3)
MOST_EXPONENT = 70.0  # beyond it one softmax has all the weight in float32; sums of exponentials stay finite


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
class Places:
    """Where the background is found at one stage.

    cells: of the fields, by kernel size.
    first: int64 [4, P], the key at which each patch begins along each serialization; of the first patch of a scene the
        scene's lowest.
    kv_rows, cu_k: int64 [4, M] and [P + 1], the keys of each patch, as in :class:`PatchTable`.
    patch_size: the most keys of a patch.
    """

    cells: dict[int, Tensor]
    first: Tensor
    kv_rows: Tensor
    cu_k: Tensor
    patch_size: int


@dataclass(frozen=True)
class Background:
    """What moving rows read of the background, through all calls of a rollout.

    curves, depths: of each stage: which curves the run uses, as do calls that read it, and how many levels they have.
    places: of each stage; none where no row is seen.
    fields: [D, C] of every convolution, by module.   keys, values: [N, H, C / H] of every attention, by module.
    """

    curves: tuple[tuple[int, ...], ...]
    depths: tuple[int, ...]
    places: tuple[Places, ...]
    fields: dict[nn.Module, Tensor] = field(default_factory=dict)
    keys: dict[nn.Module, Tensor] = field(default_factory=dict)
    values: dict[nn.Module, Tensor] = field(default_factory=dict)

    @classmethod
    def begin(
        cls,
        pyramid: Pyramid,
        particles: Particles,
        spec: PyramidSpec,
        curves: tuple[tuple[int, ...], ...] | None = None,
    ) -> tuple[Background, list[Recorder]]:
        """The places of ``particles``, whose geometry is ``pyramid``; and what keeps, at each stage, the rest."""
        curves = (ALL_CURVES,) * len(pyramid.stages) if curves is None else curves
        depths = tuple(DEPTH + 1 - n.bit_length() for n in accumulate((1, *spec.strides), operator.mul))
        if pyramid.rows.shape[0] == 0:
            return cls(curves, depths, ()), []
        rooms = list(zip(pyramid.stages, row_scenes(pyramid, particles), depths, strict=True))
        fields = [{size: _field(*room, size) for size in room[0].kernel_maps} for room in rooms]
        chosen = zip(fields, rooms, curves, spec.patch_sizes, strict=True)
        places = tuple(_places(at, *room, of_stage, size) for at, room, of_stage, size in chosen)
        background = cls(curves, depths, places)
        return background, [Recorder(background, at, stage) for at, stage in zip(fields, pyramid.stages)]

    def readers(self, pyramid: Pyramid, particles: Particles) -> list[Reader]:
        """What a call over moving ``particles`` is given, for each stage; nothing waits for the device."""
        rooms = zip(self.places, pyramid.stages, row_scenes(pyramid, particles), self.depths, self.curves)
        with Branches(particles.means) as beside:  # many launches over few rows, and no stage waits for another
            return [beside.run(Reader, self, *room) for room in rooms]

    def map(self, f: Callable[[Tensor, int], Tensor]) -> Background:
        """The same background with ``f`` applied to every tensor and its kind (KEYS, LISTS, OFFSETS or ROWS)."""
        places = tuple(
            Places(
                {size: f(cells, KEYS) for size, cells in at.cells.items()},
                f(at.first, KEYS),
                f(at.kv_rows, LISTS),
                f(at.cu_k, OFFSETS),
                at.patch_size,
            )
            for at in self.places
        )
        kept = ({module: f(x, ROWS) for module, x in part.items()} for part in (self.fields, self.keys, self.values))
        return Background(self.curves, self.depths, places, *kept)

    def with_room(self, factor: float) -> Background:
        """Another one that reads alike, with room for ``factor`` times as much."""
        return self.map(lambda x, kind: _longer(x, kind, math.ceil(factor * _length(x, kind))))

    def load(self, other: Background) -> bool:
        """Takes the numbers of ``other`` into its own memory; False where there is no room for them."""
        own, given = [], []
        self.map(lambda x, kind: own.append((x, kind)) or x)
        other.map(lambda x, kind: given.append(x) or x)
        if len(own) != len(given) or any(_length(x, kind) < _length(y, kind) for (x, kind), y in zip(own, given)):
            return False
        for (x, kind), y in zip(own, given):
            x.copy_(_longer(y, kind, _length(x, kind)))
        return True


class Recorder:
    """Keeps what moving rows will read of one stage of the run over the background."""

    def __init__(self, background: Background, fields: dict[int, Field], stage: Stage):
        self.background, self.fields, self.stage = background, fields, stage

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        """``out``, which ``conv`` made of ``x``."""
        at, voxels = self.fields[conv.kernel_size], self.stage.voxels
        means = ops.pool_mean(x, voxels.rows, voxels.cu_rows, check=False)
        x = means.new_zeros(at.cells.shape[0], means.shape[1]).index_copy(0, at.occupied, means)
        around = torch.ones_like(conv.weight[:1, ..., :1])  # the centre tap reads a row itself
        around[0, *[conv.kernel_size // 2] * 3] = 0
        field = ops.sparse_conv(x, conv.weight * around, None, at.voxels, at.kernel_map, check=False)
        # A block that is computed again in the backward pass does the same again, and leaves what was kept.
        self.background.fields.setdefault(conv, field)
        return out

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        """``attention`` of the background to itself."""
        self.background.keys.setdefault(attention, k)
        self.background.values.setdefault(attention, v)
        return ops.patch_attention(q, k, v, patches, check=False)


class Reader:
    """Adds to one stage of a call over moving rows what they read of the background."""

    def __init__(
        self,
        background: Background,
        places: Places,
        stage: Stage,
        scene: Tensor,
        depth: int,
        curves: tuple[int, ...],
    ):
        self.background = background
        self.cells = {size: _cell_of(cells, _cell_keys(scene, stage.grid)) for size, cells in places.cells.items()}
        self.patches = _overlapping(places, stage, scene, depth, curves)

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        return out + self.background.fields[conv].index_select(0, self.cells[conv.kernel_size]).to(out.dtype)

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        keys, values = self.background.keys[attention].to(q.dtype), self.background.values[attention].to(q.dtype)
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
        # lerp would round by how threads share the rows
        out = (out + (other - out) * _share_of_other(stats, other_stats, scale)).to(out.dtype)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(q, k, v, other_k, other_v, out, _joined(stats, other_stats, scale))
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


# Stats of an attention: the largest product of a query and a key, and the sum of exponentials relative to it, 0 of no keys.


def _share_of_other(stats: Tensor, other: Tensor, scale: float) -> Tensor:
    """[..., 1], of the other keys in one softmax over the keys of both; in as few launches as there may be."""
    (top, total), (other_top, other_total) = stats.split(1, -1), other.split(1, -1)
    other_total = ((other_top - top) * scale).clamp(max=MOST_EXPONENT).exp() * other_total
    return other_total / (other_total + total).clamp(min=torch.finfo(total.dtype).tiny)


def _joined(stats: Tensor, other: Tensor, scale: float) -> Tensor:
    """Of one softmax over the keys of both."""
    (top, total), (other_top, other_total) = stats.unbind(-1), other.unbind(-1)
    other_top = torch.where(other_total > 0, other_top, top)
    largest = torch.maximum(top, other_top)
    sums = (total * ((top - largest) * scale).exp(), other_total * ((other_top - largest) * scale).exp())
    return torch.stack([largest, sum(sums)], -1)


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


def _places(
    fields: dict[int, Field], stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...], patch_size: int
) -> Places:
    first = stage.order[:, stage.patches[0].cu_q[:-1]]
    codes, of_scene = _codes(stage, scene, depth, curves).gather(1, first), scene[first]
    opens = torch.ones_like(first, dtype=torch.bool)
    opens[:, 1:] = of_scene[:, 1:] != of_scene[:, :-1]
    codes = torch.where(opens, of_scene << SPACE_BITS, codes)
    kv_rows = torch.stack([table.kv_rows for table in stage.patches])
    cells = {size: at.cells for size, at in fields.items()}
    return Places(cells, codes, kv_rows, stage.patches[0].cu_k, patch_size)


def _codes(stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]) -> Tensor:
    """int64 [4, N]: places along the serializations, scenes above them."""
    return ops.curve_encode(stage.grid, scene, [CURVES[c] for c in curves], depth=depth, shift=SPACE_BITS)


def _field(stage: Stage, scene: Tensor, depth: int, kernel_size: int) -> Field:
    lowest, reach = stage.voxels.rows[stage.voxels.cu_rows[:-1]], kernel_size // 2
    keys = _cell_keys(scene[lowest], stage.grid[lowest])  # ascending, as voxels are
    steps = torch.arange(-reach, reach + 1, device=keys.device)
    cells = keys
    for axis in range(3):
        offsets = torch.zeros(kernel_size, 3, dtype=torch.int64, device=keys.device)
        offsets[:, axis] = steps
        spread, inside = _shifted(cells, offsets, depth)
        cells = torch.unique(spread[inside])
    cells = torch.cat([cells, cells.new_full((1,), NOWHERE)])
    occupied = torch.searchsorted(cells, keys)
    # Cells above each other follow each other: one search serves a column of taps.
    columns = torch.nn.functional.pad(torch.cartesian_prod(steps, steps), (0, 1))
    seen_from, inside = _shifted(keys, -columns, depth)
    heights = (keys & (1 << DEPTH) - 1) - steps[:, None]
    inside = inside[:, None] & (heights >= 0) & (heights < 1 << depth)
    inside[columns.shape[0] // 2, reach] = False
    pairs = inside.flatten().nonzero()[:, 0]
    tap_out = (torch.searchsorted(cells, seen_from)[:, None] - steps[:, None]).flatten()[pairs]
    tap_in, inside = occupied[pairs % keys.shape[0]], inside.flatten(0, 1)
    cu_taps = torch.nn.functional.pad(inside.sum(1).cumsum(0), (1, 0))
    each = torch.arange(cells.shape[0] + 1, device=keys.device)
    return Field(cells, occupied, Voxels(each[:-1], each[:-1], each), KernelMap(kernel_size, tap_in, tap_out, cu_taps))


def _cell_of(cells: Tensor, keys: Tensor) -> Tensor:
    """The place of each key among ``cells``; the last one, which is nowhere, where it is not among them."""
    at = torch.searchsorted(cells, keys)
    return torch.where(cells[at] == keys, at, cells.shape[0] - 1)


def _overlapping(
    places: Places, stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]
) -> tuple[PatchTable, ...]:
    """The patches of the background with the moving rows that lie in their intervals, of each serialization."""
    n_patches = places.first.shape[1]
    codes = _codes(stage, scene, depth, curves)
    patch = torch.searchsorted(places.first, codes, right=True) - 1
    of_scene = places.first.gather(1, patch.clamp(min=0)) >> SPACE_BITS == scene
    is_row = torch.arange(stage.n_rows, device=scene.device) < stage.cu_clouds[-1]
    patch = torch.where((patch >= 0) & of_scene & is_row, patch, n_patches)
    order, _ = ops.curve_sort(patch)
    cu_q = torch.searchsorted(patch.gather(1, order), _counting(n_patches + 1, order))
    if order.shape[1] > places.patch_size:
        return _in_parts(order, cu_q, places)
    return tuple(PatchTable(*lists, places.cu_k) for lists in zip(order, places.kv_rows, cu_q, strict=True))


def _in_parts(order: Tensor, cu_q: Tensor, places: Places) -> tuple[PatchTable, ...]:
    """Tables of patches that have at most ``patch_size`` queries each: a GPU's blocks share patches, not queries.

    order, cu_q: [4, N] and [4, P + 1], the queries of every patch of ``places``, any number. A patch of many becomes parts,
    which all list its keys. The number of parts is the largest there can be; the last ones are empty.
    """
    size, n_parts = places.patch_size, cu_q.shape[1] - 1 + order.shape[1] // places.patch_size
    cu_parts = _offsets((cu_q.diff(dim=1) + size - 1) // size)
    part = _counting(n_parts + 1, order)
    patch = torch.searchsorted(cu_parts, part, right=True) - 1
    begin = cu_q.gather(1, patch) + (part - cu_parts.gather(1, patch)) * size
    begin = torch.minimum(begin, cu_q[:, -1:])
    n_keys = torch.nn.functional.pad(places.cu_k.diff(), (0, 1))[patch[:, :-1]]
    cu_k, slot = _offsets(n_keys), _counting(n_parts * size, order)
    at = (torch.searchsorted(cu_k, slot, right=True) - 1).clamp(max=n_parts - 1)
    source = places.cu_k[patch.gather(1, at)] + slot - cu_k.gather(1, at)
    kv_rows = places.kv_rows.gather(1, source.clamp(max=places.kv_rows.shape[1] - 1))
    return tuple(PatchTable(*lists) for lists in zip(order, kv_rows, begin, cu_k, strict=True))


def _offsets(counts: Tensor) -> Tensor:
    return torch.nn.functional.pad(counts.cumsum(1), (1, 0))


def _counting(n: int, like: Tensor) -> Tensor:
    """0 to n - 1 for each row of ``like``."""
    return torch.arange(n, device=like.device).expand(like.shape[0], n).contiguous()


# ---- room ----

KEYS, LISTS, OFFSETS, ROWS = range(4)  # what may be longer, and how it goes on: nowhere, 0, with its last entry, 0


def _length(x: Tensor, kind: int) -> int:
    """Entries along the axis that may be longer, the first one of rows, else the last; offsets have one more."""
    return x.shape[0] if kind == ROWS else x.shape[-1] - (kind == OFFSETS)


def _longer(x: Tensor, kind: int, length: int) -> Tensor:
    more = length - _length(x, kind)
    if kind == ROWS:
        return torch.cat([x, x.new_zeros(more, *x.shape[1:])])
    if kind == OFFSETS:
        return torch.cat([x, x[-1:].expand(more)])
    return torch.cat([x, x.new_full((*x.shape[:-1], more), NOWHERE if kind == KEYS else 0)], -1)
