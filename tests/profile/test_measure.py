"""Errors against the reference and the truth, settings that fail, and what is on the front."""

import dataclasses
import signal
import time

import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.fvd import frechet_distance
from gsim3d.evaluate.protocol import predict as predict_plainly
from gsim3d.evaluate.protocol import render_steps
from gsim3d.profile import measure
from gsim3d.profile.limit import LEFT_OUT, TimeLimit
from gsim3d.profile.measure import Comparison, Effort, Point, compare, front, time_encodings, time_points
from gsim3d.profile.predict import Unusable, predict
from gsim3d.profile.runner import Runner
from gsim3d.profile.settings import Setting
from gsim3d.profile.stepping import Stepping
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import DeviceClock, Timing
from tests.profile.fakes import TickingClock

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def comparison(subject):
    return Comparison(subject)


def timed(seconds, error, failure=""):
    """A point of known time and error (PSNR against the reference)."""
    agreement = measure.Agreement(error, error, None, None)
    return Point(Setting(), "", "exact", failure, agreement, step=[Timing((seconds,))])


def test_the_reference_is_what_simulate_predicts(subject):
    scene, (context, targets) = subject.scenes[0], subject.views[0]
    prediction = predict_plainly(subject.restored, scene, context, subject.n_steps)
    expected = render_steps(subject.restored, prediction.particles, scene, targets)[prediction.n_encoded :]
    ours = predict(subject, subject.runner(), 0)
    torch.testing.assert_close(ours.images, expected, rtol=0, atol=1e-6)


def test_the_reference_agrees_with_itself(comparison):
    found = comparison.of(Setting())
    task, by_step = found.task, found.by_step
    assert found.agreement == measure.Agreement(100.0, 100.0, 0.0, 0.0)
    assert set(task) == {"psnr", "psnr_masked", "psnr_body", "psnr_ground", "psnr_ring", "ssim"}
    assert len(by_step["psnr"]) == comparison.subject.n_steps
    gains = [ours - constant for ours, constant in zip(by_step["psnr_masked"], comparison.constant["psnr_masked"])]
    assert comparison.gain(by_step) == pytest.approx(sum(gains) / len(gains))


def test_float64_finds_the_same_as_the_reference(subject):
    """The reference itself is validated by a run in double precision."""
    restored = subject.restored
    state = subject.start(subject.runner(), 0)
    double = dataclasses.replace(restored, simulator=_doubled(restored.simulator))
    wide = state.map(lambda t: t.double() if t.is_floating_point() else t)
    ours, exact = subject.runner(), Runner(double)
    cell = restored.simulator.config.dynamics.grid_size
    for _ in range(subject.n_steps):
        state, wide = ours.step(state), exact.step(wide)
        apart = (ours.newest(state).means.double() - exact.newest(wide).means).norm(dim=1) / cell
        assert float(apart.max()) < 1e-3


def _doubled(simulator):
    import copy

    return copy.deepcopy(simulator).double()


@pytest.mark.parametrize(
    ("setting", "known"),
    [
        (Setting(history=1), True),
        (Setting(patch_size=32), True),
        (Setting(cutoff="tile3sigma"), True),
        (Setting(grid=2.0), True),
        (Setting(context_views=1), False),
        (Setting(kept=0.5), False),
        (Setting(background="masked_out"), True),
        (Setting(shrink=2), True),
    ],
)
def test_a_turned_knob_changes_what_it_should(comparison, setting, known):
    agreement = comparison.of(setting).agreement
    assert 5 < agreement.psnr < 100
    assert agreement.psnr_worst <= agreement.psnr
    if not known:
        assert agreement.position_max is None
    elif setting.cutoff != "exact" or setting.shrink != 1:
        assert agreement.position_max == 0
    else:
        assert agreement.position_max > 0


