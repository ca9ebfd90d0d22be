"""3D Gaussians as .ply in the layout that viewers of 3D Gaussian splatting open.

One vertex a Gaussian, float32: x y z (float64 where they have a ``world_offset``), nx ny nz (zero), f_dc_0..2, f_rest_*
(colour-major: all red coefficients, then green, then blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3
(w, x, y, z).
"""

import dataclasses
import re
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.io.arrays import FIELDS, MAX_BYTES, SMALLEST_SCALE, dc_of, relative, span_of, splats_of
from gsim3d.io.files import read_file, write_whole
from gsim3d.io.ply_format import MAX_HEADER, MIP, read_columns, read_header
from gsim3d.math.rotations import unit_quats
from gsim3d.state import Gaussians

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
    splats = splats_of(gaussians, cloud, path)
    positions = splats.means
    if gaussians.world_offset is not None:
        offset = gaussians.world_offset.double().repeat_interleave(gaussians.cu_rows.diff(), 0)
        world = gaussians.means.detach().double() + offset
        positions = world[span_of(gaussians, cloud)].cpu().numpy()
    if not np.isfinite(positions).all():
        raise InputError(f"{path}: cannot write Gaussians, world_offset holds values that are not finite")
    opacities = torch.from_numpy(splats.opacities).double().clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    n_rest = 3 * (splats.sh.shape[1] - 1)
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(splats.count, n_rest)
    logits, logs = torch.logit(opacities).float().numpy()[:, None], torch.from_numpy(splats.scales).log().numpy()
    numbers = np.concatenate([np.zeros_like(splats.means), splats.sh[:, 0], rest, logits, logs, splats.quats], 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(n_rest))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    kinds = ["double" if positions.dtype == np.float64 else "float"] * 3 + ["float"] * (len(names) - 3)
    table = np.empty(splats.count, [(name, "<f8" if kind == "double" else "<f4") for name, kind in zip(names, kinds)])
    for i, name in enumerate(names):
        table[name] = positions[:, i] if i < 3 else numbers[:, i - 3]
    header = ["ply", "format binary_little_endian 1.0", *[f"comment {MIP}"] * splats.antialiased]
    header.append(f"element vertex {splats.count}")
    header += [f"property {kind} {name}" for name, kind in zip(names, kinds)] + ["end_header\n"]
    write_whole(path, "\n".join(header), table.tobytes())


def read_ply(path: str | Path) -> Gaussians:
    """Reads Gaussians of a .ply as one cloud: 3DGS or 2DGS, binary or text, properties in any order, others ignored.

    Colours are f_dc_*, or red, green, blue. 2DGS, which has two scales, becomes Gaussians of thickness 1e-9 m. Where
    float32 is too coarse for positions, they count from a ``world_offset``. They are ``antialiased`` where a comment
    says ``SplatRenderMode: mip`` or where they have Mip-Splatting's filter_3D, which is then part of scales and
    opacities. A warning says that harmonics of degree 4 were dropped.

    Raises:
        InputError: not a .ply, truncated, compressed, or a property is missing; the message names file and property.
    """
    path = Path(path)
    try:
        header = read_header(path, read_file(path, MAX_BYTES, MAX_HEADER))
        content = read_file(path, MAX_BYTES)
        names = {name for element in header.elements for name, _, _ in element.properties}
        if packed := sorted(name for name in names if name.startswith("packed_")):
            wanted = "write it uncompressed first, for example with splat-transform"
            raise InputError(f"{path}: a compressed .ply (it has {packed[0]}); {wanted}")
        table = read_columns(path, content, header, "vertex").get("vertex")
        if table is None:
            raise InputError(f"{path}: the header has no usable element vertex")
        return dataclasses.replace(_gaussians(path, table), antialiased="filter_3D" in names or header.is_mip)
    except MemoryError:
        raise InputError(f"{path} cannot be read: no memory for its Gaussians") from None


def _gaussians(path: Path, table: dict[str, np.ndarray]) -> Gaussians:
    def stack(names: list[str]) -> Tensor:
        missing = [name for name in names if name not in table]
        if missing:
            raise InputError(f"{path}: property {missing[0]} is missing, these are no Gaussians of 3DGS or 2DGS")
        return torch.stack([torch.from_numpy(table[name].astype(np.float32)) for name in names], 1)

    means, offset = _positions(path, stack, table)
    is_flat = "scale_1" in table and "scale_2" not in table  # Gaussians of 2DGS
    scales = torch.exp(stack(["scale_0", "scale_1"] if is_flat else ["scale_0", "scale_1", "scale_2"]))
    if is_flat:
        scales = torch.cat([scales, torch.full_like(scales[:, :1], SMALLEST_SCALE)], 1)
    opacities = torch.sigmoid(stack(["opacity"])[:, 0])
    if "filter_3D" in table:  # a 3D Gaussian of that standard deviation, with which these are convolved
        own, scales = scales, torch.hypot(scales, stack(["filter_3D"]))
        opacities = opacities * (own / scales.clamp_min(SMALLEST_SCALE)).prod(1)
    quats, sh = unit_quats(stack(["rot_0", "rot_1", "rot_2", "rot_3"])), _colors(path, stack, table).contiguous()
    gaussians = Gaussians(means, quats, scales, opacities, sh, torch.tensor([0, len(means)]), world_offset=offset)
    for name in FIELDS:
        if not torch.isfinite(getattr(gaussians, name)).all():
            raise InputError(f"{path}: {name} holds values that are not finite")
    return gaussians


def _positions(path: Path, stack, table: dict[str, np.ndarray]) -> tuple[Tensor, Tensor | None]:
    """means float32 [N, 3], and the world_offset float64 [1, 3] that they count from, None where it is 0."""
    means = stack(["x", "y", "z"])
    world = np.stack([table[name].astype(np.float64) for name in "xyz"], 1)
    if not np.isfinite(world).all():
        return means, None
    if (means.numpy() == world).all():
        return relative(world)
    return relative(world, far=1.0, least=0.0)


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
    """The constant harmonic [N, 3] of colours that are uchar, ushort of 16 bits, or floats in [0, 1]."""
    rgb = np.stack([table[name] for name in names], 1)
    kind, most = rgb.dtype.str[1:], float(rgb.max(initial=0))
    largest = {"u1": 255, "u2": 65535, "f4": 1, "f8": 1}.get(kind)
    if largest is None or not 0 <= rgb.min(initial=0) <= most <= largest or kind == "u2" and 0 < most <= 255:
        wanted = "uchar, ushort that use 16 bits, or floats in [0, 1]"
        raise InputError(f"{path}: {', '.join(names)} must be {wanted}; got {rgb.dtype} up to {most:g}")
    colors = rgb.astype(np.float32) / np.float32(largest)
    return torch.from_numpy(dc_of(colors))
