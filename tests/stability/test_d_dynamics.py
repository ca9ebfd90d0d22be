"""Hard cases of the dynamics and of rollouts."""

import dataclasses
import math

import pytest
import torch

from gsim3d.dynamics.step import SCALE_STEP_SHARE
from gsim3d.math.rotations import rotate_left
from gsim3d.numerics.policy import StabilityConfig
from gsim3d.numerics.report import StabilityReport
from gsim3d.numerics.validate import validate_particles
from gsim3d.state import ASLEEP
from tests.dynamics.scenes import EXPLICIT, TINY, batch, float_fields, make_history
from tests.stability.rollouts import finite, make_simulator, of_scene, ordinary, raised
from tests.stability.steps import EXACT, check_step, simulate
from tests.test_simulator import CONFIG, make_frames

NAN, INF = float("nan"), float("inf")
N_LONG = 1000
SMALLEST = {
    "history_bits": 1,
    "strides": (2,),
    "merge_windows": (2,),
    "patch_sizes": (16, 16),
    "encoder_depths": (1, 1),
    "encoder_channels": (8, 12),
    "encoder_heads": (2, 3),
    "decoder_depths": (1,),
    "decoder_channels": (8,),
    "decoder_heads": (2,),
}


def test_d42_a_thousand_steps(setting, measured):
    """Random weights for as long as they last: speed, extent and opacity stay bounded in every single step."""
    history, report = make_history((6, 6)), StabilityReport()
    simulator = make_simulator(setting, **SMALLEST)
    with torch.no_grad():
        steps = simulator.rollout(setting.to(history), N_LONG, report=report)
    means = torch.stack([step.means for step in steps])
    measured.finite(means, torch.stack([step.dynamic_latents for step in steps]))
    step = CONFIG.dynamics.max_step
    assert means.diff(dim=0).abs().max() <= step
    # A particle falls asleep with the step that takes it out of the workspace.
    assert means.min() >= -step and means.max() <= 2**16 * CONFIG.dynamics.grid_size + step
    mass = torch.stack([step.opacities.sum() for step in steps])
    assert (mass / mass[0] - 1).abs().max() < 0.01
    sentinels = report.statistics
    assert len(sentinels) == N_LONG and all(math.isfinite(s.kinetic_energy) for s in sentinels.values())
    assert all(finding.action == "asleep" for finding in report.findings)
    measured.outcome("speed, extent and opacity bounded")


def fall(simulator):
    """All that moves sinks by about 0.25 m a step."""
    head = simulator.dynamics.net.head.fc2
    head.bias.data[6] = -1.2  # latents 0 .. 3, then x, y, z


def test_d43_free_fall_out_of_the_workspace(setting, measured):
    """Particles fall asleep with the step that takes them out; another scene does not notice."""
    falling, mate = make_history((12, 15), frozen_share=0.0), ordinary()
    falling = dataclasses.replace(falling, origin=torch.tensor([[0.0, 0.0, 0.1]], dtype=torch.float64))
    mate = dataclasses.replace(mate, origin=torch.full((1, 3), -50.0, dtype=torch.float64))
    simulator, report = make_simulator(setting, prepare=fall), StabilityReport()
    steps = simulator.rollout(setting.to(batch([falling, mate])), 6, report=report)
    finite(measured, steps)
    asleep = steps[-1].activity[:15] == ASLEEP
    assert asleep.all() and not (steps[-1].activity[15:] == ASLEEP).any()
    assert (steps[-1].means[:15, 2] >= 0.1 - CONFIG.dynamics.max_step).all()
    measured.same_bits(steps[-1].means[:15], steps[-2].means[:15], "who is asleep")
    assert {(f.what, f.action, f.scene) for f in report.findings} == {("outside the workspace", "asleep", 0)}
    assert sum(finding.count for finding in report.findings) == 15
    alone = simulator.rollout(setting.to(mate), 6, report=StabilityReport())
    for step, expected in zip(steps, alone, strict=True):
        for name, value in of_scene(expected, 0).items():
            measured.unchanged(setting, of_scene(step, 1)[name], value, name)
    measured.outcome("asleep, counted")


