"""Sweeps: errors against reference and video, failures, rounds of timings, and continuation."""

import dataclasses

import pytest
import torch

from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.errors import CaptureError, NumericalError
from gsim3d.evaluate.perceptual.fvd import frechet_distance
from gsim3d.evaluate.protocol import predict, render_steps
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.numerics.speed import Setting
from gsim3d.profile import sweep as sweeping
from gsim3d.profile.settings import Runner
from gsim3d.profile.sweep import (
    NO_TIME,
    Agreement,
    BenchmarkCase,
    Effort,
    Point,
    Stepping,
    Sweep,
    TimeLimit,
    front,
    tie,
)  # fmt: skip
from gsim3d.profile.timing import DeviceClock, Timing

pytestmark = pytest.mark.usefixtures("one_thread")
SHORT = Effort(n_rounds=2, repeats=2, warm_up=0)


def points_of(sweep, *settings):
    return [sweep.point(setting, "", "model") for setting in settings]


def timed(seconds, psnr, failure=""):
    """A point with a given step time and agreement PSNR."""
    return Point(Setting(), "", "exact", failure, Agreement(psnr, None), step=(Timing((seconds,)),))


def compared(case, setting):
    point = Point(setting, "", "model")
    case.compare(point)
    return point


def test_reference_matches_evaluate(case):
    scene, (context, targets) = case.scenes[0], case.views[0]
    prediction = predict(case.restored, scene, context, case.n_steps)
    expected = render_steps(case.restored, prediction.particles, scene, targets)[prediction.n_encoded :]
    torch.testing.assert_close(case.predict(Setting(), 0).images, expected, rtol=0, atol=1e-6)


def test_reference_agrees_with_itself(case):
    point = compared(case, Setting())
    assert point.agreement == Agreement(100.0, 0.0)
    assert set(point.task) == {"psnr", "psnr_masked", "psnr_body", "psnr_ground", "psnr_ring", "ssim"}
    assert len(point.by_step["psnr"]) == case.n_steps
    gains = [ours - constant for ours, constant in zip(point.by_step["psnr_masked"], case.constant["psnr_masked"])]
    assert case.gain(point) == pytest.approx(sum(gains) / len(gains)) and case.share_kept(point, point) == 1


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
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_settings_change_the_prediction(case, setting, known):
    agreement = compared(case, setting).agreement
    assert 5 < agreement.psnr < 100
    if not known:
        assert agreement.position_max is None  # other particles
    elif setting.cutoff != "exact":
        assert agreement.position_max == 0
    else:
        assert agreement.position_max > 0


def test_failures_name_step_and_memory(case, monkeypatch):
    steps = Runner.steps

    def spoiled(self, *args):
        found = steps(self, *args)
        found[1] = dataclasses.replace(found[1], means=found[1].means * torch.nan)
        return found

    monkeypatch.setattr(Runner, "steps", spoiled)
    with pytest.raises(NumericalError, match="particles are not finite at step 2"):
        case.predict(Setting(history=1), 0)

    def full(self, *args):
        raise torch.OutOfMemoryError("too large")

    monkeypatch.setattr(Runner, "steps", full)
    sweep = Sweep(case, SHORT)
    points = points_of(sweep, Setting(history=1))
    case.__dict__["reference"] = case.reference
    sweep.run(points)
    assert points[0].failure == "out of memory" and not points[0].step


def test_fvd_uses_clips_of_all_scenes(case, monkeypatch):
    """The distance is over the clips of all scenes (with fake features)."""

    def features(clips):
        return clips.double().mean((2, 3)).flatten(1)[:, :6]

    monkeypatch.setattr("gsim3d.evaluate.perceptual.fvd.MIN_FRAMES", 2)
    monkeypatch.setattr("gsim3d.evaluate.perceptual.fvd.clip_features", features)
    with_fvd = BenchmarkCase(case.restored, case.scenes, metrics=("psnr", "fvd"))
    point = compared(with_fvd, Setting())
    sides = [[truth.images for truth in with_fvd.truths], [rollout.images for rollout in with_fvd.reference]]
    expected = frechet_distance(*(torch.cat([features(images.transpose(0, 1)) for images in side]) for side in sides))
    assert point.task["fvd"] == pytest.approx(expected) and "fvd" not in point.by_step


