"""Approximation errors of sleep and of an asymmetric background, including lost shadows."""

import math

import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep
from gsim3d.errors import InputError
from tests.dynamics.scenes import TINY, make_history
from tests.effects.approximation import compare_backgrounds, compare_sleep
from tests.effects.resting import make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = 24


def camera():
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([-0.5, -0.5, 1.0])
    K = torch.tensor([[24.0, 0.0, 12.0], [0.0, 24.0, 12.0], [0.0, 0.0, 1.0]])
    return Cameras(
        pose[None], K[None], torch.tensor([0.1]), torch.tensor([4.0]), torch.zeros(1, dtype=torch.int64), SIZE, SIZE
    )


def asleep(**options):
    return EffectsSpec(dynamics=DynamicsEffects(sleep=Sleep(**options)))


def test_sleep_error_of_slept_steps():
    simulator, state = make_simulator(), make_history((50, 60), frozen_share=0.3)
    error = compare_sleep(simulator, state, 7, simulator.plan(asleep(eps=1e6)), camera())
    assert error.log.moving[4:] == [0] * 3
    assert error.moved[:4] == (0.0,) * 4 and error.psnr[:4] == (math.inf,) * 4
    assert 0 < error.moved[4] and all(math.isfinite(p) for p in error.psnr[4:])
    awake = simulator.rollout(state, 7)
    expected = (awake[6].means - awake[3].means).norm(dim=1).max().item()
    assert error.moved[6] == pytest.approx(expected, rel=1e-6)


def test_sleep_error_without_sleep_is_zero():
    simulator, state = make_simulator(), make_history((50, 60), frozen_share=0.3)
    error = compare_sleep(simulator, state, 5, simulator.plan(asleep(eps=0.0)), camera())
    assert error.moved == (0.0,) * 5 and error.psnr == (math.inf,) * 5 and error.log.resting_share > 0


def test_background_error_against_symmetric_weights():
    simulator, state = make_simulator(), make_history((50, 60), frozen_share=0.6)
    error = compare_backgrounds(simulator, state, 3, camera())
    twin = make_simulator(TINY)
    steps, others = simulator.rollout(state, 3), twin.rollout(state, 3)
    frozen = state.activity[50:] == 1
    moved = (steps[2].means - others[2].means)[~frozen].norm(dim=1).mean().item()
    change = (others[2].dynamic_latents - state.dynamic_latents[50:])[frozen].abs().mean().item()
    assert error.moved[2] == pytest.approx(moved, rel=1e-6) and error.shadow[2] == pytest.approx(change, rel=1e-6)
    assert all(math.isfinite(p) for p in (*error.psnr, *error.shadow_psnr))


def test_background_error_without_background_is_zero():
    simulator, state = make_simulator(), make_history((50, 60), frozen_share=0.0)
    error = compare_backgrounds(simulator, state, 2, camera())
    assert error.moved == error.shadow == (0.0, 0.0) and error.psnr == error.shadow_psnr == (math.inf, math.inf)


def test_comparison_refuses_unsuitable_models():
    simulator, state = make_simulator(TINY), make_history((50, 60))
    with pytest.raises(InputError, match="background"):
        compare_backgrounds(simulator, state, 2, camera())
    with pytest.raises(InputError, match="sleep"):
        compare_sleep(simulator, state, 2, simulator.plan())
