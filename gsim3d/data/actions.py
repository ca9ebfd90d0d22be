"""Reader of actions.npz: positions of the points of actors, such as a pusher or a hand, at every step of a scene.

A scene folder of any layout may have the file. Its arrays: ``positions``, float32 [T, A, 3], metres, world coordinates,
finite; ``types``, strings [A], the type of each point. Point a at step t is where it was in the images of step t.
"""

import io
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from gsim3d.data.recording import MAX_NUMBER, Problems, RecordedActions
from gsim3d.errors import InputError
from gsim3d.io.files import read_file

FILE = "actions.npz"
MAX_BYTES = 256 * 2**20  # of the file, and of each array in it
MAX_TYPE = 64  # characters of the name of a type
UNREADABLE = (OSError, ValueError, KeyError, EOFError, MemoryError, NotImplementedError, RuntimeError, SyntaxError,
              TypeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error)  # fmt: skip


def read_actions(folder: Path, n_steps: int, problems: Problems) -> RecordedActions | None:
    """Reads the actions of a scene folder with ``n_steps`` steps; None without the file or on error."""
    file = folder / FILE
    if not file.exists():
        return None
    try:
        positions, types = _arrays(read_file(file, MAX_BYTES))
    except InputError as error:
        problems.add(str(error))
        return None
    except UNREADABLE as error:
        problems.add(f"{file} cannot be read: {str(error)[:200]}")
        return None
    if problem := _problem(positions, types, n_steps):
        problems.add(f"{file}: {problem}")
        return None
    return RecordedActions(positions.astype(np.float64), tuple(map(str, types)), np.ones(positions.shape[:2], bool))


def check_places(actions: RecordedActions, bounds: np.ndarray, problems: Problems) -> None:
    """Reports points that are always far from ``bounds`` [2, 3] in metres, or move by more than these in a step."""
    size, paths = bounds[1] - bounds[0], np.where(actions.present[..., None], actions.positions, np.nan)
    if not (np.abs(paths - bounds.mean(0)) <= size).all(-1).any():
        problems.add("actors: all points are far from the bounds of the scene; give metres, in the cameras' world")
    moved = np.linalg.norm(np.diff(paths, axis=0), axis=-1)
    for step, point in np.argwhere(moved > np.linalg.norm(size))[:1]:
        problems.add(
            f"actors: point {point} moves by {moved[step, point]:.3g} m, more than the scene, to frame {step + 1}"
        )


def _arrays(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist():
            if entry.file_size > MAX_BYTES:
                raise ValueError(f"{entry.filename} has {entry.file_size} bytes; more than {MAX_BYTES} are refused")
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        if missing := {"positions", "types"}.difference(file.files):
            raise ValueError(f"the array {min(missing)} is missing")
        return np.asarray(file["positions"]), np.asarray(file["types"])  # a member without array header: bytes


def _problem(positions: np.ndarray, types: np.ndarray, n_steps: int) -> str | None:
    """What is wrong with the arrays; None: nothing."""
    shape = f"{positions.dtype} {list(positions.shape)}"
    if positions.dtype != np.float32 or positions.ndim != 3 or positions.shape[2] != 3 or not positions.shape[1]:
        return f"positions must be float32 [T, A, 3] with A of 1 or more; got {shape}"
    if len(positions) != n_steps:
        return f"positions must have the {n_steps} steps of the scene; got {shape}"
    bad = ~(np.abs(positions) <= MAX_NUMBER)  # also NaN
    if bad.any():
        step, point, _ = np.argwhere(bad)[0]
        return f"positions of frame {step}, point {point} are not finite, or beyond {MAX_NUMBER:g} m"
    if types.dtype.kind != "U" or types.shape != positions.shape[1:2]:
        return f"types must be {positions.shape[1]} strings, one for each point; got {types.dtype} {list(types.shape)}"
    for number, name in enumerate(map(str, types)):
        if not 0 < len(name) <= MAX_TYPE or not name.isprintable():
            return f"types of point {number} must be a name of at most {MAX_TYPE} characters; got {name[:80]!r}"
    return None
