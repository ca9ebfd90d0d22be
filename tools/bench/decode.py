"""Decoding of predicted Gaussians, against the same in plain torch."""

from functools import partial

import torch
from harness import Bench

from gsim3d.math.rotations import rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import degree_damping, readings, rotate_harmonics
from gsim3d.ops import decode_gaussians

SCALES = {"scale_min": 0.0002, "scale_max": 0.1}  # metres
COLUMNS = {1: 19, 3: 55}  # degree -> of a row


def plain(raw: torch.Tensor, degree: int) -> torch.Tensor:
    """Quaternions, scales and harmonics side by side."""
    sh, quats, scales = raw.split([raw.shape[1] - 7, 4, 3], 1)
    quats = unit_quats(quats.roll(1, 1))
    scales = SCALES["scale_min"] + (SCALES["scale_max"] - SCALES["scale_min"]) * scales.sigmoid()
    sh = sh.unflatten(1, (3, -1)).mT * degree_damping(degree, sh)[:, None]
    return torch.cat([quats, scales, rotate_harmonics(sh, rotation_matrices(quats)).flatten(1)], 1)


def main():
    bench = Bench("decode")
    large, small = ((1048576, 3), (65536, 3), (65536, 1)), ((65536, 3), (16384, 1))
    for n, degree in large if bench.device.type == "cuda" else small:
        g = torch.Generator().manual_seed(0)
        raw = torch.randn(n, COLUMNS[degree], generator=g).to(bench.device)
        table = readings(torch.float32, raw.device)

        def ours(raw):
            quats, scales, sh = decode_gaussians(raw, table, degree=degree, **SCALES)
            return torch.cat([quats, scales, sh.flatten(1)], 1)

        limit = n * COLUMNS[degree] * 4 / 4.2e9  # ms for one pass over the rows; both passes read and write five
        limits = {"limits_ms": (2 * limit, 5 * limit)}
        bench.passes(
            f"{n // 1024}k rows, degree {degree}", [raw], ours, {"torch": partial(plain, degree=degree)}, **limits
        )
    bench.finish()


if __name__ == "__main__":
    main()