def test_rounds_are_shuffled(case):
    said = []
    sweep = Sweep(case, Effort(n_rounds=3, repeats=2, warm_up=0), progress=said.append)
    points = points_of(sweep, Setting(), Setting(history=1), Setting(kept=0.5))
    sweep.run(points)
    assert [line.split(": ")[0] for line in said[:3]] == ["errors"] * 3  # errors are measured before times
    rounds = [[line.split(": ")[1] for line in said[3 + 3 * n : 6 + 3 * n]] for n in range(3)]
    assert len({tuple(r) for r in rounds}) > 1 and all(sorted(r) == sorted(rounds[0]) for r in rounds)
    assert points[0].encode is not points[1].encode and points[0].encode[0] is points[2].encode[0]  # two inputs
    for point in points:
        assert len(point.step) == len(point.encode) == 3
        assert all(len(timing.repeats) == 2 for timing in point.step)
        assert {"convolution", "attention", "serialise", "dense layers"} <= set(point.sections())
        assert sum(point.sections().values()) == pytest.approx(point.step_seconds, rel=0.5)


def test_front_is_the_pareto_front():
    a, b, c, d = timed(1.0, 20.0), timed(2.0, 50.0), timed(3.0, 40.0), timed(0.5, 60.0, failure="out of memory")
    assert front([a, b, c, d], lambda p: -p.agreement.psnr) == [a, b]


def test_tie_within_spread():
    a, b = timed(1.0, 20.0), timed(1.1, 20.0)
    a.step += (Timing((1.2,)),)  # rounds of a are 0.2 s apart
    assert tie(a, b) and not tie(timed(1.0, 20.0), timed(1.5, 20.0))
    single = timed(1.0, 20.0)
    single.step = (Timing((1.0, 1.0, 1.2, 1.2)),)  # of a single round its halves tell
    assert single.spread == pytest.approx(0.2) and tie(single, timed(1.15, 20.0))


def test_case_n_steps(case):
    assert BenchmarkCase(case.restored, case.scenes, 2).n_steps == 2
    assert case.n_steps == case.scenes[0].n_steps - 2


def test_time_limit_skips_later_settings(case):
    """The reference and one round are always measured."""
    seconds = iter([0.0, 0.1, 0.1, *[50.0] * 100])
    sweep = Sweep(case, Effort(n_rounds=3, repeats=2, warm_up=0), TimeLimit(100.0, lambda: next(seconds)))
    points = points_of(sweep, Setting(), Setting(kept=0.5), Setting(grid=2.0))
    sweep.run(points)
    assert [point.failure for point in points] == ["", "", NO_TIME]
    assert len(points[0].step) == len(points[1].step) >= 1 and not points[2].step


def test_interrupted_sweep_continues(case, tmp_path, monkeypatch):
    """Saved results are reused, unless the conditions differ."""
    restored = dataclasses.replace(case.restored, checkpoint=Checkpoint({}, {}, digest="1f"))
    case, file, calls = BenchmarkCase(restored, case.scenes), tmp_path / "measured.json", []
    timing, compare = Sweep._timing, BenchmarkCase.compare

    def ended(self, point):
        calls.append(point.setting)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return timing(self, point)

    monkeypatch.setattr(Sweep, "_timing", ended)
    sweep = Sweep(case, SHORT, file=file)
    with pytest.raises(KeyboardInterrupt):
        sweep.run(points_of(sweep, Setting(), Setting(history=1)))
    assert file.is_file()
    monkeypatch.setattr(BenchmarkCase, "compare", lambda self, point: pytest.fail("compared again"))
    again = Sweep(case, SHORT, file=file)
    points = points_of(again, Setting(), Setting(history=1))
    again.run(points)
    assert len(calls) == 3 + 2 and [len(point.step) for point in points] == [2, 2]  # the first round was kept
    assert points[1].agreement.psnr < 100
    monkeypatch.setattr(BenchmarkCase, "compare", compare)
    other = Sweep(case, dataclasses.replace(SHORT, repeats=3), file=file)
    assert not other.point(Setting(), "", "exact").step
    file.write_text("[1]")
    assert not Sweep(case, SHORT, file=file).point(Setting(), "", "exact").step


