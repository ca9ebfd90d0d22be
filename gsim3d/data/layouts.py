"""The layouts of scene folders that can be read, and the search for such folders.

A layout is a module with NAME, FILE (which describes a scene), ``recognises(folder)`` and
``read(folder, problems) -> Recording``. To read another kind of folder, write such a module and list it here.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from gsim3d.data import colmap, genesis, kubric, transforms, videos
from gsim3d.data.recording import natural_order
from gsim3d.errors import InputError

LAYOUTS = (kubric, genesis, transforms, videos, colmap)  # the first that recognises a folder reads it
MAX_DEPTH = 3  # folders below the one that is searched


def layout_of(folder: str | Path) -> ModuleType:
    """The layout of a scene folder. Raises InputError where it has none."""
    found = _find(Path(folder))
    if found is None:
        raise InputError(f"{folder} is not a scene folder: it has no {_files()} (see docs/reference/data.md)")
    return found


def find_scenes(root: str | Path) -> list[Path]:
    """Scene folders at or below ``root`` (at most three levels down), in natural order of their paths.

    Hidden folders are skipped: a scene that is being written lies in one. Scenes hold no other scenes.

    Raises:
        InputError: there is none.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    found, folders = [], [root]
    for _ in range(MAX_DEPTH + 1):
        below = []
        for folder in folders:
            if _find(folder):
                found.append(folder)
            else:
                below += [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
        folders = below
    if not found:
        raise InputError(f"{root} holds no scene: no {_files()} in it or up to three folders below")
    return sorted(found, key=lambda path: natural_order(path.relative_to(root).as_posix()))


def _find(folder: Path) -> ModuleType | None:
    return next((layout for layout in LAYOUTS if layout.recognises(folder)), None)


def _files() -> str:
    files = list(dict.fromkeys(layout.FILE for layout in LAYOUTS))
    return f"{', '.join(files[:-1])} or {files[-1]}"
