"""ClothCover: two grippers hold a cloth at two of its corners and lay it over a round region."""

from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from gsim3d.envs.scenes import FPS, N_PARTICLES, Scenes, TrueScene
from gsim3d.envs.tasks import TaskEnv
from gsim3d.synth.embedding import ClothGrid, grid_faces
from gsim3d.synth.mujoco_engine import CLOTH_RADIUS, CONTACT_TIME, POISSON, check_solver, load_mujoco
from gsim3d.synth.pushing import balls
from gsim3d.synth.render import Surface
from gsim3d.synth.shapes import icosphere
from gsim3d.synth.world import CLOTH_COLOR, CLOTH_REFINEMENT

MAX_SPEED = 0.5  # m/s of each gripper along each axis
WORKSPACE, LOWEST, HIGHEST = 1.0, 0.02, 0.6  # metres: bounds of a gripper's distance from the middle and of its height
WIDTH, COUNT, MASS, YOUNG, THICKNESS, DAMPING = 0.8, 13, 0.3, 7e4, 0.008, 0.015  # of the cloth; see synth.Cloth
HELD = 0.5  # height of the grippers at the start
SUBSTEPS = 40  # of a frame
SETTLE = 12  # frames that are simulated before an episode
GOAL_DISTANCE, GOAL_ANGLE = (0.3, 0.5), 0.8  # metres from the middle, and rad from the direction away from the grippers
RADIUS, COVERED, SPACING, FLAT = 0.2, 0.9, 0.06, 0.1  # region, solved share, reach and largest height of a point
GRIPPER_RADIUS, GRIPPER_COLOR = 0.04, (0.15, 0.2, 0.75)


class ClothScene(TrueScene):
    """A square cloth with two corners in grippers, which move as given.

    Args:
        angle: of the cloth about the z axis, rad.
        goal: [2] metres.

    Raises:
        Unstable: the solver diverges.
    """

    actor_type = "gripper"
    grip = 1.5 * GRIPPER_RADIUS

    def __init__(self, angle: float, goal: np.ndarray):
        gripper = balls(1, GRIPPER_COLOR)
        flat = ClothGrid(np.zeros((1, COUNT, COUNT, 3)))
        self._fine, self._sphere = flat.refine(CLOTH_REFINEMENT), GRIPPER_RADIUS * icosphere(1)[0]
        faces = grid_faces((COUNT - 1) * CLOTH_REFINEMENT + 1)
        corners = np.zeros((*faces.shape, 3))
        sheet = Surface(faces, corners, partial(np.full_like, fill_value=CLOTH_COLOR), two_sided=True)
        super().__init__(goal, [sheet, gripper, gripper], 1)
        self._model, self._data = _start(angle)
        self._data.qpos[:] = _settled()
        load_mujoco().mj_forward(self._model, self._data)

    @property
    def actors(self) -> np.ndarray:
        return self._data.mocap_pos.copy()

    @property
    def centers(self) -> np.ndarray:
        return self._data.flexvert_xpos.mean(0)[None]

    def vertices(self) -> list[np.ndarray]:
        return [self._fine.move(self._data.flexvert_xpos), *(self._sphere + at for at in self.actors)]

    def mark(self, rng: np.random.Generator) -> None:
        self._chosen = rng.permutation(len(self._fine.corners))[:N_PARTICLES]

    def points(self) -> np.ndarray:
        return self._fine.move(self._data.flexvert_xpos)[self._chosen]

    def move(self, velocities: np.ndarray) -> None:
        _advance(self._model, self._data, velocities / FPS)


