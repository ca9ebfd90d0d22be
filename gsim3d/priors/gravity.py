"""Gravity: ballistic motion in flight; predicted displacements apply only in contact."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from gsim3d.errors import InputError
from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext


@dataclass(frozen=True)
class GravityConfig(PriorConfig):
    """Acceleration of movable particles.

    Attributes:
        acceleration: initial acceleration in m/step^2; learned.
        unit: m/step^2 a unit of the parameter; scales its learning rate.
        radius: standard deviation in metres of the windows that average contact; about the radius of a body.
        exponent: contact weight of a particle is ``proximity ** exponent``.
        touch: window mean of the contact weight that counts as full contact.
    """

    type = "gravity"
    acceleration: tuple[float, float, float] = (0.0, 0.0, -0.005)
    unit: float = 0.01
    radius: float = 0.3
    exponent: float = 4
    touch: float = 0.02

    RANGES = {
        "acceleration": (-1e6, 1e6), "unit": (1e-9, 1e6), "radius": (1e-6, 1e6), "exponent": (0, 100),
        "touch": (1e-6, 1),
    }  # fmt: skip

    def __post_init__(self):
        super().__post_init__()
        if len(self.acceleration) != 3:
            raise InputError(f"gravity: acceleration must have three components; got {list(self.acceleration)}")


class Gravity(Prior, config=GravityConfig):
    """Adds the acceleration to the inertial displacement, and multiplies the gained and network displacements by a
    contact weight t from 0 (in flight) to 1 (some particles of the window touch the background).
    """

    requires = ("proximity", "inertia")

    def __init__(self, config: GravityConfig):
        super().__init__(config)
        self.acceleration = nn.Parameter(torch.tensor(config.acceleration) / config.unit)

    @property
    def step(self) -> Tensor:
        """Acceleration [3] in m/step^2."""
        return self.config.unit * self.acceleration

    def touch(self, ctx: StepContext) -> Tensor:
        """Contact weight t [N, 1]."""
        near = ctx.priors.get("proximity").geometry(ctx).proximity ** self.config.exponent
        with torch.autocast(near.device.type, enabled=False):
            return (ctx.windows(self.config.radius).mean(near) / self.config.touch).clamp(max=1)

    def fall(self, ctx: StepContext) -> Tensor:
        """Acceleration [N, 3] in m/step^2, weighted by 1 - t."""
        return (1 - self.touch(ctx)) * self.step

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        touch = self.touch(ctx)
        inertial, gained, network = motion.inertial + self.step, touch * motion.gained, touch * motion.network
        return replace(motion, inertial=inertial, gained=gained, network=network)
