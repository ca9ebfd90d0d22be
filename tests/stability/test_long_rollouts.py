"""A thousand steps, gradients through many of them, and hard input from ordinary scenes (gsim3d/testing/stress.py)."""

import dataclasses
import math

import pytest
import torch

from gsim3d import presets
from gsim3d.simulator import Simulator
from gsim3d.state import last_steps
from gsim3d.testing.invariances import Sample
from gsim3d.testing.stress import STRESS_TESTS, gradient_norms, rollout_curves
from gsim3d.train.loop import deterministic
from tests.dynamics.scenes import batch, float_fields, make_history
from tests.stability.test_invariances import CONFIGS, make_sample, simulators  # noqa: F401
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator, target_cameras

pytestmark = pytest.mark.usefixtures("one_thread")

N_LONG = 1000


def lively(preset: str, seed: int) -> Simulator:
    """A model whose untrained particles move by centimetres a step."""
    torch.manual_seed(seed)
    simulator = Simulator(getattr(presets, preset)()).eval()
    with torch.no_grad():
        simulator.dynamics.net.head.fc2.weight.normal_(std=0.1)
    return simulator


def state_of(simulator: Simulator, n_rows: int, seed: int = 0):
    """Two scenes with two steps each of random particles around a metre from their origin."""
    config = simulator.config.dynamics
    histories = [make_history((n, n), seed=seed + n, config=config) for n in (n_rows, n_rows // 2)]
    return dataclasses.replace(batch(histories), origin=torch.full((2, 3), -2.0, dtype=torch.float64))


@pytest.mark.parametrize(("preset", "n_rows"), [("tiny", 32), ("small", 8)])
def test_long_rollout_is_finite_and_bounded(preset, n_rows, device):
    simulator = lively(preset, seed=1).to(device)
    state, finite = state_of(simulator, n_rows).to(device), []

    def look(newest):
        finite.append(all(bool(value.isfinite().all()) for value in float_fields(newest).values()))

    with torch.no_grad():
        curves = rollout_curves(simulator, state, N_LONG, on_step=look)
    assert all(finite) and len(finite) == N_LONG
    assert max(curves.speed) > 1e-3, "nothing moved: nothing is shown"
    assert max(curves.speed) <= math.sqrt(3) * simulator.config.dynamics.max_step
    mass = torch.tensor(curves.opacity_mass)
    assert (mass / mass[0] - 1).abs().max() < 0.01
    assert max(curves.extent) <= math.sqrt(3) * 2**16 * simulator.config.dynamics.grid_size
    limit = 0.5 * sum(state.activity.shape) * 3 * simulator.config.dynamics.max_step**2
    assert max(curves.kinetic_energy) <= limit


@pytest.mark.parametrize("model", CONFIGS)
@pytest.mark.parametrize("case", STRESS_TESTS)
def test_stress_test(case, model, device, simulators):  # noqa: F811
    deviations = list(STRESS_TESTS[case](simulators[model, torch.float32].to(device), make_sample(device)))
    assert deviations
    broken = [str(deviation) for deviation in deviations if not deviation.holds]
    assert not broken, "\n".join(broken)


class Diverging(Simulator):
    """Forgets what a number is: every particle is twice as far away in each step, and NaN after some."""

    def _predict(self, state, *args, **kwargs):
        step = super()._predict(state, *args, **kwargs)
        return dataclasses.replace(step, means=3 * step.means, dynamic_latents=step.dynamic_latents / 0)


def test_stress_test_detects_divergence():
    diverging = awake(Diverging(CONFIG).eval())
    for case in ("images without content", "few and equal views", "crowds", "a long rollout"):
        try:
            deviations = list(STRESS_TESTS[case](diverging, make_sample("cpu")))
        except ValueError:
            continue
        assert any(not deviation.holds for deviation in deviations), case


@pytest.fixture(scope="module")
def encoded():
    """A sample of one scene and its encoded state, of few particles."""
    frames = make_frames((2,), masked=True)
    few = torch.rand(frames.masks.shape, generator=torch.Generator().manual_seed(3)) < 0.2
    frames = dataclasses.replace(frames, masks=frames.masks & few)
    sample = Sample(frames, target_cameras(frames, 1))
    return sample, awake(make_simulator()).encode(frames).detach()


@pytest.mark.parametrize("n_steps", [12, 48])
def test_rollout_gradients_neither_explode_nor_vanish(n_steps, encoded):
    sample, state = encoded
    norms, gradients = gradient_norms(awake(make_simulator()), state, sample.targets, n_steps)
    assert len(norms) == n_steps and all(map(math.isfinite, norms))
    growth = norms[0] / norms[-1]
    assert 1e-3 < growth < 1e3, f"norms from the first state to the last: {norms}"
    total = torch.stack([g.double().norm() for g in gradients.values()]).norm()
    assert 0 < total < 1e3 and all(bool(g.isfinite().all()) for g in gradients.values())


def hard_state(kind, state):
    """States whose gradients are known to explode elsewhere."""
    n = state.n_rows
    if kind == "all in one voxel":
        apart = torch.rand(n, 3, generator=torch.Generator().manual_seed(4))
        return dataclasses.replace(state, means=state.means[:1] + 1e-4 * apart)
    if kind == "every particle twice":
        half = torch.arange(n) // 2
        return dataclasses.replace(state, **{name: value[half] for name, value in state.row_fields().items()})
    if kind == "one far away":
        means = state.means.clone()
        means[0] += 1e3
        return dataclasses.replace(state, means=means)
    return dataclasses.replace(state, opacities=torch.ones(n), dynamic_latents=100 * state.dynamic_latents)


@pytest.mark.parametrize("kind", ["all in one voxel", "every particle twice", "one far away", "opaque, large latents"])
def test_gradients_of_hard_states_are_bounded(kind, encoded):
    sample, state = encoded
    simulator = awake(make_simulator())
    norms, gradients = gradient_norms(simulator, hard_state(kind, state), sample.targets, 12)
    assert all(map(math.isfinite, norms)) and max(norms) <= 10 * norms[-1], norms
    assert all(bool(g.isfinite().all()) for g in gradients.values())


@pytest.mark.parametrize("n_steps", [12, 48])
def test_checkpointing_gradients_are_equal(n_steps, encoded):
    """To the bit: what is computed again is the same."""
    sample, state = encoded
    found = []
    for checkpointing in (False, True):
        dynamics = dataclasses.replace(CONFIG.dynamics, checkpointing=checkpointing)
        simulator = awake(make_simulator(dataclasses.replace(CONFIG, dynamics=dynamics))).train()
        with deterministic():
            found.append(gradient_norms(simulator, state, sample.targets, n_steps))
    (norms, gradients), (others, recomputed) = found
    assert norms == others and gradients.keys() == recomputed.keys()
    for name, gradient in gradients.items():
        assert torch.equal(gradient, recomputed[name]), name


def test_clipped_gradients_direction_and_norm(encoded):
    sample, state = encoded
    simulator = awake(make_simulator())
    _, gradients = gradient_norms(simulator, state, sample.targets, 12)
    parameters = dict(simulator.named_parameters())
    for name, gradient in gradients.items():
        parameters[name].grad = 1e6 * gradient
    before = torch.nn.utils.clip_grad_norm_(parameters.values(), 0.5)
    clipped = torch.cat([parameters[name].grad.flatten() for name in gradients]).double()
    plain = torch.cat([gradient.flatten() for gradient in gradients.values()]).double()
    assert before > 0.5 and clipped.norm() == pytest.approx(0.5, rel=1e-4)
    assert torch.nn.functional.cosine_similarity(clipped, plain, 0) == pytest.approx(1, abs=1e-6)


def test_rollout_curves_match_rollout(encoded):
    sample, state = encoded
    simulator = awake(make_simulator())
    with torch.no_grad():
        curves = rollout_curves(simulator, state, 3)
        steps = simulator.rollout(state, 3)
    before = last_steps(state, 1)
    for i, step in enumerate(steps):
        moved = (step.means - before.means).double()
        assert curves.kinetic_energy[i] == pytest.approx(float(0.5 * moved.square().sum()), rel=1e-4)
        assert curves.speed[i] == pytest.approx(float(moved.norm(dim=1).max()), rel=1e-5)
        assert curves.opacity_mass[i] == pytest.approx(float(step.opacities.sum()), rel=1e-5)
        assert curves.awake[i] == step.n_rows
        before = step
