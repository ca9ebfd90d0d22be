"""Decoding of predicted Gaussians, against the same in plain torch."""

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
    cuda = bench.device.type == "cuda"
    for n, degree in ((1048576, 3), (65536, 3), (65536, 1)) if cuda else ((65536, 3), (16384, 1)):
        g = torch.Generator().manual_seed(0)
        raw = torch.randn(n, COLUMNS[degree], generator=g).to(bench.device).requires_grad_()
        table = readings(torch.float32, raw.device)

        def ours():
            quats, scales, sh = decode_gaussians(raw, table, degree=degree, **SCALES)
            return torch.cat([quats, scales, sh.flatten(1)], 1)

        def both(f):
            def run():
                out = f()
                return [out.detach(), *torch.autograd.grad(out, raw, torch.ones_like(out))]

            return run

        title, runs = f"{n // 1024}k rows, degree {degree}", (both(ours), both(lambda: plain(raw, degree)))
        if cuda:
            limit = 5 * n * COLUMNS[degree] * 4 / 4.2e9  # ms: rows and gradients read, results and gradients written
            bench.gpu(f"{title}: fwd+bwd", "float32", runs[0], {"torch": runs[1]}, limit_ms=limit)
        else:
            bench.compare(f"{title}: fwd+bwd", *runs)
    bench.finish()


if __name__ == "__main__":
    main()
