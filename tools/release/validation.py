"""Scores of validation trajectories during a training run: masked PSNR of given and predicted steps, scene by scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from gsim3d.evaluate.pictures import as_bytes, comparison_frames
from gsim3d.evaluate.protocol import default_views, predict_together, render_steps
from gsim3d.evaluate.scoring import SceneTruth
from gsim3d.io import write_video
from gsim3d.train.restore import restore

TOGETHER = 8  # trajectories that are predicted at the same time
FILMED = 3  # trajectories in the film
METRICS = ("psnr_masked", "psnr_body")


@torch.no_grad()
def validate(weights: Path, folders: Sequence[Path], device: str) -> tuple[dict, dict]:
    """Mean scores over scenes [dB] with the values of each scene, and images of the first scenes for a film.

    Args:
        weights: the checkpoint.
        folders: scenes.
        device: "cpu" or "cuda".
    Returns:
        ``past``, ``future``, ``body`` (means over scenes of means over steps and target views), ``constant`` (the last
        encoded step held still), ``step``, and ``scenes``: name -> [past, future, body, constant]; and for
        :func:`write_film` true and predicted images and the frame rate.
    """
    restored = restore(weights, device)
    scenes = [restored.open_scene(folder) for folder in folders]
    n_encoded = restored.data.history
    n_future = min(scene.n_steps for scene in scenes) - n_encoded
    values, film = {}, {"truth": [], "predicted": [], "fps": scenes[0].fps}
    for first in range(0, len(scenes), TOGETHER):
        group = scenes[first : first + TOGETHER]
        for scene, prediction in zip(group, predict_together(restored, group, n_future), strict=True):
            cams = list(default_views(restored, scene)[1])
            images = scene.images(cams, range(n_encoded + n_future)).permute(0, 1, 3, 4, 2).to(device).float() / 255
            labels = scene.segmentation(cams, range(n_encoded + n_future)).to(device)
            truth = SceneTruth(scene.name, images, labels, None, n_encoded, METRICS)
            rendered = render_steps(restored, prediction.particles, scene, cams)
            held = rendered[n_encoded - 1].expand(n_future, *rendered.shape[1:])
            scores = truth.score([("model", rendered), ("constant", held)]).values
            masked, body = (scores["model"][metric] for metric in METRICS)
            parts = masked[:n_encoded], masked[n_encoded:], body[n_encoded:], scores["constant"]["psnr_masked"]
            values[scene.name] = [round(float(part.nanmean()), 4) for part in parts]
            if len(film["truth"]) < FILMED:
                film["truth"].append(as_bytes(images[:, :1]))
                film["predicted"].append(as_bytes(rendered[:, :1]))
    means = np.mean(list(values.values()), 0).round(4).tolist()
    named = dict(zip(("past", "future", "body", "constant"), means, strict=True))
    return {"step": restored.checkpoint.state["step"], **named, "scenes": values}, film


def write_film(path: Path, film: dict) -> None:
    """Truth above prediction, trajectories side by side."""
    truth, predicted = (np.concatenate(film[part], 1) for part in ("truth", "predicted"))
    write_video(path, comparison_frames(truth, predicted), film["fps"])
