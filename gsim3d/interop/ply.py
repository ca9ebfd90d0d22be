"""3D Gaussians as .ply in the layout that viewers of 3D Gaussian splatting open.

One vertex a Gaussian, float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (colour-major: all red coefficients, then
green, then blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3 (w, x, y, z).
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import torch

from gsim3d.errors import InputError
from gsim3d.files import read_file
from gsim3d.rotations import unit_quats
from gsim3d.types import Gaussians

SMALLEST_SCALE = 1e-9  # metres; keeps the logarithm finite and is far below a pixel
MAX_BYTES = 2**36  # of a file: 10^8 Gaussians and more
OPACITY_MARGIN = 1e-6  # opacities are clamped to [margin, 1 - margin]; keeps the logit finite

_DTYPES = {
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
}  # fmt: skip


def write_ply(path: str | Path, gaussians: Gaussians, cloud: int | None = None) -> None:
    """Writes the Gaussians, or those of one cloud, to ``path``; the file appears complete or not at all.

    Scales below 1e-9 m and opacities within 1e-6 of 0 or 1 are clamped, quaternions are normalised.

    Raises:
        InputError: a value is not finite; the message names the field.
    """
    path = Path(path)
    start, end = (0, gaussians.means.shape[0]) if cloud is None else gaussians.cu_rows[cloud : cloud + 2].tolist()
    rows = {
        name: getattr(gaussians, name)[start:end].detach().cpu().float()
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    for name, values in rows.items():
        if not torch.isfinite(values).all():
            raise InputError(f"{path}: cannot write Gaussians, {name} holds values that are not finite")
    opacities = rows["opacities"].double().clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = [
        rows["means"],
        torch.zeros(end - start, 3),
        rows["sh"][:, 0],
        rows["sh"][:, 1:].transpose(1, 2).flatten(1),
        torch.logit(opacities).float()[:, None],
        torch.log(rows["scales"].clamp(min=SMALLEST_SCALE)),
        unit_quats(rows["quats"]),
    ]
    table = torch.cat(columns, 1).numpy().astype("<f4")
    names = _property_names(rows["sh"].shape[1] - 1)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {end - start}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    temporary = path.with_name(f".{path.name}.part")
    with open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.tobytes())
    os.replace(temporary, path)


def read_ply(path: str | Path) -> Gaussians:
    """Reads a 3DGS .ply (binary or text, properties in any order, others ignored) as one cloud.

    Raises:
        InputError: not a .ply, truncated, or a property is missing; the message names file and property.
    """
    path = Path(path)
    try:
        return _gaussians(path, _read_vertices(path, read_file(path, MAX_BYTES)))
    except MemoryError:
        raise InputError(f"{path} cannot be read: no memory for its Gaussians") from None


def _gaussians(path: Path, table: dict[str, np.ndarray]) -> Gaussians:
    n_rest = len([name for name in table if re.fullmatch(r"f_rest_\d+", name)])
    if n_rest % 3 or n_rest // 3 not in (0, 3, 8, 15):
        raise InputError(f"{path}: {n_rest} properties f_rest_*; expected 0, 9, 24 or 45 (degree 0 to 3)")

    def stack(names):
        missing = [name for name in names if name not in table]
        if missing:
            raise InputError(f"{path}: property {missing[0]} is missing, this is not a 3DGS .ply")
        return torch.stack([torch.from_numpy(table[name].astype(np.float32)) for name in names], 1)

    names = _property_names(n_rest // 3)
    dc = stack(names[6:9])
    sh = dc[:, None]
    if n_rest:
        sh = torch.cat([sh, stack(names[9 : 9 + n_rest]).reshape(-1, 3, n_rest // 3).transpose(1, 2)], 1)
    gaussians = Gaussians(
        means=stack(["x", "y", "z"]),
        quats=unit_quats(stack(names[-4:])),
        scales=torch.exp(stack(names[-7:-4])),
        opacities=torch.sigmoid(stack(["opacity"])[:, 0]),
        sh=sh.contiguous(),
        cu_rows=torch.tensor([0, dc.shape[0]]),
    )
    for name in ("means", "quats", "scales", "opacities", "sh"):
        if not torch.isfinite(getattr(gaussians, name)).all():
            raise InputError(f"{path}: {name} holds values that are not finite")
    return gaussians


def _property_names(n_rest_per_colour: int) -> list[str]:
    return (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(3 * n_rest_per_colour)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )


def _read_vertices(path: Path, content: bytes) -> dict[str, np.ndarray]:
    """The columns of the element "vertex", which must be the first element."""
    end = re.search(rb"end_header\r?\n", content[:65536])
    if not content.startswith(b"ply") or end is None:
        raise InputError(f"{path}: not a .ply file")
    encoding, count, fields, element = None, None, [], None
    for line in content[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            encoding = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            if element is None and words[1] != "vertex":
                raise InputError(f"{path}: the first element must be vertex; got {words[1]}")
            element = words[1]
            if element == "vertex":
                count = int(words[2])
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _DTYPES:
                raise InputError(f"{path}: unsupported line in the header: {line.strip()}")
            fields.append((words[2], _DTYPES[words[1]]))
    if count is None or not fields or len({name for name, _ in fields}) != len(fields):
        raise InputError(f"{path}: the header has no usable element vertex")
    body = content[end.end() :]
    if encoding == "ascii":
        try:
            values = np.array(body.split()[: count * len(fields)], dtype=np.float64).reshape(count, len(fields))
        except ValueError:
            raise InputError(f"{path}: truncated or not numeric: expected {count} rows of {len(fields)}") from None
        return {name: values[:, i] for i, (name, _) in enumerate(fields)}
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(encoding)
    if order is None:
        raise InputError(f"{path}: unknown format {encoding}")
    dtype = np.dtype([(name, order + kind) for name, kind in fields])
    if len(body) < count * dtype.itemsize:
        raise InputError(f"{path}: truncated: {len(body)} bytes of {count} vertices; expected {count * dtype.itemsize}")
    table = np.frombuffer(body, dtype, count)
    return {name: table[name] for name, _ in fields}
