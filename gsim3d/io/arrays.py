"""One frame of Gaussians as numpy arrays, with the quantisation and the axes that the formats share."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gsim3d.errors import InputError
from gsim3d.io.files import read_file
from gsim3d.math.rotations import quat_product, rotation_matrices, rotation_to_quat, unit_quats
from gsim3d.math.spherical_harmonics import SH_0, rotate_harmonics
from gsim3d.state import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh")
MAX_BYTES = 2**36  # of a file: 10^8 Gaussians and more
SMALLEST_SCALE = 1e-9  # metres; keeps the logarithm finite and is far below a pixel
FAR, SKEW = 1000, 1e-4  # distance too far for float32, times the extent; tolerance of rotations in transforms
HALF_TURN = 0.5**0.5
# Rotations (w, x, y, z) from axes with z up to axes with y up, and back.
Z_TO_Y_UP, Y_TO_Z_UP = (HALF_TURN, -HALF_TURN, 0.0, 0.0), (HALF_TURN, HALF_TURN, 0.0, 0.0)


@dataclass(frozen=True)
class Splats:
    """One frame of Gaussians, float32 on the CPU."""

    means: np.ndarray  #: [N, 3] metres; float64 from files
    quats: np.ndarray  #: [N, 4] unit, (w, x, y, z)
    scales: np.ndarray  #: [N, 3] standard deviations, metres, positive
    opacities: np.ndarray  #: [N] in [0, 1]
    sh: np.ndarray  #: [N, K, 3] coefficients of the 3DGS basis, K = (degree + 1)^2
    antialiased: bool = False  #: as of :class:`gsim3d.state.Gaussians`

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return int(self.sh.shape[1] ** 0.5 + 0.5) - 1


def splats_of(gaussians: Gaussians, frame: int | None, path: Path) -> Splats:
    """One frame of packed ``gaussians`` to be written; None: all as one frame.

    Raises:
        InputError: a value is not finite, or there is no colour; the message names file and field.
    """
    if gaussians.sh is None:
        raise InputError(f"{path}: cannot write Gaussians without colours: sh is None; ask the renderer for rgb")
    chosen = span_of(gaussians, frame)
    values = {name: getattr(gaussians, name)[chosen].detach().cpu().float() for name in FIELDS}
    for name, value in values.items():
        if not torch.isfinite(value).all():
            raise InputError(f"{path}: cannot write Gaussians, {name} holds values that are not finite")
    values["quats"] = unit_quats(values["quats"])
    values["scales"] = values["scales"].clamp(min=SMALLEST_SCALE)
    values["opacities"] = values["opacities"].clamp(0, 1)
    return Splats(
        **{name: value.contiguous().numpy() for name, value in values.items()}, antialiased=gaussians.antialiased
    )


def span_of(gaussians: Gaussians, frame: int | None) -> slice:
    """The Gaussians of one frame; None: all."""
    return slice(None) if frame is None else slice(*gaussians.cu_rows[frame : frame + 2].tolist())


def rows_of(gaussians: Gaussians, rows: slice | torch.Tensor) -> Gaussians:
    """The ``rows`` of ``gaussians`` as one packed frame."""
    fields = {name: getattr(gaussians, name)[rows] for name in FIELDS}
    return dataclasses.replace(gaussians, **fields, cu_rows=torch.tensor([0, len(fields["means"])]))


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
    offset = None
    if splats.means.dtype == np.float64:
        tensors["means"], offset = relative(splats.means)
    cu_rows = torch.tensor([0, splats.count])
    return Gaussians(**tensors, cu_rows=cu_rows, world_offset=offset, antialiased=splats.antialiased)


def relative(world: np.ndarray, far: float = FAR, least: float = 1.0) -> tuple[torch.Tensor, torch.Tensor | None]:
    """means float32 [N, 3] of finite positions [N, 3], and the ``world_offset`` float64 [1, 3] that they count from.

    The offset is None unless a coordinate exceeds ``far`` times half of the extent, which counts as ``least`` or more.
    """
    low, high = world.min(0, initial=np.inf), world.max(0, initial=-np.inf)
    offset = np.round(low / 2 + high / 2) if len(world) else np.zeros(3)
    if not (np.abs(offset) > far * np.maximum((high - low) / 2, least)).any():
        return torch.from_numpy(world.astype(np.float32)), None
    return torch.from_numpy((world - offset).astype(np.float32)), torch.from_numpy(offset)[None]


def joined(parts: list[Splats], path: Path) -> Splats:
    """All Gaussians of ``parts``. Raises InputError where their harmonics have different degrees."""
    if len({part.degree for part in parts}) > 1:
        raise InputError(f"{path}: its parts have different degrees of harmonics")
    return Splats(*(np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS))


def placed(splats: Splats, matrix: np.ndarray, path: Path) -> Splats:
    """``splats`` transformed by ``matrix`` float64 [4, 4]; positions become float64.

    Raises:
        InputError: it does more than turn, scale alike along all axes and move.
    """
    if (matrix == np.eye(4)).all():
        return splats
    linear = matrix[:3, :3]
    size = np.cbrt(np.linalg.det(linear)) if np.isfinite(matrix).all() else 0.0
    if not size > 0 or np.abs(linear @ linear.T / size**2 - np.eye(3)).max() > SKEW:
        raise InputError(f"{path}: a node must turn, scale alike along all axes and move; apply other transforms first")
    w, x, y, z = rotation_to_quat(torch.from_numpy(linear / size)).tolist()
    moved = turned(dataclasses.replace(splats, means=splats.means.astype(np.float64)), (w, x, y, z))
    means = moved.means * size + matrix[:3, 3]
    return dataclasses.replace(moved, means=means, scales=moved.scales * np.float32(size))


def turned(splats: Splats, quat: tuple[float, ...]) -> Splats:
    """``splats`` in axes that are rotated by the unit quaternion ``quat`` (w, x, y, z)."""
    turn = turn_matrix(quat).astype(splats.means.dtype)
    quats = quat_product(torch.tensor([quat], dtype=torch.float32), torch.from_numpy(splats.quats).float())
    sh = torch.from_numpy(splats.sh).float()
    if splats.degree:
        sh = rotate_harmonics(sh, torch.from_numpy(turn).float().expand(splats.count, 3, 3))
    return dataclasses.replace(splats, means=splats.means @ turn.T, quats=quats.numpy(), sh=sh.numpy())


def turn_matrix(quat: tuple[float, ...]) -> np.ndarray:
    """float64 [3, 3] of a unit quaternion (w, x, y, z)."""
    return rotation_matrices(torch.tensor([quat], dtype=torch.float64))[0].numpy().round(12)


def colors_of(splats: Splats) -> np.ndarray:
    """[N, 3], the view-independent part of the colours, not clamped."""
    return 0.5 + SH_0 * splats.sh[:, 0]


def dc_of(colors: np.ndarray) -> np.ndarray:
    """[N, 3], the constant coefficients of ``colors``."""
    return ((colors - 0.5) / SH_0).astype(np.float32)


def unorm(x: np.ndarray, bits: int) -> np.ndarray:
    """uint32, ``x`` in [0, 1] in ``bits`` bits, clamped."""
    most = 2**bits - 1
    return np.clip(np.floor(x.astype(np.float64) * most + 0.5), 0, most).astype(np.uint32)


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N] index of the largest component of unit ``quats`` [N, 4], and [N, 3] the others where it is made positive."""
    largest, index = np.abs(quats).argmax(1), np.arange(len(quats))
    signed = quats * np.where(quats[index, largest] < 0, -1, 1)[:, None]
    return largest.astype(np.uint32), np.stack([signed[index, k + (k >= largest)] for k in range(3)], 1)


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, 4] unit quaternions of what :func:`smallest_three` returned."""
    largest, index, quats = largest.astype(np.int64), np.arange(len(largest)), np.zeros((len(largest), 4))
    for k in range(3):
        quats[index, k + (k >= largest)] = others[:, k]
    quats[index, largest] = np.sqrt(np.clip(1 - (quats**2).sum(1), 0, 1))
    return quats


def pack_tens(first: np.ndarray, fields: np.ndarray) -> np.ndarray:
    """uint32 [N]: 2 bits of ``first`` [N], then 10 of each of ``fields`` [N, 3]."""
    a, b, c = fields.T.astype(np.uint32)
    return (first << 30) | (a << 20) | (b << 10) | c


def unpack_tens(packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What :func:`pack_tens` packed."""
    return packed >> 30, np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], 1)


def read_bytes(path: Path, *starts: bytes) -> bytes:
    """The content of a file of Gaussians; of one that begins with none of ``starts``, the first bytes alone.

    Raises:
        InputError: as :func:`gsim3d.io.files.read_file`.
    """
    head = read_head(path)
    return read_file(path, MAX_BYTES) if not starts or head.startswith(starts) else head


def read_head(path: Path) -> bytes:
    """The first 4 KiB of a file; errors as :func:`read_bytes`."""
    return read_file(path, MAX_BYTES, 4096)
