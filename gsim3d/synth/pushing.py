"""Simulation of rigid bodies on a ground with a kinematic spherical pusher, by MuJoCo."""

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from gsim3d.errors import InputError
from gsim3d.synth import meshes, render
from gsim3d.synth.bodies import name_rng, named_body, named_contact
from gsim3d.synth.mujoco_engine import body_nodes, check_solver, load_mujoco, model_xml
from gsim3d.synth.scene_setup import Pusher, RigidBody, SceneSetup, turn_about_z
from gsim3d.synth.shapes import icosphere
from gsim3d.synth.world import SceneBody

OBJECTS = ("box", "cylinder", "capsule", "spot")  # bodies that do not roll away
SIZE = 0.42  # diameter of the enclosing sphere of a body in metres
DENSITY = 60.0  # kg/m^3 of the bounding box: light enough for the contacts of a kinematic pusher
FRICTION, BOUNCE = (0.4, 0.9), (0.1, 0.7)  # ranges for bodies that are not in synth.bodies.CONTACTS
PUSHER_RADIUS, PUSHER_COLOR = 0.08, (0.85, 0.15, 0.1)
# Points of the pusher as an actor, relative to its center [27, 3] in metres: the center, then 26 on the surface.
_DIRECTIONS = np.array(sorted(product((-1.0, 0.0, 1.0), repeat=3), key=any))  # (0, 0, 0) comes first
PUSHER_POINTS = PUSHER_RADIUS * _DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True).clip(1)
SUBSTEP = 1 / 480  # largest time step in seconds
SETTLE = 0.5  # seconds that are simulated before an episode, until bodies rest


def draw_body(
    name: str, position: np.ndarray, angle: float, size: float = SIZE, rng: np.random.Generator | None = None
) -> SceneBody:
    """Returns the body ``name`` of ``synth.bodies.OBJECTS`` on the ground, with its center at ``position`` [2] in
    metres, turned by ``angle`` rad about the z axis, in a sphere of diameter ``size`` in metres. ``rng`` draws
    appearance and contacts; None: they depend on the name only."""
    body = named_body(name, name_rng(name) if rng is None else rng)
    rotation = size * turn_about_z(angle)
    vertices, collision = body.vertices @ rotation.T, body.collision_vertices @ rotation.T
    offset = np.array([*position, -collision[:, 2].min()])
    vertices, collision = vertices + offset, collision + offset
    mass = DENSITY * float(np.prod(np.ptp(collision, axis=0)))
    ranges = FRICTION, BOUNCE
    friction, bounce = named_contact(name, *ranges) if rng is None else (rng.uniform(*one) for one in ranges)
    parts = tuple(meshes.convex_pieces(collision, body.collision_faces))
    rigid = RigidBody(parts, np.zeros(3), np.zeros(3), mass, friction, bounce)
    facts = {"object": name, "mass": round(mass, 6), "size": size, "friction": friction, "bounce": bounce}
    return SceneBody(rigid, render.Surface(body.faces, body.corners, body.paint), vertices, facts)


def balls(count: int, color: tuple[float, float, float], level: int = 1) -> render.Surface:
    """Surface of ``count`` spheres of :func:`gsim3d.synth.shapes.icosphere`, one after the other."""
    points, faces = icosphere(level)
    faces = np.concatenate([faces + len(points) * number for number in range(count)])
    return render.Surface(faces, np.tile(points, (count, 1))[faces], partial(np.full_like, fill_value=color))


def pusher_surface() -> tuple[render.Surface, np.ndarray]:
    """Surface of the pusher, and its vertices relative to its center [V, 3] in metres."""
    return balls(1, PUSHER_COLOR, 2), PUSHER_RADIUS * icosphere(2)[0]


class PushSimulation:
    """Simulation of bodies that a kinematic pusher moves over the ground, one frame a step.

    Equal states and velocities give equal bits.

    Args:
        bodies: bodies at time 0, above the ground at height 0; SETTLE seconds are simulated before the first step.
        pusher: pusher at time 0.
        fps: frames a second.

    Raises:
        InputError: ``fps`` is not positive.
        Unstable: the solver diverges.
    """

    def __init__(self, bodies: Sequence[RigidBody], pusher: Pusher, fps: float):
        if not 0 < fps < np.inf:
            raise InputError(f"fps must be positive; got {fps!r}")
        mujoco, self.fps = load_mujoco(), fps
        self._substeps = int(np.ceil(1 / (fps * SUBSTEP) - 1e-9))
        setup = SceneSetup(tuple(bodies), 0.0, pusher=pusher)
        self._model = mujoco.MjModel.from_xml_string(model_xml(setup, 1 / (fps * self._substeps)))
        self._data = mujoco.MjData(self._model)
        self._bodies = [self._model.body(f"b{index}").id for index in range(len(setup.bodies))]
        self._spec = mujoco.mjtState.mjSTATE_INTEGRATION
        mujoco.mj_forward(self._model, self._data)
        check_solver(self._data)
        self.rest_nodes = self.nodes()
        self._advance(np.zeros((int(np.ceil(SETTLE * fps)) * self._substeps, 3)))

    @property
    def pusher(self) -> np.ndarray:
        """Center of the pusher [3] in metres."""
        return self._data.mocap_pos[0].copy()

    @property
    def centers(self) -> np.ndarray:
        """Centers of mass of the bodies [B, 3] in metres."""
        return self._data.xipos[self._bodies].copy()

    def nodes(self) -> np.ndarray:
        """Origin and tips of the unit axes of each body [B, 4, 3] in metres; see synth.embedding.RigidFrame."""
        return np.stack([body_nodes(self._data, body) for body in self._bodies])

    def step(self, velocity: np.ndarray) -> None:
        """Simulates one frame, in which the pusher moves by ``velocity / fps``.

        Args:
            velocity: horizontal velocity [2] in m/s.

        Raises:
            InputError: ``velocity`` is not two finite numbers.
            Unstable: the solver diverges.
        """
        velocity = np.asarray(velocity, np.float64)
        if velocity.shape != (2,) or not np.isfinite(velocity).all():
            raise InputError(f"velocity must be two finite numbers; got {velocity.tolist()}")
        moved = np.array([*velocity, 0.0]) / self.fps
        self._advance(np.arange(1, self._substeps + 1)[:, None] / self._substeps * moved)

    def state(self) -> np.ndarray:
        """Returns the full state, MuJoCo's integration state, for :meth:`restore`."""
        values = np.empty(load_mujoco().mj_stateSize(self._model, self._spec))
        load_mujoco().mj_getState(self._model, self._data, values, self._spec)
        return values

    def restore(self, state: np.ndarray) -> None:
        """Restores a state of this simulation, also after it has failed."""
        for warning in self._data.warning:
            warning.number = 0
        load_mujoco().mj_setState(self._model, self._data, state, self._spec)
        load_mujoco().mj_forward(self._model, self._data)

    def _advance(self, offsets: np.ndarray) -> None:
        """Simulates S substeps with the offsets [S, 3] of the pusher from its current position."""
        mujoco, start = load_mujoco(), self._data.mocap_pos[0].copy()
        for offset in offsets:
            self._data.mocap_pos[0] = start + offset
            mujoco.mj_step(self._model, self._data)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        check_solver(self._data)
