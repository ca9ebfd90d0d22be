"""Contact response: the static background stops what would get behind it, with friction."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Windows
from gsim3d.priors.proximity import ContactGeometry
from gsim3d.priors.rigid import SMALLEST, RigidFit


@dataclass(frozen=True)
class ContactConfig(PriorConfig):
    """Non-penetration of the static background.

    Attributes:
        friction: Coulomb coefficient, at first; it is learned.
        offset: metres over the background at which particles stop, at first; learned: they are seen inside of bodies.
        offset_unit: metres, of the parameter: training changes it by little.
        rigid: what stops some particles of a body stops it as a whole in the same step.
        radius: metres, standard deviation of the windows that are a body.
        exponent: gained displacements move bodies as a whole as far as proximity to the background to this power.
        min_opacity: of particles that stop a rigid body; fainter ones lie outside of the bodies that they are seen of.
        iterations: in which a rigid body gets out of the background.
        max_scale: of the correction of one iteration over its mean.
        min_speed: metres a step along a surface; slower particles are held.
    """

    type = "contact"
    friction: float = 1.0
    offset: float = 0.02
    offset_unit: float = 0.1
    rigid: bool = False
    radius: float = 0.3
    exponent: float = 4
    min_opacity: float = 0.5
    iterations: int = 3
    max_scale: float = 50.0
    min_speed: float = 1e-6

    RANGES = {
        "friction": (0, 1e6),
        "offset": (-1e6, 1e6),
        "offset_unit": (1e-9, 1e6),
        "radius": (1e-6, 1e6),
        "exponent": (0, 100),
        "min_opacity": (0, 1),
        "iterations": (1, 100),
        "max_scale": (1, 1e6),
        "min_speed": (1e-12, 1e6),
    }


class Contact(Prior, config=ContactConfig):
    """Let h be the height of a particle over the plane of the background near it, n its normal, d its displacement. The
    normal component is clamped, d_n >= -max(h - offset, 0); the tangential part shrinks by at most friction times what
    the normal part lost. If ``rigid``, these corrections are projected on the rigid motions of the body.

    Internal forces conserve momentum: of elastic displacements, and of gained ones away from the background, the rigid
    part in the window of the body is taken out. The network predicts gains only: how stiff and damped bodies are, and
    not where they go.
    """

    requires = ("segmentation", "proximity", "inertia")
    replaces_displacement = True

    def __init__(self, config: ContactConfig):
        super().__init__(config)
        self.friction = nn.Parameter(torch.tensor(config.friction))
        self.offset = nn.Parameter(torch.tensor(config.offset / config.offset_unit))

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        geometry = ctx.priors.get("proximity").geometry(ctx)
        offset = self.config.offset_unit * self.offset
        solver = ContactSolver(ctx, geometry, self.config, self.friction, offset)
        moved = solver.displacements(motion.inertial, motion.gained, motion.elastic)
        return Motion.of_network(moved)


class ContactSolver:
    """Displacements of the newest particles of a step that do not enter the background.

    Args:
        ctx: of the step.
        geometry: of the background near the movable particles.
        config: of :class:`Contact`.
        friction, offset: numbers, of which gradients are taken.
    """

    def __init__(
        self, ctx: StepContext, geometry: ContactGeometry, config: ContactConfig, friction: Tensor, offset: Tensor
    ):
        self._windows: Windows = ctx.windows(config.radius)
        self._movable, self._config, self._friction = ctx.movable, config, friction
        means = ctx.state.means
        with torch.no_grad(), torch.autocast(means.device.type, enabled=False):
            self._body = RigidFit(self._windows.weights, self._movable.samples.positions, config.radius)
            (self._centers,) = self._windows.to_particles(self._body.center)
        height, self._normal = geometry.surface(self._centers)
        self._stops = ctx.state.opacities.detach()[:, None] >= config.min_opacity if config.rigid else None
        # For gradients: a particle that is stopped comes to the same height wherever it was, and a higher one is less
        # near.
        raised = ((means - means.detach()) * self._normal).sum(1, keepdim=True)
        self._height = height + raised - offset
        power = config.exponent
        self._near = geometry.proximity**power * (1 - power / geometry.range**2 * height * raised)

    def displacements(self, inertial: Tensor, gained: Tensor, elastic: Tensor) -> Tensor:
        """[N, 3] metres in a step.

        Gradients:
            of all three, of friction and offset, and of positions as far as they decide where particles stop and
        how near the background they are.
        """
        with torch.autocast(inertial.device.type, enabled=False):
            internal = (1 - self._near) * gained + elastic
            moves = inertial + self._near * gained + internal - self._rigid_part(internal)
            for _ in range(self._config.iterations if self._config.rigid else 0):
                moves = moves + self._rigid_correction(self._correction(moves))
            return moves + self._correction(moves)

    def _rigid_correction(self, corrections: Tensor) -> Tensor:
        """The rigid part of ``corrections``, scaled so that the squares of what its particles still lack are least."""
        moves = self._rigid_part(corrections)
        with torch.no_grad():
            lacking, done = (self._windows.mean((corrections * x).sum(1, keepdim=True)) for x in (corrections, moves))
            scale = (lacking / done.clamp(min=SMALLEST)).clamp(1, self._config.max_scale)
        return scale * moves

    def _rigid_part(self, moves: Tensor) -> Tensor:
        """[N, 3], of ``moves`` the rigid motion of the window around each particle."""
        movable = self._movable
        found = self._body.fit(movable.samples.take(movable.padded(moves)))
        moved, spin = self._windows.to_particles(*found)
        return movable.packed(moved + torch.linalg.cross(spin, movable.positions - self._centers))

    def _correction(self, moves: Tensor) -> Tensor:
        """[N, 3], what stops ``moves`` at the surface, with friction. A particle behind it may stay there."""
        into = (moves * self._normal).sum(1, keepdim=True)
        stop = torch.minimum((-into).clamp(min=0), (-self._height - into).clamp(min=0))
        along = moves - into * self._normal
        if self._stops is not None:
            stop = stop * self._stops
        speed = along.square().sum(1, keepdim=True).clamp(min=self._config.min_speed**2).sqrt()
        held = (self._friction.clamp(min=0) * stop / speed).clamp(max=1)
        return stop * self._normal - held * along
