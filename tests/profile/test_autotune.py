"""Presets keep what they promise, limits are kept, and what was tuned is found again."""

import dataclasses

import pytest

import gsim3d
from gsim3d.errors import InputError
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.profile import autotune
from gsim3d.profile.limit import TimeLimit
from gsim3d.profile.measure import Agreement, Comparison, Effort, Point, measure
from gsim3d.profile.settings import KNOBS, Setting
from gsim3d.profile.timing import DeviceClock, Timing

pytestmark = pytest.mark.usefixtures("one_thread")
SHORT = Effort(n_rounds=2, repeats=2, warm_up=0)


@pytest.fixture(scope="module")
def comparison(subject):
    return Comparison(subject)


@pytest.fixture(scope="module")
def points(subject, comparison):
    settings = [
        Setting(),
        Setting(history=1),
        Setting(kept=0.5),
        Setting(kept=0.05),
        Setting(every=3),
        Setting(grid=2.0),
    ]
    points = [Point(s, "", "model") for s in settings]
    measure(comparison, points, DeviceClock("cpu"), SHORT)
    return points


def test_every_preset_keeps_its_promise(subject, comparison, points):
    """Verified anew: the tuned setting is run again, and its gain compared with that of the reference."""
    presets = autotune.tune(comparison, points, DeviceClock("cpu"), SHORT)
    assert list(presets) == list(autotune.PROMISES)
    assert presets["exact"].setting == Setting()
    for name, share in (("balanced", 0.999), ("fast", 0.99)):
        every = presets[name].setting.every
        gain = comparison.gain(comparison.of(presets[name].setting).by_step, every)
        reference = {metric: values[::every] for metric, values in points[0].by_step.items()}
        whole = comparison.gain(reference, every)
        assert gain >= whole - (1 - share) * abs(whole)
        assert presets[name].step_seconds <= points[0].step_seconds


def test_a_setting_that_loses_too_much_keeps_no_promise(comparison, points):
    worst = points[3]
    assert not autotune.keeps_gain(comparison, worst, points[0], 0.999)
    assert autotune.keeps_gain(comparison, points[0], points[0], 1.0)


def at(setting, seconds, psnr, other_round=None):
    timings = [Timing((seconds,)), Timing((other_round or seconds,))]
    return Point(setting, "", "model", agreement=Agreement(psnr, psnr, None, None), step=timings)


def test_turns_that_keep_the_promise_are_added_up(subject, comparison, monkeypatch):
    """Two turns that help alone are measured together; one that ties, fails or breaks the promise is not taken."""
    reference = at(Setting(), 10.0, 100.0)
    turns = [
        at(Setting(history=1), 6.0, 60.0),
        at(Setting(grid=2.0), 8.0, 70.0),
        at(Setting(kept=0.1), 2.0, 10.0),
        at(Setting(cutoff="tile3sigma"), 9.9, 90.0, other_round=10.2),
    ]
    turns[2].failure = "out of memory"
    measured = []

    def fill(_, points, *others):
        measured.extend(point.setting for point in points)
        points[0].agreement = Agreement(55.0, 50.0, None, None)
        points[0].step.append(Timing((4.0,)))

    monkeypatch.setattr(autotune, "measure", fill)
    best = autotune.fastest(comparison, [reference, *turns], lambda p: p.agreement.psnr >= 50, None, SHORT)
    assert best.setting == Setting(history=1, grid=2.0)
    assert measured == [Setting(history=1, grid=2.0)]
    again = autotune.fastest(
        comparison, [reference, *turns], lambda p: p.agreement.psnr >= 40, None, SHORT, {best.setting: best}
    )
    assert again is best and len(measured) == 1  # nothing is measured twice


