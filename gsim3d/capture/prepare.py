"""From a capture to scenes that a model trains on: rate, crops, size, strides and depths, and the prepared images."""

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsim3d.capture.check import SAMPLES, angles, moving_bodies
from gsim3d.data import Scene
from gsim3d.data.fitting import Fitting, frame_stride, scale_colors, scale_labels
from gsim3d.data.recording import BACKGROUND, MOVING, evenly_spaced
from gsim3d.data.scene import SIZE_MULTIPLE
from gsim3d.data.videos import FILE
from gsim3d.errors import InputError

WANTED_FPS = 15.0
WORKING_SIDE = 512  # pixels; larger images are scaled down before anything else is done
SIDES = {"cpu": 64, "cuda": 128}  # pixels, longer side of the images that a model sees
PARTICLES = {"cpu": 1500, "cuda": 12_000}  # of a step
PRESETS = {"cpu": "tiny", "cuda": "small"}
HISTORY = {"cpu": 2, "cuda": 4}
MARGIN = 0.15  # around the moving bodies, of the size of their box
MOST = 0.95  # of the pixels of a mask, and of the steps, that the box around moving bodies encloses
DEPTH_MARGINS = (0.85, 1.15)  # around the depths of the moving bodies
HELD_OUT_SHARE = 0.15  # of a single take, its last steps


@dataclass(frozen=True)
class Proposal:
    """What a capture is turned into."""

    fps: float  #: frames per second
    size: tuple[int, int]  #: (width, height) of the images in pixels
    #: left, top, width and height of the crop of each camera, in pixels of the working images
    crops: tuple[tuple[int, int, int, int], ...]
    near_far: tuple[float, float]  #: depth range in metres
    body_stride: int  #: every n-th row and column of pixels becomes a particle
    held_out_camera: int | None  #: camera that is only a target; None: every camera is an input


def open_take(folder: Path, cache: Path) -> Scene:
    """Opens a take in working size, at the rate nearest to WANTED_FPS that divides its own."""
    recorded = Scene.open(folder)
    width, height = (max(side) for side in zip(*recorded.recorded_sizes, strict=True))
    share = WORKING_SIDE / max(width, height)
    size = (round(width * share), round(height * share)) if share < 1 else None
    rate = recorded.fps / max(1, round(recorded.fps / WANTED_FPS))
    cache.mkdir(parents=True, exist_ok=True)
    return Scene.open(folder, cache_dir=cache, fitting=Fitting(size, enlarge=True, whole=True), fps=rate)


