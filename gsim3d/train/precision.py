"""In which precision the parts of a model are trained, and algorithms that repeat their bits."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import torch

from gsim3d.nn.layers import tf32_only_if_asked

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
FIRST_SCALE, LARGEST_SCALE = 2.0**16, 2.0**24
STEPS_TO_DOUBLE = (
    2000  # good steps in a row; fewer cost more skipped steps, more leave small gradients at zero for longer
)

Precision = Literal["fp32", "bf16", "fp16"]


@dataclass(frozen=True)
class PrecisionConfig:
    """What matrix products, convolutions and attention of each part read: "fp32", "bf16" or "fp16".

    Weights, the residual stream, norms, positions, depths, curve codes, splats, losses, sums and the optimizer are
    float32 throughout. With "fp16" anywhere the loss is scaled, see :class:`LossScale`.
    """

    encoder: Precision = "fp32"
    dynamics: Precision = "fp32"
    renderer: Precision = "fp32"

    @property
    def scales_loss(self) -> bool:
        """Whether gradients could be too small for their numbers."""
        return "fp16" in (self.encoder, self.dynamics, self.renderer)

    def of(self, part: str, device: str) -> torch.autocast:
        """A context in which ``part`` computes as configured, whatever context is around it."""
        dtype = DTYPES[getattr(self, part)]
        return torch.autocast(device, dtype, enabled=dtype != torch.float32)


class LossScale:
    """What the loss is multiplied with, and gradients divided by, so that float16 holds the gradients between.

    Halved where a gradient is not finite, doubled after 2000 steps without.
    """

    def __init__(self, value: float = 1.0, n_good: int = 0):
        self.value, self.n_good = value, n_good

    def update(self, finite: bool) -> None:
        if not finite:
            self.value, self.n_good = max(1.0, self.value / 2), 0
            return
        self.n_good += 1
        if self.n_good == STEPS_TO_DOUBLE:
            self.value, self.n_good = min(LARGEST_SCALE, 2 * self.value), 0


@contextmanager
def deterministic() -> Iterator[None]:
    """Within it torch uses deterministic algorithms only, and TF32 only if asked."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory
    cudnn = torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # costs time and changes no result of a correct op
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    try:
        with tf32_only_if_asked():
            yield
    finally:
        torch.use_deterministic_algorithms(before)
        torch.utils.deterministic.fill_uninitialized_memory = fill
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = cudnn
