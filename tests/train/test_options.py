"""Precision, recomputation, drawn histories, TensorBoard, traces."""

import dataclasses
import json
import math
import re
import sys
import types
import urllib.request

import pytest
import torch

from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.settings import from_dict
from gsim3d.state import DYNAMIC, FROZEN
from gsim3d.train.config import DataConfig, PhaseConfig, PrecisionConfig
from gsim3d.train.gradients import StepWatch
from gsim3d.train.log import sample_video
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.optimizer import STEPS_TO_DOUBLE, LossScale
from gsim3d.train.samples import displaced, draw_batch, draw_noise, draw_windows
from gsim3d.viewer import training
from gsim3d.viewer.training import showing_samples
from tests.dynamics.scenes import TINY, make_history
from tests.tiny_scenes import write_scenes
from tests.train.test_loop import CONFIG, curve, scenes

pytestmark = pytest.mark.usefixtures("one_thread")
LATER = 4  # a step of the second phase, which rolls out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 2)


def trainer_at(folder, out, step=LATER, device="cpu", **settings):
    trainer = Trainer(dataclasses.replace(CONFIG, **settings), scenes(folder), out, device=str(device))
    trainer.simulator.train()
    trainer.step = step
    return trainer


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_recomputing_changes_no_bit(folder, tmp_path, norm, precision, device):
    """Gradients, statistics and what is drawn, each part alone and all together."""
    model = {"dynamics": {"norm": norm, "drop_path": 0.3, "shuffle_orders": True, "zero_init": False}}
    precision = PrecisionConfig(precision, precision, precision)
    known = None
    for recompute in ((), ("encoder",), ("steps",), ("images",), ("encoder", "steps", "images")):
        settings = {"model": model, "recompute": recompute, "precision": precision}
        trainer = trainer_at(folder, tmp_path, device=device, **settings)
        calls = []
        for part, name in (("encoder", "encoder"), ("dynamics", "steps"), ("renderer", "images")):
            getattr(trainer.simulator, part).register_forward_pre_hook(lambda *_, name=name: calls.append(name))
        with deterministic():
            loss, errors, gradients, watch = trainer._gradients([0])
        result = [loss, errors, *gradients, *trainer.simulator.buffers()]
        assert watch.seen(1.0).n_particles > 0 and len(watch.seen(1.0).norms) == 2
        for name, once in (("encoder", 1), ("steps", 2), ("images", 1)):
            assert calls.count(name) == (2 * once if name in recompute else once)
        known = known or result
        for before, now in zip(known, result, strict=True):
            assert (before is None) == (now is None) and (now is None or torch.equal(before, now)), recompute
    buffers = list(trainer.simulator.buffers())
    assert (norm == "batch") == any(bool((b != b.round()).any()) for b in buffers)


@pytest.mark.parametrize("part", ["encoder", "dynamics", "renderer"])
@pytest.mark.parametrize("precision, error", [("bf16", 0.05), ("fp16", 0.01)])
def test_precision_of_one_part(folder, tmp_path, part, precision, error):
    """Products of that part are rounded and those of no other; losses, particles and gradients stay float32."""
    model = {"dynamics": {"zero_init": False}}
    exact = trainer_at(folder, tmp_path, model=model)
    rounded = trainer_at(folder, tmp_path, model=model, precision=from_dict(PrecisionConfig, {part: precision}))
    seen = {}
    for name in ("encoder", "dynamics", "renderer"):
        for module in getattr(rounded.simulator, name).modules():
            if isinstance(module, (torch.nn.Linear, torch.nn.Conv2d)):
                module.register_forward_hook(lambda m, i, o, name=name: seen.setdefault(name, set()).add(o.dtype))
    (loss, _, expected, _), (low, _, gradients, _) = exact._gradients([0]), rounded._gradients([0])
    dtype = {"bf16": torch.bfloat16, "fp16": torch.float16}[precision]
    assert (dtype in seen[part]) and all(types == {torch.float32} for name, types in seen.items() if name != part)
    assert low.dtype == torch.float32 and low != loss and low.item() == pytest.approx(loss.item(), rel=error)
    assert all(g is None or g.dtype == torch.float32 for g in gradients)
    pairs = [(a, b) for a, b in zip(expected, gradients, strict=True) if a is not None]
    a, b = (torch.cat([g.flatten() for g in side]) for side in zip(*pairs, strict=True))
    assert torch.cosine_similarity(a, b, 0) > 0.9


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_states_and_images_stay_float32(folder, tmp_path, precision, device):
    precision = PrecisionConfig(precision, precision, precision)
    trainer = trainer_at(folder, tmp_path, device=device, precision=precision)
    render, seen = trainer.simulator.render, []
    trainer.simulator.render = lambda p, *given, **options: seen.append(p) or render(p, *given, **options)
    images = trainer._images(trainer._batch([0]), 0, StepWatch())
    (particles,) = seen
    floats = [value for value in particles.row_fields().values() if value.is_floating_point()]
    assert len(floats) == 4 and particles.n_clouds == 4
    assert all(value.dtype == torch.float32 for value in [images, *floats, *trainer.simulator.state_dict().values()])


