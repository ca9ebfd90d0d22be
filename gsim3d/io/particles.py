"""The last steps of a scene as one .safetensors file: a state that a simulation goes on from."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path

import safetensors
from safetensors.torch import load_file, save
from torch import Tensor

from gsim3d.errors import InputError, NumericalError
from gsim3d.io.files import write_whole
from gsim3d.numerics.validate import check_particles
from gsim3d.state import Actions, Particles

STATE = "state.safetensors"  # of a run
ABOUT, VERSION = "gsim3d_particles", 1
ACTIONS = ("positions", "types")  # tensors of Particles.actions


def write_particles(path: str | Path, particles: Particles, model: str = "") -> None:
    """Writes the particles of one scene.

    Args:
        path: ends in .safetensors.
        particles: clouds of one scene.
        model: hash of the checkpoint whose latents they hold.
    """
    tensors = {name: value for name, value in vars(particles).items() if isinstance(value, Tensor)}
    facts = {"version": VERSION, "model": model}
    if particles.actions is not None:
        tensors |= {f"actions.{name}": getattr(particles.actions, name) for name in ACTIONS}
        facts["actions"] = [particles.actions.names, particles.actions.first]
    about = {ABOUT: json.dumps(facts)}
    write_whole(path, save({k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}, about))


def read_particles(path: str | Path) -> tuple[Particles, str]:
    """The particles of a file that :func:`write_particles` wrote, and the hash of their model.

    Raises:
        InputError: it is no such file, is damaged, or holds several scenes.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with safetensors.safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})[ABOUT])
        tensors = load_file(path)
        version, model = about["version"], about["model"]
        actions = _actions(about, tensors)
    except MemoryError:
        raise InputError(f"{path}: {path.stat().st_size / 2**30:.1f} GiB do not fit into memory") from None
    except (safetensors.SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path}: not a state, which gsim3d simulate writes as {STATE}, or a damaged one") from None
    if version != VERSION:
        raise InputError(f"{path}: a state of version {str(version)[:20]}; this version of gsim3d reads {VERSION}")
    known = {field.name: field for field in dataclasses.fields(Particles) if field.name != "known"}
    needed = {name for name, field in known.items() if field.default is dataclasses.MISSING}
    if wrong := sorted((set(tensors) - set(known)) | (needed - set(tensors))):
        raise InputError(f"{path}: {wrong[0][:40]} is missing or unknown: the state is damaged")
    if wrong := sorted(name for name, value in tensors.items() if value.dim() == 0):
        raise InputError(f"{path}: {wrong[0]} is a single number: the state is damaged")
    particles = Particles(**tensors, actions=actions)
    try:
        check_particles(particles, str(path), particles.dynamic_latents.dtype, {})
    except NumericalError as error:
        raise InputError(str(error)) from None
    if wrong := sorted(k for k, v in tensors.items() if v.is_floating_point() and not bool(v.isfinite().all())):
        raise InputError(f"{path}: {wrong[0]} holds numbers that are not finite")
    table = particles.clouds
    if len(particles.origin) != 1 or not len(table) or any(b <= a for a, b in pairwise(table.steps)):
        raise InputError(f"{path}: must hold ascending steps of one scene")
    return particles, str(model)


def _actions(about: dict, tensors: dict[str, Tensor]) -> Actions | None:
    """Takes the actions out of the content of a file. Raises ValueError, KeyError or TypeError if they are damaged."""
    if "actions" not in about:
        return None
    (names, first), (positions, types) = about["actions"], (tensors.pop(f"actions.{name}") for name in ACTIONS)
    names, first = tuple(map(str, names)), tuple(map(int, first))
    if types.dim() == 2:  # written when points were there at all steps
        types = types[:, None].expand(-1, positions.shape[1], -1)
    return Actions(positions, types, names, first)