@pytest.mark.parametrize("cell", [-40.0, 2.0**16 + 40])
def test_d43_clamped_at_the_border(setting, measured, cell):
    """With "clamp" a particle that is outside is held at the border and goes on."""
    newest, size = setting.to(make_history((15,))), CONFIG.dynamics.grid_size
    means = newest.means.clone()
    means[3, 1] = cell * size
    report = StabilityReport()
    held = validate_particles(
        dataclasses.replace(newest, means=means), StabilityConfig("clamp"), report, "encode", grid_size=size
    )
    cells = (held.means.double() - newest.origin) / size
    assert ((cells >= 0) & (cells < 2**16)).all() and not (held.activity == ASLEEP).any()
    others = torch.arange(15, device=setting.device) != 3
    measured.same_bits(held.means[others], newest.means[others], "the others")
    assert [(f.what, f.action, f.count) for f in report.findings] == [("outside the workspace", "clamped", 1)]
    measured.outcome("clamped, counted")


def rollout_gradients(setting, n_steps, config=CONFIG):
    simulator = make_simulator(setting, config=config)
    state = setting.to(batch([make_history((14, 12)), ordinary()]))
    leaves = {name: value.clone().requires_grad_() for name, value in float_fields(state).items()}
    step = simulator.rollout(dataclasses.replace(state, **leaves), n_steps)[-1]
    total = step.means.sum() + step.dynamic_latents.square().sum()
    sources = [*leaves.values(), *simulator.dynamics.parameters()]
    found = torch.autograd.grad(total, sources, allow_unused=True)
    return step, [torch.zeros_like(s) if g is None else g for s, g in zip(sources, found, strict=True)]


@pytest.mark.parametrize("n_steps", [2, 12])
def test_d44_gradients_through_a_rollout(setting, measured, n_steps):
    step, grads = rollout_gradients(setting, n_steps)
    measured.finite(*grads, *float_fields(step).values())
    norm = torch.stack([g.double().norm() for g in grads]).norm().item()
    exact_step, exact = rollout_gradients(EXACT, n_steps)
    expected = torch.stack([g.norm() for g in exact]).norm().item()
    assert 0 < norm < 1e3 * expected
    bound = f"rollout_{n_steps}_{setting.precision}"
    measured.close(step.means, exact_step.means, bound, "means")
    measured.close(torch.tensor([norm]), torch.tensor([expected]), bound, "norm of the gradient")


OPACITY = EXPLICIT.dynamic_latents + 3 * (EXPLICIT.sh_degree + 1) ** 2 + 3  # among the channels that are predicted
SCALES = OPACITY + 4


def steep(first, count, value):
    def prepare(dynamics):
        dynamics.net.head.fc2.bias.data[first : first + count] = value

    return prepare


@pytest.mark.parametrize("sign", [-1, 1])
def test_d45_opacities_stay_between_0_and_1(setting, measured, sign):
    step = check_step(
        setting, measured, make_history((20, 25), config=EXPLICIT), EXPLICIT, prepare=steep(OPACITY, 1, 5.0 * sign)
    )
    moved = make_history((20, 25), config=EXPLICIT).activity[20:] == 0
    assert (step.fields["opacities"][moved.to(setting.device)] == (sign > 0)).all()
    measured.outcome("clamped to [0, 1]")


@pytest.mark.parametrize("sign", [-1, 1])
def test_d45_scales_stay_in_their_range(setting, measured, sign):
    """The prediction drives all scales beyond a limit; half of them lie there already."""
    low, high = EXPLICIT.scale_min, EXPLICIT.scale_max
    history = make_history((20, 25), config=EXPLICIT)
    scales = torch.full_like(history.scales, (low + high) / 2)
    scales[::2] = high if sign > 0 else low
    history = dataclasses.replace(history, scales=scales)
    step = check_step(setting, measured, history, EXPLICIT, prepare=steep(SCALES, 3, 50.0 * sign))
    moved = (history.activity[20:] == 0).to(setting.device)
    found, before = step.fields["scales"][moved], setting.to(scales[20:])[moved]
    assert found.min() >= before.new_tensor(low) and found.max() <= before.new_tensor(high)
    largest = 1.001 * SCALE_STEP_SHARE * (high - low)
    assert (found - before).abs().max() <= largest and (found != before).any()
    measured.outcome("scales clamped, their steps bounded")


