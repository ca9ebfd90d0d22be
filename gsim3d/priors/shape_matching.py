"""Shape matching: bodies go back to their rest shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext, bounded_gains
from gsim3d.priors.movable import Windows
from gsim3d.priors.rigid import best_rotation
from gsim3d.state import Particles


@dataclass(frozen=True)
class ShapeMatchingConfig(PriorConfig):
    """Displacements towards the shape at the start of a simulation.

    Attributes:
        radius: metres, standard deviation of the windows that keep their shape; about the radius of a body.
        stiffness: share of the way back that a particle goes in a step without gains.
        position_gradients: whether gradients flow from the way back to positions. Without them the stiffness of bodies
            is learned wrongly over many steps.
    """

    type = "shape_matching"
    radius: float = 0.3
    stiffness: float = 1.2
    position_gradients: bool = True

    RANGES = {"radius": (1e-6, 1e6), "stiffness": (0, 100)}


class ShapeMatching(Prior, config=ShapeMatchingConfig):
    """Let w be the way from a particle to where it would be if the window around it had only moved and turned since the
    start. The elastic displacement is (stiffness + g) w, with predicted gains g along each axis.

    What pulls an elastic body back is a function of w, and a history of a few steps does not show it.

    Source:
        shape matching, Mueller et al. 2005.
    """

    attributes = ("rest_positions",)
    n_features, n_gains = 3, 3

    def residual(self, ctx: StepContext) -> Tensor:
        """[N, 3] metres, w; without gradients."""
        make = lambda: shape_residual(ctx.windows(self.config.radius), ctx.history, ctx.state)  # noqa: E731
        return ctx.once("shape residual", make)

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.of_all(self.residual(ctx)) / ctx.grid_size

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        way, gain = self.residual(ctx).to(motion.gained.dtype), bounded_gains(gains)[:, 0]
        if not self.config.position_gradients:
            return replace(motion, gained=motion.gained + gain * way, elastic=self.config.stiffness * way)
        means = ctx.state.means
        return replace(motion, elastic=(self.config.stiffness + gain) * (way - (means - means.detach())))


@torch.no_grad()
def shape_residual(windows: Windows, history: Particles, state: Particles) -> Tensor:
    """[N, 3] metres, from each movable particle to its place in the rest shape, moved and turned as the window around
    it; 0 for others."""
    movable, rest = windows.movable, state.rest_positions
    with torch.autocast(rest.device.type, enabled=False):
        before = (movable.padded(rest).double() - history.origin[movable.scenes][:, None]).to(rest.dtype)
        then, now = movable.samples.take(before), movable.samples
        there = now.mean_of(then)[:, None]
        then, before = torch.where(now.known[:, :, None], then - there, 0), before - there
        center, began = windows.weights @ now.positions, windows.weights @ then
        products = windows.weights @ (now.positions[:, :, :, None] * then[:, :, None]).flatten(2)
        turns = best_rotation(products.unflatten(2, (3, 3)) - center[:, :, :, None] * began[:, :, None])
        shifts = center - (turns @ began[:, :, :, None])[..., 0]
        *columns, shift = windows.to_particles(*turns.unbind(3), shifts)
        way = (torch.stack(columns, 3) @ before[:, :, :, None])[..., 0] + shift - movable.positions
        return movable.packed(way)
