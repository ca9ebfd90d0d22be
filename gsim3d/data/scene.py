"""Scene: images, labels and cameras of a recorded scene, independent of its layout on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames, InputSpec
from gsim3d.data import layouts
from gsim3d.data.cameras import check_directions, frusta_origin, near_zero, shared_view, spread_steps
from gsim3d.data.fitting import Fitting, check_rate, fit, own_depths, resample, similar
from gsim3d.data.frames import make_frames
from gsim3d.data.images import ImageCache
from gsim3d.data.lenses import Undistorter
from gsim3d.data.masks import background_image, foreground
from gsim3d.data.recording import BACKGROUND, MOVING, Problems, ReadImages, Recording, read_json
from gsim3d.errors import InputError
from gsim3d.io.plain import is_number

CACHE_VERSION = 2  # increase when readers decode the same files differently
SIZE_MULTIPLE = 16  # pixels; image sizes are padded to a multiple, which the encoders of all presets accept


class Scene:
    """One recorded scene.

    Attributes:
        path: scene folder.
        name: last two components of the path.
        layout: name of the layout, see :mod:`gsim3d.data.layouts`.
        recording: cameras and readers, converted as ``fitting`` specifies.
        recorded_sizes: (width, height) of each camera's images as recorded.
        fitting: conversion of the recording.
        n_steps, n_cams: number of steps and cameras.
        fps: steps per second.
        camera_names: names for messages.
        near, far: depth range of the scene in metres.
        width, height: size of all images in pixels: the largest camera's, padded at the right and bottom to multiples
            of 16.
        origin: float64 [3] metres, lower corner of the workspace.
        world_offset: float64 [3] metres, translation that makes coordinates small enough for float32: position +
            ``world_offset`` is in the coordinates of the files. 0 unless the scene is far from the origin.
    """

    def __init__(
        self, path: Path, recording: Recording, cache_dir: str | Path | None = None, fitting: Fitting = Fitting()
    ):
        self.path = path
        self.recorded_sizes = recording.sizes
        self._recorded, self.fitting = near_zero(recording), fitting
        recording = fit(self._recorded, fitting)
        self.name = "/".join(path.absolute().parts[-2:])
        self.recording = recording
        self.layout, self.camera_names = recording.layout, recording.camera_names
        self.n_steps, self.fps, self.n_cams = recording.n_steps, recording.fps, len(recording.camera_names)
        self.near, self.far = _depths(recording)
        self.world_offset = recording.world_offset
        largest = fitting.size or np.array(recording.sizes).max(0)
        self.width, self.height = (int(-(-side // SIZE_MULTIPLE) * SIZE_MULTIPLE) for side in largest)
        if recording.origin is not None:
            self.origin = recording.origin
        else:
            self.origin = frusta_origin(*self._view()) if recording.bounds is None else recording.bounds[0]
        self._undistorters = [
            None if lens is None else Undistorter(lens, size)
            for lens, size in zip(recording.distortions or (None,) * self.n_cams, recording.sizes, strict=True)
        ]
        self._backgrounds: dict[int, np.ndarray] = {}
        shape = (self.n_steps, self.n_cams, self.height, self.width)
        stamp = (CACHE_VERSION, str(path.resolve()), recording.source.stat().st_mtime_ns, *(fitting.size or ()))
        stamp += ("whole",) * fitting.whole
        self._images = ImageCache((*shape, 3), self._read_images, cache_dir, (*stamp, "rgb"))
        self._labels = ImageCache(shape, self._read_labels, cache_dir, (*stamp, "seg"))

    @staticmethod
    def open(
        folder: str | Path,
        *,
        cache_dir: str | Path | None = None,
        fitting: Fitting = Fitting(),
        fps: float | None = None,
    ) -> Scene:
        """Opens a scene folder; images are decoded once, when first read.

        Args:
            folder: scene folder of any layout.
            cache_dir: folder to cache decoded images in, for data sets larger than memory. Default: cache in memory.
            fitting: image size, depth range and unit of a model. Default: as recorded.
            fps: frame rate to subsample to; must divide the recording's rate. Default: all frames.

        Raises:
            InputError: a file is invalid; names file, camera and frame.
        """
        path = Path(folder)
        problems = Problems()
        recording = layouts.read(path, problems)
        check_directions(recording, problems)
        if fps is not None:
            recording = resample(recording, fps)
        return Scene(path, recording, cache_dir, fitting)

    @cached_property
    def bounds(self) -> np.ndarray:
        """Bounding box of the scene, float64 [2, 3] metres; if not given, the region that most cameras see."""
        return shared_view(*self._view()) if self.recording.bounds is None else self.recording.bounds

    @cached_property
    def generated(self) -> dict:
        """What the generator wrote to metadata.json; of other scenes nothing that is asked for."""
        file = self.path / "metadata.json"
        return read_json(file) if file.is_file() else {}

    @property
    def ground_height(self) -> float | None:
        """Metres along z: what the generator wrote, else 0; None if it left the ground out."""
        height = self.generated.get("ground_height", 0.0)
        if height is not None and not is_number(height, float):
            raise InputError(f"{self.path}: metadata.json: ground_height must be metres or null; got {height!r}")
        return None if height is None else float(height) - float(self.world_offset[2])

    @property
    def own_depths(self) -> tuple[float, float] | None:
        """near and far before ``fitting.near_far`` is applied; None if the recording does not determine them."""
        return own_depths(fit(self._recorded, Fitting(unit_cameras=self.fitting.unit_cameras)))

    def _view(self) -> tuple:
        recording = self.recording
        return spread_steps(recording.viewmats), spread_steps(recording.Ks), recording.sizes, self.near, self.far

    def __repr__(self) -> str:
        return (
            f"Scene({str(self.path)!r}: {self.layout}, {self.n_steps} steps, {self.n_cams} cameras, "
            f"{self.width}x{self.height})"
        )

    def cameras_at(self, cams, steps) -> Cameras:
        """Returns the len(steps) * len(cams) cameras at ``steps`` x ``cams``, ordered by step.

        ``image_cloud`` counts the steps from 0. Steps past the end use the cameras of the last step.
        """
        steps = [min(int(step), self.n_steps - 1) for step in steps]
        steps, cams = self._numbers(cams, steps)
        viewmats, Ks = (
            torch.from_numpy(values[np.ix_([step if len(values) > 1 else 0 for step in steps], cams)]).flatten(0, 1)
            for values in (self.recording.viewmats, self.recording.Ks)
        )
        n_images = len(viewmats)
        return Cameras(
            viewmats=viewmats.float(),
            Ks=Ks.float(),
            near=torch.full((n_images,), self.near),
            far=torch.full((n_images,), self.far),
            image_cloud=torch.arange(len(steps)).repeat_interleave(len(cams)),
            width=self.width,
            height=self.height,
        )

    @property
    def cameras_move(self) -> bool:
        """Whether poses or intrinsics change over time."""
        return len(self.recording.viewmats) > 1 or len(self.recording.Ks) > 1

    def images(self, cams, steps) -> Tensor:
        """Returns RGB images, uint8 [len(steps), len(cams), 3, H, W].

        Padding is black. So is the background of real scenes with labels, because it is not simulated.

        Args:
            cams, steps: indices of cameras and steps.
        """
        images = self.recorded_images(cams, steps)
        if self.recording.real_background and self.has_segmentation():
            images *= (self.segmentation(cams, steps) != BACKGROUND)[:, :, None]
        return images

    def recorded_images(self, cams, steps) -> Tensor:
        """Returns images as :meth:`images` does, with the background."""
        images = self._images.get(*self._numbers(cams, steps))
        return torch.from_numpy(images).permute(0, 1, 4, 2, 3).contiguous()

    def segmentation(self, cams, steps) -> Tensor:
        """Returns labels, uint8 [len(steps), len(cams), H, W]: 0 background, 1 static geometry, 3 movable bodies."""
        if not self.has_segmentation():
            raise InputError(f"{self.path}: the scene has no segmentation labels")
        return torch.from_numpy(self._labels.get(*self._numbers(cams, steps)))

    def has_segmentation(self) -> bool:
        """Returns whether the scene has labels, recorded or by background subtraction."""
        return self.recording.read_labels is not None or self.recording.subtract_background

    def has_actions(self) -> bool:
        """Returns whether the scene has actors."""
        return self.recording.actions is not None

    def valid(self, cams, steps) -> Tensor | None:
        """Returns bool [len(steps), len(cams), H, W]: pixels that are neither padding nor outside the distorted image.

        None if all pixels are valid.
        """
        steps, cams = self._numbers(cams, steps)
        full = all(self.recording.sizes[cam] == (self.width, self.height) for cam in cams)
        if full and all(self._undistorters[cam] is None for cam in cams):
            return None
        valid = torch.zeros(len(steps), len(cams), self.height, self.width, dtype=torch.bool)
        for j, cam in enumerate(cams):
            width, height = self.recording.sizes[cam]
            undistorter = self._undistorters[cam]
            for i, step in enumerate(steps):
                inner = True if undistorter is None else torch.from_numpy(undistorter.valid(self._K(cam, step)))
                valid[i, j, :height, :width] = inner
        return valid

    def input_frames(self, inputs: InputSpec, *, start: int = 0, cams: Sequence[int] | None = None) -> Frames:
        """Returns input frames for a simulator (:class:`gsim3d.cameras.FrameSource`).

        A scene that was opened as recorded gets the depth range of the training if its own differs by at most a factor
        of 1.25, as `gsim3d simulate` does.

        Args:
            inputs: input specification of the simulator.
            start: first step.
            cams: camera indices. Default: the number used in training, evenly spaced over the cameras allowed as input.

        Raises:
            InputError: the scene has too few steps or cameras, or another frame rate than the training.
        """
        if not 0 <= start <= self.n_steps - inputs.history:
            raise InputError(
                f"{self.path}: needs {inputs.history} steps from step {start}, but the scene has {self.n_steps} steps"
            )
        if cams is None:
            known = all(cam < self.n_cams for cam in (*inputs.context_cameras, *inputs.target_only_cameras))
            excluded = set(inputs.target_only_cameras) if known else set()
            allowed = [cam for cam in (known and inputs.context_cameras) or range(self.n_cams) if cam not in excluded]
            n = min(inputs.context_views, len(allowed))
            cams = sorted(allowed[k * len(allowed) // n] for k in range(n))
        check_rate(self, inputs.fps)
        frames = make_frames([self], [list(cams)], [range(start, start + inputs.history)])
        # What Restored.open_scene has opened enlarges images; its depths are fitted, or kept on request.
        as_recorded = self.fitting.near_far is None and not self.fitting.enlarge
        if not (inputs.near_far and as_recorded and similar((self.near, self.far), inputs.near_far)):
            return frames
        near, far = (torch.full_like(frames.cameras.near, depth) for depth in inputs.near_far)
        return dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, near=near, far=far))

    def _numbers(self, cams, steps) -> tuple[list[int], list[int]]:
        cams, steps = [int(c) for c in cams], [int(s) for s in steps]
        for what, values, count in (("camera", cams, self.n_cams), ("step", steps, self.n_steps)):
            for value in values:
                if not 0 <= value < count:
                    raise InputError(f"{self.path}: {what} {value} does not exist; the scene has {count}")
        return steps, cams

    def _K(self, cam: int, step: int) -> np.ndarray:
        return self.recording.cameras_at_step(step)[1][cam]

    def with_images(self, read_images: ReadImages) -> Scene:
        """Returns the scene with its images replaced; ``read_images`` yields images of ``recorded_sizes``."""
        return Scene(self.path, dataclasses.replace(self._recorded, read_images=read_images), None, self.fitting)

    def _read_images(self, cam: int, steps: Sequence[int]) -> Iterator[np.ndarray]:
        undistorter = self._undistorters[cam]
        for step, image in zip(steps, self.recording.read_images(cam, steps, Problems()), strict=True):
            yield self._padded(image if undistorter is None else undistorter(image, self._K(cam, step)))

    def _read_labels(self, cam: int, steps: Sequence[int]) -> Iterator[np.ndarray]:
        if self.recording.subtract_background:
            yield from self._subtracted(cam, steps)
            return
        undistorter = self._undistorters[cam]
        for step, labels in zip(steps, self.recording.read_labels(cam, steps, Problems()), strict=True):
            if undistorter is not None:
                K = self._K(cam, step)
                labels = undistorter(labels, K, nearest=True) * undistorter.valid(K)
            yield self._padded(labels)

    def _subtracted(self, cam: int, steps: Sequence[int]) -> Iterator[np.ndarray]:
        width, height = self.recording.sizes[cam]

        def read(wanted: Sequence[int]) -> np.ndarray:
            return self._images.get(wanted, [cam])[:, 0, :height, :width]

        if cam not in self._backgrounds:
            self._backgrounds[cam] = background_image(read, self.n_steps)
        valid = self.valid([cam], [0])
        for step in steps:
            labels = self._padded(foreground(read([step])[0], self._backgrounds[cam]).astype(np.uint8) * MOVING)
            yield labels if valid is None else labels * valid[0, 0].numpy()

    def _padded(self, image: np.ndarray) -> np.ndarray:
        if image.shape[:2] == (self.height, self.width):
            return image
        try:
            padded = np.zeros((self.height, self.width, *image.shape[2:]), image.dtype)
        except MemoryError:
            raise InputError(f"{self.path}: out of memory for images of {self.width}x{self.height} pixels") from None
        padded[: image.shape[0], : image.shape[1]] = image
        return padded


def _depths(recording: Recording) -> tuple[float, float]:
    """Returns near and far in metres, given or estimated from the cameras."""
    depths = own_depths(recording)
    if depths is None:
        raise InputError(
            f"{recording.source}: near and far (metres) are needed: they cannot be estimated, because the cameras do "
            "not look at a common point"
        )
    near, far = depths
    if not 0 < np.float32(near) < np.float32(far):  # Cameras stores float32
        raise InputError(f"{recording.source}: far must lie beyond near; got near {near:g} and far {far:g}")
    return near, far
