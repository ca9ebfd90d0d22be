"""Registry of scene-folder layouts, and the search for scene folders.

A layout is a module with NAME, FILE (the name of the description file), ``recognises(folder)`` and
``read(folder, problems) -> Recording``. To support another layout, write such a module and list it here.
"""

import dataclasses
from contextlib import suppress
from pathlib import Path
from types import ModuleType

from gsim3d.data import colmap, genesis, hocap, kubric, transforms, videos
from gsim3d.data.actions import read_actions
from gsim3d.data.recording import Problems, Recording, natural_order
from gsim3d.errors import InputError

LAYOUTS = (hocap, kubric, genesis, transforms, videos, colmap)  # in order of precedence
MAX_DEPTH = 3  # levels of subfolders that are searched


def layout_of(folder: str | Path) -> ModuleType:
    """Returns the layout module of a scene folder. Raises InputError if no layout recognises it."""
    if found := find_layout(Path(folder)):
        return found
    if not Path(folder).is_dir():
        raise InputError(f"{folder} is not a folder")
    with suppress(OSError):  # of folders that may not be read
        below = sorted((*Path(folder).glob("*"), *Path(folder).glob("*/*")))
        if inside := next(filter(find_layout, below), None):
            raise InputError(f"{folder} is not a scene folder, but a folder of scenes: name one, such as {inside}")
    raise InputError(f"{folder} is not a scene folder: it has no {_files()} (see docs/reference/data.md)")


def read(folder: Path, problems: Problems) -> Recording:
    """Reads a scene folder of any layout, and its actions."""
    recording = layout_of(folder).read(folder, problems)
    actions = read_actions(folder, recording.n_steps, problems)
    return recording if actions is None else dataclasses.replace(recording, actions=actions)


def find_scenes(root: str | Path) -> list[Path]:
    """Finds the scene folders at or up to three levels below ``root``, in natural order of their paths.

    Hidden folders are skipped, because unfinished scenes are written to them; scene folders are not searched further.

    Raises:
        InputError: ``root`` is not a folder or contains no scene.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    found, folders = [], [root]
    for _ in range(MAX_DEPTH + 1):
        below = []
        for folder in folders:
            if find_layout(folder):
                found.append(folder)
            else:
                below += [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
        folders = below
    if not found:
        raise InputError(f"{root} contains no scene: no {_files()} in it or up to three levels below")
    return sorted(found, key=lambda path: natural_order(path.relative_to(root).as_posix()))


def find_layout(folder: Path) -> ModuleType | None:
    """Returns the layout module that recognises ``folder``, or None."""
    return next((layout for layout in LAYOUTS if layout.recognises(folder)), None)


def _files() -> str:
    files = list(dict.fromkeys(layout.FILE for layout in LAYOUTS))
    return f"{', '.join(files[:-1])} or {files[-1]}"
