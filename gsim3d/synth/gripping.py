"""The world cloth-grip: one or two grippers hold a cloth and move it. Each gripper is one point."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from gsim3d.synth import mujoco_engine, pushing, scene_setup
from gsim3d.synth.acting import RESTING, place, smooth_path
from gsim3d.synth.embedding import ClothGrid, ParticleCloud
from gsim3d.synth.scene_setup import Cloth, SceneSetup, Unstable
from gsim3d.synth.shapes import icosphere
from gsim3d.synth.world import CLOTH_REFINEMENT, SceneDraw, World

RADIUS, COLOR = 0.05, (0.15, 0.2, 0.75)  # of a gripper
SETTLE = 1.2  # seconds before the first frame, in which the flat cloth falls and comes to its first place
SCRIPTED = 0.5  # fraction of scenes in which the cloth is laid down; in others it is moved from place to place
HEIGHTS, LAID = (0.4, 0.7), 0.04  # metres, range of the height of grippers, and that at which a cloth is laid down
REACH = 0.3  # metres from the center that the middle between the grippers stays inside
CLOSEST = 0.75  # smallest distance of the grippers over that of their nodes on the flat cloth
TURN = 1.0  # rad, largest rotation between two places
FASTEST = 6.0  # m/s of a node of the cloth


@dataclass(frozen=True)
class ClothGrip(World):
    """One or two grippers hold a cloth at its corners and move it over the ground."""

    objects: tuple[str, ...] = ("cloth",)
    n_frames: int = 32
    fps: float = 12.0
    cloth_width: tuple[float, float] = (0.6, 0.8)  #: width
    cloth_count: int = 13  #: nodes along a side
    cloth_mass: tuple[float, float] = (0.2, 0.4)  #: mass in kg
    cloth_young: tuple[float, float] = (4e4, 1e5)  #: Young's modulus in Pa
    grip_speed: tuple[float, float] = (0.25, 0.5)  #: mean speed of the middle between the grippers in m/s
    distance: float = 2.7
    elevations: tuple[float, float] = (20.0, 42.0)
    target_height: float = 0.35
    ground_radius: float = 1.25
    near: float = 1.0
    far: float = 4.8

    name = "cloth-grip"
    engines = ("mujoco",)
    actors = ("gripper", "gripper")
    known_objects = ("cloth",)
    unused = (*(name for name in RESTING if name != "max_timestep"), "objects", "n_bodies", "body_size")

    def check(self) -> None:
        super().check()
        self._check_counts(cloth_count=3)
        self._check_ranges("cloth_width", "cloth_mass", "cloth_young", "grip_speed")

    def _draw(self, name, rng):
        n = self.cloth_count
        held = (0, n - 1) if rng.random() < 0.5 else (0,)
        width, mass, young = (rng.uniform(*of) for of in (self.cloth_width, self.cloth_mass, self.cloth_young))
        height = rng.uniform(*HEIGHTS)
        return 0.0, Cloth(width, height, n, mass, young, thickness=0.008, damping=0.015, held=held), []

    def _with_actors(self, drawn: SceneDraw, rng: np.random.Generator) -> SceneDraw:
        surfaces = [*drawn.surfaces, pushing.balls(len(drawn.cloth.held), COLOR)]
        return dataclasses.replace(drawn, surfaces=surfaces, policy=self._path(drawn.cloth, rng))

    def _path(self, cloth: Cloth, rng: np.random.Generator) -> np.ndarray:
        """Draws the positions of the grippers [SETTLE fps + T, G, 3]; the first ones are those of their nodes."""
        grips = cloth.rest_nodes().reshape(-1, 3)[list(cloth.held)]
        middle, length = grips.mean(0), self.n_frames / self.fps * rng.uniform(*self.grip_speed)
        begin = np.array([*place(rng, REACH), cloth.height, rng.uniform(-np.pi, np.pi), 1.0])
        poses, travelled, laid = [begin], 0.0, rng.random() < SCRIPTED  # middle, rotation, relative distance
        while travelled < length:
            at = np.array([*place(rng, REACH), LAID if laid else rng.uniform(*HEIGHTS)])
            travelled += np.linalg.norm(at - poses[-1][:3])
            turn = poses[-1][3] + rng.uniform(-TURN, TURN) * (not laid)
            poses.append(np.array([*at, turn, 1.0 if laid else rng.uniform(CLOSEST, 1.0)]))
        path = smooth_path(np.stack(poses), np.linspace(0, 1, self.n_frames) * length / travelled)
        before = smooth_path(np.stack([[*middle, 0.0, 1.0], begin]), np.linspace(0, 1.3, self._n_before))
        path = np.concatenate([before, path])
        c, s = np.cos(path[:, 3, None]), np.sin(path[:, 3, None])
        x, y, z = ((grips - middle) * path[:, 4, None, None]).transpose(2, 0, 1)
        return path[:, None, :3] + np.stack([c * x - s * y, s * x + c * y, z], -1)

    @property
    def _n_before(self) -> int:
        return int(np.ceil(SETTLE * self.fps))

    def simulate(self, drawn):
        setup, grips = SceneSetup((), drawn.ground, drawn.cloth, grips=drawn.policy), drawn.policy[self._n_before :]
        (cloth,) = mujoco_engine.simulate(setup, len(drawn.policy), self.fps, self.max_timestep)
        cloth = ClothGrid(cloth.nodes[self._n_before :])
        fine, sphere = cloth.refine(CLOTH_REFINEMENT), RADIUS * icosphere(1)[0]
        grippers = (grips[:, :, None] + sphere).reshape(self.n_frames, -1, 3)
        return [cloth, ParticleCloud(grips)], [np.stack([fine.move(nodes) for nodes in cloth.nodes]), grippers]

    def _check_trajectory(self, rig, drawn, moved):
        n = (drawn.cloth.count - 1) * CLOTH_REFINEMENT + 1
        scene_setup.check_cloth([], moved[0].reshape(self.n_frames, n, n, 3), drawn.ground)
        if (np.linalg.norm(np.diff(moved[0], axis=0), axis=2) * self.fps > FASTEST).any():
            raise Unstable("the cloth was torn away")
        self._check_view(rig, drawn.ground, moved)
