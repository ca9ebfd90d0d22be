"""Nerfstudio's transforms.json, with a time for every frame and any number of cameras.

Keys of the file, or of single frames, which win: fl_x, fl_y, cx, cy, w, h; k1, k2, p1, p2, k3 (OpenCV's lens model).
Each of ``frames``: file_path; transform_matrix, camera-to-world with OpenGL's axes (x right, y up, z backwards); time
in seconds (any unit where fps is given); camera, its name; mask_path, an image that is not 0 on bodies that may move;
or label_path, one with 0 background, 1 fixed parts, 3 bodies that may move. Without ``camera`` the path decides:
frames whose paths differ in their last number only come from one camera. Without any ``time`` all show one instant
and each has its own camera. Beside them: fps, near, far, origin, bounds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data.cameras import OPENGL, by_step, check_intrinsics, check_pose, inverse
from gsim3d.data.images import as_color, as_labels, as_mask, read_files
from gsim3d.data.recording import (
    MAX_CAMS,
    MAX_STEPS,
    Problems,
    Recording,
    array,
    image_size,
    inside,
    natural_order,
    positive,
    read_json,
    step_rate,
    workspace,
)
from gsim3d.errors import InputError

NAME = "transforms"
FILE = "transforms.json"
PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
LENS = ("k1", "k2", "p1", "p2", "k3")
SAME_TIME = 1e-6  # of the whole duration: times closer than that are one step


def recognises(folder: Path) -> bool:
    return (folder / FILE).is_file()


def read(folder: Path, problems: Problems) -> Recording:
    """The scene in ``folder``. Raises InputError where its description cannot be read at all."""
    source = folder / FILE
    description = read_json(source)
    frames = description.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source}: frames must be a list of one or more JSON objects")
    if len(frames) > MAX_STEPS:
        raise InputError(f"{source}: {len(frames)} frames; more than {MAX_STEPS} are taken to be a mistake")
    model = description.get("camera_model", "OPENCV")
    if model not in PINHOLES:
        raise InputError(
            f"{source}: camera_model {model!r} is not read; undistort the images to a pinhole "
            f"(known: {', '.join(PINHOLES)})"
        )
    for number, frame in enumerate(frames):
        for key in ("file_path", "mask_path", "label_path"):
            if key != "file_path" and key not in frame:
                continue
            if not isinstance(frame.get(key), str):
                raise InputError(f"{source}: frames[{number}].{key} must be text; got {str(frame.get(key))[:80]!r}")
            inside(folder, frame[key], f"{source}: frames[{number}].{key}")
    table, times = _table(frames, source, problems)
    names = sorted(table, key=natural_order)
    if len(names) > MAX_CAMS:
        raise InputError(f"{source}: {len(names)} cameras; more than {MAX_CAMS} are taken to be a mistake")
    cameras = [_Camera(name, table[name], description, source, problems) for name in names]
    n_steps = len(times)
    fps = positive(description.get("fps"), f"{source}: fps", problems)
    if n_steps > 1:
        rate, broken = step_rate(times)
        if broken is not None:
            problems.add(
                f"{source}: times must be evenly spaced; after {times[broken]:g} the next is {times[broken + 1]:g}, "
                f"elsewhere {1 / rate:g} later"
            )
        fps = fps or rate

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return read_files(cameras[cam].files(folder, "file_path", steps), cameras[cam].size, as_color, problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        camera = cameras[cam]
        for step in steps:
            frame = camera.frames[step]
            key, convert = ("label_path", as_labels) if "label_path" in frame else ("mask_path", as_mask)
            if key not in frame:
                problems.add(f"{source}: {camera.place(step)} has no mask_path, though other frames have one")
                yield None
                continue
            yield from read_files(camera.files(folder, key, [step]), camera.size, convert, problems)

    has_labels = any("mask_path" in frame or "label_path" in frame for frame in frames)
    return Recording(
        layout=NAME,
        source=source,
        n_steps=n_steps,
        fps=fps or 1.0,
        camera_names=tuple(names),
        viewmats=by_step([camera.viewmats for camera in cameras], n_steps),
        Ks=by_step([camera.Ks for camera in cameras], n_steps),
        sizes=tuple(camera.size for camera in cameras),
        read_images=read_images,
        read_labels=read_labels if has_labels else None,
        distortions=tuple(camera.distortion for camera in cameras),
        is_film=True,
        **workspace(description, source, problems),
    )


def _table(frames: list[dict], source: Path, problems: Problems) -> tuple[dict, np.ndarray]:
    """(camera -> its frames step by step, times of the steps)."""
    timeless = [number for number, frame in enumerate(frames) if "time" not in frame]
    if len(timeless) == len(frames):
        return {str(frame.get("camera", frame["file_path"])): [frame] for frame in frames}, np.zeros(1)
    if timeless:
        raise InputError(
            f"{source}: frames[{timeless[0]}] ({frames[timeless[0]]['file_path']}) has no time, others have"
        )
    stamps = array([frame["time"] for frame in frames], [(len(frames),)], f"{source}: time of frames", problems)
    if stamps is None:
        raise InputError(f"{source}: every frame needs a finite time")
    order = np.argsort(stamps, kind="stable")
    fresh = np.diff(stamps[order], prepend=-np.inf) > SAME_TIME * np.ptp(stamps)
    step_of = np.empty(len(frames), dtype=np.int64)
    step_of[order] = np.cumsum(fresh) - 1
    times = stamps[order][fresh]
    table: dict[str, list] = {}
    for frame, step in zip(frames, step_of):
        own = table.setdefault(_camera_name(frame), [None] * len(times))
        if own[step] is not None:
            raise InputError(
                f"{source}: camera {_camera_name(frame)} has two frames at time {times[step]:g}: "
                f"{own[step]['file_path']} and {frame['file_path']}; give every frame its camera"
            )
        own[step] = frame
    for name, own in table.items():
        missing = [step for step, frame in enumerate(own) if frame is None]
        if missing:
            problems.add(
                f"{source}: camera {name} has {len(times) - len(missing)} frames, but there are {len(times)} times; "
                f"missing: time {times[missing[0]]:g} (frame {missing[0]}); if frames of several cameras were taken "
                "for one, or the reverse, give every frame its camera"
            )
            first = next(frame for frame in own if frame is not None)
            table[name] = [frame or first for frame in own]
    return table, times


def _camera_name(frame: dict) -> str:
    if "camera" in frame:
        return str(frame["camera"])
    return re.sub(r"[_\-/]?\d+(?=\D*$)", "", str(Path(frame["file_path"]).with_suffix(""))) or "camera"


class _Camera:
    """All frames of one camera, step by step."""

    def __init__(self, name: str, frames: list[dict], description: dict, source: Path, problems: Problems):
        self.name, self.frames, self._source = name, frames, source
        self._description = description
        self.size = image_size(self._values(frames[0], ("w", "h")), f"{source}: w, h of camera {name}", problems)
        lenses = np.array([self._lens(frame, step, problems) for step, frame in enumerate(frames)])
        if (lenses != lenses[0]).any():
            problems.add(f"{source}: camera {name}: the lens (k1, k2, p1, p2, k3) must be the same in all frames")
        self.distortion = lenses[0] if lenses[0].any() else None
        self.viewmats = np.stack([self._viewmat(frame, step, problems) for step, frame in enumerate(frames)])
        self.Ks = np.stack([self._K(frame, step, problems) for step, frame in enumerate(frames)])

    def place(self, step: int) -> str:
        return f"camera {self.name}, frame {step}"

    def files(self, folder: Path, key: str, steps: Sequence[int]) -> Iterator[tuple[Path, str]]:
        for step in steps:
            file = inside(folder, self.frames[step][key], f"{self._source}: {key} of {self.place(step)}")
            if not file.suffix:
                file = file.with_suffix(".png")  # as in the synthetic sets
            yield file, self.place(step)

    def _values(self, frame: dict, keys: Sequence[str], default=None) -> list:
        return [frame.get(key, self._description.get(key, default)) for key in keys]

    def _lens(self, frame: dict, step: int, problems: Problems) -> np.ndarray:
        what = f"{self._source}: {', '.join(LENS)} of {self.place(step)}"
        values = array(self._values(frame, LENS, 0.0), [(len(LENS),)], what, problems)
        return np.zeros(len(LENS)) if values is None else values

    def _viewmat(self, frame: dict, step: int, problems: Problems) -> np.ndarray:
        what = f"{self._source}: transform_matrix of {self.place(step)}"
        pose = array(frame.get("transform_matrix"), [(4, 4), (3, 4)], what, problems)
        if pose is None:
            return np.eye(4)
        if len(pose) == 3:
            pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
        return OPENGL @ inverse(pose) if check_pose(pose, what, problems) else np.eye(4)

    def _K(self, frame: dict, step: int, problems: Problems) -> np.ndarray:
        what = f"{self._source}: intrinsics of {self.place(step)}"
        size = self._values(frame, ("w", "h"))
        if size != list(self.size) and size != [None, None]:
            problems.add(f"{what}: w, h are {size}, but {list(self.size)} in its first frame")
        fl_x, fl_y, cx, cy = self._values(frame, ("fl_x", "fl_y", "cx", "cy"))
        values = array([fl_x, fl_x if fl_y is None else fl_y, cx, cy], [(4,)], f"{what}: fl_x, fl_y, cx, cy", problems)
        if values is None:
            return np.eye(3)
        K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
        return K if check_intrinsics(K, self.size, what, problems) else np.eye(3)
