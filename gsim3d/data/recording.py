"""Recording, the canonical form of a recorded scene, and helpers shared by the layout readers."""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.errors import InputError, naming
from gsim3d.io.files import MAX_TEXT, read_file

MAX_STEPS, MAX_CAMS, MAX_SIZE = 1_000_000, 10_000, 16_384  # larger values are rejected as errors
MAX_NUMBER = 1e9  # metres, pixels, seconds; larger values are rejected as errors
NEAR_NAME, MAX_OTHERS = 0.8, 100  # similarity at which a key is taken for a misspelt one, and keys that are compared
MAX_NAME = 200  # characters of a file name
HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")  # JSON escape of a surrogate, possibly unpaired
SPACING_TOLERANCE, MAX_ROUNDING = 0.05, 0.25  # largest deviation from even spacing in steps, of times rounded to ms
BACKGROUND, FIXED, MOVING = 0, 1, 3  # pixel labels: background, static geometry, movable bodies

# (camera, ascending steps, problems) -> one image per step; None on error
ReadImages = Callable[[int, Sequence[int], "Problems"], Iterator[np.ndarray | None]]


class Problems:
    """Error sink of the readers: raises the first problem as InputError, or collects all of them in ``found``."""

    def __init__(self, collect: bool = False):
        self.collect = collect
        self.found: list[str] = []

    def add(self, message: str) -> None:
        """Raises or records a problem."""
        if not self.collect:
            raise InputError(message)
        self.found.append(message)


@dataclass(frozen=True, eq=False)
class Lens:
    """Lens distortion in OpenCV's parametrisation."""

    coefficients: np.ndarray  #: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 of the fisheye model
    fisheye: bool = False  #: whether it is the fisheye model

    def __eq__(self, other) -> bool:
        same = isinstance(other, Lens) and self.fisheye == other.fisheye
        return same and np.array_equal(self.coefficients, other.coefficients)


@dataclass(frozen=True, eq=False)
class RecordedActions:
    """Points of actors at every step of a recording."""

    positions: np.ndarray  #: float64 [T, A, 3] metres
    types: tuple[str, ...]  #: type of each point
    present: np.ndarray  #: bool [T, A], where a point is

    def every(self, stride: int) -> RecordedActions:
        """Returns the actions at every ``stride``-th step."""
        return RecordedActions(self.positions[::stride], self.types, self.present[::stride])


@dataclass(frozen=True)
class Camera:
    """One camera of a recording, in gsim3d's conventions."""

    name: str  #: name for messages
    size: tuple[int, int]  #: (width, height) of its images
    viewmats: np.ndarray  #: world-to-camera [4, 4], or [n_steps, 4, 4] if it moves
    Ks: np.ndarray  #: [3, 3], or [n_steps, 3, 3]
    lens: Lens | None = None  #: distortion; None for a pinhole


