"""The worlds: what differs between them, their presets, and the held-out sets that training never sees."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from gsim3d.errors import InputError, did_you_mean
from gsim3d.synth import bodies, meshes, shapes
from gsim3d.synth.scene_setup import Cloth, Material, RigidBody, SoftBody
from gsim3d.synth.world import TRAIN, World

# Seeds of held-out trajectories: models are chosen on the first; the second is scored once a release.
VALIDATION_SEED, TEST_SEED = 77, 78
SOFT_DENSITY = 45.0  # kg per cubic metre of the body's bounding box, about half of which it fills
LIGHT_DENSITY = 20.0  # likewise, of bodies that a cloth must carry
RIGID_DENSITY = 200.0

# Ranges of Young's modulus [Pa] and yield strain; damping [s]. With them a body of the usual size is squeezed by 15 to
# 40 % when it lands; rubber jumps back highest, foam hardly, clay keeps a dent.
MATERIALS = {
    "jelly": ((5e3, 9e3), 0.01, None),
    "rubber": ((1.5e4, 2.5e4), 0.002, None),
    "foam": ((5e3, 8e3), 0.04, None),
    "clay": ((8e3, 1.2e4), 0.04, (0.02, 0.05)),
    "putty": ((1e4, 1e4), 0.04, (0.03, 0.03)),
}
# Colours to which bodies lean where there are several materials: nothing else tells them apart before a body lands.
TINTS = {
    "jelly": (0.15, 0.6, 0.25),
    "rubber": (0.1, 0.25, 0.8),
    "foam": (0.95, 0.85, 0.3),
    "clay": (0.75, 0.25, 0.15),
    "putty": (0.6, 0.58, 0.55),
}
TINT_SHARE = 0.6


def draw_material(names: tuple[str, ...], rng: np.random.Generator) -> tuple[str, Material]:
    """One of MATERIALS, drawn."""
    name = names[rng.integers(len(names))] if len(names) > 1 else names[0]
    young, damping, lasting = MATERIALS[name]
    return name, Material(rng.uniform(*young), damping, rng.uniform(*lasting) if lasting else 0.0)


@dataclass(frozen=True)
class SoftWorld(World):
    """Soft bodies of one or several materials.

    materials: names in MATERIALS.   cells: of the control lattice of a body, along each axis.
    """

    materials: tuple[str, ...] = ("jelly",)
    cells: int = 3

    density = SOFT_DENSITY

    def check(self) -> None:
        super().check()
        unknown = sorted(set(self.materials) - set(MATERIALS))
        if unknown or not self.materials:
            got = ", ".join(self.materials) or "none"
            raise InputError(f"materials must be some of {', '.join(MATERIALS)}; got {got}")
        if not (isinstance(self.cells, int) and self.cells >= 1):
            raise InputError(f"cells must be a whole number, 1 or more; got {self.cells!r}")

    def _make_body(self, name, vertices, faces, velocity, spin, rng):
        material_name, material = draw_material(self.materials, rng)
        mass = self.density * float(np.prod(np.ptp(vertices, axis=0)))
        return SoftBody(vertices, faces, velocity, spin, material, mass, self.cells), {"material": material_name}

    def _painted(self, paint, facts):
        if len(self.materials) == 1:
            return paint
        tint = TINT_SHARE * np.array(TINTS[facts["material"]])
        return lambda points: (1 - TINT_SHARE) * paint(points) + tint


@dataclass(frozen=True)
class Elastic(SoftWorld):
    """Soft bodies fall on a round ground, are squeezed and jump back or stay bent."""

    name = "elastic"

    def _drop(self, height, body_height):
        # A soft body that falls less than its own height is hardly squeezed; without ground there is no fall.
        return max(height, body_height) if self.ground else height


@dataclass(frozen=True)
class ClothWorld(SoftWorld):
    """Soft bodies fall on a square cloth that hangs from its four corners over the ground."""

    body_size: tuple[float, float] = (0.42, 0.56)
    drop_height: tuple[float, float] = (0.1, 0.35)
    speed: float = 0.2
    spread: float = 0.15
    cloth_width: float = 1.7
    cloth_height: float = 0.8
    cloth_count: int = 17  # nodes along a side
    cloth_mass: tuple[float, float] = (0.6, 1.2)
    cloth_young: tuple[float, float] = (4e4, 1e5)  # Pa
    max_timestep: float = 1 / 504
    distance: float = 3.2
    target_height: float = 0.62
    ground_radius: float = 1.3
    far: float = 5.0

    name = "cloth"
    density = LIGHT_DENSITY

    def check(self) -> None:
        super().check()
        if not (isinstance(self.cloth_count, int) and self.cloth_count >= 3):
            raise InputError(f"cloth_count must be a whole number, 3 or more; got {self.cloth_count!r}")

    def _draw_cloth(self, rng):
        return Cloth(
            self.cloth_width,
            self.cloth_height,
            self.cloth_count,
            mass=rng.uniform(*self.cloth_mass),
            young=rng.uniform(*self.cloth_young),
            thickness=0.008,
            damping=0.015,
        )


@dataclass(frozen=True)
class Rigid(World):
    """One to three rigid bodies are thrown on a round ground, hit each other, roll and come to rest."""

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
    friction: tuple[float, float] = (0.4, 0.9)
    bounce: tuple[float, float] = (0.1, 0.7)
    max_timestep: float = 1 / 960
    distance: float = 3.4
    target_height: float = 0.55
    ground_radius: float = 1.3
    near: float = 1.6
    far: float = 5.2

    name = "rigid"
    engines = ("mujoco",)

    def _make_body(self, name, vertices, faces, velocity, spin, rng):
        if self.by_name:
            friction, bounce = bodies.named_contact(name, self.friction, self.bounce)
        else:
            friction, bounce = rng.uniform(*self.friction), rng.uniform(*self.bounce)
        mass = RIGID_DENSITY * float(np.prod(np.ptp(vertices, axis=0)))
        parts = tuple(meshes.convex_pieces(vertices, faces))
        facts = {"friction": round(friction, 6), "bounce": round(bounce, 6)}
        return RigidBody(parts, velocity, spin, mass, friction, bounce), facts


WORLDS = {"elastic": Elastic, "rigid": Rigid, "cloth": ClothWorld}

_FULL_SIZE = {"n_trajectories": 1200, "image_size": 128, "n_cams": 12}
# Few bodies, each of one look, size and material; a plain ground; one rig. Nothing that decides a motion is invisible.
_KNOWN = {**_FULL_SIZE, "by_name": True, "ground_albedo": 0.55, "n_bodies": (1, 1), "lift": (0.0, 0.0)}
_SOFT = {**_KNOWN, "objects": ("spot", "blob", "box", "capsule", "ellipsoid", "cylinder"), "materials": ("putty",)}
_VARIED = ("jelly", "rubber", "foam", "clay")
_ELASTIC_VIEW = {"distance": 3.2, "target_height": 0.7, "ground_radius": 1.2, "near": 1.5, "far": 5.0}
_PUBLISHED = {
    "elastic": {
        **_SOFT,
        **_ELASTIC_VIEW,
        "n_frames": 84,
        "fps": 42.0,
        "body_size": (0.68, 0.68),
        "drop_height": (0.4, 1.0),
        "speed": 0.3,
        "spin": 0.0,
        "spread": 0.08,
    },
    "rigid": {
        **_KNOWN,
        "objects": ("box", "capsule", "ellipsoid", "cylinder", "cone", "spot"),
        "n_frames": 32,
        "fps": 12.0,
        "body_size": (0.62, 0.62),
        "drop_height": (0.3, 0.7),
        "speed": 0.4,
        "spin": 1.0,
        "distance": 2.8,
        "target_height": 0.45,
        "ground_radius": 1.1,
        "near": 0.9,
        "far": 4.6,
    },
    "cloth": {
        **_SOFT,
        "n_frames": 84,
        "fps": 42.0,
        "body_size": (0.5, 0.5),
        "drop_height": (0.1, 0.35),
        "speed": 0.2,
        "spin": 0.0,
        "cloth_mass": (0.9, 0.9),
        "cloth_young": (7e4, 7e4),
    },
}
PRESETS = {
    "mini": {world: {**options, "n_trajectories": 34, "n_frames": 24} for world, options in _PUBLISHED.items()},
    "published": _PUBLISHED,
    # Bodies, looks, sizes and materials are drawn anew for every trajectory.
    "diverse": {
        "elastic": {
            **_FULL_SIZE,
            **_ELASTIC_VIEW,
            "n_frames": 84,
            "fps": 42.0,
            "materials": _VARIED,
            "drop_height": (0.4, 1.0),
            "speed": 0.7,
            "spin": 3.0,
        },
        "rigid": {**_FULL_SIZE, "n_frames": 32, "fps": 12.0},
        "cloth": {**_FULL_SIZE, "n_frames": 84, "fps": 42.0, "materials": _VARIED},
    },
}
_RENAMED = {"paper": "diverse"}

# What a held-out set changes, by world. Without ground, bodies are thrown up and filmed until they have fallen out of
# reach; the number of frames is given in seconds.
_UNSEEN = {"objects": shapes.UNSEEN_SHAPES}
_RAISED = {"ground_height": (0.15, 0.3)}
_THROWN = {"ground": False, "drop_height": (0.02, 0.1)}
_DIVERSE_HELD_OUT = {
    "unseen": {"elastic": _UNSEEN, "rigid": _UNSEEN, "cloth": _UNSEEN},
    "several": {
        "elastic": {"n_bodies": (2, 3), "body_size": (0.38, 0.5), "spread": 0.25},
        "rigid": {"n_bodies": (4, 5), "body_size": (0.26, 0.38), "spread": 0.5},
        "cloth": {"n_bodies": (2, 2), "body_size": (0.3, 0.4), "spread": 0.25},
    },
    "no-ground": {
        "elastic": {**_THROWN, "lift": (3.3, 3.8)},
        "rigid": {**_THROWN, "lift": (3.6, 4.2), "n_bodies": (1, 1)},
    },
    "raised": {"elastic": _RAISED, "rigid": _RAISED},
    "higher": {
        "elastic": {"drop_height": (1.05, 1.2)},
        "rigid": {"drop_height": (0.8, 1.0), "lift": (0.8, 1.2)},
        "cloth": {"drop_height": (0.45, 0.6)},
    },
}
_PUBLISHED_HELD_OUT = {
    **_DIVERSE_HELD_OUT,
    "several": {
        "elastic": {"n_bodies": (2, 3), "body_size": (0.46, 0.46), "spread": 0.25},
        "rigid": {"n_bodies": (2, 3), "body_size": (0.42, 0.42), "spread": 0.35},
        "cloth": {"n_bodies": (2, 2), "body_size": (0.36, 0.36), "spread": 0.25},
    },
    "no-ground": {"elastic": {**_THROWN, "lift": (3.3, 3.8)}, "rigid": {**_THROWN, "lift": (2.8, 3.2)}},
    "higher": {
        "elastic": {"drop_height": (1.05, 1.2)},
        "rigid": {"drop_height": (0.75, 0.85)},
        "cloth": {"drop_height": (0.45, 0.6)},
    },
}
HELD_OUT = {"mini": _PUBLISHED_HELD_OUT, "published": _PUBLISHED_HELD_OUT, "diverse": _DIVERSE_HELD_OUT}
_HELD_OUT_COUNT = {"mini": 24, "published": 24}  # trajectories; others have those of their preset
_SECONDS_WITHOUT_GROUND = 0.72


def build_world(world: str, preset: str, changes: dict) -> World:
    """The settings of ``world`` under ``preset``, of a held-out set if ``changes`` name one as "subset", checked.

    Other ``changes`` replace single settings.
    """
    if world not in WORLDS:
        raise InputError(f"world {world!r} is not known; choose from {', '.join(WORLDS)}{did_you_mean(world, WORLDS)}")
    if preset not in PRESETS:
        hint = f"; {preset} is called {_RENAMED[preset]} now" if preset in _RENAMED else did_you_mean(preset, PRESETS)
        raise InputError(f"preset {preset!r} is not known; choose from {', '.join(PRESETS)}{hint}")
    known = {field.name for field in dataclasses.fields(WORLDS[world])}
    unknown = sorted(set(changes) - known)
    if unknown:
        hint = did_you_mean(unknown[0], known)
        raise InputError(f"world {world!r} has no option {unknown[0]!r}; it has {', '.join(sorted(known))}{hint}")
    chosen = {**PRESETS[preset][world], **_held_out(world, preset, changes.get("subset", TRAIN)), **changes}
    settings = WORLDS[world](**chosen)
    if not settings.ground and "n_frames" not in changes:
        settings = dataclasses.replace(settings, n_frames=int(_SECONDS_WITHOUT_GROUND * settings.fps))
    settings.check()
    return settings


def _held_out(world: str, preset: str, subset: str) -> dict:
    if subset == TRAIN:
        return {}
    sets = [name for name, worlds in HELD_OUT[preset].items() if world in worlds]
    if subset not in sets:
        known = [TRAIN, *sets]
        hint = did_you_mean(subset, known)
        raise InputError(f"world {world!r} has no set {subset!r}; choose from {', '.join(known)}{hint}")
    count = {"n_trajectories": _HELD_OUT_COUNT[preset]} if preset in _HELD_OUT_COUNT else {}
    return {**HELD_OUT[preset][subset][world], **count}
