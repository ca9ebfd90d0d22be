"""Velocities of encoded clouds, and their gains."""

import dataclasses

import pytest
import torch

from gsim3d.priors import Motion, VelocityConfig, VelocityFromImagesConfig, padding
from gsim3d.priors.velocity import slope_weights, window_velocities
from gsim3d.state import DYNAMIC, FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history
from tests.priors.scenes import context, with_priors

pytestmark = pytest.mark.usefixtures("one_thread")
CELL, RADIUS, FRAMES = 0.02, 0.3, object()
PLAIN = dataclasses.replace(TINY, position_features=False)
MOVING = with_priors(PLAIN, VelocityConfig())


def flown(counts=(300, 340, 280, 310), velocity=(0.004, -0.003, 0.001), seed=0, noise=0.0, steps=None):
    """Clouds of a body that moves by ``velocity`` a step; each shows other points of it."""
    history, g = make_history(counts, seed=seed, frozen_share=0.0), torch.Generator().manual_seed(seed)
    steps = history.clouds.steps if steps is None else steps
    clouds = [
        1.0 + 0.2 * _even(n, g) + step * torch.tensor(velocity) + noise * torch.randn(3, generator=g)
        for n, step in zip(counts, steps, strict=True)
    ]
    clouds = torch.cat(clouds) + history.origin[0].float()
    return dataclasses.replace(history, means=clouds, activity=torch.full_like(history.activity, DYNAMIC))


def _even(n, g):
    """``n`` points of a ball with mean 0."""
    points = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    return points - points.mean(0)


def of(history, radius=RADIUS):
    """Mean velocities."""
    return both_of(history, radius)[1]


def both_of(history, radius=RADIUS):
    return window_velocities(context(history, grid_size=CELL), radius)


def moving(value=0.004, **options):
    """A history whose particles have a velocity."""
    history = make_history(**options)
    velocities = {name: torch.full_like(history.means, value) for name in ("velocity", "mean_velocity")}
    return dataclasses.replace(history, **velocities)


def newest(history):
    return history.means[history.cu_rows[-2] :]


def test_slope_of_a_line():
    weights, divisor = slope_weights([3, 2, 1])
    assert (weights, divisor) == ([6, 2, -2], 20)
    assert sum(w * 0.7 * age for w, age in zip(weights, [3, 2, 1])) / divisor == pytest.approx(0.7)
    assert slope_weights([]) == ([], 1)
    weights, divisor = slope_weights([5, 1])
    assert sum(w * age for w, age in zip(weights, [5, 1])) / divisor == pytest.approx(1)


def test_velocity_of_clouds_below_a_cell():
    history = flown()
    found = of(history, radius=10.0)  # a window that holds all of the body: the clouds show different points
    assert (found - torch.tensor([0.004, -0.003, 0.001])).abs().max() < 1e-5


def test_windows_follow_bodies_apart():
    left, right = flown(velocity=(0.0, 0.01, 0.0)), flown(velocity=(0.0, -0.01, 0.0), seed=1)
    n = [end - begin for begin, end in zip(left.cu_rows[:-1].tolist(), left.cu_rows[1:].tolist())]
    parts = [[part for cloud in zip(left.means.split(n), right.means.split(n)) for part in cloud]]
    wide = make_history(tuple(2 * k for k in n), frozen_share=0.0)
    means = torch.cat(
        [part + (0.0 if i % 2 == 0 else 3.0) * torch.tensor([1.0, 0, 0]) for i, part in enumerate(parts[0])]
    )
    found = of(dataclasses.replace(wide, means=means, activity=torch.full_like(wide.activity, DYNAMIC)))
    assert (found[: n[-1]] - torch.tensor([0.0, 0.01, 0.0])).abs().max() < 2e-3
    assert (found[n[-1] :] + torch.tensor([0.0, 0.01, 0.0])).abs().max() < 2e-3


