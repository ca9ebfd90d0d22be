"""All formats by suffix."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gsim3d.errors import FitWarning, InputError
from gsim3d.io import compressed_ply, gltf, splat, spz, usd
from gsim3d.io.arrays import Y_TO_Z_UP, Z_TO_Y_UP, Splats, gaussians_of, read_head, splats_of, turn_matrix, turned
from gsim3d.io.ply import read_ply, write_ply
from gsim3d.state import Gaussians

UPS = ("y", "z")


@dataclass(frozen=True)
class Format:
    """One format of Gaussians."""

    about: str  #: one line of what it keeps
    write: Callable  #: writes one frame; frames and their rate where ``has_time``
    read: Callable[[Path], Splats] | None  #: reads the (first) frame; None: it is not read
    up: str | None = "z"  #: axis that points up in a file, unless it is said otherwise; None: the file says it itself
    most_degree: int = 3  #: of spherical harmonics that it keeps
    says_antialiased: bool = False  #: whether it keeps ``antialiased``
    has_time: bool = False  #: whether one file holds a sequence


_PACKED = "positions in 11, 10 and 11 bits of a chunk of 256, colours in 8"
FORMATS = {
    ".compressed.ply": Format(_PACKED, compressed_ply.write, compressed_ply.read, says_antialiased=True),
    ".ply": Format("3DGS layout, float32", None, None, says_antialiased=True),
    ".splat": Format("float32 positions and scales, colours in 8 bits", splat.write, splat.read, most_degree=0),
    ".spz": Format("positions to 0.13 mm, 8-bit colours; version 3", spz.write, spz.read, "y", says_antialiased=True),
    ".glb": Format("glTF with KHR_gaussian_splatting, float32", gltf.write, gltf.read, up=None),
    ".usdc": Format("USD particle field, float32, with time", usd.write, usd.read, up=None, has_time=True),
    ".usda": Format("USD as text", usd.write, usd.read, up=None, has_time=True),
}


def format_of(path: str | Path, others: Sequence[str] = ()) -> tuple[str, Format]:
    """Suffix and format of a file name; an error also names ``others``, suffixes of videos.

    Raises:
        InputError: no format has this suffix.
    """
    name = Path(path).name.lower()
    for suffix, found in FORMATS.items():  # .compressed.ply stands before .ply
        if name.endswith(suffix):
            return suffix, found
    raise InputError(f"{path}: no format of Gaussians has this suffix; choose from {', '.join((*FORMATS, *others))}")


def write_splats(
    path: str | Path,
    gaussians: Gaussians | Sequence[Gaussians],
    *,
    frame: int | None = None,
    fps: float = 24.0,
    up: str | None = None,
) -> None:
    """Writes Gaussians to ``path`` in the format of its suffix; the file appears complete or not at all.

    Args:
        path: ends in one of FORMATS.
        gaussians: packed frames, z up, metres; or a sequence of single frames for formats with time.
        frame: of ``gaussians``; None: all Gaussians as one frame (formats without time) or all frames.
        fps: frames a second, of formats with time.
        up: "y" or "z", the axis that points up in the file (default: as the format's readers expect).
    Raises:
        InputError: an unknown suffix, values that are not finite, or what the format cannot hold.
    """
    path, (suffix, chosen) = Path(path), format_of(path)
    if not fps > 0:
        raise InputError(f"{path}: frames a second must be positive; got {fps}")
    parts = [gaussians] if isinstance(gaussians, Gaussians) else list(gaussians)
    turn = _turn(path, chosen, up, Z_TO_Y_UP)
    if suffix != ".ply":
        offsets = (p.world_offset for p in parts if p.world_offset is not None and bool(p.world_offset.any()))
        if (offset := next(offsets, None)) is not None:
            first = ", ".join(f"{x:.2f}" for x in offset[0].tolist())
            message = f"{path}: positions count from ({first}) m in the world, which is not kept; a .ply keeps it"
            warnings.warn(message, FitWarning, stacklevel=2)
    if not chosen.says_antialiased and any(part.antialiased for part in parts):
        message = f"{path}: {suffix} does not say that Gaussians are antialiased: small ones will appear too bright"
        warnings.warn(message, FitWarning, stacklevel=2)
    if chosen.has_time:
        chosen_of = ((part, range(len(part.cu_rows) - 1) if frame is None else (frame,)) for part in parts)
        frames = [splats_of(part, index, path) for part, indices in chosen_of for index in indices]
        if not frames:
            raise InputError(f"{path}: there is no frame to write")
        chosen.write(path, frames, fps)
        return
    if len(parts) != 1:
        raise InputError(f"{path}: {suffix} holds one frame; got {len(parts)}: choose a frame, or .usdc")
    if suffix == ".ply":
        write_ply(path, parts[0] if turn is None else _turned(parts[0], turn, path), frame)
        return
    splats = splats_of(parts[0], frame, path)
    chosen.write(path, splats if turn is None else turned(splats, turn))


def read_splats(path: str | Path, *, up: str | None = None) -> Gaussians:
    """The Gaussians of a file (the first frame of formats with time), z up, as one packed frame.

    Args:
        path: ends in one of FORMATS; a .ply may be compressed.
        up: "y" or "z", the axis that points up in the file (default: as the format says, or as its writers do).
    Raises:
        InputError: the file is damaged or of no known format; the message names it.
    """
    path, (suffix, chosen) = Path(path), format_of(path)
    turn = _turn(path, chosen, up, Y_TO_Z_UP)
    if suffix == ".glb":
        turn = Y_TO_Z_UP
    if suffix == ".ply" and compressed_ply.is_compressed(read_head(path)):
        chosen = FORMATS[".compressed.ply"]
    if chosen.read is None:
        gaussians = read_ply(path)
        return gaussians if turn is None else _turned(gaussians, turn, path)
    try:
        splats = chosen.read(path)
        splats = dataclasses.replace(splats, means=splats.means.astype(np.float64))
        return gaussians_of(splats if turn is None else turned(splats, turn), path)
    except MemoryError:
        raise InputError(f"{path} cannot be read: no memory for its Gaussians") from None


def _turned(gaussians: Gaussians, turn: tuple, path: Path) -> Gaussians:
    offset = None if gaussians.world_offset is None else gaussians.world_offset @ torch.from_numpy(turn_matrix(turn)).T
    return dataclasses.replace(gaussians_of(turned(splats_of(gaussians, None, path), turn), path), world_offset=offset)


def _turn(path: Path, chosen: Format, up: str | None, turn: tuple) -> tuple | None:
    """``turn`` where the file has y up."""
    if up is not None and up not in UPS:
        raise InputError(f"up must be y or z; got {up!r}")
    if up is not None and chosen.up is None:
        raise InputError(f"{path}: this format says itself which axis points up; leave it out")
    return turn if (up or chosen.up) == "y" else None
