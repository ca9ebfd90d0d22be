"""Pictures and videos of predictions."""

import dataclasses
import importlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import Prediction, render_steps
from gsim3d.evaluate.scoring import METRICS
from gsim3d.io import write_ply, write_video
from gsim3d.io.files import new_output_path, whole_file, write_picture
from gsim3d.io.particles import STATE, write_particles
from gsim3d.io.sequence import write_about
from gsim3d.io.terminal import progress
from gsim3d.nn.gaussian_head import render
from gsim3d.numerics.trust import draw_values
from gsim3d.state import last_steps
from gsim3d.train.restore import Restored
from gsim3d.viewer.clips import clip_frames, turbo
from gsim3d.viewer.player import View, write_player

SPLAT_SIZE = 320  # pixels, height of the picture of the Gaussians
SPLAT_SHRINK = 0.45  # factor of the scales in it, which makes single Gaussians visible
CURVES = {  # method -> label, colour
    "model": ("model", "#1f5fbf"),
    "constant": ("constant (last encoded particles)", "#c0504d"),
    "copy": ("copy (last true frame)", "#7f7f7f"),
    "constant_velocity": ("constant velocity", "#e0a030"),
    "release_constant": ("constant (first predicted)", "#d8a0a0"),
    "perfect_ground": ("constant on exact ground", "#4f9d4f"),
    "perfect_body": ("exact bodies on constant ground", "#8064a2"),
}


def as_bytes(images: Tensor) -> np.ndarray:
    """Converts images in [0, 1] to uint8."""
    return (images * 255).round().to(torch.uint8).cpu().numpy()


def true_images(scene: Scene, cams: Sequence[int], steps: Sequence[int]) -> np.ndarray:
    """Returns recorded images, uint8 [S, V, H, W, 3]; black after the scene's last step."""
    known = [step for step in steps if step < scene.n_steps]
    images = np.zeros((len(steps), len(cams), scene.height, scene.width, 3), np.uint8)
    if known:
        images[: len(known)] = scene.images(list(cams), known).permute(0, 1, 3, 4, 2).numpy()
    return images


