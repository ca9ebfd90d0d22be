"""Cached network activations of a static background: frozen particles attend to each other, moving particles to both.

The network runs once over the background alone, one cloud a scene in the newest time slot, with its own voxels,
clusters, patches and curves. While the background does not change, the following is cached:

* For every convolution, a field: the contribution of the background to each cell within the kernel's reach. A moving
  particle looks up its cell; a tap adds the mean of the moving and the mean of the frozen particles of a cell.
* For every attention, keys and values. A moving particle attends to its own patch and to the background patch whose
  interval of the curve contains it, in one softmax.
* Sorted keys of both, for binary search.

Clusters and merged time slots contain moving particles only. So the cost of a step depends on the moving particles
alone, no size depends on their positions, and a scene without background gives the result of the symmetric model.
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

DEPTH = 16  # depth of the curves at level 0, and bits of a cell index along an axis
SPACE_BITS = 3 * DEPTH  # bits of a key below the scene
NOWHERE = torch.iinfo(torch.int64).max  # key above all others, for missing cells
ALL_CURVES = (0, 1, 2, 3)


@dataclass(frozen=True)
class Field:
    """The D cells to which the background contributes in a convolution; the last one is NOWHERE."""

    cells: Tensor  #: int64 [D], ascending keys
    occupied: Tensor  #: int64 [V], indices of the cells of the background's voxels
    voxels: Voxels  #: one voxel for each cell
    kernel_map: KernelMap  #: taps from occupied cells to all cells


@dataclass(frozen=True)
class Places:
    """Lookup tables of the background at one level. A scene's first patch starts at the lowest key of the scene."""

    cells: dict[int, Tensor]  #: kernel size -> cells of the field
    first: Tensor  #: int64 [4, P], first key of each patch along each curve
    kv_rows: Tensor  #: int64 [4, M], rows of the attention keys, as in :class:`PatchTable`
    cu_k: Tensor  #: int64 [P + 1], offsets of the patches in ``kv_rows``
    patch_size: int  #: largest number of keys of a patch


@dataclass(frozen=True)
class FrozenContext:
    """Cached activations of the background for all calls of a rollout."""

    curves: tuple[tuple[int, ...], ...]  #: indices of the curves of each level, also for calls that read the context
    depths: tuple[int, ...]  #: depth of the curves of each level
    places: tuple[Places, ...]  #: lookup tables of each level; empty if the background has no particles
    fields: dict[nn.Module, Tensor] = field(default_factory=dict)  #: convolution -> contribution to each cell [D, C]
    keys: dict[nn.Module, Tensor] = field(default_factory=dict)  #: attention -> keys [N, H, C / H]
    values: dict[nn.Module, Tensor] = field(default_factory=dict)  #: attention -> values [N, H, C / H]

    @classmethod
    def begin(
        cls,
        pyramid: Pyramid,
        particles: Particles,
        spec: PyramidSpec,
        curves: tuple[tuple[int, ...], ...] | None = None,
    ) -> tuple[FrozenContext, list[Recorder]]:
        """Starts a context for the background ``particles``, at most one cloud a scene, of geometry ``pyramid``.
        Also returns for each level the recorder that fills it in a call of the network."""
        curves = (ALL_CURVES,) * len(pyramid.stages) if curves is None else curves
        depths = tuple(DEPTH + 1 - n.bit_length() for n in accumulate((1, *spec.strides), operator.mul))
        if pyramid.rows.shape[0] == 0:
            return cls(curves, depths, ()), []
        levels = list(zip(pyramid.stages, row_scenes(pyramid, particles), depths, strict=True))
        fields = [{size: _field(*level, size) for size in level[0].kernel_maps} for level in levels]
        chosen = zip(fields, levels, curves, spec.patch_sizes, strict=True)
        places = tuple(_places(at, *level, of_level, size) for at, level, of_level, size in chosen)
        background = cls(curves, depths, places)
        return background, [Recorder(background, at, stage) for at, stage in zip(fields, pyramid.stages)]

    def readers(self, pyramid: Pyramid, particles: Particles) -> list[Reader]:
        """Readers of each level for a call over moving ``particles``, without a device sync."""
        scenes = row_scenes(pyramid, particles)
        levels = list(zip(self.places, pyramid.stages, scenes, self.depths, self.curves))
        with Streams(particles.means, MANY_STREAMS) as streams:  # many independent launches over few rows
            patches = [streams.run(_overlap, *level) for level in levels]
            cells = [streams.run(_cells_of_rows, *level[:3]) for level in levels]
        return [Reader(self, *of_level) for of_level in zip(cells, patches, strict=True)]

    def map(self, f: Callable[[Tensor, int], Tensor]) -> FrozenContext:
        """Applies ``f`` to every tensor and its kind (KEYS, LISTS, OFFSETS or ROWS)."""
        places = []
        for at in self.places:
            cells = {size: f(cells, KEYS) for size, cells in at.cells.items()}
            lists = f(at.first, KEYS), f(at.kv_rows, LISTS), f(at.cu_k, OFFSETS)
            places.append(Places(cells, *lists, at.patch_size))
        kept = ({module: f(x, ROWS) for module, x in part.items()} for part in (self.fields, self.keys, self.values))
        return FrozenContext(self.curves, self.depths, tuple(places), *kept)

    def with_capacity(self, factor: float) -> FrozenContext:
        """An equivalent context, padded to ``factor`` times its sizes."""
        return self.map(lambda x, kind: _longer(x, kind, math.ceil(factor * _length(x, kind))))

    def load(self, other: FrozenContext) -> bool:
        """Copies ``other`` into the memory of this context. Returns False if its sizes exceed the capacity."""
        own, given = [], []
        self.map(lambda x, kind: own.append((x, kind)) or x)
        other.map(lambda x, kind: given.append(x) or x)
        if len(own) != len(given) or any(_length(x, kind) < _length(y, kind) for (x, kind), y in zip(own, given)):
            return False
        for (x, kind), y in zip(own, given):
            x.copy_(_longer(y, kind, _length(x, kind)))
        return True


