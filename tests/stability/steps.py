"""One step of the dynamics on a hard scene beside an ordinary one in the same call."""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.dynamics import DynamicsConfig
from gsim3d.state import Particles
from tests.dynamics.scenes import TINY, batch, float_fields, make_dynamics, make_history
from tests.stability.setting import Measured, Setting

EXACT = Setting(torch.device("cpu"), "float64")


@dataclass(frozen=True)
class Step:
    """fields: of the rows of the newest steps.   grads: of all rows that went in.   parameters: their gradients."""

    fields: dict[str, Tensor]
    grads: dict[str, Tensor]
    parameters: dict[str, Tensor]

    @property
    def tensors(self) -> list[Tensor]:
        return [*self.fields.values(), *self.grads.values(), *self.parameters.values()]


def simulate(
    setting: Setting, history: Particles, config: DynamicsConfig = TINY, *, training: bool = False, prepare=None
) -> Step:
    """A step of a network with random weights, and the gradients of a weighted sum of all that comes out.

    prepare: what to do to the network first.
    """
    dynamics = make_dynamics(config)
    if prepare is not None:
        prepare(dynamics)
    dynamics = setting.to(dynamics).train(training)
    history = setting.to(history)
    leaves = {name: value.detach().clone().requires_grad_() for name, value in float_fields(history).items()}
    fields = float_fields(dynamics(dataclasses.replace(history, **leaves)))
    total = sum((_weights(value) * value).sum() for value in fields.values())
    sources = {**leaves, **{f"parameter {name}": p for name, p in dynamics.named_parameters()}}
    found = torch.autograd.grad(total, list(sources.values()), allow_unused=True)
    grads = {n: torch.zeros_like(s) if g is None else g for (n, s), g in zip(sources.items(), found, strict=True)}
    return Step(
        {name: value.detach() for name, value in fields.items()},
        {name: grads[name] for name in leaves},
        {name: grads[name] for name in sources if name not in leaves},
    )


def _weights(value: Tensor) -> Tensor:
    """Different for each channel, the same for each row."""
    shape = value.shape[1:]
    return torch.linspace(0.5, 1.5, shape.numel(), dtype=value.dtype, device=value.device).reshape(shape)


def ordinary(config: DynamicsConfig = TINY) -> Particles:
    return make_history((12, 9)[-(2**config.history_bits) :], seed=11, config=config)


def check_step(
    setting: Setting, measured: Measured, hard: Particles, config: DynamicsConfig = TINY, *, prepare=None
) -> Step:
    """The step of ``hard``, a scene, beside an ordinary one: finite, forward and backward, and near float64's.

    The ordinary scene's result and gradients must have the bits that they have alone.
    """
    mate, options = ordinary(config), {"prepare": prepare}
    together, alone = (simulate(setting, h, config, **options) for h in (batch([hard, mate]), mate))
    measured.finite(*together.tensors)
    exact = simulate(EXACT, batch([hard, mate]), config, **options)
    for kind in ("fields", "grads", "parameters"):
        for name, expected in getattr(exact, kind).items():
            bound = f"network_{'' if kind == 'fields' else 'grad_'}{setting.precision}"
            measured.close(getattr(together, kind)[name], expected, bound, f"{kind} {name}")
    for kind in ("fields", "grads"):
        for name, expected in getattr(alone, kind).items():
            both = getattr(together, kind)[name]
            measured.unchanged(
                setting, both[len(both) - len(expected) :], expected, f"{kind} {name} of the other scene"
            )
    n_new, n_old = (len(x.means) for x in (last(hard), hard))
    return Step(
        {name: value[:n_new] for name, value in together.fields.items()},
        {name: value[:n_old] for name, value in together.grads.items()},
        together.parameters,
    )


def last(history: Particles) -> Particles:
    """The newest step of a scene."""
    return history.select_clouds([history.n_clouds - 1])


def check_same_rows(
    setting: Setting, measured: Measured, actual: Step, expected: Step, rows: Tensor, history_rows: Tensor
) -> None:
    """Results of ``rows`` of the newest step and gradients of ``history_rows`` are those of ``expected``."""
    for kind, chosen in (("fields", rows), ("grads", history_rows)):
        for name, value in getattr(expected, kind).items():
            found = getattr(actual, kind)[name]
            measured.unchanged(setting, found[chosen.to(found.device)], value, f"{kind} {name}")