@torch.no_grad()
def write_gaussians(folder: str | Path, restored: Restored, prediction: Prediction, fps: float) -> None:
    """Writes one .ply file per step (step_0000.ply, ...) and sequence.json with the frame rate into ``folder``."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    gaussians = restored.simulator.renderer(prediction.particles).to("cpu")
    for step in range(prediction.n_steps):
        write_ply(folder / f"step_{step:04d}.ply", gaussians, step)
    write_about(folder, fps)


def write_prediction(
    folder: str | Path,
    restored: Restored,
    scene: Scene,
    prediction: Prediction,
    cams: Sequence[int],
    first: int = 0,
    *,
    player: bool = False,
    quiet: bool = True,
    bounds: Tensor | None = None,
) -> None:
    """Writes a prediction as images, video, Gaussians and state into ``folder``, which is moved into place at the end.

    Args:
        cams: cameras to render.
        first: step of the scene at which the prediction starts.
        player: also write player.html.
        quiet: hide the progress bar.
        bounds: [S, N] metres, bounds of the errors of the predicted particles, a further row of the video.
    """
    folder = Path(folder)
    steps = [prediction.particles.select_clouds([step]) for step in range(prediction.n_steps)]
    steps = progress(steps, "rendering", unit="step", quiet=quiet)
    images = [as_bytes(render_steps(restored, step, scene, cams, first + i))[0] for i, step in enumerate(steps)]
    truth = true_images(scene, cams, range(first, first + len(images)))
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")  # another call may write to the same folder
    try:
        (part / "frames").mkdir(parents=True)
        for step, views in enumerate(images):
            for cam, image in zip(cams, views, strict=True):
                write_picture(part / "frames" / f"cam_{cam}_{step:04d}.png", image)
        rows = {"truth": truth, "predicted": np.stack(images)}
        if bounds is not None:
            rows = bound_images(restored, scene, prediction, cams, first, bounds) | rows
        write_video(part / "rollout.mp4", clip_frames(rows, scene.fps, prediction.n_encoded), scene.fps)
        write_gaussians(part / "gaussians", restored, prediction, scene.fps)
        last = last_steps(prediction.particles, 2**restored.simulator.config.dynamics.history_bits)
        write_particles(part / STATE, last, restored.checkpoint.digest)
        if player:
            camera = scene.cameras_at(cams[:1], [first])
            write_player(
                part / "player.html",
                restored.simulator.renderer(prediction.particles).to("cpu"),
                fps=scene.fps,
                title=scene.name,
                view=View(camera.viewmats[0].numpy(), camera.Ks[0].numpy(), camera.width, camera.height),
                truth=truth[:, 0],
                start=prediction.n_encoded,
            )
        os.replace(part, new_output_path(folder))
    finally:
        shutil.rmtree(part, ignore_errors=True)


def bound_images(
    restored: Restored, scene: Scene, prediction: Prediction, cams: Sequence[int], first: int, bounds: Tensor
) -> dict[str, np.ndarray]:
    """Renders the bounds of errors [S, N] as colours: a row of a video, whose label names the bound of the last colour.

    Given steps are black, as pixels without particles.
    """
    largest, n_steps = max(float(bounds.max()), 1e-9), prediction.n_steps
    images = np.zeros((n_steps, len(cams), scene.height, scene.width, 3), np.uint8)
    for step, values in enumerate(bounds, prediction.n_encoded):
        cameras = scene.cameras_at(cams, [first + step]).to(values.device)
        drawn = draw_values(restored.simulator, prediction.step(step), values / largest, cameras)
        shown = drawn.cpu().numpy()
        images[step] = np.where(shown[..., None] > 0, turbo(shown), 0)
    return {f"bound, red {largest:.2g} m": images}


@torch.no_grad()
def splat_picture(restored: Restored, prediction: Prediction, scene: Scene, cam: int, step: int) -> np.ndarray:
    """Renders the Gaussians of a step with reduced scales, on white, at a higher resolution than the images."""
    zoom = SPLAT_SIZE / scene.height
    device = prediction.particles.means.device
    camera = scene.cameras_at([cam], [step]).to(device)
    Ks = camera.Ks * torch.tensor([zoom, zoom, 1.0], device=device)[:, None]
    camera = Cameras(
        camera.viewmats, Ks, camera.near, camera.far, camera.image_cloud, round(scene.width * zoom), SPLAT_SIZE
    )
    gaussians = restored.simulator.renderer(prediction.particles.select_clouds(torch.tensor([step], device=device)))
    gaussians = dataclasses.replace(gaussians, scales=gaussians.scales * SPLAT_SHRINK)
    jacobian = restored.simulator.config.renderer.jacobian
    return as_bytes(render(gaussians, camera, torch.ones(3, device=device), jacobian=jacobian).color[0].clamp(0, 1))


def write_overview(
    path: str | Path, restored: Restored, scene: Scene, prediction: Prediction, images: Tensor, cam: int
) -> None:
    """Writes an overview picture: input views, Gaussians, and true above predicted frames ``images`` [S, H, W, 3],
    rendered from ``cam``."""
    plt = pyplot()
    last_given, n_steps = prediction.n_encoded - 1, prediction.n_steps
    inputs = true_images(scene, prediction.context_cams, [last_given])[0]
    shown = np.linspace(prediction.n_encoded, n_steps - 1, 5).round().astype(int)
    truth = true_images(scene, [cam], shown)[:, 0]
    figure = plt.figure(figsize=(13.5, 4.1), facecolor="white")
    margins = {"left": 0.01, "right": 0.995, "top": 0.86, "bottom": 0.05}
    parts = figure.add_gridspec(1, 3, width_ratios=(2, 2.05, 5.1), wspace=0.07, **margins)

    def show(cell, image, title=None, label=None):
        axes = figure.add_subplot(cell)
        axes.imshow(image, interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        for side in axes.spines.values():
            side.set_visible(False)
        if title:
            axes.set_title(title, fontsize=9, color="#333333", pad=3)
        if label:
            axes.set_ylabel(label, fontsize=10, color="#333333")

    views = parts[0].subgridspec(2, 2, hspace=0.06, wspace=0.06)
    for k, image in enumerate(inputs[:4]):
        show(views[k // 2, k % 2], image)
    show(parts[1], splat_picture(restored, prediction, scene, cam, last_given))
    frames = parts[2].subgridspec(2, 5, hspace=0.06, wspace=0.06)
    for k, step in enumerate(shown):
        time = f"+{(step - last_given) / scene.fps:.2f} s"
        show(frames[0, k], truth[k], time, "truth" if k == 0 else None)
        show(frames[1, k], as_bytes(images[step]), None, "predicted" if k == 0 else None)
    heads = {f"{len(inputs)} input views": 0.11, "particles as 3D Gaussians": 0.34}
    heads["the future, from a camera never seen"] = 0.72
    for text, x in heads.items():
        figure.text(x, 0.94, text, ha="center", fontsize=12)
    save_figure(figure, path)


def write_curves(path: str | Path, summary: dict, fps: float | None, metrics: Sequence[str] = tuple(METRICS)) -> None:
    """Plots ``metrics`` of every method over time, as far as the summary has them by step, and for the first method the
    deviation between scenes. ``fps``: steps per second; None: the axis is in steps."""
    plt = pyplot()
    methods, n_encoded = summary["methods"], summary["n_encoded_steps"]
    prefixes = {method: "" if method == "model" else f"{method}." for method in methods}
    drawn = [m for m in metrics if f"{prefixes[methods[0]]}{m}" in summary["by_step"]]
    columns = min(len(drawn), 3)
    rows = -(-len(drawn) // columns)
    figure, panels = plt.subplots(rows, columns, figsize=(5 * columns, 3.8 * rows), squeeze=False, layout="constrained")
    unit = 1 if fps is None else fps
    for axes, metric in zip(panels.flat, drawn):
        for k, method in enumerate(methods):
            if f"{prefixes[method]}{metric}" not in summary["by_step"]:
                continue
            values, deviation = (
                np.array(summary[key][f"{prefixes[method]}{metric}"], dtype=float) for key in ("by_step", "by_step_std")
            )
            times = (np.arange(len(values)) - (n_encoded - 1)) / unit
            label, color = CURVES.get(method, (method, f"C{k}"))
            axes.plot(times, values, color=color, linewidth=1.3 if k else 2.4, label=label)
            if k == 0:
                axes.fill_between(times, values - deviation, values + deviation, color=color, alpha=0.15, linewidth=0)
        axes.axvspan((0.5 - n_encoded) / unit, 0.5 / unit, color="#eeeeee", zorder=0)
        what = METRICS[metric]
        axes.set(title=what.label, xlabel=f"{'steps' if fps is None else 'seconds'} after the last given frame")
        axes.set_ylabel("dB" if metric.startswith("psnr") else "higher is better" if what.rises else "lower is better")
        axes.grid(alpha=0.3)
    for axes in panels.flat[len(drawn) :]:
        axes.remove()
    max(panels.flat[: len(drawn)], key=lambda axes: len(axes.lines)).legend(fontsize=8)
    save_figure(figure, path)


def pyplot():
    """Imports matplotlib's pyplot without a display. Raises InputError if matplotlib is not installed."""
    try:
        import matplotlib
    except ImportError:
        raise InputError("plots need matplotlib: pip install 'gsim3d[plot]'") from None
    matplotlib.use("Agg")
    return importlib.import_module("matplotlib.pyplot")


def save_figure(figure, path: str | Path) -> None:
    """Writes a figure of matplotlib as PNG, atomically, and closes it."""
    with whole_file(path) as part:
        figure.savefig(part, dpi=110)
    pyplot().close(figure)
