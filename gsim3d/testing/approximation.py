"""Approximation error of an asymmetric background, and of sleep, against computing everything.

compare_backgrounds(simulator, state, 12, cameras)   # an asymmetric model and its weights in a symmetric one
compare_sleep(simulator, state, 12, plan, cameras)   # a plan with sleep and one without
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.dynamics import RestLog, last_steps
from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError
from gsim3d.simulator import Simulator
from gsim3d.state import FROZEN, Particles


@dataclass(frozen=True)
class SleepError:
    """The error of sleep, one number per step.

    Attributes:
        moved: metres, the largest distance between the two positions of a particle.
        psnr: dB between their images, inf where equal.
        log: particles that rested.
    """

    moved: tuple[float, ...]
    psnr: tuple[float, ...]
    log: RestLog


@dataclass(frozen=True)
class BackgroundError:
    """The error of an asymmetric background, one number per step.

    Attributes:
        moved: metres, mean distance between the two positions of a moving particle.
        psnr: dB between their images.
        shadow: mean change of a latent of the background in the symmetric model, such as by a shadow; in the asymmetric
            one it does not change.
        shadow_psnr: dB between images of the symmetric model with and without these changes.
    """

    moved: tuple[float, ...]
    psnr: tuple[float, ...]
    shadow: tuple[float, ...]
    shadow_psnr: tuple[float, ...]


@torch.no_grad()
def compare_sleep(
    simulator: Simulator, state: Particles, n_steps: int, plan: Plan, cameras: Cameras | None = None
) -> SleepError:
    """The error of sleep in a rollout of ``n_steps``.

    Args:
        plan: with sleep.
        cameras: as in :meth:`Simulator.render` of a step; None: no images are compared.
    """
    if plan.spec.dynamics.sleep is None:
        raise InputError("compare_sleep: plan must be one with dynamics.sleep")
    awake = dataclasses.replace(plan.spec, dynamics=dataclasses.replace(plan.spec.dynamics, sleep=None))
    log = RestLog()
    steps = simulator.rollout(state, n_steps, plan, log=log)
    others = simulator.rollout(state, n_steps, simulator.plan(awake))
    pairs = list(zip(steps, others, strict=True))
    moved = tuple(_distances(a, b).max().item() if a.n_rows else 0.0 for a, b in pairs)
    psnr = () if cameras is None else tuple(_psnr(simulator, a, b, cameras) for a, b in pairs)
    return SleepError(moved, psnr, log)


@torch.no_grad()
def compare_backgrounds(
    simulator: Simulator, state: Particles, n_steps: int, cameras: Cameras, plan: Plan | None = None
) -> BackgroundError:
    """The error of an asymmetric background in a rollout of ``n_steps``.

    Args:
        simulator: of an asymmetric model.
        cameras: as in :meth:`Simulator.render` of a step.
    """
    config = simulator.config
    if not config.dynamics.is_asymmetric:
        raise InputError('compare_backgrounds: the model must have background="asymmetric"')
    dynamics = dataclasses.replace(config.dynamics, background="symmetric")
    twin = type(simulator)(dataclasses.replace(config, dynamics=dynamics)).to(state.means).eval()
    twin.load_state_dict(simulator.state_dict())
    newest = last_steps(simulator._prepare(state, plan or simulator.plan()), 1)
    frozen = newest.activity == FROZEN
    steps, others = (model.rollout(state, n_steps, plan) for model in (simulator, twin))
    columns = []
    for one, other in zip(steps, others, strict=True):
        held = torch.where(frozen[:, None], newest.dynamic_latents, other.dynamic_latents)
        changes = (other.dynamic_latents - held)[frozen].abs()
        columns.append((
            _mean(_distances(one, other)[~frozen]),
            _psnr(simulator, one, other, cameras),
            _mean(changes),
            _psnr(simulator, dataclasses.replace(other, dynamic_latents=held), other, cameras),
        ))  # fmt: skip
    return BackgroundError(*zip(*columns, strict=True))


def _mean(x: Tensor) -> float:
    return x.double().mean().item() if x.numel() else 0.0


def _distances(one: Particles, other: Particles) -> Tensor:
    return (one.means - other.means).norm(dim=1)


def _psnr(simulator: Simulator, one: Particles, other: Particles, cameras: Cameras) -> float:
    images = [simulator.render(particles, cameras).color for particles in (one, other)]
    wrong = (images[0] - images[1]).square().mean().item()
    return math.inf if wrong == 0 else -10 * math.log10(wrong)