def test_d46_a_thousand_turns(setting, measured):
    """Unit quaternions all the way, and the rotation that the turns make together in float64."""
    g = torch.Generator().manual_seed(0)
    turns = 0.1 * torch.randn(N_LONG, 8, 3, generator=g)
    turns[::10] = 0  # no turn at all
    start = torch.randn(8, 4, generator=g)

    def turned(where):
        quats, vectors = where.to(start), where.to(turns).requires_grad_()
        for vector in vectors.unbind(0):
            quats = rotate_left(quats, vector)
        return quats, torch.autograd.grad(quats.sum(), vectors)[0]

    quats, grad = turned(setting)
    measured.finite(quats, grad)
    exact, _ = turned(EXACT)
    measured.close(quats.norm(dim=1), torch.ones(8, dtype=torch.float64), f"unit_{setting.exact}", "length")
    measured.close(quats, exact, f"turns_{setting.exact}", "rotation")


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-9])
def test_d51_quaternions_without_a_direction(setting, measured, length):
    """They are the identity, and get no gradient."""
    quats = torch.tensor([[0.5, -0.5, 0.5, 0.5], [1.0, 0, 0, 0]]) * torch.tensor([[length], [1.0]])
    vectors = torch.tensor([[0.1, -0.2, 0.3]]).repeat(2, 1)
    leaves = [setting.to(t).requires_grad_() for t in (quats, vectors)]
    out = rotate_left(*leaves)
    grads = torch.autograd.grad(out.sum(), leaves)
    measured.finite(out, *grads)
    measured.same_bits(out[0], out[1])
    assert not grads[0][0].any() and grads[1][0].any()
    history = make_history((12, 15), config=EXPLICIT)
    odd = history.quats.clone()
    odd[::5] *= length
    check_step(setting, measured, dataclasses.replace(history, quats=odd), EXPLICIT)


def race(simulator):
    """Everything that moves goes some metres a step."""
    simulator.dynamics.net.head.fc2.weight.data.mul_(40)


@pytest.mark.parametrize("n_steps", [1, 8])
def test_d47_one_scene_diverges(setting, measured, n_steps):
    """Its particles fall asleep at the speed limit; the other scene has the bits it has alone."""
    wild, mate = make_history((14, 12)), ordinary()
    wild = dataclasses.replace(wild, dynamic_latents=9e3 * wild.dynamic_latents)
    origin = torch.full((1, 3), -3000.0, dtype=torch.float64)
    wild, mate = (dataclasses.replace(h, origin=origin) for h in (wild, mate))
    simulator, report = make_simulator(setting, prepare=race, max_step=None), StabilityReport()
    limits = dataclasses.replace(simulator.config.stability, max_speed=1e-3)
    simulator.config = dataclasses.replace(simulator.config, stability=limits)
    steps = simulator.rollout(setting.to(batch([wild, mate])), n_steps, report=report)
    finite(measured, steps)
    assert {(f.what, f.action) for f in report.findings} == {("speed limit", "asleep")}
    alone = simulator.rollout(setting.to(mate), n_steps, report=StabilityReport())
    for step, expected in zip(steps, alone, strict=True):
        for name, value in of_scene(expected, 0).items():
            measured.unchanged(setting, of_scene(step, 1)[name], value, name)
    measured.outcome("asleep, counted")


FIELDS = {"means": NAN, "dynamic_latents": INF, "static_latents": -INF, "opacities": NAN}


def poisoned(name, row):
    history = make_history((14, 12))
    values = getattr(history, name).clone()
    values[row] = FIELDS[name]
    return dataclasses.replace(history, **{name: values})


@pytest.mark.parametrize("name", FIELDS)
def test_d47_numbers_that_are_none_are_an_error(setting, measured, name):
    simulator, report = make_simulator(setting), StabilityReport()
    state = setting.to(batch([ordinary(), poisoned(name, 17)]))
    error = raised(lambda: simulator.rollout(state, 2, report=report), report)
    assert (error.tensor, error.scene, error.step, error.row) == (f"particles.{name}", 1, 1, 21 + 17)
    measured.outcome("NumericalError names scene, step, row, tensor")


@pytest.mark.parametrize("name", FIELDS)
def test_d47_numbers_that_are_none_are_dropped(setting, measured, name):
    """As if the particle were not there, for its scene and for the other one."""
    simulator, report = make_simulator(setting), StabilityReport()
    hard, kept = poisoned(name, 17), torch.arange(26) != 17
    steps = simulator.rollout(setting.to(batch([hard, ordinary()])), 3, on_invalid="drop", report=report)
    finite(measured, steps)
    absent = batch([hard.select_rows(kept), ordinary()])
    expected = simulator.rollout(setting.to(absent), 3, on_invalid="drop", report=StabilityReport())
    rows = torch.cat([kept[14:], torch.ones(9, dtype=torch.bool)]).to(setting.device)
    assert all(step.opacities[3] == 0 and step.activity[3] == ASLEEP for step in steps)
    for step, other in zip(steps, expected, strict=True):
        for field, value in float_fields(other).items():
            measured.unchanged(setting, float_fields(step)[field][rows], value, field)
    assert [(f.tensor, f.action, f.count) for f in report.findings] == [(f"particles.{name}", "dropped", 1)]
    measured.outcome("dropped, counted")


