"""Worlds: what can be simulated and filmed. A world turns (object, sample number) into one finished scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.generate import cameras, physics, render, shapes, writer

DENSITY = 45.0  # kg per cubic metre of the body's bounding box, about half of which it fills
DAMPING = 0.01  # seconds; a bounce dies away after about a second
MAX_ATTEMPTS = 40  # draws of one scene before the options are called impossible
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
MESH_UPS = ("y", "z")


class Rejected(Exception):
    """A drawn trajectory that is not filmed: it leaves the view or the depth range."""


@dataclass(frozen=True)
class Elastic:
    """A soft body falls on a round ground, is squeezed and jumps back, seen by cameras on two rings.

    Lengths in metres, times in seconds; pairs are ranges from which every trajectory draws.
    """

    n_trajectories: int = 34  # the usual split keeps 30 for training and 4 for tests
    n_frames: int = 24
    fps: float = 24.0
    image_size: int = 64
    n_cams: int = 12
    seed: int = 0
    objects: tuple[str, ...] = tuple(shapes.SHAPES)
    meshes: tuple[str, ...] = ()  # files; they take part like objects, and alone where objects is empty
    mesh_up: str = "y"
    background: str = "black"
    samples: int = 2  # rays along each side of a pixel
    body_size: tuple[float, float] = (0.6, 0.76)  # diameter of the sphere that holds the body
    drop_height: tuple[float, float] = (0.5, 0.7)  # of the lowest point; never less than the body's own height
    speed: float = 0.35  # largest horizontal speed at the start, m/s
    spin: float = 1.2  # largest, rad/s
    young: tuple[float, float] = (5e3, 9e3)  # Pa
    cells: int = 3  # of the control lattice along each axis
    max_timestep: float = 1 / 480
    distance: float = 2.6
    elevations: tuple[float, float] = (18.0, 42.0)  # degrees, of the low and the high ring
    target_height: float = 0.52
    fov: float = 42.0  # degrees
    ground_radius: float = 0.85
    near: float = 1.5
    far: float = 3.8

    name = "elastic"

    def check(self) -> None:
        """Raises InputError for options that cannot make a scene."""
        for field in ("n_trajectories", "n_frames", "image_size", "n_cams", "samples", "cells"):
            if not (isinstance(getattr(self, field), int) and getattr(self, field) >= 1):
                raise InputError(f"{field} must be a whole number, 1 or more; got {getattr(self, field)!r}")
        for field in ("fps", "max_timestep", "distance", "fov", "ground_radius", "near"):
            if not 0 < getattr(self, field) < np.inf:
                raise InputError(f"{field} must be positive; got {getattr(self, field)!r}")
        for field in ("body_size", "drop_height", "young"):
            low, high = getattr(self, field)
            if not 0 < low <= high < np.inf:
                raise InputError(f"{field} must be two positive numbers, the smaller first; got {low} {high}")
        if not self.near < self.far < np.inf:
            raise InputError(f"far must lie beyond near; got near {self.near} and far {self.far}")
        if not self.seed >= 0:
            raise InputError(f"seed must be 0 or more; got {self.seed}")
        if self.background not in BACKGROUNDS:
            raise InputError(f"background must be one of {', '.join(BACKGROUNDS)}; got {self.background!r}")
        if self.mesh_up not in MESH_UPS:
            raise InputError(f"mesh_up must be y or z; got {self.mesh_up!r}")
        for name in self.objects:
            if name not in shapes.SHAPES:
                raise InputError(f"object {name!r} is not known; choose from {', '.join(shapes.SHAPES)}")
        names = self.object_names()
        repeated = [name for name, count in Counter(names).items() if count > 1]
        if repeated or not names:
            raise InputError(f"objects and mesh files need names of their own; repeated: {repeated}, all: {names}")
        for path in self.meshes:
            shapes.load_body(path, self.mesh_up)
        self._check_ground()

    def _check_ground(self) -> None:
        rig = self.rig()
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        rim = self.ground_radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(64)], 1)
        pixels, depth = cameras.project(rim, rig.viewmats, rig.Ks)
        seen = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= rig.size).all(-1)
        if seen.any() and not (rig.near <= depth[seen].min() and depth[seen].max() <= rig.far):
            low, high = depth[seen].min(), depth[seen].max()
            raise InputError(
                f"the ground is seen from {low:.2f} to {high:.2f} m, beyond near {rig.near} and far {rig.far}"
            )

    def object_names(self) -> list[str]:
        """Names of objects and mesh files, in the order in which trajectories are dealt to them."""
        return [*self.objects, *(Path(path).stem for path in self.meshes)]

    def scenes(self) -> list[tuple[str, int]]:
        """(object, sample) of every trajectory: one of each object in turn."""
        names = self.object_names()
        return [(names[i % len(names)], i // len(names)) for i in range(self.n_trajectories)]

    def fingerprint(self, name: str) -> str:
        """Hash of all that the scenes of object ``name`` depend on, apart from their sample number."""
        fields = dataclasses.asdict(self)
        for field in ("n_trajectories", "objects", "meshes"):
            del fields[field]
        text = json.dumps([writer.GENERATOR_VERSION, self.name, fields, name], sort_keys=True)
        digest = hashlib.sha256(text.encode())
        path = self._mesh_path(name)
        if path is not None:
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def _mesh_path(self, name: str) -> Path | None:
        return next((Path(path) for path in self.meshes if Path(path).stem == name), None)

    def rig(self) -> cameras.Rig:
        """The cameras, the same in every scene."""
        return cameras.two_rings(
            self.n_cams,
            self.image_size,
            self.near,
            self.far,
            distance=self.distance,
            target_height=self.target_height,
            elevations=self.elevations,
            fov=self.fov,
        )

    def make(self, name: str, sample: int) -> writer.Scene:
        """Simulates and films trajectory ``sample`` of object ``name``; draws again until one can be used."""
        rejected = []
        rig = self.rig()
        for attempt in range(MAX_ATTEMPTS):
            rng = np.random.default_rng([self.seed, zlib.crc32(name.encode()), sample, attempt])
            try:
                body, lattice, vertices = self._fall(name, rig, rng)
            except (physics.Unstable, Rejected) as reason:
                rejected.append(str(reason))
                continue
            renderer = render.Renderer(
                rig,
                body.faces,
                body.corners,
                body.paint,
                ground_radius=self.ground_radius,
                background=BACKGROUNDS[self.background],
                samples=self.samples,
            )
            return writer.Scene(
                name,
                sample,
                self.fps,
                rig,
                views=[renderer.draw(frame) for frame in vertices],
                states=lattice.nodes.astype(np.float32),
                body_height=float(np.ptp(vertices[0, :, 2])),
                extras={"world": self.name, "seed": self.seed, "attempt": attempt, "rejected": rejected},
                fingerprint=self.fingerprint(name),
            )
        raise InputError(
            f"{name}: none of {MAX_ATTEMPTS} draws could be used ({Counter(rejected).most_common(1)[0][0]}); "
            "lower the drop height or the body size, or widen the view"
        )

    def _fall(self, name: str, rig: cameras.Rig, rng: np.random.Generator):
        path = self._mesh_path(name)
        body = shapes.procedural_body(name, rng) if path is None else shapes.load_body(path, self.mesh_up)
        # Mesh files keep their feet down and turn about the vertical; procedural bodies have no top.
        rotation = _random_rotation(rng) if path is None else _turn(rng.uniform(0, 2 * np.pi))
        size = rng.uniform(*self.body_size)
        vertices = size * (body.vertices[:, None, :] * rotation).sum(-1)
        collision = size * (body.collision_vertices[:, None, :] * rotation).sum(-1)
        drop = max(rng.uniform(*self.drop_height), np.ptp(vertices[:, 2]))
        heading, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0, self.speed)
        velocity = speed * np.array([np.cos(heading), np.sin(heading), 0])
        # A body that will drift starts upwind, so that it lands near the middle.
        place = -velocity * np.sqrt(2 * drop / 9.81) + [*rng.uniform(-0.08, 0.08, 2), drop - vertices[:, 2].min()]
        axis = rng.normal(size=3)
        fall = physics.Fall(
            collision + place,
            body.collision_faces,
            velocity,
            rng.uniform(0, self.spin) * axis / np.linalg.norm(axis),
            young=rng.uniform(*self.young),
            damping=DAMPING,
            mass=DENSITY * float(np.prod(np.ptp(collision, axis=0))),
            cells=self.cells,
        )
        self._check_view(rig, (vertices + place)[None])  # many draws fail here, before the costly part
        lattice = physics.simulate(fall, self.n_frames, self.fps, self.max_timestep)
        binding = physics.bind(vertices + place, lattice.nodes[0], lattice.occupied)
        moved = np.stack([binding.move(nodes) for nodes in lattice.nodes])
        physics.check_motion(moved)
        self._check_view(rig, moved)
        return body, lattice, moved

    def _check_view(self, rig: cameras.Rig, vertices: np.ndarray) -> None:
        for frame in vertices:
            pixels, depth = cameras.project(frame, rig.viewmats, rig.Ks)
            if depth.min() < rig.near or depth.max() > rig.far:
                raise Rejected("the body leaves the depth range")
            if pixels.min() < 0 or pixels.max() > rig.size:
                raise Rejected("the body leaves the view of a camera")
            if np.hypot(frame[:, 0], frame[:, 1]).max() > 1.25 * self.ground_radius:
                raise Rejected("the body leaves the ground")


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniform rotation matrix, from a random unit quaternion."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


WORLDS = {"elastic": Elastic}

PRESETS = {
    "demo": {"elastic": {}},
    "paper": {"elastic": {"n_trajectories": 1200, "n_frames": 84, "fps": 42.0, "image_size": 128}},
}


def build_world(world: str, preset: str, changes: dict):
    """The settings of ``world`` under ``preset`` with ``changes`` on top, checked."""
    if world not in WORLDS:
        raise InputError(f"world {world!r} is not known; choose from {', '.join(WORLDS)}")
    if preset not in PRESETS:
        raise InputError(f"preset {preset!r} is not known; choose from {', '.join(PRESETS)}")
    known = {field.name for field in dataclasses.fields(WORLDS[world])}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise InputError(f"world {world!r} has no option {unknown[0]!r}; it has {', '.join(sorted(known))}")
    settings = WORLDS[world](**{**PRESETS[preset][world], **changes})
    settings.check()
    return settings
