"""Every knob is declared once, turned where it can be, and else there is a true reason."""

import dataclasses

import pytest
import torch

from gsim3d import presets
from gsim3d.dynamics import RestLog
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import InputError
from gsim3d.profile import products
from gsim3d.profile.measure import QUICK_ON_CPU, Comparison, Effort, Point, compare, points_of, time_points
from gsim3d.profile.predict import Unusable, predict
from gsim3d.profile.runner import Runner
from gsim3d.profile.settings import KINDS, KNOBS, SLOW, Setting, turned
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import DeviceClock
from gsim3d.train.restore import build_simulator

pytestmark = pytest.mark.usefixtures("one_thread")
ASKED = {
    "precision", "fp8 products", "compile", "graph capture", "context views", "history", "background", "particles kept",
    "degree of colours", "cutoff of Gaussians", "sleep", "patch size", "orders of curves", "grid size",
    "image size and decoded frames", "horizon", "steps a call", "model size", "training steps",
}  # fmt: skip


def knobs(*names):
    return [knob for knob in KNOBS if knob.name in names]


@pytest.fixture
def other(subject):
    """The same model with other weights."""
    simulator = build_simulator(subject.restored.simulator.config, seed=5).eval()
    return dataclasses.replace(subject.restored, simulator=simulator)


def test_every_knob_is_declared_once(subject):
    assert {knob.name for knob in KNOBS} == ASKED and len(KNOBS) == len(ASKED)
    assert {knob.kind for knob in KNOBS} == set(KINDS)
    points, missing = points_of(subject)
    assert points[0].setting == Setting()
    assert len({p.setting for p in points}) == len(points)
    for point in points[1:]:
        assert Setting.from_dict(point.setting.to_dict()) == point.setting
    shown = {knob.name for knob in KNOBS if knob.shown}
    assert {p.knob for p in points[1:]} | set(missing) | shown == ASKED
    assert not {p.knob for p in points[1:]} & set(missing)
    assert all(missing.values()) and "only float32" in missing["precision"]


def test_a_quick_report_takes_the_ends_and_nothing_slow(subject):
    points, missing = points_of(subject, KNOBS, QUICK_ON_CPU)
    assert [p.setting.kept for p in points if p.knob == "particles kept"] == [0.75, 0.1]
    assert missing["compile"] == SLOW
    assert max(sum(p.knob == knob.name for p in points) for knob in KNOBS) == 2


def test_without_a_compiler_the_reason_says_so(subject, monkeypatch):
    monkeypatch.setattr("gsim3d.profile.settings.compiler_problem", lambda device: "a C++ compiler")
    assert points_of(subject, knobs("compile"))[1] == {"compile": "a C++ compiler"}


def test_a_compiler_that_torch_cannot_find(monkeypatch):
    def none():
        raise RuntimeError("no compiler")

    monkeypatch.setattr("torch._inductor.cpp_builder.get_cpp_compiler", none)
    assert products.compiler_problem(torch.device("cpu")) == "a C++ compiler"


def test_a_compiled_step_is_exact(subject, monkeypatch):
    """Through torch.compile's tracing, without its slow C++."""
    compile_ = torch.nn.Module.compile
    monkeypatch.setattr(torch.nn.Module, "compile", lambda self, **options: compile_(self, backend="eager", **options))
    runner, plain = Runner(subject.restored, Setting(compiled=True)), subject.runner()
    state = subject.start(plain, 0)
    torch.testing.assert_close(runner.step(state).means, plain.step(state).means, rtol=0, atol=1e-6)
    assert runner.simulator.dynamics.net._compiled_call_impl is not None
    assert plain.simulator.dynamics.net._compiled_call_impl is None


def test_what_cannot_be_compiled_is_a_failure(subject, monkeypatch):
    def fails(self, state):
        raise KeyError("no such instruction")

    monkeypatch.setattr(Runner, "step", fails)
    with pytest.raises(Unusable, match="cannot be compiled: KeyError: 'no such instruction'"):
        predict(subject, Runner(subject.restored, Setting(compiled=True)), 0)
    with pytest.raises(KeyError):  # without a compiler it is a fault of ours
        predict(subject, subject.runner(), 0)


