"""Bodies by name: procedural shapes, meshes that come with the package, and those of an installed genesis-world."""

from __future__ import annotations

import zlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.generate import meshes, shapes

ASSETS = Path(__file__).parent / "assets"
MESH_BODIES = {"spot": ASSETS / "spot.obj"}
OBJECTS = (*shapes.SHAPES, *MESH_BODIES)
GENESIS = "genesis:"  # begins names of meshes of the package genesis-world
MESH_SUFFIXES = (".glb", ".obj", ".ply", ".stl")

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


def mesh_file(text: str, up: str = "y") -> str:
    """The path of a mesh: ``text`` itself, or the file that ``genesis:NAME`` means.

    That is the first closed mesh in the folder NAME of the meshes of an installed genesis-world, else NAME beside these
    folders. The package is not imported.

    Raises: InputError when there is none.
    """
    if not text.startswith(GENESIS):
        return text
    spec = find_spec("genesis")
    folders = [Path(place) / "assets" / "meshes" for place in (spec and spec.submodule_search_locations) or ()]
    folder = next((folder for folder in folders if folder.is_dir()), None)
    if folder is None:
        raise InputError(
            f"mesh {text} is a file of the package genesis-world, which is not installed: "
            "pip install --no-deps genesis-world==1.4.5 (84 MB; nothing of it is executed)"
        )
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in MESH_SUFFIXES)
    names = {file: file.relative_to(folder).parts[0].removesuffix(file.suffix) for file in files}
    chosen = [file for file in files if names[file] == text.removeprefix(GENESIS)]
    if not chosen:
        raise InputError(f"mesh {text} does not exist; choose from {', '.join(sorted(set(names.values())))}")
    problems = []
    for file in sorted(chosen, key=lambda file: -len(file.parts)):
        try:
            meshes.load_body(file, up)
            return str(file)
        except InputError as problem:
            problems.append(str(problem))
    raise InputError(f"mesh {text}: {'; '.join(problems)}")


def named_contact(name: str, friction: tuple[float, float], bounce: tuple[float, float]) -> tuple[float, float]:
    """Friction and bounce of the body called ``name``: of CONTACTS, else what ``name`` gives in these ranges."""
    if name in CONTACTS:
        return CONTACTS[name]
    rng = name_rng(name)
    return rng.uniform(*friction), rng.uniform(*bounce)
