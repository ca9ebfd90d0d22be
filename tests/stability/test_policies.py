"""The policies raise, drop and clamp: what is refused, what sleeps, what is bounded, what is reported."""

import copy
import dataclasses
import pickle
from functools import partial

import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import Cameras
from gsim3d.errors import InputError, NumericalError
from gsim3d.numerics.policy import StabilityConfig
from gsim3d.numerics.report import Finding, Reading, StabilityReport, Statistics, _Record, pack
from gsim3d.ops import rasterize_gaussians
from gsim3d.state import ASLEEP, last_steps
from tests.asserts import assert_same_bits
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator, target_cameras

NAN, INF = float("nan"), float("inf")
SCENES = (2, 3)  # steps of each


@pytest.fixture
def simulator(device):
    return awake(make_simulator()).to(device)


@pytest.fixture
def state(simulator, device):
    with torch.no_grad():
        return simulator.encode(make_frames(SCENES).to(device))


def with_value(particles, name, row, value):
    changed = getattr(particles, name).clone()
    changed[row] = value
    return dataclasses.replace(particles, **{name: changed})


def rows_of_scene(particles, scene):
    return particles.cloud_scene[particles.row_cloud()] == scene


def assert_finite(particles):
    for name, value in particles.row_fields().items():
        assert bool(torch.isfinite(value).all()), name


BAD = [
    ("means", NAN, "not finite"),
    ("means", -INF, "not finite"),
    ("opacities", 1.5, "outside [0, 1]"),
    ("opacities", NAN, "outside [0, 1]"),
    ("dynamic_latents", INF, "not finite or beyond 10000"),
    ("static_latents", 3e4, "not finite or beyond 10000"),
]


@pytest.mark.parametrize("name, value, what", BAD)
def test_raise_names_scene_step_row_and_tensor(name, value, what, simulator, state):
    row = int(state.cu_rows[-2]) + 4  # of the last step of scene 1
    bad = with_value(state, name, row, value)
    with pytest.raises(NumericalError) as caught:
        simulator.rollout(bad, 1)
        simulator.report.check()  # a GPU raises here, the CPU before
    error = caught.value
    assert str(error).startswith(f"rollout: particles.{name}: {what} at row {row} (scene 1, step 2)")
    assert 'on_invalid="drop"' in str(error) and "\n" not in str(error)
    assert (error.tensor, error.scene, error.step, error.row) == (f"particles.{name}", 1, 2, row)
    assert pickle.loads(pickle.dumps(error)).row == row


@pytest.mark.parametrize("on_invalid", ["drop", "clamp"])
@pytest.mark.parametrize("name, value, what", BAD)
def test_invalid_particle_keeps_other_scene_bits(name, value, what, on_invalid, simulator, state):
    row, report = int(state.cu_rows[-2]) + 4, StabilityReport()
    with torch.no_grad():
        good = simulator.rollout(state, 3)
        steps = simulator.rollout(with_value(state, name, row, value), 3, on_invalid=on_invalid, report=report)
    for before, after in zip(good, steps, strict=True):
        assert_finite(after)
        other = rows_of_scene(after, 0)
        assert_same_bits(after.means[other], before.means[other])
        assert_same_bits(after.dynamic_latents[other], before.dynamic_latents[other])
    first = report.findings[0]
    assert (first.what, first.tensor, first.row, first.scene, first.step) == (what, f"particles.{name}", row, 1, 2)
    assert first.action == {"drop": "dropped", "clamp": "clamped"}[on_invalid]
    report.check()
    assert int((steps[-1].activity == ASLEEP).sum()) == (on_invalid == "drop")


@pytest.mark.parametrize("name, value, what", BAD)
def test_dropped_particle_matches_absent(name, value, what, simulator, state):
    """Its values change no other particle and no image."""
    row = int(state.cu_rows[-2]) + 4
    kept = torch.arange(state.n_rows, device=state.means.device) != row
    with torch.no_grad():
        dropped = simulator.rollout(with_value(state, name, row, value), 2, on_invalid="drop")[-1]
        absent = simulator.rollout(state.select_rows(kept), 2)[-1]
        cameras = target_cameras(make_frames(SCENES).to(state.means.device), 2)
        images = [simulator.render(particles, cameras).color for particles in (dropped, absent)]
    place = int(row - state.cu_rows[-2] + (dropped.cu_rows[1]))
    others = torch.arange(dropped.n_rows, device=kept.device) != place
    assert bool(dropped.activity[place] == ASLEEP) and float(dropped.opacities[place]) == 0
    assert_same_bits(dropped.means[others], absent.means)
    assert_same_bits(dropped.dynamic_latents[others], absent.dynamic_latents)
    assert_same_bits(images[0], images[1])