class Recorder:
    """Records the activations of one level in the call over the background."""

    records = True

    def __init__(self, background: FrozenContext, fields: dict[int, Field], stage: Stage):
        self.background, self.fields, self.stage = background, fields, stage

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        """Records the field of ``conv`` for its input ``x``. Returns its output ``out``."""
        at, voxels = self.fields[conv.kernel_size], self.stage.voxels
        means = ops.pool_mean(x, voxels.rows, voxels.cu_rows, check=False)
        x = means.new_zeros(at.cells.shape[0], means.shape[1]).index_copy(0, at.occupied, means)
        weight = conv.full_weight()
        around = torch.ones_like(weight[:1, ..., :1])  # the center tap reads the row itself
        around[0, *[conv.kernel_size // 2] * 3] = 0
        field = ops.sparse_conv(x, weight * around, None, at.voxels, at.kernel_map, check=False)
        # A checkpointed block is computed again in the backward pass; the first record stays.
        self.background.fields.setdefault(conv, field)
        return out

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        """Records keys and values. Returns the attention of the background to itself."""
        self.background.keys.setdefault(attention, k)
        self.background.values.setdefault(attention, v)
        return ops.patch_attention(q, k, v, patches, check=False)


class Reader:
    """Adds the contributions of the background to one level of a call over moving particles."""

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
    """Scene of every row for each level, int64 [N]; undefined for padding."""
    pooled = [Segments(pyramid.rows, pyramid.cu_rows), *(stage.cluster for stage in pyramid.stages[1:])]
    return ops.row_scenes(particles.cloud_scene, particles.cu_rows, pooled)


def _cells_of_rows(places: Places, stage: Stage, scene: Tensor) -> dict[int, Tensor]:
    """Kernel size -> index of the field's cell of each row of a level."""
    return {size: ops.find_cells(cells, scene, stage.grid) for size, cells in places.cells.items()}


def _overlap(
    places: Places, stage: Stage, scene: Tensor, depth: int, curves: tuple[int, ...]
) -> tuple[PatchTable, ...]:
    """Background patches of the rows of a level along each curve."""
    codes, at = _codes(stage, scene, depth, curves), (stage.order, stage.cu_clouds)
    background = places.first, places.kv_rows, places.cu_k
    return ops.overlapping_patches(*background, codes, *at, patch_size=places.patch_size)


def _shifted(keys: Tensor, offsets: Tensor, depth: int) -> tuple[Tensor, Tensor]:
    """Keys [..., V] of the cells shifted by ``offsets`` [..., 3], and whether they lie inside the 2^depth cells."""
    inside = True
    for axis, shift in enumerate((2 * DEPTH, DEPTH, 0)):
        step = offsets[..., axis, None]
        index = (keys >> shift & (1 << DEPTH) - 1) + step
        inside = (index >= 0) & (index < 1 << depth) & inside
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
    """Codes of the rows along the four curves with the scene in the high bits, int64 [4, N]."""
    return ops.curve_encode(stage.grid, scene, [CURVES[c] for c in curves], depth=depth, shift=SPACE_BITS)


def _field(stage: Stage, scene: Tensor, depth: int, kernel_size: int) -> Field:
    lowest, reach = stage.voxels.rows[stage.voxels.cu_rows[:-1]], kernel_size // 2
    x, y, z = stage.grid[lowest].unbind(1)
    keys = scene[lowest] << SPACE_BITS | x << 2 * DEPTH | y << DEPTH | z  # ascending, as voxels are
    steps = torch.arange(-reach, reach + 1, device=keys.device)
    cells = keys
    for axis in range(3):
        offsets = torch.zeros(kernel_size, 3, dtype=torch.int64, device=keys.device)
        offsets[:, axis] = steps
        spread, inside = _shifted(cells, offsets, depth)
        cells = torch.unique(spread[inside])
    cells = torch.cat([cells, cells.new_full((1,), NOWHERE)])
    occupied = torch.searchsorted(cells, keys)
    # Cells of a column have consecutive keys: one search serves a column of taps.
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


KEYS, LISTS, OFFSETS, ROWS = range(4)  # kinds of tensors; they are padded with NOWHERE, 0, the last entry, 0


def _length(x: Tensor, kind: int) -> int:
    """Entries along the axis that is padded: the first one of ROWS, else the last. OFFSETS have one more entry."""
    return x.shape[0] if kind == ROWS else x.shape[-1] - (kind == OFFSETS)


def _longer(x: Tensor, kind: int, length: int) -> Tensor:
    more = length - _length(x, kind)
    if kind == ROWS:
        return torch.cat([x, x.new_zeros(more, *x.shape[1:])])
    if kind == OFFSETS:
        return torch.cat([x, x[-1:].expand(more)])
    return torch.cat([x, x.new_full((*x.shape[:-1], more), NOWHERE if kind == KEYS else 0)], -1)
