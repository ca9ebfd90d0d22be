"""Rows at rest sleep, wake in time, and cost nothing meanwhile."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import RestLog, Sleepers, rollout_in_parts
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep
from gsim3d.errors import InputError
from gsim3d.state import ASLEEP, FROZEN, Particles, concatenate, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, float_fields, make_history
from tests.effects.resting import ASYMMETRIC, make_scenes, make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

HALO, REACH = 0.05, 0.04  # metres


def at(places, velocities, frozen=()):
    """One scene, one step; a row's dynamic latents are its velocity."""
    means = torch.tensor(places, dtype=torch.float64)
    n = means.shape[0]
    return Particles(
        means=means,
        opacities=torch.ones(n).double(),
        dynamic_latents=torch.tensor(velocities, dtype=torch.float64),
        static_latents=torch.zeros(n, 1).double(),
        cu_rows=torch.tensor([0, n]),
        cloud_scene=torch.zeros(1, dtype=torch.int64),
        cloud_step=torch.zeros(1, dtype=torch.int64),
        activity=torch.tensor([FROZEN if i in frozen else 0 for i in range(n)], dtype=torch.uint8),
        origin=torch.full((1, 3), -5.0, dtype=torch.float64),
    )


def billiards(moving, background):
    """Rows fly on; one that lies still within reach of one that flies takes over its velocity, the other stops."""
    newest = last_steps(moving, 1)
    scene, velocity = newest.row_cloud(), newest.dynamic_latents.clone()
    for i in range(newest.n_rows):
        near = (newest.means - newest.means[i]).norm(dim=1) <= REACH
        flying = near & (scene == scene[i]) & newest.dynamic_latents.any(1)
        if flying.any() and not newest.dynamic_latents[i].any():
            by = flying.nonzero()[0, 0]
            velocity[i], velocity[by] = newest.dynamic_latents[by], 0
    table = newest.clouds
    counts = [table.count(q) for q in range(len(table))]
    later = type(table).make(counts, table.scenes, [s + 1 for s in table.steps], "cpu")
    return newest.with_clouds(later, means=newest.means + velocity, dynamic_latents=velocity)


def simulate(history, n_steps, rule=None, predict=billiards, asymmetric=True):
    sleepers = None if rule is None else Sleepers(rule, last_steps(history, 1), grid_size=0.01, history=1)
    log = RestLog()
    remember = (lambda background: background) if asymmetric else None
    return rollout_in_parts(predict, history, n_steps, 1, remember=remember, sleepers=sleepers, log=log), log


def assert_same_steps(steps, expected):
    assert [s.clouds.steps for s in steps] == [s.clouds.steps for s in expected]
    for one, other in zip(steps, expected, strict=True):
        for name, value in float_fields(other).items():
            assert_same_bits(getattr(one, name), value, name)


LINE = [[0.5 + 0.03 * i, 0.0, 0.0] for i in range(3)] + [[2.0, 0.0, 0.0], [2.03, 0.0, 0.0]]


