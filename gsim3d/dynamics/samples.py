"""Rows of one cloud of every scene, padded and thinned: of a size that is known without waiting for the device."""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gsim3d.ops.validate_state import CELLS
from gsim3d.state import DYNAMIC, Particles, constant

SAMPLES = 1024  # rows of a cloud that are looked at, evenly spread over them
FAINTEST = -60.0  # logarithm of a weight: a CPU takes many times as long for numbers that are almost 0


class Padded:
    """One cloud of every scene, padded.

    rows: int64 [B, M].   places: float64 [B, M, 3] from the origins of the scenes.   is_row: bool [B, M], those within
    the workspace.
    """

    def __init__(self, history: Particles, chosen: list[int], grid_size: float):
        table, device = history.clouds, history.means.device
        starts, counts, scenes = (
            constant(tuple(of[q] for q in chosen), device)
            for of in (table.starts, [table.count(q) for q in range(len(table))], table.scenes)
        )
        place = torch.arange(max(1, max(table.count(q) for q in chosen)), device=device)
        self.rows = (starts[:, None] + place).clamp(max=history.n_rows - 1)
        self.places = history.means.detach()[self.rows].double() - history.origin[scenes][:, None]
        inside = ((self.places >= 0) & (self.places / grid_size < CELLS)).all(2)  # the workspace, and not NaN
        self.is_row = (place < counts[:, None]) & inside


class Rows:
    """Some rows of padded clouds.

    rows: int64 [B, M].   wanted: bool [B, M], those of the ``activity`` that are at least as opaque as ``opacity``.
    places: [B, M, 3] from the origins of the scenes, 0 of others.
    """

    def __init__(self, clouds: Padded, history: Particles, activity: int = DYNAMIC, opacity: float = 0.0):
        self._clouds, self.rows = clouds, clouds.rows
        self.wanted = clouds.is_row & (history.activity[self.rows] == activity)
        if opacity > 0:
            self.wanted = self.wanted & (history.opacities.detach()[self.rows] >= opacity)
        self.places = torch.where(self.wanted[:, :, None], clouds.places, 0).to(history.means.dtype)

    def only(self, few: Few) -> Rows:
        """Those of ``few``; 0 of others."""
        if few.known is self.wanted:
            return self
        some = copy.copy(self)
        some.rows, some.places, some.wanted = few.take(self.rows), few.take(self.places), few.known
        return some

    def that_are(self, history: Particles, activity: int, opacity: float = 0.0) -> Rows:
        """Others of the same clouds, all of them."""
        return Rows(self._clouds, history, activity, opacity)


class Few:
    """Rows that are ``wanted`` [B, M], of every scene the first m of its list, in their order.

    m is how many a scene has at most: ``most``, where the caller knows it; else a CPU counts them, and a GPU, which
    would have to wait for the number, has all M in their places.
    """

    def __init__(self, wanted: Tensor, most: int | None = None):
        if most is None and wanted.device.type == "cpu" and not torch.compiler.is_compiling():
            most = int(wanted.sum(1).max())
        self.known, self._wanted = wanted, wanted
        self._at = None
        if most is not None:
            until, k = wanted.cumsum(1), torch.arange(max(1, most), device=wanted.device)
            self.known = k < until[:, -1:]
            self._at = torch.searchsorted(until, (k + 1).repeat(len(until), 1)).clamp(max=until.shape[1] - 1)
            self._rank = (until - 1).clamp(0, max(1, most) - 1)

    def take(self, values: Tensor) -> Tensor:
        """[B, m, ...] of ``values`` [B, M, ...]; 0 where there is none."""
        if self._at is None:
            return values
        return _moved(values, self._at, self.known, self._rank, self._wanted)

    def put(self, values: Tensor) -> Tensor:
        """[B, M, ...] of ``values`` [B, m, ...]; 0 of rows that are not wanted."""
        if self._at is None:
            return torch.where(self._wanted.reshape(*self._wanted.shape, *(1,) * (values.dim() - 2)), values, 0)
        return _moved(values, self._rank, self._wanted, self._at, self.known)


def _moved(values: Tensor, *places: Tensor) -> Tensor:
    """_Taken, of ``values`` [B, M, ...]."""
    return _Taken.apply(values.reshape(*values.shape[:2], -1), *places).reshape(len(values), -1, *values.shape[2:])