def test_dropped_particle_gradients_are_zero(simulator, state):
    latents = state.dynamic_latents.clone()
    latents[-1, 0] = NAN
    latents.requires_grad_()
    steps = simulator.rollout(dataclasses.replace(state, dynamic_latents=latents), 2, on_invalid="drop")
    cameras = target_cameras(make_frames(SCENES).to(latents.device), 2)
    image = simulator.render(steps[-1], cameras, on_invalid="drop").color
    parameters = list(simulator.dynamics.parameters())
    grad, *others = torch.autograd.grad(image.square().sum(), [latents, *parameters], allow_unused=True)
    assert grad[-1].abs().max() == 0 and bool(torch.isfinite(grad).all()) and grad.abs().max() > 0
    assert all(bool(torch.isfinite(other).all()) for other in others if other is not None)


@pytest.mark.parametrize("knows_previous", [False, True])
def test_sanitized_values_with_and_without_gradients(simulator, state, knows_previous):
    """Gradients go to the values, and to the previous ones of rows that have them."""
    newest, generator = last_steps(state, 1), torch.Generator().manual_seed(0)
    shapes = {"quats": (4,), "scales": (3,), "sh": (4, 3)}
    explicit = {name: torch.rand(newest.n_rows, *shape, generator=generator) for name, shape in shapes.items()}
    newest = dataclasses.replace(newest, **{name: value.to(newest.means) for name, value in explicit.items()})
    bad = newest
    cases = [
        *BAD,
        *((name, value, "") for name in shapes for value in (NAN, -INF)),
        ("means", 90.0, ""),
        ("means", 9e3, ""),
    ]
    for row, (name, value, _) in enumerate(cases):
        bad = with_value(bad, name, row, value)
    guard = simulator._guard("rollout", "drop", StabilityReport())
    options = {"previous": newest} if knows_previous else {}
    expected = guard(bad, **options)
    leaves, before = (
        {name: value.clone().requires_grad_() for name, value in of.row_fields().items() if name != "activity"}
        for of in (bad, newest)
    )
    options = {"previous": dataclasses.replace(newest, **before)} if knows_previous else {}
    actual = guard(dataclasses.replace(bad, **leaves), **options)
    for name, value in expected.row_fields().items():
        assert not value.requires_grad and getattr(actual, name).requires_grad == (name != "activity")
        assert_same_bits(getattr(actual, name).detach(), value)
    assert_finite(expected)
    asleep = (expected.activity == ASLEEP).nonzero()[:, 0].tolist()
    assert asleep == [row for row in range(len(cases)) if knows_previous or row != len(cases) - 2]
    replaced = torch.arange(newest.n_rows, device=newest.means.device) < len(cases) - 2 * (not knows_previous)
    for name, leaf in leaves.items():
        value = getattr(actual, name)
        weight = torch.rand(value.shape, generator=generator).to(value)
        grads = torch.autograd.grad((weight * value).sum(), [leaf, before[name]], retain_graph=True, allow_unused=True)
        rows = replaced.reshape(-1, *[1] * (value.dim() - 1))
        assert_same_bits(grads[0], torch.where(rows, 0, weight))
        if knows_previous:
            hidden = torch.arange(len(weight), device=weight.device) < len(cases) - 2
            shown = torch.where(hidden, 0, weight) if name == "opacities" else weight
            assert_same_bits(grads[1], torch.where(rows, shown, 0))


