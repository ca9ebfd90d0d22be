"""Inertia: particles go on with the rigid motion of those around them, unless predicted gains change it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.math.rotations import rotate_left
from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext, bounded_gains
from gsim3d.priors.movable import Windows
from gsim3d.priors.rigid import RigidFit, next_displacement, spin_of
from gsim3d.state import Particles


@dataclass(frozen=True)
class InertiaConfig(PriorConfig):
    """Rigid motions of windows, which go on.

    Attributes:
        radius: metres, standard deviation of the windows; about the radius of a body.
        rotate_appearance: whether what is drawn turns with the particles around it. Needs a latent model.
    """

    type = "inertia"
    radius: float = 0.3
    rotate_appearance: bool = False

    RANGES = {"radius": (1e-6, 1e6)}


class Inertia(Prior, config=InertiaConfig):
    """Let V be three displacements a step of each particle: of the window around it, of the rigid motion of that window
    if it goes on and turns as one body, and its own last one. The inertial displacement is V_2, and predicted gains
    g [3, 3] add sum_k g_k V_k along each axis. What a contact did to some particles of a body in the last step is part
    of the momentum of the body at once, and gradients flow through velocities.
    """

    n_conv_features, n_features, n_gains = 6, 3, 9

    def __init__(self, config: InertiaConfig):
        super().__init__(config)
        self.latent_only = config.rotate_appearance
        self.attributes = ("velocity", "orientations") if config.rotate_appearance else ("velocity",)

    def velocities(self, ctx: StepContext) -> Tensor:
        """[N, 3, 3] metres a step, V."""
        return ctx.once("velocities", lambda: _velocities(ctx.windows(self.config.radius), ctx.state.velocity))

    def conv_features(self, ctx: StepContext) -> Tensor:
        return ctx.of_all(self.velocities(ctx)[:, :2]).flatten(1) / ctx.grid_size

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.of_all(self.velocities(ctx)[:, 2:]).flatten(1) / ctx.grid_size

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        velocities = self.velocities(ctx)
        gained = (bounded_gains(gains) * velocities).sum(1)
        return replace(motion, inertial=velocities[:, 1], gained=gained)

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        step = replace(step, velocity=step.means - ctx.state.means)
        if not self.config.rotate_appearance:
            return step
        turned = rotate_with_window(ctx.windows(self.config.radius), ctx.state.orientations, step.velocity)
        return replace(step, orientations=turned)


def _velocities(windows: Windows, own: Tensor) -> Tensor:
    """[N, 3, 3] metres a step, for particles whose own last displacement is ``own`` [N, 3]."""
    movable = windows.movable
    with torch.autocast(own.device.type, enabled=False):
        found = windows.to_particles(*_rigid_motion(windows, own, since=True))
        rigid = movable.packed(found[0]), movable.packed(next_displacement(movable.positions, *found))
    return torch.stack([*rigid, own], 1)


def _rigid_motion(windows: Windows, moved: Tensor, since: bool) -> tuple[Tensor, Tensor, Tensor]:
    """The displacement of each window, its spin (rad) and its center, [B, G, 3] each, of particles that moved by
    ``moved`` [N, 3], from where they are or, ``since`` then, to there."""
    samples, half = windows.movable.samples, -0.5 if since else 0.5
    paths = samples.take(windows.movable.padded(moved))
    body = RigidFit(windows.weights, samples.positions + half * paths, windows.radius)
    velocity, fitted = body.fit(paths)
    return velocity, spin_of(fitted), body.center - half * velocity


@torch.no_grad()
def rotate_with_window(windows: Windows, orientations: Tensor, moved: Tensor) -> Tensor:
    """[N, 4] (w, x, y, z), ``orientations`` after a step by ``moved`` [N, 3], turned with the particles around each."""
    with torch.autocast(moved.device.type, enabled=False):
        _, spin, _ = _rigid_motion(windows, moved, since=False)
        (spin,) = windows.to_particles(spin)
        return rotate_left(orientations, windows.movable.packed(spin))
