"""A sequence of Gaussians on disk: a folder of one file a frame, with its rate beside it."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

from gsim3d.errors import InputError, naming
from gsim3d.io.files import MAX_TEXT, read_file
from gsim3d.io.formats import FORMATS, read_splats
from gsim3d.state import Gaussians

ABOUT = "sequence.json"
GAUSSIANS = "gaussians"  # folder of a run


@dataclass(frozen=True)
class Sequence:
    """Frames of Gaussians, read when they are asked for."""

    files: tuple[Path, ...]  #: one a frame, in the order of their names
    fps: float | None = None  #: frames a second; None: the folder does not say
    up: str | None = None  #: axis that points up in the files; None: as their format does

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, frame: int) -> Gaussians:
        return read_splats(self.files[frame], up=self.up)


def write_about(folder: Path, fps: float) -> None:
    """Writes rate, up axis and unit of the frames in ``folder`` beside them."""
    (folder / ABOUT).write_text(json.dumps({"fps": fps, "up": "z", "unit": "metre"}) + "\n")


def open_sequence(target: str | Path, up: str | None = None) -> Sequence:
    """The frames of ``target``: a file of Gaussians, a folder of such files, or a folder that has them in gaussians/.

    ``up`` is the axis that points up in the files (default: as their formats say).

    Raises:
        InputError: there are none, or they are of several formats.
    """
    if (target := Path(target)).is_file():
        return Sequence((target,), up=up)
    if not target.is_dir():
        raise InputError(f"{target}: no such file or folder")
    folder = target / GAUSSIANS if (target / GAUSSIANS).is_dir() else target
    files = sorted(path for path in folder.iterdir() if path.is_file() and _suffix(path))
    kinds = sorted({_suffix(path) for path in files})
    if len(kinds) != 1:
        none = "no file of Gaussians (of a data set, view a scene)"
        found = f"files of several formats: {', '.join(kinds)}" if kinds else none
        raise InputError(f"{folder}: {found}; formats: {', '.join(FORMATS)}")
    return Sequence(tuple(files), _fps(folder / ABOUT), up)


def _suffix(path: Path) -> str | None:
    return next((suffix for suffix in FORMATS if path.name.lower().endswith(suffix)), None)


def _fps(about: Path) -> float | None:
    if not about.is_file():
        return None
    kinds = ValueError, KeyError, TypeError, OverflowError, RecursionError
    with naming(f"{about}: not the description of a sequence", kinds):
        fps = json.loads(read_file(about, MAX_TEXT))["fps"]
        if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps < math.inf:
            raise ValueError(f"fps must be a positive number; got {fps!r:.40}")
        return float(fps)
