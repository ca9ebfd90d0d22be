"""The world push: a round pusher moves rigid bodies over the ground. Its points: pushing.PUSHER_POINTS.

Other worlds with actors: synth.gripping, synth.hands.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from gsim3d.synth import pushing, scene_setup
from gsim3d.synth.embedding import ParticleCloud, RigidFrame
from gsim3d.synth.scene_setup import Pusher, Unstable
from gsim3d.synth.world import SceneDraw, World

# Options of World that have no effect where bodies rest at time 0 on a ground at height 0.
RESTING = ("drop_height", "speed", "lift", "spin", "spread", "max_timestep")
RESTING += ("ground", "ground_height", "meshes", "mesh_up")
SCRIPTED = 0.75  # fraction of scenes whose pusher pushes a body to a goal; others go from place to place
PUSH_DISTANCE = (0.35, 0.8)  # metres between a body and its goal
START_DISTANCE = (0.34, 0.46)  # metres between the pusher and the body that it pushes first
START_ANGLE = 0.5  # rad, largest deviation of the pusher from the line through body and goal
APPROACH, ALIGNED = 0.33, 0.05  # metres behind a body, and beside the line of a push, from which it begins
REACHED = 0.04  # metres to the goal
N_LEGS = 12
ARENA = 0.5  # metres from the center; goals lie inside
APART = 0.24  # smallest distance of bodies from each other, as a radius
CLEAR = 0.33  # smallest initial distance of the pusher to the centers of bodies
FASTEST = 3.0  # largest speed of a body over that of the pusher
TRIES = 50


@dataclass(frozen=True)
class PushPolicy:
    """A closed-loop policy of a pusher: a sequence of legs, each to push a body to a goal, or to go to a place."""

    start: np.ndarray  #: first position [2] in metres
    speed: float  #: speed in m/s
    legs: tuple[tuple[int, np.ndarray], ...]  #: (body, or -1 for none, and goal [2] in metres) in order

    def run(self, simulation: pushing.PushSimulation, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Runs a simulation. Returns nodes of the bodies [T, B, 4, 3] and the pusher's center [T, 1, 3] in metres."""
        nodes, places, leg = [simulation.nodes()], [simulation.pusher], 0
        for _ in range(1, n_frames):
            centers, at = simulation.centers[:, :2], simulation.pusher[:2]
            while leg < len(self.legs) and self._done(self.legs[leg], centers, at):
                leg += 1
            towards = self._heading(self.legs[leg], centers, at) if leg < len(self.legs) else np.zeros(2)
            simulation.step(self.speed * towards)
            nodes.append(simulation.nodes())
            places.append(simulation.pusher)
        return np.stack(nodes), np.stack(places)[:, None]

    @staticmethod
    def _done(leg: tuple[int, np.ndarray], centers: np.ndarray, at: np.ndarray) -> bool:
        body, goal = leg
        return bool(np.linalg.norm((at if body < 0 else centers[body]) - goal) < REACHED)

    @staticmethod
    def _heading(leg: tuple[int, np.ndarray], centers: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Unit vector [2] of the next displacement."""
        body, goal = leg
        if body < 0:
            return _unit(goal - at)
        ahead = _unit(goal - centers[body])
        offset = at - centers[body]
        along = offset @ ahead
        aside = offset - along * ahead
        if along > 0 or np.linalg.norm(aside) > max(ALIGNED, -0.5 * along):
            return _unit(centers[body] - APPROACH * ahead - at)
        return _unit(ahead - aside / ALIGNED)


@dataclass(frozen=True)
class Push(World):
    """A round pusher moves one to three rigid bodies, which rest on the ground at time 0."""

    objects: tuple[str, ...] = pushing.OBJECTS
    n_bodies: tuple[int, int] = (1, 3)
    n_frames: int = 32
    fps: float = 12.0
    body_size: tuple[float, float] = (pushing.SIZE, pushing.SIZE)
    push_speed: tuple[float, float] = (0.3, 0.5)  #: speed of the pusher in m/s
    distance: float = 2.3
    elevations: tuple[float, float] = (30.0, 45.0)
    target_height: float = 0.15
    ground_radius: float = 1.25
    near: float = 0.8
    far: float = 4.2

    name = "push"
    engines = ("mujoco",)
    actors = ("pusher",) * len(pushing.PUSHER_POINTS)
    generator_version = 4
    unused = RESTING

    def check(self) -> None:
        super().check()
        self._check_ranges("push_speed")

    def _draw(self, name, rng):
        count, known = int(rng.integers(self.n_bodies[0], self.n_bodies[1] + 1)), self.object_names()
        names = [name, *(known[rng.integers(len(known))] for _ in range(count - 1))]
        least = APART / np.sin(np.pi / count) if count > 1 else 0.0
        first, bodies = rng.uniform(0, 2 * np.pi), []
        for number, one in enumerate(names):
            angle = first + 2 * np.pi * number / count
            at = rng.uniform(least, max(0.3, 1.2 * least)) * np.array([np.cos(angle), np.sin(angle)])
            look = None if self.by_name else rng
            bodies.append(pushing.draw_body(one, at, rng.uniform(0, 2 * np.pi), rng.uniform(*self.body_size), look))
        return 0.0, None, bodies

    def _with_actors(self, drawn: SceneDraw, rng: np.random.Generator) -> SceneDraw:
        outlines = [body.vertices[:, :2] for body in drawn.bodies]
        centers = np.stack([(outline.min(0) + outline.max(0)) / 2 for outline in outlines])
        scripted, speed = rng.random() < SCRIPTED, rng.uniform(*self.push_speed)
        for _ in range(TRIES):
            body, goal, start = _draw_push(centers, rng)
            if (np.linalg.norm(centers - start, axis=1) > CLEAR).all():
                break
        if scripted:
            legs = [(body, goal), *((int(rng.integers(len(centers))), place(rng)) for _ in range(2))]
        else:  # near bodies, so that it meets them
            near = [centers[rng.integers(len(centers))] + 0.5 * place(rng) for _ in range(N_LEGS)]
            legs = [(-1, at * min(1.0, ARENA / np.linalg.norm(at))) for at in near]
        surfaces = [*drawn.surfaces, pushing.pusher_surface()[0]]
        return dataclasses.replace(drawn, surfaces=surfaces, policy=PushPolicy(start, speed, tuple(legs)))

    def simulate(self, drawn):
        pusher = Pusher(np.array([*drawn.policy.start, pushing.PUSHER_RADIUS]), pushing.PUSHER_RADIUS)
        simulation = pushing.PushSimulation([body.body for body in drawn.bodies], pusher, self.fps)
        bound = [RigidFrame(rest[None]).bind(body.vertices) for rest, body in zip(simulation.rest_nodes, drawn.bodies)]
        nodes, places = drawn.policy.run(simulation, self.n_frames)
        bodies = [RigidFrame(axes) for axes in nodes.swapaxes(0, 1)]
        moved = [np.stack([points.move(axes) for axes in body.nodes]) for points, body in zip(bound, bodies)]
        return [*bodies, ParticleCloud(places + pushing.PUSHER_POINTS)], [*moved, places + pushing.pusher_surface()[1]]

    def _check_trajectory(self, rig, drawn, moved):
        for vertices in moved[:-1]:
            scene_setup.check_motion(vertices, drawn.ground)
            steps = np.linalg.norm(np.diff(vertices.mean(1), axis=0), axis=1)
            if (steps * self.fps > FASTEST * drawn.policy.speed).any():
                raise Unstable("a body was shot away")
        self._check_view(rig, drawn.ground, moved)


def _draw_push(centers: np.ndarray, rng: np.random.Generator) -> tuple[int, np.ndarray, np.ndarray]:
    """Draws a body, a goal [2] inside the arena, and a start [2] of the pusher behind the body."""
    body = int(rng.integers(len(centers)))
    for _ in range(TRIES):
        angle = rng.uniform(0, 2 * np.pi)
        ahead = np.array([np.cos(angle), np.sin(angle)])
        goal = centers[body] + rng.uniform(*PUSH_DISTANCE) * ahead
        if np.linalg.norm(goal) <= ARENA:
            break
    turn = angle + rng.uniform(-START_ANGLE, START_ANGLE)
    return body, goal, centers[body] - rng.uniform(*START_DISTANCE) * np.array([np.cos(turn), np.sin(turn)])


def place(rng: np.random.Generator, reach: float = ARENA) -> np.ndarray:
    """Draws a place [2] nearer than ``reach`` to the middle."""
    angle = rng.uniform(0, 2 * np.pi)
    return reach * np.sqrt(rng.random()) * np.array([np.cos(angle), np.sin(angle)])


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(np.linalg.norm(vector), 1e-9)


def ramp(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def smooth_path(poses: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Path [T, C] through ``poses`` [P, C], whose first three numbers are a place, that rests at each of them.
    ``times`` [T] ascend from 0 to the end of the path at 1; the time between two places is proportional to their
    distance."""
    lengths = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) + 1e-9
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    leg = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(lengths) - 1)
    part = ramp((times - ends[leg]) / (ends[leg + 1] - ends[leg]))[:, None]
    return poses[leg] + part * (poses[leg + 1] - poses[leg])
