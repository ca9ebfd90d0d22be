"""What an engine is asked to move: bodies, a cloth and a ground at time 0, in metres, seconds and kilograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81  # m/s^2, along -z
MAX_STRETCH = 2.0  # a body's bounding box longer or shorter than so many times at rest: the simulation has failed
MAX_SINK = 0.1  # of the body height below the ground: likewise
MAX_THROUGH = 0.03  # metres of a body below the cloth over it, or of the cloth below the ground: likewise
STORED = 0.5  # seconds that a body stays squeezed at most
MAX_GAIN = 0.3  # J/kg that a setup may gain: what a fall of 3 cm gives; centres are known to about a third of it


@dataclass(frozen=True)
class Material:
    """What a soft body is made of: young: Pa.   damping: seconds.   yield_strain: of lasting deformation, 0: none."""

    young: float
    damping: float
    yield_strain: float = 0.0


@dataclass(frozen=True)
class SoftBody:
    """vertices [V, 3], faces [F, 3]: collision mesh in the world.   velocity, spin [3]: m/s, rad/s about the centre.

    cells: of the control lattice along each axis.
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
    """parts: vertices [V, 3] of convex pieces that make up the body, in the world.   velocity, spin [3]: as above.

    friction: sliding.   bounce: 0 to 1, how much of the speed of an impact is kept, roughly.
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

    width: metres.   height: of the corners.   count: nodes along a side.   mass: kg.
    young: Pa.   thickness: metres, for stiffness.   damping: seconds.
    """

    width: float
    height: float
    count: int
    mass: float
    young: float
    thickness: float
    damping: float


@dataclass(frozen=True)
class SceneSetup:
    """bodies: soft or rigid.   ground: height of the ground, or None.   cloth: or None."""

    bodies: tuple[SoftBody | RigidBody, ...]
    ground: float | None
    cloth: Cloth | None = None


class Unstable(Exception):
    """The trajectory is no motion of bodies: something exploded, or went through ground or cloth."""


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
    """Raises Unstable where bodies move faster or rise higher than what came before allows.

    What a squeezed body stores, it gives back within STORED seconds: from then on the energy of the centres may only
    fall, wherever one starts to look.

    Args:
        centres [B, T, 3]: of the bodies; what they do inside, and their turning, is not counted.
        masses [B].   spin: J/kg of turning at the start.
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
    """How far the deepest of ``points`` [N, 3] lies below the cloth over it, metres; negative: all lie above.

    cloth [n, n, 3]: a grid fine enough that the nearest node, seen from above, stands for the place.
    """
    nodes = cloth.reshape(-1, 3)
    low, high = nodes[:, :2].min(0), nodes[:, :2].max(0)
    spacing = float(np.max(high - low)) / (cloth.shape[0] - 1)
    n_cells = np.floor((high - low) / spacing).astype(np.int64) + 1
    lowest = np.full(tuple(n_cells), np.inf)
    cell = np.minimum(np.floor((nodes[:, :2] - low) / spacing).astype(np.int64), n_cells - 1)
    np.minimum.at(lowest, tuple(cell.T), nodes[:, 2])
    place = np.floor((points[:, :2] - low) / spacing).astype(np.int64)
    over = ((place >= 0) & (place < n_cells)).all(1)
    heights = lowest[tuple(place[over].T)]
    below = heights - points[over, 2]
    below = below[np.isfinite(below)]
    return float(below.max()) if len(below) else -np.inf