def test_slope_is_less_noisy_than_the_last_displacement():
    errors, true = [], torch.tensor([0.004, -0.003, 0.001])
    for seed in range(20):
        history = flown(seed=seed, noise=0.001)
        last, mean = both_of(history, radius=10.0)
        means = [part.mean(0) for part in history.means.split([300, 340, 280, 310])]
        assert torch.allclose(last, means[3] - means[2], atol=1e-5)
        errors.append(torch.stack([mean[0] - true, last[0] - true]).norm(dim=1))
    slope, difference = torch.stack(errors).square().mean(0).sqrt()
    assert slope < 0.5 * difference


def test_order_of_rows_of_dense_clouds_does_not_matter(monkeypatch):
    """More particles than samples, that move by ``v``, in another order of rows in each cloud."""
    v, g = torch.tensor([0.004, -0.003, 0.001]), torch.Generator().manual_seed(0)
    points = 1.0 + 0.2 * _even(2500, g)
    clouds = [points[torch.randperm(2500, generator=g)] + step * v for step in range(4)]
    history = dataclasses.replace(flown((2500,) * 4), means=torch.cat(clouds))
    errors = lambda: [(found - v).norm(dim=1).max() for found in both_of(history)]  # noqa: E731
    assert max(errors()) < 1e-5
    monkeypatch.setattr(padding, "DYNAMIC", FROZEN)  # all are sampled in the order of rows
    assert min(errors()) > 1e-3


def test_ages_of_clouds_count():
    """Clouds of steps 0, 2 and 3: the last displacement is that of one step, the line is that of time."""
    history = flown((200, 210, 220))
    history = dataclasses.replace(history, cloud_step=torch.tensor([0, 2, 3]))
    parts, v = history.means.split([200, 210, 220]), torch.tensor([0.004, -0.003, 0.001])
    history = dataclasses.replace(history, means=torch.cat([parts[0], parts[1] + v, parts[2] + v]))
    last, mean = both_of(history, radius=10.0)
    assert (last - v).abs().max() < 1e-5 and (mean - v).abs().max() < 1e-5
    early = history.select_clouds(torch.tensor([0, 1]))
    last, mean = both_of(early, radius=10.0)
    assert (last - v).abs().max() < 1e-5 and (mean - v).abs().max() < 1e-5


@pytest.mark.parametrize("counts", [(0, 0, 0, 200), (200,), (0, 200, 0, 210), (200, 190, 0, 0)])
def test_missing_clouds(counts):
    for found in both_of(flown(counts)):
        assert found.isfinite().all() and found.shape == (counts[-1], 3)
        if sum(n > 0 for n in counts) < 2:
            assert not found.any()


def test_frozen_particles_and_older_clouds_have_none():
    history = flown()
    activity = history.activity.clone()
    activity[-50:] = FROZEN
    history = dataclasses.replace(history, activity=activity)
    ctx = context(history, VelocityConfig(), grid_size=CELL)
    prior = ctx.priors.get("velocity")
    begun = prior.initialize(ctx.history, ctx, FRAMES)
    for velocity in (begun.velocity, begun.mean_velocity):
        assert not velocity[-50:].any() and velocity[-310:-50].any(1).all() and not velocity[:-310].any()
    assert prior.initialize(ctx.history, ctx) is ctx.history  # edits keep velocities


def test_velocities_of_images_are_the_mean():
    history = flown()
    found = torch.rand(history.means.shape, generator=torch.Generator().manual_seed(0))
    history = dataclasses.replace(history, velocity=found)
    ctx = context(history, VelocityFromImagesConfig(), VelocityConfig(), grid_size=CELL)
    begun = ctx.priors.get("velocity").initialize(ctx.history, ctx, FRAMES)
    assert begun.mean_velocity is found
    assert_same_bits(ctx.select_newest(begun.velocity), both_of(history)[0])


