"""The world hands: two hands of 21 keypoints each take a body, carry it, put it down and leave it.

The motion is prescribed, without forces: the body moves with the hands while they hold it, and rests otherwise.
Keypoints are in the usual order: the wrist, then four of each finger from its base to its tip.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from gsim3d.synth import pushing, scene_setup
from gsim3d.synth.acting import RESTING, ramp, smooth_path
from gsim3d.synth.embedding import ParticleCloud, RigidFrame
from gsim3d.synth.scene_setup import Unstable, turn_about_z
from gsim3d.synth.shapes import icosphere
from gsim3d.synth.world import SceneDraw, World

SIDES = ("left", "right")
TYPES = tuple(f"{side}_{joint}" for side in SIDES for joint in range(21))  # as those of HO-Cap
# Of each finger: base (forward, up) from the wrist, lengths of its three bones in metres, direction (rad from forward).
SHAPE = {
    "thumb": ((0.030, 0.035), (0.040, 0.032, 0.026), 0.75),
    "index": ((0.090, 0.028), (0.042, 0.026, 0.020), 0.10),
    "middle": ((0.092, 0.008), (0.046, 0.029, 0.021), 0.02),
    "ring": ((0.086, -0.012), (0.042, 0.027, 0.021), -0.08),
    "little": ((0.078, -0.030), (0.033, 0.020, 0.018), -0.18),
}
SCALE, RADIUS, COLOR = 1.3, 0.022, (0.85, 0.62, 0.48)  # size over SHAPE; of the spheres that show keypoints
PALM = 0.075  # metres forward of the wrist, of the point of an unscaled hand that meets the body
OPEN, CLOSED = 0.05, 0.35  # rad between two bones, before and after a hand takes the body
AWAY = (0.14, 0.22)  # metres between each hand and the body before and after
TAKEN, LEFT = (0.15, 0.3), (0.75, 0.9)  # fractions of the time at which hands hold the body, and let it go
FADE = 0.1  # fraction of the time in which fingers close or open
PLACE, LIFT, TURN, TILT = 0.35, (0.12, 0.3), 1.2, 0.4  # metres, metres, rad, rad: of the places on the way
SCRIPTED = 0.7  # fraction of scenes in which the body is taken and put down; in others it is held all the time


@dataclass(frozen=True)
class CarryPolicy:
    """A prescribed motion of two hands and the body between them."""

    #: position of the body's center, rotation about z and tilt about the axis between the hands [T, 5]
    poses: np.ndarray
    apart: np.ndarray  #: distance of each hand to the body [T] in metres
    curl: np.ndarray  #: rad between two bones of a finger [T]
    center: np.ndarray  #: center of the body at time 0 [3] in metres
    axis: float  #: rad, direction from the left to the right hand at time 0
    half: float  #: half of the body's extent along it in metres

    def moved(self, points: np.ndarray) -> np.ndarray:
        """Positions [T, N, 3] of ``points`` [N, 3] that are fixed to the body."""
        return np.einsum("tij,nj->tni", self._rotations(), points - self.center) + self.poses[:, None, :3]

    def hands(self) -> np.ndarray:
        """Keypoints [T, 42, 3] in metres, those of the left hand first."""
        keypoints = []
        for frame, rotation in enumerate(self._rotations() @ turn_about_z(self.axis)):
            for side in (-1, 1):
                hand = SCALE * (_hand(self.curl[frame]) - [0, PALM, 0])
                out = self.half + self.apart[frame] + RADIUS - hand[:, 0]
                local = np.stack([side * out, hand[:, 1], hand[:, 2]], 1)
                keypoints.append(local @ rotation.T + self.poses[frame, :3])
        return np.stack(keypoints).reshape(len(self.poses), -1, 3)

    def _rotations(self) -> np.ndarray:
        """Rotation of the body since time 0 [T, 3, 3]."""
        around = turn_about_z(self.axis)
        return np.stack([turn_about_z(turn) @ around @ _tilt(tilt) @ around.T for turn, tilt in self.poses[:, 3:]])


@dataclass(frozen=True)
class Hands(World):
    """Two hands take a body from the ground, carry it and put it down."""

    objects: tuple[str, ...] = pushing.OBJECTS
    n_frames: int = 32
    fps: float = 12.0
    body_size: tuple[float, float] = (pushing.SIZE, pushing.SIZE)
    distance: float = 2.3
    elevations: tuple[float, float] = (25.0, 45.0)
    target_height: float = 0.25
    ground_radius: float = 1.2
    near: float = 0.8
    far: float = 4.2

    name = "hands"
    engines = ("mujoco",)
    actors = TYPES
    unused = (*RESTING, "n_bodies")

    def _draw(self, name, rng):
        place, angle = PLACE * rng.uniform(-1, 1, 2), rng.uniform(0, 2 * np.pi)
        look = None if self.by_name else rng
        return 0.0, None, [pushing.draw_body(name, place, angle, rng.uniform(*self.body_size), look)]

    def _with_actors(self, drawn: SceneDraw, rng: np.random.Generator) -> SceneDraw:
        vertices, axis = drawn.bodies[0].vertices, rng.uniform(0, 2 * np.pi)
        center = (vertices.min(0) + vertices.max(0)) / 2
        half = np.abs((vertices - center)[:, :2] @ [np.cos(axis), np.sin(axis)]).max()
        times, stays = np.linspace(0, 1, self.n_frames), rng.random() >= SCRIPTED
        taken, left = (-1.0, 2.0) if stays else (rng.uniform(*TAKEN), rng.uniform(*LEFT))
        poses = [np.array([*center, 0.0, 0.0])]
        for _ in range(int(rng.integers(1, 4))):
            height = center[2] + rng.uniform(*LIFT)
            poses.append(
                np.array([*PLACE * rng.uniform(-1, 1, 2), height, rng.uniform(-TURN, TURN), rng.uniform(-TILT, TILT)])
            )
        if stays:
            poses = poses[1:] if len(poses) > 2 else [poses[1], poses[1] + [0.1, 0.1, 0.1, 0.5, 0.0]]
        else:
            poses.append(np.array([*poses[-1][:2], center[2], poses[-1][3], 0.0]))
        before, after = ramp((taken - times) / max(taken, FADE)), ramp((times - left) / (1 - left))
        far = rng.uniform(*AWAY) * np.maximum(before, after)
        curl = OPEN + (CLOSED - OPEN) * np.minimum(ramp(1 + (times - taken) / FADE), ramp(1 + (left - times) / FADE))
        path = smooth_path(np.stack(poses), np.clip((times - taken) / (left - taken), 0, 1) if not stays else times)
        policy = CarryPolicy(path, far * (not stays), curl, center, axis, half)
        surfaces = [*drawn.surfaces, pushing.balls(len(TYPES), COLOR)]
        return dataclasses.replace(drawn, surfaces=surfaces, policy=policy)

    def simulate(self, drawn):
        policy, center = drawn.policy, drawn.policy.center
        frame = RigidFrame(policy.moved(np.concatenate([center[None], center + np.eye(3)])))
        hands, ball = policy.hands(), RADIUS * icosphere(1)[0]
        skin = (hands[:, :, None] + ball).reshape(self.n_frames, -1, 3)
        return [frame, ParticleCloud(hands)], [policy.moved(drawn.bodies[0].vertices), skin]

    def _check_trajectory(self, rig, drawn, moved):
        scene_setup.check_motion(moved[0], drawn.ground)
        if moved[1][..., 2].min() < drawn.ground:
            raise Unstable("a hand is below the ground")
        self._check_view(rig, drawn.ground, moved)


def _hand(curl: float) -> np.ndarray:
    """Keypoints [21, 3] of a hand: x towards the palm's side, y forward, z up; ``curl`` rad between two bones."""
    points = [np.zeros(3)]
    for (forward, up), bones, direction in SHAPE.values():
        points.append(np.array([0.0, forward, up]))
        for number, length in enumerate(bones, 1):
            bend = number * curl
            ahead = np.array([np.sin(bend), np.cos(bend) * np.cos(direction), np.cos(bend) * np.sin(direction)])
            points.append(points[-1] + length * ahead)
    return np.stack(points)


def _tilt(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
