"""Hard cases of training, and of what measures it."""

import json
import math

import pytest
import torch

from gsim3d.data import Scene, find_scenes
from gsim3d.evaluate.metrics import PSNR_CAP, mean_of_counted, psnr, ssim
from gsim3d.io import checkpoint
from gsim3d.train import loop
from gsim3d.train.config import DataConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.losses import image_errors
from tests.stability.setting import NAMES
from tests.tiny_scenes import write_scenes

NAN, INF = float("nan"), float("inf")
FLOAT32 = pytest.mark.parametrize("setting", [name for name in NAMES if "float32" in name], indirect=True)
TRAINING = TrainConfig(
    phases=(PhaseConfig(steps=3, horizon=1, target_views=1, learning_rate=1e-3),),
    data=DataConfig(history=2, context_views=2, background_stride=2),
    optimizer=OptimizerConfig(ema_decay=0.9, clip_norm=0.5),
    log_every=1,
    checkpoint_every=1,
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = write_scenes(tmp_path_factory.mktemp("scenes"), 2)
    return [Scene.open(path) for path in find_scenes(folder)]


@FLOAT32
@pytest.mark.parametrize("poison", [NAN, INF])
def test_d44_a_step_that_is_not_finite_is_skipped(setting, measured, scenes, tmp_path, poison):
    trainer = Trainer(TRAINING, scenes, tmp_path, device=setting.device.type)
    trainer.train_step()
    loss, before = trainer.loss, {k: v.clone() for k, v in trainer.simulator.state_dict().items()}
    trainer.loss = lambda *given: tuple(poison * value for value in loss(*given))
    entry = trainer.train_step()
    assert "not finite" in entry["skipped"]
    for name, value in trainer.simulator.state_dict().items():
        measured.same_bits(value, before[name], name)
    trainer.loss = loss
    entry = trainer.train_step()
    assert "skipped" not in entry and math.isfinite(entry["grad_norm"]) and trainer.n_skipped == 1
    measured.outcome("skipped, logged, weights kept")


@FLOAT32
def test_d44_gradients_are_clipped(setting, measured, scenes, tmp_path):
    """Of a loss 1e6 times as steep the optimizer remembers a gradient as long as the limit, and no longer."""
    trainer = Trainer(TRAINING, scenes, tmp_path, device=setting.device.type)
    loss = trainer.loss
    trainer.loss = lambda *given: tuple(1e6 * value for value in loss(*given))
    entry = trainer.train_step()
    settings = TRAINING.optimizer
    assert entry["grad_norm"] > settings.clip_norm
    means = [state["exp_avg"] for state in trainer.optimizer.state.values()]
    norm = torch.nn.utils.get_total_norm(means).item() / (1 - settings.beta1)  # of the first gradient
    assert norm == pytest.approx(settings.clip_norm, rel=1e-3)
    measured.finite(*means, *trainer.parameters.values())
    measured.outcome("clipped, norm logged")


def test_d49_perfect_and_empty_images(setting, measured):
    """PSNR has a cap; an image with nothing in it has no PSNR and is left out; a loss over no pixel is 0."""
    g = torch.Generator().manual_seed(0)
    target = setting.to(torch.rand(3, 16, 16, 3, generator=g))
    prediction = target.clone()
    prediction[2] = 1 - target[2]
    mask = torch.ones(3, 16, 16, dtype=torch.bool, device=setting.device)
    mask[1] = False
    values = psnr(prediction, target, mask)
    assert values[0] == PSNR_CAP and values[1].isnan() and 0 < values[2] < 10
    assert mean_of_counted(values) == pytest.approx(float(values[[0, 2]].mean()))
    assert mean_of_counted(values[1:2]) is None
    black = torch.zeros_like(target)
    assert psnr(black, black).tolist() == [PSNR_CAP] * 3
    measured.finite(ssim(black, black), ssim(prediction, target))
    leaf = target.clone().requires_grad_()
    errors = image_errors(leaf, target, mask.to(leaf.dtype) * 0)
    (grad,) = torch.autograd.grad(errors.sum() + image_errors(leaf, target).sum(), leaf)
    assert not errors.any() and not grad.any()
    measured.finite(errors, grad)
    measured.outcome("100 dB; left out; 0")


def curve(run):
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "machine"} for line in lines]


class Killed(BaseException):
    """Not caught by the training loop, like a signal."""


@FLOAT32
@pytest.mark.parametrize("when", ["in the step", "in the checkpoint"])
def test_d50_resume_after_kill(setting, measured, scenes, tmp_path, when, monkeypatch):
    """Killed once in every step, before or while its checkpoint is written: the curve of a run that never was."""
    Trainer(TRAINING, scenes, tmp_path / "whole", device=setting.device.type).run(progress=False)
    victim = {"in the step": (loop, "update_average"), "in the checkpoint": (checkpoint, "_sync")}[when]
    original = getattr(*victim)
    for step in range(TRAINING.n_steps):
        trainer = Trainer(TRAINING, scenes, tmp_path / "killed", device=setting.device.type)
        assert trainer.step == step

        def kill(*given, **options):
            raise Killed

        monkeypatch.setattr(*victim, kill)
        with pytest.raises(Killed):
            trainer.run(progress=False)
        monkeypatch.setattr(*victim, original)
        Trainer(TRAINING, scenes, tmp_path / "killed", device=setting.device.type).run(until=step + 1, progress=False)
    assert curve(tmp_path / "killed") == curve(tmp_path / "whole")
    killed, whole = (checkpoint.load(tmp_path / name) for name in ("killed", "whole"))
    for part in ("model", "ema", "optimizer"):
        for name, value in getattr(whole, part).items():
            measured.same_bits(getattr(killed, part)[name], value, f"{part} {name}")
    measured.outcome("the same curve")