def test_a_scene_at_rest_sleeps(subject):
    """With a threshold that everything is below, the whole scene rests once its patience is over."""
    short = Subject(subject.restored, subject.scenes)
    runner, log = short.runner(Setting(sleep=100.0)), RestLog()
    steps = list(runner.steps(short.start(runner, 0), 12, log))
    assert len(steps) == 12 and log.resting_share > 0.5
    torch.testing.assert_close(steps[-1].means, steps[-2].means, rtol=0, atol=0)
    awake = short.runner(Setting(sleep=0.0))
    plain = list(short.runner().steps(short.start(short.runner(), 0), 4))
    for ours, expected in zip(awake.steps(short.start(awake, 0), 4), plain, strict=True):
        torch.testing.assert_close(ours.means, expected.means)
    point = Point(Setting(sleep=100.0), "sleep", "near-exact")
    compare(Comparison(short), [point])
    assert point.resting == 0  # films of this length end before anybody's patience


def test_sleep_is_timed_over_whole_rollouts(subject):
    point = Point(Setting(sleep=0.1), "sleep", "near-exact")
    time_points(subject, [point], DeviceClock("cpu"), Effort(n_rounds=1, repeats=2, warm_up=0))
    assert subject.runner(point.setting).span(subject.n_steps) == subject.n_steps
    assert point.step_seconds > 0 and sum(point.stages().values()) > 0


def test_orders_are_averaged(subject):
    runner, one = subject.runner(Setting(orders=2)), subject.runner()
    state = subject.start(one, 0)
    own = one.newest(one.step(state))
    geometry = one.simulator.dynamics.geometry
    two = one.simulator.rollout(state, 1, one.plan, geometry=lambda s: geometry(s, curves=((2, 3, 0, 1),) * 3))[0]
    averaged = runner.newest(runner.step(state))
    assert not torch.equal(own.means, two.means)
    torch.testing.assert_close(averaged.means, (own.means + two.means) / 2)
    torch.testing.assert_close(averaged.dynamic_latents, (own.dynamic_latents + two.dynamic_latents) / 2)
    assert torch.equal(averaged.activity, own.activity)
    prediction = runner.predict(subject.scenes[0], subject.views[0][0], 2)
    steps = list(runner.steps(subject.start(runner, 0), 2))
    torch.testing.assert_close(prediction.particles.select_clouds([3]).means, steps[1].means)


def test_orders_need_a_background_that_is_not_read_apart(subject):
    config = presets.tiny()
    config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, background="asymmetric"))
    simulator = build_simulator(config, seed=0).eval()
    spec = EffectsSpec(dynamics=DynamicsEffects(background="asymmetric"))
    restored = dataclasses.replace(subject.restored, simulator=simulator, plan=simulator.plan(spec))
    _, missing = points_of(Subject(restored, subject.scenes), knobs("orders of curves"))
    assert "asymmetric" in missing["orders of curves"]


def test_weak_gaussians_are_not_drawn(subject):
    runner = subject.runner()
    newest, cameras = runner.newest(subject.start(runner, 0)), subject.cameras(0, 0)
    whole = runner.images(newest, cameras)
    below = subject.runner(Setting(least_opacity=1 / 255)).images(newest, cameras)
    torch.testing.assert_close(below, whole, rtol=0, atol=1e-6)  # no pixel shows what is below a step of an 8-bit image
    least = float(newest.opacities.median())
    fewer = subject.runner(Setting(least_opacity=least)).images(newest, cameras)
    expected = runner.images(newest.select_rows(newest.opacities >= least), cameras)
    torch.testing.assert_close(fewer, expected, rtol=0, atol=0)
    assert not torch.equal(fewer, whole)


