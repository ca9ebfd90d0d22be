"""Motion of a soft body that falls on the ground (MuJoCo, a flex on a trilinear control lattice)."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

CONTACT_RADIUS = 0.005  # metres around every collision vertex; the ground plane is lowered by it
CONTACT_TIME = 0.005  # seconds; a slower contact lets the body sink in by centimetres at impact
MIN_STEPS_PER_CONTACT = 2.0  # MuJoCo's own limit: the contact time spans at least two steps
POISSON = 0.3
MAX_STRETCH = 2.0  # the body's bounding box longer or shorter than so many times at rest: the simulation has failed
MAX_SINK = 0.1  # of the body height below the ground: likewise


@dataclass(frozen=True)
class Fall:
    """One trajectory: a body at rest in the world, and how it starts.

    vertices [V, 3], faces [F, 3]: collision mesh in the world at time 0, metres.
    velocity, spin [3]: m/s and rad/s about the centre, at time 0.
    young: Pa.   damping: seconds.   mass: kg.   cells: of the control lattice along each axis.
    """

    vertices: np.ndarray
    faces: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    young: float
    damping: float
    mass: float
    cells: int


class Unstable(Exception):
    """The trajectory is no motion of a body: it exploded or sank into the ground."""


def _numbers(values) -> str:
    return " ".join(f"{x:.9g}" for x in np.ravel(values))


def _model_xml(fall: Fall, timestep: float) -> str:
    contact = f'solref="{max(CONTACT_TIME, MIN_STEPS_PER_CONTACT * timestep):.9g} 1"'
    cells = f"{fall.cells} {fall.cells} {fall.cells}"
    centre = (fall.vertices.min(0) + fall.vertices.max(0)) / 2  # the lattice always contains the flex's origin
    return f"""<mujoco>
  <option timestep="{timestep:.12g}" integrator="discrete" iterations="50" gravity="0 0 -9.81"/>
  <size memory="128M"/>
  <asset><mesh name="body" vertex="{_numbers(fall.vertices)}" face="{_numbers(fall.faces)}"/></asset>
  <worldbody>
    <geom type="plane" size="9 9 .1" pos="0 0 {-CONTACT_RADIUS}" {contact}/>
    <body name="root">
      <flexcomp name="soft" type="mesh" dim="3" mesh="body" dof="trilinear" cellcount="{cells}"
                origin="{_numbers(centre)}" mass="{fall.mass:.9g}" radius="{CONTACT_RADIUS}">
        <elasticity young="{fall.young:.9g}" poisson="{POISSON}" damping="{fall.damping:.9g}"/>
        <contact selfcollide="none" {contact}/>
      </flexcomp>
    </body>
  </worldbody>