class Samples:
    """Of :class:`Rows` all that are wanted, or S that are evenly spread over their list.

    n: [B] there are.   known: bool [B, S], entries that are rows; others are 0.   mean: [B, 3] of the places.
    places: [B, S, 3].
    """

    def __init__(self, cloud: Rows):
        self._rows, self._wanted, self._until = cloud.rows, cloud.wanted, cloud.wanted.cumsum(1)
        self.n = self._until[:, -1]
        k = torch.arange(SAMPLES, device=self.n.device)
        self.known = k < self.n[:, None]
        self._at = torch.searchsorted(self._until, self._place(k) + 1).clamp(max=self._until.shape[1] - 1)
        self.places = torch.where(
            self.known[:, :, None], cloud.places.gather(1, self._at[:, :, None].expand(-1, -1, 3)), 0
        )
        self.mean = self.mean_of(self.places)

    def of(self, values: Tensor) -> Tensor:
        """[B, S, C] of ``values`` [N, C] of all rows of the history, as places; 0 for what is no number."""
        found = values.detach()[self._rows.gather(1, self._at)].to(self.places.dtype)
        return torch.where(self.known[:, :, None], found, 0).nan_to_num(0, 0, 0)

    def _place(self, k: Tensor) -> Tensor:
        """Of sample ``k`` in the list of those that are wanted."""
        n = self.n[:, None]
        return torch.where(n > SAMPLES, k * n // SAMPLES, k)

    def take(self, values: Tensor) -> Tensor:
        """[B, S, C] of ``values`` [B, M, C] of the clouds' rows; 0 where there is no sample."""
        place, n = self._until - 1, self.n[:, None]
        k = torch.where(n > SAMPLES, (place * SAMPLES + n - 1) // n.clamp(min=1), place).clamp(0, SAMPLES - 1)
        is_sample = self._wanted & (self._place(k) == place)
        return _Taken.apply(values, self._at, self.known, k, is_sample)

    def seen_from(self, place: Tensor) -> None:
        """Counts places from ``place`` [B, 1, 3]: squares of places far away would be all rounding."""
        self.places = torch.where(self.known[:, :, None], self.places - place, 0)
        self.mean = self.mean - place[:, 0]

    def mean_of(self, values: Tensor) -> Tensor:
        """[B, C] of [B, S, C], values of the entries."""
        return torch.where(self.known[:, :, None], values, 0).sum(1) / self.n.clamp(1, SAMPLES)[:, None]

    def crowd(self, length: float) -> Tensor:
        """[B, S], how many samples are around each in a Gaussian window of ``length`` metres, itself one of them."""
        near = (squares(self.places, self.places) * (-0.5 / length**2)).clamp(min=FAINTEST).exp()
        return (near * self.known[:, None]).sum(2).clamp(min=1)


class _Taken(torch.autograd.Function):
    """Rows ``at``, of which each is taken once: row i as sample k[i], where ``is_sample``. So its gradient is taken,
    too; that of gather waits for the device where it has to be deterministic."""

    @staticmethod
    def forward(ctx, values: Tensor, at: Tensor, known: Tensor, k: Tensor, is_sample: Tensor) -> Tensor:
        ctx.save_for_backward(k, is_sample)
        return torch.where(known[:, :, None], values.gather(1, at[:, :, None].expand(-1, -1, values.shape[2])), 0)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None, None]:
        k, is_sample = ctx.saved_tensors
        taken = grad.gather(1, k[:, :, None].expand(-1, -1, grad.shape[2]))
        return torch.where(is_sample[:, :, None], taken, 0), None, None, None, None


def weights(logits: Tensor, known: Tensor) -> Tensor:
    """[B, G, S], how much each of the ``known`` [B, S] counts; nothing where there is none."""
    known = known[:, None]
    logits = torch.where(known, logits, -torch.inf)
    logits = (logits - logits.amax(2, keepdim=True)).clamp(min=FAINTEST)
    return torch.where(known, logits, -torch.inf).softmax(2).nan_to_num(0)


def grouped(rows: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    """``rows`` [B, N, C] in groups of one size, [B K, SAMPLES, C], and what belongs to each group of ``others``
    [B, ...]: bits of products of matrices do not depend on how many rows other scenes have. Back: :func:`ungrouped`."""
    k = -(-rows.shape[1] // SAMPLES)
    rows = F.pad(rows, (0, 0, 0, k * SAMPLES - rows.shape[1])).unflatten(1, (k, SAMPLES))
    others = (x[:, None].expand(-1, k, *x.shape[1:]) for x in others)
    return tuple(x.flatten(0, 1).contiguous() for x in (rows, *others))


def ungrouped(values: Tensor, like: Tensor) -> Tensor:
    """[B, N, ...] of ``values`` [B K, SAMPLES, ...], of the rows ``like`` [B, N, C]."""
    return values.unflatten(0, (len(like), -1)).flatten(1, 2)[:, : like.shape[1]]


def squares(a: Tensor, b: Tensor) -> Tensor:
    """[B, G, S], squared distances of [B, G, C] from [B, S, C]."""
    found = torch.baddbmm(b.square().sum(2)[:, None], a, b.mT, alpha=-2)
    return found.add_(a.square().sum(2)[:, :, None]).clamp_(min=0)
