"""Base class of worlds: options, and the random draw, simulation, checks and rendering of a scene."""

import dataclasses
import hashlib
import importlib
import itertools
import json
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec, OutputEffects
from gsim3d.errors import InputError, check_ranges, check_whole, did_you_mean
from gsim3d.synth import cameras, render, scene_setup, shapes, writer
from gsim3d.synth.bodies import OBJECTS, load_mesh, mesh_bytes, mesh_name
from gsim3d.synth.embedding import Embedding, grid_faces, states
from gsim3d.synth.scene_setup import Cloth, RigidBody, SceneSetup, SoftBody, Unstable

MAX_ATTEMPTS = 40  # draws of a scene before it fails
MAX_COUNT, RATES = 1_000_000, (1, 10_000)  # largest number of scenes, frames, pixels or cameras; frames a second
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
MESH_UPS = ("y", "z")
ENGINES = {"mujoco": "gsim3d.synth.mujoco_engine", "genesis": "gsim3d.synth.genesis_engine"}
CLOTH_REFINEMENT = 3  # resolution of the rendered cloth over the simulated one
TRAIN = "train"
CLOTH_COLOR = (0.78, 0.14, 0.12)  # of worlds with ``by_name``
# Not in fingerprints at their defaults, so that older sets stay valid.
LATER_OPTIONS = ("by_name", "camera_spread", "ground_albedo")
MAX_SPREAD = 0.25  # largest camera_spread; bodies would leave the view of closer cameras
HIGHER, STEEPER = 0.5, 45.0  # spread of the target height (in distances) and of the elevation (in degrees)
RIM_POINTS = 64  # points of the ground's rim whose depths are checked


class Rejected(Exception):
    """A trajectory leaves the view, the ground or the depth range."""


@dataclass(frozen=True)
class SceneBody:
    """A body of a scene."""

    body: SoftBody | RigidBody  #: simulated body
    surface: render.Surface  #: rendered surface
    vertices: np.ndarray  #: vertices of the surface at time 0 [V, 3] in metres
    facts: dict  #: entry of metadata.json


@dataclass(frozen=True)
class SceneDraw:
    """A random draw of a scene at time 0."""

    ground: float | None  #: height of the ground in metres; None: no ground
    cloth: Cloth | None  #: cloth; None: no cloth
    bodies: list[SceneBody]  #: bodies
    surfaces: list[render.Surface]  #: surfaces of the bodies, then of the cloth, then of the actors
    policy: Any = None  #: how the actors move; None: no actors