GRAPHS = [
    Setting(captured=True, kept=0.5),
    Setting(captured=True, cutoff="tile3sigma"),
]


@pytest.mark.parametrize("setting", [Setting(captured=True), *GRAPHS], ids=lambda setting: setting.name)
def test_captured_setting_matches_uncaptured(case, setting):
    clock, plain = DeviceClock(case.device), dataclasses.replace(setting, captured=False)
    stepping = Stepping(case, setting, clock)
    stepping()
    rendered = stepping._graph(stepping.state)
    runner = case.runner(plain)
    expected = runner.steps(case.start(runner, [0]), stepping.span)
    assert stepping.span == len(rendered.steps) == 4 and stepping.capture_seconds > 0
    for ours, right in zip(rendered.steps, expected, strict=True):
        torch.testing.assert_close(ours.means, right.means, rtol=0, atol=1e-5)
    image = runner.images(rendered.steps[0], case.cameras([0], 0))
    torch.testing.assert_close(rendered.renderings[0].color.clamp(0, 1), image, rtol=0, atol=1e-5)


def test_sections_of_graph_give_host_gaps(case):
    """Only uncaptured settings have host gaps."""
    whole, sweep = Timing((5.0, 5.0)), Sweep(case)
    launched = sweep.sections_of_graph(Setting(), whole)
    assert sum(launched.values()) == pytest.approx(5.0) and launched["host gaps"] > 1.0
    assert {"convolution", "sort and raster"} <= set(launched)
    assert "host gaps" not in sweep.sections_of_graph(Setting(captured=True), whole)


def test_batch_images_match_single_scenes(case):
    runner = case.runner()
    images = runner.images(runner.steps(case.start(runner, [0, 1]), 1)[0], case.cameras([0, 1], 0))
    for number in range(2):
        newest = runner.steps(case.start(runner, [number]), 1)[0]
        alone = runner.images(newest, case.cameras([number], 0))
        torch.testing.assert_close(images[number : number + 1], alone, rtol=0, atol=1e-5)


def test_throughput_counts_all_scenes_and_steps(case, monkeypatch):
    sweep, replays, call = Sweep(case, SHORT), [], CapturedRollout.__call__

    def counted(self, state, cameras=None):
        replays.append((len(state.clouds.scenes), self._n_steps))
        return call(self, state, cameras)

    monkeypatch.setattr(CapturedRollout, "__call__", counted)
    assert sweep.throughput(timed(1.0, 20.0), 3)["steps_a_second"] > 0 and not replays
    captured = sweep.point(Setting(captured=True), "", "exact")
    assert sweep.throughput(captured, 3)["steps_a_second"] > 0
    assert replays == [(3 * case.restored.data.history, 4)] * 2

    def fails(*args, **options):
        raise CaptureError("Captured: no")

    monkeypatch.setattr(Runner, "captured", fails)
    assert sweep.throughput(captured, 4)["problem"] == "Captured: no"
    monkeypatch.setattr(sweeping.Stepping, "_run", lambda self: (_ for _ in ()).throw(torch.OutOfMemoryError("")))
    assert sweep.throughput(timed(1.0, 20.0), 4)["problem"] == "out of memory"