def test_closed_report_takes_no_records(simulator, state):
    row, report = int(state.cu_rows[-2]) + 4, StabilityReport()
    bad = with_value(state, "means", row, NAN)
    with torch.no_grad():
        simulator.rollout(bad, 1, on_invalid="drop", report=report)
        known = report.total
        report.close()
        steps = simulator.rollout(bad, 1, on_invalid="drop", report=report)
        assert known == report.total == 1 and int((steps[0].activity == ASLEEP).sum()) == 1
        report.clear()
        simulator.rollout(bad, 1, on_invalid="drop", report=report)
    assert report.total == 1


def kick_row(simulator, row, call, kick):
    """At that call of the dynamics, ``kick`` is added to the position of one row of the result."""
    calls = []

    def hook(module, arguments, predicted):
        calls.append(1)
        if len(calls) != call:
            return None
        means = predicted.means.clone()
        means[row] += kick
        return dataclasses.replace(predicted, means=means)

    simulator.dynamics.register_forward_hook(hook)


@pytest.mark.parametrize(
    ("kick", "what", "stays"),
    [(50.0, "speed limit", True), (7000.0, "outside the workspace", False), (NAN, "not finite", True)],
)
def test_diverging_particle_sleeps(kick, what, stays, simulator, state):
    """From the step on at which it diverges the network does not see it; the other scene keeps its bits."""
    with torch.no_grad():
        good = simulator.rollout(state, 4)
        kick_row(simulator, 3, 2, kick)
        limits = StabilityConfig(max_speed=10.0 if stays else 1e5)
        simulator.config = dataclasses.replace(simulator.config, stability=limits)
        report = StabilityReport()
        steps = simulator.rollout(state, 4, on_invalid="drop", report=report)
    (finding,) = report.findings
    assert (finding.what, finding.scene, finding.step, finding.row) == (what, 0, 3, 3)
    assert finding.action == ("dropped" if what == "not finite" else "asleep")
    assert bool(steps[0].activity[3] != ASLEEP) and all(bool(step.activity[3] == ASLEEP) for step in steps[1:])
    for step in steps[2:]:
        assert_same_bits(step.means[3], steps[1].means[3])
    if stays:
        assert_same_bits(steps[1].means[3], steps[0].means[3])
    for before, after in zip(good, steps, strict=True):
        assert_finite(after)
        other = rows_of_scene(after, 1)
        assert_same_bits(after.means[other], before.means[other])
    sentinels = report.statistics
    assert sentinels[0, 2].awake - sentinels[0, 3].awake == 1
    assert sentinels[1, 4].awake == sentinels[1, 3].awake


def test_leaving_workspace_is_no_error(simulator, state):
    report = StabilityReport()
    far = with_value(state, "means", -1, 1e6)
    steps = simulator.rollout(far, 2, report=report)  # on_invalid is "raise"
    report.check()
    assert [(f.what, f.action, f.count) for f in report.findings] == [("outside the workspace", "asleep", 1)]
    assert_same_bits(steps[-1].means[-1], far.means[-1])


def test_clamp_keeps_workspace_and_speed_limit(simulator, state):
    kick_row(simulator, 3, 1, torch.tensor([50.0, -1e9, 0.0], device=state.means.device))
    simulator.config = dataclasses.replace(simulator.config, stability=StabilityConfig("clamp", max_speed=2.0))
    with torch.no_grad():
        step = simulator.rollout(state, 1)[0]
    newest = last_steps(state, 1)
    assert float((step.means - newest.means).double().norm(dim=1)[3]) <= 2.0 * (1 + 1e-6)
    inside = (step.means.double() - state.origin[0]) / CONFIG.dynamics.grid_size
    assert bool(((inside >= 0) & (inside < 2**16)).all()) and not bool((step.activity == ASLEEP).any())


def test_valid_state_is_unchanged(simulator, state):
    report = StabilityReport()
    with torch.no_grad():
        for on_invalid in ("raise", "drop", "clamp"):
            step = simulator.rollout(state, 1, on_invalid=on_invalid, report=report)[0]
            assert_same_bits(step.means, simulator.dynamics(state).means)
    assert report.total == 0 and str(report).startswith("nothing was")
    assert sorted(report.statistics) == [(0, 2), (1, 3)]


