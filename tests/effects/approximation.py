"""Approximation errors of sleep and of an asymmetric background.

compare_sleep(simulator, state, 12, plan, cameras)   # a plan with sleep against the same plan without
compare_backgrounds(simulator, state, 12, cameras)   # an asymmetric model against a symmetric one with its weights
"""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.dynamics import RestLog
from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError
from gsim3d.simulator import Simulator
from gsim3d.state import FROZEN, Particles, last_steps


@dataclass(frozen=True)
class SleepError:
    """Error of sleep at each step."""

    moved: tuple[float, ...]  #: largest distance of a particle from the rollout without sleep, in metres
    psnr: tuple[float, ...]  #: PSNR between the images in dB, inf if equal
    log: RestLog  #: counts of computed particles


@dataclass(frozen=True)
class BackgroundError:
    """Error of an asymmetric background at each step."""

    moved: tuple[float, ...]  #: mean distance of moving particles between the two models, in metres
    psnr: tuple[float, ...]  #: PSNR between the images in dB
    #: mean absolute change of the background's latents in the symmetric model, for example by shadows; 0 in the
    #: asymmetric model
    shadow: tuple[float, ...]
    shadow_psnr: tuple[float, ...]  #: PSNR in dB between images of the symmetric model with and without these changes


@torch.no_grad()
def compare_sleep(
    simulator: Simulator, state: Particles, n_steps: int, plan: Plan, cameras: Cameras | None = None
) -> SleepError:
    """Compares a rollout with sleep to one without.

    Args:
        simulator: simulator to test.
        state: initial state.
        n_steps: steps of the rollout.
        plan: plan with sleep.
        cameras: cameras of the compared images; None: no images.
    """
    if plan.spec.dynamics.sleep is None:
        raise InputError("compare_sleep: the plan must have dynamics.sleep")
    awake = dataclasses.replace(plan.spec, dynamics=dataclasses.replace(plan.spec.dynamics, sleep=None))
    log = RestLog()
    steps = simulator.rollout(state, n_steps, plan, log=log)
    others = simulator.rollout(state, n_steps, simulator.plan(awake))
    pairs = list(zip(steps, others, strict=True))
    moved = tuple(_distances(a, b).max().item() if a.n_rows else 0.0 for a, b in pairs)
    psnr = () if cameras is None else tuple(_psnr(simulator, a, b, cameras) for a, b in pairs)
    return SleepError(moved, psnr, log)


@torch.no_grad()
def compare_backgrounds(simulator: Simulator, state: Particles, n_steps: int, cameras: Cameras) -> BackgroundError:
    """Compares a rollout of an asymmetric model to one of a symmetric model with the same weights.

    Args:
        simulator: simulator with an asymmetric background.
        state: initial state.
        n_steps: steps of the rollout.
        cameras: cameras of the compared images.
    """
    config = simulator.config
    if not config.dynamics.is_asymmetric:
        raise InputError('compare_backgrounds: the model must have background="asymmetric"')
    dynamics = dataclasses.replace(config.dynamics, background="symmetric")
    twin = type(simulator)(dataclasses.replace(config, dynamics=dynamics)).to(state.means).eval()
    twin.load_state_dict(simulator.state_dict())
    newest = last_steps(simulator._prepare(state, simulator.plan()), 1)
    frozen = newest.activity == FROZEN
    steps, others = (model.rollout(state, n_steps) for model in (simulator, twin))
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
