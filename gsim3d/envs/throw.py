"""ThrowToTarget: one throw of a rigid body over the ground."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from gsim3d.envs.model import ModelScenes
from gsim3d.envs.scenes import FPS, N_PARTICLES, TrueScene, TrueScenes, polar
from gsim3d.envs.tasks import TaskEnv
from gsim3d.synth import pushing
from gsim3d.synth.embedding import RigidFrame
from gsim3d.synth.mujoco_engine import simulate
from gsim3d.synth.scene_setup import SceneSetup

MAX_SPEED = 1.0  # m/s along each axis
FRAMES = 18  # from the throw to the end, 1.5 seconds
HEIGHT = (0.4, 0.6)  # metres of the body above the ground
START = (0.0, 0.3)  # metres of the body from the middle
GOAL_DISTANCE = (0.3, 0.6)  # metres between body and goal at the start
REACHED = 0.1  # metres of the body's centre from the goal


class ThrowScene(TrueScene):
    """A body that is held in the air until it is thrown.

    Args:
        body: the body at the start.
        goal: [2] metres.
    """

    def __init__(self, body: pushing.SceneBody, goal: np.ndarray):
        super().__init__(goal, [body.surface], 1)
        self._body, self._rest = body.body, body.vertices
        self._nodes, self._frame = self._simulate(np.zeros(3), 1), 0
        self._axes = RigidFrame(self._nodes[:1])
        self._bound = self._axes.bind(body.vertices)
        self._center = self._axes.bind((body.vertices.min(0) + body.vertices.max(0))[None] / 2)

    @property
    def actors(self) -> np.ndarray:
        return np.zeros((0, 3))

    @property
    def centers(self) -> np.ndarray:
        return self._center.move(self._nodes[self._frame])

    def vertices(self) -> list[np.ndarray]:
        return [self._bound.move(self._nodes[self._frame])]

    def mark(self, rng: np.random.Generator) -> None:
        self._points = self._axes.bind(self._rest[rng.integers(len(self._rest), size=N_PARTICLES)])

    def points(self) -> np.ndarray:
        return self._points.move(self._nodes[self._frame])

    def throw(self, velocity: np.ndarray) -> None:
        """Gives the body, which was held until now, a ``velocity`` [3] in m/s."""
        self._nodes, self._frame = self._simulate(velocity, FRAMES + 1), 0

    def move(self, velocities: np.ndarray) -> None:
        self._frame += 1

    def _simulate(self, velocity: np.ndarray, n_frames: int) -> np.ndarray:
        setup = SceneSetup((dataclasses.replace(self._body, velocity=velocity),), 0.0)
        return simulate(setup, n_frames, FPS, pushing.SUBSTEP)[0].nodes


class ThrowScenes(TrueScenes):
    """:class:`ThrowScene` side by side."""

    def throw(self, velocities: Tensor) -> None:
        """Gives the bodies, which were held until now, ``velocities`` [n, 3] in m/s."""
        for scene, velocity in zip(self.all, velocities.numpy(), strict=True):
            scene.throw(velocity)


class ThrowToTarget(TaskEnv):
    """Throw a body so that it comes to rest at a goal; solved where its centre is nearer than 10 cm after 1.5 seconds.

    An episode has one step: the action is the body's initial velocity [3], up to 1 m/s along each axis. The reward is
    minus the distance of the body's centre to the goal, metres.
    """

    max_action = (MAX_SPEED,) * 3
    true_scenes = ThrowScenes
    reached = REACHED

    @classmethod
    def draw(cls, rng: np.random.Generator) -> ThrowScene:
        name = pushing.OBJECTS[rng.integers(len(pushing.OBJECTS))]
        at = polar(rng, START)
        body = pushing.draw_body(name, at, rng.uniform(0, 2 * np.pi))
        up = np.array([0.0, 0.0, rng.uniform(*HEIGHT)])
        lifted = dataclasses.replace(body.body, parts=tuple(part + up for part in body.body.parts))
        raised = dataclasses.replace(body, body=lifted, vertices=body.vertices + up)
        return ThrowScene(raised, at + polar(rng, GOAL_DISTANCE))

    @classmethod
    def act(cls, scenes: ThrowScenes | ModelScenes, actions: Tensor) -> Tensor:
        scenes.throw(actions)
        for _ in range(FRAMES):
            scenes.move(scenes.actors())
        return actions.clone()

    @classmethod
    def ended(cls, distances: Tensor) -> Tensor:
        return torch.ones_like(distances, dtype=torch.bool)
