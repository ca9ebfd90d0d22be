"""How matter has moved: a velocity for every particle, read off clouds whose rows do not correspond."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds
from gsim3d.ops.sentinel import CELLS
from gsim3d.types import DYNAMIC, CloudTable, Particles, constant

NODES = 6  # of the lattice that spans the movable rows of a scene, along each axis
SAMPLES = 1024  # movable rows of a cloud that are looked at, evenly spread over them
PASSES = 3  # in which the window follows the matter, and in which rows are matched
REACH = 0.2  # of the window's length: how far from where it is expected a row is looked for
LIKENESS = 0.12  # how far apart the latents of one place may be, relative to how far they spread
FAINTEST = -60.0  # logarithm of a weight: a CPU takes many times as long for numbers that are almost 0
LEAST_SPREAD = 1e-12  # of latents, squared: where all look the same the place alone counts
STIFFNESS = 1e-3  # against turning, relative to the window's size: a point and a line do not turn


@torch.no_grad()
def motion(history: Particles, length: float, grid_size: float) -> Tensor:
    """[N, 2, 3] metres a step: how movable matter around each row of the newest clouds moved since the step before it;
    and how the row itself will if it goes on as since the oldest step, turning as it did. 0 of rows that do not move,
    and where there is one step only.

    Of two clouds the means within a Gaussian window are compared. The window lies around a place in the newer cloud,
    and around where that place came from in the older one (mean shift), so that a body that flies as a whole has its
    velocity everywhere, beside others too, and a squeezed one that of its parts. Over the whole history rows are
    matched as well, by place and latents, and the rigid motion that fits the matches in a window tells how it turns.
    All this is done at the nodes of a lattice and interpolated between them: rows have no order (up to ``SAMPLES`` of
    them), and scenes do not see each other.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    if not any(clouds.count(q) for q in newest):
        return history.means.new_zeros(0, 2, 3)
    first = [0, *(q + 1 for q in newest[:-1])]
    before = [max(f, q - 1) for f, q in zip(first, newest, strict=True)]
    with torch.autocast(history.means.device.type, enabled=False):
        now, last, oldest = (_Samples(history, chosen, grid_size) for chosen in (newest, before, first))
        here = now.mean[:, None]
        for samples in (now, last, oldest):
            samples.seen_from(here)
        lattice = _Lattice(now)
        window = _weights(_squares(lattice.nodes, now.places) * (-0.5 / length**2), now)
        moved, expected = (_shift(now, then, lattice.nodes, window, length) for then in (last, oldest))
        velocity, spin, centre = _rigid_motion(now, oldest, lattice, window, expected, length)
        a_step, all_steps = _share(clouds, before, newest, now, last), _share(clouds, first, newest, now, oldest)
        rows = _Rows(history, newest, grid_size)
        fields = moved * a_step, velocity * all_steps, spin * all_steps, centre
        places = rows.places - here
        moved, velocity, spin, centre = lattice.at(places, *fields)
        turning = torch.linalg.cross(spin, places - centre)
        onward = velocity + turning + 0.5 * torch.linalg.cross(spin, turning)
        result = torch.where(rows.move[:, :, None, None], torch.stack([moved, onward], 2), 0)
    return torch.cat([result[b, : clouds.count(q)] for b, q in enumerate(newest)])


class _Rows:
    """One cloud of every scene, padded.

    rows: int64 [B, M].   move: bool [B, M], those that can.   places: [B, M, 3] from the origins of the scenes.
    """

    def __init__(self, history: Particles, chosen: list[int], grid_size: float):
        table, device = history.clouds, history.means.device
        starts, counts, scenes = (
            constant(tuple(of[q] for q in chosen), device)
            for of in (table.starts, [table.count(q) for q in range(len(table))], table.scenes)
        )
        place = torch.arange(max(1, max(table.count(q) for q in chosen)), device=device)
        self.rows = (starts[:, None] + place).clamp(max=history.n_rows - 1)
        places = history.means.detach()[self.rows].double() - history.origin[scenes][:, None]
        is_seen = ((places >= 0) & (places / grid_size < CELLS)).all(2)  # inside the workspace, not NaN
        self.move = (place < counts[:, None]) & (history.activity[self.rows] == DYNAMIC) & is_seen
        self.places = torch.where(self.move[:, :, None], places, 0).to(history.means.dtype)


