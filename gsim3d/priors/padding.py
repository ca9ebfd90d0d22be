"""Padded batches of one cloud a scene, with sizes that are known without a device sync.

Shapes: B scenes, M padded particles, m compacted particles, S samples, G nodes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gsim3d.ops.curve import curve_encode, curve_sort
from gsim3d.ops.segment import segment_sum
from gsim3d.ops.validate_state import CELLS
from gsim3d.state import DYNAMIC, Particles, constant

SAMPLES = 1024  # largest number of samples of a subset
SHIFT_PASSES = 3  # mean-shift iterations that follow a window from cloud to cloud
LEAST_LOGIT = -60.0  # smallest logit of a weight; avoids denormals, which are slow on a CPU


class PaddedClouds:
    """One cloud of every scene, padded to the largest.

    Attributes:
        rows: int64 [B, M], indices of particles.
        positions: float64 [B, M, 3], metres from the origins of the scenes.
        is_inside: bool [B, M], particles inside the workspace; False for padding.
    """

    def __init__(self, history: Particles, chosen: list[int], grid_size: float):
        table, device = history.clouds, history.means.device
        columns = table.starts, table.counts, table.scenes
        starts, counts, scenes = (constant(tuple(of[q] for q in chosen), device) for of in columns)
        index = torch.arange(max(1, max(table.count(q) for q in chosen)), device=device)
        self.rows = (starts[:, None] + index).clamp(max=history.n_rows - 1)
        self.positions = history.means.detach()[self.rows].double() - history.origin[scenes][:, None]
        inside = ((self.positions >= 0) & (self.positions / grid_size < CELLS)).all(2)  # False for NaN
        self.is_inside = (index < counts[:, None]) & inside


class Subset:
    """Particles of padded clouds with a given activity and a minimum opacity.

    Attributes:
        rows: int64 [B, M], indices of particles.
        is_movable: whether the members are movable particles.
        known: bool [B, M], mask of the members.
        positions: [B, M, 3], metres from the origins of the scenes; 0 outside the mask.
    """

    def __init__(self, clouds: PaddedClouds, history: Particles, activity: int = DYNAMIC, opacity: float = 0.0):
        self._clouds, self._history, self.rows, self.is_movable = clouds, history, clouds.rows, activity == DYNAMIC
        self.known = clouds.is_inside & (history.activity[self.rows] == activity)
        if opacity > 0:
            self.known = self.known & (history.opacities.detach()[self.rows] >= opacity)
        self.positions = torch.where(self.known[:, :, None], clouds.positions, 0).to(history.means.dtype)

    def compacted(self, compact: Compact) -> Subset:
        """The members in ``compact``, [B, m]."""
        if compact.known is self.known:
            return self
        some = copy.copy(self)
        some.rows, some.positions, some.known = compact.take(self.rows), compact.take(self.positions), compact.known
        return some

    def other(self, activity: int, opacity: float = 0.0) -> Subset:
        """Another subset of the same clouds."""
        return Subset(self._clouds, self._history, activity, opacity)


class Compact:
    """Stable compaction of a padded batch [B, M] -> [B, m] by a mask.

    m is ``max_count``, or the exact maximum on a CPU. On a GPU without ``max_count``, m = M (no device sync).

    Attributes:
        known: bool [B, m], False for padding.
    """

    def __init__(self, mask: Tensor, max_count: int | None = None):
        if max_count is None and mask.device.type == "cpu" and not torch.compiler.is_compiling():
            max_count = int(mask.sum(1).max())
        self.known, self._mask, self._at = mask, mask, None
        if max_count is not None:
            until, k = mask.cumsum(1), torch.arange(max(1, max_count), device=mask.device)
            self.known = k < until[:, -1:]
            self._at = torch.searchsorted(until, (k + 1).repeat(len(until), 1)).clamp(max=until.shape[1] - 1)
            self._rank = (until - 1).clamp(0, max(1, max_count) - 1)

    def take(self, values: Tensor) -> Tensor:
        """Gathers [B, M, ...] -> [B, m, ...], 0 for padding."""
        if self._at is None:
            return values
        return _take_flat(values, self._at, self.known, self._rank, self._mask)

    def put(self, values: Tensor) -> Tensor:
        """Scatters [B, m, ...] -> [B, M, ...], 0 outside the mask."""
        if self._at is None:
            return torch.where(self._mask.reshape(*self._mask.shape, *(1,) * (values.dim() - 2)), values, 0)
        return _take_flat(values, self._rank, self._mask, self._at, self.known)


def _take_flat(values: Tensor, *indices: Tensor) -> Tensor:
    """:class:`_Take` for ``values`` [B, M, ...]."""
    return _Take.apply(values.reshape(*values.shape[:2], -1), *indices).reshape(len(values), -1, *values.shape[2:])


class Samples(Compact):
    """All members of a subset or, of larger subsets, ``SAMPLES`` of them at even intervals: movable particles along a
    Hilbert curve, so that the order of rows does not matter, others in the order of rows.

    Attributes:
        n: int64 [B], number of members.
        positions: [B, S, 3] in metres, 0 for padding.
        mean: mean position [B, 3].
    """

    def __init__(self, subset: Subset):
        super().__init__(subset.known, SAMPLES)
        self.n = subset.known.sum(1)
        if subset.known.shape[1] > SAMPLES:
            codes = _curve_codes(subset, self.n > SAMPLES) if subset.is_movable else 0
            order, ranks = curve_sort(torch.where(subset.known, codes, 1 << 62))  # equal codes keep their order
            n = self.n.clamp(min=SAMPLES)[:, None]
            self._at = order.gather(1, torch.arange(SAMPLES, device=n.device) * n // SAMPLES)
            self._rank = ((ranks * SAMPLES + n - 1) // n).clamp(max=SAMPLES - 1)
            self._mask = subset.known & (self._rank * n // SAMPLES == ranks)
        self.positions = self.take(subset.positions)
        self.mean = self.mean_of(self.positions)

    def center(self, center: Tensor) -> None:
        """Subtracts ``center`` [B, 1, 3] from the positions, since squares of large coordinates lose precision."""
        self.positions = torch.where(self.known[:, :, None], self.positions - center, 0)
        self.mean = self.mean - center[:, 0]

    def mean_of(self, values: Tensor) -> Tensor:
        """Mean [B, C] of ``values`` [B, S, C]; the bits of a scene do not depend on B."""
        ends = constant(tuple(SAMPLES * q for q in range(len(values) + 1)), values.device)
        total = segment_sum(torch.where(self.known[:, :, None], values, 0).flatten(0, 1), ends, check=False)
        return total / self.n.clamp(1, SAMPLES)[:, None]

    def density(self, radius: float) -> Tensor:
        """Number of samples [B, S] in a Gaussian window of ``radius`` metres around each sample, including itself."""
        near = gaussian(squared_distances(self.positions, self.positions), radius)
        return (near * self.known[:, None]).sum(2).clamp(min=1)


def _curve_codes(subset: Subset, chosen: Tensor) -> Tensor:
    """Codes int64 [B, M] below 2^48 of the members along a Hilbert curve through their cube; equal ones in scenes that
    are not ``chosen`` (bool [B])."""
    inside = (subset.known & chosen[:, None])[:, :, None]
    at = subset.positions.double() - torch.where(inside, subset.positions, torch.inf).amin(1, keepdim=True)
    size = torch.where(inside, at, 0).amax((1, 2), keepdim=True).clamp(min=1e-6)
    cells = torch.where(inside, at / size * CELLS, 0).long().clamp(max=CELLS - 1)
    return curve_encode(cells.flatten(0, 1), None, "hilbert").view_as(subset.known)


class _Take(torch.autograd.Function):
    """A gather without repeated indices, whose gradient is a gather too: entry i goes to k[i] where ``is_taken``.
    The deterministic gradient of ``torch.gather`` needs a device sync."""

    @staticmethod
    def forward(ctx, values: Tensor, at: Tensor, known: Tensor, k: Tensor, is_taken: Tensor) -> Tensor:
        ctx.save_for_backward(k, is_taken)
        return torch.where(known[:, :, None], values.gather(1, at[:, :, None].expand(-1, -1, values.shape[2])), 0)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None, None]:
        k, is_taken = ctx.saved_tensors
        taken = grad.gather(1, k[:, :, None].expand(-1, -1, grad.shape[2]))
        return torch.where(is_taken[:, :, None], taken, 0), None, None, None, None


def weights(logits: Tensor, known: Tensor) -> Tensor:
    """Softmax of ``logits`` [B, G, S] over the mask ``known`` [B, S]; 0 for an empty mask."""
    known = known[:, None]
    logits = torch.where(known, logits, -torch.inf)
    logits = (logits - logits.amax(2, keepdim=True)).clamp(min=LEAST_LOGIT)
    return torch.where(known, logits, -torch.inf).softmax(2).nan_to_num(0)


def gaussian(squared: Tensor, radius: float) -> Tensor:
    """exp(-d^2 / (2 radius^2)) of squared distances d^2."""
    return (squared * (-0.5 / radius**2)).clamp(min=LEAST_LOGIT).exp()


def in_blocks(values: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    """Splits ``values`` [B, N, C] into blocks [B K, SAMPLES, C], and repeats ``others`` [B, ...] for each block.

    With blocks of a fixed size, the bits of matrix products do not depend on the sizes of other scenes. Inverse:
    :func:`from_blocks`.
    """
    k = -(-values.shape[1] // SAMPLES)
    values = F.pad(values, (0, 0, 0, k * SAMPLES - values.shape[1])).unflatten(1, (k, SAMPLES))
    others = (x[:, None].expand(-1, k, *x.shape[1:]) for x in others)
    return tuple(x.flatten(0, 1).contiguous() for x in (values, *others))


def block_by_block(f: Callable[..., tuple[Tensor, ...]], *blocks: Tensor) -> tuple[Tensor, ...]:
    """Applies ``f`` to blocks of :func:`in_blocks`: on a CPU one after another, whose matrices stay in the caches."""
    if blocks[0].device.type != "cpu" or torch.compiler.is_compiling() or len(blocks[0]) < 2:
        return f(*blocks)
    parts = [f(*one) for one in zip(*(x.split(1) for x in blocks))]
    return tuple(map(torch.cat, zip(*parts)))


def from_blocks(blocks: Tensor, like: Tensor) -> Tensor:
    """Joins ``blocks`` [B K, SAMPLES, ...] to [B, N, ...], with B and N of ``like`` [B, N, C]."""
    return blocks.unflatten(0, (len(like), -1)).flatten(1, 2)[:, : like.shape[1]]


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances [B, G, S] between ``a`` [B, G, C] and ``b`` [B, S, C]."""
    found = torch.baddbmm(b.square().sum(2)[:, None], a, b.mT, alpha=-2)
    return found.add_(a.square().sum(2)[:, :, None]).clamp_(min=0)


def mean_shift(now: Samples, then: Samples, nodes: Tensor, radius: float) -> Tensor:
    """Displacement [B, G, 3], since ``then``, of the particles in a Gaussian window of each node, by mean shift."""
    around = _mean_around(nodes, now, radius)
    moved = (now.mean - then.mean)[:, None].expand_as(nodes)
    for _ in range(SHIFT_PASSES):
        moved = around - _mean_around(nodes - moved, then, radius)
    return moved


def _mean_around(nodes: Tensor, samples: Samples, radius: float) -> Tensor:
    return weights(squared_distances(nodes, samples.positions) * (-0.5 / radius**2), samples.known) @ samples.positions
