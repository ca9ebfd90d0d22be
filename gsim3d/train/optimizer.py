"""AdamW for many small tensors, learning-rate schedule, weight averaging, loss scaling, deterministic mode."""

import math
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from gsim3d.io.checkpoint import laid_out_as
from gsim3d.nn.layers import tf32_only_if_asked
from gsim3d.train.config import OptimizerConfig

START_DIVISOR = 25  # initial learning rate = peak / START_DIVISOR
END_DIVISOR = 1e4  # final learning rate = initial / END_DIVISOR
FIRST_SCALE, LARGEST_SCALE = 2.0**16, 2.0**24
MOMENTS = "step", "exp_avg", "exp_avg_sq"
STEPS_TO_DOUBLE = 2000  # consecutive finite steps after which the loss scale doubles


class Optimizer:
    """AdamW with explicit gradients and clipping at a global norm.

    Args:
        parameters: parameters by name; those of ``encoder.`` may have another learning rate.
        settings: hyperparameters.

    Attributes:
        state: "step", "exp_avg" and "exp_avg_sq" of a parameter; empty before its first update.

    Source:
        Loshchilov and Hutter 2019, "Decoupled weight decay regularization".
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], settings: OptimizerConfig):
        self._parameters, self._settings = list(parameters.values()), settings
        self._encodes = {p for name, p in parameters.items() if name.startswith("encoder.")}
        self.state: dict[nn.Parameter, dict[str, Tensor]] = defaultdict(dict)

    @torch.no_grad()
    def update(self, gradients: Sequence[Tensor | None], norm: Tensor, rate: float, encoder_rate: float = 1.0) -> None:
        """Performs one update at learning ``rate``, times ``encoder_rate`` for the encoder, with ``gradients`` in the
        order of the parameters (clipped in place; None: unchanged), whose global ``norm`` is a scalar tensor."""
        pairs = zip(self._parameters, gradients, strict=True)
        known = {p: laid_out_as(p, gradient) for p, gradient in pairs if gradient is not None}
        if not known:
            return
        share = (self._settings.clip_norm or math.inf) / (norm + 1e-6)  # as torch clips
        torch._foreach_mul_(list(known.values()), share.clamp(max=1.0))
        for encodes in (False, True):
            if some := [p for p in known if (p in self._encodes) == encodes]:
                self._step(some, [known[p] for p in some], rate * encoder_rate if encodes else rate)
        torch.autograd.graph.increment_version(list(known))  # not done by all; autocast would keep stale casts

    def restore(self, parameter: nn.Parameter, moments: Mapping[str, Tensor]) -> None:
        """Restores the saved ``state`` of ``parameter``, as far as it has one."""
        for kind in MOMENTS:
            value = moments[kind].to(parameter.device)
            self.state[parameter][kind] = value if kind == "step" else laid_out_as(parameter, value)

    def _moments(self, parameters: Sequence[nn.Parameter], kind: str) -> list[Tensor]:
        for p in parameters:
            if kind not in self.state[p]:
                self.state[p][kind] = torch.zeros_like(p) if kind != "step" else torch.zeros((), device=p.device)
        return [self.state[p][kind] for p in parameters]

    def _step(self, parameters: list[nn.Parameter], gradients: list[Tensor], rate: float) -> None:
        steps, means, squares = (self._moments(parameters, kind) for kind in MOMENTS)
        settings = {name: getattr(self._settings, name) for name in ("beta1", "beta2", "eps", "weight_decay")}
        settings |= {"lr": rate, "amsgrad": False, "maximize": False}
        torch._foreach_add_(steps, 1)
        torch._fused_adamw_(parameters, gradients, means, squares, [], steps, **settings)


@torch.no_grad()
def update_average(
    average: Mapping[str, Tensor],
    parameters: Mapping[str, Tensor],
    buffers: Mapping[str, Tensor],
    gradients: Sequence[Tensor | None],
    decay: float,
) -> None:
    """Updates an exponential moving ``average`` in place with floating buffers and with the updated parameters that
    have one of ``gradients`` (in the order of ``parameters``); copies other buffers."""
    pairs = zip(parameters.items(), gradients, strict=True)
    weights = {name: parameter for (name, parameter), gradient in pairs if gradient is not None}
    weights |= {name: value for name, value in buffers.items() if value.is_floating_point()}
    if weights:
        torch._foreach_lerp_([average[name] for name in weights], list(weights.values()), 1 - decay)
    for name in buffers.keys() - weights.keys():
        average[name].copy_(buffers[name])


def one_cycle(step: int, n_steps: int, peak: float, warm_up: float = 0.01) -> float:
    """Returns the one-cycle learning rate (Smith and Topin 2019, "Super-convergence") of ``step`` (from 0) of
    ``n_steps``: cosine from peak / 25 to the peak within the fraction ``warm_up``, then cosine to peak / 250 000."""
    start, end = peak / START_DIVISOR, peak / START_DIVISOR / END_DIVISOR
    turn = max(1.0, warm_up * n_steps - 1)
    if step <= turn:
        return _cosine(start, peak, step / turn)
    return _cosine(peak, end, min(1.0, (step - turn) / max(1.0, n_steps - 1 - turn)))


def _cosine(a: float, b: float, share: float) -> float:
    return b + (a - b) * (1 + math.cos(math.pi * share)) / 2


class LossScale:
    """Dynamic loss scale, which keeps float16 gradients from underflowing.

    Halved after a gradient that is not finite, doubled after STEPS_TO_DOUBLE consecutive finite steps.

    Attributes:
        value: factor of the loss.
        n_good: finite steps since the last change.
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
    """Context in which torch uses deterministic algorithms only, and TF32 only if enabled explicitly."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory
    cudnn = torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # a debugging aid that costs time
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    try:
        with tf32_only_if_asked():
            yield
    finally:
        torch.use_deterministic_algorithms(before)
        torch.utils.deterministic.fill_uninitialized_memory = fill
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = cudnn
