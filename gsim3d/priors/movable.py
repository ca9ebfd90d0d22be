"""Movable particles of the newest cloud of each scene, padded and subsampled, and windows around them."""

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.priors import padding
from gsim3d.priors.padding import Compact, PaddedClouds, Samples, Subset, squared_distances
from gsim3d.state import FROZEN, Particles, constant, newest_clouds

NODES = 6  # nodes along each axis of the control grid over the movable particles of a scene
EVEN = 0.15  # radius for the density of samples, over the radius of the window
APART = 0.2  # radius of windows between body centers over the radius: under half the distance of two centers


class Movable:
    """Movable particles of the newest clouds and a subsample of them, without gradients.

    At least one cloud must have particles.

    Attributes:
        subset: padded movable particles [B, M].
        particles: compacted movable particles [B, m].
        samples: subsample [B, S].
        center: mean of the samples [B, 1, 3], in metres from the origins of the scenes.
        positions: positions [B, m, 3] in metres relative to ``center``, as those of ``samples``.
    """

    def __init__(self, history: Particles, grid_size: float, most: int | None = None):
        table, self.newest = history.clouds, newest_clouds(history.clouds)
        self._counts = [table.count(q) for q in self.newest]
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
        """Samples of another subset. Positions are relative to ``center`` if ``centered``, else to the origins."""
        samples = Samples(self.subset.other(activity, opacity))
        if centered:
            samples.center(self.center)
        return samples

    def awake(self) -> Tensor:
        """bool [N]: particles inside the workspace that are not asleep."""
        return self.unpad(self.subset.known | self.subset.other(FROZEN).known)

    def gather(self, values: Tensor) -> Tensor:
        """Values of the movable particles: packed [N, C] -> compacted [B, m, C]."""
        return self.compact.take(self.pad(values))

    def scatter(self, values: Tensor) -> Tensor:
        """Inverse of :meth:`gather`: [B, m, ...] -> [N, ...], 0 for particles that cannot move."""
        return self.unpad(self.compact.put(values))

    def pad(self, values: Tensor) -> Tensor:
        """Packed [N, C] -> padded [B, M, C]."""
        most = self.subset.rows.shape[1]
        return torch.stack([F.pad(part, (0, 0, 0, most - len(part))) for part in values.split(self._counts)])

    def unpad(self, values: Tensor) -> Tensor:
        """Padded [B, M, ...] -> packed [N, ...]."""
        return torch.cat([values[b, :n] for b, n in enumerate(self._counts)])


class Windows:
    """Gaussian windows at the nodes of a control grid, interpolated to the movable particles.

    With segmentation, the grid spans the centers of bodies, so that each body has a window of its own.

    Attributes:
        nodes: positions [B, G, 3].
        weights: weights [B, G, S] of the samples; each row sums to 1.
    """

    def __init__(self, movable: Movable, history: Particles, radius: float, *, evenly: bool):
        self.movable, self.radius = movable, radius
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            samples, size = movable.samples, radius
            self._at, self._sampled = movable.positions, samples.positions
            if history.body is not None:
                rows, known = movable.particles.rows, movable.particles.known[:, :, None]
                bodies = history.body.detach()[rows].double() - history.origin[movable.scenes][:, None]
                self._at = torch.where(known, bodies, 0).to(movable.center.dtype) - movable.center
                size = APART * radius
                self._sampled = samples.take(self._at)
            self._grid = ControlGrid(self._sampled, samples.known)
            self.nodes = self._grid.nodes
            logits = squared_distances(self.nodes, self._sampled) * (-0.5 / size**2)
            if evenly:
                logits = logits - samples.density(EVEN * radius).log()[:, None]
            self.weights = padding.weights(logits, samples.known)

    def to_particles(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Interpolates each of ``values`` [B, G, 3] to the movable particles, [B, m, 3]."""
        return self._grid.interpolate(self._at, *values)

    def to_samples(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Interpolates each of ``values`` [B, G, 3] to the samples, [B, S, 3]."""
        return self._grid.interpolate(self._sampled, *values)

    def mean(self, values: Tensor) -> Tensor:
        """Mean [N, 1] of ``values`` [N, 1] in the window of each movable particle."""
        sampled = self.movable.samples.take(self.movable.gather(values.expand(-1, 3)))
        (found,) = self.to_particles(self.weights @ sampled)
        return self.movable.scatter(found)[:, :1]


class ControlGrid:
    """A regular grid with ``nodes`` [B, G, 3] over the bounding box of ``positions`` [B, S, 3] where ``known``."""

    def __init__(self, positions: Tensor, known: Tensor):
        known = known[:, :, None]
        low, high = (side * torch.where(known, side * positions, torch.inf).amin(1, keepdim=True) for side in (1, -1))
        self._low, high = (torch.where(x.isfinite(), x, 0) for x in (low, high))
        self._size = high - self._low
        self._ticks = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
        unit = torch.stack(torch.meshgrid(self._ticks, self._ticks, self._ticks, indexing="ij"), -1).flatten(0, 2)
        self.nodes = self._low + unit * self._size

    def interpolate(self, positions: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        """Trilinear interpolation of each of ``values`` [B, G, 3] at ``positions`` [B, N, 3].

        Uses a matrix product, whose gradient is deterministic on a GPU; that of grid_sample is not.
        """
        at = ((positions - self._low) / self._size.clamp(min=1e-6)).clamp(0, 1)
        at, field = padding.in_blocks(at, torch.cat(values, 2))
        x, y, z = (1 - (NODES - 1) * (at[..., None] - self._ticks).abs()).clamp(min=0).unbind(2)
        shares = (x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]).flatten(2)
        return padding.from_blocks(shares @ field, positions).split(3, 2)
