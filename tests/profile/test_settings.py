"""Settings: groups are unique, settings have their effect, and empty groups state their requirement."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import RestLog
from gsim3d.errors import InputError
from gsim3d.numerics.speed import Setting
from gsim3d.profile.settings import GROUPS, KINDS, Runner
from gsim3d.profile.sweep import QUICK, BenchmarkCase, Sweep

pytestmark = pytest.mark.usefixtures("one_thread")


def groups(*names):
    return [group for group in GROUPS if group.name in names]


def test_groups_are_declared_once(case):
    names = [group.name for group in GROUPS]
    assert len(set(names)) == len(names) and {group.kind for group in GROUPS} == set(KINDS)
    points, missing = Sweep(case).points()
    assert points[0].setting == Setting() and len({p.setting for p in points}) == len(points)
    for point in points[1:]:
        assert Setting.from_dict(point.setting.to_dict()) == point.setting
    assert {p.group for p in points[1:]} | set(missing) == set(names)
    assert not {p.group for p in points[1:]} & set(missing)
    assert all(missing.values()) and "only float32" in missing["precision"]


def test_quick_sweep_uses_ends_of_groups(case):
    points, _ = Sweep(case, QUICK).points()
    assert [p.setting.kept for p in points if p.group == "particles kept"] == [0.75, 0.1]
    assert max(sum(p.group == group.name for p in points) for group in GROUPS) == 2


def test_gpu_settings_are_captured_if_possible():
    """Uncaptured settings would be limited by launch overhead."""

    class OnGpu:
        device = torch.device("cuda")

    chosen = groups("precision", "particles kept", "cutoff of Gaussians", "sleep", "graph capture")
    points, missing = Sweep(OnGpu()).points(chosen)
    launched = [point.setting.name for point in points[1:] if not point.setting.captured]
    assert launched == ["sleep 0.001", "sleep 0.01", "sleep 0.1"] and not missing
    assert Setting(captured=True) in [point.setting for point in points]
    ends, _ = Sweep(OnGpu(), QUICK).points(groups("precision"))
    names = ("precision tf32", "precision bf16 dynamics", "precision bf16")
    assert [point.setting.name for point in ends[1:]] == [f"graph captured, {name}" for name in names]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"encoder": "fp8"}, "encoder"),
        ({"kept": 0}, "kept"),
        ({"history": 0}, "history"),
        ({"no": 1}, "no"),
        ({"kept": "half"}, "kept: must be a number"),
        ({"captured": 1}, "captured: must be true or false"),
        ({"sh_degree": "x"}, "sh_degree"),
        ({"captured": True, "sleep": 0.1}, "captured does not fit sleep"),
        ([1], "must be a mapping"),
    ],
)
def test_setting_refuses_invalid_values(values, message):
    with pytest.raises(InputError, match=f"setting: .*{message}"):
        Setting.from_dict(values)


def test_sleep_setting_puts_scene_to_sleep(case):
    """With a high threshold, the whole scene sleeps after ``patience`` steps."""
    runner, log = case.runner(Setting(sleep=100.0)), RestLog()
    steps = list(runner.steps(case.start(runner, [0]), 12, log))
    assert len(steps) == 12 and log.resting_share > 0.5
    torch.testing.assert_close(steps[-1].means, steps[-2].means, rtol=0, atol=0)
    awake = case.runner(Setting(sleep=0.0))
    plain = list(case.runner().steps(case.start(case.runner(), [0]), 4))
    for ours, expected in zip(awake.steps(case.start(awake, [0]), 4), plain, strict=True):
        torch.testing.assert_close(ours.means, expected.means)
    assert runner.span(case.n_steps) == case.n_steps  # no particle sleeps in a first step


def test_kept_selects_most_opaque_particles(case):
    all_of_them = case.start(case.runner(), [0])
    kept = case.start(case.runner(Setting(kept=0.25)), [0])
    for cloud in range(all_of_them.n_clouds):
        for activity in (0, 1):
            here = (all_of_them.row_cloud() == cloud) & (all_of_them.activity == activity)
            there = (kept.row_cloud() == cloud) & (kept.activity == activity)
            assert int(there.sum()) == -(-int(here.sum()) // 4)
            if there.any():
                least = kept.opacities[there].min()
                assert int((all_of_them.opacities[here] > least).sum()) < int(there.sum()) + 1


def test_least_opacity_skips_gaussians(case):
    runner, newest, cameras = case.runner(), case.newest(0), case.cameras([0], 0)
    whole = runner.images(newest, cameras)
    below = case.runner(Setting(least_opacity=1 / 255)).images(newest, cameras)
    torch.testing.assert_close(below, whole, rtol=0, atol=1e-6)  # no pixel shows what is below a step of an 8-bit image
    least = float(newest.opacities.median())
    fewer = case.runner(Setting(least_opacity=least)).images(newest, cameras)
    expected = runner.images(newest.select_rows(newest.opacities >= least), cameras)
    torch.testing.assert_close(fewer, expected, rtol=0, atol=0)
    assert not torch.equal(fewer, whole)


def test_runner_with_two_steps_a_call(case):
    config = case.restored.simulator.config
    config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, steps_per_call=2))
    simulator = type(case.restored.simulator)(config).eval()
    simulator.inputs = case.restored.simulator.inputs
    two = BenchmarkCase(dataclasses.replace(case.restored, simulator=simulator), case.scenes, 3)
    runner = two.runner()
    assert len(runner.steps(two.start(runner, [0]), 3)) == 3 and runner.span(3) == 2


def test_reference_matches_float64(case):
    """Validates the reference by a rollout in double precision."""
    import copy

    restored = case.restored
    state = case.start(case.runner(), [0])
    double = dataclasses.replace(restored, simulator=copy.deepcopy(restored.simulator).double())
    wide = state.map(lambda t: t.double() if t.is_floating_point() else t)
    cell = restored.simulator.config.dynamics.grid_size
    ours, exact = (runner.steps(s, case.n_steps) for runner, s in ((case.runner(), state), (Runner(double), wide)))
    for a, b in zip(ours, exact, strict=True):
        assert float((a.means.double() - b.means).norm(dim=1).max() / cell) < 1e-3
