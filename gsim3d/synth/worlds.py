"""The worlds elastic, rigid and cloth, and the list of all; presets and held-out sets are in assets/presets.yaml."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.plain import parse_yaml
from gsim3d.synth import bodies, meshes, shapes
from gsim3d.synth.acting import Push
from gsim3d.synth.falling import FallingWorld
from gsim3d.synth.gripping import ClothGrip
from gsim3d.synth.hands import Hands
from gsim3d.synth.scene_setup import Cloth, Material, RigidBody, SoftBody
from gsim3d.synth.world import TRAIN, World

# Seeds of held-out sets: validation selects models; test is scored once a release.
VALIDATION_SEED, TEST_SEED = 77, 78
SOFT_DENSITY = 45.0  # kg/m^3 of the bounding box, about half of which a body fills
LIGHT_DENSITY = 20.0  # kg/m^3, for bodies on a cloth
RIGID_DENSITY = 200.0  # kg/m^3
SECONDS_WITHOUT_GROUND = 0.72  # then bodies leave the view

# Range of Young's modulus (Pa), damping (s), range of yield strain (None: elastic). A body is compressed by 15 to 40 %
# at impact; rubber bounces highest, foam hardly, and clay deforms permanently.
MATERIALS = {
    "jelly": ((5e3, 9e3), 0.01, None),
    "rubber": ((1.5e4, 2.5e4), 0.002, None),
    "foam": ((5e3, 8e3), 0.04, None),
    "clay": ((8e3, 1.2e4), 0.04, (0.02, 0.05)),
    "putty": ((1e4, 1e4), 0.04, (0.03, 0.03)),
}
# Tints of materials in worlds with several, which are not visible otherwise before the impact.
TINTS = {
    "jelly": (0.15, 0.6, 0.25),
    "rubber": (0.1, 0.25, 0.8),
    "foam": (0.95, 0.85, 0.3),
    "clay": (0.75, 0.25, 0.15),
    "putty": (0.6, 0.58, 0.55),
}
TINT_SHARE = 0.6


@dataclass(frozen=True)
class SoftWorld(FallingWorld):
    """Base class of worlds with soft bodies."""

    materials: tuple[str, ...] = ("jelly",)  #: materials, keys of MATERIALS
    cells: int = 3  #: cells of a body's control grid along each axis

    density = SOFT_DENSITY

    def check(self) -> None:
        super().check()
        unknown = sorted(set(self.materials) - set(MATERIALS))
        if unknown or not self.materials:
            got = ", ".join(self.materials) or "none"
            raise InputError(f"materials must be some of {', '.join(MATERIALS)}; got {got}")
        self._check_counts(cells=1)

    def _make_body(self, name, vertices, faces, velocity, spin, rng):
        material_name = self.materials[rng.integers(len(self.materials))] if len(self.materials) > 1 else None
        material_name = material_name or self.materials[0]
        young, damping, lasting = MATERIALS[material_name]
        material = Material(rng.uniform(*young), damping, rng.uniform(*lasting) if lasting else 0.0)
        mass = self.density * float(np.prod(np.ptp(vertices, axis=0)))
        return SoftBody(vertices, faces, velocity, spin, material, mass, self.cells), {"material": material_name}

    def _painted(self, paint, facts):
        if len(self.materials) == 1:
            return paint
        tint = TINT_SHARE * np.array(TINTS[facts["material"]])
        return lambda points: (1 - TINT_SHARE) * paint(points) + tint


@dataclass(frozen=True)
class Elastic(SoftWorld):
    """Soft bodies fall on a round ground and bounce or deform permanently."""

    name = "elastic"

    def _drop(self, height, body_height):
        # A fall of less than the body's height hardly compresses it.
        return max(height, body_height) if self.ground else height


@dataclass(frozen=True)
class ClothWorld(SoftWorld):
    """Soft bodies fall on a square cloth with four fixed corners above the ground."""

    body_size: tuple[float, float] = (0.42, 0.56)
    drop_height: tuple[float, float] = (0.1, 0.35)
    speed: float = 0.2
    spread: float = 0.15
    cloth_width: float = 1.7  #: width
    cloth_height: float = 0.8  #: height of the corners
    cloth_count: int = 17  #: nodes along a side
    cloth_mass: tuple[float, float] = (0.6, 1.2)  #: mass in kg
    cloth_young: tuple[float, float] = (4e4, 1e5)  #: Young's modulus in Pa
    max_timestep: float = 1 / 504
    distance: float = 3.2
    target_height: float = 0.62
    ground_radius: float = 1.3
    far: float = 5.0

    name = "cloth"
    density = LIGHT_DENSITY

    def check(self) -> None:
        super().check()
        self._check_counts(cloth_count=3)

    def _draw_cloth(self, rng):
        mass, young = rng.uniform(*self.cloth_mass), rng.uniform(*self.cloth_young)
        return Cloth(self.cloth_width, self.cloth_height, self.cloth_count, mass, young, thickness=0.008, damping=0.015)


@dataclass(frozen=True)
class Rigid(FallingWorld):
    """One to three rigid bodies are thrown on a round ground, collide, roll and come to rest."""

    objects: tuple[str, ...] = shapes.RIGID_SHAPES
    n_bodies: tuple[int, int] = (1, 3)
    n_frames: int = 16
    fps: float = 12.0
    body_size: tuple[float, float] = (0.38, 0.58)
    drop_height: tuple[float, float] = (0.3, 0.7)
    speed: float = 0.8
    lift: tuple[float, float] = (0.0, 0.8)
    spin: float = 5.0
    spread: float = 0.3
    friction: tuple[float, float] = (0.4, 0.9)  #: coefficient of sliding friction
    bounce: tuple[float, float] = (0.1, 0.7)  #: approximate coefficient of restitution
    max_timestep: float = 1 / 960
    distance: float = 3.4
    target_height: float = 0.55
    ground_radius: float = 1.3
    near: float = 1.6
    far: float = 5.2

    name = "rigid"
    engines = ("mujoco",)

    def _make_body(self, name, vertices, faces, velocity, spin, rng):
        ranges = self.friction, self.bounce
        friction, bounce = bodies.named_contact(name, *ranges) if self.by_name else (rng.uniform(*x) for x in ranges)
        mass = RIGID_DENSITY * float(np.prod(np.ptp(vertices, axis=0)))
        parts = tuple(meshes.convex_pieces(vertices, faces))
        facts = {"friction": round(friction, 6), "bounce": round(bounce, 6)}
        return RigidBody(parts, velocity, spin, mass, friction, bounce), facts


def _with_tuples(value):
    if isinstance(value, dict):
        return {key: _with_tuples(one) for key, one in value.items()}
    return tuple(value) if isinstance(value, list) else value


WORLDS = {
    "elastic": Elastic,
    "rigid": Rigid,
    "cloth": ClothWorld,
    "push": Push,
    "cloth-grip": ClothGrip,
    "hands": Hands,
}
_FILE = _with_tuples(parse_yaml((Path(__file__).parent / "assets" / "presets.yaml").read_bytes()))
PRESETS = _FILE["presets"]  # preset -> world -> options
HELD_OUT = _FILE["held_out"]  # preset -> set -> world -> options on top of the preset
_RENAMED = {"paper": "diverse"}


def build_world(world: str, preset: str, changes: dict) -> World:
    """Returns the validated settings of a world.

    Args:
        world: one of WORLDS.
        preset: one of PRESETS.
        changes: options that replace those of the preset; "subset" selects a held-out set.

    Raises:
        InputError: an unknown name or an invalid option.
    """
    if world not in WORLDS:
        raise InputError(f"world {world!r} is not known; choose from {', '.join(WORLDS)}{did_you_mean(world, WORLDS)}")
    if preset not in PRESETS:
        hint = f"; {preset} is now called {_RENAMED[preset]}" if preset in _RENAMED else did_you_mean(preset, PRESETS)
        raise InputError(f"preset {preset!r} is not known; choose from {', '.join(PRESETS)}{hint}")
    known = {field.name for field in dataclasses.fields(WORLDS[world])}
    unknown = sorted(set(changes) - known)
    if unknown:
        hint = did_you_mean(unknown[0], known)
        raise InputError(f"world {world!r} has no option {unknown[0]!r}; it has {', '.join(sorted(known))}{hint}")
    if ignored := sorted(set(changes) & set(WORLDS[world].unused)):
        raise InputError(f"world {world!r} does not use the option {ignored[0]!r}; leave it out")
    subset = changes.get("subset", TRAIN)
    sets = {TRAIN: {}, **{name: worlds[world] for name, worlds in HELD_OUT[preset].items() if world in worlds}}
    if subset not in sets:
        hint = did_you_mean(subset, sets)
        raise InputError(f"world {world!r} has no set {subset!r}; choose from {', '.join(sets)}{hint}")
    settings = WORLDS[world](**{**PRESETS[preset][world], **sets[subset], **changes})
    if not settings.ground and "n_frames" not in changes:
        settings = dataclasses.replace(settings, n_frames=int(SECONDS_WITHOUT_GROUND * settings.fps))
    settings.check()
    return settings
