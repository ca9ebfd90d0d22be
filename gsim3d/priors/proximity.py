"""Proximity: direction and distance of each movable particle to the static background."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Movable
from gsim3d.priors.padding import LEAST_LOGIT, from_blocks, in_blocks, squared_distances, weights
from gsim3d.priors.rigid import fit_planes
from gsim3d.state import FROZEN


@dataclass(frozen=True)
class ProximityConfig(PriorConfig):
    """Static background near each movable particle.

    Attributes:
        range: length scale of the proximity in metres; larger than a displacement in a step, to anticipate contacts.
        window: standard deviation of the window that averages frozen particles, over ``range``.
        min_opacity: smallest opacity of frozen particles that count. Particles of uncertain depth at silhouettes are
            below 0.1, floating particles in occluded regions below 0.5.
    """

    type = "proximity"
    range: float = 0.15
    window: float = 0.5
    min_opacity: float = 0.1

    RANGES = {"range": (1e-6, 1e6), "window": (1e-3, 1e3), "min_opacity": (0, 1)}


class Proximity(Prior, config=ProximityConfig):
    """Features p u and p of each movable particle, with the vector u to the background in units of ``range`` and the
    proximity ``p = exp(-|u|^2 / 2)``. No gradients."""

    n_features, reads_background = 4, True

    def geometry(self, ctx: StepContext) -> ContactGeometry:
        """The background near the movable particles of this step."""
        config = self.config
        make = lambda: ContactGeometry(ctx.movable, config.range, config.window, config.min_opacity)  # noqa: E731
        return ctx.cached("contact geometry", make)

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.scatter_newest(self.geometry(ctx).features)


class ContactGeometry:
    """Static background near each movable particle, from up to SAMPLES frozen particles of its scene. No gradients.

    The vector to the background ends at the mean of the frozen particles, weighted by a Gaussian of their distances.
    At a plane it is normal to the plane, also for particles behind it.

    Attributes:
        range: length scale in metres.
        features: [N, 4], p u and p of :class:`Proximity`; 0 for frozen particles and in scenes without any.
        proximity: p [N, 1].
    """

    def __init__(self, movable: Movable, range: float, window: float, min_opacity: float):
        self._movable, self.range, self._window_radius = movable, range, window * range
        with torch.no_grad(), torch.autocast(movable.positions.device.type, enabled=False):
            frozen = movable.samples_of(FROZEN, min_opacity, centered=False)
            self._center = frozen.mean[:, None]
            frozen.center(self._center)
            self._positions = movable.particles.positions - self._center
            positions, self._around, known = in_blocks(self._positions, frozen.positions, frozen.known)
            logits = squared_distances(positions, self._around) * (-0.5 / self._window_radius**2)
            self._window = weights(logits, known)
            way = (from_blocks(self._window @ self._around, self._positions) - self._positions) / range
            near = (-0.5 * way.square().sum(2, keepdim=True)).clamp(min=LEAST_LOGIT).exp()
            is_any = (frozen.n > 0)[:, None, None]
            self.features = movable.scatter(torch.where(is_any, torch.cat([near * way, near], 2), 0))
        self.proximity = self.features[:, -1:]

    def surface(self, centers: Tensor) -> tuple[Tensor, Tensor]:
        """Local plane of the background near each particle: height over it in metres [N, 1] and unit normal [N, 3], to
        the side of the body's center (``centers`` [B, m, 3], relative to ``movable.center``); 0 for particles that
        cannot move and in scenes without frozen particles."""
        with torch.no_grad(), torch.autocast(self._positions.device.type, enabled=False):
            found = fit_planes(self._window, self._around, self._window_radius)
            middle, normal = (from_blocks(x, self._positions) for x in found)
            ahead = ((centers + self._movable.center - self._center - middle) * normal).sum(2, keepdim=True)
            normal = torch.where(ahead < 0, -normal, normal)
            height = ((self._positions - middle) * normal).sum(2, keepdim=True)
            found = self._movable.scatter(torch.cat([height, normal], 2))
            return found[:, :1], found[:, 1:]
