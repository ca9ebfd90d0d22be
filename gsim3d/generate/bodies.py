"""Bodies by name: procedural shapes, and meshes that come with the package."""

from __future__ import annotations

import zlib
from functools import cache
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.generate import meshes, shapes

ASSETS = Path(__file__).parent / "assets"
MESH_BODIES = {"spot": ASSETS / "spot.obj"}
OBJECTS = (*shapes.SHAPES, *MESH_BODIES)

# Friction and bounce of rigid bodies whose properties are functions of their names.
CONTACTS = {
    "box": (0.6, 0.3),
    "capsule": (0.5, 0.4),
    "ellipsoid": (0.7, 0.35),
    "cylinder": (0.55, 0.25),
    "cone": (0.65, 0.3),
    "spot": (0.8, 0.2),
}


def name_rng(name: str) -> np.random.Generator:
    """A generator of random numbers that depend on ``name`` only."""
    return np.random.default_rng(zlib.crc32(name.encode()))


def named_body(name: str, rng: np.random.Generator) -> shapes.Body:
    """The body called ``name``, one of OBJECTS; ``rng`` draws the pattern and colours of procedural ones."""
    if name in MESH_BODIES:
        return _mesh_body(name)
    if name not in shapes.SHAPES:
        raise InputError(f"object {name!r} is not known; choose from {', '.join(OBJECTS)} or give a mesh file")
    return shapes.procedural_body(name, rng)


@cache
def _mesh_body(name: str) -> shapes.Body:
    return meshes.load_body(MESH_BODIES[name])


def named_contact(name: str, friction: tuple[float, float], bounce: tuple[float, float]) -> tuple[float, float]:
    """Friction and bounce of the body called ``name``: of CONTACTS, else what ``name`` gives in these ranges."""
    if name in CONTACTS:
        return CONTACTS[name]
    rng = name_rng(name)
    return rng.uniform(*friction), rng.uniform(*bounce)
