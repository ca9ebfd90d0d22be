"""Velocity: particles see how fast they move, and predicted gains carry them on."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext, bounded_gains
from gsim3d.priors.movable import Windows
from gsim3d.priors.padding import PaddedClouds, Samples, Subset, mean_shift
from gsim3d.state import Particles, constant

SMOOTHING = 0.5  # of the displacement before in the velocity, so that it is as old as that of four encoded clouds


@dataclass(frozen=True)
class VelocityConfig(PriorConfig):
    """Smoothed displacement of the movable particles.

    Attributes:
        radius: standard deviation in metres of the windows whose means are followed through encoded clouds; about the
            radius of a body.
    """

    type = "velocity"
    radius: float = 0.3

    RANGES = {"radius": (1e-6, 1e6)}


class Velocity(Prior, config=VelocityConfig):
    """Feature of the newest particles: their velocity v. Predicted gains g [3] add g v (elementwise) to a displacement.

    The network rounds positions to cells, and so does not see motions below a cell. v is the slope of the line through
    the means of a particle's window in the clouds of an encoded history; each step with displacement d changes it to
    (v + d) / 2. With four encoded clouds both are mean velocities 1.5 steps before the newest position. Gradients flow
    through displacements, not through encoded velocities.
    """

    attributes = ("velocity",)
    n_features = n_gains = 3
    is_local = True

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        if frames is None or ctx.is_empty:
            return particles
        return replace(particles, velocity=ctx.scatter_newest(window_velocity(ctx, self.config.radius)))

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.scatter_newest(ctx.state.velocity) / ctx.grid_size

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        return replace(motion, gained=motion.gained + bounded_gains(gains)[:, 0] * ctx.state.velocity)

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        moved = step.means - ctx.state.means
        return replace(step, velocity=torch.lerp(moved, ctx.state.velocity, SMOOTHING))


@torch.no_grad()
def window_velocity(ctx: StepContext, radius: float) -> Tensor:
    """Velocity [N, 3] in m/step of the newest particles: the slope of the line through the means of their window over
    the history, by least squares; 0 of particles that cannot move, and in scenes with a single step."""
    particles, steps = ctx.history, ctx.history.clouds.steps
    begins = [0, *(q + 1 for q in ctx.newest[:-1])]
    older = [[f for f in range(b, q) if steps[q] - steps[f] < ctx.max_steps] for b, q in zip(begins, ctx.newest)]
    slopes = [slope_weights([steps[q] - steps[f] for f in some]) for some, q in zip(older, ctx.newest)]
    with torch.autocast(particles.means.device.type, enabled=False):
        movable = ctx.movable
        windows, now = Windows(movable, particles, radius, evenly=False), movable.samples
        velocity = torch.zeros_like(windows.nodes)
        divisors = constant(tuple(divisor for _, divisor in slopes), velocity.device)
        for number in range(max(map(len, older))):
            chosen = [some[number] if number < len(some) else q for some, q in zip(older, ctx.newest)]
            then = Samples(Subset(PaddedClouds(particles, chosen, ctx.grid_size), particles))
            then.center(movable.center)
            weights = constant(tuple(some[number] if number < len(some) else 0 for some, _ in slopes), velocity.device)
            weights = torch.where((now.n > 0) & (then.n > 0), weights, 0) / divisors
            moved = mean_shift(now, then, windows.nodes, radius)
            velocity = velocity + weights.to(moved)[:, None, None] * moved
        return movable.scatter(*windows.to_particles(velocity))


def slope_weights(ages: list[int]) -> tuple[list[int], int]:
    """Weights, and what divides them, of the displacements since points of these ages in the slope of the line through
    them and the newest point, by least squares."""
    count, total = len(ages) + 1, sum(ages)
    divisor = count * sum(age**2 for age in ages) - total**2
    return [count * age - total for age in ages], max(1, divisor)