@pytest.mark.parametrize("name", FIELDS)
def test_d47_numbers_that_a_step_made_are_dropped(setting, measured, name):
    """The row falls asleep where it was, and is not drawn; the others have the bits they have without it."""
    before = setting.to(make_history((15,)))
    values = getattr(before, name).clone()
    values[3] = FIELDS[name]
    report = StabilityReport()
    after = validate_particles(
        dataclasses.replace(before, **{name: values}), StabilityConfig("drop"), report, "rollout", previous=before
    )
    assert after.opacities[3] == 0 and after.activity[3] == ASLEEP
    measured.same_bits(after.means, before.means, "places")
    others = torch.arange(15, device=setting.device) != 3
    for field, value in float_fields(before).items():
        measured.same_bits(float_fields(after)[field][others], value[others], field)
    assert [(f.tensor, f.action, f.count) for f in report.findings] == [(f"particles.{name}", "dropped", 1)]
    measured.outcome("dropped, counted")


@pytest.mark.parametrize("value", [0.0, 1.0, 9e3])
def test_d47_what_a_scene_holds_never_reaches_another(setting, measured, value):
    """Two calls of equal sizes: whatever the first scene's particles carry, the second one has equal bits."""
    wild, mate = make_history((14, 12)), ordinary()
    wild = dataclasses.replace(wild, dynamic_latents=value * wild.dynamic_latents, opacities=0.5 * wild.opacities)
    tame = make_history((14, 12))
    step, other = (simulate(setting, batch([history, mate])) for history in (wild, tame))
    measured.finite(*step.tensors)
    for kind, rows in (("fields", 9), ("grads", 21)):
        for name, expected in getattr(other, kind).items():
            measured.same_bits(getattr(step, kind)[name][-rows:], expected[-rows:], f"{kind} {name}")


@pytest.mark.parametrize("name", FIELDS)
def test_d47_numbers_that_are_none_are_clamped(setting, measured, name):
    simulator, report = make_simulator(setting), StabilityReport()
    steps = simulator.rollout(setting.to(batch([poisoned(name, 17), ordinary()])), 3, on_invalid="clamp", report=report)
    finite(measured, steps)
    alone = simulator.rollout(setting.to(ordinary()), 3, report=StabilityReport())
    for step, expected in zip(steps, alone, strict=True):
        for field, value in of_scene(expected, 0).items():
            measured.unchanged(setting, of_scene(step, 1)[field], value, field)
    assert report.findings[0].tensor == f"particles.{name}" and report.findings[0].action == "clamped"
    measured.outcome("clamped, counted")


def twice(history):
    """Every particle a second time, behind those of its step."""
    rows = torch.cat([torch.arange(a, b).repeat(2) for a, b in zip(history.cu_rows, history.cu_rows[1:])])
    fields = {name: value[rows] for name, value in history.row_fields().items()}
    return dataclasses.replace(history, **fields, cu_rows=2 * history.cu_rows)


def test_d48_an_object_on_top_of_itself(setting, measured):
    """Where both lie in the same patches, a particle and its copy have the same future. (Of equal maxima the first one
    gets the gradient: gradients of the two are finite, not equal.)"""
    config = dataclasses.replace(TINY, patch_sizes=(256,) * 3)
    step = check_step(setting, measured, twice(make_history((20, 25))), config)
    for name, value in step.fields.items():
        measured.close(value[25:], value[:25], f"network_{setting.precision}", f"{name} of the copy")


def test_d48_the_image_of_an_object_on_top_of_itself(setting, measured):
    simulator = make_simulator(setting)
    state = setting.to(twice(make_history((0, 25))))
    camera = setting.to(make_frames((1,), masked=False)).cameras
    camera = camera.select(torch.zeros(1, dtype=torch.int64, device=setting.device))
    means = state.means.clone().requires_grad_()
    step = dataclasses.replace(state, means=means).select_clouds([1])
    image = simulator.render(step, camera)
    (grad,) = torch.autograd.grad(image.color.sum() + image.alpha.sum(), means)
    measured.finite(image.color, image.alpha, image.depth, grad)
    single = simulator.render(setting.to(make_history((0, 25))).select_clouds([1]), camera)
    assert (image.alpha >= single.alpha - 1e-6).all() and image.alpha.max() < 1
