"""Gradients of a training step: truncated backpropagation, activation checkpointing, norms and statistics."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from gsim3d.numerics.report import StabilityReport
from gsim3d.state import Particles, concatenate


def in_segments(
    rollout: Callable[[Particles, int], list[Particles]], state: Particles, n_steps: int, cut: int, history: int
) -> Iterator[list[Particles]]:
    """Yields ``n_steps`` steps in segments of ``cut`` (0: one), through each of which gradients flow."""
    while n_steps:
        segment = rollout(state, min(cut or n_steps, n_steps))
        state, n_steps = concatenate([state, *segment[-history:]], history).detach(), n_steps - len(segment)
        yield segment


def recomputing(parts: Collection[str], module: nn.Module) -> Callable[..., Callable[[Callable], Callable]]:
    """Returns a function (part, generator) -> decorator that applies activation checkpointing to ``parts``.

    Decorated functions, which call ``module``, are recomputed in the backward pass, with equal bits. The module's
    buffers, such as running statistics, change in the forward pass only; the generator is reset, so that both passes
    draw equal random numbers. Functions of other parts are returned unchanged.
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

    # Reentrant checkpoints do not support gradients of tensors inside dataclasses.
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
    """Statistics of one call of the loss, as plain values."""

    n_particles: int = 0  #: number of encoded particles
    n_clouds: int = 0  #: number of encoded clouds
    n_unusable: int = 0  #: number of findings in the report
    norms: tuple[float, ...] = ()  #: gradient norm with respect to each simulated step
    error: str | None = None  #: message of an invalid number; None if all are valid


class StepWatch:
    """Records statistics of one call of the loss.

    Attributes:
        report: StabilityReport of the call.
        strict: treat dropped particles as errors.
        n_particles, n_clouds: numbers of encoded particles and clouds.
    """

    def __init__(self, *, strict: bool = False):
        self.strict = strict
        self.report = StabilityReport()
        self.n_particles = self.n_clouds = 0
        self._squares: list[list[Tensor]] = []

    def seen(self, scale: float | None) -> Seen:
        """Returns the statistics after the backward pass; without gradient norms where ``scale``, the factor of the
        loss, is None."""
        wrong = ("error", "dropped") if self.strict else ("error",)
        error = next((str(finding.error()) for finding in self.report.findings if finding.action in wrong), None)
        norms = () if scale is None else tuple(norm / scale for norm in self.norms())
        return Seen(self.n_particles, self.n_clouds, self.report.total, norms, error)

    def follow(self, steps: Sequence[Particles]) -> None:
        """Registers hooks that record the gradients of each step of a rollout."""
        self._squares = [[] for _ in steps]
        for squares, step in zip(self._squares, steps, strict=True):
            for value in (value for value in step.row_fields().values() if value.requires_grad):
                value.register_hook(partial(_note, squares))

    def norms(self) -> list[float]:
        """Returns the gradient norm of each step's particles, after the backward pass."""
        return [math.sqrt(sum(square.item() for square in squares)) for squares in self._squares]


def _note(squares: list[Tensor], gradient: Tensor | None) -> None:
    if gradient is not None:  # None: zero, from an operator that nothing flows through
        squares.append(gradient.detach().double().square().sum())


def mean_of_norms(samples: Sequence[Sequence[float]]) -> list[float]:
    """Combines gradient norms of several losses over disjoint samples into those of the mean loss."""
    return [math.sqrt(sum(norm**2 for norm in norms)) / len(samples) for norms in zip(*samples, strict=True)]


def mean_of_samples(results: Sequence[tuple]) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """Averages (loss, errors, gradients) over samples, in a fixed order."""
    if len(results) == 1:
        return results[0]
    losses, errors, gradients = zip(*results, strict=True)
    means = []
    for values in zip(*gradients, strict=True):
        known = [value for value in values if value is not None]
        means.append(sum(known[1:], known[0]) / len(results) if known else None)
    return sum(losses) / len(results), sum(errors) / len(results), means


def norms_by_module(gradients: Mapping[str, Tensor | None]) -> dict[str, float]:
    """Returns the gradient norm of each top-level module."""
    parts: dict[str, list[Tensor]] = {}
    for name, gradient in gradients.items():
        if gradient is not None:
            parts.setdefault(name.split(".")[0], []).append(gradient.detach())
    norms = {name: torch.stack(torch._foreach_norm(values, 2, torch.double)) for name, values in parts.items()}
    return {name: math.sqrt(values.square().sum().item()) for name, values in norms.items()}
