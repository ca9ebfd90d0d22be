"""Gravity: what touches nothing falls, and what is predicted counts only near a contact."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from gsim3d.errors import InputError
from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext


@dataclass(frozen=True)
class GravityConfig(PriorConfig):
    """Acceleration of movable particles.

    Attributes:
        acceleration: metres a step squared, at first; it is learned.
        unit: metres a step squared, of the parameter: training changes it by little.
        radius: metres, standard deviation of the windows in which a touch counts; about the radius of a body.
        exponent: a particle touches as far as proximity to the background to this power.
        touch: mean of that in a window, from which on its particles touch in full.
    """

    type = "gravity"
    acceleration: tuple[float, float, float] = (0.0, 0.0, -0.005)
    unit: float = 0.01
    radius: float = 0.3
    exponent: float = 4
    touch: float = 0.02

    RANGES = {
        "acceleration": (-1e6, 1e6),
        "unit": (1e-9, 1e6),
        "radius": (1e-6, 1e6),
        "exponent": (0, 100),
        "touch": (1e-6, 1),
    }

    def __post_init__(self):
        super().__post_init__()
        if len(self.acceleration) != 3:
            raise InputError(f"gravity: acceleration must be three numbers; got {list(self.acceleration)}")


class Gravity(Prior, config=GravityConfig):
    """The inertial displacement grows by the acceleration in every step. With t from 0 for bodies in flight to 1 for
    those that touch the background anywhere, what is predicted counts t times: flight is ballistic, and a contact
    changes how the whole body moves.
    """

    requires = ("proximity", "inertia")

    def __init__(self, config: GravityConfig):
        super().__init__(config)
        self.acceleration = nn.Parameter(torch.tensor(config.acceleration) / config.unit)

    @property
    def step(self) -> Tensor:
        """[3] metres a step squared."""
        return self.config.unit * self.acceleration

    def touch(self, ctx: StepContext) -> Tensor:
        """[N, 1], t."""
        near = ctx.priors.get("proximity").geometry(ctx).proximity ** self.config.exponent
        with torch.autocast(near.device.type, enabled=False):
            return (ctx.windows(self.config.radius).mean(near) / self.config.touch).clamp(max=1)

    def fall(self, ctx: StepContext) -> Tensor:
        """[N, 3] metres a step squared, the acceleration of particles in flight."""
        return (1 - self.touch(ctx)) * self.step

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        touch = self.touch(ctx)
        predicted = {"gained": touch * motion.gained, "network": touch * motion.network}
        return replace(motion, inertial=motion.inertial + self.step, **predicted)
