"""The momentum of what has been simulated: known row by row, of the last step alone, and with gradients."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import DynamicsConfig, last_steps, rollout
from gsim3d.dynamics.momentum import momentum
from gsim3d.dynamics.motion import motion
from gsim3d.types import DYNAMIC, FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH = 0.2
HOW = LENGTH, TINY.grid_size
KEEPING = dataclasses.replace(TINY, motion_length=LENGTH, momentum=True)
VELOCITY, SPIN = (0.03, -0.02, 0.05), (0.0, 0.08, 0.04)


def cross_matrix(w):
    return torch.linalg.cross(torch.tensor(w).expand(3, 3), torch.eye(3)).T


def turning(n_steps, n=200, velocity=VELOCITY, spin=SPIN, seed=0, known=True):
    """A ball of 20 cm that flies and turns, seen in ``n_steps``; its rows keep their static latents where ``known``."""
    g = torch.Generator().manual_seed(seed)
    ball = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1) * 0.2
    history = make_history((n,) * n_steps, seed=seed, frozen_share=0.0)
    steps = [
        1.0 + k * torch.tensor(velocity) + ball @ torch.linalg.matrix_exp(k * cross_matrix(spin)).T
        for k in range(n_steps)
    ]
    static = history.static_latents[:n].repeat(n_steps, 1) if known else history.static_latents
    return dataclasses.replace(history, means=torch.cat(steps), static_latents=static)


def parts_of(history):
    onward = motion(history, *HOW)[:, 1]
    return onward, *momentum(history, onward, *HOW).unbind(1)


def test_simulated_rows_know_their_last_step():
    history = turning(3)
    _, rigid, own = parts_of(history)
    assert_same_bits(own, history.means[400:] - history.means[200:400])
    ahead = turning(4).means[600:] - history.means[400:]
    assert_close_relative_to_max(rigid, ahead, 0.02)


def test_what_is_not_known_is_what_clouds_tell():
    history = turning(3, known=False)
    onward, rigid, own = parts_of(history)
    assert_same_bits(own, onward)
    assert_same_bits(rigid, onward)
    shorter = make_history((60, 50), frozen_share=0.0)
    onward, _, own = parts_of(shorter)
    assert_same_bits(own, onward)
    alone = last_steps(shorter, 1)
    assert not torch.stack(parts_of(alone)).any()


def test_an_impulse_is_part_of_it_at_once():
    """The older steps of the history say something else."""
    flown, stopped = turning(3), turning(4, spin=(0.0, 0.0, 0.0))
    means = torch.cat([flown.means, flown.means[400:] + torch.tensor([0.0, 0.01, 0.0])])
    onward, rigid, own = parts_of(dataclasses.replace(stopped, means=means))
    still = torch.tensor([0.0, 0.01, 0.0]).expand(200, 3)
    assert_close_relative_to_max(own, still, 1e-4)
    assert_close_relative_to_max(rigid, still, 1e-3)
    assert (onward - still).norm(dim=1).mean() > 0.02


def test_what_holds_some_rows_turns_the_body():
    """Friction: rows below stop, those above go on; the body falls forward about them."""
    before = turning(1)
    low = before.means[:, 2] < 0.85
    assert 10 < low.sum() < 60
    step = torch.where(low[:, None], 0.0, torch.tensor([0.04, 0.0, 0.0]))
    history = dataclasses.replace(turning(2), means=torch.cat([before.means, before.means + step]))
    _, rigid, _ = parts_of(history)
    top, bottom = before.means[:, 2] > 1.15, low
    assert rigid[top, 0].mean() > 0.038 and rigid[bottom, 0].mean() < 0.03
    assert_close_relative_to_max(rigid.mean(0), step.mean(0), 0.2)


def test_steps_that_are_missing_count():
    history = turning(3, spin=(0.0, 0.0, 0.0))
    apart = history.with_clouds(dataclasses.replace(history.clouds, steps=(0, 2, 4)))
    assert_close_relative_to_max(parts_of(apart)[2], torch.tensor(VELOCITY).expand(200, 3) / 2, 1e-4)


def test_a_place_that_is_none_spoils_nothing():
    """Neither what others are told nor a gradient."""
    history = turning(2)
    means = history.means.clone()
    means[250], means[30] = torch.nan, torch.inf
    means.requires_grad_()
    dynamics, broken = make_dynamics(KEEPING), dataclasses.replace(history, means=means)
    _, rigid, own = parts_of(broken)
    assert rigid.isfinite().all() and own.isfinite().all()
    others = torch.ones(200, dtype=torch.bool)
    others[[30, 50]] = False
    assert_close_relative_to_max(rigid[others], parts_of(history)[1][others], 0.02)
    step = dynamics(broken).means
    step[others].sum().backward()
    gradients = [means.grad, *(p.grad for p in dynamics.parameters() if p.grad is not None)]
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_scenes_do_not_see_each_other_and_frozen_rows_do_not_move():
    one, other = turning(2), turning(3, n=90, velocity=(0.0, 0.05, 0.0), seed=1)
    frozen = torch.arange(len(other.means)) % 90 < 20
    other = dataclasses.replace(other, activity=torch.where(frozen, FROZEN, DYNAMIC).to(other.activity.dtype))
    both = batch([one, other])
    together = momentum(both, motion(both, *HOW)[:, 1], *HOW)
    alone = [momentum(scene, motion(scene, *HOW)[:, 1], *HOW) for scene in (one, other)]
    assert_close_relative_to_max(together, torch.cat(alone), 1e-4)
    assert not together[200:220].any() and together[220:].any()


@pytest.mark.parametrize("n", [40, 1500])
def test_gradients_of_the_step_before(n):
    """Of its places only: those of the newest step also say where the windows are, which is a constant. Of 1,500 rows
    1,024 are looked at."""
    history = turning(2, n=n)
    history = dataclasses.replace(history, means=history.means.double())
    onward = torch.zeros(n, 3, dtype=torch.float64)

    def of_older(older):
        return momentum(dataclasses.replace(history, means=torch.cat([older, history.means[n:]])), onward, *HOW)

    older = history.means[:n].clone().requires_grad_()
    assert torch.autograd.gradcheck(of_older, (older,), atol=1e-6, fast_mode=n > 100)


def test_an_impulse_is_blamed_for_all_that_follows():
    dynamics = make_dynamics(dataclasses.replace(KEEPING, zero_init=True))
    history = turning(2, n=60)
    means = history.means.clone().requires_grad_()
    end = rollout(dynamics, dataclasses.replace(history, means=means), 4, max_steps=2)[-1]
    end.means[:, 0].sum().backward()
    older, newer = means.grad[:60, 0].sum(), means.grad[60:, 0].sum()
    assert abs(float(older) + 4 * 60) < 12 and abs(float(newer) - 5 * 60) < 12


def test_untrained_a_body_flies_and_turns_on():
    dynamics = make_dynamics(dataclasses.replace(KEEPING, zero_init=True))
    end = rollout(dynamics, turning(2), 6, max_steps=2)[-1]
    assert_close_relative_to_max(end.means - 1, turning(8).means[1400:] - 1, 0.03)


def test_a_body_that_nothing_stops_does_not_stop_turning():
    dynamics = make_dynamics(dataclasses.replace(KEEPING, zero_init=True))
    steps = rollout(dynamics, turning(2, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.03, 0.0)), 20, max_steps=2)
    before, after = (step.means - step.means.mean(0) for step in steps[-2:])
    turned = torch.linalg.cross(before, after).mean(0)[1] / before[:, [0, 2]].square().sum(1).mean()
    assert 0.97 < turned / 0.03 < 1.03


@pytest.mark.parametrize("columns", [slice(-3, None), slice(-9, -3)])
def test_shares_of_all_three_motions_are_kept(columns):
    dynamics = make_dynamics(dataclasses.replace(KEEPING, zero_init=True))
    history, newest = turning(3), last_steps(turning(3), 1)
    onward, rigid, own = parts_of(history)
    last = motion(history, *HOW)[:, 0]
    dynamics.net.head.fc2.bias.detach()[columns] = 2 * torch.tensor(-0.2).atanh()
    kept = rigid - 0.4 * own if columns.stop is None else 0.6 * rigid - 0.4 * last
    assert_close_relative_to_max(dynamics(history).means - newest.means, kept, 1e-3)


def test_the_network_reads_it():
    dynamics, history = make_dynamics(KEEPING), turning(2)
    step = dynamics(history)
    with torch.no_grad():
        dynamics.net.stem.told.weight[:, :3] = 0
    assert (dynamics(history).means - step.means).abs().max() > 1e-5


def test_a_gpu_finds_the_same(devices):
    history = batch([turning(2), turning(3, n=90, seed=1)])
    onward = motion(history, *HOW)[:, 1]
    expected, actual = (momentum(history.to(device), onward.to(device), *HOW).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(momentum(history.to(devices[1]), onward.to(devices[1]), *HOW).cpu(), actual)


def test_compiled_it_is_the_same(device):
    history = turning(2, n=50).to(device)
    history.clouds
    onward = motion(history, *HOW)[:, 1]
    compiled = torch.compile(momentum, fullgraph=True)
    assert_close_relative_to_max(compiled(history, onward, *HOW), momentum(history, onward, *HOW), 1e-4)


@pytest.mark.parametrize("change", [{"motion_length": None}, {"static_latents": 0, "dynamic_latents": 64}])
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match="momentum"):
        DynamicsConfig(**{"motion_length": LENGTH, "momentum": True, **change})
