"""Errors against the reference and the truth, settings that fail, and what is on the front."""

import dataclasses

import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import predict as predict_plainly
from gsim3d.evaluate.protocol import render_steps
from gsim3d.pareto import measure
from gsim3d.pareto.measure import Comparison, Effort, Point, Subject, Unusable, compare, front, points_of, time_points
from gsim3d.pareto.runner import Runner
from gsim3d.pareto.settings import KINDS, KNOBS, Setting
from gsim3d.pareto.timing import DeviceClock, Timing

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
    ours = measure.predict(subject, subject.runner(), 0)
    torch.testing.assert_close(ours.images, expected, rtol=0, atol=1e-6)


def test_the_reference_agrees_with_itself(comparison):
    agreement, task, by_step = comparison.of(Setting())
    assert agreement == measure.Agreement(100.0, 100.0, 0.0, 0.0)
    assert set(task) == {"psnr", "psnr_masked", "ssim"}
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
    agreement, _, _ = comparison.of(setting)
    assert 5 < agreement.psnr < 100
    assert agreement.psnr_worst <= agreement.psnr
    if not known:
        assert agreement.position_max is None
    elif setting.cutoff != "exact" or setting.shrink != 1:
        assert agreement.position_max == 0
    else:
        assert agreement.position_max > 0


def test_images_that_are_left_out_cost_no_agreement(comparison):
    agreement, _, by_step = comparison.of(Setting(every=3))
    assert agreement.psnr == 100
    assert len(by_step["psnr"]) == -(-comparison.subject.n_steps // 3)
    whole = comparison.of(Setting())[2]
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
        measure.predict(subject, runner, 0)


def test_a_run_without_memory_is_drawn_as_failed(subject, monkeypatch):
    def full(self, state):
        raise torch.OutOfMemoryError("too large")

    monkeypatch.setattr(Runner, "step", full)
    points = [Point(Setting(history=1), "history", "model")]
    comparison = Comparison(subject)
    comparison.__dict__["reference"] = [None, None]  # not made: the only setting fails before it is needed
    compare(comparison, points)
    assert points[0].failure == "out of memory at step 1"


def test_every_knob_is_declared_once(subject):
    assert len({knob.name for knob in KNOBS}) == len(KNOBS)
    assert {knob.kind for knob in KNOBS} <= set(KINDS)
    points = points_of(subject.restored)
    assert points[0].setting == Setting()
    assert len({p.setting for p in points}) == len(points)
    for point in points[1:]:
        assert Setting.from_dict(point.setting.to_dict()) == point.setting


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
    for point in points:
        assert len(point.step) == len(point.encode) == 3
        assert all(len(timing.repeats) == 2 for timing in point.step)
        assert {"convolution", "attention", "serialise", "dense layers"} <= set(point.stages())
        assert point.peak > 0


def test_the_front_holds_what_nothing_beats():
    a, b, c, d = timed(1.0, 20.0), timed(2.0, 50.0), timed(3.0, 40.0), timed(0.5, 60.0, failure="out of memory")
    assert front([a, b, c, d], measure.disagreement) == [a, b]


def test_near_times_are_a_tie():
    a, b = timed(1.0, 20.0), timed(1.1, 20.0)
    a.step.append(Timing((1.2,)))  # rounds of a are 0.2 s apart
    assert measure.ties(a, b)
    assert not measure.ties(timed(1.0, 20.0), timed(1.5, 20.0))


def test_a_wrong_setting_is_told():
    for values, what in [
        ({"encoder": "fp8"}, "encoder"),
        ({"kept": 0}, "kept"),
        ({"every": 0}, "every"),
        ({"no": 1}, "no"),
    ]:
        with pytest.raises(InputError, match=f"setting: .*{what}"):
            Setting.from_dict(values)


def test_a_subject_is_as_short_as_asked(subject):
    assert Subject(subject.restored, subject.scenes, 2).n_steps == 2
    assert subject.n_steps == subject.scenes[0].n_steps - 2