def test_images_that_are_left_out_cost_no_agreement(comparison):
    found = comparison.of(Setting(every=3))
    agreement, by_step = found.agreement, found.by_step
    assert agreement.psnr == 100
    assert len(by_step["psnr"]) == -(-comparison.subject.n_steps // 3)
    whole = comparison.of(Setting()).by_step
    assert by_step["psnr"] == whole["psnr"][::3]
    assert comparison.gain(by_step, 3) is not None


def test_the_most_opaque_particles_are_kept(subject):
    all_of_them = subject.start(subject.runner(), 0)
    kept = subject.start(subject.runner(Setting(kept=0.25)), 0)
    for cloud in range(all_of_them.n_clouds):
        for activity in (0, 1):
            here = (all_of_them.row_cloud() == cloud) & (all_of_them.activity == activity)
            there = (kept.row_cloud() == cloud) & (kept.activity == activity)
            assert int(there.sum()) == -(-int(here.sum()) // 4)
            if there.any():
                least = kept.opacities[there].min()
                assert int((all_of_them.opacities[here] > least).sum()) < int(there.sum()) + 1


def test_a_run_that_is_not_finite_says_at_which_step(subject, monkeypatch):
    runner, step = subject.runner(), Runner.step
    calls = []

    def spoiled(self, state):
        calls.append(1)
        state = step(self, state)
        return dataclasses.replace(state, means=state.means * torch.nan) if len(calls) == 2 else state

    monkeypatch.setattr(Runner, "step", spoiled)
    with pytest.raises(Unusable, match="particles are not finite at step 2"):
        predict(subject, runner, 0)


def test_a_run_without_memory_is_drawn_as_failed(subject, monkeypatch):
    def full(self, state):
        raise torch.OutOfMemoryError("too large")

    monkeypatch.setattr(Runner, "step", full)
    points = [Point(Setting(history=1), "history", "model")]
    comparison = Comparison(subject)
    comparison.__dict__["reference"] = [None, None]  # not made: the only setting fails before it is needed
    compare(comparison, points)
    assert points[0].failure == "out of memory at step 1"


def test_rounds_are_timed_in_another_order_each(subject):
    points = [
        Point(Setting(), "", "exact"),
        Point(Setting(history=1), "", "model"),
        Point(Setting(kept=0.5), "", "model"),
    ]
    told = []
    effort = Effort(n_rounds=3, repeats=2, warm_up=0)
    time_points(subject, points, DeviceClock("cpu"), effort, progress=told.append)
    rounds = [[name.split(": ")[1] for name in told[3 * n : 3 * n + 3]] for n in range(3)]
    assert len({tuple(r) for r in rounds}) > 1 and all(sorted(r) == sorted(rounds[0]) for r in rounds)
    time_encodings(subject, points, DeviceClock("cpu"), effort)
    assert points[0].encode is points[2].encode and points[0].encode is not points[1].encode  # two inputs
    for point in points:
        assert len(point.step) == len(point.encode) == 3
        assert all(len(timing.repeats) == 2 for timing in point.step)
        assert {"convolution", "attention", "serialise", "dense layers"} <= set(point.stages())
        assert point.peak > 0


def test_steps_are_timed_on_the_way(subject):
    """The reference three times, the others once; what is drawn otherwise only shares the simulation's time."""
    settings = [Setting(), Setting(shrink=2), Setting(every=2), Setting(kept=0.1), Setting(sleep=1e-9)]
    points = [Point(setting, "", "model") for setting in settings]
    effort, clock, told = Effort(apart=False, warm_up=1, repeats=2, n_rounds=1), TickingClock(), []
    comparison = Comparison(subject, clock=clock)
    measure.measure(comparison, points, clock, effort, told.append)
    assert len(told) == measure.n_runs(points, effort)
    n_all = subject.n_steps * len(subject.scenes)
    assert [len(point.step) for point in points] == [3, 1, 1, 1, 1]
    assert [len(point.step[0].repeats) for point in points] == [n_all - 1, n_all - 1, n_all // 2 - 1, n_all - 1, 2]
    assert points[0].noise == comparison.noise and points[1].spread >= comparison.noise * points[1].step_seconds
    for point in points:
        assert {"convolution", "sort and raster"} <= set(point.stages())
        assert sum(point.stages().values()) == pytest.approx(point.step_seconds, rel=0.05)


def test_drawing_together_is_drawing_alone(subject):
    settings = [Setting(), Setting(shrink=2), Setting(cutoff="tile3sigma"), Setting(every=3)]
    together = Comparison(subject).of_all(settings)
    for setting, found in zip(settings, together, strict=True):
        alone = Comparison(subject).of(setting)
        assert (alone.agreement, alone.by_step) == (found.agreement, found.by_step)


def test_a_failure_to_draw_leaves_the_others(subject, monkeypatch):
    images = Runner.images

    def full(self, particles, cameras):
        if self.setting.shrink == 2:
            raise torch.OutOfMemoryError("too large")
        return images(self, particles, cameras)

    monkeypatch.setattr(Runner, "images", full)
    points = [
        Point(Setting(), "", "exact"),
        Point(Setting(shrink=2), "", "exact"),
        Point(Setting(every=2), "", "exact"),
    ]
    compare(Comparison(subject), points)
    assert [point.failure for point in points] == ["", "out of memory at step 1", ""]


def test_fvd_is_of_all_clips(subject, monkeypatch):
    """One distance between the clips of all scenes; the features are made up."""
    monkeypatch.setattr("gsim3d.evaluate.perceptual.fvd.MIN_FRAMES", 2)
    monkeypatch.setattr(
        "gsim3d.evaluate.perceptual.fvd.clip_features", lambda clips: clips.double().mean((2, 3)).flatten(1)[:, :6]
    )
    comparison = Comparison(subject, ("psnr", "fvd"))
    task = comparison.of(Setting()).task
    truth = [subject.truth(n, range(subject.n_steps))[0] for n in range(2)]
    features = [images.transpose(0, 1).double().mean((2, 3)).flatten(1)[:, :6] for images in truth]
    ours = [p.images.transpose(0, 1).double().mean((2, 3)).flatten(1)[:, :6] for p in comparison.reference]
    assert task["fvd"] == pytest.approx(frechet_distance(torch.cat(features), torch.cat(ours)))
    assert "fvd" not in comparison.of(Setting()).by_step


def test_the_front_holds_what_nothing_beats():
    a, b, c, d = timed(1.0, 20.0), timed(2.0, 50.0), timed(3.0, 40.0), timed(0.5, 60.0, failure="out of memory")
    assert front([a, b, c, d], measure.disagreement) == [a, b]


def test_near_times_are_a_tie():
    a, b = timed(1.0, 20.0), timed(1.1, 20.0)
    a.step.append(Timing((1.2,)))  # rounds of a are 0.2 s apart
    assert measure.ties(a, b)
    assert not measure.ties(timed(1.0, 20.0), timed(1.5, 20.0))
    single = timed(1.0, 20.0)
    single.step = [Timing((1.0, 1.0, 1.2, 1.2))]  # without another round its halves tell
    assert single.spread == pytest.approx(0.2) and measure.ties(single, timed(1.15, 20.0))


def test_a_wrong_setting_is_told():
    for values, what in [
        ({"encoder": "fp8"}, "encoder"),
        ({"kept": 0}, "kept"),
        ({"every": 0}, "every"),
        ({"no": 1}, "no"),
        ({"kept": "half"}, "kept must be a number"),
        ({"captured": 1}, "captured must be true or false"),
        ({"sh_degree": "x"}, "sh_degree"),
        ([1], "must be a mapping"),
    ]:
        with pytest.raises(InputError, match=f"setting: .*{what}"):
            Setting.from_dict(values)


def test_a_subject_is_as_short_as_asked(subject):
    assert Subject(subject.restored, subject.scenes, 2).n_steps == 2
    assert subject.n_steps == subject.scenes[0].n_steps - 2


GRAPHS = [
    Setting(captured=True),
    Setting(captured=True, kept=0.5),
    Setting(captured=True, cutoff="tile3sigma"),
    Setting(captured=True, every=3),
    Setting(captured=True, shrink=2),
]


def launched_images(subject, setting, particles):
    return subject.runner(dataclasses.replace(setting, captured=False)).images(particles, subject.cameras(0, 0))


@pytest.mark.parametrize("setting", GRAPHS, ids=lambda setting: setting.name)
def test_what_is_replayed_is_what_the_setting_says(subject, setting, monkeypatch):
    """Drawn by the graph where it can, else behind it: as many images of the same particles as without one."""
    drawn = []
    monkeypatch.setattr(Runner, "images", lambda self, particles, cameras: drawn.append(particles.means.clone()))
    stepping = Stepping(subject, setting, DeviceClock("cpu"))
    stepping()
    launched = Stepping(subject, dataclasses.replace(setting, captured=False), DeviceClock("cpu"), span=stepping.span)
    runner = launched.runner
    if stepping.runner.draws_in_graph:
        assert not drawn
        rendered = stepping._graph(stepping.state)
        drawn += [step.means for step in rendered.steps]
        assert len(rendered.renderings) == stepping.span == 4
        monkeypatch.undo()
        image, alone = rendered.renderings[0].color, launched_images(subject, setting, rendered.steps[0])
        torch.testing.assert_close(image.clamp(0, 1), alone, rtol=0, atol=1e-5)
    expected = [newest.means for n, newest in enumerate(runner.steps(launched.state, 4)) if n % setting.every == 0]
    assert len(drawn) == len(expected)
    for ours, right in zip(drawn, expected, strict=True):
        torch.testing.assert_close(ours, right, rtol=0, atol=1e-5)


def test_graphs_are_captured_once(subject):
    points = [Point(setting, "", "model") for setting in (Setting(), *GRAPHS[:2])]
    ready = {}
    effort, clock = Effort(n_rounds=1, repeats=2, warm_up=0), DeviceClock("cpu")
    time_points(subject, points, clock, effort, rounds=(0,), ready=ready)
    captured = dict(ready)
    time_points(subject, points, clock, effort, rounds=(1,), ready=ready)
    assert set(captured) == set(GRAPHS[:2]) and all(ready[setting] is captured[setting] for setting in captured)
    assert all(point.once > 0 for point in points[1:]) and points[0].once == 0
    assert [len(point.step) for point in points] == [2, 2, 2]
    assert all(point.stages() for point in points)  # of a graph in its first round


def test_a_time_limit_leaves_out_what_comes_last(subject):
    """The reference and one round are always there, and a round tells what it found."""
    seconds = iter([0.0, *[0.1] * 2, *[50.0] * 100])
    limit = TimeLimit(100.0, lambda: next(seconds))
    points = [
        Point(Setting(), "", "exact"),
        Point(Setting(kept=0.5), "", "model"),
        Point(Setting(grid=2.0), "", "model"),
    ]
    told = []
    measure.measure(
        Comparison(subject), points, DeviceClock("cpu"), Effort(n_rounds=3, repeats=2, warm_up=0), told.append, limit,
        lambda n: told.append(n),
    )  # fmt: skip
    assert [point.failure for point in points] == ["", "", LEFT_OUT]
    assert len(points[0].step) == len(points[1].step) >= 1 and not points[2].step
    assert 1 in told


def test_what_compiles_too_long_is_ended(subject, monkeypatch):
    """With its reason, and the alarm is put back."""
    monkeypatch.setattr("gsim3d.profile.stepping._end_compilers", lambda: None)
    monkeypatch.setattr(measure, "LEAST_COMPILE", 0.1)
    monkeypatch.setattr(Stepping, "__call__", lambda self: time.sleep(60))
    point, before = Point(Setting(compiled=True), "compile", "exact"), signal.getsignal(signal.SIGALRM)
    start = time.monotonic()
    measure._compile(subject, point, DeviceClock("cpu"), 0.2)
    assert time.monotonic() - start < 30 and point.failure == "not compiled after 0.2 s"
    assert signal.getsignal(signal.SIGALRM) is before and signal.getitimer(signal.ITIMER_REAL)[0] == 0
    monkeypatch.setattr(Stepping, "__call__", lambda self: None)
    point.failure = ""
    measure._compile(subject, point, DeviceClock("cpu"), 30.0)
    assert not point.failure and point.once > 0
    measure._compile(subject, point, DeviceClock("cpu"), 0.05)
    assert point.failure == LEFT_OUT


def test_what_the_stages_of_a_graph_leave_are_gaps_of_the_host(subject):
    """Of a setting that is launched; one that is replayed has none, and one that fits no graph has no stages."""
    whole, clock = Timing((5.0, 5.0)), DeviceClock("cpu")
    launched = measure._stages_of_graph(subject, Setting(), clock, whole)
    assert sum(launched.values()) == pytest.approx(5.0) and launched["host gaps"] > 1.0
    assert {"convolution", "sort and raster"} <= set(launched)
    assert "host gaps" not in measure._stages_of_graph(subject, Setting(captured=True), clock, whole)
    assert measure._stages_of_graph(subject, Setting(orders=2), clock, whole) == {}
