"""PushToGoal and PushClear: a round pusher among rigid bodies on the ground."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gsim3d.envs.scenes import FPS, N_PARTICLES, Scenes, TrueScene, TrueScenes, polar
from gsim3d.envs.tasks import TaskEnv
from gsim3d.errors import InputError
from gsim3d.synth import pushing
from gsim3d.synth.embedding import RigidFrame
from gsim3d.synth.scene_setup import Pusher

MAX_SPEED = 0.5  # m/s of the pusher, along x and y
WORKSPACE = 1.0  # metres from the middle; the pusher stays inside
REACHED = 0.05  # metres of the body's centre from the goal
GOAL_DISTANCE = (0.3, 0.6)  # metres between body and goal at the start
PUSHER_DISTANCE = (0.4, 0.6)  # metres between body and pusher at the start
CLEAR_RADIUS = 0.45  # metres, of the region that PushClear empties


class PushScene(TrueScene):
    """Bodies and a pusher on the ground.

    Args:
        bodies: bodies at the start.
        pusher: [2] metres.
        goal: [2] metres.

    Attributes:
        simulation: the bodies and the pusher.
    """

    actor_type, actor_points = "pusher", pushing.PUSHER_POINTS

    def __init__(self, bodies: Sequence[pushing.SceneBody], pusher: np.ndarray, goal: np.ndarray):
        surface, self._sphere = pushing.pusher_surface()
        super().__init__(goal, [*(body.surface for body in bodies), surface], len(bodies))
        start = Pusher(np.array([*pusher, pushing.PUSHER_RADIUS]), pushing.PUSHER_RADIUS)
        self.simulation = pushing.PushSimulation([body.body for body in bodies], start, FPS)
        self._frames = [RigidFrame(nodes[None]) for nodes in self.simulation.rest_nodes]
        self._rest = [body.vertices for body in bodies]
        self._bound = [frame.bind(points) for frame, points in zip(self._frames, self._rest, strict=True)]

    @property
    def actors(self) -> np.ndarray:
        return self.simulation.pusher[None]

    @property
    def centers(self) -> np.ndarray:
        return self.simulation.centers

    def vertices(self) -> list[np.ndarray]:
        bodies = [bound.move(frame) for bound, frame in zip(self._bound, self.simulation.nodes(), strict=True)]
        return [*bodies, self._sphere + self.simulation.pusher]

    def mark(self, rng: np.random.Generator) -> None:
        share = -(-N_PARTICLES // self.n_bodies)
        chosen = [points[rng.integers(len(points), size=share)] for points in self._rest]
        self._points = [frame.bind(points) for frame, points in zip(self._frames, chosen, strict=True)]

    def points(self) -> np.ndarray:
        moved = [points.move(frame) for points, frame in zip(self._points, self.simulation.nodes(), strict=True)]
        return np.concatenate(moved)[:N_PARTICLES]

    def move(self, velocities: np.ndarray) -> None:
        self.simulation.step(velocities[0, :2])


class _Push(TaskEnv):
    """Base of the push tasks: an action is the pusher's velocity in m/s.

    The pusher stays inside the workspace: ``info["velocity"]`` is the velocity that it executed. Episodes end after 60
    steps or when the task is solved.
    """

    actors = ("pusher", (2,))
    max_action = (MAX_SPEED, MAX_SPEED)
    shipped = "push-small"

    @property
    def simulation(self) -> pushing.PushSimulation:
        """The simulation of ``backend="truth"``."""
        if not isinstance(self.scenes, TrueScenes) or self.scenes.all[0] is None:
            raise InputError('simulation: there is one after reset, with backend="truth"')
        return self.scenes.all[0].simulation

    @classmethod
    def act(cls, scenes: Scenes, actions: Tensor) -> Tensor:
        velocities = bounded_velocity(scenes.actors()[:, 0, :2], actions)
        scenes.move(torch.nn.functional.pad(velocities, (0, 1))[:, None])
        return velocities


class PushToGoal(_Push):
    """Push one body to a goal 0.3 to 0.6 m away; solved where its centre is nearer than 5 cm.

    The reward is minus the distance of the body's centre to the goal, metres.
    """

    reached = REACHED

    @classmethod
    def draw(cls, rng: np.random.Generator) -> PushScene:
        at = rng.uniform(-0.2, 0.2, 2)
        body = pushing.draw_body(pushing.OBJECTS[rng.integers(len(pushing.OBJECTS))], at, rng.uniform(0, 2 * np.pi))
        return PushScene([body], at + polar(rng, PUSHER_DISTANCE), at + polar(rng, GOAL_DISTANCE))


class PushClear(_Push):
    """Push two or three bodies out of a round region in the middle.

    The reward is minus the sum of the depths of the bodies' centres inside the region, metres.
    """

    max_bodies = 3

    @classmethod
    def draw(cls, rng: np.random.Generator) -> PushScene:
        count, start = int(rng.integers(2, 4)), rng.uniform(0, 2 * np.pi)
        bodies = []
        for number in range(count):
            angle = start + 2 * np.pi * number / count
            at = 0.62 * pushing.SIZE * np.array([np.cos(angle), np.sin(angle)])
            name = pushing.OBJECTS[rng.integers(len(pushing.OBJECTS))]
            bodies.append(pushing.draw_body(name, at, rng.uniform(0, 2 * np.pi)))
        return PushScene(bodies, polar(rng, (0.75, 0.9)), np.zeros(2))

    @classmethod
    def distances(cls, scenes: Scenes, goals: Tensor) -> Tensor:
        depths = CLEAR_RADIUS - (scenes.centers()[..., :2] - goals[:, None]).norm(dim=-1)
        return depths.nan_to_num(0.0).clamp_min(0).sum(-1)  # NaN: a scene with fewer bodies

    @classmethod
    def solved(cls, distances: Tensor) -> Tensor:
        return distances == 0


def bounded_velocity(pusher: Tensor, velocity: Tensor) -> Tensor:
    """``velocity`` [..., 2], shortened so that ``pusher`` [..., 2] ends the step inside the workspace."""
    end = pusher + velocity / FPS
    reach = end.norm(dim=-1, keepdim=True)
    return torch.where(reach <= WORKSPACE, velocity, (end * (WORKSPACE / reach) - pusher) * FPS)
