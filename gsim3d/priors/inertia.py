"""Inertia: particles continue the rigid motion of their window, modified by predicted gains."""

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
    """Rigid velocity field of the movable particles.

    Attributes:
        radius: standard deviation in metres of the windows; about the radius of a body.
        rotate_appearance: rotates Gaussians with their window. Not for explicit models.
    """

    type = "inertia"
    radius: float = 0.3
    rotate_appearance: bool = False

    RANGES = {"radius": (1e-6, 1e6)}


class Inertia(Prior, config=InertiaConfig):
    """Let V_1 be the mean displacement of the window of a particle in the last step, V_2 the displacement if the rigid
    motion of the window continues, and V_3 the particle's own last displacement. The inertial displacement is V_2, and
    predicted gains g [3, 3] add sum_k g_k V_k (elementwise). An impulse on some particles of a body changes the rigid
    motion of the whole body in the next step. Gradients flow through velocities.
    """

    n_conv_features, n_features, n_gains = 6, 3, 9

    def __init__(self, config: InertiaConfig):
        super().__init__(config)
        self.latent_only = config.rotate_appearance
        self.attributes = ("velocity", "orientations") if config.rotate_appearance else ("velocity",)

    def velocities(self, ctx: StepContext) -> Tensor:
        """V [N, 3, 3] in m/step."""
        return ctx.cached("velocities", lambda: _velocities(ctx.windows(self.config.radius), ctx.state.velocity))

    def conv_features(self, ctx: StepContext) -> Tensor:
        return ctx.scatter_newest(self.velocities(ctx)[:, :2]).flatten(1) / ctx.grid_size

    def features(self, ctx: StepContext) -> Tensor:
        return ctx.scatter_newest(self.velocities(ctx)[:, 2:]).flatten(1) / ctx.grid_size

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
    """V [N, 3, 3] in m/step of particles whose last displacement is ``own`` [N, 3]."""
    movable = windows.movable
    with torch.autocast(own.device.type, enabled=False):
        found = windows.to_particles(*_rigid_motion(windows, own, since=True))
        rigid = movable.scatter(found[0]), movable.scatter(next_displacement(movable.positions, *found))
    return torch.stack([*rigid, own], 1)


def _rigid_motion(windows: Windows, moved: Tensor, since: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Fits a rigid motion to displacements ``moved`` [N, 3] that start, or ``since`` then end, at the positions:
    displacement, spin (rad) and center of each window, [B, G, 3] each."""
    samples, half = windows.movable.samples, -0.5 if since else 0.5
    paths = samples.take(windows.movable.gather(moved))
    body = RigidFit(windows.weights, samples.positions + half * paths, windows.radius)
    velocity, fitted = body.fit(paths)
    return velocity, spin_of(fitted), body.center - half * velocity


@torch.no_grad()
def rotate_with_window(windows: Windows, orientations: Tensor, moved: Tensor) -> Tensor:
    """Rotates ``orientations`` [N, 4] (w, x, y, z) by the spin of the displacements ``moved`` [N, 3] in each window."""
    with torch.autocast(moved.device.type, enabled=False):
        _, spin, _ = _rigid_motion(windows, moved, since=False)
        (spin,) = windows.to_particles(spin)
        return rotate_left(orientations, windows.movable.scatter(spin))
