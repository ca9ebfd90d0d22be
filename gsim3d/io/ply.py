"""3D Gaussians as .ply in the layout that viewers of 3D Gaussian splatting open.

One vertex a Gaussian, float32: x y z (float64 where they have a ``world_offset``), nx ny nz (zero), f_dc_0..2, f_rest_*
(colour-major: all red coefficients, then green, then blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3
(w, x, y, z).
"""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.io.files import read_file
from gsim3d.io.ply_format import MAX_HEADER, Header, read_columns, read_header
from gsim3d.math.rotations import unit_quats
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.state import Gaussians

SMALLEST_SCALE = 1e-9  # metres; keeps the logarithm finite and is far below a pixel
MAX_BYTES = 2**36  # of a file: 10^8 Gaussians and more
OPACITY_MARGIN = 1e-6  # opacities are clamped to [margin, 1 - margin]; keeps the logit finite
COLORS = (("red", "green", "blue"), ("r", "g", "b"))
READ_DEGREE = 3


def write_ply(path: str | Path, gaussians: Gaussians, cloud: int | None = None) -> None:
    """Writes the Gaussians, or those of one cloud, to ``path``; the file appears complete or not at all.

    Scales below 1e-9 m and opacities within 1e-6 of 0 or 1 are clamped, quaternions are normalised. Positions of
    Gaussians with a ``world_offset`` are written in the world, as float64.

    Raises:
        InputError: a value is not finite, or there are no colours; the message names the field.
    """
    path = Path(path)
    if gaussians.sh is None:
        raise InputError(f"{path}: cannot write Gaussians without colours: sh is None; ask the renderer for rgb")
    start, end = (0, gaussians.means.shape[0]) if cloud is None else gaussians.cu_rows[cloud : cloud + 2].tolist()
    rows = {
        name: getattr(gaussians, name)[start:end].detach().cpu().float()
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    positions = rows["means"].numpy() if gaussians.world_offset is None else _in_world(gaussians, start, end)
    for name, values in rows.items():
        if not torch.isfinite(values).all() or name == "means" and not np.isfinite(positions).all():
            raise InputError(f"{path}: cannot write Gaussians, {name} holds values that are not finite")
    opacities = rows["opacities"].double().clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = [
        torch.zeros(end - start, 3),
        rows["sh"][:, 0],
        rows["sh"][:, 1:].transpose(1, 2).flatten(1),
        torch.logit(opacities).float()[:, None],
        torch.log(rows["scales"].clamp(min=SMALLEST_SCALE)),
        unit_quats(rows["quats"]),
    ]
    numbers = torch.cat(columns, 1).numpy()
    names = _property_names(rows["sh"].shape[1] - 1)
    kinds = ["double" if positions.dtype == np.float64 else "float"] * 3 + ["float"] * (len(names) - 3)
    table = np.empty(end - start, [(name, "<f8" if kind == "double" else "<f4") for name, kind in zip(names, kinds)])
    for i, name in enumerate(names):
        table[name] = positions[:, i] if i < 3 else numbers[:, i - 3]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {end - start}"]
    header += [f"property {kind} {name}" for name, kind in zip(names, kinds)] + ["end_header\n"]
    temporary = path.with_name(f".{path.name}.part")
    with open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.tobytes())
    os.replace(temporary, path)


def _in_world(gaussians: Gaussians, start: int, end: int) -> np.ndarray:
    """float64 [end - start, 3], positions with the offsets of their clouds."""
    counts = gaussians.cu_rows.diff()
    offset = gaussians.world_offset.double().repeat_interleave(counts, 0)[start:end]
    return (gaussians.means[start:end].detach().double() + offset).cpu().numpy()


def read_ply(path: str | Path) -> Gaussians:
    """Reads Gaussians of a .ply as one cloud: 3DGS or 2DGS, binary or text, properties in any order, others ignored.

    Colours are f_dc_*, or red, green, blue. 2DGS, which has two scales, becomes Gaussians of thickness 1e-9 m. Where
    float32 does not hold the positions, they count from a ``world_offset``. A warning says that harmonics of degree 4
    were dropped, or that the Gaussians were trained with an antialiasing that is not drawn here.

    Raises:
        InputError: not a .ply, truncated, compressed, or a property is missing; the message names file and property.
    """
    path = Path(path)
    try:
        header = read_header(path, read_file(path, MAX_BYTES, MAX_HEADER))
        content = read_file(path, MAX_BYTES)
        _check_kind(path, header)
        return _gaussians(path, read_columns(path, content, header, "vertex"), header)
    except MemoryError:
        raise InputError(f"{path} cannot be read: no memory for its Gaussians") from None