def test_statistics_match_sums(simulator, state):
    report = StabilityReport()
    with torch.no_grad():
        step = simulator.rollout(state, 1, report=report)[0]
    newest, rows = last_steps(state, 1), rows_of_scene(step, 1)
    now, before = step.means[rows].double(), newest.means[rows].double()
    sums = report.statistics[1, 3]
    assert sums.awake == int(rows.sum())
    assert sums.kinetic_energy == pytest.approx(float((now - before).square().sum() / 2), rel=1e-9)
    assert sums.opacity_mass == pytest.approx(float(step.opacities[rows].double().sum()), rel=1e-9)
    assert sums.extent == pytest.approx(float((now.amax(0) - now.amin(0)).norm()), rel=1e-9)


def test_default_policy_is_the_model_s(simulator, state):
    bad = with_value(state, "opacities", 0, -0.5)
    simulator.config = dataclasses.replace(simulator.config, stability=StabilityConfig("drop"))
    simulator.step(bad)
    assert simulator.report.total == 1
    with pytest.raises(NumericalError):
        simulator.step(bad, on_invalid="raise")
        simulator.report.check()
    simulator.report.clear()
    assert simulator.report.total == 0


def test_error_is_raised_once(simulator, state):
    """The next good call on the same report does not fail for the bad one; check() still tells."""
    with pytest.raises(NumericalError):
        simulator.step(with_value(state, "opacities", 0, -0.5))
        simulator.report.findings  # a GPU: waits for the flag
        simulator.step(state)
    simulator.step(state)
    with pytest.raises(NumericalError):
        simulator.report.check()


def test_validation_does_not_synchronize(devices):
    simulator = make_simulator().to(devices[1])
    with torch.no_grad():
        state = simulator.encode(make_frames(SCENES).to(devices[1]))
        guard = simulator._guard("rollout", None, StabilityReport())
        newest = last_steps(state, 1)
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")
        try:
            guard(state)
            guard(newest, previous=newest)
        finally:
            torch.cuda.set_sync_debug_mode("default")


def test_captured_validation_counts_every_replay(devices):
    simulator = make_simulator().to(devices[1])
    with torch.no_grad():
        state = last_steps(simulator.encode(make_frames(SCENES).to(devices[1])), 1)
        report = StabilityReport()
        guard = simulator._guard("rollout", "drop", report)
        guard(state, previous=state)
        report.clear()
        moved = dataclasses.replace(state, means=state.means.clone())
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            out = guard(moved, previous=state)
        assert report.total == 0
        for count in (1, 2):
            moved.means[count] = NAN
            graph.replay()
            report.replayed()
            assert int((out.activity == ASLEEP).sum()) == count
    assert report.total == 1 + 2 and report.findings[0].what == "not finite"


def test_validation_compiles():
    simulator = make_simulator()
    with torch.no_grad():
        state = last_steps(simulator.encode(make_frames(SCENES)), 1)
        guard = simulator._guard("rollout", "drop", StabilityReport())

        def f(means):
            mended = guard(dataclasses.replace(state, means=means), previous=state)
            return mended.means, mended.opacities, mended.activity

        bad = with_value(state, "means", 1, NAN).means
        for a, b in zip(torch.compile(f, fullgraph=True)(bad), f(bad), strict=True):
            assert_same_bits(a, b)


def spoiled_frames(device, value=NAN):
    """Two scenes; one pixel of the last image of the first step of scene 0, which becomes a particle, is no number."""
    frames = make_frames(SCENES)
    kept = frames.masks[1].nonzero()[3]
    images = frames.images.clone()
    images[1, 1, kept[0], kept[1]] = value
    row = int(frames.masks[0].sum()) + 3
    return dataclasses.replace(frames, images=images).to(device), row


def test_invalid_pixel(simulator, device):
    frames, row = spoiled_frames(device)
    with pytest.raises(
        NumericalError, match=r"images must be finite; image 1 \(scene 0, step 0\) is not; on_invalid=\"drop\""
    ) as caught:
        simulator.encode(frames)
    assert (caught.value.tensor, caught.value.camera) == ("images", 1)
    black = dataclasses.replace(frames, images=frames.images.nan_to_num(0.0))
    with torch.no_grad():
        expected = simulator.encode(black)
        report = StabilityReport()
        dropped = simulator.encode(frames, on_invalid="drop", report=report)
        clamped = simulator.encode(frames, on_invalid="clamp", report=report)
    assert [(f.tensor, f.action, f.count, f.scene, f.step, f.camera) for f in report.findings] == [
        ("frames.images", action, 1, 0, 0, 1) for action in ("dropped", "clamped")
    ]
    assert_same_bits(clamped.dynamic_latents, expected.dynamic_latents)
    assert_same_bits(clamped.activity, expected.activity)
    assert_same_bits(dropped.means, expected.means)
    assert (dropped.activity == ASLEEP).nonzero()[:, 0].tolist() == [row] and float(dropped.opacities[row]) == 0