def test_loss_scale_leaves_gradients_and_halves_on_overflow(folder, tmp_path, device):
    trainers = [
        trainer_at(folder, tmp_path, device=device, precision=PrecisionConfig(dynamics=p)) for p in ("fp16", "fp16")
    ]
    assert trainers[0].scale.value == 2.0**16
    for trainer, scale in zip(trainers, (2.0**12, 2.0**10), strict=True):
        trainer.scale = LossScale(scale)
    entries = [trainer.train_step() for trainer in trainers]
    assert [entry["loss_scale"] for entry in entries] == [2.0**12, 2.0**10]
    for name in ("grad_norm", "grad_norm_by_step"):
        assert entries[0][name] == pytest.approx(entries[1][name], rel=0.02)
    trainer = trainers[0]
    trainer.scale = LossScale(2.0**126)
    assert "not finite" in trainer.train_step()["skipped"] and trainer.scale.value == 2.0**125
    trainer.out.mkdir(exist_ok=True)
    trainer.save()
    assert trainer_at(folder, tmp_path, precision=PrecisionConfig(dynamics="fp16")).scale.value == 2.0**125
    scale = LossScale(4.0)
    for _ in range(STEPS_TO_DOUBLE):
        scale.update(True)
    assert (scale.value, scale.n_good) == (8.0, 0)


