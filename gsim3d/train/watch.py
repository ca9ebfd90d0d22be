"""What one training step tells beside its loss: rows that could not be used, and gradients through its rollout."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from gsim3d.stability import StabilityReport
from gsim3d.types import Particles


class StepWatch:
    """Goes along with the samples that one call of the loss sees.

    report: of that call.
    """

    def __init__(self):
        self.report = StabilityReport()
        self._squares: list[list[Tensor]] = []

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


def mean_of_norms(parts: Sequence[list[float]]) -> list[float]:
    """Norms for the mean of several losses, each of other samples, from the norms for each loss."""
    return [math.sqrt(sum(norm**2 for norm in norms)) / len(parts) for norms in zip(*parts, strict=True)]


def norms_by_module(gradients: Mapping[str, Tensor | None]) -> dict[str, float]:
    """The norm of the gradients of all parameters of each part of a model, by the first word of their names."""
    squares: dict[str, list[Tensor]] = {}
    for name, gradient in gradients.items():
        if gradient is not None:
            squares.setdefault(name.split(".")[0], []).append(gradient.detach().double().square().sum())
    return {name: math.sqrt(torch.stack(values).sum().item()) for name, values in squares.items()}


def first_not_finite(gradients: Iterable[tuple[str, Tensor | None]]) -> str | None:
    """Name of the first parameter whose gradient is not finite."""
    for name, gradient in gradients:
        if gradient is not None and not bool(gradient.isfinite().all()):
            return name
    return None
