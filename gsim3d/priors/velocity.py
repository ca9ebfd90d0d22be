"""Velocity: a step carries velocities on, and the network predicts their changes."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext, bounded_gains
from gsim3d.priors.movable import Windows
from gsim3d.priors.padding import PaddedClouds, Samples, Subset, mean_shift
from gsim3d.state import Particles, constant

SMOOTHING = 0.5  # share of the old mean velocity in the new one


@dataclass(frozen=True)
class VelocityConfig(PriorConfig):
    """Velocities of the movable particles.

    Attributes:
        radius: standard deviation in metres of the windows that encoded clouds share; about the radius of a body.
    """

    type = "velocity"
    version: int = 3
    radius: float = 0.3

    RANGES = {"radius": (1e-6, 1e6)}


class Velocity(Prior, config=VelocityConfig):
    """Adds g_1 v_1 + (1 + g_2) v_2 (elementwise) to a displacement, of the last displacement v_1, the mean velocity v_2
    and gains g [2, 3]: the network predicts changes, as graph network simulators do (Sanchez-Gonzalez et al. 2020).

    In encoded clouds v_1 is the displacement of the mean of a particle's window since the cloud before, and v_2 the
    slope of the line through all, or what ``velocity_from_images`` before it in the list has found. A displacement d
    changes v_2 to (v_2 + d) / 2, which lags behind by 1.5 steps, as that of four clouds. Gradients flow through
    displacements, not through encoded velocities.
    """

    attributes = ("velocity", "mean_velocity")
    n_gains = 6
    is_local = True

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        if frames is None or ctx.is_empty:
            return particles
        last, mean = map(ctx.scatter_newest, window_velocities(ctx, self.config.radius))
        mean = mean if ctx.priors.get("velocity_from_images") is None else particles.velocity
        return replace(particles, velocity=last, mean_velocity=mean)

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        g_1, g_2 = bounded_gains(gains).unbind(1)
        return replace(motion, gained=motion.gained + g_1 * ctx.state.velocity + (1 + g_2) * ctx.state.mean_velocity)

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        moved = step.means - ctx.state.means
        return replace(step, velocity=moved, mean_velocity=torch.lerp(moved, ctx.state.mean_velocity, SMOOTHING))


@torch.no_grad()
def window_velocities(ctx: StepContext, radius: float) -> tuple[Tensor, Tensor]:
    """Last displacement and mean velocity [N, 3] in m/step of the newest particles, see :class:`Velocity`; 0 of
    particles that cannot move, and in scenes with a single step."""
    particles, steps = ctx.history, ctx.history.clouds.steps
    ends = zip([0, *(q + 1 for q in ctx.newest[:-1])], ctx.newest)
    older = [[f for f in range(q - 1, b - 1, -1) if steps[q] - steps[f] < ctx.max_steps] for b, q in ends]
    ages = [[steps[q] - steps[f] for f in some] for some, q in zip(older, ctx.newest)]
    slopes = [slope_weights(some) for some in ages]
    with torch.autocast(particles.means.device.type, enabled=False):
        movable = ctx.movable
        windows, now = Windows(movable, particles, radius, evenly=False), movable.samples
        last = mean = torch.zeros_like(windows.nodes)

        def of_scenes(values: list[int]) -> Tensor:
            return constant(tuple(values), last.device).to(last)[:, None, None]

        for number in range(max(map(len, older))):  # from the cloud before the newest on
            chosen = [(*some, *[q] * (number + 1))[number] for some, q in zip(older, ctx.newest)]
            then = Samples(Subset(PaddedClouds(particles, chosen, ctx.grid_size), particles))
            then.center(movable.center)
            known = ((now.n > 0) & (then.n > 0))[:, None, None]
            moved = torch.where(known, mean_shift(now, then, windows.nodes, radius), 0)
            weights = of_scenes([(*some, *[0] * (number + 1))[number] for some, _ in slopes])
            mean = mean + moved * weights / of_scenes([divisor for _, divisor in slopes])
            if number == 0:
                last = moved / of_scenes([(*some, 1)[0] for some in ages])
        return tuple(map(movable.scatter, windows.to_particles(last, mean)))


def slope_weights(ages: list[int]) -> tuple[list[int], int]:
    """Weights, and their divisor, of the displacements since points of these ages in the slope of their line."""
    count, total = len(ages) + 1, sum(ages)
    divisor = count * sum(age**2 for age in ages) - total**2
    return [count * age - total for age in ages], max(1, divisor)