def propose(takes: Sequence[Scene], device: str, say: Callable[[str], None]) -> Proposal:
    """Decides how the takes of a capture are prepared, and says why."""
    first = takes[0]
    if any(frame_stride(take.fps, first.fps) != 1 for take in takes):
        raise InputError("the takes differ in frame rate; capture them in folders of their own")
    say(f"  rate: {first.fps:g} frames a second, nearest to {WANTED_FPS:g}: steps large enough to see motion")
    has_masks = all(take.has_segmentation() for take in takes)
    sizes = first.recording.sizes
    boxes, pixels = _boxes(takes) if has_masks else ([(0, 0, *size) for size in sizes], max(w * h for w, h in sizes))
    aspect = float(np.median([box[2] / box[3] for box in boxes]))
    longer = min(SIDES[device], max(max(box[2:]) for box in boxes))
    sides = longer * min(1, aspect), longer * min(1, 1 / aspect)
    size = tuple(max(2 * SIZE_MULTIPLE, int(side // SIZE_MULTIPLE) * SIZE_MULTIPLE) for side in sides)
    crops = [_shaped(box, size, image) for box, image in zip(boxes, sizes, strict=True)]
    what = f"where bodies move, and {MARGIN:.0%} around" if has_masks else "the whole image, because there are no masks"
    say(f"  crop: {what}; scaled to {size[0]}x{size[1]} pixels, what a model for {device} affords")
    scale = max(size[0] / crop[2] for crop in crops)
    particles = pixels * scale**2 * first.n_cams
    limit = PARTICLES[device]
    stride = max(1, int(np.ceil(np.sqrt(particles / limit))))
    say(f"  stride: {stride}, so that a step has about {particles / stride**2:.0f} particles (limit {limit})")
    around = _depths(takes) if has_masks else None
    depths, why = (around, "around the moving bodies") if around else ((first.near, first.far), "of the cameras")
    say(f"  depth: {depths[0]:.2f} to {depths[1]:.2f} m, {why}")
    if first.n_cams > 3:
        nearest = np.sort(angles(first.recording.viewmats[0]), axis=1)[:, 1:3]
        held_out = int(np.argmin(nearest.sum(1)))
        say(f"  held out: camera {first.camera_names[held_out]}, which the others surround best")
    else:
        held_out, why = None, f"there are only {first.n_cams}; each is drawn from the particles of the others"
        say(f"  held out: no camera, because {why}")
    return Proposal(first.fps, size, tuple(crops), depths, stride, held_out)


def _boxes(takes: Sequence[Scene]) -> tuple[list[tuple], float]:
    """Returns for each camera the box of its moving pixels (left, top, width, height), and their largest mean count."""
    low, high, counts = [], [], []
    for cam, (width, height) in enumerate(takes[0].recording.sizes):
        moving = np.concatenate(
            [(t.segmentation([cam], evenly_spaced(t.n_steps, SAMPLES))[:, 0] == MOVING).numpy() for t in takes]
        )
        y, x = (np.flatnonzero(moving.any((0, axis))) for axis in (2, 1))
        if not len(x):
            raise InputError(
                f"{takes[0].path}: nothing moves in the masks of camera {takes[0].camera_names[cam]}; record a moving "
                'body, give masks, or set "masks": "none" in cameras.json'
            )
        counts.append(moving.sum((1, 2)).mean())
        border = MARGIN * max(np.ptp(x), np.ptp(y))
        low.append((max(0, x[0] - border), max(0, y[0] - border)))
        high.append((min(width, x[-1] + 1 + border), min(height, y[-1] + 1 + border)))
    return [(*a, b[0] - a[0], b[1] - a[1]) for a, b in zip(low, high, strict=True)], max(counts)


def _shaped(box: tuple, size: tuple[int, int], image: tuple[int, int]) -> tuple[int, int, int, int]:
    """Returns the smallest box around ``box`` with the aspect of ``size``, moved into the image where it fits."""
    share = max(box[2] / size[0], box[3] / size[1])
    wanted = [max(1, round(side * share)) for side in size]
    corner = []
    for begin, length, side, limit in zip(box[:2], box[2:], wanted, image, strict=True):
        start = begin + length / 2 - side / 2
        corner.append(round(np.clip(start, 0, limit - side) if side <= limit else (limit - side) / 2))
    return *corner, *wanted


def _depths(takes: Sequence[Scene]) -> tuple[float, float] | None:
    """Returns the range of depths in which bodies move; None if it is unknown.

    Of spheres around the point nearest to the rays through the masks' centroids, which stretch less than visual hulls.
    """
    depths = []
    for take in takes:
        viewmats, Ks = take.recording.cameras_at_step(0)
        for found in filter(None, (moving_bodies(take, step) for step in evenly_spaced(take.n_steps, SAMPLES))):
            seen, pixels, middles, point = found
            depth = viewmats[seen, 2, :3] @ point + viewmats[seen, 2, 3]
            spans = [np.quantile(np.linalg.norm(own - m, axis=1), MOST) for own, m in zip(pixels, middles)]
            radius = np.median(np.array(spans) * depth / Ks[seen, 0, 0])
            depths.append((depth.min() - radius, depth.max() + radius))
    if not depths:
        return None
    near, far = (float(np.quantile([d[end] for d in depths], q)) for end, q in ((0, 1 - MOST), (1, MOST)))
    return (DEPTH_MARGINS[0] * near, DEPTH_MARGINS[1] * far) if near > 0 else None


def write_scene(take: Scene, proposal: Proposal, steps: Sequence[int], folder: Path) -> None:
    """Writes consecutive ``steps`` of a take of :func:`open_take` as a scene of the layout videos, which appears
    complete: cropped, scaled and undistorted as proposed, with labels."""
    unfinished = folder.with_name(f".{folder.name}")
    viewmats, Ks = take.recording.cameras_at_step(0)
    cameras = []
    for cam, (name, crop) in enumerate(zip(take.camera_names, proposal.crops, strict=True)):
        for kind in ("labels", "."):
            (unfinished / kind / name).mkdir(parents=True, exist_ok=True)
        for number, step in enumerate(steps):
            image = take.recorded_images([cam], [step])[0, 0].permute(1, 2, 0).numpy()
            labels = np.full(image.shape[:2], MOVING, np.uint8)
            if take.has_segmentation():
                labels = take.segmentation([cam], [step])[0, 0].numpy()
            if (valid := take.valid([cam], [step])) is not None:
                labels = np.where(valid[0, 0].numpy(), labels, BACKGROUND)
            file = f"{name}/{number:05d}.png"
            small = scale_colors(_cropped(image, crop), proposal.size)
            cv2.imwrite(str(unfinished / file), small[..., ::-1])
            cv2.imwrite(str(unfinished / "labels" / file), scale_labels(_cropped(labels, crop), proposal.size))
        scale = np.diag([proposal.size[0] / crop[2], proposal.size[1] / crop[3], 1.0])
        K = scale @ (Ks[cam] - [[0, 0, crop[0]], [0, 0, crop[1]], [0, 0, 0]])
        pose = {"K": K.tolist(), "R": viewmats[cam, :3, :3].tolist(), "T": viewmats[cam, :3, 3].tolist()}
        cameras.append({"name": name, "size": list(proposal.size), **pose})
    content = {"fps": proposal.fps, "near": proposal.near_far[0], "far": proposal.near_far[1], "cameras": cameras}
    (unfinished / FILE).write_text(json.dumps(content, indent=1))
    os.replace(unfinished, folder)


def _cropped(image: np.ndarray, crop: tuple[int, int, int, int]) -> np.ndarray:
    """Returns the crop of an image, black outside."""
    left, top, width, height = crop
    over = [max(0, -top), max(0, top + height - image.shape[0]), max(0, -left), max(0, left + width - image.shape[1])]
    padded = cv2.copyMakeBorder(image, *over, cv2.BORDER_CONSTANT, value=0)
    return padded[top + over[0] :, left + over[2] :][:height, :width]
