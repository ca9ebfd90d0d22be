"""Proximity: where the static background near each movable particle is."""

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
    """The frozen particles around each movable one.

    Attributes:
        range: metres, more than a particle moves in a step, so that a contact is seen before it happens.
        window: standard deviation of the window in which frozen particles are averaged, over ``range``.
        min_opacity: of frozen particles that count. Those at silhouettes, whose depth is not known, have less than 0.1;
            those that the background leaves in the air where it was hidden less than 0.5.
    """

    type = "proximity"
    range: float = 0.15
    window: float = 0.5
    min_opacity: float = 0.1

    RANGES = {"range": (1e-6, 1e6), "window": (1e-3, 1e3), "min_opacity": (0, 1)}


class Proximity(Prior, config=ProximityConfig):
    """Features p u and p for each movable particle: u is the way to the background in units of the range, and
    ``p = exp(-|u|^2 / 2)`` the proximity. No gradients."""

    n_features, reads_background = 4, True

    def geometry(self, ctx: StepContext) -> ContactGeometry:
        """The background near the movable particles of this step."""
        config = self.config
        make = lambda: ContactGeometry(ctx.movable, config.range, config.window, config.min_opacity)  # noqa: E731
        return ctx.once("contact geometry", make)

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.of_all(self.geometry(ctx).features)


class ContactGeometry:
    """The frozen particles near each of ``movable``: up to SAMPLES of a scene, evenly spread.

    The way leads to their mean in a Gaussian window around the nearest part: of a plane it is the normal, also for a
    particle that got behind it. Scenes do not see each other. No gradients.

    Attributes:
        range: metres.
        features: [N, 4], p u and p of :class:`Proximity`; 0 for frozen particles, and where nothing is frozen.
        proximity: [N, 1], p.
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
            self.features = movable.packed(torch.where(is_any, torch.cat([near * way, near], 2), 0))
        self.proximity = self.features[:, -1:]

    def surface(self, centers: Tensor) -> tuple[Tensor, Tensor]:
        """The plane through the background near each particle.

        Args:
            centers: [B, m, 3], of the body of each movable particle, as its positions: bodies are in front of planes.
        Returns:
            The height [N, 1] of the particle over the plane, metres, and its unit normal [N, 3]; 0 for particles that
            do not move, and where nothing is frozen.
        """
        with torch.no_grad(), torch.autocast(self._positions.device.type, enabled=False):
            found = fit_planes(self._window, self._around, self._window_radius)
            middle, normal = (from_blocks(x, self._positions) for x in found)
            ahead = ((centers + self._movable.center - self._center - middle) * normal).sum(2, keepdim=True)
            normal = torch.where(ahead < 0, -normal, normal)
            height = ((self._positions - middle) * normal).sum(2, keepdim=True)
            found = self._movable.packed(torch.cat([height, normal], 2))
            return found[:, :1], found[:, 1:]
