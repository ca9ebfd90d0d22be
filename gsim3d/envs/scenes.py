"""Scenes of environments: what tasks need of a simulated scene, and MuJoCo as the truth."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from gsim3d.synth import cameras, render

FPS = 12
N_PARTICLES = 256  # points of all bodies together
N_VIEWS = 4
RIG = {"distance": 2.3, "target_height": 0.15, "elevations": (30.0, 45.0), "fov": 42.0}
NEAR, FAR, GROUND_RADIUS, GROUND_ALBEDO = 0.8, 4.2, 1.25, 0.55


def task_rig(size: int, n_views: int = N_VIEWS) -> cameras.Rig:
    """The calibrated cameras of all tasks, with images of ``size`` pixels."""
    return cameras.two_rings(n_views, size, NEAR, FAR, **RIG)


class TrueScene(ABC):
    """One episode, simulated by MuJoCo.

    Attributes:
        goal: [2] metres.
        surfaces: of the bodies, then of the actors.
        n_bodies: number of bodies.
        actor_type: type of the points of actors, for models with action particles.
        actor_points: these points relative to the actor's center [P, 3] in metres.
        grip: metres; particles of bodies nearer to an actor's center move with it.
    """

    actor_type = ""
    actor_points = np.zeros((1, 3))
    grip = 0.0

    def __init__(self, goal: np.ndarray, surfaces: Sequence[render.Surface], n_bodies: int):
        self.goal, self.surfaces, self.n_bodies = goal, list(surfaces), n_bodies
        self._renderers: dict[int, render.Renderer] = {}

    @property
    @abstractmethod
    def actors(self) -> np.ndarray:
        """Centers of the actors [A, 3] in metres."""

    @property
    @abstractmethod
    def centers(self) -> np.ndarray:
        """Centers of the bodies [B, 3] in metres."""

    @abstractmethod
    def vertices(self) -> list[np.ndarray]:
        """Vertices [V, 3] of every surface, metres."""

    @abstractmethod
    def mark(self, rng: np.random.Generator) -> None:
        """Chooses the points of :meth:`points`."""

    @abstractmethod
    def points(self) -> np.ndarray:
        """The chosen points of the bodies [256, 3] in metres, the same ones at all times."""

    @abstractmethod
    def move(self, velocities: np.ndarray) -> None:
        """Simulates one frame, in which the actors have ``velocities`` [A, 3] in m/s."""

    def view(self, rig: cameras.Rig) -> render.View:
        """Images of all cameras now."""
        if rig.size not in self._renderers:
            ground = render.Ground(GROUND_RADIUS, 0.0, GROUND_ALBEDO)
            self._renderers[rig.size] = render.Renderer(rig, self.surfaces, ground=ground, background=(0.0, 0.0, 0.0))
        return self._renderers[rig.size].draw(self.vertices())


class Scenes(Protocol):
    """Scenes side by side: :class:`TrueScenes`, or :class:`gsim3d.envs.model.ModelScenes`.

    Attributes:
        device: of all tensors.
    """

    device: torch.device

    def reset(self, started: Mapping[int, TrueScene], rngs: Mapping[int, np.random.Generator]) -> None:
        """Replaces scenes, by their numbers; ``rngs`` choose their points."""

    def move(self, velocities: Tensor) -> None:
        """Simulates one frame, in which the actors have ``velocities`` [n, A, 3] in m/s."""

    def actors(self) -> Tensor:
        """Centers of the actors, float64 [n, A, 3] metres."""

    def centers(self) -> Tensor:
        """Centers of the bodies, float64 [n, B, 3] metres; NaN where a scene has fewer."""

    def points(self) -> Tensor:
        """Points of the bodies, float32 [n, 256, 3] metres; the same ones at all times."""

    def images(self, rig: cameras.Rig) -> Tensor:
        """Images uint8 [n, V, H, W, 3]."""


class TrueScenes(Scenes):
    """Scenes side by side, each simulated by MuJoCo.

    Args:
        count: number of scenes, n.
        most_bodies: largest number of bodies of a scene, B.

    Attributes:
        all: the scenes; None before the first :meth:`reset`.
    """

    def __init__(self, count: int, most_bodies: int):
        self.all: list[TrueScene | None] = [None] * count
        self.most_bodies, self.device = most_bodies, torch.device("cpu")

    def reset(self, started: Mapping[int, TrueScene], rngs: Mapping[int, np.random.Generator]) -> None:
        for number, scene in started.items():
            scene.mark(rngs[number])
            self.all[number] = scene

    def move(self, velocities: Tensor) -> None:
        for scene, of_scene in zip(self.all, velocities.numpy(), strict=True):
            scene.move(of_scene)

    def actors(self) -> Tensor:
        return torch.from_numpy(np.stack([scene.actors for scene in self.all]))

    def centers(self) -> Tensor:
        absent = [((0, self.most_bodies - scene.n_bodies), (0, 0)) for scene in self.all]
        centers = [np.pad(scene.centers, pad, constant_values=np.nan) for scene, pad in zip(self.all, absent)]
        return torch.from_numpy(np.stack(centers))

    def points(self) -> Tensor:
        return torch.from_numpy(np.stack([scene.points() for scene in self.all]).astype(np.float32))

    def images(self, rig: cameras.Rig) -> Tensor:
        return torch.from_numpy(np.stack([scene.view(rig).rgb for scene in self.all]))


def polar(rng: np.random.Generator, distance: tuple[float, float]) -> np.ndarray:
    """Draws a position [2] at a distance between two bounds from the origin."""
    angle = rng.uniform(0, 2 * np.pi)
    return rng.uniform(*distance) * np.array([np.cos(angle), np.sin(angle)])
