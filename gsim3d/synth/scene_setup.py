"""Input of an engine (bodies, cloth and ground at time 0, in SI units), and checks of its output."""

from dataclasses import dataclass

import numpy as np

from gsim3d.errors import NumericalError

GRAVITY = 9.81  # m/s^2, along -z
# Limits beyond which a simulation has failed.
MAX_STRETCH = 2.0  # factor on the diagonal of a body's bounding box
MAX_SINK = 0.1  # depth below the ground over the body's height
MAX_THROUGH = 0.03  # depth of a body below the cloth, or of the cloth below the ground, in metres
STORED = 0.5  # longest time in seconds that a body stores elastic energy
MAX_GAIN = 0.3  # gain of energy in J/kg, as of a fall of 3 cm; the error of centers is about a third of it


@dataclass(frozen=True)
class Material:
    """Material of a soft body."""

    young: float  #: Young's modulus in Pa
    damping: float  #: damping time in seconds
    yield_strain: float = 0.0  #: strain at which plastic deformation begins; 0: purely elastic


@dataclass(frozen=True)
class SoftBody:
    """A soft body."""

    vertices: np.ndarray  #: collision mesh [V, 3], world coordinates in metres
    faces: np.ndarray  #: collision mesh [F, 3]
    velocity: np.ndarray  #: [3] in m/s
    spin: np.ndarray  #: [3] in rad/s about the center
    material: Material  #: material of the body
    mass: float  #: mass in kg
    cells: int  #: cells of the control grid along each axis


@dataclass(frozen=True)
class RigidBody:
    """A rigid body."""

    parts: tuple[np.ndarray, ...]  #: vertices [V, 3] of the convex pieces of the body, world coordinates in metres
    velocity: np.ndarray  #: [3] in m/s
    spin: np.ndarray  #: [3] in rad/s about the center
    mass: float  #: mass in kg
    friction: float  #: coefficient of sliding friction
    bounce: float  #: approximate coefficient of restitution in [0, 1]


@dataclass(frozen=True)
class Cloth:
    """A square cloth, flat at time 0, whose corners are fixed or which grippers hold."""

    width: float  #: width in metres
    height: float  #: height at time 0 in metres
    count: int  #: nodes along a side
    mass: float  #: mass in kg
    young: float  #: Young's modulus in Pa
    thickness: float  #: thickness in metres, for the stiffness
    damping: float  #: damping time in seconds
    held: tuple[int, ...] | None = None  #: indices of the nodes that grippers hold; None: the four corners are fixed

    def rest_nodes(self) -> np.ndarray:
        """Nodes at time 0 [n, n, 3], world coordinates in metres."""
        part = self.width * (np.arange(self.count) / (self.count - 1) - 0.5)
        return np.stack(np.meshgrid(part, part, [self.height], indexing="ij"), -1)[:, :, 0]


@dataclass(frozen=True)
class Pusher:
    """A kinematic sphere."""

    position: np.ndarray  #: center at time 0 [3] in metres
    radius: float  #: radius in metres


@dataclass(frozen=True)
class SceneSetup:
    """A scene at time 0."""

    bodies: tuple[SoftBody | RigidBody, ...]  #: soft or rigid bodies
    ground: float | None  #: height of the ground in metres; None: no ground
    cloth: Cloth | None = None  #: cloth; None: no cloth
    pusher: Pusher | None = None  #: kinematic sphere; None: no sphere
    #: positions of the grippers of the cloth at every frame [T, G, 3] in metres; None: no grippers
    grips: np.ndarray | None = None


def turn_about_z(angle: float) -> np.ndarray:
    """Rotation matrix [3, 3] about the z axis by ``angle`` rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


class Unstable(NumericalError):
    """The simulation has failed: a body exploded, or passed through ground or cloth."""


def check_motion(vertices: np.ndarray, ground: float | None) -> None:
    """Raises Unstable if a body ``vertices`` [T, V, 3] changes its size too much or sinks into the ground."""
    if not np.isfinite(vertices).all():
        raise Unstable("positions are not finite")
    size = np.linalg.norm(np.ptp(vertices, axis=1), axis=-1)
    if (size > MAX_STRETCH * size[0]).any() or (size < size[0] / MAX_STRETCH).any():
        raise Unstable("a body was torn apart or crushed")
    if ground is not None and vertices[..., 2].min() < ground - MAX_SINK * np.ptp(vertices[0, :, 2]):
        raise Unstable("a body sank into the ground")


def check_energy(centres: np.ndarray, masses: np.ndarray, spin: float, fps: float) -> None:
    """Raises Unstable if bodies gain energy over longer than the STORED seconds in which a compressed body releases its
    own. ``centres`` of the bodies [B, T, 3] in metres, ``masses`` [B] in kg, rotational energy ``spin`` at first in
    J/kg."""
    if centres.shape[1] < 2:
        return
    speed = np.diff(centres, axis=1) * fps
    height = (centres[:, 1:, 2] + centres[:, :-1, 2]) / 2
    energy = (masses[:, None] * (GRAVITY * height + (speed**2).sum(-1) / 2)).sum(0) / masses.sum()
    window = max(1, round(STORED * fps))
    largest = np.array([energy[t : t + window].max() for t in range(len(energy))])
    if (largest > np.minimum.accumulate(largest) + spin + MAX_GAIN).any() or energy.max() > energy[0] + spin + MAX_GAIN:
        raise Unstable("bodies gained energy")


def check_cloth(bodies: list[np.ndarray], cloth: np.ndarray, ground: float | None) -> None:
    """Raises Unstable if ``bodies`` [T, V, 3] pass through ``cloth`` [T, n, n, 3], or the cloth through the ground."""
    if not np.isfinite(cloth).all():
        raise Unstable("positions of the cloth are not finite")
    if ground is not None and cloth[..., 2].min() < ground - MAX_THROUGH:
        raise Unstable("the cloth sank into the ground")
    for body in bodies:
        if max(depth_below_cloth(points, nodes) for points, nodes in zip(body, cloth)) > MAX_THROUGH:
            raise Unstable("a body went through the cloth or fell beside it")


def depth_below_cloth(points: np.ndarray, cloth: np.ndarray) -> float:
    """Depth of the deepest of ``points`` [N, 3] below the nearest node of ``cloth`` [n, n, 3] in metres; negative if
    all are above it."""
    nodes = cloth.reshape(-1, 3)
    low, high = nodes[:, :2].min(0), nodes[:, :2].max(0)
    spacing = float(np.max(high - low)) / (cloth.shape[0] - 1)
    n_cells = np.floor((high - low) / spacing).astype(np.int64) + 1
    lowest = np.full(tuple(n_cells), np.inf)
    cell = np.minimum(np.floor((nodes[:, :2] - low) / spacing).astype(np.int64), n_cells - 1)
    np.minimum.at(lowest, tuple(cell.T), nodes[:, 2])
    index = np.floor((points[:, :2] - low) / spacing).astype(np.int64)
    over = ((index >= 0) & (index < n_cells)).all(1)
    heights = lowest[tuple(index[over].T)]
    below = heights - points[over, 2]
    below = below[np.isfinite(below)]
    return float(below.max()) if len(below) else -np.inf
