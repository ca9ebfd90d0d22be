""".splat: 32 bytes a Gaussian, no header, no view dependence.

float32 position and scale, uint8 colour and opacity, uint8 quaternion (w, x, y, z) as 128 q + 128. Written by falling
volume times opacity, so that a prefix of the file is a preview.
"""

from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.arrays import Splats, colors_of, dc_of, read_bytes, unorm
from gsim3d.io.files import write_whole

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def write(path: Path, splats: Splats) -> None:
    """Writes degree 0 of ``splats``; errors: colour and opacity 1/510, quaternion components 1/128."""
    order = np.argsort(-(splats.scales.astype(np.float64).prod(1) * splats.opacities), kind="stable")
    table = np.empty(splats.count, RECORD)
    table["means"], table["scales"] = splats.means, splats.scales
    table["rgba"][:, :3] = unorm(colors_of(splats), 8)
    table["rgba"][:, 3] = unorm(splats.opacities, 8)
    table["quats"] = np.clip(np.round(splats.quats * 128.0 + 128.0), 0, 255)
    write_whole(path, table[order].tobytes())


def read(path: Path) -> Splats:
    """The Gaussians of a file. Raises InputError where its length is not one of whole records."""
    content = read_bytes(path)
    if len(content) % RECORD.itemsize:
        raise InputError(f"{path}: {len(content)} bytes are no whole number of .splat records of {RECORD.itemsize}")
    table = np.frombuffer(content, RECORD)
    rgba = table["rgba"].astype(np.float32) / 255
    quats = (table["quats"].astype(np.float32) - 128) / 128
    return Splats(table["means"], quats, table["scales"], rgba[:, 3], dc_of(rgba[:, :3])[:, None])
