"""Training: equal bits twice, resuming equals never having stopped, bad numbers are skipped, mistakes are named."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from safetensors.torch import save_file

from gsim3d.data import Scene, find_scenes
from gsim3d.errors import InputError, NumericalError
from gsim3d.evaluate.perceptual.lpips import LPIPS
from gsim3d.evaluate.perceptual.weights import SOURCES, cache_folder
from gsim3d.io import checkpoint
from gsim3d.state import concatenate
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.losses import image_loss, time_weights
from gsim3d.train.restore import restore
from gsim3d.train.samples import draw_batch, spread_views, subsampled
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

CONFIG = TrainConfig(
    phases=(
        PhaseConfig(steps=3, history=1, batch=2, target_views=2, learning_rate=1e-3),
        PhaseConfig(steps=3, horizon=2, target_views=2, from_start=0.5, learning_rate=1e-3),
    ),
    data=DataConfig(history=2, context_views=2, target_only_cameras=(3,), background_stride=2),
    optimizer=OptimizerConfig(ema_decay=0.9),
    log_every=1,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 2)


def scenes(folder):
    return [Scene.open(path) for path in find_scenes(folder)]


def curve(run):
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "machine"} for line in lines]


@pytest.fixture(scope="module")
def finished(folder, tmp_path_factory, one_thread):
    """A run that was never stopped."""
    out = tmp_path_factory.mktemp("run")
    Trainer(CONFIG, scenes(folder), out).run(progress=False)
    return out


def test_training_on_a_device_repeats_and_resumes_bit_by_bit(folder, tmp_path, device):
    for name, runs in (("whole", [None]), ("again", [None]), ("parts", [2, 4, None])):
        for until in runs:
            Trainer(CONFIG, scenes(folder), tmp_path / name, device=device.type).run(until=until, progress=False)
    assert curve(tmp_path / "whole") == curve(tmp_path / "again") == curve(tmp_path / "parts")
    whole, parts = (checkpoint.load(tmp_path / name).model for name in ("whole", "parts"))
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


def assert_same_checkpoint(a, b):
    a, b = checkpoint.load(a), checkpoint.load(b)
    for part in ("model", "ema", "optimizer"):
        before, after = getattr(a, part), getattr(b, part)
        assert before.keys() == after.keys() and before
        assert all(torch.equal(before[name], after[name]) for name in before), part


def test_run_writes_log_and_changes_weights(finished):
    log = curve(finished)
    assert [line["step"] for line in log] == list(range(6))
    assert all(math.isfinite(line["loss"]) and line["grad_norm"] > 0 for line in log)
    assert "future_psnr" not in log[0] and "future_psnr" in log[3]
    saved = checkpoint.load(finished)
    assert saved.state["step"] == 6 and saved.state["n_skipped"] == 0
    assert all(name in saved.config for name in ("model", "data", "effects", "train"))
    assert any(not torch.equal(saved.model[name], saved.ema[name]) for name in saved.model)


def test_the_same_run_twice_gives_the_same_bits(folder, finished, tmp_path):
    Trainer(CONFIG, scenes(folder), tmp_path).run(progress=False)
    assert curve(tmp_path) == curve(finished)
    assert_same_checkpoint(tmp_path, finished)


def test_resumed_run_equals_uninterrupted(folder, finished, tmp_path):
    for until in (2, 4, None):
        Trainer(CONFIG, scenes(folder), tmp_path).run(until=until, progress=False)
    assert curve(tmp_path) == curve(finished)
    assert_same_checkpoint(tmp_path, finished)


def test_run_out_of_time_saves_and_goes_on(folder, finished, tmp_path):
    for steps in (1, 2):
        trainer = Trainer(CONFIG, scenes(folder), tmp_path)
        trainer.run(end=time.monotonic(), progress=False)
        assert trainer.step == steps
    Trainer(CONFIG, scenes(folder), tmp_path).run(progress=False)
    assert curve(tmp_path) == curve(finished)


def test_killed_run_repeats_steps_after_checkpoint(folder, finished, tmp_path):
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from tests.train.test_loop import CONFIG, Trainer, scenes\n"
        "trainer = Trainer(CONFIG, scenes(Path(sys.argv[1])), sys.argv[2])\n"
        "trainer.run(until=2, progress=False)\n"
        "trainer.save = lambda: os.kill(os.getpid(), signal.SIGKILL)\n"
        "trainer.run(until=5, progress=False)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", script, str(folder), str(tmp_path)], env=environment)
    assert done.returncode == -signal.SIGKILL
    assert len(curve(tmp_path)) == 5 and checkpoint.load(tmp_path).state["step"] == 2
    Trainer(CONFIG, scenes(folder), tmp_path).run(progress=False)
    assert curve(tmp_path) == curve(finished)
    assert_same_checkpoint(tmp_path, finished)


def test_weights_that_are_not_finite_are_not_saved(folder, tmp_path):
    trainer = Trainer(CONFIG, scenes(folder), tmp_path)
    trainer.run(until=1, progress=False)
    trainer.average[min(trainer.average)][0] = math.nan
    with pytest.raises(NumericalError, match="holds numbers that are not finite; nothing is written"):
        trainer.run(until=2, progress=False)
    assert checkpoint.load(tmp_path).state["step"] == 1


@pytest.mark.parametrize("part", ["model", "ema", "optimizer"])
def test_a_checkpoint_of_other_tensors_is_refused(folder, finished, tmp_path, part):
    saved = checkpoint.load(finished)
    tensors = dict(getattr(saved, part))
    name = min(tensors)
    for wrong in ({**tensors, name: torch.zeros(1)}, {**tensors, "other": torch.zeros(1)}):
        checkpoint.save(tmp_path, dataclasses.replace(saved, **{part: wrong}))
        if part == "ema" and "other" in wrong:
            continue
        with pytest.raises(InputError, match="its checkpoint does not fit the configuration"):
            Trainer(CONFIG, scenes(folder), tmp_path)


def test_any_number_of_workers_gives_the_same_bits(folder, tmp_path):
    for workers in (1, 2, 3):
        torch.set_num_threads(workers)
        config = dataclasses.replace(CONFIG, phases=CONFIG.phases[:1], workers=workers)
        Trainer(config, scenes(folder), tmp_path / str(workers)).run(progress=False)
        assert torch.get_num_threads() == workers
    torch.set_num_threads(1)
    for workers in (2, 3):
        assert curve(tmp_path / str(workers)) == curve(tmp_path / "1")
        assert_same_checkpoint(tmp_path / str(workers), tmp_path / "1")


def test_workers_give_the_gradient_of_the_whole_batch(folder, tmp_path):
    gradients = []
    for workers in (0, 1):
        trainer = Trainer(dataclasses.replace(CONFIG, workers=workers), scenes(folder), tmp_path)
        trainer.optimizer.update = lambda found, *_: gradients.append(found)
        trainer.train_step()
    for whole, split in zip(*gradients, strict=True):
        assert (whole is None) == (split is None)
        if whole is not None:
            torch.testing.assert_close(split, whole, rtol=1e-3, atol=1e-5)


def test_checkpointing_changes_no_gradient(folder, tmp_path):
    """Every parameter gets the same bits, with drop path and shuffled curves drawn once."""
    gradients = []
    for checkpointing in (False, True):
        model = {"drop_path": 0.3, "shuffle_orders": True, "zero_init": False, "checkpointing": checkpointing}
        trainer = Trainer(dataclasses.replace(CONFIG, model={"dynamics": model}), scenes(folder), tmp_path)
        trainer.simulator.train()
        trainer.step = 4  # of the second phase, which rolls out
        gradients.append(trainer._gradients([0])[2])
    names = list(trainer.parameters)
    unused = set(trainer.plan.unused)
    for name, plain, again in zip(names, *gradients, strict=True):
        if name in unused:
            assert plain is None and again is None
        else:
            assert torch.equal(plain, again) and plain.isfinite().all(), name
    trained = [name for name, gradient in zip(names, gradients[1]) if gradient is not None and gradient.any()]
    assert any("attention.qkv" in name for name in trained) and any("mlp.fc1" in name for name in trained)


def test_perceptual_loss_is_added(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path / "cache"))
    config = dataclasses.replace(CONFIG, loss=LossConfig(perceptual=0.05))
    with pytest.raises(InputError, match="gsim3d weights lpips"):
        Trainer(config, scenes(folder), tmp_path / "run")
    torch.manual_seed(0)
    network = LPIPS("vgg").requires_grad_(False)
    for head in network.heads:
        head.fill_(0.5)
    file = cache_folder() / "lpips_vgg.safetensors"
    file.parent.mkdir(parents=True)
    save_file(network.state_dict(), file, {"sha256": SOURCES["lpips_vgg"].sha256})
    trainers = [Trainer(c, scenes(folder), tmp_path / "run") for c in (config, CONFIG)]
    batch = draw_batch(trainers[0].scenes, CONFIG.data, CONFIG.phases[1], CONFIG.seed, 0, [0])
    (loss, errors), (plain, same) = (trainer.loss(batch) for trainer in trainers)
    assert torch.equal(errors, same)
    simulator, targets = trainers[0].simulator, batch.targets
    particles = simulator.encode(batch.context)
    particles = concatenate([particles, *simulator.rollout(particles, batch.n_future, trainers[0].plan)])
    images = simulator.render(particles, targets.cameras, plan=trainers[0].plan).color
    distances = network(images.permute(0, 3, 1, 2), targets.images)
    extra = 0.05 * image_loss(distances, targets.cameras.image_cloud, time_weights(batch.n_context, batch.n_future))
    assert extra.item() > 1e-4
    assert loss.item() == pytest.approx(plain.item() + extra.item(), rel=1e-5)


def test_another_configuration_does_not_resume(folder, finished):
    with pytest.raises(InputError, match="different 'seed'"):
        Trainer(TrainConfig(**{**vars(CONFIG), "seed": 1}), scenes(folder), finished)
    assert Trainer(TrainConfig(**{**vars(CONFIG), "log_every": 5}), scenes(folder), finished).step == 6


def test_resumed_run_accepts_more_scenes_only(folder, tmp_path):
    known = scenes(folder)
    Trainer(CONFIG, known[:1], tmp_path).run(until=1, progress=False)
    assert Trainer(CONFIG, known[:1], tmp_path).same_scenes and not Trainer(CONFIG, known, tmp_path).same_scenes
    with pytest.raises(InputError, match="trained on 1 scenes that are missing now, such as ball/0000"):
        Trainer(CONFIG, known[1:], tmp_path)


def test_steps_that_are_not_finite_are_skipped(folder, tmp_path):
    trainer = Trainer(CONFIG, scenes(folder), tmp_path)
    loss = trainer.loss
    trainer.loss = lambda *given: tuple(value * (math.nan if trainer.step == 1 else 1) for value in loss(*given))
    before = None
    while trainer.step < 3:
        if trainer.step == 1:
            before = {name: value.clone() for name, value in trainer.simulator.state_dict().items()}
            entry = trainer.train_step()
            after = trainer.simulator.state_dict()
            assert "not finite" in entry["skipped"] and entry["loss"] == "nan" and trainer.n_skipped == 1
            assert all(torch.equal(value, after[name]) for name, value in before.items())
        else:
            assert "skipped" not in trainer.train_step()


def test_a_restored_simulator_predicts_with_the_averaged_weights(folder, finished):
    restored = restore(finished)
    saved = checkpoint.load(finished)
    weights = restored.simulator.state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in saved.ema.items())
    assert restored.image_size == (32, 32) and restored.data == CONFIG.data and not restored.simulator.training


def test_what_does_not_fit_is_named(folder, tmp_path):
    long = TrainConfig(phases=(PhaseConfig(steps=1, horizon=9),), data=CONFIG.data)
    with pytest.raises(InputError, match="windows of 11 steps do not fit"):
        Trainer(long, scenes(folder), tmp_path)
    with pytest.raises(InputError, match=r"4 cameras may be inputs; lower data.context_views \(5\)"):
        data = DataConfig(context_views=5, target_only_cameras=(0,))
        Trainer(TrainConfig(phases=CONFIG.phases, data=data), scenes(folder), tmp_path)
    with pytest.raises(InputError, match="camera 77 of data.target_only_cameras does not exist"):
        data = DataConfig(context_views=1, target_only_cameras=(77,))
        Trainer(TrainConfig(phases=CONFIG.phases, data=data), scenes(folder), tmp_path)
    with pytest.raises(InputError, match="5 steps, but this model takes at most 2"):
        phases = (PhaseConfig(steps=1, horizon=1, target_views=2),)
        Trainer(TrainConfig(phases=phases, data=DataConfig(history=5, context_views=2)), scenes(folder), tmp_path)
    with pytest.raises(InputError, match="preset: must be one of"):
        Trainer(TrainConfig(**{**vars(CONFIG), "preset": "huge"}), scenes(folder), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_samples_depend_on_seed_and_step_only(folder):
    phase = CONFIG.phases[1]

    def key(seed, step):
        batch = draw_batch(scenes(folder), CONFIG.data, phase, seed, step, [0, 1])
        return batch.targets.images.sum().item(), batch.context.images.sum().item()

    assert key(0, 3) == key(0, 3)
    assert len({key(0, 3), key(0, 4), key(1, 3)}) == 3


def test_target_only_cameras_are_never_an_input(folder):
    known = scenes(folder)
    forbidden = known[0].cameras_at([3], [0]).viewmats[0]
    for step in range(20):
        batch = draw_batch(known, CONFIG.data, CONFIG.phases[0], 0, step, [0, 1])
        assert not (batch.context.cameras.viewmats == forbidden).all(-1).all(-1).any()


def test_views_are_spread_evenly():
    assert spread_views(range(12), 4, 0) == (0, 3, 6, 9)
    assert spread_views(range(12), 4, 10) == (1, 4, 7, 10)
    assert spread_views([0, 1, 3, 4], 4, 3) == (0, 1, 3, 4)


def test_subsampling_by_strides(folder):
    frames = draw_batch(scenes(folder), DataConfig(context_views=2), CONFIG.phases[0], 0, 0, [0]).context
    sparse = subsampled(frames, DataConfig(background_stride=2))
    body = frames.dynamic & frames.masks
    assert torch.equal(sparse.masks & frames.dynamic, body)
    ground = frames.masks & ~frames.dynamic
    share = (sparse.masks & ~frames.dynamic).sum() / ground.sum()
    assert 0.15 < share < 0.35
    assert subsampled(frames, DataConfig()) is frames
    pixels, valid = torch.ones_like(frames.masks), frames.images[:, 0] > 0.5
    whole = subsampled(frames, DataConfig(masks=False, background_stride=2))
    assert torch.equal(whole.masks, pixels) and torch.equal(whole.dynamic, pixels)
    padded = dataclasses.replace(frames, valid=valid, masks=None, dynamic=None)
    assert torch.equal(subsampled(padded, DataConfig(masks=False)).masks, valid)
    every = subsampled(frames, DataConfig(masks=False, background_stride=8, body_stride=2)).masks
    assert every.sum() == pixels.sum() / 4
    of_body = subsampled(frames, DataConfig(body_stride=2)).masks
    assert torch.equal(of_body & ~frames.dynamic, ground) and 0.1 < (of_body & body).sum() / body.sum() < 0.4


def test_deterministic_mode_is_left_as_it_was():
    before = torch.are_deterministic_algorithms_enabled()
    with deterministic():
        assert torch.are_deterministic_algorithms_enabled()
    assert torch.are_deterministic_algorithms_enabled() == before
