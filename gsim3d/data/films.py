"""A plain folder: for each camera one video file or one folder of frames, and cameras.json.

cameras.json holds ``cameras``, a list of objects with name; size [W, H]; K (3x3, pixels); R (3x3) and T (3),
world-to-camera with OpenCV's axes; optional distortion, OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]] (dist_k1k2p1p2k3 is the
same). Of a camera that moves K, R and T may be lists with one entry a step. Optional beside ``cameras``: fps (needed
for folders of frames), near, far, origin, bounds; units of T and of those (m, cm or mm); pixel_center, the coordinate
of the first pixel's centre in K: 0.5, or 0 as in OpenCV's calibration; masks: "subtract" or "none".

Frames lie in <name>/<number>.png or .jpg, or in <name>.mp4 (.mkv, .webm, .mov, .avi). Frame number n was taken at
n / fps seconds. Labels, where there are any: masks/<name>/<number>.png, not 0 on bodies that may move, or
labels/<name>/<number>.png with 0 background, 1 fixed parts, 3 bodies that may move. Without them the background of
cameras that stand still is subtracted, unless masks is "none".
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data.cameras import by_step, check_intrinsics, check_pose
from gsim3d.data.images import IMAGE_SUFFIXES, as_color, as_labels, as_mask, read_files
from gsim3d.data.masks import MIN_STEPS
from gsim3d.data.recording import (
    MAX_CAMS,
    MAX_NAME,
    MAX_STEPS,
    Problems,
    Recording,
    array,
    common_numbers,
    image_size,
    inside,
    positive,
    read_json,
    trailing_number,
    workspace,
)
from gsim3d.errors import InputError

NAME = "films"
FILE = "cameras.json"
VIDEO_SUFFIXES = (".mp4", ".mkv", ".webm", ".mov", ".avi")
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
DISTORTIONS = [(4,), (5,), (8,)]
OWN_FOLDERS = ("masks", "labels")  # not names of cameras


def recognises(folder: Path) -> bool:
    return (folder / FILE).is_file()


def read(folder: Path, problems: Problems) -> Recording:
    """The scene in ``folder``. Raises InputError where its description cannot be read at all."""
    source = folder / FILE
    description = read_json(source)
    entries = description.get("cameras")
    if (
        not isinstance(entries, list)
        or not 1 <= len(entries) <= MAX_CAMS
        or not all(isinstance(e, dict) for e in entries)
    ):
        raise InputError(f"{source}: cameras must be a list of 1 to {MAX_CAMS} JSON objects")
    names = [_name(entry, number, source) for number, entry in enumerate(entries)]
    if len(set(names)) < len(names):
        raise InputError(f"{source}: two cameras have the same name: {', '.join(names)}")
    fps = positive(description.get("fps"), f"{source}: fps", problems)
    sizes = [
        image_size(entry.get("size"), f"{source}: size of camera {n}", problems) for n, entry in zip(names, entries)
    ]
    sources = [_frames_of(folder, name, size, source, problems) for name, size in zip(names, sizes)]
    own = {name: frames.numbers for name, frames in zip(names, sources) if frames.numbers}
    numbers = common_numbers(own, source, problems) if own else []
    if not numbers:
        raise InputError(f"{source}: the cameras have no frame number in common")
    rates = {frames.fps for frames in sources if frames.fps}
    if fps is None and len(rates) != 1:
        problems.add(f"{source}: fps is needed" + (f": the videos have {sorted(rates)}" if rates else ""))
        rates = {1.0}
    unit = description.get("units", "m")
    if not isinstance(unit, str) or unit not in UNITS:
        raise InputError(f"{source}: units must be one of {', '.join(UNITS)}; got {unit!r}")
    cameras = [
        _camera(entry, name, size, len(numbers), description, source, problems)
        for name, entry, size in zip(names, entries, sizes)
    ]
    viewmats, Ks = (by_step([camera[i] for camera in cameras], len(numbers)) for i in (0, 1))
    viewmats[..., :3, 3] *= UNITS[unit]
    given = {
        key: None if value is None else value * UNITS[unit]
        for key, value in workspace(description, source, problems).items()
    }
    masks = _masks(folder, description, source)
    stills = len(viewmats) == len(Ks) == 1
    subtract = masks == "subtract" and stills and len(numbers) >= MIN_STEPS
    if description.get("masks") == "subtract" and not subtract and masks == "subtract":
        problems.add(
            f"{source}: masks: the background can be subtracted from {MIN_STEPS} frames or more of still cameras"
        )

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return sources[cam].read([numbers[step] for step in steps], problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        wanted = [numbers[step] for step in steps]
        return labels[cam].read(wanted, problems, as_labels if masks == "labels" else as_mask)

    labels = [_Frames(folder, Path(masks) / n, n, s) for n, s in zip(names, sizes)] if masks in OWN_FOLDERS else None
    stride = numbers[1] - numbers[0] if len(numbers) > 1 else 1
    return Recording(
        layout=NAME,
        source=source,
        n_steps=len(numbers),
        fps=(fps or rates.pop()) / stride,
        camera_names=tuple(names),
        viewmats=viewmats,
        Ks=Ks,
        sizes=tuple(sizes),
        read_images=read_images,
        read_labels=read_labels if labels else None,
        distortions=tuple(camera[2] for camera in cameras),
        is_film=True,
        subtract_background=subtract,
        **given,
    )


def _name(entry: dict, number: int, source: Path) -> str:
    name = entry.get("name")
    plain = isinstance(name, str) and 0 < len(name) <= MAX_NAME and Path(name).name == name and "\0" not in name
    if not plain or name in OWN_FOLDERS or name.startswith("."):
        raise InputError(
            f"{source}: cameras[{number}].name must be the name of its folder or video, without ending; "
            f"got {str(name)[:80]!r}"
        )
    return name


def _camera(
    entry: dict, name: str, size: tuple[int, int], n_steps: int, description: dict, source: Path, problems: Problems
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """viewmat [4, 4] or [S, 4, 4], K likewise, distortion."""
    what = f"{source}: camera {name}"
    viewmat, K = np.eye(4), np.eye(3)
    R = array(entry.get("R"), [(3, 3), (n_steps, 3, 3)], f"{what}: R", problems)
    T = array(entry.get("T"), [(3,), (3, 1), (n_steps, 3)], f"{what}: T", problems)
    if R is not None and T is not None:
        T = T[:, 0] if T.shape == (3, 1) and R.ndim == 2 else T
        moving = R.ndim == 3 or T.ndim == 2
        full = np.broadcast_to(np.eye(4), (n_steps if moving else 1, 4, 4)).copy()
        full[:, :3, :3], full[:, :3, 3] = R, T
        full = full if moving else full[0]
        viewmat = full if check_pose(full, f"{what}: R", problems) else viewmat
    found = array(entry.get("K"), [(3, 3), (n_steps, 3, 3)], f"{what}: K", problems)
    if found is not None:
        found = found.copy()
        found[..., :2, 2] += 0.5 - _pixel_center(description, source)
        K = found if check_intrinsics(found, size, f"{what}: K", problems) else K
    lens = entry.get("distortion", entry.get("dist_k1k2p1p2k3"))
    if lens is None:
        return viewmat, K, None
    lens = array(lens, DISTORTIONS, f"{what}: distortion", problems)
    return viewmat, K, lens if lens is not None and lens.any() else None


def _pixel_center(description: dict, source: Path) -> float:
    center = description.get("pixel_center", 0.5)
    if center not in (0, 0.5):
        raise InputError(f"{source}: pixel_center must be 0 (OpenCV's calibration) or 0.5; got {center!r}")
    return center


def _masks(folder: Path, description: dict, source: Path) -> str:
    """Where labels come from: the folder labels or masks, "subtract", or "none"."""
    wanted = description.get("masks", "subtract")
    if wanted not in ("subtract", "none"):
        raise InputError(f'{source}: masks must be "subtract" or "none"; got {wanted!r}')
    if wanted == "none":
        return wanted
    return next((name for name in reversed(OWN_FOLDERS) if (folder / name).is_dir()), wanted)


def _frames_of(folder: Path, name: str, size: tuple[int, int], source: Path, problems: Problems) -> _Frames | _Video:
    """Where the frames of a camera come from; without any numbers where there is a problem."""
    videos = [folder / f"{name}{suffix}" for suffix in VIDEO_SUFFIXES if (folder / f"{name}{suffix}").is_file()]
    frames = _Frames(folder, Path(name), name, size)
    if len(videos) == 1 and not (folder / name).is_dir():
        return _Video(inside(folder, videos[0].name, f"camera {name}"), name, size, problems)
    if not frames.numbers:
        found = f"found {', '.join(video.name for video in videos)}" if videos else "neither is there"
        problems.add(
            f"{source}: camera {name} needs a folder {name} with frames <number>.png or .jpg, or one video {name}.mp4 "
            f"({', '.join(VIDEO_SUFFIXES)}); {found}"
        )
    return frames


class _Frames:
    """A folder of numbered images."""

    fps = None

    def __init__(self, scene: Path, folder: Path, name: str, size: tuple[int, int]):
        self._name, self._size, self._folder = name, size, scene / folder
        self._files: dict[int, Path] = {}
        for path in sorted(self._folder.iterdir()) if self._folder.is_dir() else ():
            number = trailing_number(path.stem) if path.suffix.lower() in IMAGE_SUFFIXES else None
            if number is None:
                continue
            if number in self._files:
                raise InputError(f"camera {name}: two images have number {number}: {self._files[number]} and {path}")
            self._files[number] = inside(scene, path.relative_to(scene).as_posix(), f"camera {name}")
        self.numbers = sorted(self._files)

    def read(self, numbers: Sequence[int], problems: Problems, convert=as_color) -> Iterator[np.ndarray | None]:
        if not self._files:  # reported when the scene was opened
            yield from [None] * len(numbers)
            return
        for number in numbers:
            place = f"camera {self._name}, frame {number}"
            if number not in self._files:
                problems.add(f"{self._folder}: the image of {place} is missing")
                yield None
                continue
            yield from read_files(iter([(self._files[number], place)]), self._size, convert, problems)


class _Video:
    """A video file. It is opened for each read and closed after it; frames are decoded from the first one on."""

    def __init__(self, file: Path, name: str, size: tuple[int, int], problems: Problems):
        import cv2

        self._file, self._name, self._size = file, name, size
        self.numbers, self.fps = [], None
        try:
            capture = self._open()
        except InputError as error:
            problems.add(str(error))
            return
        try:
            count, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            found = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        finally:
            capture.release()
        if not 1 <= count <= MAX_STEPS:
            problems.add(f"video {file} (camera {name}) does not tell how many frames it has: got {count:g}")
        elif found != size:
            problems.add(
                f"video {file} (camera {name}) has {found[0]}x{found[1]} pixels, its camera {size[0]}x{size[1]}"
            )
        else:
            self.numbers = list(range(int(count)))
            self.fps = rate if 0 < rate < 1e6 else None

    def _open(self):
        import cv2

        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # errors are reported here, with their file and camera
        capture = cv2.VideoCapture(str(self._file), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            capture.release()
            raise InputError(f"video {self._file} (camera {self._name}) cannot be opened: broken, cut off or no video")
        return capture

    def read(self, numbers: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        import cv2

        capture = self._open()
        try:
            at, ended = -1, False
            for number in numbers:
                while at < number and not ended:
                    ended = not capture.grab()
                    at += 1
                if ended:
                    if at <= number:
                        problems.add(
                            f"video {self._file} (camera {self._name}) ends before frame {at}, though it tells of "
                            f"{len(self.numbers)}: cut off?"
                        )
                        at = len(self.numbers)
                    yield None
                    continue
                done, frame = capture.retrieve()
                if not done or frame.shape != (self._size[1], self._size[0], 3):
                    problems.add(f"video {self._file} (camera {self._name}, frame {number}) cannot be decoded")
                    yield None
                    continue
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        finally:
            capture.release()
