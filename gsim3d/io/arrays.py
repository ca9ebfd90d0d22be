"""What all formats share: one frame of Gaussians as numpy arrays, quantisation, axes, files that appear whole."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gsim3d.errors import InputError
from gsim3d.io.files import read_file
from gsim3d.math.rotations import quat_product, unit_quats
from gsim3d.math.spherical_harmonics import SH_0, rotate_harmonics
from gsim3d.state import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh")
MAX_BYTES = 2**36  # of a file: 10^8 Gaussians and more
SMALLEST_SCALE = 1e-9  # metres; keeps the logarithm finite and is far below a pixel
HALF_TURN = 0.5**0.5
# Rotations (w, x, y, z) from axes with z up to axes with y up, and back.
Z_TO_Y_UP, Y_TO_Z_UP = (HALF_TURN, -HALF_TURN, 0.0, 0.0), (HALF_TURN, HALF_TURN, 0.0, 0.0)


@dataclass(frozen=True)
class Splats:
    """One frame of Gaussians, float32 on the CPU.

    Attributes:
        means: [N, 3] metres.
        quats: [N, 4] unit, (w, x, y, z).
        scales: [N, 3] standard deviations, metres, positive.
        opacities: [N] in [0, 1].
        sh: [N, K, 3] coefficients of the 3DGS basis, K = (degree + 1)^2.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return int(self.sh.shape[1] ** 0.5 + 0.5) - 1


def splats_of(gaussians: Gaussians, frame: int | None, path: Path) -> Splats:
    """One frame of ``gaussians``, or all rows where ``frame`` is None.

    Raises:
        InputError: a value is not finite, or there is no colour; the message names file and field.
    """
    if gaussians.sh is None:
        raise InputError(f"{path}: cannot write Gaussians without colours: sh is None")
    start, end = (0, gaussians.means.shape[0]) if frame is None else gaussians.cu_rows[frame : frame + 2].tolist()
    values = {name: getattr(gaussians, name)[start:end].detach().cpu().float() for name in FIELDS}
    for name, value in values.items():
        if not torch.isfinite(value).all():
            raise InputError(f"{path}: cannot write Gaussians, {name} holds values that are not finite")
    values["quats"] = unit_quats(values["quats"])
    values["scales"] = values["scales"].clamp(min=SMALLEST_SCALE)
    values["opacities"] = values["opacities"].clamp(0, 1)
    return Splats(**{name: value.contiguous().numpy() for name, value in values.items()})


def gaussians_of(splats: Splats, path: Path) -> Gaussians:
    """``splats`` as one packed frame.

    Raises:
        InputError: a value is not finite, or a scale is not positive; the message names file and field.
    """
    values = {name: np.array(getattr(splats, name), np.float32) for name in FIELDS}
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise InputError(f"{path}: {name} holds values that are not finite")
    if (values["scales"] < 0).any():
        raise InputError(f"{path}: a scale is negative")
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    tensors["quats"] = unit_quats(tensors["quats"])
    return Gaussians(**tensors, cu_rows=torch.tensor([0, splats.count]))


def turned(splats: Splats, quat: tuple[float, ...]) -> Splats:
    """``splats`` in axes that are rotated by the unit quaternion ``quat`` (w, x, y, z)."""
    w, x, y, z = quat
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).round(12)
    quats = quat_product(torch.tensor([quat], dtype=torch.float32), torch.from_numpy(splats.quats))
    sh = torch.from_numpy(splats.sh)
    if splats.degree:
        rotations = torch.from_numpy(turn).float().expand(splats.count, 3, 3)
        sh = rotate_harmonics(sh, rotations)
    means = splats.means @ turn.T.astype(np.float32)
    return Splats(means, quats.numpy(), splats.scales, splats.opacities, sh.numpy())


def colors_of(splats: Splats) -> np.ndarray:
    """[N, 3], the view-independent part of the colours, not clamped."""
    return 0.5 + SH_0 * splats.sh[:, 0]


def dc_of(colors: np.ndarray) -> np.ndarray:
    """[N, 3], the constant coefficients of ``colors``."""
    return ((colors - 0.5) / SH_0).astype(np.float32)


def logits(opacities: np.ndarray, margin: float) -> np.ndarray:
    """Logits of opacities that are kept ``margin`` from 0 and 1."""
    clamped = np.clip(opacities.astype(np.float64), margin, 1 - margin)
    return np.log(clamped / (1 - clamped))


def unorm(x: np.ndarray, bits: int) -> np.ndarray:
    """uint32, ``x`` in [0, 1] in ``bits`` bits, clamped."""
    most = 2**bits - 1
    return np.clip(np.floor(x.astype(np.float64) * most + 0.5), 0, most).astype(np.uint32)


def read_bytes(path: Path, *starts: bytes) -> bytes:
    """The content of a file of Gaussians; of one that begins with none of ``starts``, the first bytes alone.

    Raises: InputError as :func:`gsim3d.io.files.read_file`.
    """
    head = read_head(path)
    return read_file(path, MAX_BYTES) if not starts or head.startswith(starts) else head


def read_head(path: Path) -> bytes:
    """The first 4 KiB of a file; errors as :func:`read_bytes`."""
    return read_file(path, MAX_BYTES, 4096)


def write_bytes(path: Path, *parts: bytes) -> None:
    """Writes a file that appears complete or not at all."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        with open(temporary, "wb") as file:
            for part in parts:
                file.write(part)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    finally:
        temporary.unlink(missing_ok=True)
