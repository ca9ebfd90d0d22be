"""Gradients of a training step: through long rollouts, with less memory, and what is known of them afterwards."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from gsim3d.dynamics import concatenate
from gsim3d.numerics.report import StabilityReport
from gsim3d.state import Particles


def in_segments(
    rollout: Callable[[Particles, int], list[Particles]], state: Particles, n_steps: int, cut: int
) -> list[Particles]:
    """``n_steps`` steps of ``rollout``; gradients flow back through ``cut`` of them at most, 0: through all."""
    steps = []
    while len(steps) < n_steps:
        segment = rollout(state, min(cut or n_steps, n_steps - len(steps)))
        state = concatenate([state, *segment]).detach()
        steps += segment
    return steps


def recomputing(parts: Collection[str], module: nn.Module) -> Callable[..., Callable[[Callable], Callable]]:
    """(part, generator) -> a decorator for functions that call ``module``, which does nothing but for ``parts``.

    What it decorates is computed again by the backward pass instead of being stored: less memory, the same bits.
    Gradients reach the function's arguments and the module's parameters alike; the module's buffers, such as running
    statistics, change in the first pass only; the generator is set back, so that both passes draw the same.
    """

    def choose(part: str, generator: torch.Generator | None = None) -> Callable[[Callable], Callable]:
        if part not in parts:
            return lambda f: f
        return lambda f: lambda *arguments: _recomputed(f, module, generator, arguments)

    return choose


def _recomputed(f: Callable, module: nn.Module, generator: torch.Generator | None, arguments: tuple) -> Any:
    before = None if generator is None else generator.get_state()

    def run(*arguments: Any) -> Any:
        if generator is not None:
            generator.set_state(before)
        return f(*arguments)

    # Re-entrant checkpoints would drop the gradients of tensors inside particles.
    contexts = {"context_fn": lambda: (nullcontext(), _unchanged_buffers(module))}
    return checkpoint(run, *arguments, use_reentrant=False, preserve_rng_state=False, **contexts)


@contextmanager
def _unchanged_buffers(module: nn.Module) -> Iterator[None]:
    before = [(buffer, buffer.clone()) for buffer in module.buffers()]
    try:
        yield
    finally:
        with torch.no_grad():
            for buffer, value in before:
                buffer.copy_(value)


@dataclass(frozen=True)
class Seen:
    """What was seen in one call of the loss, as plain values.

    Attributes:
        n_particles: that the encoder made.
        n_clouds: in how many clouds.
        n_unusable: findings of the report.
        norms: of the gradients that reached each simulated step.
        error: of a number that could not be used, or None.
    """

    n_particles: int = 0
    n_clouds: int = 0
    n_unusable: int = 0
    norms: tuple[float, ...] = ()
    error: str | None = None


class StepWatch:
    """Notes what happens in one call of the loss.

    Attributes:
        report: of that call.
        strict: a particle that was dropped counts as a number that could not be used.
    """

    def __init__(self, *, strict: bool = False):
        self.strict = strict
        self.report = StabilityReport()
        self._n_particles = self._n_clouds = 0
        self._squares: list[list[Tensor]] = []

    def count(self, n_particles: int, n_clouds: int) -> None:
        """Notes how many particles the encoder made, and in how many clouds."""
        self._n_particles, self._n_clouds = n_particles, n_clouds

    def seen(self, scale: float | None) -> Seen:
        """After the backward pass of a loss that was multiplied with ``scale``; None: without the gradients' norms."""
        wrong = ("error", "dropped") if self.strict else ("error",)
        error = next((str(finding.error()) for finding in self.report.findings if finding.action in wrong), None)
        norms = () if scale is None else tuple(norm / scale for norm in self.norms())
        return Seen(self._n_particles, self._n_clouds, self.report.total, norms, error)

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


def mean_of_norms(samples: Sequence[Sequence[float]]) -> list[float]:
    """Norms for the mean of several losses, each of other samples, from the norms for each loss."""
    return [math.sqrt(sum(norm**2 for norm in norms)) / len(samples) for norms in zip(*samples, strict=True)]


def mean_of_samples(results: Sequence[tuple]) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """Means of (loss, errors, gradients), added in the order of the samples."""
    if len(results) == 1:
        return results[0]
    losses, errors, gradients = zip(*results, strict=True)
    means = []
    for values in zip(*gradients, strict=True):
        known = [value for value in values if value is not None]
        means.append(sum(known[1:], known[0]) / len(results) if known else None)
    return sum(losses) / len(results), sum(errors) / len(results), means


def total_norm(gradients: Iterable[Tensor | None]) -> Tensor:
    """The norm of all gradients together."""
    return torch.nn.utils.get_total_norm([gradient for gradient in gradients if gradient is not None])


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
