"""Movable particles of the newest cloud of each scene, padded and subsampled, and windows around them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.priors.padding import (
    Compact,
    PaddedClouds,
    Samples,
    Subset,
    from_blocks,
    in_blocks,
    squared_distances,
    weights,
)
from gsim3d.state import FROZEN, Particles, constant, newest_clouds

NODES = 6  # of the grid that spans the movable particles of a scene, along each axis
EVEN = 0.15  # of a window's radius: that of windows in which samples are counted
APART = 0.2  # of a window's radius: less than half as far as the centers of two bodies are apart


class Movable:
    """Movable particles and samples of them. No gradients. At least one newest cloud has particles.

    Attributes:
        subset: [B, M] of the newest clouds.
        particles: [B, m], compacted.
        samples: [B, S] of those.
        center: [B, 1, 3] metres from the origins, the mean of the samples, which they and ``positions`` count from.
        positions: [B, m, 3].
    """

    def __init__(self, history: Particles, grid_size: float, most: int | None = None):
        self.newest = newest_clouds(history.clouds)
        self._counts = [history.clouds.count(q) for q in self.newest]
        table = history.clouds
        self.scenes = constant(tuple(table.scenes[q] for q in self.newest), history.means.device)
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            self.subset = Subset(PaddedClouds(history, self.newest, grid_size), history)
            self.compact = Compact(self.subset.known, most)
            self.particles = self.subset.compacted(self.compact)
            self.samples = Samples(self.particles)
            self.center = self.samples.mean[:, None]
            self.samples.center(self.center)
            self.positions = self.particles.positions - self.center

    def samples_of(self, activity: int, opacity: float = 0.0, *, centered: bool = True) -> Samples:
        """Samples of another subset; ``centered``: their positions count from ``center``, else from the origins."""
        samples = Samples(self.subset.other(activity, opacity))
        if centered:
            samples.center(self.center)
        return samples

    def awake(self) -> Tensor:
        """bool [N], packed: particles that are neither asleep nor outside of the workspace."""
        return self.together(self.subset.known | self.subset.other(FROZEN).known)

    def padded(self, values: Tensor) -> Tensor:
        """[B, m, C] of ``values`` [N, C] of the newest clouds, packed."""
        return self.compact.take(self.apart(values))

    def packed(self, values: Tensor) -> Tensor:
        """[N, ...] of ``values`` [B, m, ...]; 0 for particles that cannot move."""
        return self.together(self.compact.put(values))

    def apart(self, values: Tensor) -> Tensor:
        """[B, M, C] of ``values`` [N, C] of the newest clouds, packed."""
        most = self.subset.rows.shape[1]
        return torch.stack([F.pad(part, (0, 0, 0, most - len(part))) for part in values.split(self._counts)])

    def together(self, values: Tensor) -> Tensor:
        """[N, ...] of ``values`` [B, M, ...]."""
        return torch.cat([values[b, :n] for b, n in enumerate(self._counts)])


class Windows:
    """Gaussian windows at the nodes of a control grid, interpolated to movable particles.

    Segmented particles belong to the window of their body and no other: the grid then spans the places of bodies.

    Attributes:
        nodes: [B, G, 3].
        weights: [B, G, S], how much each sample counts; rows sum to 1.
    """

    def __init__(self, movable: Movable, history: Particles, radius: float, *, evenly: bool):
        self.movable, self.radius = movable, radius
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            samples, size = movable.samples, radius
            self._at, self._sampled = movable.positions, samples.positions
            if history.body is not None:
                self._at, size = _from_center(movable, history, history.body), APART * radius
                self._sampled = samples.take(self._at)
            self._grid = ControlGrid(self._sampled, samples.known)
            self.nodes = self._grid.nodes
            logits = squared_distances(self.nodes, self._sampled) * (-0.5 / size**2)
            if evenly:
                logits = logits - samples.density(EVEN * radius).log()[:, None]
            self.weights = weights(logits, samples.known)

    def to_particles(self, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, m, 3] at the movable particles, for each of ``values`` [B, G, 3] at the nodes."""
        return self._grid.interpolate(self._at, *values)

    def to_samples(self, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, S, 3] at the samples, as :meth:`to_particles`."""
        return self._grid.interpolate(self._sampled, *values)

    def mean(self, values: Tensor) -> Tensor:
        """[N, 1], the mean of ``values`` [N, 1] in the window around each movable particle."""
        sampled = self.movable.samples.take(self.movable.padded(values.expand(-1, 3)))
        (found,) = self.to_particles(self.weights @ sampled)
        return self.movable.packed(found)[:, :1]


def _from_center(movable: Movable, history: Particles, positions: Tensor) -> Tensor:
    """[B, m, 3] of ``positions`` [N, 3] of all particles."""
    rows = movable.particles.rows
    found = positions.detach()[rows].double() - history.origin[movable.scenes][:, None]
    return torch.where(movable.particles.known[:, :, None], found, 0).to(movable.center.dtype) - movable.center


class ControlGrid:
    """A regular grid that spans positions [B, S, 3], those that are ``known`` [B, S]; ``nodes`` [B, G, 3]."""

    def __init__(self, positions: Tensor, known: Tensor):
        known = known[:, :, None]
        low, high = (side * torch.where(known, side * positions, torch.inf).amin(1, keepdim=True) for side in (1, -1))
        self._low, high = (torch.where(x.isfinite(), x, 0) for x in (low, high))
        self._size = high - self._low
        self._ticks = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
        unit = torch.stack(torch.meshgrid(self._ticks, self._ticks, self._ticks, indexing="ij"), -1).flatten(0, 2)
        self.nodes = self._low + unit * self._size

    def interpolate(self, positions: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, N, 3] at ``positions`` [B, N, 3], trilinear, for each of ``values`` [B, G, 3].

        A product with the share of every node: on a GPU its gradient has a fixed order, that of grid_sample has not.
        """
        at = ((positions - self._low) / self._size.clamp(min=1e-6)).clamp(0, 1)
        at, field = in_blocks(at, torch.cat(values, 2))
        x, y, z = (1 - (NODES - 1) * (at[..., None] - self._ticks).abs()).clamp(min=0).unbind(2)
        shares = (x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]).flatten(2)
        return from_blocks(shares @ field, positions).split(3, 2)
