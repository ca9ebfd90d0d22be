"""Implementation of ``gsim3d demo``: generates multi-view video and predicts it with a shipped or new simulator."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.data import Scene, split_scenes
from gsim3d.evaluate import pictures
from gsim3d.evaluate.protocol import Prediction, default_views, predict, render_steps, score_scene
from gsim3d.evaluate.report import summarize, table, write_json
from gsim3d.io import checkpoint, write_video
from gsim3d.io.terminal import progress as shown
from gsim3d.synth import generate
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.log import memory_gib
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore
from gsim3d.train.run import run_folder
from gsim3d.viewer.clips import clip_frames

_phase = partial(PhaseConfig, batch=2, target_views=2, warm_up=0.1)


@dataclass(frozen=True)
class DemoConfig:
    """Configuration of a demo."""

    preset: str = "mini"  #: data preset of gsim3d.synth
    #: options that override those of the preset
    data: dict[str, Any] = field(default_factory=lambda: {"n_frames": 18, "fps": 16.0, "image_size": 64})
    train: TrainConfig = TrainConfig(
        preset="tiny",
        data=DataConfig(history=2, context_views=3, target_only_cameras=(2, 7), background_stride=2),
        phases=(
            _phase(steps=400, history=1, learning_rate=2e-3),
            _phase(steps=100, horizon=3, from_start=0.4, learning_rate=2e-3),
            _phase(steps=120, horizon=7, from_start=0.4, learning_rate=1.5e-3),
            _phase(steps=110, horizon=14, from_start=0.5, learning_rate=1e-3),
        ),
        loss=LossConfig(body_weight=2.0),
        optimizer=OptimizerConfig(clip_norm=1.0, ema_decay=0.98),
        workers=2,
        checkpoint_every=50,
        log_every=1,
    )  #: training configuration
    simulator: str | None = None  #: name of a shipped simulator to use; None trains a new one


SHIPPED = DemoConfig(
    preset="diverse", data={"n_trajectories": 2, "objects": ("star", "torus")}, simulator="elastic-small"
)


def run_demo(out: str | Path, config: DemoConfig | None = None, *, progress: bool = True) -> dict:
    """Runs or resumes the demo in the folder ``out``; returns the content of metrics.json.

    Raises:
        InputError: ``out`` is not a folder or contains a run with other settings, or a package is missing.
    """
    config = config or DemoConfig()
    out, start = Path(out), time.perf_counter()
    with run_folder(out):
        return _run(out, config, progress, start)


def _run(out: Path, config: DemoConfig, progress: bool, start: float) -> dict:
    seconds = _Stopwatch(out / "seconds.json")
    pictures.pyplot()  # raises early without matplotlib
    place = "data" if config.simulator is None else "held_out"
    print("generating multi-view video of falling bodies", flush=True)
    with seconds.measure("data"):
        folders = generate(out / place, preset=config.preset, progress=progress, **config.data).folders
    if config.simulator is None:
        train_folders, folders = split_scenes(folders)
        print(f"training on {len(train_folders)} scenes; {len(folders)} held out", flush=True)
        _train(out, config.train, train_folders, progress, seconds)
    print("predicting the held-out scenes", flush=True)
    with seconds.measure("evaluation"):
        predictor = _Predictor(config.simulator or out / "model")
        scenes = [predictor.restored.open_scene(folder) for folder in folders]
        summary = _evaluate(out, predictor, scenes, progress)
    print("writing pictures", flush=True)
    with seconds.measure("pictures"):
        _pictures(out, predictor, scenes, summary)
    _report(out, summary, seconds.total, time.perf_counter() - start)
    return summary


class _Stopwatch:
    """Seconds spent in each section, accumulated over resumed runs in a file."""

    def __init__(self, file: Path):
        self.file = file
        try:
            self.total = json.loads(file.read_text())
        except (OSError, ValueError):
            self.total = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.total[name] = round(self.total.get(name, 0.0) + time.perf_counter() - start, 1)
            self.file.write_text(json.dumps(self.total))


def _train(out: Path, config: TrainConfig, folders: list[Path], progress: bool, seconds: _Stopwatch) -> None:
    """Trains all steps and exports the model."""
    trainer = Trainer(config, [Scene.open(folder) for folder in folders], out / "model")
    if 0 < trainer.step < config.n_steps:
        print(f"    resuming at step {trainer.step}", flush=True)
    if trainer.step < config.n_steps:
        with seconds.measure("training"):
            trainer.run(progress=progress)
    if not (out / "model.safetensors").is_file():
        checkpoint.export(checkpoint.load(out / "model"), out / "model.safetensors")


class _Predictor:
    """Predicts scenes to their last step, and caches the predictions."""

    def __init__(self, simulator: str | Path):
        self.restored, self._known = restore(simulator), {}

    def __call__(self, scene: Scene) -> Prediction:
        if scene.path not in self._known:
            context, _ = default_views(self.restored, scene)
            n_future = scene.n_steps - self.restored.data.history
            self._known[scene.path] = predict(self.restored, scene, context, n_future)
        return self._known[scene.path]


def _evaluate(out: Path, predictor: _Predictor, scenes: list, progress: bool) -> dict:
    """Returns the scores of ``scenes``, read from metrics.json if it is up to date with the checkpoint."""
    digest, file = predictor.restored.checkpoint.digest, out / "metrics.json"
    try:
        summary = json.loads(file.read_text())
    except (OSError, ValueError):
        summary = {}
    if summary.get("checkpoint") != digest or "methods" not in summary:
        scenes = shown(scenes, "scenes", unit="scene", quiet=not progress)
        scores = [score_scene(predictor.restored, scene, prediction=predictor(scene)) for scene in scenes]
        summary = {"checkpoint": digest, **summarize(scores)}
        write_json(file, summary)
    return summary


def _pictures(out: Path, predictor: _Predictor, scenes: list, summary: dict) -> None:
    """Writes all pictures if one is missing or older than metrics.json."""
    restored = predictor.restored
    made = [out / name for name in ("rollout.mp4", "psnr.png", "overview.png")]
    age = (out / "metrics.json").stat().st_mtime
    if all(file.is_file() and file.stat().st_mtime >= age for file in made):
        return
    truth, images, first = [], [], None
    for scene in scenes:
        _, target = default_views(restored, scene)
        prediction = predictor(scene)
        rendered = render_steps(restored, prediction.particles, scene, target[:1])
        truth.append(pictures.true_images(scene, target[:1], range(prediction.n_steps)))
        images.append(pictures.as_bytes(rendered))
        if first is None:
            first = (scene, prediction, rendered[:, 0], target[0])
    scene, prediction, rendered, cam = first
    pictures.write_gaussians(out / "gaussians", restored, prediction, scene.fps)
    pictures.write_curves(made[1], summary, scene.fps, ("psnr", "psnr_masked"))
    pictures.write_overview(made[2], restored, scene, prediction, rendered, cam)
    rows = {"truth": np.concatenate(truth, 1), "predicted": np.concatenate(images, 1)}
    write_video(made[0], clip_frames(rows, scene.fps, prediction.n_encoded), scene.fps)


def comparisons(summary: dict) -> list[tuple[str, float, float]]:
    """Returns (description, model, baseline) of three comparisons with baselines; PSNR in dB."""
    rows = {
        "PSNR of predicted steps, against constant": ("future.psnr", "constant"),
        "the same, masked": ("future.psnr_masked", "constant"),
        "masked, second half of the horizon, against copy": ("future_late.psnr_masked", "copy"),
    }
    return [(what, summary[score], summary[f"{baseline}.{score}"]) for what, (score, baseline) in rows.items()]


def _report(out: Path, summary: dict, seconds: dict, now: float) -> None:
    print()
    print(table(summary))
    print()
    for what, model, baseline in comparisons(summary):
        verdict = "better" if model > baseline else "WORSE"
        margin = f"{verdict} by {abs(model - baseline):.2f} dB"
        print(f"{what + ':':52}{model:7.2f} dB, baseline {baseline:.2f} dB: {margin}")
    parts = ", ".join(f"{name} {value:.0f}" for name, value in seconds.items())
    in_all = f"{sum(seconds.values()):.0f} in total, {now:.0f} in this run"
    print(f"\nseconds: {parts}; {in_all}; peak memory {memory_gib('cpu'):.1f} GiB")
    print(f"open {out / 'rollout.mp4'} and {out / 'overview.png'}")