@pytest.mark.parametrize("speed", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("direction", [(1, 0, 0), (0.6, 0.8, 0.0)])
def test_sleep_with_waking_matches_never_sleeping(speed, direction):
    """A row is shot at rows that sleep: they are hit, fly on, wake others and come to rest."""
    direction = torch.tensor(direction, dtype=torch.float64)
    across = torch.tensor([-direction[1], direction[0], 0.0])
    turned = [(x * direction + y * across).tolist() for x, y, _ in [[0.0, 0.0, 0.0], *LINE]]
    velocities = [(speed * HALO * direction).tolist()] + [[0.0] * 3] * len(LINE)
    history, n_steps = at(turned, velocities), round(2.4 / (speed * HALO))
    expected, _ = simulate(history, n_steps)
    steps, log = simulate(history, n_steps, Sleep("approx", eps=1e-6, patience=2, halo=HALO))
    assert_same_steps(steps, expected)
    assert (expected[-1].means - history.means).norm(dim=1)[[1, 2, 3, 4]].min() > 0  # all were hit
    assert log.resting_share > 0.4 and min(log.moving) < max(log.moving) == len(turned)


@pytest.mark.parametrize("speed", [0.5, 3.0, 10.0])
def test_sleeper_wakes_before_fast_particle_arrives(speed):
    """Seven places on its way: after each step those are awake where it is, and where it will be; the others sleep."""
    step = speed * HALO
    places = [[0.0, 0.0, 0.0]] + [[step * k, 1.5 * HALO, 0.0] for k in range(1, 8)]
    before = at(places, [[0.0] * 3] * 8)
    sleepers = Sleepers(Sleep("approx", eps=1e-6, patience=1, halo=HALO), before, grid_size=0.01, history=1)
    for k in range(1, 7):
        means = before.means.clone()
        means[0, 0] = step * k
        after = dataclasses.replace(before, means=means)
        sleepers.update(before, after)
        before = after
        awake = (~sleepers.asleep).nonzero()[:, 0].tolist()
        assert {0, k, k + 1} <= set(awake)
        assert speed < 1 or awake == [0, k, k + 1]


def test_sleeper_wakes_late_beyond_halo_speed():
    history = at([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[4 * REACH, 0.0, 0.0], [0.0] * 3])
    rule = Sleep("approx", eps=1e-6, patience=1, halo=REACH / 8)
    expected, _ = simulate(history, 12)
    steps, _ = simulate(history, 12, rule)
    assert (expected[-1].means[1, 0] > 1.0) and steps[-1].means[1, 0] == 1.0


@pytest.mark.parametrize("asymmetric", [False, True])
def test_sleep_of_one_scene_in_batch(asymmetric):
    """Scene 1 rests from the start and sleeps; the others are computed, as if alone."""
    flying = at([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], [[0.02, 0.0, 0.0], [0.0] * 3])
    resting = at([[0.0, 0.0, 0.0]] * 3, [[0.0] * 3] * 3)
    history, seen = batch([flying, resting, flying]), []

    def predict(moving, background):
        seen.append(moving.clouds.scenes)
        return billiards(moving, background)

    steps, log = simulate(history, 8, Sleep("exact", eps=0.0, patience=3), predict, asymmetric)
    assert seen == [(0, 1, 2)] * 3 + [(0, 2)] * 5
    assert log.moving == [7] * 3 + [4] * 5
    assert_same_steps(steps, simulate(history, 8, asymmetric=asymmetric)[0])


def test_changed_state_wakes_scene():
    resting, rule = at([[0.0, 0.0, 0.0]], [[0.0] * 3]), Sleep("exact", eps=0.0, patience=1)
    steps, log = simulate(resting, 4, rule)
    assert log.calls == 1
    pushed = dataclasses.replace(steps[-1], dynamic_latents=torch.full_like(steps[-1].dynamic_latents, 0.01))
    after, log = simulate(pushed, 4, rule)
    assert log.calls == 4 and (after[-1].means > 0.03).all()


def test_removed_particle_wakes_scene():
    """A guard takes one row out in the second step: nothing moved, and yet the others see another scene."""
    history, calls = at([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0] * 3] * 2), []

    def predict(moving, background):
        calls.append(1)
        step = billiards(moving, background)
        gone = torch.tensor([0, ASLEEP if len(calls) >= 2 else 0], dtype=torch.uint8)
        return dataclasses.replace(step, activity=gone)

    _, log = simulate(history, 12, Sleep("exact", eps=0.0, patience=3), predict, asymmetric=False)
    assert log.calls == len(calls) == 6, "asleep at the first third step before which three changed nothing"


@pytest.mark.parametrize("policy", ["exact", "approx"])
def test_sleep_error_is_bounded_by_eps(policy):
    history = at([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[9e-5, 0.0, 0.0], [0.0, -8e-5, 0.0]])
    rule = Sleep(policy, eps=1e-2, patience=3)  # of cells of 1 cm
    expected, _ = simulate(history, 20)
    steps, log = simulate(history, 20, rule)
    assert log.calls == 3
    for k, (one, other) in enumerate(zip(steps, expected, strict=True)):
        missed = (one.means - other.means).abs().max().item()
        assert missed <= 1e-4 * max(0, k - 2) * (1 + 1e-9)
    assert missed > 1e-3


def still(config, dtype=torch.float32):
    """A simulator whose dynamics change nothing."""
    simulator = make_simulator(config, dtype=dtype)
    with torch.no_grad():
        simulator.dynamics.net.head.fc2.weight.zero_()
        simulator.dynamics.net.head.fc2.bias.zero_()
    return simulator