def test_scenes_are_independent():
    one, other = flown(), flown((200, 220), velocity=(0.0, 0.02, 0.0), seed=3)
    both = of(batch([one, other]))
    assert_close_relative_to_max(both[:310], of(one), 1e-5)
    assert_close_relative_to_max(both[310:], of(other), 1e-5)


def test_motions_below_a_cell_are_carried_on():
    slow, fast, plain, carrying = moving(0.004), moving(0.006), make_dynamics(PLAIN), make_dynamics(MOVING)
    assert_same_bits(plain(fast).means, plain(slow).means)
    carried = 0.002 * (plain(fast).activity == DYNAMIC)[:, None].expand(-1, 3)
    assert_close_relative_to_max(carrying(fast).means - carrying(slow).means, carried, 1e-4)


def test_gains_carry_velocities_on():
    history = moving(0.004, frozen_share=0.0)
    ctx = context(history, VelocityConfig(), grid_size=CELL)
    prior, n = ctx.priors.get("velocity"), len(newest(history))
    gains = 2 * torch.atanh(torch.tensor([0.5, 0.0, -0.25, 0.25, 0.5, 0.0])).expand(n, 6)
    motion = prior.move(Motion.of_network(torch.zeros(n, 3)), gains, ctx)
    assert_close_relative_to_max(motion.total(), torch.tensor([0.010, 0.008, 0.002]).expand(n, 3), 1e-5)


def test_a_step_holds_its_displacement_and_halves_the_old_mean():
    history = moving(0.004)
    step = make_dynamics(MOVING)(history)
    moved = step.means - newest(history)
    assert moved.abs().max() > 0
    assert_same_bits(step.velocity, moved)
    assert_close_relative_to_max(step.mean_velocity, (moved + 0.004) / 2, 1e-6)


def test_velocity_of_a_steady_fall_does_not_jump_at_the_first_step():
    """Encoded and simulated velocities of a body in free fall lag behind by the same 1.5 steps."""
    fall = torch.tensor([0.0, 0.0, -0.0056])
    at = [fall * step**2 / 2 for step in range(12)]
    slopes = [sum((k - 1.5) * at[t - 3 + k] for k in range(4)) / 5 for t in range(3, 12)]
    smoothed = [slopes[0]]
    for t in range(4, 12):
        smoothed.append((smoothed[-1] + at[t] - at[t - 1]) / 2)
    assert torch.allclose(torch.stack(smoothed), torch.stack(slopes), atol=1e-7)


def test_gradients_flow_through_displacements_only():
    dynamics, history = make_dynamics(MOVING), moving()
    torch.nn.init.constant_(dynamics.priors.get("velocity").gain_head.bias, 0.5)
    for parameter in dynamics.net.head.parameters():
        torch.nn.init.zeros_(parameter)  # else some displacements are at their limit
    start = dynamics(history)
    velocity, mean = (value.detach().requires_grad_() for value in (start.velocity, start.mean_velocity))
    later = dynamics(dynamics(dataclasses.replace(start, velocity=velocity, mean_velocity=mean)))
    gradients = torch.autograd.grad(later.means.sum(), [velocity, mean])
    gain = 2 * torch.tanh(torch.tensor(0.25))
    moves = (start.activity == DYNAMIC)[:, None].expand(-1, 3)
    # The first step adds g v_1 + h v_2 = d, the second g d + h (v_2 + d) / 2.
    carried = 1 + gain
    for gradient, own, more in zip(gradients, (gain, carried), (0, carried / 2), strict=True):
        wanted = own + (gain + carried / 2) * own + more
        assert_close_relative_to_max(gradient[moves], wanted.expand(int(moves.sum())), 1e-5)
        assert not gradient[~moves].any()
    history = flown()
    assert not of(dataclasses.replace(history, means=history.means.requires_grad_())).requires_grad


def test_on_gpu(devices):
    expected, actual = (of(flown().to(device)).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)
