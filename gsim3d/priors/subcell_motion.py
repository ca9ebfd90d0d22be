"""Positions and displacements below the size of a cell, which the network's grid rounds away."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.priors.position_waves import relative_positions
from gsim3d.state import Particles


@dataclass(frozen=True)
class SubcellMotionConfig(PriorConfig):
    """Features of positions inside the cells of the network, and of the last displacements. It has no settings."""

    type = "subcell_motion"


class SubcellMotion(Prior, config=SubcellMotionConfig):
    """Features: the position inside its cell in [-1, 1], and the displacement of the last step in cells, which is 0 for
    encoded particles. It changes no displacement. Gradients flow through both.
    """

    attributes = ("velocity",)
    n_features = 6

    def features(self, ctx: StepContext) -> Tensor:
        cells = relative_positions(ctx.history) / ctx.grid_size
        with torch.no_grad():
            corners = torch.floor(cells)
        inside = (2 * (cells - corners) - 1).to(ctx.history.means)
        return torch.cat([inside, ctx.history.velocity / ctx.grid_size], 1)

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        return replace(step, velocity=step.means - ctx.state.means)