def test_on_a_gpu_settings_are_replayed_where_they_fit_a_graph():
    """A setting that the host launches is as slow as the host, whatever it saves."""

    class OnGpu:
        device = torch.device("cuda")

    chosen = knobs("precision", "particles kept", "cutoff of Gaussians", "sleep", "image size and decoded frames")
    settings, missing = turned(OnGpu(), [*chosen, *knobs("graph capture")])
    launched = [setting for setting in settings if not setting.captured]
    assert {setting.name for setting in launched} == {"sleep 0.001", "sleep 0.01", "sleep 0.1"}
    assert settings[Setting(captured=True)].name == "graph capture" and not missing
    ends, _ = turned(OnGpu(), knobs("precision"), fewest=True)
    names = ("precision tf32", "precision bf16 dynamics", "precision bf16")
    assert [setting.name for setting in ends] == [f"graph captured, {name}" for name in names]


def test_a_graph_does_not_fit_everything():
    with pytest.raises(InputError, match="captured does not fit sleep and orders"):
        Setting(captured=True, sleep=0.1, orders=2)
    assert Setting(captured=True).name == "graph captured"
    assert Setting(compiled=True, kept=0.5).name == "compiled, kept 0.5"


def test_fp8_is_measured_or_impossible(subject):
    assert products.why_not(subject) == "a GPU that multiplies fp8"
    counts = products.products_of(subject.restored.simulator, subject.start(subject.runner(), 0))
    config = subject.restored.simulator.config.dynamics
    per_block = 5  # position, qkv, proj, fc1, fc2
    wide = [c % 16 == 0 for c in (*config.encoder_channels, *config.decoder_channels)]
    assert sum(counts.values()) == per_block * sum(wide)
    assert (32, 64) in {(k, n) for _, k, n in counts}
    text = products.verdict(10, 0.5, 0.75)
    assert "nothing to gain" in text and "0.500 ms in bf16" in text and "0.750 ms in fp8" in text
    assert "at most 0.250 ms of a step to gain" in products.verdict(10, 0.75, 0.5)


def test_other_checkpoints_are_settings(subject, other):
    named = {"later": other, "same": subject.restored}
    both = Subject(subject.restored, subject.scenes, 2, named)
    assert both.knob_of_other == {"later": "training steps", "same": "training steps"}
    points, missing = points_of(both, knobs("training steps", "steps a call", "model size"))
    assert [p.setting.checkpoint for p in points] == [None, "later", "same"]
    assert set(missing) == {"steps a call", "model size"}
    assert {p.kind for p in points[1:]} == {"needs-training"}
    compare(Comparison(both), points)
    assert points[2].agreement.psnr == 100 and points[1].agreement.psnr < 60


def test_a_model_of_two_steps_a_call(subject):
    config = subject.restored.simulator.config
    config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, steps_per_call=2))
    simulator = build_simulator(config, seed=1).eval()
    two = dataclasses.replace(subject.restored, simulator=simulator, plan=simulator.plan(EffectsSpec()))
    both = Subject(subject.restored, subject.scenes, 3, {"two": two})
    assert both.knob_of_other == {"two": "steps a call"}
    runner = both.runner(Setting(checkpoint="two"))
    steps = list(runner.steps(both.start(runner, 0), 3))
    expected = simulator.rollout(both.start(runner, 0), 3, two.plan)
    assert [step.cloud_step.tolist() for step in steps] == [[2], [3], [4]]
    for ours, right in zip(steps, expected, strict=True):
        torch.testing.assert_close(ours.means, right.means)
    assert runner.span(3) == 2


def test_others_that_need_more_given_steps_are_refused(subject):
    short = dataclasses.replace(subject.restored, data=dataclasses.replace(subject.restored.data, history=1))
    with pytest.raises(InputError, match="longer: sees 2 given steps, the reference 1"):
        Subject(short, subject.scenes, None, {"longer": subject.restored})
    both = Subject(subject.restored, subject.scenes, 2, {"short": short})
    runner = both.runner(Setting(checkpoint="short"))
    frames, second = both.frames(runner, 0), runner.frames(subject.scenes[:1], [both.views[0][0]], 1)
    torch.testing.assert_close(frames.images, second.images, rtol=0, atol=0)
    assert not torch.equal(frames.images, runner.frames(subject.scenes[:1], [both.views[0][0]], 0).images)
