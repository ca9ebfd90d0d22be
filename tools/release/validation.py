"""Scores of validation trajectories during a training run: masked PSNR of given and predicted steps, scene by scene."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsim3d.data import Scene
from gsim3d.evaluate.pictures import as_bytes, true_images
from gsim3d.evaluate.protocol import default_views, predict, render_steps, score_scenes
from gsim3d.io import write_video
from gsim3d.train.restore import Restored, restore
from gsim3d.viewer.clips import clip_frames

SHOWN = 3  # trajectories in the video
METRICS = ("psnr_masked", "psnr_body")
GIVEN = 4  # steps before the predicted ones; a model of fewer is given the last of them


def validate(weights: Path, folders: Sequence[Path], device: str) -> tuple[dict, Restored, list[Scene]]:
    """Mean scores over scenes [dB] with the values of each scene; the model and the scenes.

    Args:
        weights: the checkpoint.
        folders: scenes.
        device: "cpu" or "cuda".
    Returns:
        ``past``, ``future``, ``body`` (means over scenes of means over steps and target views), ``constant`` (the last
        encoded step held still), ``step``, and ``scenes``: name -> [past, future, body, constant].
    """
    restored = restore(weights, device)
    scenes = [restored.open_scene(folder) for folder in folders]
    n_encoded, views = restored.data.history, [default_views(restored, scene) for scene in scenes]
    start, values = max(0, GIVEN - n_encoded), {}
    n_future = min(scene.n_steps for scene in scenes) - n_encoded - start
    given = {"n_encoded": n_encoded, "n_future": n_future, "metrics": METRICS, "methods": ("model", "constant")}
    for scores in score_scenes(restored, scenes, views, start=start, **given):
        masked, body = (scores.values["model"][metric] for metric in METRICS)
        held = scores.values["constant"]["psnr_masked"]
        parts = masked[:n_encoded], masked[n_encoded:], body[n_encoded:], held
        values[scores.scene] = [round(float(part.nanmean()), 4) for part in parts]
    means = np.mean(list(values.values()), 0).round(4).tolist()
    named = dict(zip(("past", "future", "body", "constant"), means, strict=True))
    return {"step": restored.checkpoint.state["step"], **named, "scenes": values}, restored, scenes


def write_comparison(path: Path, restored: Restored, scenes: Sequence[Scene]) -> None:
    """A video of the first scenes: truth above prediction, trajectories side by side."""
    n_steps, truth, predicted = min(scene.n_steps for scene in scenes), [], []
    for scene in scenes[:SHOWN]:
        context, targets = default_views(restored, scene)
        prediction = predict(restored, scene, context, n_steps - restored.data.history)
        truth.append(true_images(scene, targets[:1], range(n_steps)))
        predicted.append(as_bytes(render_steps(restored, prediction.particles, scene, targets[:1])))
    rows = {"truth": np.concatenate(truth, 1), "predicted": np.concatenate(predicted, 1)}
    write_video(path, clip_frames(rows, scenes[0].fps, restored.data.history), scenes[0].fps)
