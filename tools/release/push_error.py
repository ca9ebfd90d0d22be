#!/usr/bin/env python
"""Errors of the final positions of pushed bodies, of a simulator with actions and of *constant*.

    python tools/release/push_error.py push-small runs/held_out --out runs/push_error.json --device cuda

DATA is a set of `gsim3d generate push --seed 77`, whose instance images and states tell the bodies apart. The predicted
motion of a body is the rigid motion that fits its particles best, between the last encoded and the last predicted step.
Printed and written: for the body that is pushed farthest in each scene, the distance of its predicted from its true
center in metres, that of *constant*, which is how far it was pushed, and their medians with 95 %
intervals.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.data import Scene, find_scenes  # noqa: E402
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.protocol import default_views, horizon, input_frames  # noqa: E402
from gsim3d.io.files import opencv_path, write_whole  # noqa: E402
from gsim3d.io.terminal import progress  # noqa: E402
from gsim3d.nn.multiview_encoder import pixel_rows  # noqa: E402
from gsim3d.state import last_steps  # noqa: E402
from gsim3d.synth.render import FIRST_BODY  # noqa: E402
from gsim3d.synth.writer import FILE_TEMPLATE  # noqa: E402
from gsim3d.train.restore import Restored, restore  # noqa: E402
from gsim3d.train.samples import subsampled  # noqa: E402

LEAST = 8  # particles of a body; others are left out


def scene_errors(restored: Restored, scene: Scene) -> dict[str, float] | None:
    """Returns "model" and "constant" of the body that is pushed farthest; None if no input shows enough of it.

    Raises:
        InputError: the scene was not generated with its bodies.
    """
    simulator, n_encoded = restored.simulator, restored.n_encoded
    n_future, (context, _) = horizon(scene, n_encoded, None), default_views(restored, scene)
    with np.load(scene.path / "states.npz") as states:
        centers = [states[name][:, 0] for name in sorted(states.files) if name.startswith("body_")]
    first, last = (np.stack(centers)[:, step] for step in (n_encoded - 1, n_encoded + n_future - 1))
    moved = np.linalg.norm(last - first, axis=1)
    body = int(moved.argmax())
    frames = input_frames(restored, [scene], [context])
    frames = subsampled(frames, restored.data).to(restored.device)
    with torch.no_grad():
        state = simulator.encode(frames)
    shown = torch.from_numpy(_instances(scene, context, n_encoded)).to(restored.device)
    newest = last_steps(state, 1)
    rows = pixel_rows(frames, shown == FIRST_BODY + body)[-newest.n_rows :]
    if int(rows.sum()) < LEAST:
        return None
    final = simulator.predict(state, n_future, restored.plan).steps[-1]
    before, after = newest.means[rows].double().cpu().numpy(), final.means[rows].double().cpu().numpy()
    found = moved_rigidly(first[body], before, after)
    return {"model": float(np.linalg.norm(found - last[body])), "constant": float(moved[body])}


def moved_rigidly(point: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Moves ``point`` [3] by the rigid motion that maps ``before`` [N, 3] best to ``after`` [N, 3]."""
    a, b = before.mean(0), after.mean(0)
    u, _, vh = np.linalg.svd((after - b).T @ (before - a))
    u[:, -1] *= np.linalg.det(u @ vh)
    return u @ vh @ (point - a) + b


def median(values: list[float]) -> list[float]:
    """The median and its 95 % interval, from 10,000 samples with replacement."""
    drawn = np.random.default_rng(0).choice(values, (10_000, len(values)))
    return [float(np.median(values)), *np.percentile(np.median(drawn, 1), (2.5, 97.5)).tolist()]


def _instances(scene: Scene, cams, n_steps: int) -> np.ndarray:
    import cv2

    images = []
    for step in range(n_steps):
        for cam in cams:
            file = scene.path / (FILE_TEMPLATE.format(cam_ix=cam, img_type="inst", n_step=step) + ".png")
            image = cv2.imread(opencv_path(file), cv2.IMREAD_GRAYSCALE)
            if image is None or image.shape != (scene.height, scene.width):
                raise InputError(f"{file} cannot be read as an image of {scene.width}x{scene.height} pixels")
            images.append(image)
    return np.stack(images)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("checkpoint", help="name, run folder or weights")
    parser.add_argument("data", type=Path, help="generated set of the world push")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    args = parser.parse_args(arguments)
    restored, folders, scenes = restore(args.checkpoint, args.device), find_scenes(args.data), {}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    for folder in progress(folders, "scenes", len(folders), unit="scene"):
        if errors := scene_errors(restored, restored.open_scene(folder)):
            scenes[folder.relative_to(args.data).as_posix()] = errors
    if not scenes:
        raise InputError(f"{args.data}: no scene shows enough of a body")
    found = {name: median([errors[name] for errors in scenes.values()]) for name in ("model", "constant")}
    write_whole(args.out, json.dumps({"median": found, "scenes": scenes}, indent=1) + "\n")
    shown = (f"{name} {value:.3f} m (95 %: {low:.3f} to {high:.3f})" for name, (value, low, high) in found.items())
    print(f"{len(scenes)} scenes, {len(folders) - len(scenes)} left out; error in the median: {', '.join(shown)}")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError) as error:
        sys.exit(f"push_error: error: {error}")
