"""Sines and cosines of positions: attention can then find what is at a given distance, as a body above its shadow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.state import Particles

MOST_WAVES = 16  # further ones are shorter than rounding


@dataclass(frozen=True)
class PositionWavesConfig(PriorConfig):
    """Features of positions relative to the scene's origin.

    Attributes:
        count: of waves along each axis; each is half as long as the one before.
        longest: metres, wavelength of the first.
    """

    type = "position_waves"
    count: int = 4
    longest: float = 4.0

    RANGES = {"count": (1, MOST_WAVES), "longest": (1e-6, 1e6)}


class PositionWaves(Prior, config=PositionWavesConfig):
    """Features sin(2 pi 2^k x / longest), cos(2 pi 2^k x / longest) for k = 0 .. count - 1."""

    def __init__(self, config: PositionWavesConfig):
        super().__init__(config)
        self.n_features = 6 * config.count

    def features(self, ctx: StepContext) -> Tensor:
        return position_waves(ctx.history, self.config.count, self.config.longest)


def position_waves(particles: Particles, count: int, longest: float) -> Tensor:
    """[N, 6 count], of ``count`` waves from ``longest`` metres down."""
    positions = particles.means.double() - particles.origin[particles.cloud_scene[particles.row_cloud()]]
    angles = positions * (2 * math.pi / longest)
    angles = torch.stack([2**k * angles for k in range(count)], 1)
    return torch.stack([angles.sin(), angles.cos()], 2).flatten(1).to(particles.means.dtype)
