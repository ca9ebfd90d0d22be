"""Shape matching: elastic displacements towards the rest shape."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext, bounded_gains
from gsim3d.priors.movable import Windows
from gsim3d.priors.rigid import best_rotation
from gsim3d.state import Particles


@dataclass(frozen=True)
class ShapeMatchingConfig(PriorConfig):
    """Shape matching to the positions at the start of the simulation.

    Attributes:
        radius: standard deviation in metres of the windows that keep their shape; about the radius of a body.
        stiffness: fraction of the residual that a step corrects without gains.
        position_gradients: whether gradients flow from the residual to positions. Without them, long rollouts learn a
            wrong stiffness.
    """

    type = "shape_matching"
    radius: float = 0.3
    stiffness: float = 1.2
    position_gradients: bool = True

    RANGES = {"radius": (1e-6, 1e6), "stiffness": (0, 100)}


class ShapeMatching(Prior, config=ShapeMatchingConfig):
    """Let w be the vector from a particle to its goal position: its rest position under the rigid motion of its window
    since the start. The elastic displacement is (stiffness + g) w, with predicted gains g along each axis.

    Source:
        Mueller et al. 2005, Meshless Deformations Based on Shape Matching.
    """

    attributes = ("rest_positions",)
    n_features, n_gains = 3, 3

    def residual(self, ctx: StepContext) -> Tensor:
        """Residual w [N, 3] in metres, without gradients."""
        make = lambda: shape_residual(ctx.windows(self.config.radius), ctx.history, ctx.state)  # noqa: E731
        return ctx.cached("shape residual", make)

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.scatter_newest(self.residual(ctx)) / ctx.grid_size

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        residual, gain = self.residual(ctx).to(motion.gained.dtype), bounded_gains(gains)[:, 0]
        if not self.config.position_gradients:
            return replace(motion, gained=motion.gained + gain * residual, elastic=self.config.stiffness * residual)
        means = ctx.state.means
        return replace(motion, elastic=(self.config.stiffness + gain) * (residual - (means - means.detach())))


@torch.no_grad()
def shape_residual(windows: Windows, history: Particles, state: Particles) -> Tensor:
    """Vector [N, 3] in metres from each movable particle to its goal position; 0 for other particles."""
    movable, rest = windows.movable, state.rest_positions
    with torch.autocast(rest.device.type, enabled=False):
        rest_positions = (movable.gather(rest).double() - history.origin[movable.scenes][:, None]).to(rest.dtype)
        rest_samples, samples = movable.samples.take(rest_positions), movable.samples
        rest_mean = samples.mean_of(rest_samples)[:, None]
        rest_samples = torch.where(samples.known[:, :, None], rest_samples - rest_mean, 0)
        rest_positions = rest_positions - rest_mean
        center, rest_center = windows.weights @ samples.positions, windows.weights @ rest_samples
        products = windows.weights @ (samples.positions[:, :, :, None] * rest_samples[:, :, None]).flatten(2)
        rotations = best_rotation(products.unflatten(2, (3, 3)) - center[:, :, :, None] * rest_center[:, :, None])
        shifts = center - (rotations @ rest_center[:, :, :, None])[..., 0]
        *columns, shift = windows.to_particles(*rotations.unbind(3), shifts)
        residual = (torch.stack(columns, 3) @ rest_positions[:, :, :, None])[..., 0] + shift - movable.positions
        return movable.scatter(residual)
