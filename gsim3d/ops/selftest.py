"""A quick check of every op against plain torch, for ``gsim3d doctor``: small inputs, forward and backward."""

from collections.abc import Callable

import torch
from torch import Tensor

from gsim3d import ops

TOLERANCE = 1e-4  # float32, relative to the largest value of the expected tensor


def _compare(device: str, function: Callable[..., Tensor], reference: Callable[..., Tensor], *inputs: Tensor) -> float:
    """Worst error of output and gradients relative to the largest expected value; raises above TOLERANCE."""
    results = []
    for f, target in ((function, device), (reference, "cpu")):
        leaves = [x.detach().to(target).requires_grad_() for x in inputs]
        out = f(*leaves)
        weights = torch.linspace(-1, 1, out.numel(), device=target).reshape(out.shape)
        results.append([out, *torch.autograd.grad((out * weights).sum(), leaves)])
    worst = 0.0
    for name, got, expected in zip(["output", *(f"gradient {i}" for i in range(len(inputs)))], *results):
        scale = expected.abs().max().clamp_min(1e-12)
        error = float((got.detach().cpu() - expected.detach()).abs().max() / scale)
        if not error <= TOLERANCE:
            raise AssertionError(f"{name} differs from plain torch by {error:.1e} of its largest value")
        worst = max(worst, error)
    return worst


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _pool(device: str) -> float:
    rows = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    cu_rows = torch.tensor([0, 7, 8, 30, 40])
    segments = [rows[a:b] for a, b in zip(cu_rows[:-1], cu_rows[1:])]
    args = rows.to(device), cu_rows.to(device)
    return max(
        _compare(
            device,
            lambda x: ops.unpool(ops.pool_max(x, *args) + ops.pool_mean(x, *args), *args, 40),
            lambda x: torch.stack([x[s].amax(0) + x[s].mean(0) for s in segments])[
                torch.repeat_interleave(torch.arange(4), cu_rows.diff())[torch.argsort(rows)]
            ],
            _random(40, 5),
        ),
        0.0,
    )


CHECKS: dict[str, Callable[[str], float]] = {"pool": _pool}
