"""AdamW for models of many small tensors, whose host would work longer on a step than a GPU."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from gsim3d.train.checkpoint import laid_out_as
from gsim3d.train.config import OptimizerConfig


class Optimizer(torch.optim.AdamW):
    """torch's AdamW, whose step is given its gradients and clips them at a global norm.

    On a GPU a step is some thirty launches of kernels that read many tensors each. torch's own step looks at tensor by
    tensor in Python, and counts the steps of each on the host.

    Args:
        parameters: by name; those of ``encoder.`` learn at ``settings.encoder_rate`` times the rate of a step.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], settings: OptimizerConfig):
        groups = defaultdict(list)
        for name, parameter in parameters.items():
            groups[settings.encoder_rate if name.startswith("encoder.") else 1.0].append(parameter)
        super().__init__(
            [{"params": members, "factor": factor} for factor, members in groups.items()],
            lr=0.0,
            betas=(settings.beta1, settings.beta2),
            eps=settings.eps,
            weight_decay=settings.weight_decay,
        )
        self._parameters = list(parameters.values())
        self._limit = settings.clip_norm or math.inf

    @torch.no_grad()
    def update(self, gradients: Sequence[Tensor | None], norm: Tensor, rate: float) -> None:
        """One step; ``gradients`` are clipped in place.

        Args:
            gradients: of every parameter, in order; None where it had no part: it stays as it is.
            norm: [], of all gradients together.
            rate: the learning rate.
        """
        for group in self.param_groups:
            group["lr"] = rate * group["factor"]
        if norm.is_cuda:
            self._update_at_once(gradients, norm)
            return
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        torch.nn.utils.clip_grads_with_norm_(self._parameters, self._limit, norm)
        self.step()

    def restore(self, parameter: nn.Parameter, moments: Mapping[str, Tensor]) -> None:
        """Goes on from saved "step", "exp_avg" and "exp_avg_sq" of ``parameter``."""
        self.state[parameter] = {
            kind: value.to(parameter.device) if kind == "step" else laid_out_as(parameter, value)
            for kind, value in moments.items()
        }

    def _update_at_once(self, gradients: Sequence[Tensor | None], norm: Tensor) -> None:
        pairs = zip(self._parameters, gradients, strict=True)
        known = {p: laid_out_as(p, gradient) for p, gradient in pairs if gradient is not None}
        if not known:
            return
        torch._foreach_mul_(list(known.values()), (self._limit / (norm + 1e-6)).clamp(max=1.0))  # as torch clips
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter in known]
            if not parameters:
                continue
            states = [self.state[parameter] or self._begin(parameter) for parameter in parameters]
            steps, means, squares = ([state[kind] for state in states] for kind in ("step", "exp_avg", "exp_avg_sq"))
            torch._foreach_add_(steps, 1)
            beta1, beta2 = group["betas"]
            settings = {"lr": group["lr"], "beta1": beta1, "beta2": beta2, "eps": group["eps"]}
            settings |= {"weight_decay": group["weight_decay"], "amsgrad": False, "maximize": False}
            own = [known[parameter] for parameter in parameters]
            torch._fused_adamw_(parameters, own, means, squares, [], steps, **settings)
        torch.autograd.graph.increment_version(list(known))  # which that call does not: rounded copies would stay

    def _begin(self, parameter: nn.Parameter) -> dict[str, Tensor]:
        state = self.state[parameter]
        state["step"] = torch.zeros((), device=parameter.device)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state