def test_a_turn_must_save_more_than_its_graph_does(comparison, monkeypatch):
    """All that is replayed is faster than the launched reference; what saves nothing beside the graph is not tried."""
    points = [
        at(Setting(), 10.0, 100.0),
        at(Setting(captured=True), 6.0, 100.0),
        at(Setting(captured=True, patch_size=64), 5.9, 60.0, other_round=6.1),
        at(Setting(captured=True, history=1), 4.0, 60.0),
        at(Setting(captured=True, kept=0.5), 5.0, 50.0),
    ]
    measured = []

    def fill(_, points, *others):
        measured.append(points[0].setting)
        points[0].agreement, points[0].step = Agreement(50.0, 50.0, None, None), [Timing((3.0,))]

    monkeypatch.setattr(autotune, "measure", fill)
    best = autotune.fastest(comparison, points, lambda p: True, None, SHORT)
    assert best.setting == Setting(captured=True, history=1, kept=0.5) and measured == [best.setting]
    only = autotune.fastest(comparison, points[:3], lambda p: True, None, SHORT)
    assert only is points[1]


def test_what_ties_with_the_fastest_is_chosen_by_agreement(comparison):
    points = [
        at(Setting(), 10.0, 100.0),
        at(Setting(history=1), 5.0, 40.0, other_round=5.2),
        at(Setting("bf16", "bf16", "bf16", history=1), 5.1, 60.0, other_round=5.3),
    ]
    assert autotune.fastest(comparison, points, lambda p: True, None, SHORT) is points[2]


def test_nothing_is_tried_when_the_time_is_over(comparison, monkeypatch):
    monkeypatch.setattr(autotune, "measure", lambda *args: pytest.fail("measured"))
    points = [at(Setting(), 10.0, 100.0), at(Setting(history=1), 6.0, 60.0), at(Setting(grid=2.0), 8.0, 70.0)]
    over = TimeLimit(1.0, iter([0.0, *[2.0] * 9]).__next__)
    best = autotune.fastest(comparison, points, lambda p: True, None, SHORT, limit=over)
    assert best is points[1]


def test_limits_are_kept(subject):
    few = {"knobs": [knob for knob in KNOBS if knob.name in ("history", "grid size")], "effort": SHORT}
    tuned = gsim3d.autotune(subject, min_agreement_psnr=30.0, **few)
    again = Comparison(subject).of(tuned.setting).agreement
    assert again.psnr >= 30.0
    assert autotune.autotune(subject, max_ms=1e6, **few).setting == Setting()
    with pytest.raises(InputError, match="no setting takes at most 1e-06 ms"):
        autotune.autotune(subject, max_ms=1e-6, **few)
    with pytest.raises(InputError, match="either max_ms or min_agreement_psnr"):
        autotune.autotune(subject)


def test_tuned_presets_are_found_again(tmp_path, subject):
    restored, other = (
        dataclasses.replace(subject.restored, checkpoint=Checkpoint({}, {}, digest=digest)) for digest in ("1f", "2e")
    )
    autotune.save_speeds(tmp_path, restored, {"fast": at(Setting(history=1, kept=0.9), 1.0, 50.0)})
    autotune.save_speeds(tmp_path, other, {"fast": at(Setting(grid=2.0), 1.0, 50.0)})
    assert autotune.load_speed(tmp_path, restored, "fast") == Setting(history=1, kept=0.9)
    assert autotune.load_speed(tmp_path, other, "fast") == Setting(grid=2.0)
    assert autotune.load_speed(tmp_path / "none", restored, "exact") == Setting()
    with pytest.raises(InputError, match="not tuned for cpu .*run gsim3d profile"):
        autotune.load_speed(tmp_path, restored, "balanced")
    with pytest.raises(InputError, match="must be one of exact, balanced, fast"):
        autotune.load_speed(tmp_path, restored, "warp")
    (tmp_path / autotune.SPEEDS_FILE).write_text("[1]")
    with pytest.raises(InputError, match="must hold a mapping"):
        autotune.load_speed(tmp_path, restored, "fast")
