"""Tuned presets retain their share of the gain, limits hold, and saved speeds load."""

import dataclasses
import json

import pytest

import gsim3d
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import InputError
from gsim3d.evaluate.plan_costs import Workload, predicted_cost
from gsim3d.evaluate.plan_report import TIMES, PartTimes, load_times
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.numerics.speed import SPEEDS_FILE, Setting, load_speed
from gsim3d.profile import autotune
from gsim3d.profile.settings import GROUPS
from gsim3d.profile.sweep import Agreement, Effort, Point, Sweep, TimeLimit
from gsim3d.profile.timing import Timing

pytestmark = pytest.mark.usefixtures("one_thread")
SHORT = Effort(n_rounds=2, repeats=2, warm_up=0)
SECTIONS = {"serialise": 0.002, "attention": 0.003, "state and guards": 0.001, "head": 0.004, "sort and raster": 0.005}
REFERENCE = Point(Setting(), "", "exact", step=(Timing((0.015,), SECTIONS),))
MEASURED = PartTimes("here", Workload(100, 300, 2, 1024), dynamics=6.0, gaussians=4.0, images=5.0, host=2.0)


def at(setting, seconds, psnr, other_round=None):
    timings = Timing((seconds,)), Timing((other_round or seconds,))
    return Point(setting, "", "model", agreement=Agreement(psnr, None), step=timings)


def all_points(point):
    return True


@pytest.fixture
def fake(case, monkeypatch):
    """(sweep, list of measured settings); every measurement gives 3 s and 55 dB."""
    sweep, measured = Sweep(case, SHORT), []

    def run(points):
        for point in points:
            if not point.step:
                measured.append(point.setting)
                point.agreement, point.step = Agreement(55.0, None), (Timing((3.0,)),)

    monkeypatch.setattr(sweep, "run", run)
    return sweep, measured


def test_presets_retain_their_share_of_the_gain(case):
    """Runs the tuned settings again and compares their gain with that of the reference."""
    sweep = Sweep(case, SHORT)
    settings = (Setting(), Setting(history=1), Setting(kept=0.5), Setting(kept=0.05), Setting(grid=2.0))
    points = [sweep.point(setting, "", "model") for setting in settings]
    sweep.run(points)
    presets = autotune.tune(sweep, points)
    assert list(presets) == list(autotune.PROMISES) and presets["exact"] is points[0]
    for name, share in (("balanced", 0.999), ("fast", 0.99)):
        again = Point(presets[name].setting, "", "model")
        case.compare(again)
        whole = case.gain(points[0])
        assert case.gain(again) >= whole - (1 - share) * abs(whole)
        assert presets[name].step_seconds <= points[0].step_seconds
    assert not autotune.keeping(case, points[0], 0.999)(points[3])  # it loses too much
    assert autotune.keeping(case, points[0], 1.0)(points[0])


def test_fastest_combines_useful_settings(fake):
    """Combines two useful settings; ties, failures and inaccurate settings are left out."""
    sweep, measured = fake
    points = [
        at(Setting(), 10.0, 100.0),
        at(Setting(history=1), 6.0, 60.0),
        at(Setting(grid=2.0), 8.0, 70.0),
        at(Setting(kept=0.1), 2.0, 10.0),
        at(Setting(cutoff="tile3sigma"), 9.9, 90.0, other_round=10.2),
    ]
    points[3].failure = "out of memory"
    best = autotune.fastest(sweep, points, lambda p: p.agreement.psnr >= 50)
    assert best.setting == Setting(history=1, grid=2.0) and measured == [best.setting]
    assert autotune.fastest(sweep, points, lambda p: p.agreement.psnr >= 40) is best and len(measured) == 1


def test_fastest_skips_settings_without_gain_over_graph(fake):
    """A captured setting must be faster than graph capture alone."""
    sweep, measured = fake
    points = [
        at(Setting(), 10.0, 100.0),
        at(Setting(captured=True), 6.0, 100.0),
        at(Setting(captured=True, patch_size=64), 5.9, 60.0, other_round=6.1),
        at(Setting(captured=True, history=1), 4.0, 60.0),
        at(Setting(captured=True, kept=0.5), 5.0, 50.0),
    ]
    best = autotune.fastest(sweep, points, all_points)
    assert best.setting == Setting(captured=True, history=1, kept=0.5) and measured == [best.setting]
    assert autotune.fastest(sweep, points[:3], all_points) is points[1]


def test_fastest_skips_conflicting_settings(fake):
    sweep, measured = fake
    points = [at(Setting(), 10.0, 100.0), at(Setting(captured=True), 6.0, 100.0), at(Setting(sleep=0.1), 8.0, 99.0)]
    assert autotune.fastest(sweep, points, all_points) is points[1] and not measured


def test_tied_settings_are_chosen_by_agreement(fake):
    points = [
        at(Setting(), 10.0, 100.0),
        at(Setting(history=1), 5.0, 40.0, other_round=5.2),
        at(Setting("bf16", "bf16", "bf16", history=1), 5.1, 60.0, other_round=5.3),
    ]
    assert autotune.fastest(fake[0], points, all_points) is points[2]


def test_fastest_stops_at_time_limit(fake):
    sweep, measured = fake
    sweep.limit = TimeLimit(1.0, iter([0.0, *[2.0] * 9]).__next__)
    points = [at(Setting(), 10.0, 100.0), at(Setting(history=1), 6.0, 60.0), at(Setting(grid=2.0), 8.0, 70.0)]
    assert autotune.fastest(sweep, points, all_points) is points[1] and not measured


