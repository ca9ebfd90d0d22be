"""Predictions of other models, read from a folder that mirrors the data set.

    DIR/<scene folder relative to DATA>/cam_<j>/<frames>.png      each name ends in the index of its step
    DIR/<scene folder relative to DATA>/cam_<j>.mp4               or one video per camera

Steps count from 0, the first frame of the scene. Frames of input steps are optional and ignored. A video starts at step
0 or at the first predicted step, and ends at the last compared step or at the end of the scene.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from gsim3d.data import Scene
from gsim3d.data.images import IMAGE_SUFFIXES, as_color, read_files
from gsim3d.data.recording import Problems
from gsim3d.data.video_file import Video
from gsim3d.data.videos import VIDEO_SUFFIXES
from gsim3d.errors import InputError

RESERVED = ("model", "constant", "copy", "constant_velocity", "release_constant", "perfect_ground", "perfect_body",
            "truth", "past", "future")  # fmt: skip


@dataclass(frozen=True)
class Predictions:
    """Predicted images of one model for the scenes of a data set."""

    name: str  #: name in tables and reports
    folder: Path  #: folder of the predictions
    root: Path  #: folder of the data set

    @staticmethod
    def open(given: str, root: str | Path) -> Predictions:
        """Opens ``NAME=DIR``, or ``DIR``, whose last component is then the name.

        Raises:
            InputError: the folder does not exist, or the name is that of a baseline.
        """
        name, _, folder = given.rpartition("=") if re.match(r"[\w-]+=", given) else ("", "", given)
        folder = Path(folder)
        if not folder.is_dir():
            raise InputError(f"--predictions: {folder} is not a folder")
        name = name or re.sub(r"[^\w-]", "_", folder.absolute().name)
        if name in RESERVED:
            raise InputError(f"--predictions: the name {name!r} is reserved; choose another: NAME={folder}")
        return Predictions(name, folder, Path(root))

    def cameras(self, scene: Scene) -> tuple[int, ...]:
        """Returns the cameras with predictions for ``scene``. Raises InputError if there are none."""
        folder = self._scene_folder(scene)
        stems = {path.stem if path.suffix.lower() in VIDEO_SUFFIXES else path.name for path in folder.iterdir()}
        cams = sorted(int(match[1]) for stem in stems if (match := re.fullmatch(r"cam_(\d+)", stem)))
        if not cams:
            raise InputError(f"{folder}: contains neither a folder nor a video named cam_<number>")
        if cams[-1] >= scene.n_cams:
            raise InputError(f"{folder}: predictions of camera {cams[-1]}, but {scene.path} has {scene.n_cams} cameras")
        return tuple(cams)

    def check(self, scene: Scene, cams: Sequence[int], n_encoded: int, n_future: int) -> None:
        """Raises InputError if a folder, frame or video is missing; decodes nothing."""
        for cam in cams:
            _find(self._scene_folder(scene) / f"cam_{cam}", range(n_encoded, n_encoded + n_future))

    def images(self, scene: Scene, cams: list[int], n_encoded: int, n_future: int) -> Tensor:
        """Reads the predicted images of ``cams`` at the ``n_future`` steps after the first ``n_encoded``.

        Returns:
            uint8 [n_future, V, H, W, 3].

        Raises:
            InputError: a folder, frame or video is missing, too short, damaged or of another size.
        """
        folder = self._scene_folder(scene)

        def read(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray]:
            size = scene.recorded_sizes[cam]
            frames = _view(folder / f"cam_{cam}", size, scene.n_steps, n_encoded, n_future, problems)
            return (frames[step - n_encoded] for step in steps)

        return (
            scene.with_images(read).recorded_images(cams, range(n_encoded, n_encoded + n_future)).permute(0, 1, 3, 4, 2)
        )

    def _scene_folder(self, scene: Scene) -> Path:
        folder = self.folder / scene.path.relative_to(self.root)
        if not folder.is_dir():
            raise InputError(f"{folder} is missing: predictions of {scene.path} are expected there")
        return folder


def _view(
    path: Path, size: tuple[int, int], n_steps: int, n_encoded: int, n_future: int, problems: Problems
) -> list[np.ndarray]:
    """Returns one camera's predicted RGB frames, [h, w, 3] each."""
    steps = range(n_encoded, n_encoded + n_future)
    found = _find(path, steps)
    if isinstance(found, Path):
        return _from_video(found, size, n_steps, n_encoded, n_future)
    named = ((file, f"predicted step {step}") for file, step in zip(found, steps, strict=True))
    frames = list(read_files(named, size, as_color, problems))
    if max(int(frame.max()) for frame in frames) == 1:
        raise InputError(f"{path}: colours are 0 and 1 of 255: were images in [0, 1] saved without scaling by 255?")
    return frames


def _find(path: Path, steps: range) -> Path | list[Path]:
    """Returns the video file, or the frame files of ``steps``."""
    if path.is_dir():
        return _frames(path, steps)
    for video in path.parent.glob(f"{path.name}.*"):
        if video.suffix.lower() in VIDEO_SUFFIXES and video.is_file():
            return video
    raise InputError(f"{path} is missing: a folder of frames, or a video {path.name}{VIDEO_SUFFIXES[0]}")


def _frames(folder: Path, steps: range) -> list[Path]:
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = re.search(r"(\d+)$", path.stem)
        if path.suffix.lower() not in IMAGE_SUFFIXES or number is None:
            continue
        if (step := int(number[1])) in files:
            raise InputError(f"{folder}: {files[step].name} and {path.name} are both step {step}")
        files[step] = path
    if missing := [step for step in steps if step not in files]:
        raise InputError(
            f"{folder}: step {missing[0]} is missing ({len(missing)} of {len(steps)} are); file names must end in "
            f"their step, here {steps[0]} to {steps[-1]}"
        )
    return [files[step] for step in steps]


def _from_video(file: Path, size: tuple[int, int], n_steps: int, n_encoded: int, n_future: int) -> list[np.ndarray]:
    problems = Problems()
    video = Video(file, file.stem, size, problems)
    n_frames, last = len(video.numbers), n_encoded + n_future
    if video.rate is None and n_frames > 2:
        raise InputError(f"{file}: {video.unevenness}; write it at a constant frame rate, or as image files")
    first = {n_steps: 0, n_steps - n_encoded: n_encoded, last: 0, n_future: n_encoded}
    if n_frames not in first:
        raise InputError(
            f"{file} has {'more than ' if n_frames > n_steps else ''}{min(n_frames, n_steps)} frames; to compare the "
            f"{n_future} steps after the {n_encoded} input steps, it must have {last} (or the scene's {n_steps}), or "
            f"without the input steps {n_future} (or {n_steps - n_encoded})"
        )
    if n_frames == n_steps - n_encoded == last:
        raise InputError(f"{file} is ambiguous: its first frame may be step 0 or {n_encoded}; use image files instead")
    start = n_encoded - first[n_frames]
    return list(video.read(range(start, start + n_future), problems))
