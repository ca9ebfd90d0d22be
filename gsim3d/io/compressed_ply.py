""".compressed.ply (PlayCanvas): chunks of 256 Gaussians, quantised between the limits of their chunk.

Positions and log-scales in 11, 10 and 11 bits, rotations as the three smaller components in 10 bits each, colours and
opacity in 8 bits, harmonics above degree 0 in 8 bits between -4 and 4.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.arrays import Splats, colors_of, dc_of, read_bytes, unorm, write_bytes

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
    scales, low_scale, high_scale = _between(
        np.clip(np.log(splats.scales), -LOG_SCALES, LOG_SCALES).astype(np.float32), n_chunks
    )
    colors, low_color, high_color = _between(colors_of(splats).astype(np.float32), n_chunks)
    limits = np.concatenate([low, high, low_scale, high_scale, low_color, high_color], 1).astype("<f4")
    vertices = np.stack(
        [
            _pack(positions),
            _pack_rotations(splats.quats),
            _pack(scales),
            sum(unorm(channel, 8) << shift for channel, shift in zip((*colors.T, splats.opacities), (24, 16, 8, 0))),
        ],
        1,
    ).astype("<u4")
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(splats.count, 3 * (splats.sh.shape[1] - 1))
    levels = np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {n_chunks}"]
    header += [f"property float {name}" for name in LIMITS]
    header += [f"element vertex {splats.count}", *(f"property uint {name}" for name in PACKED)]
    if rest.shape[1]:
        header += [f"element sh {splats.count}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    header.append("end_header\n")
    write_bytes(path, "\n".join(header).encode(), limits.tobytes(), vertices.tobytes(), levels.tobytes())


def is_compressed(content: bytes) -> bool:
    """Whether the content of a .ply is compressed so."""
    return re.search(rb"\nelement chunk \d+\r?\n", content[:4096]) is not None


def read(path: Path) -> Splats:
    """The Gaussians of a file. Raises InputError where it is damaged or another .ply."""
    content = read_bytes(path, b"ply")
    end = re.search(rb"end_header\r?\n", content[:65536])
    if not content.startswith(b"ply") or end is None or not is_compressed(content):
        raise InputError(f"{path}: not a compressed .ply")
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    kinds = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
    for line in content[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3 and re.fullmatch(r"\d{1,12}", words[2]):
            elements[words[1]] = int(words[2]), []
        elif words[:1] == ["property"] and elements:
            if len(words) != 3 or words[1] not in kinds:
                raise InputError(f"{path}: unsupported line in the header: {line.strip()[:80]!r}")
            elements[list(elements)[-1]][1].append((words[2], kinds[words[1]]))
        elif words[:1] == ["format"] and words[1:] != ["binary_little_endian", "1.0"]:
            raise InputError(f"{path}: a compressed .ply must be binary_little_endian 1.0")
    tables, place = {}, end.end()
    for name, (count, fields) in elements.items():
        if not fields or len({field for field, _ in fields}) != len(fields):
            raise InputError(f"{path}: element {name[:40]!r} has no usable properties")
        dtype = np.dtype(fields)
        if place + count * dtype.itemsize > len(content):
            raise InputError(f"{path}: truncated: element {name[:40]!r} of {count} rows ends behind the file")
        tables[name] = np.frombuffer(content, dtype, count, place)
        place += count * dtype.itemsize
    return _unpacked(path, tables)


def _unpacked(path: Path, tables: dict[str, np.ndarray]) -> Splats:
    for name, needed in (("chunk", LIMITS[:12]), ("vertex", PACKED)):
        if name not in tables or (missing := [key for key in needed if key not in tables[name].dtype.names]):
            raise InputError(f"{path}: element {name} lacks {missing[0] if name in tables else 'everything'}")
    chunk, vertex = tables["chunk"], tables["vertex"]
    count = len(vertex)
    if len(chunk) != -(-count // CHUNK):
        raise InputError(f"{path}: {len(chunk)} chunks for {count} Gaussians; expected {-(-count // CHUNK)}")
    of = np.arange(count) // CHUNK
    ranges = {name: chunk[name][of].astype(np.float64) for name in LIMITS if name in chunk.dtype.names}

    def between(values: np.ndarray, kind: str, axes: str, low: float = 0.0, high: float = 1.0) -> np.ndarray:
        lows, highs = (
            np.stack([np.broadcast_to(ranges.get(f"{end}{kind}_{axis}", other), count) for axis in axes], 1)
            for end, other in (("min", low), ("max", high))
        )
        return lows + values * (highs - lows)

    means = between(_unpack(vertex["packed_position"]), "", "xyz")
    scales = np.exp(np.clip(between(_unpack(vertex["packed_scale"]), "_scale", "xyz"), -LOG_SCALES, LOG_SCALES))
    packed = vertex["packed_color"]
    bytes_of = np.stack([(packed >> shift) & 255 for shift in (24, 16, 8, 0)], 1) / 255.0
    colors = between(bytes_of[:, :3], "", "rgb")
    sh = dc_of(colors)[:, None]
    if "sh" in tables:
        table = tables["sh"]
        names = [name for name in table.dtype.names if re.fullmatch(r"f_rest_\d{1,2}", name)]
        if len(table) != count or len(names) not in N_REST:
            shape = f"{len(table)} of {len(names)}"
            raise InputError(f"{path}: element sh must have {count} rows of 9, 24 or 45; got {shape}")
        missing = [f"f_rest_{i}" for i in range(len(names)) if f"f_rest_{i}" not in names]
        if missing:
            raise InputError(f"{path}: element sh lacks {missing[0]}")
        levels = np.stack([table[f"f_rest_{i}"] for i in range(len(names))], 1).astype(np.float32)
        share = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
        rest = ((share - 0.5) * 8).reshape(count, 3, len(names) // 3).transpose(0, 2, 1)
        sh = np.concatenate([sh, rest], 1)
    return Splats(means, _unpack_rotations(vertex["packed_rotation"]), scales, bytes_of[:, 3], sh)


def _sorted(splats: Splats) -> Splats:
    """In Morton order, so that chunks are small."""
    low, high = splats.means.min(0, initial=np.inf), splats.means.max(0, initial=-np.inf)
    span = np.maximum(high - low, np.finfo(np.float32).tiny)
    code = np.zeros(splats.count, np.uint64)
    cells = unorm((splats.means - low) / span, 10).astype(np.uint64) if splats.count else np.zeros((0, 3), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    order = np.argsort(code, kind="stable")
    return Splats(*(getattr(splats, name)[order] for name in ("means", "quats", "scales", "opacities", "sh")))


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


def _pack_rotations(quats: np.ndarray) -> np.ndarray:
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    signed = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    packed = largest.astype(np.uint32)
    for smaller in range(3):
        component = signed[rows, smaller + (smaller >= largest)]
        packed = (packed << 10) | unorm(component * (0.5 * 2**0.5) + 0.5, 10)
    return packed


def _unpack_rotations(packed: np.ndarray) -> np.ndarray:
    largest, rows = (packed >> 30).astype(np.int64), np.arange(len(packed))
    quats = np.zeros((len(packed), 4))
    for smaller, shift in enumerate((20, 10, 0)):
        quats[rows, smaller + (smaller >= largest)] = (((packed >> shift) & 1023) / 1023.0 - 0.5) * 2**0.5
    quats[rows, largest] = np.sqrt(np.clip(1 - (quats**2).sum(1), 0, 1))
    return quats