@pytest.mark.parametrize("on_invalid", ["drop", "clamp"])
def test_gradients_of_invalid_pixels_are_finite(simulator, device, on_invalid):
    frames, _ = spoiled_frames(device, INF)
    images = frames.images.clone().requires_grad_()
    particles = simulator.encode(dataclasses.replace(frames, images=images), on_invalid=on_invalid)
    total = sum(value.float().sum() for name, value in particles.row_fields().items() if name != "activity")
    for grad in torch.autograd.grad(total, [images, *simulator.encoder.parameters()], allow_unused=True):
        assert grad is None or bool(torch.isfinite(grad).all())


@pytest.mark.parametrize("on_invalid", ["raise", "drop", "clamp"])
def test_invalid_camera_raises_under_every_policy(simulator, device, on_invalid):
    frames = make_frames((1,)).to(device)
    near = frames.cameras.near.clone()
    near[1] = 0
    frames = dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, near=near))
    with pytest.raises(
        NumericalError, match="cameras.near must be positive; image 1 .*; mend its calibration"
    ) as caught:
        simulator.encode(frames, on_invalid=on_invalid)
    assert (caught.value.tensor, caught.value.camera, caught.value.scene) == ("cameras.near", 1, 0)


# ---- the report ------------------------------------------------------------------------------------------------------


def test_report_formats_and_clear(simulator, state):
    report = StabilityReport()
    simulator.step(with_value(state, "opacities", slice(0, 3), 2.0), on_invalid="drop", report=report)
    header, line, total = str(report).splitlines()
    assert header.split() == ["where", "tensor", "what", "action", "scene", "step", "camera", "row", "count"]
    assert line.split() == ["step", "particles.opacities", "outside", "[0,", "1]", "dropped", "0", "0", "-", "0", "3"]
    assert total == "total 3"
    assert report.to_dict()["findings"][0]["count"] == report.to_dict()["total"] == 3
    report.clear()
    assert report.findings == () and report.statistics == {}


def replayed(*records):
    """A report that got the records (numbers, counts) of a replay, and the list of those that it has read."""
    source, target, seen = StabilityReport(), StabilityReport(), []

    def read(numbers, place):
        seen.append(numbers)
        return Reading([], {(0, place): Statistics(place, 0.0, 0.0, 0.0)})

    source._captured = [
        _Record(numbers, partial(read, place=place), counts) for place, (numbers, counts) in enumerate(records)
    ]
    source.replayed(target, pack(source.captured()).clone())
    return target, seen


def test_records_are_copied_together():
    generator = torch.Generator().manual_seed(0)
    counts, sums = torch.arange(6).reshape(3, 2), torch.randn(2, 5, generator=generator, dtype=torch.float64)
    sums[1, 2] = INF
    for records in ([counts, sums, torch.empty(0, 2, dtype=torch.int64), -counts], [sums]):
        report, seen = replayed(*((numbers, ()) for numbers in records))
        assert report.total == 0
        for a, b in zip(seen, records, strict=True):
            assert_same_bits(a, b)


def test_quiet_records_are_read_lazily():
    bad = torch.tensor([[0.0, 7.0], [2.0, 8.0]], dtype=torch.float64)
    good = bad * torch.tensor([0.0, 1.0], dtype=torch.float64)
    report, seen = replayed((good, (0, 2)), (good + 1, ()))
    assert report.total == 0
    assert len(seen) == 2  # in the order in which they came
    report, seen = replayed((good, (0, 2)), (good, (0, 2)))
    assert report.total == 0 and not seen
    assert report.statistics == {(0, place): Statistics(place, 0.0, 0.0, 0.0) for place in (0, 1)}
    assert_same_bits(seen[1], good)
    report, seen = replayed((bad, (0, 2)), (good, (0, 2)))
    assert report.total == 0
    assert len(seen) == 1
    assert_same_bits(seen[0], bad)


