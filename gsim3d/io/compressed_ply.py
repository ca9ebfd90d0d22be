""".compressed.ply (PlayCanvas): chunks of 256 Gaussians, quantised between the limits of their chunk.

Positions and log-scales in 11, 10 and 11 bits, rotations as the three smaller components in 10 bits each, colours and
opacity in 8 bits, harmonics above degree 0 in 8 bits between -4 and 4.
"""

import dataclasses
import re
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.arrays import (
    FIELDS,
    Splats,
    colors_of,
    dc_of,
    from_smallest_three,
    pack_tens,
    read_bytes,
    smallest_three,
    unorm,
    unpack_tens,
)
from gsim3d.io.files import write_whole
from gsim3d.io.ply_format import MIP, read_columns, read_header

CHUNK = 256
LOG_SCALES = 20.0  # limit of log-scales
LIMITS = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
LIMITS += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
LIMITS += [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
N_REST = (0, 9, 24, 45)  # harmonics above degree 0, by degree
BITS = (11, 10, 11)


def write(path: Path, splats: Splats) -> None:
    """Writes ``splats`` in Morton order of their positions; errors as the module says, in a chunk of 256."""
    splats = _sorted(splats)
    n_chunks = -(-splats.count // CHUNK)
    positions, low, high = _between(splats.means, n_chunks)
    log_scales = np.clip(np.log(splats.scales), -LOG_SCALES, LOG_SCALES).astype(np.float32)
    scales, low_scale, high_scale = _between(log_scales, n_chunks)
    colors, low_color, high_color = _between(colors_of(splats).astype(np.float32), n_chunks)
    limits = np.concatenate([low, high, low_scale, high_scale, low_color, high_color], 1).astype("<f4")
    rgba = sum(unorm(channel, 8) << shift for channel, shift in zip((*colors.T, splats.opacities), (24, 16, 8, 0)))
    largest, others = smallest_three(splats.quats)
    rotations = pack_tens(largest, unorm(others * (0.5 * 2**0.5) + 0.5, 10))
    packed = (_pack(positions), rotations, _pack(scales), rgba)
    vertices = np.stack(packed, 1).astype("<u4")
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(splats.count, 3 * (splats.sh.shape[1] - 1))
    levels = np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    header = ["ply", "format binary_little_endian 1.0", *[f"comment {MIP}"] * splats.antialiased]
    header.append(f"element chunk {n_chunks}")
    header += [f"property float {name}" for name in LIMITS]
    header += [f"element vertex {splats.count}", *(f"property uint {name}" for name in PACKED)]
    if rest.shape[1]:
        header += [f"element sh {splats.count}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    header.append("end_header\n")
    write_whole(path, "\n".join(header).encode(), limits.tobytes(), vertices.tobytes(), levels.tobytes())


def is_compressed(content: bytes) -> bool:
    """Whether the content of a .ply is compressed so."""
    return re.search(rb"\nelement chunk \d+\r?\n", content[:4096]) is not None


def read(path: Path) -> Splats:
    """The Gaussians of a file. Raises InputError where it is damaged or another .ply."""
    content = read_bytes(path, b"ply")
    if not is_compressed(content):
        raise InputError(f"{path}: not a compressed .ply")
    header = read_header(path, content)
    tables = read_columns(path, content, header, "chunk", "vertex", "sh")
    for name, needed, kind in (("chunk", LIMITS[:12], "f"), ("vertex", PACKED, "u")):
        missing = [key for key in needed if key not in tables.get(name, ()) or tables[name][key].dtype.kind != kind]
        if missing:
            raise InputError(f"{path}: element {name} lacks {missing[0] if name in tables else 'everything'}")
    chunk, vertex = tables["chunk"], tables["vertex"]
    count, n_chunks = len(vertex[PACKED[0]]), len(chunk[LIMITS[0]])
    if n_chunks != -(-count // CHUNK):
        raise InputError(f"{path}: {n_chunks} chunks for {count} Gaussians; expected {-(-count // CHUNK)}")
    of = np.arange(count) // CHUNK

    def between(values: np.ndarray, kind: str, axes: str) -> np.ndarray:
        names = [[f"{end}{kind}_{axis}" for axis in axes] for end in ("min", "max")]
        if not all(name in chunk for name in sum(names, [])):  # files of older writers have no limits of colours
            return values
        low, high = (np.stack([chunk[name][of].astype(np.float64) for name in some], 1) for some in names)
        return low + values * (high - low)

    packed = vertex["packed_color"]
    bytes_of = np.stack([(packed >> shift) & 255 for shift in (24, 16, 8, 0)], 1) / 255.0
    largest, others = unpack_tens(vertex["packed_rotation"])
    log_scales = between(_unpack(vertex["packed_scale"]), "_scale", "xyz")
    return Splats(
        means=between(_unpack(vertex["packed_position"]), "", "xyz"),
        quats=from_smallest_three(largest, (others / 1023.0 - 0.5) * 2**0.5),
        scales=np.exp(np.clip(log_scales, -LOG_SCALES, LOG_SCALES)),
        opacities=bytes_of[:, 3],
        sh=np.concatenate([dc_of(between(bytes_of[:, :3], "", "rgb"))[:, None], _rest(path, tables, count)], 1),
        antialiased=header.is_mip,
    )


def _rest(path: Path, tables: dict[str, dict[str, np.ndarray]], count: int) -> np.ndarray:
    """[N, K - 1, 3], the harmonics above degree 0."""
    table = tables.get("sh", {})
    n_rest = len([name for name in table if re.fullmatch(r"f_rest_\d{1,2}", name)])
    if missing := [f"f_rest_{i}" for i in range(n_rest) if f"f_rest_{i}" not in table]:
        raise InputError(f"{path}: element sh lacks {missing[0]}")
    if n_rest not in N_REST or n_rest and len(table["f_rest_0"]) != count:
        raise InputError(f"{path}: element sh must have {count} rows of 9, 24 or 45 harmonics; got {n_rest}")
    levels = np.zeros((count, n_rest), np.float32)
    for i in range(n_rest):
        levels[:, i] = table[f"f_rest_{i}"]
    share = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
    return ((share - 0.5) * 8).reshape(count, 3, n_rest // 3).transpose(0, 2, 1)


def _sorted(splats: Splats) -> Splats:
    """In Morton order, so that chunks are small."""
    low, high = splats.means.min(0, initial=np.inf), splats.means.max(0, initial=-np.inf)
    span = np.maximum(high - low, np.finfo(np.float32).tiny)
    code = np.zeros(splats.count, np.uint64)
    cells = unorm((splats.means - low) / span, 10).astype(np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    order = np.argsort(code, kind="stable")
    return dataclasses.replace(splats, **{name: getattr(splats, name)[order] for name in FIELDS})


def _between(values: np.ndarray, n_chunks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``values`` [N, 3] between the limits of their chunk, and these limits [n_chunks, 3]."""
    if not n_chunks:
        return values.astype(np.float64), np.zeros((0, 3)), np.zeros((0, 3))
    starts = np.arange(n_chunks) * CHUNK
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    of = np.arange(len(values)) // CHUNK
    span = (high - low).astype(np.float64)
    return (values - low[of]) / np.where(span == 0, 1, span)[of], low, high


def _pack(values: np.ndarray) -> np.ndarray:
    x, y, z = (unorm(values[:, axis], bits) for axis, bits in enumerate(BITS))
    return (x << 21) | (y << 11) | z


def _unpack(packed: np.ndarray) -> np.ndarray:
    return np.stack([(packed >> 21) / 2047.0, ((packed >> 11) & 1023) / 1023.0, (packed & 2047) / 2047.0], 1)
