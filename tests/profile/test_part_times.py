"""What parts of a step took is kept with a checkpoint, and scaled to other plans by their multiply-adds."""

import dataclasses
import json

import pytest

from gsim3d.dynamics import last_steps
from gsim3d.effects.plan import Workload, predicted_cost
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import InputError
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.profile import autotune
from gsim3d.profile.measure import Point
from gsim3d.profile.part_times import PartTimes
from gsim3d.profile.settings import Setting
from gsim3d.profile.timing import Timing

pytestmark = pytest.mark.usefixtures("one_thread")

STAGES = {"serialise": 0.002, "attention": 0.003, "state and guards": 0.001, "head": 0.004, "sort and raster": 0.005}
REFERENCE = Point(Setting(), "", "exact", step=[Timing((0.015,), STAGES)])
TIMES = PartTimes("here", Workload(100, 300, 2, 1024), dynamics=6.0, gaussians=4.0, images=5.0, host=2.0)


def test_stages_are_parts_and_the_work_is_that_of_the_scenes(subject):
    times = PartTimes.of(subject, REFERENCE)
    assert (times.dynamics, times.gaussians, times.images, times.host) == pytest.approx((6.0, 4.0, 5.0, 0.0))
    starts = [last_steps(subject.start(subject.runner(), n), 1).activity for n in range(2)]
    moving = sum(int((activity == 0).sum()) for activity in starts) / 2
    rows = sum(len(activity) for activity in starts) / 2
    assert times.work == Workload(round(moving), round(rows) - round(moving), len(subject.views[0][1]), 32 * 32)
    waits = Point(Setting(), "", "exact", step=[Timing((0.015,), {**STAGES, "host gaps": 0.01})])
    assert PartTimes.of(subject, waits).host == pytest.approx(10.0)
    assert PartTimes.of(subject, Point(Setting(), "", "exact", step=[Timing((0.015,), {})])) is None


def test_milliseconds_grow_as_multiply_adds(subject):
    simulator = subject.restored.simulator
    own, masked = simulator.plan(), simulator.plan(EffectsSpec(DynamicsEffects("masked_out")))
    same = TIMES.predicted(own, own, simulator.config, TIMES.work)
    assert same == pytest.approx({"dynamics": 6.0, "gaussians": 4.0, "images": 5.0, "host": 2.0})
    work = dataclasses.replace(TIMES.work, views=1)
    before = predicted_cost(own, simulator.config, TIMES.work)
    after, found = predicted_cost(masked, simulator.config, work), TIMES.predicted(own, masked, simulator.config, work)
    assert found["host"] == 2.0, "however little is computed"
    for part in ("dynamics", "gaussians", "images"):
        measured = getattr(TIMES, part)
        assert 0 < found[part] < measured and found[part] == pytest.approx(measured * after[part] / before[part])


def test_times_are_kept_beside_presets(tmp_path, subject):
    restored = dataclasses.replace(subject.restored, checkpoint=Checkpoint({}, {}, digest="1f"))
    assert autotune.load_times(tmp_path, restored) == {}
    autotune.save_speeds(tmp_path, restored, {"exact": REFERENCE})
    assert autotune.load_times(tmp_path, restored) == {}
    autotune.save_speeds(tmp_path, restored, {"exact": REFERENCE}, TIMES)
    assert autotune.load_times(tmp_path, restored) == {"cpu": TIMES}
    assert autotune.load_speed(tmp_path, restored, "exact") == Setting()
    other = dataclasses.replace(restored, checkpoint=Checkpoint({}, {}, digest="2e"))
    assert autotune.load_times(tmp_path, other) == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dynamics": "long"}, "speeds.json: cpu: measured: dynamics must be a number; got 'long'"),
        ({"work": {"moving": "many", "frozen": 0}}, "speeds.json: cpu: measured: work.moving must be a whole number"),
        ({"until": 3}, "speeds.json: cpu: measured: unknown key until"),
        ({"work": {"moving": 3}}, "speeds.json: cpu: measured: key work.frozen is missing"),
    ],
)
def test_files_that_hold_no_times(tmp_path, subject, change, message):
    restored = dataclasses.replace(subject.restored, checkpoint=Checkpoint({}, {}, digest="1f"))
    values = dataclasses.asdict(TIMES) | change
    (tmp_path / autotune.SPEEDS_FILE).write_text(json.dumps({"1f": {"cpu": {autotune.TIMES: values}}}))
    with pytest.raises(InputError, match=message):
        autotune.load_times(tmp_path, restored)


def test_a_file_of_speeds_that_is_nested_without_end(tmp_path, subject):
    (tmp_path / autotune.SPEEDS_FILE).write_text("[" * 100_000)
    with pytest.raises(InputError, match="speeds.json cannot be read: it is nested too deeply"):
        autotune.load_times(tmp_path, subject.restored)
