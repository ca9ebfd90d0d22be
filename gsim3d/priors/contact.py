"""Contact response: non-penetration of the static background, with Coulomb friction."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gsim3d.priors.base import Motion, Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Windows
from gsim3d.priors.proximity import ContactGeometry
from gsim3d.priors.rigid import SMALLEST, RigidFit


@dataclass(frozen=True)
class ContactConfig(PriorConfig):
    """Contact with the static background.

    Attributes:
        friction: initial Coulomb coefficient; learned.
        offset: initial contact offset in metres: particles stop at this height. Learned, because encoded particles lie
            below the surface of their body.
        offset_unit: metres a unit of the offset parameter; scales its learning rate.
        rigid: corrects a body as a whole by the rigid part of its contact corrections.
        radius: standard deviation in metres of the windows around bodies.
        exponent: gained displacements move a body as a whole with weight ``proximity ** exponent``.
        min_opacity: smallest opacity of particles in contact, if ``rigid``; fainter ones may lie outside their body.
        iterations: rigid corrections a step.
        max_scale: largest over-relaxation factor of a rigid correction.
        min_speed: tangential speed in m/step below which a particle in contact sticks.
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
        "friction": (0, 1e6), "offset": (-1e6, 1e6), "offset_unit": (1e-9, 1e6), "radius": (1e-6, 1e6),
        "exponent": (0, 100), "min_opacity": (0, 1), "iterations": (1, 100), "max_scale": (1, 1e6),
        "min_speed": (1e-12, 1e6),
    }  # fmt: skip


class Contact(Prior, config=ContactConfig):
    """Let h be the height of a particle over the local plane of the background, n the normal, and d the displacement.
    The normal component is clamped, d_n >= -max(h - offset, 0). The tangential component is reduced by at most friction
    times the change of the normal component. If ``rigid``, the corrections are projected on rigid motions of the body.

    Internal forces conserve momentum: the rigid part of elastic displacements, and of gained displacements away from
    the background, is removed. The network predicts gains only, so it controls stiffness and damping of bodies and not
    their path.
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
    """Projects displacements of the newest particles so that they do not enter the background. ``friction`` [] and
    ``offset`` [] in metres are differentiable."""

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
        # Zero in the forward pass: gradients of height and proximity with respect to positions.
        raised = ((means - means.detach()) * self._normal).sum(1, keepdim=True)
        self._height = height + raised - offset
        power = config.exponent
        self._near = geometry.proximity**power * (1 - power / geometry.range**2 * height * raised)

    def displacements(self, inertial: Tensor, gained: Tensor, elastic: Tensor) -> Tensor:
        """Displacements [N, 3] in metres after the contact response. Gradients flow to all three terms, friction,
        offset, and positions by way of height and proximity."""
        with torch.autocast(inertial.device.type, enabled=False):
            internal = (1 - self._near) * gained + elastic
            moves = inertial + self._near * gained + internal - self._rigid_part(internal)
            for _ in range(self._config.iterations if self._config.rigid else 0):
                moves = moves + self._rigid_correction(self._correction(moves))
            return moves + self._correction(moves)

    def _rigid_correction(self, corrections: Tensor) -> Tensor:
        """Rigid part of ``corrections``, scaled by the factor that minimises the squared remaining corrections."""
        moves = self._rigid_part(corrections)
        with torch.no_grad():
            lacking, done = (self._windows.mean((corrections * x).sum(1, keepdim=True)) for x in (corrections, moves))
            scale = (lacking / done.clamp(min=SMALLEST)).clamp(1, self._config.max_scale)
        return scale * moves

    def _rigid_part(self, moves: Tensor) -> Tensor:
        """Rigid motion [N, 3] fitted to ``moves`` in the window of each particle."""
        movable = self._movable
        found = self._body.fit(movable.samples.take(movable.gather(moves)))
        moved, spin = self._windows.to_particles(*found)
        return movable.scatter(moved + torch.linalg.cross(spin, movable.positions - self._centers))

    def _correction(self, moves: Tensor) -> Tensor:
        """Correction [N, 3] that stops ``moves`` at the surface, with friction; penetrating particles may stay."""
        into = (moves * self._normal).sum(1, keepdim=True)
        stop = torch.minimum((-into).clamp(min=0), (-self._height - into).clamp(min=0))
        along = moves - into * self._normal
        if self._stops is not None:
            stop = stop * self._stops
        speed = along.square().sum(1, keepdim=True).clamp(min=self._config.min_speed**2).sqrt()
        held = (self._friction.clamp(min=0) * stop / speed).clamp(max=1)
        return stop * self._normal - held * along
