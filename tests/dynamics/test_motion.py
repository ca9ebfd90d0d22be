"""How matter has moved, read off clouds whose rows do not correspond, and a dynamics that lets it fly on."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import DynamicsConfig, last_steps
from gsim3d.dynamics.motion import motion
from gsim3d.dynamics.parts import Parts
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import EXPLICIT, TINY, batch, float_fields, make_dynamics, make_history, permute_rows

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH = 0.2
HOW = LENGTH, TINY.grid_size
MOVING = dataclasses.replace(TINY, motion_length=LENGTH)


def flying(velocities, n=300, n_steps=4, apart=1.5, seed=0, spin=(0.0, 0.0, 0.0)):
    """Balls of 20 cm, each with its velocity in metres a step, painted; their rows change places from step to step."""
    g = torch.Generator().manual_seed(seed)
    history = make_history((n * len(velocities),) * n_steps, frozen_share=0.0)
    ball = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1) * 0.2
    paint = torch.sin(20 * ball @ torch.randn(3, TINY.dynamic_latents, generator=g))
    steps, latents = [], []
    for step in range(n_steps):
        order = torch.randperm(n, generator=g)
        turned = ball[order] @ torch.linalg.matrix_exp(step * cross_matrix(spin)).T
        for place, velocity in enumerate(velocities):
            centre = torch.tensor([1 + apart * place, 1.0, 1.0]) + step * torch.tensor(velocity)
            steps.append(centre + turned)
            latents.append(paint[order])
    static = torch.zeros_like(history.static_latents)
    return dataclasses.replace(
        history, means=torch.cat(steps), dynamic_latents=torch.cat(latents), static_latents=static
    )


def cross_matrix(w):
    return torch.linalg.cross(torch.tensor(w).expand(3, 3), torch.eye(3)).T


def test_a_body_has_its_velocity_everywhere():
    velocity = torch.tensor([0.03, -0.02, 0.05])
    found = motion(flying([velocity.tolist()]), *HOW)
    assert_close_relative_to_max(found, velocity.expand(300, 2, 3), 1e-3)


def test_two_bodies_have_their_own():
    velocities = torch.tensor([[0.03, 0.0, -0.05], [-0.03, 0.01, 0.05]])
    found = motion(flying(velocities.tolist()), *HOW)
    for body, velocity in enumerate(velocities):
        error = found[300 * body : 300 * (body + 1)] - velocity
        assert error.norm(dim=2).mean() < 0.05 * velocity.norm()


@pytest.mark.parametrize("n", [300, 3000])
@pytest.mark.parametrize("spin", [(0.0, 0.0, 0.05), (0.04, -0.03, 0.02)])
def test_a_body_turns_on(spin, n):
    velocity, history = (0.03, -0.02, 0.05), flying([(0.03, -0.02, 0.05)], n, spin=spin)
    found = motion(history, *HOW)
    smooth, onward = found.unbind(1)
    assert (smooth - torch.tensor(velocity)).norm(dim=1).max() < (0.04 if n < 1000 else 0.4) * torch.tensor(spin).norm()
    newest = last_steps(history, 1).means
    radius = newest - newest.mean(0)
    turned = radius @ torch.linalg.matrix_exp(cross_matrix(spin)).T - radius
    assert turned.norm(dim=1).max() > 0.007
    assert (onward - torch.tensor(velocity) - turned).norm(dim=1).max() < 0.15 * turned.norm(dim=1).max()
    longer = (radius + onward - onward.mean(0)).norm(dim=1) / radius.norm(dim=1)
    assert (longer - 1).abs().max() < 4e-3  # else a body would grow as it turns


def test_far_from_the_origin_it_is_the_same():
    history = flying([(0.03, -0.02, 0.05)], spin=(0.0, 0.0, 0.05))
    far = dataclasses.replace(history, means=history.means + torch.tensor([2000.0, 1000.0, 0.0]))
    assert_close_relative_to_max(motion(far, *HOW), motion(history, *HOW), 0.03)


def test_what_looks_the_same_everywhere_does_not_turn():
    history = flying([(0.03, -0.02, 0.05)], spin=(0.0, 0.0, 0.05))
    plain = dataclasses.replace(history, dynamic_latents=torch.zeros_like(history.dynamic_latents))
    found = motion(plain, *HOW)
    assert_close_relative_to_max(found, torch.tensor((0.03, -0.02, 0.05)).expand(300, 2, 3), 0.1)


def test_the_last_step_and_the_whole_history_are_told_apart():
    history = flying([[0.0, 0.0, 0.0]])
    means = history.means.clone()
    means[-300:, 2] -= 0.06
    found = motion(dataclasses.replace(history, means=means), *HOW)
    assert_close_relative_to_max(found[:, 0, 2], torch.full((300,), -0.06), 3e-3)
    assert_close_relative_to_max(found[:, 1, 2], torch.full((300,), -0.02), 3e-3)


def test_gaps_between_steps_count():
    history = flying([[0.02, 0.0, 0.0]], n_steps=3)
    spread = dataclasses.replace(history, cloud_step=torch.tensor([0, 2, 4]))
    assert_close_relative_to_max(motion(spread, *HOW), motion(history, *HOW) / 2, 1e-6)


@pytest.mark.parametrize("activity", [FROZEN, ASLEEP])
def test_what_cannot_move_has_no_velocity_and_changes_nobody_elses(activity):
    history = flying([[0.03, 0.0, 0.0]])
    rests = torch.arange(history.n_rows) % 3 == 0
    still = dataclasses.replace(history, activity=torch.where(rests, activity, DYNAMIC).to(torch.uint8))
    found, newest = motion(still, *HOW), rests[-300:]
    assert not found[newest].any()
    elsewhere = dataclasses.replace(still, means=torch.where(rests[:, None], torch.nan, still.means))
    assert_same_bits(motion(elsewhere, *HOW), found)
    assert found[~newest].any()


@pytest.mark.parametrize("n_rows", [(50,), (0, 50), (50, 0), (0,), (1, 1), (0, 0)])
def test_without_matter_before_or_now_nothing_has_moved(n_rows):
    found = motion(make_history(n_rows, frozen_share=0.0), *HOW)
    assert found.shape == (n_rows[-1], 2, 3) and found.isfinite().all()
    assert n_rows == (1, 1) or not found.any()


def test_the_order_of_rows_does_not_matter():
    history = flying([[0.03, 0.0, 0.0], [0.0, 0.02, 0.0]])
    shuffled, order = permute_rows(history)
    newest = order[-600:] - (history.n_rows - 600)
    assert_close_relative_to_max(motion(shuffled, *HOW), motion(history, *HOW)[newest], 1e-4)


def test_scenes_do_not_see_each_other():
    histories = [flying([[0.03, 0.0, 0.0]]), make_history((7, 5)), flying([[0.0, 0.0, 0.05]], n=40)]
    together = motion(batch(histories), *HOW)
    begin = 0
    for history in histories:
        alone = motion(history, *HOW)
        assert_close_relative_to_max(together[begin : begin + len(alone)], alone, 1e-5)
        begin += len(alone)


def test_a_gpu_finds_the_same(devices):
    history = batch([flying([[0.03, 0.0, 0.0], [0.0, 0.02, 0.0]]), make_history((30, 40))])
    expected, actual = (motion(history.to(device), *HOW).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(motion(history.to(devices[1]), *HOW).cpu(), actual)


def test_compiled_it_is_the_same(device):
    history = flying([[0.03, 0.0, 0.0]], n=50).to(device)
    history.clouds
    compiled = torch.compile(motion, fullgraph=True)
    assert_close_relative_to_max(compiled(history, *HOW), motion(history, *HOW), 1e-4)


@pytest.mark.parametrize("predicts", ["from_newest", "from_previous"])
@pytest.mark.parametrize("steps_per_call", [1, 3])
def test_untrained_a_body_flies_on(predicts, steps_per_call):
    config = dataclasses.replace(MOVING, zero_init=True, predicts=predicts, steps_per_call=steps_per_call)
    history = flying([[0.03, 0.0, -0.05]])
    steps, newest = make_dynamics(config)(history), last_steps(history, 1)
    for i in range(steps_per_call):
        ahead = (1 + i) * torch.tensor([0.03, 0.0, -0.05])
        assert_close_relative_to_max(steps.means[300 * i : 300 * (i + 1)] - newest.means, ahead.expand(300, 3), 1e-3)


@pytest.mark.parametrize("steps_per_call", [1, 2])
@pytest.mark.parametrize("config", [MOVING, dataclasses.replace(EXPLICIT, motion_length=LENGTH)])
def test_of_each_motion_a_share_is_kept(config, steps_per_call):
    """A body that slides to rest, flies on and bounces, and takes some of what it did last."""
    config = dataclasses.replace(config, zero_init=True, steps_per_call=steps_per_call)
    dynamics, history = make_dynamics(config), make_history((80, 80), config=config, frozen_share=0.0)
    flown = torch.tensor([0.03, 0.02, -0.05]) * history.row_cloud()[:, None]
    history = dataclasses.replace(history, means=history.means + flown)
    names, widths = zip(*dynamics.layout.outputs, strict=True)
    bias = dynamics.net.head.fc2.bias.detach().unflatten(0, (steps_per_call, -1))
    shares = torch.tensor([[0.2, 0.0, 0.5], [-1.0, 0.0, -1.6]])
    bias.split(widths, 1)[names.index("means")][:, 3:] = 2 * (shares / 2).atanh().flatten()
    last, onward = motion(history, *HOW).unbind(1)
    kept = shares[0] * last + (1 + shares[1]) * onward
    steps, newest = dynamics(history).means.unflatten(0, (steps_per_call, -1)), last_steps(history, 1).means
    for i, step in enumerate(steps):
        assert_close_relative_to_max(step - newest, (1 + i) * kept, 1e-4)


def test_frozen_particles_stay_where_they_are():
    history = make_history((30, 40), config=MOVING)
    step, newest = make_dynamics(MOVING)(history), last_steps(history, 1)
    frozen = newest.activity == FROZEN
    assert frozen.any() and not torch.equal(step.means[~frozen], newest.means[~frozen])
    assert_same_bits(step.means[frozen], newest.means[frozen])


@pytest.mark.parametrize("config", [MOVING, dataclasses.replace(EXPLICIT, motion_length=LENGTH)])
def test_the_network_sees_the_velocity(config):
    """Without the columns that read it the next step is another one."""
    dynamics, history = make_dynamics(config), make_history((60, 50), config=config, frozen_share=0.0)
    step = dynamics(history)
    with torch.no_grad():
        dynamics.net.stem.conv.weight[..., -6:] = 0
    assert (dynamics(history).means - step.means).abs().max() > 1e-5


@pytest.mark.parametrize("predicts", ["from_newest", "from_previous"])
def test_no_step_is_longer_than_the_limit(predicts):
    config = dataclasses.replace(MOVING, zero_init=True, max_step=0.04, steps_per_call=2, predicts=predicts)
    history = flying([[0.03, 0.0, -0.05]])
    steps, newest = make_dynamics(config)(history), last_steps(history, 1)
    for i in range(2):
        ahead = (1 + i) * torch.tensor([0.03, 0.0, -0.04])
        assert_close_relative_to_max(steps.means[300 * i : 300 * (i + 1)] - newest.means, ahead.expand(300, 3), 1e-3)


def test_beside_a_background_that_is_computed_once_it_is_the_same():
    dynamics = make_dynamics(dataclasses.replace(MOVING, background="asymmetric"))
    history = batch([make_history((40, 50), config=MOVING), make_history((30, 20, 25), seed=1, config=MOVING)])
    parts = Parts.of(history, asymmetric=True)
    moving = dynamics(parts.moving, background=dynamics.remember(parts.background))
    whole = dynamics(history)
    assert_same_bits(whole.means[parts.rows], moving.means)
    rests = last_steps(history, 1).activity == FROZEN
    assert rests.any() and not rests.all()
    assert_same_bits(whole.means[rests], last_steps(history, 1).means[rests])


def test_gradients_reach_weights_and_features_but_no_velocity():
    dynamics, history = make_dynamics(MOVING), make_history((30, 40), frozen_share=0.0)
    leaves = {name: value.clone().requires_grad_() for name, value in float_fields(history).items()}
    dynamics(dataclasses.replace(history, **leaves)).means.sum().backward()
    assert dynamics.net.stem.conv.weight.grad[..., -6:].any()
    assert leaves["dynamic_latents"].grad.any()
    assert_close_relative_to_max(leaves["means"].grad[30:].sum(0), torch.full((3,), 40.0), 0.5)


@pytest.mark.parametrize("change", [{"motion_length": 0.0}, {"predicts": "absolute"}])
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match="motion_length"):
        DynamicsConfig(**{"motion_length": LENGTH, **change})