def test_autotune_respects_limits(case):
    few = {"groups": [group for group in GROUPS if group.name in ("history", "grid size")], "effort": SHORT}
    tuned = gsim3d.autotune(case, min_agreement_psnr=30.0, **few)
    case.compare(again := Point(tuned.setting, "", "model"))
    assert again.agreement.psnr >= 30.0
    assert autotune.autotune(case, max_ms=1e6, **few).setting == Setting()
    with pytest.raises(InputError, match="no setting takes at most 1e-06 ms"):
        autotune.autotune(case, max_ms=1e-6, **few)
    with pytest.raises(InputError, match="either max_ms or min_agreement_psnr"):
        autotune.autotune(case)


# ---- what is kept beside the weights ----


def speed_of(folder, restored, name):
    return load_speed(folder, restored.checkpoint.digest, restored.device.type, name)


@pytest.fixture
def restored(case):
    return dataclasses.replace(case.restored, checkpoint=Checkpoint({}, {}, digest="1f"))


def test_speeds_round_trip(tmp_path, restored):
    other = dataclasses.replace(restored, checkpoint=Checkpoint({}, {}, digest="2e"))
    autotune.save_speeds(tmp_path, restored, {"fast": at(Setting(history=1, kept=0.9), 1.0, 50.0)})
    autotune.save_speeds(tmp_path, other, {"fast": at(Setting(grid=2.0), 1.0, 50.0)})
    assert speed_of(tmp_path, restored, "fast") == Setting(history=1, kept=0.9)
    assert speed_of(tmp_path, other, "fast") == Setting(grid=2.0)
    assert speed_of(tmp_path / "none", restored, "exact") == Setting()
    with pytest.raises(InputError, match="not tuned for cpu .*run gsim3d profile"):
        speed_of(tmp_path, restored, "balanced")
    with pytest.raises(InputError, match="must be one of exact, balanced, fast"):
        speed_of(tmp_path, restored, "warp")
    (tmp_path / SPEEDS_FILE).write_text("[1]")
    with pytest.raises(InputError, match="must hold a mapping"):
        speed_of(tmp_path, restored, "fast")


def test_part_times_sum_sections(case):
    times = autotune.part_times(case, REFERENCE)
    assert (times.dynamics, times.gaussians, times.images, times.host) == pytest.approx((6.0, 4.0, 5.0, 0.0))
    newest = [case.newest(number).activity for number in range(2)]
    moving, count = (sum(counts) / 2 for counts in zip(*((int((a == 0).sum()), len(a)) for a in newest)))
    assert times.work == Workload(round(moving), round(count) - round(moving), len(case.views[0][1]), 32 * 32)
    waits = Point(Setting(), "", "exact", step=(Timing((0.015,), {**SECTIONS, "host gaps": 0.01}),))
    assert autotune.part_times(case, waits).host == pytest.approx(10.0)
    assert autotune.part_times(case, Point(Setting(), "", "exact", step=(Timing((0.015,), {}),))) is None


def test_predicted_times_scale_with_multiply_adds(case):
    simulator = case.restored.simulator
    own, masked = simulator.plan(), simulator.plan(EffectsSpec(DynamicsEffects("masked_out")))
    same = MEASURED.predicted(own, own, simulator.config, MEASURED.work)
    assert same == pytest.approx({"dynamics": 6.0, "gaussians": 4.0, "images": 5.0, "host": 2.0})
    work = dataclasses.replace(MEASURED.work, views=1)
    before = predicted_cost(own, simulator.config, MEASURED.work)
    after, found = (
        predicted_cost(masked, simulator.config, work),
        MEASURED.predicted(own, masked, simulator.config, work),
    )
    assert found["host"] == 2.0, "however little is computed"
    for part in ("dynamics", "gaussians", "images"):
        measured = getattr(MEASURED, part)
        assert 0 < found[part] < measured and found[part] == pytest.approx(measured * after[part] / before[part])


def test_part_times_round_trip(tmp_path, restored):
    assert load_times(tmp_path, restored) == {}
    autotune.save_speeds(tmp_path, restored, {"exact": REFERENCE})
    assert load_times(tmp_path, restored) == {}
    autotune.save_speeds(tmp_path, restored, {"exact": REFERENCE}, MEASURED)
    assert load_times(tmp_path, restored) == {"cpu": MEASURED}
    assert speed_of(tmp_path, restored, "exact") == Setting()
    other = dataclasses.replace(restored, checkpoint=Checkpoint({}, {}, digest="2e"))
    assert load_times(tmp_path, other) == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dynamics": "long"}, "speeds.json: cpu: measured: dynamics: must be a number; got 'long'"),
        ({"work": {"moving": "many", "frozen": 0}}, "speeds.json: cpu: measured: work.moving: must be a whole number"),
        ({"until": 3}, "speeds.json: cpu: measured: until: unknown setting"),
        ({"work": {"moving": 3}}, "speeds.json: cpu: measured: work.frozen: this setting is missing"),
    ],
)
def test_load_times_refuses_invalid_values(tmp_path, restored, change, message):
    values = dataclasses.asdict(MEASURED) | change
    (tmp_path / SPEEDS_FILE).write_text(json.dumps({"1f": {"cpu": {TIMES: values}}}))
    with pytest.raises(InputError, match=message):
        load_times(tmp_path, restored)


def test_load_times_refuses_deep_nesting(tmp_path, restored):
    (tmp_path / SPEEDS_FILE).write_text("[" * 100_000)
    with pytest.raises(InputError, match="speeds.json cannot be read: it is nested too deeply"):
        load_times(tmp_path, restored)