</mujoco>"""


@dataclass(frozen=True)
class Lattice:
    """Control lattice of a flex over time.

    nodes [T, c+1, c+1, c+1, 3]: metres, world; frame 0 is a box of equal cells.
    occupied bool [c, c, c]: cells that hold collision vertices and whose corners all move with the body; nodes of no
        such cell drift freely or stay behind.
    """

    nodes: np.ndarray
    occupied: np.ndarray


def simulate(fall: Fall, n_frames: int, fps: float, max_timestep: float) -> Lattice:
    """The control lattice at every frame; it is the bounding box of the collision mesh at time 0.

    Raises: Unstable when the solver gives up.
    """
    os.environ.setdefault("MUJOCO_GL", "disable")
    import mujoco

    substeps = int(np.ceil(1 / (fps * max_timestep) - 1e-9))
    model = mujoco.MjModel.from_xml_string(_model_xml(fall, 1 / (fps * substeps)))
    data = mujoco.MjData(model)
    bodies = model.flex_nodebodyid
    mujoco.mj_forward(model, data)
    shape = (fall.cells + 1,) * 3
    rest = _box_lattice(fall)
    movable = model.body_dofnum[bodies] == 3  # a node without mass is welded to the world
    occupied = _occupied_cells(fall)
    used = np.zeros(shape, dtype=bool)
    corners = [tuple(slice(s, s + fall.cells) for s in step) for step in np.ndindex(2, 2, 2)]
    for corner in corners:
        occupied &= movable.reshape(shape)[corner]
    for corner in corners:
        used[corner] |= occupied
    start = data.xpos[bodies].reshape(*shape, 3)
    if not used.any() or np.abs(start - rest)[used].max() > 1e-5:
        raise RuntimeError("MuJoCo has laid out the nodes of the flex otherwise than by x, y, z")
    velocity = fall.velocity + np.cross(fall.spin, rest - rest[used].mean(0))
    data.qvel[model.body_dofadr[bodies[movable]][:, None] + np.arange(3)] = velocity.reshape(-1, 3)[movable]
    nodes = np.empty((n_frames, *shape, 3))
    nodes[0] = rest
    for frame in range(1, n_frames):
        mujoco.mj_step(model, data, substeps)
        mujoco.mj_kinematics(model, data)
        nodes[frame] = data.xpos[bodies].reshape(*shape, 3)
    if any(w.number for w in data.warning) or not np.isfinite(nodes).all():
        raise Unstable("the solver gave up")
    return Lattice(nodes, occupied)


def _box_lattice(fall: Fall) -> np.ndarray:
    low, high = fall.vertices.min(0), fall.vertices.max(0)
    part = np.arange(fall.cells + 1) / fall.cells
    return np.stack(np.meshgrid(*(a + (b - a) * part for a, b in zip(low, high)), indexing="ij"), -1)


def _occupied_cells(fall: Fall) -> np.ndarray:
    low, high = fall.vertices.min(0), fall.vertices.max(0)
    cell = np.floor((fall.vertices - low) / (high - low) * fall.cells).astype(np.int64)
    occupied = np.zeros((fall.cells,) * 3, dtype=bool)
    occupied[tuple(np.clip(cell, 0, fall.cells - 1).T)] = True
    return occupied


def check_motion(vertices: np.ndarray) -> None:
    """Raises Unstable unless ``vertices`` [T, V, 3] keep their size and stay above the ground, as a body does."""
    if not np.isfinite(vertices).all():
        raise Unstable("positions are not finite")
    size = np.linalg.norm(np.ptp(vertices, axis=1), axis=-1)
    if (size > MAX_STRETCH * size[0]).any() or (size < size[0] / MAX_STRETCH).any():
        raise Unstable("the body was torn apart or crushed")
    if vertices[..., 2].min() < -MAX_SINK * np.ptp(vertices[0, :, 2]):
        raise Unstable("the body sank into the ground")


@dataclass(frozen=True)
class Binding:
    """Points tied to a control lattice: eight corners (rows of the flattened lattice) and trilinear weights each.

    corners: int64 [N, 8].  weights: [N, 8]; they add up to 1, outside their cell some are negative.
    """

    corners: np.ndarray
    weights: np.ndarray

    def move(self, nodes: np.ndarray) -> np.ndarray:
        """Where the points [N, 3] go when the lattice nodes [c+1, c+1, c+1, 3] have moved."""
        nodes = nodes.reshape(-1, 3)
        points = np.zeros((len(self.corners), 3))
        for corner in range(8):
            points += self.weights[:, corner, None] * nodes[self.corners[:, corner]]
        return points


def bind(points: np.ndarray, rest: np.ndarray, occupied: np.ndarray) -> Binding:
    """Ties ``points`` [N, 3] to a lattice at rest [c+1, c+1, c+1, 3], an axis-aligned box of equal cells.

    A point belongs to the nearest occupied cell; its weights extrapolate where it lies outside, so a rigid
    motion of the lattice moves every point rigidly.
    """
    n = rest.shape[0] - 1
    low, high = rest[0, 0, 0], rest[-1, -1, -1]
    place = (points - low) / (high - low) * n
    cells = np.argwhere(occupied)
    outside = np.maximum(np.abs(place[:, None] - (cells[None] + 0.5)) - 0.5, 0)
    cell = cells[(outside**2).sum(-1).argmin(1)]
    part = place - cell
    corners, weights = [], []
    for step in np.ndindex(2, 2, 2):
        corner = cell + np.array(step)
        corners.append((corner[:, 0] * (n + 1) + corner[:, 1]) * (n + 1) + corner[:, 2])
        weights.append(np.where(np.array(step) == 1, part, 1 - part).prod(1))
    return Binding(np.stack(corners, 1), np.stack(weights, 1))
