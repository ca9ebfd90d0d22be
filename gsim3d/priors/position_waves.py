"""Sines and cosines of positions, by which attention finds particles at a given distance."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.state import Particles

MOST_WAVES = 16  # shorter waves are below float rounding


@dataclass(frozen=True)
class PositionWavesConfig(PriorConfig):
    """Features of positions relative to the scene's origin.

    Attributes:
        count: waves along each axis; each wavelength is half the previous one.
        longest: wavelength of the first wave in metres.
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
        angles = relative_positions(ctx.history) * (2 * math.pi / self.config.longest)
        angles = torch.stack([2**k * angles for k in range(self.config.count)], 1)
        return torch.stack([angles.sin(), angles.cos()], 2).flatten(1).to(ctx.history.means.dtype)


def relative_positions(particles: Particles) -> Tensor:
    """Positions relative to the origins of the scenes in metres, float64 [N, 3]."""
    return particles.means.double() - particles.row_origin()
