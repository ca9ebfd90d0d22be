"""AdamW for models of many small tensors, whose host would work longer on a step than a GPU."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from gsim3d.train.checkpoint import laid_out_as
from gsim3d.train.config import OptimizerConfig


class Optimizer(torch.optim.AdamW):
    """torch's AdamW, whose step is given its gradients and clips them at a global norm.

    On a GPU a step is some thirty launches of kernels that read many tensors each. torch's own step looks at tensor by
    tensor in Python, and counts the steps of each on the host.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], settings: OptimizerConfig):
        betas = settings.beta1, settings.beta2
        super().__init__(parameters, lr=0.0, betas=betas, eps=settings.eps, weight_decay=settings.weight_decay)
        self._limit = settings.clip_norm or math.inf

    @torch.no_grad()
    def update(self, gradients: Sequence[Tensor | None], norm: Tensor, rate: float) -> None:
        """One step; ``gradients`` are clipped in place.

        Args:
            gradients: of every parameter, in order; None where it had no part: it stays as it is.
            norm: [], of all gradients together.
            rate: the learning rate.
        """
        (group,) = self.param_groups
        group["lr"] = rate
        if norm.is_cuda:
            self._update_at_once(group, gradients, norm)
            return
        for parameter, gradient in zip(group["params"], gradients, strict=True):
            parameter.grad = gradient
        torch.nn.utils.clip_grads_with_norm_(group["params"], self._limit, norm)
        self.step()

    def restore(self, parameter: nn.Parameter, moments: Mapping[str, Tensor]) -> None:
        """Goes on from saved "step", "exp_avg" and "exp_avg_sq" of ``parameter``."""
        self.state[parameter] = {
            kind: value.to(parameter.device) if kind == "step" else laid_out_as(parameter, value)
            for kind, value in moments.items()
        }

    def _update_at_once(self, group: dict, gradients: Sequence[Tensor | None], norm: Tensor) -> None:
        pairs = zip(group["params"], gradients, strict=True)
        known = [(p, laid_out_as(p, gradient)) for p, gradient in pairs if gradient is not None]
        if not known:
            return
        parameters, gradients = map(list, zip(*known, strict=True))
        torch._foreach_mul_(gradients, (self._limit / (norm + 1e-6)).clamp(max=1.0))  # as torch clips
        states = [self.state[parameter] or self._begin(parameter) for parameter in parameters]
        steps, means, squares = ([state[kind] for state in states] for kind in ("step", "exp_avg", "exp_avg_sq"))
        torch._foreach_add_(steps, 1)
        beta1, beta2 = group["betas"]
        settings = {"lr": group["lr"], "beta1": beta1, "beta2": beta2, "eps": group["eps"]}
        settings |= {"weight_decay": group["weight_decay"], "amsgrad": False, "maximize": False}
        torch._fused_adamw_(parameters, gradients, means, squares, [], steps, **settings)
        torch.autograd.graph.increment_version(parameters)  # which that call does not: rounded copies would stay

    def _begin(self, parameter: nn.Parameter) -> dict[str, Tensor]:
        state = self.state[parameter]
        state["step"] = torch.zeros((), device=parameter.device)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state
