"""Conversion of recordings to a model's image size, frame rate, depth range and unit of length."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from gsim3d.data.cameras import depth_range, spread_steps
from gsim3d.data.recording import BACKGROUND, FIXED, MOVING, ReadImages, Recording
from gsim3d.errors import InputError

SIMILAR = 1.25  # scenes whose near and far differ by at most this factor use those of a training
MIN_EXTENT = 1e-3  # metres; scenes with smaller camera coordinates are not normalised
RATE_TOLERANCE = 1.0001e-3  # relative; 29.97 and 30 fps count as equal


def frame_stride(rate: float, wanted: float) -> int | None:
    """Returns the integer ``rate / wanted``; None if ``rate`` is not an integer multiple of ``wanted``."""
    stride = max(1, round(rate / wanted))
    return stride if math.isclose(rate, stride * wanted, rel_tol=RATE_TOLERANCE) else None


def check_rate(scene: Any, fps: float | None) -> None:
    """Raises InputError if the frame rate of ``scene`` is not ``fps`` (None: unknown); names both, and a remedy."""
    if fps is None or scene.n_steps == 1 or (stride := frame_stride(scene.fps, fps)) == 1:
        return
    how = f"--resample, or Scene.open(folder, fps={fps:g}), takes every frame number {stride}"
    raise InputError(
        f"{scene.path}: {scene.fps:g} frames per second; the model was trained at {fps:g} "
        f"({how if stride else 'not an integer multiple: resample the scene'})"
    )


def similar(depths: tuple[float, float], others: tuple[float, float], factor: float = SIMILAR) -> bool:
    """Whether two (near, far) differ by at most ``factor``."""
    return all(max(a / b, b / a) <= factor for a, b in zip(depths, others, strict=True))


def resample(recording: Recording, fps: float) -> Recording:
    """Subsamples ``recording`` to ``fps``; raises InputError if its rate is not an integer multiple of ``fps``."""
    if recording.n_steps == 1:
        return recording
    stride = frame_stride(recording.fps, fps)
    if stride is None:
        raise InputError(
            f"{recording.source}: its {recording.fps:g} fps are not an integer multiple of the requested {fps:g} fps"
        )
    if stride == 1:
        return recording

    def strided(read: ReadImages) -> ReadImages:
        return lambda cam, steps, problems: read(cam, [stride * step for step in steps], problems)

    viewmats, Ks = (values[::stride] if len(values) > 1 else values for values in (recording.viewmats, recording.Ks))
    return dataclasses.replace(
        recording,
        n_steps=-(-recording.n_steps // stride),
        fps=recording.fps / stride,
        viewmats=viewmats,
        Ks=Ks,
        read_images=strided(recording.read_images),
        read_labels=None if recording.read_labels is None else strided(recording.read_labels),
        actions=recording.actions and recording.actions.every(stride),
    )


@dataclass(frozen=True)
class Fitting:
    """How recordings are converted for a model; the defaults change nothing."""

    #: (width, height) in pixels. Images are resized to cover it (bilinear, antialiased) and centre-cropped.
    size: tuple[int, int] | None = None
    near_far: tuple[float, float] | None = None  #: depth range of all scenes in metres, after ``unit_cameras``
    unit_cameras: bool = False  #: divide lengths by the largest camera coordinate of the scene's first step
    #: scenes whose own near or far differs from ``near_far`` by more than this factor keep their own
    slack: float = math.inf
    enlarge: bool = False  #: upsample images smaller than ``size``; otherwise they are an error
    whole: bool = False  #: resize images to fit into ``size`` and pad them, instead of cropping


def fit(recording: Recording, fitting: Fitting) -> Recording:
    """Converts ``recording``; raises InputError if images are smaller than ``fitting.size`` without ``enlarge``."""
    if fitting.unit_cameras:
        recording = _in_units_of_cameras(recording)
    if fitting.size is not None and any(size != fitting.size for size in recording.sizes):
        recording = _of_size(recording, fitting.size, fitting)
    if fitting.near_far is not None:
        own, (near, far) = own_depths(recording), fitting.near_far
        if own is None or similar(own, fitting.near_far, fitting.slack):
            recording = dataclasses.replace(recording, near=near, far=far)
    return recording


def own_depths(recording: Recording) -> tuple[float, float] | None:
    """Returns the recording's near and far, estimated from the cameras where absent; None if they have no focus."""
    near, far = recording.near, recording.far
    if near is None or far is None:
        guessed = depth_range(spread_steps(recording.viewmats).reshape(-1, 4, 4))
        if guessed is None:
            return None
        near, far = near or guessed[0], far or guessed[1]
    return near, far


def _in_units_of_cameras(recording: Recording) -> Recording:
    first = recording.viewmats[0]
    centers = -np.einsum("vji,vj->vi", first[:, :3, :3], first[:, :3, 3])
    extent = float(np.abs(centers).max())
    if extent < MIN_EXTENT:
        return recording
    viewmats = recording.viewmats.copy()
    viewmats[..., :3, 3] /= extent
    lengths = {
        name: value / extent
        for name in ("near", "far", "origin", "bounds", "world_offset")
        if (value := getattr(recording, name)) is not None
    }
    actions = recording.changed_actions(lambda positions: positions / extent)
    return dataclasses.replace(recording, viewmats=viewmats, actions=actions, **lengths)


def _of_size(recording: Recording, size: tuple[int, int], how: Fitting) -> Recording:
    width, height = size
    scaled, corners, sizes, Ks = [], [], [], recording.Ks.copy()
    for cam, (w, h) in enumerate(recording.sizes):
        if (w < width or h < height) and not how.enlarge:
            raise InputError(
                f"{recording.source}: camera {recording.camera_names[cam]} has images of {w}x{h} pixels; the model "
                f"needs at least {width}x{height}"
            )
        share = (min if how.whole else max)(width / w, height / h)
        large = max(1, round(w * share)), max(1, round(h * share))
        kept = min(width, large[0]), min(height, large[1])
        corner = (large[0] - kept[0]) // 2, (large[1] - kept[1]) // 2
        for axis in (0, 1):
            Ks[:, cam, axis] *= large[axis] / (w, h)[axis]
            Ks[:, cam, axis, 2] -= corner[axis]
        scaled.append(large)
        corners.append(corner)
        sizes.append(kept)

    def changed(read: ReadImages, scale: Callable[[np.ndarray, tuple[int, int]], np.ndarray]) -> ReadImages:
        def read_images(cam, steps, problems):
            left, top = corners[cam]
            for image in read(cam, steps, problems):
                if image is not None:
                    image = scale(image, scaled[cam])[top : top + height, left : left + width]
                yield image

        return read_images

    return dataclasses.replace(
        recording,
        Ks=Ks,
        sizes=tuple(sizes),
        read_images=changed(recording.read_images, scale_colors),
        read_labels=None if recording.read_labels is None else changed(recording.read_labels, scale_labels),
    )


def _smooth(maps: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    return F.interpolate(maps[None], size[::-1], mode="bilinear", antialias=True)[0]


def scale_colors(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resizes uint8 [h, w, 3], bilinear with antialiasing."""
    scaled = _smooth(torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float(), size)
    return scaled.round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()


def scale_labels(labels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resizes labels uint8 [h, w]: MOVING if any source pixel is, BACKGROUND only if all source pixels are."""
    parts = torch.from_numpy(np.stack([labels != BACKGROUND, labels == MOVING])).float()
    shown, moving = _smooth(parts, size) > 0
    return torch.where(moving, MOVING, torch.where(shown, FIXED, BACKGROUND)).to(torch.uint8).numpy()