def test_draw_matches_render(simulator, state):
    report = StabilityReport()
    with torch.no_grad():
        (step,) = simulator.rollout(with_value(state, "means", 1, NAN), 1, on_invalid="drop", report=report)
        found = report.total
        cameras = make_frames(SCENES).cameras
        cameras = dataclasses.replace(cameras, image_cloud=cameras.image_cloud % len(SCENES)).to(step.means.device)
        drawn = simulator._draw(step, cameras, on_invalid="drop", report=report)
        rendered = simulator.render(step, cameras, on_invalid="drop", report=report)
    assert_same_bits(drawn.color, rendered.color)
    assert found == report.total > 0 and float(drawn.alpha.max()) > 0


def test_copied_model_has_own_report(simulator, state):
    simulator.step(with_value(state, "opacities", 0, 2.0), on_invalid="drop")
    other = copy.deepcopy(simulator)
    assert other.report is not simulator.report and other.report.total == 0 and simulator.report.total == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StabilityConfig("ignore"), "on_invalid must be one of raise, drop, clamp; got 'ignore'"),
        (lambda: StabilityConfig(max_speed=0.0), "max_speed must be positive and finite"),
        (lambda: StabilityConfig(max_latent=INF), "max_latent must be positive and finite"),
        (lambda: make_simulator().step(None, on_invalid="sleep"), "on_invalid must be one of"),
    ],
)
def test_config_refuses_invalid_policy_and_limits(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_every_preset_has_the_default_policy():
    for preset in (presets.tiny, presets.small, presets.paper_latent, presets.paper_explicit):
        assert preset().stability == StabilityConfig() and preset().stability.on_invalid == "raise"


def test_raster_finding_names_camera():
    frames = make_frames((1,))
    n = 3
    means = torch.zeros(n, 3)
    arguments = means, torch.tensor([[1.0, 0, 0, 0]] * n), torch.full((n, 3), 0.1), torch.tensor([0.5, NAN, 0.5])
    cameras = frames.cameras.select(torch.tensor([0, 1]), torch.tensor([0, 0]))
    with pytest.raises(NumericalError, match=r"opacities: outside \[0, 1\] at row 1 \(camera 0\)") as caught:
        rasterize_gaussians(*arguments, cameras, colors=torch.ones(n, 3))
    assert (caught.value.camera, caught.value.row) == (0, 1)


def test_error_counts_its_own_call():
    """One report of several calls: what earlier ones found is neither in the message nor in its count."""
    report, finding = StabilityReport(), Finding("not finite", "rollout", "means", "error", 1, row=4, scene=0, step=2)
    for row, count in ((4, 1), (7, 1), (1, 3), (4, 1)):
        report.add(dataclasses.replace(finding, row=row, count=count))
        with pytest.raises(NumericalError) as error:
            report.poll()
        more = f" and {count - 1} more" if count > 1 else ""
        assert str(error.value).startswith(f"rollout: means: not finite at row {row} (scene 0, step 2){more};")
        assert error.value.row == row
    assert [found.count for found in report.findings] == [6] and report.total == 6
    for _ in range(2):
        with pytest.raises(NumericalError, match=r"at row 4 \(scene 0, step 2\);"):
            report.check()
    report.clear()
    report.check()


@pytest.mark.parametrize("calls", [1, 3])
def test_op_findings_count_every_call(calls):
    report, bad = StabilityReport(), torch.tensor([[0.0, 0, 3], [torch.nan, 0, 4], [0, torch.inf, 4]])
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], K, torch.ones(1), torch.full((1,), 9.0), torch.tensor([0]), 64, 48)
    arguments = (torch.tensor([[1.0, 0, 0, 0]] * 3), torch.full((3, 3), 0.2), torch.full((3,), 0.9), cameras)
    for _ in range(calls):
        with pytest.raises(NumericalError, match="at row 1 .* and 1 more;"):
            rasterize_gaussians(bad, *arguments, colors=torch.eye(3), report=report)
