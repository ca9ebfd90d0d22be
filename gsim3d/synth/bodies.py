"""Bodies by name: procedural shapes, meshes of the package, and meshes of an installed genesis-world."""

import dataclasses
import zlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.synth import meshes, shapes
from gsim3d.synth.mesh_files import SUFFIXES

ASSETS = Path(__file__).parent / "assets"
MESH_BODIES = {"spot": ASSETS / "spot.obj"}
OBJECTS = (*shapes.SHAPES, *MESH_BODIES)
_mesh_body = cache(meshes.load_body)
GENESIS = "genesis:"  # prefix of meshes of the package genesis-world

# Friction and bounce of rigid bodies, for worlds in which they depend on the name only.
CONTACTS = {
    "box": (0.6, 0.3),
    "capsule": (0.5, 0.4),
    "ellipsoid": (0.7, 0.35),
    "cylinder": (0.55, 0.25),
    "cone": (0.65, 0.3),
    "spot": (0.8, 0.2),
}


def name_rng(name: str) -> np.random.Generator:
    """Random generator seeded by ``name``."""
    return np.random.default_rng(zlib.crc32(name.encode()))


def named_body(name: str, rng: np.random.Generator) -> shapes.Body:
    """Returns the body ``name`` of OBJECTS; ``rng`` draws pattern and colours of procedural bodies."""
    if name in MESH_BODIES:
        return _mesh_body(MESH_BODIES[name])
    if name not in shapes.SHAPES:
        raise InputError(f"object {name!r} is not known; choose from {', '.join(OBJECTS)} or give a mesh file")
    return shapes.procedural_body(name, rng)


def mesh_name(text: str) -> str:
    """Name of the body of a mesh: a file, or ``genesis:NAME``."""
    return text.removeprefix(GENESIS) if text.startswith(GENESIS) else Path(text).stem


def load_mesh(text: str, up: str = "y") -> shapes.Body:
    """Loads a mesh file, or a mesh ``genesis:NAME`` of an installed genesis-world, whose holes are filled."""
    return _genesis_body(_genesis_folder(text), text, up)[1] if text.startswith(GENESIS) else meshes.load_body(text, up)


def mesh_bytes(text: str, up: str = "y") -> bytes:
    """Content of the file that :func:`load_mesh` reads."""
    file = _genesis_body(_genesis_folder(text), text, up)[0] if text.startswith(GENESIS) else Path(text)
    return file.read_bytes()


def _genesis_folder(text: str) -> Path:
    """Folder of the meshes of genesis-world, found without importing it. Raises InputError if it is not installed."""
    spec = find_spec("genesis")
    for root in (spec and spec.submodule_search_locations) or ():
        if (folder := Path(root) / "assets" / "meshes").is_dir():
            return folder
    raise InputError(
        f"mesh {text} needs the package genesis-world: "
        "pip install --no-deps genesis-world==1.4.5 (84 MB; none of its code is executed)"
    )


@cache
def _genesis_body(folder: Path, text: str, up: str) -> tuple[Path, shapes.Body]:
    """First readable mesh in the subfolder of the name in ``text``, or in the folder itself, and its body."""
    names: dict[str, list[Path]] = {}
    for file in sorted(folder.rglob("*"), key=lambda file: (-len(file.parts), file)):
        if file.suffix.lower() in SUFFIXES:
            names.setdefault(file.relative_to(folder).parts[0].removesuffix(file.suffix), []).append(file)
    name, problems = mesh_name(text), []
    if name not in names:
        raise InputError(f"mesh {text} does not exist; choose from {', '.join(sorted(names))}")
    for file in names[name]:
        try:
            return file, dataclasses.replace(meshes.load_body(file, up, fill_holes=True), name=name)
        except InputError as problem:
            problems.append(str(problem))
    raise InputError(f"mesh {text}: {'; '.join(problems)}")


def named_contact(name: str, friction: tuple[float, float], bounce: tuple[float, float]) -> tuple[float, float]:
    """Friction and bounce of the body ``name``: from CONTACTS, else drawn from these ranges, seeded by the name."""
    if name in CONTACTS:
        return CONTACTS[name]
    rng = name_rng(name)
    return rng.uniform(*friction), rng.uniform(*bounce)
