"""PushToGoal and PushClear: a round pusher among rigid bodies on the ground, simulated by MuJoCo."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from gsim3d.errors import InputError
from gsim3d.synth import cameras, pushing, render
from gsim3d.synth.embedding import RigidFrame
from gsim3d.synth.scene_setup import Pusher

FPS = 12
MAX_STEPS = 60  # five seconds
MAX_SPEED = 0.5  # m/s of the pusher, along x and y
WORKSPACE = 1.0  # metres from the middle; the pusher stays inside
N_PARTICLES = 256  # surface points of all bodies together
REACHED = 0.05  # metres of the body's centre from the goal
GOAL_DISTANCE = (0.3, 0.6)  # metres between body and goal at the start
PUSHER_DISTANCE = (0.4, 0.6)  # metres between body and pusher at the start
CLEAR_RADIUS = 0.45  # metres, of the region that PushClear empties
OBSERVATIONS = ("particles", "images", "both")
N_VIEWS = 4
RIG = {"distance": 2.3, "target_height": 0.15, "elevations": (30.0, 45.0), "fov": 42.0}
NEAR, FAR, GROUND_RADIUS, GROUND_ALBEDO = 0.8, 4.2, 1.25, 0.55


class _Push(gymnasium.Env):
    """Base of the push tasks.

    An action is the pusher's velocity in m/s. The pusher stays inside the workspace: ``info["velocity"]`` is the
    velocity that it executed. Observations are a dictionary:

    - ``pusher`` [2], ``goal`` [2]: metres;
    - ``particles`` [256, 3]: points of the bodies' surfaces, metres; the same points at every step;
    - ``images`` uint8 [4, H, W, 3]: of four calibrated cameras (``rig``).

    Episodes are functions of the seed and equal in all bits. They end after 60 steps or when the task is solved.

    Args:
        observation: "particles", "images" or "both".
        image_size: pixels, width and height of images.
        render_mode: None or "rgb_array": the first camera.

    Raises:
        InputError: an argument is not known.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(self, observation: str = "particles", image_size: int = 64, render_mode: str | None = None):
        if observation not in OBSERVATIONS:
            raise InputError(f"observation must be one of {', '.join(OBSERVATIONS)}; got {observation!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode must be rgb_array or None; got {render_mode!r}")
        if image_size < 1:
            raise InputError(f"image_size must be at least 1; got {image_size}")
        self.render_mode, self.observation = render_mode, observation
        self.rig = cameras.two_rings(N_VIEWS, image_size, NEAR, FAR, **RIG)
        reach = np.full(2, 2 * WORKSPACE, np.float32)
        parts: dict[str, spaces.Space] = {"pusher": spaces.Box(-reach, reach), "goal": spaces.Box(-reach, reach)}
        if observation != "images":
            parts["particles"] = spaces.Box(-10.0, 10.0, (N_PARTICLES, 3), np.float32)
        if observation != "particles":
            parts["images"] = spaces.Box(0, 255, (N_VIEWS, image_size, image_size, 3), np.uint8)
        self.observation_space = spaces.Dict(parts)
        self.action_space = spaces.Box(-MAX_SPEED, MAX_SPEED, (2,), np.float32)
        self.simulation: pushing.PushSimulation | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """The first observation of a new episode, and ``info``."""
        super().reset(seed=seed)
        rng = self.np_random
        actors, pusher, self.goal = self._draw(rng)
        centre = np.array([*pusher, pushing.PUSHER_RADIUS])
        bodies = [actor.body for actor in actors]
        self.simulation = pushing.PushSimulation(bodies, Pusher(centre, pushing.PUSHER_RADIUS), FPS)
        frames = [RigidFrame(nodes[None]) for nodes in self.simulation.rest_nodes]
        self._surfaces = [frame.bind(actor.vertices) for frame, actor in zip(frames, actors, strict=True)]
        share = -(-N_PARTICLES // len(actors))
        points = [actor.vertices[rng.integers(len(actor.vertices), size=share)] for actor in actors]
        self._particles = [frame.bind(one) for frame, one in zip(frames, points, strict=True)]
        ground = render.Ground(GROUND_RADIUS, 0.0, GROUND_ALBEDO)
        surface, self._sphere = pushing.pusher_surface()
        surfaces = [*(actor.surface for actor in actors), surface]
        self._renderer = render.Renderer(self.rig, surfaces, ground=ground, background=(0.0, 0.0, 0.0))
        return self._observe(), self._info(np.zeros(2))

    def step(self, action: np.ndarray):
        """Moves the pusher for one frame: observation, reward, terminated, truncated, info.

        Raises:
            InputError: ``action`` is not a velocity inside the bounds, or no episode has begun.
        """
        if self.simulation is None:
            raise InputError("step was called before reset")
        action = np.asarray(action, np.float64)
        if action.shape != (2,) or not (np.abs(action) <= MAX_SPEED + 1e-6).all():
            raise InputError(f"action must be two velocities from -{MAX_SPEED} to {MAX_SPEED} m/s; got {action}")
        velocity = bounded_velocity(self.simulation.pusher[:2], action)
        self.simulation.step(velocity)
        info = self._info(velocity)
        return self._observe(), self._reward(), info["is_success"], False, info

    def render(self) -> np.ndarray | None:
        """uint8 [H, W, 3] of the first camera; None without a render mode."""
        return self._images()[0] if self.render_mode == "rgb_array" else None

    def particles(self) -> np.ndarray:
        """Surface points of all bodies now, float32 [256, 3] metres."""
        nodes = self.simulation.nodes()
        moved = [points.move(frame) for points, frame in zip(self._particles, nodes, strict=True)]
        return np.concatenate(moved)[:N_PARTICLES].astype(np.float32)

    def _images(self) -> np.ndarray:
        nodes = self.simulation.nodes()
        vertices = [surface.move(frame) for surface, frame in zip(self._surfaces, nodes, strict=True)]
        return self._renderer.draw([*vertices, self._sphere + self.simulation.pusher]).rgb

    def _observe(self) -> dict[str, np.ndarray]:
        found = {"pusher": self.simulation.pusher[:2].astype(np.float32), "goal": self.goal.astype(np.float32)}
        if self.observation != "images":
            found["particles"] = self.particles()
        if self.observation != "particles":
            found["images"] = self._images()
        return found

    def _info(self, velocity: np.ndarray) -> dict[str, Any]:
        centers = self.simulation.centers[:, :2]
        return {"is_success": self._solved(centers), "centers": centers, "velocity": velocity}

    def _reward(self) -> float:
        return -self._distance(self.simulation.centers[:, :2])

    @abstractmethod
    def _draw(self, rng: np.random.Generator) -> tuple[list[pushing.SceneBody], np.ndarray, np.ndarray]:
        """Bodies, and positions [2] of pusher and goal."""

    @abstractmethod
    def _distance(self, centers: np.ndarray) -> float:
        """How far body centres [B, 2] are from solving the task, metres."""

    @abstractmethod
    def _solved(self, centers: np.ndarray) -> bool: ...


class PushToGoal(_Push):
    """Push one body to a goal 0.3 to 0.6 m away; solved where its centre is nearer than 5 cm.

    The reward is minus the distance of the body's centre to the goal, metres.
    """

    def _draw(self, rng):
        at = rng.uniform(-0.2, 0.2, 2)
        actor = pushing.draw_body(pushing.OBJECTS[rng.integers(len(pushing.OBJECTS))], at, rng.uniform(0, 2 * np.pi))
        return [actor], at + _polar(rng, PUSHER_DISTANCE), at + _polar(rng, GOAL_DISTANCE)

    def _distance(self, centers):
        return float(np.linalg.norm(centers[0] - self.goal))

    def _solved(self, centers):
        return self._distance(centers) < REACHED


class PushClear(_Push):
    """Push two or three bodies out of a round region in the middle.

    The reward is minus the sum of the depths of the bodies' centres inside the region, metres.
    """

    def _draw(self, rng):
        count, start = int(rng.integers(2, 4)), rng.uniform(0, 2 * np.pi)
        actors = []
        for number in range(count):
            angle = start + 2 * np.pi * number / count
            at = 0.62 * pushing.SIZE * np.array([np.cos(angle), np.sin(angle)])
            name = pushing.OBJECTS[rng.integers(len(pushing.OBJECTS))]
            actors.append(pushing.draw_body(name, at, rng.uniform(0, 2 * np.pi)))
        return actors, _polar(rng, (0.75, 0.9)), np.zeros(2)

    def _distance(self, centers):
        return float(np.maximum(CLEAR_RADIUS - np.linalg.norm(centers - self.goal, axis=1), 0).sum())

    def _solved(self, centers):
        return self._distance(centers) == 0


def bounded_velocity(pusher: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """``velocity`` [2], shortened so that ``pusher`` [2] ends the step inside the workspace."""
    end = pusher + velocity / FPS
    reach = np.linalg.norm(end)
    return velocity if reach <= WORKSPACE else (end * (WORKSPACE / reach) - pusher) * FPS


def _polar(rng: np.random.Generator, distance: tuple[float, float]) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    return rng.uniform(*distance) * np.array([np.cos(angle), np.sin(angle)])