def _start(angle: float):
    """Model and data of a flat cloth at the height HELD, turned by ``angle``."""
    mujoco = load_mujoco()
    c, s, half = np.cos(angle), np.sin(angle), WIDTH / 2
    grippers = "".join(
        f'<body name="g{i}" mocap="true" pos="{-half * c - side * s:.9g} {-half * s + side * c:.9g} {HELD}"/>'
        for i, side in enumerate((-half, half))
    )
    held = [f'<connect body1="g{i}" body2="cloth_{vertex}" anchor="0 0 0"/>' for i, vertex in enumerate((0, COUNT - 1))]
    spacing = f"{WIDTH / (COUNT - 1):.9g}"
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
  <option timestep="{1 / (FPS * SUBSTEPS):.12g}" integrator="discrete" iterations="100"/>
  <size memory="256M"/>
  <worldbody><geom type="plane" size="9 9 .1" pos="0 0 {-CLOTH_RADIUS}"/>{grippers}
    <body name="cloth" pos="0 0 {HELD}" euler="0 0 {np.degrees(angle):.9g}">
      <flexcomp name="cloth" type="grid" dim="2" count="{COUNT} {COUNT} 1" spacing="{spacing} {spacing} 1"
        mass="{MASS}" radius="{CLOTH_RADIUS}">
        <elasticity young="{YOUNG}" poisson="{POISSON}" thickness="{THICKNESS}" damping="{DAMPING}" elastic2d="both"/>
        <contact selfcollide="none" solref="{CONTACT_TIME} 1"/>
      </flexcomp></body></worldbody>
  <equality>{"".join(held)}</equality>
</mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def _advance(model, data, moved: np.ndarray) -> None:
    """Simulates one frame, in which the grippers move by ``moved`` [2, 3] metres."""
    start = data.mocap_pos.copy()
    for substep in range(1, SUBSTEPS + 1):
        data.mocap_pos[:] = start + substep / SUBSTEPS * moved
        load_mujoco().mj_step(model, data)
    load_mujoco().mj_kinematics(model, data)
    load_mujoco().mj_flex(model, data)
    check_solver(data)


@cache
def _settled() -> np.ndarray:
    """Positions of the nodes, relative to the flat cloth, of a cloth that hangs from its grippers."""
    model, data = _start(0.0)
    for _ in range(SETTLE):
        _advance(model, data, np.zeros((2, 3)))
    return data.qpos.copy()


class ClothCover(TaskEnv):
    """Lay a cloth over a round region of 20 cm radius; solved where it covers more than 90 % of it.

    An action is the velocities [6] of the two grippers, up to 0.5 m/s along each axis; they stay inside the workspace:
    ``info["velocity"]`` is what they executed. The reward is minus the share of the region that is not covered: that is
    farther than 6 cm, along the ground, from all points of the cloth below 10 cm. Episodes end after 60 steps or when
    the task is solved.
    """

    actors = ("grippers", (2, 3))
    max_action = (MAX_SPEED,) * 6
    reached = 1 - COVERED

    @classmethod
    def draw(cls, rng: np.random.Generator) -> ClothScene:
        angle = rng.uniform(0, 2 * np.pi)
        towards = angle + rng.uniform(-GOAL_ANGLE, GOAL_ANGLE)
        return ClothScene(angle, rng.uniform(*GOAL_DISTANCE) * np.array([np.cos(towards), np.sin(towards)]))

    @classmethod
    def act(cls, scenes: Scenes, actions: Tensor) -> Tensor:
        at = scenes.actors()
        end = at + actions.unflatten(1, (2, 3)) / FPS
        reach = end[..., :2].norm(dim=-1, keepdim=True).clamp_min(WORKSPACE)
        end = torch.cat([end[..., :2] * (WORKSPACE / reach), end[..., 2:].clamp(LOWEST, HIGHEST)], -1)
        velocities = (end - at) * FPS
        scenes.move(velocities)
        return velocities.flatten(1)

    @classmethod
    def distances(cls, scenes: Scenes, goals: Tensor) -> Tensor:
        points = scenes.points().double()
        region = goals[:, None] + torch.from_numpy(_disc()).to(goals)
        away = torch.cdist(region, points[..., :2]).masked_fill((points[..., 2] > FLAT)[:, None], torch.inf)
        return (away.amin(-1) > SPACING).double().mean(-1)


def _disc() -> np.ndarray:
    """Points [D, 2] of the region, around its centre, 2 cm apart."""
    line = np.arange(-RADIUS, RADIUS + 1e-9, 0.02)
    grid = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    return grid[np.linalg.norm(grid, axis=1) <= RADIUS]