class _Samples:
    """Movable rows of one cloud of every scene: all of them, or S that are evenly spread over their list.

    n: [B] there are.   known: bool [B, S], entries that are rows; others are 0.   mean: [B, 3] of the places.
    places: [B, S, 3].   latents: [B, S, C].
    """

    def __init__(self, history: Particles, chosen: list[int], grid_size: float):
        cloud = _Rows(history, chosen, grid_size)
        until = cloud.move.cumsum(1)
        self.n = until[:, -1]
        n, k = self.n[:, None], torch.arange(SAMPLES, device=until.device)
        self.known = k < n
        wanted = torch.where(n > SAMPLES, k * n // SAMPLES, k)
        at = torch.searchsorted(until, wanted + 1).clamp(max=until.shape[1] - 1)
        here = self.known[:, :, None]
        self.places = torch.where(here, cloud.places.gather(1, at[:, :, None].expand(-1, -1, 3)), 0)
        latents = history.latents.detach()[cloud.rows.gather(1, at)].to(self.places.dtype)
        self.latents = torch.where(here, latents, 0).nan_to_num(0, 0, 0)
        self.mean = self.mean_of(self.places)

    def seen_from(self, place: Tensor) -> None:
        """Counts places from ``place`` [B, 1, 3]: squares of places far away would be all rounding."""
        self.places = torch.where(self.known[:, :, None], self.places - place, 0)
        self.mean = self.mean - place[:, 0]

    def mean_of(self, values: Tensor) -> Tensor:
        """[B, C] of [B, S, C], values of the entries."""
        return torch.where(self.known[:, :, None], values, 0).sum(1) / self.n.clamp(1, SAMPLES)[:, None]


class _Lattice:
    """nodes: [B, G, 3] that span what can move."""

    def __init__(self, now: _Samples):
        here = now.known[:, :, None]
        low, high = (side * torch.where(here, side * now.places, torch.inf).amin(1, keepdim=True) for side in (1, -1))
        self._low, high = (torch.where(x.isfinite(), x, 0) for x in (low, high))
        self._size = high - self._low
        ticks = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
        unit = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).flatten(0, 2)
        self.nodes = self._low + unit * self._size

    def at(self, places: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, N, 3] at places [B, N, 3], of each of ``values`` [B, G, 3]."""
        field = torch.cat(values, 2).mT.unflatten(2, (NODES, NODES, NODES))
        place = 2 * (places - self._low) / self._size.clamp(min=1e-6) - 1
        place = place.clamp(-1, 1).flip(2)[:, None, None]
        found = F.grid_sample(field, place, padding_mode="border", align_corners=True)[:, :, 0, 0].mT
        return found.split(3, 2)


def _shift(now: _Samples, then: _Samples, nodes: Tensor, window: Tensor, length: float) -> Tensor:
    """[B, G, 3], how far the matter in the window around each node has moved."""
    around = window @ now.places
    moved = (now.mean - then.mean)[:, None].expand_as(nodes)
    for _ in range(PASSES):
        moved = around - _weights(_squares(nodes - moved, then.places) * (-0.5 / length**2), then) @ then.places
    return moved


def _rigid_motion(
    now: _Samples, then: _Samples, lattice: _Lattice, window: Tensor, moved: Tensor, length: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, spin (rad) and centre [B, G, 3] of the rigid motion that takes matter in each window from ``then`` to
    ``now``, if it moved about as far as ``moved``."""
    mean = now.mean_of(now.latents)[:, None]
    looks, looked = now.latents - mean, then.latents - mean
    spread = now.mean_of(looks.square().sum(2, keepdim=True)).clamp(min=LEAST_SPREAD)[:, None]
    unlike = _squares(looks, looked) * (-0.5 / (LIKENESS**2 * spread))
    places, centre, spin = now.places, window @ now.places, torch.zeros_like(moved)
    products = (places[:, :, :, None] * places[:, :, None]).flatten(2)
    scatter = (window @ products).unflatten(2, (3, 3)) - centre[:, :, :, None] * centre[:, :, None]
    size = scatter.diagonal(dim1=2, dim2=3).sum(2)[:, :, None, None] + STIFFNESS * length**2
    inertia = size * torch.eye(3, device=size.device, dtype=size.dtype) - scatter
    for _ in range(PASSES):
        velocity, turns, middle = lattice.at(places, moved, spin, centre)
        expected = velocity + torch.linalg.cross(turns, places - middle)
        match = _weights(unlike - _squares(places - expected, then.places) * (0.5 / (REACH * length) ** 2), then)
        paths = places - match @ then.places
        moved = window @ paths
        impulse = window @ torch.linalg.cross(places, paths) - torch.linalg.cross(centre, moved)
        spin = _solved(inertia, impulse)
    return moved, spin, centre


def _solved(matrices: Tensor, values: Tensor) -> Tensor:
    """The solutions [..., 3] of symmetric systems [..., 3, 3], by Cramer's rule: a graph can capture it."""
    a, b, c = matrices.unbind(-2)
    rows = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * rows[0]).sum(-1, keepdim=True)
    return torch.stack([(row * values).sum(-1) for row in rows], -1) / determinant


def _share(clouds: CloudTable, earlier: list[int], newest: list[int], now: _Samples, then: _Samples) -> Tensor:
    """[B, 1, 1], one over the steps between two clouds; 0 where they are one, or one of them has nothing that moves."""
    gaps = tuple(clouds.steps[q] - clouds.steps[e] for q, e in zip(newest, earlier, strict=True))
    gaps = constant(gaps, now.n.device)
    known = (gaps > 0) & (now.n > 0) & (then.n > 0)
    return (known / gaps.clamp(min=1))[:, None, None].to(now.places.dtype)


def _weights(logits: Tensor, of: _Samples) -> Tensor:
    """[B, G, S], how much each sample counts; nothing where there is none."""
    known = of.known[:, None]
    logits = torch.where(known, logits, -torch.inf)
    logits = (logits - logits.amax(2, keepdim=True)).clamp(min=FAINTEST)
    return torch.where(known, logits, -torch.inf).softmax(2).nan_to_num(0)


def _squares(a: Tensor, b: Tensor) -> Tensor:
    """[B, G, S], squared distances of [B, G, C] from [B, S, C]."""
    return (a.square().sum(2)[:, :, None] + b.square().sum(2)[:, None] - 2 * (a @ b.mT)).clamp(min=0)