def asleep_by(policy, patience=4, **options):
    return EffectsSpec(dynamics=DynamicsEffects(sleep=Sleep(policy, patience=patience, **options)))


@pytest.mark.parametrize(("config", "policy"), [(TINY, "exact"), (ASYMMETRIC, "exact"), (ASYMMETRIC, "approx")])
def test_sleeping_scene_skips_network(config, policy):
    simulator, state, calls, log = still(config), make_scenes(), [], RestLog()
    simulator.dynamics.net.register_forward_hook(lambda *_: calls.append(1))
    plan = simulator.plan(asleep_by(policy))
    steps = simulator.rollout(state, 9, plan, log=log)
    assert log.calls == 4 and len(calls) == 4 + log.remembered
    assert log.moving[4:] == [0] * 5 and log.remembered <= 1
    assert_same_steps(steps, simulator.rollout(state, 9))


def test_frozen_state_skips_network():
    simulator, state = make_simulator(), make_history((30, 30), frozen_share=1.0)
    simulator.dynamics.net.register_forward_hook(lambda *_: pytest.fail("the network was called"))
    for step in simulator.rollout(state, 3):
        assert_same_bits(step.means, last_steps(state, 1).means)


def test_sleeping_particles_act_as_background():
    """A part of a scene falls asleep after four steps: the next ones are those of a state in which it is frozen."""
    simulator, state = make_simulator(), make_history((50, 60), frozen_share=0.3)
    newest, dynamics, log = last_steps(state, 1), simulator.dynamics, RestLog()
    asleep = (newest.activity != FROZEN) & (newest.means[:, 0] < 0.5)

    class Some(Sleepers):
        def update(self, before, after):
            self.n_steps += 1
            self.asleep = asleep & (self.n_steps >= 4)
            return self.n_steps == 4

    steps = rollout_in_parts(
        lambda moving, background: dynamics(moving, background=background),
        state,
        7,
        4,
        remember=dynamics.remember,
        sleepers=Some(Sleep("approx"), newest, 1.0, 4),
        log=log,
    )
    assert log.remembered == 2 and log.moving[3] > log.moving[4] > 0
    history = concatenate(steps[:4])
    activity = torch.where(asleep.repeat(4), FROZEN, history.activity).to(torch.uint8)
    expected = simulator.rollout(dataclasses.replace(history, activity=activity), 3)
    for one, other in zip(steps[4:], expected, strict=True):
        assert_same_bits(one.means, other.means)
        assert torch.equal(one.activity, newest.activity)
    assert_same_bits(steps[-1].means[asleep], steps[3].means[asleep])


def test_sleep_repeats_bits():
    simulator, state = make_simulator(), make_scenes()
    plan = simulator.plan(asleep_by("approx", eps=2.2))
    logs = [RestLog(), RestLog()]
    one, other = (simulator.rollout(state, 8, plan, log=log) for log in logs)
    assert logs[0] == logs[1] and logs[0].remembered > 1
    assert_same_steps(one, other)


def test_sleep_gradients():
    """Rows asleep hold their state, and its gradient: that of the last step in which they were awake."""
    simulator, state = (
        make_simulator(dtype=torch.float64),
        make_history((30, 40), frozen_share=0.3, dtype=torch.float64),
    )
    latents = state.dynamic_latents.clone().requires_grad_()
    plan = simulator.plan(asleep_by("exact", eps=1e6))
    steps = simulator.rollout(dataclasses.replace(state, dynamic_latents=latents), 7, plan)
    awake, slept = (
        torch.autograd.grad(step.means.sum(), latents, retain_graph=True)[0] for step in (steps[3], steps[6])
    )
    assert awake.abs().max() > 0
    assert_close_relative_to_max(slept, awake, 1e-12)


def test_symmetric_model_refuses_approx_sleep():
    simulator = make_simulator(TINY)
    assert "sleep" in simulator.plan(asleep_by("exact")).on
    with pytest.raises(InputError, match="unsupported effect dynamics.sleep.policy approx"):
        simulator.plan(asleep_by("approx"))


@pytest.mark.parametrize("halo", [0.0, float("inf"), float("nan")])
def test_sleep_refuses_invalid_halo(halo):
    with pytest.raises(InputError, match="halo"):
        Sleep("approx", halo=halo)
