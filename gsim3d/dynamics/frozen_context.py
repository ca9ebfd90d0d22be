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
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import accumulate

import torch
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.ops.curve import CURVES, KernelMap, PatchTable, Pyramid, PyramidSpec, Segments, Stage, Voxels
from gsim3d.ops.streams import MANY_STREAMS, Streams
from gsim3d.state import Particles

DEPTH = 16  # levels of the curves at stage 0, and bits of a cell along an axis
SPACE_BITS = 3 * DEPTH  # below the scene in a key
NOWHERE = torch.iinfo(torch.int64).max  # a key behind all others
ALL_CURVES = (0, 1, 2, 3)


@dataclass(frozen=True)
class Field:
    """Where a convolution meets the background: D cells, the last of them nowhere.

    Attributes:
        cells: int64 [D], keys, ascending.
        occupied: int64 [V], the cells of the background's voxels.
        voxels, kernel_map: from the occupied cells to all.
    """

    cells: Tensor
    occupied: Tensor
    voxels: Voxels
    kernel_map: KernelMap


@dataclass(frozen=True)
class Places:
    """Where the background is found at one stage.

    Attributes:
        cells: of the fields, by kernel size.
        first: int64 [4, P], the key at which each patch begins along each serialization; of the first patch of a scene
            the scene's lowest.
        kv_rows, cu_k: int64 [4, M] and [P + 1], the keys of each patch, as in :class:`PatchTable`.
        patch_size: the most keys of a patch.
    """

    cells: dict[int, Tensor]
    first: Tensor
    kv_rows: Tensor
    cu_k: Tensor
    patch_size: int


@dataclass(frozen=True)
class FrozenContext:
    """What moving rows read of the background, through all calls of a rollout.

    Attributes:
        curves, depths: of each stage: which curves the run uses, as do calls that read it, and how many levels they
            have.
        places: of each stage; none where no row is seen.
        fields: [D, C] of every convolution, by module.
        keys, values: [N, H, C / H] of every attention, by module.
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
    ) -> tuple[FrozenContext, list[Recorder]]:
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
        scenes = row_scenes(pyramid, particles)
        rooms = list(zip(self.places, pyramid.stages, scenes, self.depths, self.curves))
        with Streams(particles.means, MANY_STREAMS) as streams:  # many launches over few rows; none waits for another
            patches = [streams.run(_overlap, *room) for room in rooms]
            cells = [streams.run(_cells_of_rows, *room[:3]) for room in rooms]
        return [Reader(self, *of_stage) for of_stage in zip(cells, patches, strict=True)]

    def map(self, f: Callable[[Tensor, int], Tensor]) -> FrozenContext:
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
        return FrozenContext(self.curves, self.depths, places, *kept)

    def with_room(self, factor: float) -> FrozenContext:
        """Another one that reads alike, with room for ``factor`` times as much."""
        return self.map(lambda x, kind: _longer(x, kind, math.ceil(factor * _length(x, kind))))

    def load(self, other: FrozenContext) -> bool:
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

    records = True

    def __init__(self, background: FrozenContext, fields: dict[int, Field], stage: Stage):
        self.background, self.fields, self.stage = background, fields, stage

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        """``out``, which ``conv`` made of ``x``."""
        at, voxels = self.fields[conv.kernel_size], self.stage.voxels
        means = ops.pool_mean(x, voxels.rows, voxels.cu_rows, check=False)
        x = means.new_zeros(at.cells.shape[0], means.shape[1]).index_copy(0, at.occupied, means)
        weight = conv.full_weight()
        around = torch.ones_like(weight[:1, ..., :1])  # the centre tap reads a row itself
        around[0, *[conv.kernel_size // 2] * 3] = 0
        field = ops.sparse_conv(x, weight * around, None, at.voxels, at.kernel_map, check=False)
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

    records = False

    def __init__(self, background: FrozenContext, cells: dict[int, Tensor], patches: tuple[PatchTable, ...]):
        self.background, self.cells, self.patches = background, cells, patches

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        field = self.background.fields[conv].to(out.dtype)
        return ops.add_cells(out, field, self.cells[conv.kernel_size], check=False)

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        keys, values = self.background.keys[attention].to(q.dtype), self.background.values[attention].to(q.dtype)
        return ops.joint_attention(q, k, v, keys, values, patches, self.patches[row], check=False)


def row_scenes(pyramid: Pyramid, particles: Particles) -> list[Tensor]:
    """int64 [N] for each stage: the scene of every row, anything for rows of a given capacity that are none."""
    pooled = [Segments(pyramid.rows, pyramid.cu_rows), *(stage.cluster for stage in pyramid.stages[1:])]
    return ops.row_scenes(particles.cloud_scene, particles.cu_rows, pooled)


def _cells_of_rows(places: Places, stage: Stage, scene: Tensor) -> dict[int, Tensor]:
    """Where the rows of a stage find the fields, by kernel size."""
    return {size: ops.find_cells(cells, scene, stage.grid) for size, cells in places.cells.items()}


def _overlap(
    places: Places, stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]
) -> tuple[PatchTable, ...]:
    """The patches of the background around the rows of a stage, along each curve."""
    codes, at = _codes(stage, scene, depth, curves), (stage.order, stage.cu_clouds)
    background = places.first, places.kv_rows, places.cu_k
    return ops.overlapping_patches(*background, codes, *at, patch_size=places.patch_size)


# ---- places ----


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
