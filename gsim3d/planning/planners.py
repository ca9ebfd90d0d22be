"""MPPI, CEM and gradient descent over sequences of actions.

A planner has no notion of particles or images. It needs two callables:

- ``dynamics(state, actions)``: predicted states of K sequences of ``actions`` [K, H, A], all from one ``state``. The
  result is passed on to the cost as it is.
- ``cost(states, actions)``: costs [K].

Both are called with at most ``chunk`` sequences. Row k of a result may depend on sequence k alone, so plans do not
depend on ``chunk``. Random numbers come from a CPU generator: equal seeds draw equal sequences on every device.

Sources: Williams et al., "Information theoretic MPC for model-based reinforcement learning", ICRA 2017 (MPPI); Pinneri
et al., "Sample-efficient cross-entropy method for real-time planning", CoRL 2020 (iCEM: coloured noise, kept elites).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsim3d.errors import InputError, NumericalError, check_whole

BISECTIONS = 60  # halvings of the interval of log temperature: more than a double resolves
WIDEST = 60.0  # the interval is exp(-WIDEST) to exp(WIDEST) times the spread of the costs


@dataclass(frozen=True)
class Plan:
    """A sequence of actions and its predicted cost."""

    actions: Tensor  #: [H, A], inside the bounds
    cost: float  #: predicted cost of ``actions``
    history: tuple[float, ...]  #: lowest cost found until the end of each iteration; never rises


class Planner(ABC):
    """Base of the planners: bounds, evaluation in chunks, the best sequence, and warm starts.

    Each call of ``plan`` begins with the result of the last, without the actions that were executed in between.

    Args:
        dynamics: see the module.
        cost: see the module.
        low, high: bounds of an action [A], finite; tensors or arrays, as those of an action space.
        horizon: actions in a sequence, H.
        samples: sequences in each iteration, K.
        iterations: number of iterations in each call.
        noise: initial standard deviation, as a share of ``high - low``.
        color: exponent beta of the noise's power spectrum 1 / f^beta along the horizon: 0 is white noise; at 2 actions
            change slowly.
        chunk: largest number of sequences that are evaluated together; None: all.
        seed: of the random numbers.

    Raises:
        InputError: an argument is out of range.
    """

    def __init__(
        self,
        dynamics: Callable[[Any, Tensor], Any],
        cost: Callable[[Any, Tensor], Tensor],
        low: Tensor | np.ndarray,
        high: Tensor | np.ndarray,
        *,
        horizon: int = 10,
        samples: int = 64,
        iterations: int = 5,
        noise: float = 0.25,
        color: float = 1.0,
        chunk: int | None = None,
        seed: int = 0,
    ):
        counts = {"horizon": horizon, "samples": samples, "iterations": iterations}
        for name, value in {**counts, "chunk": samples if chunk is None else chunk}.items():
            check_whole(name, value)
        check_whole("seed", seed, 0, 2**64 - 1)
        low, high = torch.as_tensor(low), torch.as_tensor(high)
        same = low.shape == high.shape and low.device == high.device and low.dtype == high.dtype
        if not same or low.dim() != 1 or not low.is_floating_point():
            raise InputError("low and high must be vectors [A] of one length, floating dtype and device")
        if not low.isfinite().all() or not high.isfinite().all() or not (low < high).all():
            raise InputError("low and high must be finite, with low below high in every element")
        if not all(isinstance(x, Real) and 0 <= x < math.inf for x in (noise, color)) or noise == 0:
            raise InputError(f"noise must be positive and color 0 or more; got {noise!r} and {color!r}")
        self.dynamics, self.cost, self.low, self.high = dynamics, cost, low, high
        self.horizon, self.samples, self.iterations = horizon, samples, iterations
        self.noise, self.color, self.chunk = noise, color, chunk
        self._seed = seed
        self.reset()

    def reset(self) -> None:
        """Forgets earlier plans and restarts the random numbers: the state of a new planner."""
        self._generator = torch.Generator().manual_seed(self._seed)
        self._last = ((self.low + self.high) / 2).expand(self.horizon, -1)
        self._std = (self.noise * (self.high - self.low)).expand(self.horizon, -1)

    def plan(self, state: Any, executed: int = 1) -> Plan:
        """The best sequence of actions from ``state``.

        Args:
            state: is passed on to the dynamics.
            executed: actions of the last plan that were executed; 0: all of it is still ahead.

        Raises:
            NumericalError: no sequence has a finite cost.
        """
        check_whole("executed", executed, 0)
        best = _Best(_shifted(self._last, executed))
        with torch.no_grad():
            self._search(state, best, executed)
        self._last = best.actions
        return Plan(best.actions, best.cost, tuple(best.history))

    @abstractmethod
    def _search(self, state: Any, best: _Best, executed: int) -> None:
        """Improves ``best``, which holds the sequence to begin with; extends its history once an iteration."""

    def _costs(self, state: Any, actions: Tensor) -> Tensor:
        """Costs of sequences [K, H, A], float64 [K] on the CPU; infinite where they are not finite."""
        size = self.chunk or len(actions)
        found = [self._evaluate(state, actions[at : at + size]) for at in range(0, len(actions), size)]
        costs = torch.cat([part.detach().double().cpu() for part in found])
        return torch.where(costs.isfinite(), costs, math.inf)

    def _evaluate(self, state: Any, actions: Tensor) -> Tensor:
        costs = self.cost(self.dynamics(state, actions.clone()), actions.clone())  # both may edit them in place
        if not isinstance(costs, Tensor) or costs.shape != (len(actions),):
            got = list(costs.shape) if isinstance(costs, Tensor) else type(costs).__name__
            raise InputError(f"cost must return a tensor with one value a sequence [{len(actions)}]; got {got}")
        return costs

    def _sample(self, mean: Tensor, std: Tensor) -> Tensor:
        """[K, H, A]: ``mean`` first, then sequences around it, inside the bounds."""
        shape = (self.samples - 1, len(self.low), self.horizon)
        noise = colored_noise(shape, self.color, self._generator).transpose(1, 2).to(mean)
        return torch.cat([mean[None], (mean + std * noise).clamp(self.low, self.high)])


class MPPI(Planner):
    """Model predictive path integral control: the mean moves to an average of samples, weighted by exp(-cost / T).

    The noise of iteration i is divided by i + 1. The best sample is returned where the mean does not beat it.

    Args:
        temperature: T, in units of the cost; None: chosen in each iteration so that the effective sample size
            (sum w)^2 / sum w^2 is ``effective_share`` of the samples.
        effective_share: see ``temperature``.
        others: as for :class:`Planner`.
    """

    def __init__(self, *args, temperature: float | None = None, effective_share: float = 0.1, **others):
        if temperature is not None and not temperature > 0:
            raise InputError(f"temperature must be positive; got {temperature}")
        if not 0 < effective_share < 1:
            raise InputError(f"effective_share must lie between 0 and 1; got {effective_share}")
        self.temperature, self.effective_share = temperature, effective_share
        super().__init__(*args, **others)

    def _search(self, state: Any, best: _Best, executed: int) -> None:
        mean, std = best.actions, self._std
        for iteration in range(self.iterations):
            sequences = self._sample(mean, std / (iteration + 1))
            costs = self._costs(state, sequences)
            best.update(sequences, costs)
            if costs.isfinite().any():
                weights = softmin(costs, self.temperature, max(1.0, self.effective_share * self.samples))
                mean = torch.einsum("k,kha->ha", weights.to(mean), sequences)
            best.history.append(best.cost)
        best.update(mean[None], self._costs(state, mean[None]))
        best.history[-1] = best.cost


class CEM(Planner):
    """Cross-entropy method with coloured noise and kept elites (iCEM): a Gaussian is fitted to the best samples.

    Args:
        elite_share: share of the samples that the Gaussian is fitted to; at least two.
        momentum: share of the old mean and standard deviation that stays.
        kept_share: share of the elites that join the K samples of the next iteration, and of the next call, shifted.
        min_std: smallest standard deviation, as a share of ``high - low``.
        others: as for :class:`Planner`.
    """

    def __init__(
        self,
        *args,
        elite_share: float = 0.1,
        momentum: float = 0.1,
        kept_share: float = 0.3,
        min_std: float = 0.01,
        **others,
    ):
        for name, value in (("elite_share", elite_share), ("kept_share", kept_share), ("momentum", momentum)):
            if not 0 <= value < 1:
                raise InputError(f"{name} must lie from 0 to below 1; got {value}")
        if not min_std >= 0:
            raise InputError(f"min_std must be 0 or more; got {min_std}")
        self.elite_share, self.momentum, self.kept_share, self.min_std = elite_share, momentum, kept_share, min_std
        super().__init__(*args, **others)

    def reset(self) -> None:
        super().reset()
        self._kept = self.low.new_empty(0, self.horizon, len(self.low))

    def _search(self, state: Any, best: _Best, executed: int) -> None:
        mean, std = best.actions, self._std
        kept = _shifted(self._kept, executed)
        count = min(self.samples, max(2, round(self.elite_share * self.samples)))
        for _ in range(self.iterations):
            sequences = torch.cat([self._sample(mean, std), kept])
            costs = self._costs(state, sequences)
            best.update(sequences, costs)
            order = costs.argsort(stable=True)[: min(count, max(1, int(costs.isfinite().sum())))]
            elites = sequences[order.to(sequences.device)]
            kept = elites[: round(self.kept_share * count)]
            mean = self.momentum * mean + (1 - self.momentum) * elites.mean(0)
            std = self.momentum * std + (1 - self.momentum) * elites.std(0, correction=0)
            std = torch.maximum(std, self.min_std * (self.high - self.low))
            best.history.append(best.cost)
        self._kept = kept


class GradientDescent(Planner):
    """Adam on the sequence, from the best of K samples; dynamics and cost must be differentiable.

    Args:
        learning_rate: of Adam, as a share of ``high - low``.
        others: as for :class:`Planner`; ``iterations`` counts steps of Adam.
    """

    def __init__(self, *args, learning_rate: float = 0.03, iterations: int = 30, **others):
        if not learning_rate > 0:
            raise InputError(f"learning_rate must be positive; got {learning_rate}")
        self.learning_rate = learning_rate
        super().__init__(*args, iterations=iterations, **others)

    def _search(self, state: Any, best: _Best, executed: int) -> None:
        sequences = self._sample(best.actions, self._std)
        best.update(sequences, self._costs(state, sequences))
        scale = self.high - self.low
        scaled = (best.actions / scale).detach().clone().requires_grad_()
        optimizer = torch.optim.Adam([scaled], lr=self.learning_rate)
        for _ in range(self.iterations):
            with torch.enable_grad():
                value = self._evaluate(state, (scaled * scale)[None])
                # Of the actions alone, not of weights.
                sought = torch.autograd.grad(value.sum(), scaled, allow_unused=True) if value.requires_grad else [None]
            if sought[0] is None:
                raise InputError("dynamics and cost must be differentiable; use MPPI or CEM where they are not")
            scaled.grad = sought[0]
            if not scaled.grad.isfinite().all():
                break  # the best sequence so far stands
            optimizer.step()
            scaled.copy_((scaled * scale).clamp(self.low, self.high) / scale)
            actions = (scaled.detach() * scale).clamp(self.low, self.high)[None]
            best.update(actions, self._costs(state, actions))
            best.history.append(best.cost)
        best.history += [best.cost] * (self.iterations - len(best.history))


class _Best:
    """The sequence with the lowest cost so far."""

    def __init__(self, actions: Tensor):
        self.actions, self.cost, self.history = actions, math.inf, []

    def update(self, sequences: Tensor, costs: Tensor) -> None:
        lowest = int(costs.argmin())
        if costs[lowest] < self.cost:
            self.actions, self.cost = sequences[lowest].clone(), float(costs[lowest])
        if not math.isfinite(self.cost):
            raise NumericalError("no sequence of actions has a finite cost; check the dynamics and the cost")


def _shifted(actions: Tensor, steps: int) -> Tensor:
    """Sequences [..., H, A] ``steps`` later; the last action is repeated."""
    horizon = actions.shape[-2]
    return actions[..., [min(step + steps, horizon - 1) for step in range(horizon)], :]


def softmin(costs: Tensor, temperature: float | None, effective: float) -> Tensor:
    """Weights exp(-cost / T), normalised to a sum of 1.

    Args:
        costs: float64 [K]; at least one is finite.
        temperature: T; None: such that (sum w)^2 / sum w^2 equals ``effective``, by bisection.
        effective: effective sample size where ``temperature`` is None.
    Returns:
        float64 [K]; 0 where the cost is infinite.
    """
    excess = costs - costs.min()
    spread = float(excess[excess.isfinite()].max())
    if spread == 0:
        weights = (excess == 0).double()
        return weights / weights.sum()
    if temperature is not None:
        return torch.softmax(-excess / temperature, 0)
    low, high = math.log(spread) - WIDEST, math.log(spread) + WIDEST
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        weights = torch.softmax(-excess / math.exp(middle), 0)
        low, high = (middle, high) if 1 / weights.square().sum() < effective else (low, middle)
    return weights


def colored_noise(shape: tuple[int, ...], color: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise with power spectrum 1 / f^color along the last axis; variance 1 on average.

    Args:
        shape: of the result.
        color: exponent; 0: white noise.
        generator: of the CPU.
    Returns:
        float64 of ``shape``.

    Source:
        Timmer and Koenig, "On generating power law noise", Astronomy and Astrophysics 300, 1995.
    """
    white = torch.randn(shape, dtype=torch.float64, generator=generator)
    if color == 0 or shape[-1] == 1 or not white.numel():  # the transform takes no empty batch
        return white
    n = shape[-1]
    frequencies = torch.fft.rfftfreq(n, dtype=torch.float64)
    frequencies[0] = frequencies[1]  # the constant part is as strong as the slowest wave
    amplitudes = frequencies ** (-color / 2)
    copies = torch.full_like(amplitudes, 2.0)  # of each frequency in the full spectrum
    copies[0] = 1
    if n % 2 == 0:
        copies[-1] = 1
    amplitudes /= ((copies * amplitudes.square()).sum() / n).sqrt()
    return torch.fft.irfft(torch.fft.rfft(white) * amplitudes, n=n)