@dataclass(frozen=True)
class Recording:
    """One recorded scene in gsim3d's conventions (OpenCV axes, pixel centres at +0.5, metres)."""

    layout: str  #: name of the layout
    source: Path  #: file that describes the cameras
    n_steps: int  #: number of steps
    fps: float  #: steps per second
    camera_names: tuple[str, ...]  #: V names, for messages
    viewmats: np.ndarray  #: float64 [S, V, 4, 4], world-to-camera; S is 1 for static cameras, else n_steps
    Ks: np.ndarray  #: float64 [S, V, 3, 3]; S is 1 or n_steps
    sizes: tuple[tuple[int, int], ...]  #: (width, height) of each camera's images
    read_images: ReadImages  #: reader of images, uint8 RGB [h, w, 3]
    #: reader of labels, uint8 [h, w] of BACKGROUND, FIXED, MOVING; None if there are no labels
    read_labels: ReadImages | None = None
    distortions: tuple[Lens | None, ...] = ()  #: lens of each camera, None for a pinhole; images are still distorted
    near: float | None = None  #: None if the description does not give it
    far: float | None = None  #: None if the description does not give it
    origin: np.ndarray | None = None  #: None if the description does not give it
    bounds: np.ndarray | None = None  #: None if the description does not give it
    real_background: bool = False  #: the images show a real background, which is masked to black where labels are 0
    subtract_background: bool = False  #: derive labels by background subtraction
    notes: tuple[str, ...] = ()  #: remarks about skipped or changed data; check-data prints them
    #: float64 [3] metres, origin of all positions in the coordinates of the files; readers return 0
    world_offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    actions: RecordedActions | None = None  #: points of actors; None: no actors

    @classmethod
    def of_cameras(cls, cameras: Sequence[Camera], n_steps: int, **others: Any) -> Recording:
        """Builds a recording from ``cameras``; ``others`` are the remaining attributes."""
        return cls(
            n_steps=n_steps,
            camera_names=tuple(camera.name for camera in cameras),
            viewmats=_by_step([camera.viewmats for camera in cameras], n_steps),
            Ks=_by_step([camera.Ks for camera in cameras], n_steps),
            sizes=tuple(camera.size for camera in cameras),
            distortions=tuple(camera.lens for camera in cameras),
            **others,
        )

    def changed_actions(self, change: Callable[[np.ndarray], np.ndarray]) -> RecordedActions | None:
        """Returns ``actions`` with positions changed by a function."""
        return self.actions and dataclasses.replace(self.actions, positions=change(self.actions.positions))

    def cameras_at_step(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns viewmats [V, 4, 4] and Ks [V, 3, 3] of a step."""
        return tuple(values[step if len(values) > 1 else 0] for values in (self.viewmats, self.Ks))


def _by_step(matrices: Sequence[np.ndarray], n_steps: int) -> np.ndarray:
    """Stacks V matrices [...] (static) or [n_steps, ...] (moving) to [S, V, ...]; S is 1 if all are static."""
    full = np.stack([np.broadcast_to(matrix, (n_steps, *matrix.shape[-2:])) for matrix in matrices], 1)
    return full[:1].copy() if (full == full[:1]).all() else full


@dataclass(frozen=True)
class Description:
    """A JSON object with validating accessors."""

    values: Mapping[str, Any]  #: the object
    where: str  #: prefix of error messages, such as "metadata.json: cam_0."
    problems: Problems  #: receives the errors found

    def refuse_misspelt(self, known: Sequence[str]) -> None:
        """Raises InputError if a key resembles one of ``known``, or has such a word in it, and is none of them."""
        for key in sorted(set(self.values).difference(known))[:MAX_OTHERS]:
            lower, words = key[:100].lower(), {"fps", "offset", "near", "far"}.intersection(known)
            meant = [word for word in known if sorted(word) == sorted(lower) or word in words & {*lower.split("_")}]
            if meant := difflib.get_close_matches(lower, known, 1, NEAR_NAME) or meant:
                raise InputError(f"{self.where}{key:.80} is no key of this file; did you mean {meant[0]}?")

    def whole(self, key: str, limit: int) -> int:
        """Returns an integer from 1 to ``limit``; 1 on error."""
        value = self.values.get(key)
        if not _is_number(value) or value != value // 1 or not 1 <= value <= limit:
            self.problems.add(f"{self.where}{key} must be a whole number from 1 to {limit}; got {value!r:.80}")
            return 1
        return int(value)

    def positive(self, key: str) -> float | None:
        """Returns a positive number; None if absent or on error."""
        value = self.values.get(key)
        if value is not None and not (_is_number(value) and 0 < value <= MAX_NUMBER):
            self.problems.add(f"{self.where}{key} must be a positive number, at most {MAX_NUMBER:g}; got {value!r:.80}")
            value = None
        return None if value is None else float(value)

    def array(self, key: str, *shapes: tuple[int, ...]) -> np.ndarray | None:
        """Returns a finite float64 array of one of ``shapes``; None on error."""
        return array(self.values.get(key), shapes, f"{self.where}{key}", self.problems)

    def size(self, key: str) -> tuple[int, int]:
        """Returns (width, height) of an image; (1, 1) on error."""
        size = self.array(key, (2,))
        if size is not None and not ((size == np.round(size)) & (size >= 1) & (size <= MAX_SIZE)).all():
            self.problems.add(f"{self.where}{key} must be [width, height] in pixels; got {size.tolist()}")
            size = None
        return (1, 1) if size is None else (int(size[0]), int(size[1]))

    def workspace(self, near: float | None = None, far: float | None = None, unit: float = 1.0) -> dict[str, Any]:
        """Returns the keys common to all layouts, near, far, origin and bounds, in metres.

        Args:
            near, far: defaults in metres.
            unit: metres per unit of the description.
        """
        found: dict[str, Any] = {key: self.positive(key) for key in ("near", "far")}
        if None not in found.values() and found["far"] <= found["near"]:
            self.problems.add(f"{self.where}far must lie beyond near; got near {found['near']} and far {found['far']}")
            found["near"] = found["far"] = None
        for key, shape in (("origin", (3,)), ("bounds", (2, 3))):
            found[key] = None if self.values.get(key) is None else self.array(key, shape)
        bounds = found["bounds"]
        if bounds is not None and (bounds[0] >= bounds[1]).any():
            self.problems.add(f"{self.where}bounds must be [lower corner, upper corner]; got {bounds.tolist()}")
            found["bounds"] = None
        found = {key: None if value is None else value * unit for key, value in found.items()}
        return {**found, "near": found["near"] or near, "far": found["far"] or far}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def array(value: Any, shapes: Sequence[tuple], what: str, problems: Problems, most=MAX_NUMBER) -> np.ndarray | None:
    """Converts ``value`` to a finite float64 array of one of ``shapes``; reports errors of ``what``, returns None."""
    if value is None:
        problems.add(f"{what} is missing")
        return None
    try:
        given = np.asarray(value)
        numbers = np.asarray(value, dtype=np.float64) if given.dtype.kind in "iufO" else None
    except (TypeError, ValueError, OverflowError):
        numbers = None
    if numbers is None or numbers.shape not in shapes:
        wanted = " or ".join(str(list(shape)) for shape in shapes)
        got = repr(value)[:80] if numbers is None else str(list(numbers.shape))
        problems.add(f"{what} must be numbers of shape {wanted}; got {got}")
        return None
    if not np.isfinite(numbers).all():
        index = np.argwhere(~np.isfinite(numbers))[0]
        frame = f" (frame {index[0]})" if len(shapes) > 1 and numbers.ndim == max(map(len, shapes)) else ""
        null = given.dtype.kind == "O" and given[tuple(index)] is None
        problems.add(f"{what}{frame} contains {'null' if null else 'values that are not finite'}")
        return None
    if (np.abs(numbers) > most).any():
        problems.add(f"{what} contains {np.abs(numbers).max():g}; magnitudes above {most:g} are not allowed")
        return None
    return numbers


def read_json(file: Path) -> dict:
    """Reads the JSON object in ``file``. Raises InputError if it cannot be read or is not an object."""
    content = read_file(file, MAX_TEXT)
    with naming(f"{file} cannot be read", (ValueError, RecursionError, MemoryError)):
        text = content.decode(json.detect_encoding(content))
        content = json.loads(text)
    if not isinstance(content, dict):
        raise InputError(f"{file} must hold a JSON object; got {type(content).__name__}")
    if HALF_PAIR.search(text):  # unpaired surrogates cannot be encoded for file names and messages
        try:
            json.dumps(content, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            half = error.object[error.start]
            raise InputError(f"{file} cannot be read: it contains an unpaired surrogate, {half!a}") from None
    return content


def inside(folder: Path, relative: str, what: str) -> Path:
    """Returns ``folder / relative``, a path of any system. Raises InputError if it is outside of ``folder``."""
    file = folder / relative
    try:
        if "\\" in relative and not file.exists():
            file = folder / relative.replace("\\", "/")
        root, target = folder.resolve(), file.resolve()
        if target != root and target.is_relative_to(root) and len(file.name) <= MAX_NAME:
            return file
    except (OSError, ValueError, RuntimeError):
        pass
    raise InputError(f"{what} is not a file inside the scene folder: {str(relative)[:200]!r}")


def evenly_spaced(n: int, most: int) -> list[int]:
    """Returns at most ``most`` evenly spaced indices from 0 to n - 1, ascending."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int)).tolist()


def natural_order(text: str) -> list:
    """Returns a sort key that orders frame2 before frame10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text)]


def trailing_number(name: str) -> int | None:
    """Returns the last number in a file name without suffix; None if there is none."""
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if digits and len(digits[-1]) <= 9 else None


def common_numbers(numbers: dict[str, Sequence[int]], source: Path, problems: Problems) -> list[int]:
    """Returns the frame numbers that all cameras have; reports missing frames and uneven spacing."""
    every = sorted(set().union(*numbers.values()))
    for camera, own in numbers.items():
        missing = sorted(set(every) - set(own))
        if missing:
            shown = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
            longest = max(numbers, key=lambda name: len(numbers[name]))
            problems.add(
                f"{source}: camera {camera} has {len(own)} frames, camera {longest} {len(numbers[longest])}; "
                f"missing: frame {shown}"
            )
    common = sorted(set(every).intersection(*numbers.values()))
    gaps = np.diff(common)
    if len(gaps) and (gaps != gaps.min()).any() and common == every:
        late = int(np.argmax(gaps != gaps.min()))
        problems.add(
            f"{source}: frame numbers are times and must be evenly spaced by {gaps.min()}; frame {common[late]} is "
            f"followed by frame {common[late + 1]}"
        )
    return common


def step_rate(times: np.ndarray) -> tuple[float, int | None]:
    """Returns the rate (1/s) of ascending ``times``, and the index of the first uneven step (None if even)."""
    gaps = np.diff(times)
    rate = len(gaps) / (times[-1] - times[0])
    late = np.abs((times - times[0]) * rate - np.arange(len(times)))  # in steps
    digits = (unit for unit in (1, 0.1, 0.01, 1e-3) if np.abs(times / unit - np.round(times / unit)).max() < 1e-6)
    if late.max() <= max(SPACING_TOLERANCE, min(1.01 * rate * next(digits, 0), MAX_ROUNDING)):
        return float(rate), None
    usual = float(np.median(gaps))
    return 1 / usual, int(np.argmax(np.abs(gaps - usual)))