def test_histories_and_views_are_drawn_for_each_step(folder, tmp_path):
    data = DataConfig(history=4, shortest_history=1, context_views=3, fewest_views=2, target_only_cameras=(3,))
    phase = dataclasses.replace(CONFIG.phases[1], batch=2)
    found = set()
    for step in range(24):
        batch = draw_batch(scenes(folder), data, phase, 0, step, [0, 1])
        (alone,) = {draw_batch(scenes(folder), data, phase, 0, step, [s]).n_context for s in (0, 1)}
        n_images, n_clouds = batch.context.images.shape[0], batch.context.cloud_scene.shape[0]
        assert batch.n_context == alone and n_clouds == 2 * alone
        found.add((alone, n_images // n_clouds))
    assert {history for history, _ in found} == {1, 2, 3, 4} and {views for _, views in found} == {2, 3}
    model = {"dynamics": {"history_bits": 2}}
    config = dataclasses.replace(CONFIG, data=data, model=model, phases=(dataclasses.replace(phase, steps=4, batch=1),))
    for name, runs in (("whole", [None]), ("parts", [2, None])):
        for until in runs:
            Trainer(config, scenes(folder), tmp_path / name).run(until=until, progress=False)
    assert curve(tmp_path / "whole") == curve(tmp_path / "parts")
    with pytest.raises(InputError, match="data.shortest_history: must be at most data.history, 2; got 3"):
        DataConfig(shortest_history=3)


def test_tensorboard_gets_all_numbers_and_videos_and_changes_no_bit(folder, tmp_path):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    for name in ("without", "with"):
        Trainer(CONFIG, scenes(folder), tmp_path / name).run(progress=False, until=5, tensorboard=name == "with")
    assert curve(tmp_path / "without") == curve(tmp_path / "with")
    board = events.EventAccumulator(str(tmp_path / "with" / "tensorboard"), {"images": 0, "scalars": 0}).Reload()
    losses = [(event.step, event.value) for event in board.Scalars("train/loss")]
    assert losses == [(line["step"], pytest.approx(line["loss"])) for line in curve(tmp_path / "with")]
    names = set(board.Tags()["scalars"])
    modules = {f"train/grad_norm_by_module/{part}" for part in ("encoder", "dynamics", "renderer")}
    assert {"train/particles", "train/step_seconds", "train/memory_gib", "train/grad_norm_by_step/2"} | modules <= names
    (video,) = board.Images("sample/true, predicted")
    assert video.step == 5 and (video.width, video.height) == (64, 32) and video.encoded_image_string[:3] == b"GIF"


class FakeWandb(types.ModuleType):
    """Records what is logged."""

    Error = RuntimeError

    def __init__(self):
        super().__init__("wandb")
        self.started, self.logged, self.n_finished = [], [], 0

    def init(self, **options):
        self.started.append(options)
        return self

    def log(self, values, step):
        self.logged.append((step, values))

    def finish(self):
        self.n_finished += 1


def test_wandb_gets_what_tensorboard_gets_and_the_settings(folder, tmp_path, monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for name in ("without", "with"):
        Trainer(CONFIG, scenes(folder), tmp_path / name).run(progress=False, until=3, wandb=name == "with")
    assert curve(tmp_path / "without") == curve(tmp_path / "with")
    (options,) = fake.started
    assert options["dir"] == str(tmp_path / "with") and options["config"]["train"]["seed"] == CONFIG.seed
    losses = [(step, values["train/loss"]) for step, values in fake.logged]
    assert losses == [(line["step"], line["loss"]) for line in curve(tmp_path / "with")] and fake.n_finished == 1
    assert {"train/step_seconds", "train/grad_norm_by_module/encoder"} <= set(fake.logged[0][1])


@pytest.mark.parametrize("name, option", [("torch.utils.tensorboard", "tensorboard"), ("wandb", "wandb")])
def test_loggers_that_are_not_installed_are_named(folder, tmp_path, monkeypatch, name, option):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=rf"pip install 'gsim3d\[{option}\]'"):
        Trainer(CONFIG, scenes(folder), tmp_path).run(progress=False, **{option: True})


def test_sample_video_shows_truth_and_prediction(folder, tmp_path):
    trainer = trainer_at(folder, tmp_path)
    video = sample_video(trainer.simulator, trainer.plan, trainer.draw_sample())
    assert video.shape == (4, 32, 64, 3) and video.dtype == torch.uint8 and trainer.simulator.training
    assert torch.equal(video[:, :, :32], trainer.scenes[0].images([0], range(4))[:, 0].permute(0, 2, 3, 1))
    assert video[:, :, 32:].float().std() > 1


def test_viewer_shows_each_sample_and_changes_no_bit(folder, tmp_path, capsys):
    pytest.importorskip("viser", reason="needs viser")
    config = dataclasses.replace(CONFIG, checkpoint_every=2)
    Trainer(config, scenes(folder), tmp_path / "without").run(progress=False, until=5)
    shown = []
    with showing_samples() as show:

        def watch(sample, step):
            show(sample, step)
            shown.append((step, sample.particles.n_clouds, sample.n_given))
            assert sample.scene is others

        others = Scene.open(scenes(folder)[1].path)
        Trainer(config, scenes(folder), tmp_path / "with").run(progress=False, until=5, watch=watch, watched=others)
        address = re.search(r"viewer: (http://127.0.0.1:\d+)", capsys.readouterr().out)[1]
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
    assert curve(tmp_path / "without") == curve(tmp_path / "with")
    second = Trainer(config, scenes(folder), tmp_path / "second")
    second.processes.rank = 1
    second.run(progress=False, until=1, watch=lambda *_: pytest.fail("only the first process shows samples"))
    assert [step for step, *_ in shown] == [0, 2, 4, 5] and shown[0][1:] == (1, 1) and shown[-1][1:] == (4, 2)


def test_training_goes_on_without_a_viewer_that_fails(folder, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="needs viser")
    calls = []

    def fails(*_):
        calls.append(1)
        raise OSError("no port")

    monkeypatch.setattr(training, "Viewer", fails)
    with showing_samples() as show, pytest.warns(UserWarning, match="given up at step 0: OSError: no port"):
        Trainer(CONFIG, scenes(folder), tmp_path).run(progress=False, until=3, watch=show)
    assert len(curve(tmp_path)) == 3 and len(calls) == 1


def test_a_trace_is_written_and_changes_no_bit(folder, tmp_path):
    Trainer(CONFIG, scenes(folder), tmp_path / "plain").run(progress=False, until=5)
    Trainer(CONFIG, scenes(folder), tmp_path / "traced").run(progress=False, until=5, profile=True)
    assert curve(tmp_path / "plain") == curve(tmp_path / "traced")
    (trace,) = (tmp_path / "traced" / "profile").iterdir()
    names = {event.get("name") for event in json.loads(trace.read_text())["traceEvents"]}
    assert trace.name == "process_0.json" and "ProfilerStep#3" in names and "gsim3d::rasterize_gaussians" in names
    with pytest.raises(InputError, match="--profile traces steps 3 and 4 of a run; this one has 1"):
        Trainer(CONFIG, scenes(folder), tmp_path / "traced").run(progress=False, profile=True)


def test_log_has_time_memory_and_particles(folder, tmp_path):
    Trainer(CONFIG, scenes(folder), tmp_path).run(progress=False, until=2)
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert all(line["machine"]["step_seconds"] > 0 and 0.01 < line["machine"]["memory_gib"] < 100 for line in lines)
    assert lines[1]["machine"]["seconds"] > lines[0]["machine"]["seconds"]
    batch = draw_batch(scenes(folder), CONFIG.data, CONFIG.phases[0], 0, 0, [0, 1])
    assert lines[0]["particles"] == pytest.approx(batch.context.masks.sum().item() / 2)
    assert math.isfinite(checkpoint.load(tmp_path).state["seconds"])


@pytest.mark.parametrize("within, starts", [(0, 9), (3, 3), (50, 9)])
def test_windows_begin_within_the_first_steps(within, starts):
    """Windows of 2 + 4 steps in a scene of 14: begin_within is bounded by what fits."""

    class Long:
        n_steps, n_cams = 14, 6

    phase = PhaseConfig(steps=1, horizon=4, history=2, begin_within=within, target_views=1)
    drawn = set()
    for step in range(60):
        (window,) = draw_windows([Long()], DataConfig(context_views=2), phase, 0, step, [0])
        drawn.add(window.steps[0])
    assert drawn == set(range(starts))
    always = dataclasses.replace(phase, from_start=1.0)
    assert draw_windows([Long()], DataConfig(context_views=2), always, 0, 3, [0])[0].steps[0] == 0


def test_position_noise_moves_bodies_smoothly():
    data, state = DataConfig(position_noise=0.01), make_history((2000, 2000))
    assert draw_noise(DataConfig(), 2, 0, 0, [0]) is None and displaced(state, None, 1.0) is state
    pairs = torch.cdist(state.means[:2000], state.means[:2000])
    near, far = (((pairs > low) & (pairs < high)).nonzero()[::97] for low, high in ((0, 0.02), (0.4, 1)))
    moved, apart = [], {0.02: [], 0.4: []}
    for step in range(30):
        noise = draw_noise(data, 2, 7, step, [3])
        assert torch.equal(draw_noise(data, 2, 7, step, [1, 3])[2:], noise)
        offsets = displaced(state, noise, TINY.grid_size).means - state.means
        assert not offsets[state.activity == FROZEN].any()
        moves = state.activity == DYNAMIC
        moved.append(offsets[moves])
        for name, (a, b) in zip(apart, (near.T, far.T), strict=True):
            both = moves[a] & moves[b]
            apart[name].append((offsets[a] - offsets[b])[both].square().mean())
    deviations = torch.cat(moved).square().mean(0).sqrt()
    assert ((deviations / 0.01 - 1).abs() < 0.25).all(), deviations
    assert sum(apart[0.02]) < 0.05 * sum(apart[0.4])


def test_position_noise_changes_simulated_steps_in_training_alone(folder, tmp_path):
    config = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, position_noise=0.05))
    trainer = Trainer(config, scenes(folder), tmp_path)
    batch = draw_batch(trainer.scenes, config.data, CONFIG.phases[1], 0, 0, [0])
    (_, noisy), (_, clean) = trainer.loss(batch), trainer.loss(dataclasses.replace(batch, noise=None))
    n = batch.n_context
    assert torch.equal(noisy[:n], clean[:n]) and (noisy[n:] != clean[n:]).all()


def test_cut_bounds_steps_of_gradients(folder, tmp_path):
    """The last of four steps is compared: gradients reach the particles of those steps that are not cut off."""
    trainer = trainer_at(folder, tmp_path)
    with torch.no_grad():
        for parameter in trainer.simulator.dynamics.net.head.parameters():
            parameter.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    reached = {}
    for cut in (0, 1, 2, 3, 4):
        phase = dataclasses.replace(CONFIG.phases[1], horizon=4, cut=cut, from_start=1.0)
        batch, watch = draw_batch(trainer.scenes, CONFIG.data, phase, 0, LATER, [0]), StepWatch()
        trainer.step = 0  # one that is logged
        images = trainer._images(batch, 0, watch)
        errors = (images - batch.targets.images.permute(0, 2, 3, 1)).square()
        errors[batch.targets.cameras.image_cloud == batch.n_context + 3].mean().backward()
        reached[cut] = [norm > 0 for norm in watch.norms()]
    assert reached[0] == reached[4] == [True] * 4
    assert reached[1] == [False, False, False, True]
    assert reached[2] == [False, False, True, True]
    assert reached[3] == [False, False, False, True]  # three steps, then one
