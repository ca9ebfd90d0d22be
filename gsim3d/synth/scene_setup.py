"""The input of an engine: bodies, a cloth and a ground at time 0, in metres, seconds and kilograms; and checks of what
it returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81  # m/s^2, along -z
MAX_STRETCH = 2.0  # a body's bounding box longer or shorter than so many times at rest: the simulation has failed
MAX_SINK = 0.1  # of the body height below the ground: the same
MAX_THROUGH = 0.03  # metres of a body below the cloth over it, or of the cloth below the ground: the same
STORED = 0.5  # seconds that a body stays squeezed at most
MAX_GAIN = 0.3  # J/kg that bodies may gain: what a fall of 3 cm gives; centres are known to about a third of it


@dataclass(frozen=True)
class Material:
    """Material of a soft body.

    Attributes:
        young: Young's modulus, Pa.
        damping: seconds.
        yield_strain: from which on deformation lasts; 0: never.
    """

    young: float
    damping: float
    yield_strain: float = 0.0


@dataclass(frozen=True)
class SoftBody:
    """A soft body.

    Attributes:
        vertices: [V, 3] of its collision mesh, in the world.
        faces: [F, 3] of its collision mesh.
        velocity: [3] m/s.
        spin: [3] rad/s about the centre.
        material: of the whole body.
        mass: kg.
        cells: of the control grid along each axis.
    """

    vertices: np.ndarray
    faces: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    material: Material
    mass: float
    cells: int


@dataclass(frozen=True)
class RigidBody:
    """A rigid body.

    Attributes:
        parts: vertices [V, 3] of the convex pieces that make up the body, in the world.
        velocity: [3] m/s.
        spin: [3] rad/s about the centre.
        mass: kg.
        friction: sliding.
        bounce: 0 to 1, part of the speed that an impact leaves, roughly.
    """

    parts: tuple[np.ndarray, ...]
    velocity: np.ndarray
    spin: np.ndarray
    mass: float
    friction: float
    bounce: float


@dataclass(frozen=True)
class Cloth:
    """A square cloth that hangs from its four corners.

    Attributes:
        width: metres.
        height: metres, of the corners.
        count: nodes along a side.
        mass: kg.
        young: Young's modulus, Pa.
        thickness: metres, for stiffness.
        damping: seconds.
    """

    width: float
    height: float
    count: int
    mass: float
    young: float
    thickness: float
    damping: float

    def rest_nodes(self) -> np.ndarray:
        """[n, n, 3] metres, world, at time 0."""
        part = self.width * (np.arange(self.count) / (self.count - 1) - 0.5)
        return np.stack(np.meshgrid(part, part, [self.height], indexing="ij"), -1)[:, :, 0]


@dataclass(frozen=True)
class Pusher:
    """A sphere that moves as commanded and that nothing else moves.

    Attributes:
        position: [3] metres, its centre at time 0.
        radius: metres.
    """

    position: np.ndarray
    radius: float


@dataclass(frozen=True)
class SceneSetup:
    """A scene at time 0.

    Attributes:
        bodies: soft or rigid.
        ground: height, metres; None: no ground.
        cloth: or None.
        pusher: or None.
    """

    bodies: tuple[SoftBody | RigidBody, ...]
    ground: float | None
    cloth: Cloth | None = None
    pusher: Pusher | None = None


class Unstable(Exception):
    """A trajectory is no motion of bodies: one exploded, or went through ground or cloth."""


def check_motion(vertices: np.ndarray, ground: float | None) -> None:
    """Raises Unstable unless ``vertices`` [T, V, 3] keep their size and stay above the ground, as a body does."""
    if not np.isfinite(vertices).all():
        raise Unstable("positions are not finite")
    size = np.linalg.norm(np.ptp(vertices, axis=1), axis=-1)
    if (size > MAX_STRETCH * size[0]).any() or (size < size[0] / MAX_STRETCH).any():
        raise Unstable("a body was torn apart or crushed")
    if ground is not None and vertices[..., 2].min() < ground - MAX_SINK * np.ptp(vertices[0, :, 2]):
        raise Unstable("a body sank into the ground")


def check_energy(centres: np.ndarray, masses: np.ndarray, spin: float, fps: float) -> None:
    """Raises Unstable where bodies gain energy.

    A squeezed body gives back its elastic energy within STORED seconds: over longer times the energy of the centres may
    only fall.

    Args:
        centres: [B, T, 3] of the bodies; deformation and turning are not counted.
        masses: [B] kg.
        spin: J/kg of turning at the start.
        fps: frames a second.
    """
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
    """Raises Unstable unless ``bodies`` [T, V, 3] stay above ``cloth`` [T, n, n, 3], and the cloth above the ground."""
    if not np.isfinite(cloth).all():
        raise Unstable("positions of the cloth are not finite")
    if ground is not None and cloth[..., 2].min() < ground - MAX_THROUGH:
        raise Unstable("the cloth sank into the ground")
    for body in bodies:
        if max(depth_below_cloth(points, nodes) for points, nodes in zip(body, cloth)) > MAX_THROUGH:
            raise Unstable("a body went through the cloth or fell beside it")


def depth_below_cloth(points: np.ndarray, cloth: np.ndarray) -> float:
    """Metres by which the deepest point lies below the cloth; negative: all lie above.

    Args:
        points: [N, 3].
        cloth: [n, n, 3], a grid so fine that the nearest node, seen from above, has the height of the cloth.
    """
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
