""".spz (Niantic): gzip of quantised arrays; version 3 is written, 2 to 4 are read.

Positions in fixed point of 24 bits (12 of them fractional: 0.12 mm), log-scales in steps of 1/16, opacity and colour in
8 bits, rotations as the three smaller components in 10 bits, harmonics in 5 (degree 1) or 4 bits.
"""

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError, naming
from gsim3d.io.arrays import Splats, from_smallest_three, pack_tens, read_bytes, smallest_three, unpack_tens
from gsim3d.io.files import write_whole

MAGIC = 0x5053474E
ANTIALIASED = 1  # bit of the flags
GZIP, ZSTD = b"\x1f\x8b", b"NGSP"  # beginnings of versions 2 and 3, and of version 4
FRACTION_BITS = 12
LEAST_RATIO = 1024 / 9  # points a byte: gzip packs no better
COLOR_SCALE = 0.15
MOST_BEHIND = 2**20  # bytes that are unpacked at a time of what is not read
N_REST = (0, 3, 8, 15)  # harmonics above degree 0, by degree
HEADER, STREAMS = struct.Struct("<IIIBBBB"), struct.Struct("<QQ")


def write(path: Path, splats: Splats) -> None:
    """Writes version 3. Raises InputError for positions beyond 2048 m, which its fixed point cannot hold."""
    bits = FRACTION_BITS
    if splats.count and np.abs(splats.means).max() >= 2**23 / 2**bits - 1:
        raise InputError(f"{path}: .spz holds positions up to 2047 m; centre the scene first, or write .ply")
    fixed = np.round(splats.means.astype(np.float64) * 2**bits).astype("<i4")
    positions = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    alphas = np.round(255 * splats.opacities.astype(np.float64)).astype(np.uint8)
    colors = np.clip(np.round(splats.sh[:, 0] * (COLOR_SCALE * 255) + 127.5), 0, 255).astype(np.uint8)
    scales = np.clip(np.round((np.log(splats.scales.astype(np.float64)) + 10) * 16), 0, 255).astype(np.uint8)
    levels = np.round(splats.sh[:, 1:] * 128.0).astype(np.int64) + 128
    bucket = np.where(np.arange(levels.shape[1]) < 3, 8, 16)[None, :, None]  # of degree 1, of others
    rest = np.clip((levels + bucket // 2) // bucket * bucket, 0, 255).astype(np.uint8)
    parts = [positions, alphas, colors, scales, _pack_rotations(splats.quats), rest]
    header = HEADER.pack(MAGIC, 3, splats.count, splats.degree, bits, ANTIALIASED * splats.antialiased, 0)
    body = header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    write_whole(path, gzip.compress(body, mtime=0))


def read(path: Path) -> Splats:
    """The Gaussians of a file. Raises InputError where it is damaged, of another version or needs ``zstandard``."""
    content = read_bytes(path, GZIP, ZSTD)
    if content.startswith(GZIP):
        return _read_gzip(path, content)
    if content.startswith(ZSTD):
        return _read_streams(path, content)
    raise InputError(f"{path}: not a .spz file")


def _read_gzip(path: Path, content: bytes) -> Splats:
    stream = zlib.decompressobj(wbits=31)
    with naming(f"{path}: damaged", zlib.error):
        head = stream.decompress(content, HEADER.size)
        if len(head) < HEADER.size:
            raise InputError(f"{path}: truncated within its header")
        version, count, degree, bits, is_mip, sizes = _checked(path, head, len(content))
        if version not in (2, 3):
            raise InputError(f"{path}: version {version} of .spz is not read; versions 2, 3 and 4 are")
        body = stream.decompress(stream.unconsumed_tail, sum(sizes)) if sum(sizes) else b""
        while not stream.eof and stream.decompress(stream.unconsumed_tail, MOST_BEHIND):
            pass  # extensions; the checksum stands at the end
    if len(body) < sum(sizes) or not stream.eof:
        raise InputError(f"{path}: truncated: {len(body)} bytes of {count} Gaussians; expected {sum(sizes)}")
    bounds = np.cumsum([0, *sizes])
    return _decoded(version, count, degree, bits, is_mip, [body[a:b] for a, b in zip(bounds, bounds[1:])])


def _read_streams(path: Path, content: bytes) -> Splats:
    """Version 4: one zstd frame an attribute."""
    if len(content) < 32:
        raise InputError(f"{path}: truncated within its header")
    version, count, degree, bits, is_mip, sizes = _checked(path, content[: HEADER.size], len(content))
    n_streams, table = struct.unpack_from("<BI", content, 15)
    expected = [size for size in sizes if size] if count else sizes[: 6 if degree else 5]
    if version != 4 or n_streams != (6 if degree else 5):
        raise InputError(f"{path}: version {version} with {n_streams} streams of degree {degree}; expected version 4")
    if table < 32 or table + n_streams * STREAMS.size > len(content):
        raise InputError(f"{path}: its table of contents lies behind the file")
    try:
        import zstandard
    except ImportError:
        raise InputError(f"{path}: version 4 of .spz needs zstandard: pip install 'gsim3d[splats]'") from None
    begin, parts = table + n_streams * STREAMS.size, []
    for index, size in zip(range(n_streams), expected + [0] * n_streams):
        packed, whole = STREAMS.unpack_from(content, table + index * STREAMS.size)
        if whole != size or begin + packed > len(content):
            raise InputError(f"{path}: stream {index} has {whole} bytes; expected {size} within the file")
        with naming(f"{path}: stream {index} is damaged", zstandard.ZstdError):
            with zstandard.ZstdDecompressor().stream_reader(content[begin : begin + packed]) as stream:
                part = stream.read(size + 1)  # a small frame may unpack to much more
        if len(part) != size:
            amount = "more" if len(part) > size else "fewer"
            raise InputError(f"{path}: stream {index} holds {amount} than {size} bytes")
        parts.append(part)
        begin += packed
    return _decoded(version, count, degree, bits, is_mip, parts + [b""] * (6 - n_streams))


def _checked(path: Path, head: bytes, n_bytes: int) -> tuple[int, int, int, int, bool, list[int]]:
    """Version, count, degree, fraction bits, whether antialiased, and the sizes of the six arrays."""
    magic, version, count, degree, bits, flags, _ = HEADER.unpack(head[: HEADER.size])
    if magic != MAGIC:
        raise InputError(f"{path}: not a .spz file")
    if count > n_bytes * LEAST_RATIO:
        raise InputError(f"{path}: {count} Gaussians cannot lie in {n_bytes} bytes")
    if degree >= len(N_REST) or bits > 23:
        raise InputError(f"{path}: degree {degree} with {bits} fraction bits; degrees 0 to 3 are read")
    per_point = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * N_REST[degree])
    return version, count, degree, bits, bool(flags & ANTIALIASED), [count * size for size in per_point]


def _decoded(version: int, count: int, degree: int, bits: int, is_mip: bool, parts: list[bytes]) -> Splats:
    positions, alphas, colors, scales, rotations, rest = (np.frombuffer(part, np.uint8) for part in parts)
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[:, :, :3] = positions.reshape(count, 3, 3)
    fixed[:, :, 3] = np.where(fixed[:, :, 2] & 128, 255, 0)
    means = fixed.view("<i4")[..., 0] / 2.0**bits
    if version == 2:
        xyz = rotations.reshape(count, 3) / 127.5 - 1
        quats = np.concatenate([np.sqrt(np.clip(1 - (xyz**2).sum(1, keepdims=True), 0, 1)), xyz], 1)
    else:
        quats = _unpack_rotations(rotations)
    dc = (colors.reshape(count, 3) / 255.0 - 0.5) / COLOR_SCALE
    harmonics = (rest.reshape(count, N_REST[degree], 3) - 128.0) / 128
    sh = np.concatenate([dc[:, None], harmonics], 1)
    return Splats(means, quats, np.exp(scales.reshape(count, 3) / 16.0 - 10), alphas / 255.0, sh, is_mip)


def _pack_rotations(quats: np.ndarray) -> np.ndarray:
    """uint32 [N]: index of the largest of (x, y, z, w), then sign and 9 bits of each of the others."""
    largest, others = smallest_three(quats[:, [1, 2, 3, 0]].astype(np.float64))
    sizes = np.clip(np.floor(511 * np.abs(others) * 2**0.5 + 0.5), 0, 511).astype(np.uint32)
    return pack_tens(largest, ((others < 0).astype(np.uint32) << 9) | sizes).astype("<u4")


def _unpack_rotations(rotations: np.ndarray) -> np.ndarray:
    largest, fields = unpack_tens(np.ascontiguousarray(rotations).view("<u4"))
    sizes = (fields & 511) / 511.0 / 2**0.5
    return from_smallest_three(largest, np.where(fields >> 9, -sizes, sizes))[:, [3, 0, 1, 2]]