def _check_kind(path: Path, header: Header) -> None:
    names = {name for element in header.elements for name, _, _ in element.properties}
    if packed := sorted(name for name in names if name.startswith("packed_")):
        raise InputError(
            f"{path}: a compressed .ply (it has {packed[0]}); write it uncompressed first, for example with "
            "splat-transform"
        )
    mips = [text for text in header.comments if re.match(r"splatrendermode\s*:\s*mip", text, re.IGNORECASE)]
    if "filter_3D" in names or mips:
        what = "filter_3D" if "filter_3D" in names else mips[0][:40]
        warnings.warn(
            f"{path}: trained with antialiasing ({what}), which is not drawn here: splats smaller than a pixel appear "
            "too bright",
            stacklevel=3,
        )


def _gaussians(path: Path, table: dict[str, np.ndarray], header: Header) -> Gaussians:
    def stack(names: list[str]) -> Tensor:
        missing = [name for name in names if name not in table]
        if missing:
            raise InputError(f"{path}: property {missing[0]} is missing, these are no Gaussians of 3DGS or 2DGS")
        return torch.stack([torch.from_numpy(table[name].astype(np.float32)) for name in names], 1)

    means, offset = _positions(path, stack, table)
    scales = torch.exp(stack(["scale_0", "scale_1"] if _is_flat(table) else ["scale_0", "scale_1", "scale_2"]))
    if _is_flat(table):
        scales = torch.cat([scales, torch.full_like(scales[:, :1], SMALLEST_SCALE)], 1)
    gaussians = Gaussians(
        means=means,
        quats=unit_quats(stack(["rot_0", "rot_1", "rot_2", "rot_3"])),
        scales=scales,
        opacities=torch.sigmoid(stack(["opacity"])[:, 0]),
        sh=_colors(path, stack, table).contiguous(),
        cu_rows=torch.tensor([0, means.shape[0]]),
        world_offset=offset,
    )
    for name in ("means", "quats", "scales", "opacities", "sh"):
        if not torch.isfinite(getattr(gaussians, name)).all():
            raise InputError(f"{path}: {name} holds values that are not finite")
    return gaussians


def _is_flat(table: dict[str, np.ndarray]) -> bool:
    """Whether these are Gaussians of 2DGS."""
    return "scale_1" in table and "scale_2" not in table


def _positions(path: Path, stack, table: dict[str, np.ndarray]) -> tuple[Tensor, Tensor | None]:
    """means float32 [N, 3], and the world_offset float64 [1, 3] that they count from, None where it is 0."""
    means = stack(["x", "y", "z"])
    world = np.stack([table[name].astype(np.float64) for name in "xyz"], 1)
    if len(world) == 0 or (means.numpy() == world).all() or not np.isfinite(world).all():
        return means, None
    low, high = world.min(0), world.max(0)
    offset = np.round(low / 2 + high / 2)
    if not offset.any() or not (np.abs(offset) > (high - low) / 2).any():
        return means, None
    return torch.from_numpy((world - offset).astype(np.float32)), torch.from_numpy(offset)[None]


def _colors(path: Path, stack, table: dict[str, np.ndarray]) -> Tensor:
    """sh [N, K, 3]."""
    rgb = next((names for names in COLORS if all(name in table for name in names)), None)
    if "f_dc_0" not in table and rgb is not None:
        return _of_bytes(path, table, rgb)[:, None]
    dc = stack(["f_dc_0", "f_dc_1", "f_dc_2"])[:, None]
    n_rest = len([name for name in table if re.fullmatch(r"f_rest_\d+", name)])
    if n_rest % 3 or n_rest // 3 not in (0, 3, 8, 15, 24):
        raise InputError(f"{path}: {n_rest} properties f_rest_*; expected 0, 9, 24, 45 or 72 (degree 0 to 4)")
    if not n_rest:
        return dc
    rest = stack([f"f_rest_{i}" for i in range(n_rest)]).reshape(-1, 3, n_rest // 3).transpose(1, 2)
    most = (READ_DEGREE + 1) ** 2 - 1
    if rest.shape[1] > most:
        warnings.warn(f"{path}: harmonics of degree 4 are dropped; colours keep degrees 0 to 3", stacklevel=4)
    return torch.cat([dc, rest[:, :most]], 1)


def _of_bytes(path: Path, table: dict[str, np.ndarray], names: tuple[str, ...]) -> Tensor:
    """The constant harmonic [N, 3] of colours that are whole numbers of their type, or floats in [0, 1]."""
    rgb = np.stack([table[name] for name in names], 1)
    largest = np.iinfo(rgb.dtype).max if rgb.dtype.kind in "iu" else 1.0
    colors = torch.from_numpy(rgb.astype(np.float32) / np.float32(largest))
    if colors.numel() and not (colors.min() >= 0 and colors.max() <= 1):
        raise InputError(f"{path}: {', '.join(names)} must be whole numbers, or floats in [0, 1]")
    return (colors - 0.5) / SH_0


def _property_names(n_rest_per_colour: int) -> list[str]:
    return (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(3 * n_rest_per_colour)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
