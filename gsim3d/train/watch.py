"""What one training step tells beside its loss: rows that could not be used, and gradients through its rollout."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from gsim3d.numerics.policy import StabilityReport
from gsim3d.state import Particles


@dataclass(frozen=True)
class Seen:
    """What was seen in one call of the loss, as plain values.

    n_rows, n_clouds: particles that the encoder made, and in how many clouds.   n_unusable: findings of the report.
    norms: of the gradients that reached each simulated step.   error: of a number that could not be used, or None.
    """

    n_rows: int = 0
    n_clouds: int = 0
    n_unusable: int = 0
    norms: tuple[float, ...] = ()
    error: str | None = None


class StepWatch:
    """Goes along with the samples that one call of the loss sees.

    report: of that call.
    strict: a row that was dropped counts as a number that could not be used.
    """

    def __init__(self, *, strict: bool = False):
        self.strict = strict
        self.report = StabilityReport()
        self._n_rows = self._n_clouds = 0
        self._squares: list[list[Tensor]] = []

    def count(self, n_rows: int, n_clouds: int) -> None:
        """Notes how many particles the encoder made, and in how many clouds."""
        self._n_rows, self._n_clouds = n_rows, n_clouds

    def seen(self, scale: float | None) -> Seen:
        """After the backward pass of a loss that was multiplied with ``scale``; None: without the gradients' norms."""
        wrong = ("error", "dropped") if self.strict else ("error",)
        error = next((str(finding.error()) for finding in self.report.findings if finding.action in wrong), None)
        norms = () if scale is None else tuple(norm / scale for norm in self.norms())
        return Seen(self._n_rows, self._n_clouds, self.report.total, norms, error)

    def follow(self, steps: Sequence[Particles]) -> None:
        """Notes the gradients that will reach the particles of each step of a rollout."""
        self._squares = [[] for _ in steps]
        for squares, step in zip(self._squares, steps, strict=True):
            for value in step.row_fields().values():
                if value.requires_grad:
                    value.register_hook(partial(_note, squares))

    def norms(self) -> list[float]:
        """The norm of the gradient that reached each step's particles, first step first; after the backward pass."""
        return [math.sqrt(sum(square.item() for square in squares)) for squares in self._squares]


def _note(squares: list[Tensor], gradient: Tensor) -> None:
    squares.append(gradient.detach().double().square().sum())


def mean_of_norms(parts: Sequence[Sequence[float]]) -> list[float]:
    """Norms for the mean of several losses, each of other samples, from the norms for each loss."""
    return [math.sqrt(sum(norm**2 for norm in norms)) / len(parts) for norms in zip(*parts, strict=True)]


def norms_by_module(gradients: Mapping[str, Tensor | None]) -> dict[str, float]:
    """The norm of the gradients of all parameters of each part of a model, by the first word of their names."""
    parts: dict[str, list[Tensor]] = {}
    for name, gradient in gradients.items():
        if gradient is not None:
            parts.setdefault(name.split(".")[0], []).append(gradient.detach())
    norms = {name: torch.stack(torch._foreach_norm(values, 2, torch.double)) for name, values in parts.items()}
    return {name: math.sqrt(values.square().sum().item()) for name, values in norms.items()}


def first_not_finite(gradients: Iterable[tuple[str, Tensor | None]]) -> str | None:
    """Name of the first parameter whose gradient is not finite."""
    for name, gradient in gradients:
        if gradient is not None and not bool(gradient.isfinite().all()):
            return name
    return None
