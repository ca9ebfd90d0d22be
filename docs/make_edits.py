"""Edits encoded particles of held-out scenes, which no training shows, and measures what a simulator makes of them.

    python tools/release/score.py elastic-small --data runs/held_out --out runs/scores --sets held_out
    python docs/make_edits.py elastic-small runs/held_out/validation/elastic/held_out --out runs/edits --device cuda

Written to OUT: NAME.edits.json with its table, which is printed; a video and a picture of each of the first scenes, all
edits beside each other. A scene that is measured already, with these weights, is not measured again. Shapes and heights
are those of particles that do not end below the ground. Shadows are those of generated scenes: how much darker the
ground is where the lamp and the predicted body want it, over what the renderer casts. NAME.edits.json and pictures in
docs/results/models are shown on the page of the model.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import torch

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

from gsim3d.data import Scene, find_scenes  # noqa: E402
from gsim3d.effects.edits import Edit, structure_of  # noqa: E402
from gsim3d.evaluate.compare import paired  # noqa: E402
from gsim3d.evaluate.physics import moving_points  # noqa: E402
from gsim3d.evaluate.pictures import as_bytes, save_figure, true_images  # noqa: E402
from gsim3d.evaluate.protocol import default_views, horizon, predict, render_steps  # noqa: E402
from gsim3d.evaluate.report import write_json  # noqa: E402
from gsim3d.io import write_video  # noqa: E402
from gsim3d.io.terminal import progress  # noqa: E402
from gsim3d.reproduce.entries import EDIT_STEPS, EDITED, RAISE, SHOWN, numbers_of_edits, strip  # noqa: E402
from gsim3d.synth.render import AMBIENT, DIFFUSE, LIGHT_DIRECTION  # noqa: E402
from gsim3d.train.restore import Restored, restore  # noqa: E402
from gsim3d.viewer.clips import clip_frames  # noqa: E402

LIT = ("as it is", "thrown up", "duplicated", "ground raised")  # edits whose shadows are measured
CAST = 1 - AMBIENT / (AMBIENT + DIFFUSE * LIGHT_DIRECTION[2])  # share of the light that a shadow of the renderer lacks
DISC, SPACING, NEAR, FAR = 1.1, 0.03, 0.03, 0.25  # metres: of the ground; in a shadow nearer than NEAR, lit beyond FAR
WANTED = {  # number -> what it is, and its target
    "fall": ("fall without ground over free fall, 20 steps", "0.95 to 1.05"),
    "through": ("particles that end below the ground, %", "0"),
    "shape_cm": ("change of shape, cm", "that of the truth"),
    "true_cm": ("change of shape of the truth, cm", ""),
    "copies_cm": ("change of shape of the worst copy, cm", "at most 2"),
    "above_cm": ("lowest points above the raised ground at the end, cm", "0"),
    **{f"shadow {name}": (f"shadow over a whole one, {name}", "1") for name in LIT},
}


def darkness(image: np.ndarray, points: np.ndarray, scene: Scene, cam: int, level: float) -> float:
    """The share of the light that ``image`` [H, W, 3] lacks on the ground where ``points`` [N, 3] shade it from the
    lamp; NaN where the camera sees less than ten such places."""
    steps = np.arange(-DISC, DISC, SPACING)
    ground = np.stack([*np.meshgrid(steps, steps), np.full((len(steps),) * 2, level)], -1).reshape(-1, 3)
    ground = ground[np.linalg.norm(ground[:, :2], axis=1) < DISC]
    away = points[:, 2:] - level
    shaded = (points - away / LIGHT_DIRECTION[2] * LIGHT_DIRECTION)[away[:, 0] > 0, :2]
    covered = np.zeros(image.shape[:2], np.uint8)
    height, width = covered.shape
    rows, columns = pixels(points, scene, cam).T
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    covered[rows[inside], columns[inside]] = 1
    covered = cv2.dilate(covered, np.ones((5, 5), np.uint8))
    rows, columns = pixels(ground, scene, cam).T
    seen = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    seen[seen] = covered[rows[seen], columns[seen]] == 0
    light = image[rows[seen], columns[seen]].mean(1)
    if len(shaded) == 0:
        return float("nan")
    nearest = torch.cdist(torch.from_numpy(ground[seen, :2]), torch.from_numpy(shaded)).amin(1).numpy()
    dark, lit = light[nearest < NEAR], light[nearest > FAR]
    return 1 - dark.mean() / np.median(lit) if min(len(dark), len(lit)) >= 10 else float("nan")


def pixels(points: np.ndarray, scene: Scene, cam: int) -> np.ndarray:
    """Row and column [N, 2] of each of ``points`` [N, 3] in the images of a camera."""
    cameras = scene.cameras_at([cam], [0])
    inside = points @ cameras.viewmats[0, :3, :3].double().numpy().T + cameras.viewmats[0, :3, 3].double().numpy()
    projected = inside @ cameras.Ks[0].double().numpy().T
    return np.floor(projected[:, 1::-1] / projected[:, 2:]).astype(int)


def measured(restored: Restored, scene: Scene, out: Path | None) -> dict[str, float]:
    """The numbers of a scene; its video and picture go to ``out``.mp4 and .png."""
    context, targets = default_views(restored, scene)
    n_given, cam = restored.n_encoded, targets[:1]
    n_future = min(EDIT_STEPS, horizon(scene, n_given, None))
    future = range(n_given, n_given + n_future)
    videos, points, heights = {"truth": true_images(scene, cam, range(future.stop))}, {}, []
    for name, operation in EDITED.items():
        edits = () if operation is None else (Edit(0, operation),)
        spec = dataclasses.replace(restored.plan.spec, structure=structure_of(edits))
        planned = dataclasses.replace(restored, plan=restored.simulator.plan(spec))
        made = predict(planned, scene, context, n_future, edits=edits)
        videos[name] = as_bytes(render_steps(planned, made.particles, scene, cam))
        points[name] = moving_points(made.particles, future)
        if operation is None:
            heights = [moving_points(made.particles, [step])[0, :, 2].mean().item() for step in range(n_given)]
    found = numbers_of_edits(points, heights, scene, n_given)
    for name in LIT if points["as it is"].shape[1] else ():
        level, cast = RAISE * (name == "ground raised"), []
        for step in range(4, n_future, 5):
            body, image = points[name][step].double().numpy(), videos[name][n_given + step, 0]
            cast.append(darkness(image, body, scene, cam[0], level) / CAST)
        found[f"shadow {name}"] = float(np.mean([value for value in cast if np.isfinite(value)] or [np.nan]))
    if out is not None:
        shown = np.linspace(n_given, future.stop - 1, min(SHOWN, n_future)).round().astype(int).tolist()
        times = [f"+{(step - n_given + 1) / scene.fps:.2f} s" for step in shown]
        save_figure(strip({name: images[shown, 0] for name, images in videos.items()}, times), out.with_suffix(".png"))
        write_video(out.with_suffix(".mp4"), clip_frames(videos, scene.fps, n_given), scene.fps)
    return {name: value for name, value in found.items() if np.isfinite(value)}


def table(scenes: dict[str, dict[str, float]]) -> str:
    """Means over scenes with standard errors, beside the targets."""
    lines = ["| | mean | scenes | target |", "| --- | ---: | ---: | ---: |"]
    for key, (what, target) in WANTED.items():
        if values := [numbers[key] for numbers in scenes.values() if key in numbers]:
            mean, error = paired(values)
            spread = "" if error is None else f" ± {error:.2f}"
            extent = f"{min(values):.2f} to {max(values):.2f}"
            lines.append(f"| {what} | {mean:.2f}{spread} ({extent}) | {len(values)} | {target} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="such as elastic-small")
    parser.add_argument("data", type=Path, help="generated set")
    parser.add_argument("--checkpoint", help="where its weights are (default: those that come with gsim3d)")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", type=int, help="how many, one body after another (default: all)")
    parser.add_argument("--videos", type=int, default=6, help="of the first scenes, each of another body (default: 6)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    args = parser.parse_args(arguments)
    restored, file = restore(args.checkpoint or args.name, args.device), args.out / f"{args.name}.edits.json"
    args.out.mkdir(parents=True, exist_ok=True)
    head = {"checkpoint": restored.checkpoint.digest, "step": restored.checkpoint.state["step"]}
    known = json.loads(file.read_text()) if file.is_file() else {}
    scenes = known.get("scenes", {}) if known.get("checkpoint") == head["checkpoint"] else {}
    folders = sorted(find_scenes(args.data), key=lambda path: (path.name, path.parent.name))[: args.scenes]
    for number, folder in enumerate(progress(folders, "scenes", len(folders), unit="scene")):
        name = f"{folder.parent.name}/{folder.name}"
        if name not in scenes:
            place = args.out / f"{args.name}-edits-{folder.parent.name}" if number < args.videos else None
            scenes[name] = measured(restored, restored.open_scene(folder), place)
            write_json(file, {**head, "table": table(scenes), "scenes": scenes})
    print(table(scenes))


if __name__ == "__main__":
    main()