@dataclass(frozen=True)
class World(ABC):
    """Options of a data set. Lengths are in metres, times in seconds; pairs are ranges of uniform random draws."""

    n_trajectories: int = 34  #: number of trajectories; the default split is 30 for training and 4 for tests
    n_frames: int = 24  #: steps of a trajectory
    fps: float = 24.0  #: steps per second
    image_size: int = 64  #: pixels, width and height
    n_cams: int = 12  #: cameras, on two rings
    seed: int = 0  #: random seed
    subset: str = TRAIN  #: "train" or a held-out set, which has random numbers of its own
    engine: str = "mujoco"  #: physics engine, a key of ENGINES
    objects: tuple[str, ...] = shapes.SOFT_SHAPES  #: shapes, assigned to trajectories in turn
    meshes: tuple[str, ...] = ()  #: mesh files, additional objects
    mesh_up: str = "y"  #: axis of mesh files that points up
    by_name: bool = False  #: paint, friction and bounce depend on the body's name only; the cloth is red
    background: str = "black"  #: colour behind the ground
    depth: bool = False  #: writes depth images
    samples: int = 2  #: rays along each side of a pixel
    n_bodies: tuple[int, int] = (1, 1)  #: number of bodies; all but the first are random objects
    body_size: tuple[float, float] = (0.6, 0.76)  #: diameter of the enclosing sphere of a body
    drop_height: tuple[float, float] = (0.5, 0.7)  #: height of the lowest point above ground or cloth
    speed: float = 0.35  #: largest initial horizontal speed in m/s
    lift: tuple[float, float] = (0.0, 0.0)  #: initial upward speed in m/s
    spin: float = 1.2  #: largest initial spin in rad/s
    spread: float = 0.08  #: largest offset of the target position from the center along x and y
    max_timestep: float = 1 / 480  #: largest time step of the engine
    distance: float = 2.6  #: distance of the cameras from their target
    elevations: tuple[float, float] = (18.0, 42.0)  #: elevation of the low and the high ring in degrees
    target_height: float = 0.52  #: height of the cameras' target
    fov: float = 42.0  #: vertical field of view in degrees
    camera_spread: float = 0.0  #: variation of the cameras between scenes, see rig(); 0: none
    ground: bool = True  #: whether there is a ground
    ground_height: tuple[float, float] = (0.0, 0.0)  #: height of the ground
    ground_radius: float = 0.85  #: radius of the ground
    ground_albedo: float | None = None  #: uniform grey of the ground; None: a pattern of three colours
    near: float = 1.5  #: smallest visible depth
    far: float = 3.8  #: largest visible depth

    name = ""
    generator_version = 3  # increased whenever the bytes for given options change
    engines = tuple(ENGINES)
    known_objects = OBJECTS
    unused = ()  # options without effect, which are refused
    actors = ()  # types of the actors' points; a scene has the first of them

    def check(self) -> None:
        """Raises InputError for invalid options."""
        self._check_counts(n_trajectories=1, n_frames=1, image_size=1, n_cams=1, samples=1)
        for field in ("max_timestep", "distance", "fov", "ground_radius", "near"):
            if not 0 < getattr(self, field) < np.inf:
                raise InputError(f"{field} must be positive; got {getattr(self, field)!r}")
        check_ranges(self, fps=RATES, camera_spread=(0, MAX_SPREAD), ground_albedo=(0, 1), seed=(0, np.inf))
        self._check_ranges("body_size", "drop_height", "n_bodies")
        if not self.near < self.far < np.inf:
            raise InputError(f"far must be above near; got near {self.near} and far {self.far}")
        if self.depth and self.far > writer.MAX_DEPTH:
            raise InputError(f"far must be at most {writer.MAX_DEPTH} m with depth images; got {self.far}")
        for field, allowed in (("background", BACKGROUNDS), ("mesh_up", MESH_UPS), ("engine", self.engines)):
            if (value := getattr(self, field)) not in allowed:
                hint = did_you_mean(value, allowed)
                raise InputError(f"{field} must be one of {', '.join(allowed)}; got {value!r}{hint}")
        for name in self.objects:
            if name not in self.known_objects:
                known, hint = ", ".join(self.known_objects), did_you_mean(name, self.known_objects)
                raise InputError(f"object {name!r} is not known; choose from {known}{hint}")
        names = self.object_names()
        repeated = [name for name, count in Counter(names).items() if count > 1]
        if repeated or not names:
            wrong = f"different names; repeated: {', '.join(repeated)}" if names else "one name at least"
            raise InputError(f"objects and mesh files must have {wrong}")
        for path in self.meshes:
            load_mesh(path, self.mesh_up)
        if self.ground:
            self._check_ground()

    def _check_counts(self, **least: int) -> None:
        for field, low in least.items():
            check_whole(field, getattr(self, field), low, MAX_COUNT)

    def _check_ranges(self, *fields: str) -> None:
        for field in fields:
            low, high = getattr(self, field)
            if not 0 < low <= high < np.inf:
                raise InputError(f"{field} must be two positive numbers, the smaller first; got {low} {high}")

    def _check_ground(self) -> None:
        angle = np.linspace(0, 2 * np.pi, RIM_POINTS, endpoint=False)
        extremes = itertools.product((-1.0, 1.0), repeat=3) if self.camera_spread else [(0.0, 0.0, 0.0)]
        for height, extreme in itertools.product(self.ground_height, extremes):
            rig = self._rig(*extreme)
            rim = np.stack([np.cos(angle), np.sin(angle), np.full(RIM_POINTS, height)], 1)
            rim[:, :2] *= self.ground_radius
            pixels, depth = cameras.project(rim, rig.viewmats, rig.Ks)
            seen = depth[(depth > 0) & (pixels >= 0).all(-1) & (pixels <= rig.size).all(-1)]
            if len(seen) and not (rig.near <= seen.min() and seen.max() <= rig.far):
                raise InputError(
                    f"visible depths of the ground, {seen.min():.2f} to {seen.max():.2f} m, exceed near {rig.near} and "
                    f"far {rig.far}"
                )

    def object_names(self) -> list[str]:
        """Names of objects and mesh files, in the order of their assignment to trajectories."""
        return [*self.objects, *map(mesh_name, self.meshes)]

    def scenes(self) -> list[tuple[str, int]]:
        """(object, sample) of every trajectory, with objects in turn."""
        names = self.object_names()
        return [(names[i % len(names)], i // len(names)) for i in range(self.n_trajectories)]

    def fingerprint(self, name: str) -> str:
        """Hash of all options that the scenes of object ``name`` depend on."""
        fields = dataclasses.asdict(self)
        others = self.n_bodies[1] > 1  # scenes then have random other objects
        unused = ["n_trajectories", "meshes"] + ["objects"] * (not others)
        unused += [field for field in LATER_OPTIONS if fields[field] == getattr(World, field)]
        fields = {field: value for field, value in fields.items() if field not in unused}
        text = json.dumps([self.generator_version, self.name, fields, name], sort_keys=True)
        digest = hashlib.sha256(text.encode())
        for path in self.meshes:
            if others or mesh_name(path) == name:
                digest.update(mesh_bytes(path, self.mesh_up))
        return digest.hexdigest()

    def rig(self, scene: tuple[str, int] | None = None) -> cameras.Rig:
        """Cameras of a scene; None: without variation.

        A ``camera_spread`` of s varies the distance by a factor of 1 +- s, the target height by +- s / 2 distances, the
        elevations by +- 45 s degrees, and the azimuth of both rings uniformly.
        """
        if scene is None or not self.camera_spread:
            return self._rig()
        rng = np.random.default_rng([self.seed, zlib.crc32(scene[0].encode()), scene[1], zlib.crc32(b"cameras")])
        return self._rig(*rng.uniform(-1, 1, 3), turned=rng.uniform(0, 2 * np.pi))

    def _rig(self, farther: float = 0.0, higher: float = 0.0, steeper: float = 0.0, turned: float = 0.0) -> cameras.Rig:
        """Cameras with variations in [-1, 1], relative to the largest."""
        spread = self.camera_spread
        return cameras.two_rings(
            self.n_cams,
            self.image_size,
            self.near,
            self.far,
            distance=self.distance * (1 + spread * farther),
            target_height=self.target_height + HIGHER * spread * self.distance * higher,
            elevations=tuple(degrees + STEEPER * spread * steeper for degrees in self.elevations),
            fov=self.fov,
            turned=turned,
        )

    def effects(self) -> EffectsSpec:
        """Effects of the scenes: matte surfaces, a history of two steps, shadows if there is a ground, and actors."""
        background, acting = "frozen" if self.ground else "masked_out", tuple(dict.fromkeys(self.actors))
        return EffectsSpec(
            DynamicsEffects(background, history=2, actions=acting),
            AppearanceEffects(view_dependent=0, changing="all" if self.ground else "dynamic"),
            outputs=OutputEffects(depth=self.depth),
        )

    def make(self, name: str, sample: int) -> writer.Scene:
        """Simulates and renders trajectory ``sample`` of object ``name``; redraws rejected trajectories."""
        rejected = []
        rig = self.rig((name, sample))
        for attempt in range(MAX_ATTEMPTS):
            drawn = self.draw(name, sample, attempt)
            try:
                # Cheap check before the simulation.
                self._check_view(rig, drawn.ground, [body.vertices[None] for body in drawn.bodies])
                embeddings, moved = self.simulate(drawn)
                self._check_trajectory(rig, drawn, moved)
            except (Unstable, Rejected) as reason:
                rejected.append(str(reason))
                continue
            names = [f"body_{index}" for index in range(len(drawn.bodies))]
            names += ["cloth"] * (drawn.cloth is not None) + ["actors"] * bool(self.actors)
            actions = embeddings[-1].nodes.astype(np.float32) if self.actors else None
            renderer = self.renderer(rig, drawn)
            return writer.Scene(
                name,
                sample,
                self.fps,
                rig,
                views=[renderer.draw(vertices) for vertices in zip(*moved)],
                states={name: states(embedding) for name, embedding in zip(names, embeddings)},
                extras={
                    **{"generator_version": self.generator_version, "world": self.name, "subset": self.subset},
                    **{"engine": self.engine, "seed": self.seed, "attempt": attempt, "rejected": rejected},
                    **{"ground_height": drawn.ground, "bodies": [body.facts for body in drawn.bodies]},
                },
                fingerprint=self.fingerprint(name),
                actions=actions,
                action_types=() if actions is None else self.actors[: actions.shape[1]],
            )
        raise InputError(
            f"{name}: all {MAX_ATTEMPTS} draws were rejected ({Counter(rejected).most_common(1)[0][0]}); "
            "lower the drop height or the body size, or widen the view"
        )

    def draw(self, name: str, sample: int, attempt: int) -> SceneDraw:
        """Draws trajectory ``sample`` of object ``name`` at time 0; each ``attempt`` has other random numbers."""
        subset = [zlib.crc32(text.encode()) for text in (self.name, self.subset) if text not in ("elastic", TRAIN)]
        rng = np.random.default_rng([self.seed, zlib.crc32(name.encode()), sample, attempt, *subset])
        ground, cloth, bodies = self._draw(name, rng)
        surfaces = [body.surface for body in bodies]
        if cloth is not None:
            surfaces.append(self._cloth_surface(cloth, rng))
        return self._with_actors(SceneDraw(ground, cloth, bodies, surfaces), rng)

    def renderer(self, rig: cameras.Rig, drawn: SceneDraw) -> render.Renderer:
        """Renderer of a draw with the cameras ``rig``."""
        ground = None if drawn.ground is None else render.Ground(self.ground_radius, drawn.ground, self.ground_albedo)
        background = BACKGROUNDS[self.background]
        return render.Renderer(
            rig, drawn.surfaces, ground=ground, background=background, samples=self.samples, depth=self.depth
        )

    def simulate(self, drawn: SceneDraw) -> tuple[list[Embedding], list[np.ndarray]]:
        """Simulates a draw, without checks.

        Returns:
            Embeddings of the bodies, of the cloth, and of the actors (a ParticleCloud of their points) last, and the
            vertices [T, V, 3] of every surface.

        Raises:
            Unstable: the solver diverges.
        """
        engine = importlib.import_module(ENGINES[self.engine])
        setup = SceneSetup(tuple(body.body for body in drawn.bodies), drawn.ground, drawn.cloth)
        embeddings = engine.simulate(setup, self.n_frames, self.fps, self.max_timestep)
        bindings = [embedding.bind(body.vertices) for body, embedding in zip(drawn.bodies, embeddings)]
        if drawn.cloth is not None:
            bindings.append(embeddings[-1].refine(CLOTH_REFINEMENT))
        moved = [np.stack([b.move(nodes) for nodes in e.nodes]) for b, e in zip(bindings, embeddings, strict=True)]
        return embeddings, moved

    @abstractmethod
    def _draw(self, name: str, rng: np.random.Generator) -> tuple[float | None, Cloth | None, list[SceneBody]]:
        """Draws the height of the ground (None: none), the cloth, and the bodies at time 0."""

    def _cloth_surface(self, cloth: Cloth, rng: np.random.Generator) -> render.Surface:
        n = (cloth.count - 1) * CLOTH_REFINEMENT + 1
        part = np.arange(n) / (n - 1) - 0.5
        points = np.stack(np.meshgrid(part, part, [0.0], indexing="ij"), -1).reshape(-1, 3)
        faces = grid_faces(n)
        paint = partial(np.full_like, fill_value=CLOTH_COLOR) if self.by_name else shapes.random_paint(rng)
        return render.Surface(faces, points[faces], paint, two_sided=True)

    def _with_actors(self, drawn: SceneDraw, rng: np.random.Generator) -> SceneDraw:
        """Adds the policy and the surface of actors to a draw."""
        return drawn

    def _check_trajectory(self, rig: cameras.Rig, drawn: SceneDraw, moved: list[np.ndarray]) -> None:
        """Raises Unstable or Rejected for the vertices ``moved`` [T, V, 3] of all surfaces."""
        bodies = moved[: len(drawn.bodies)]
        for vertices in bodies:
            scene_setup.check_motion(vertices, drawn.ground)
        self._check_view(rig, drawn.ground, bodies)
        centres = np.stack([vertices.mean(1) for vertices in bodies])
        masses = np.array([body.body.mass for body in drawn.bodies])
        spins = [((body.body.spin**2).sum() * (body.facts["size"] / 2) ** 2) / 2 for body in drawn.bodies]
        scene_setup.check_energy(centres, masses, max(spins), self.fps)
        if drawn.cloth is not None:
            n = (drawn.cloth.count - 1) * CLOTH_REFINEMENT + 1
            scene_setup.check_cloth(bodies, moved[-1].reshape(self.n_frames, n, n, 3), drawn.ground)

    def _check_view(self, rig: cameras.Rig, ground: float | None, bodies: list[np.ndarray]) -> None:
        for frame in itertools.chain.from_iterable(bodies):
            pixels, depth = cameras.project(frame, rig.viewmats, rig.Ks)
            if depth.min() < rig.near or depth.max() > rig.far:
                raise Rejected("a body leaves the depth range")
            if pixels.min() < 0 or pixels.max() > rig.size:
                raise Rejected("a body leaves the view of a camera")
            if ground is not None and np.hypot(frame[:, 0], frame[:, 1]).max() > 1.25 * self.ground_radius:
                raise Rejected("a body leaves the ground")
