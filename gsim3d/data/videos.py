"""Reader of videos: cameras.json, and for each camera a video file or a folder of numbered frames.

Cameras are synchronised by time: frame n of a folder is at n / fps seconds, frames of a video at their time stamps.
Labels come from the folders labels or masks, or else from alpha, or else from background subtraction.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data import images, recording
from gsim3d.data.cameras import check_intrinsics, check_pose
from gsim3d.data.lenses import FISHEYE, FISHEYE_ORDER, OPENCV_ORDER, lens_of
from gsim3d.data.masks import MIN_STEPS
from gsim3d.data.recording import Camera, Description, Lens, Problems, Recording, array, inside
from gsim3d.data.video_file import Video
from gsim3d.errors import InputError

NAME = "videos"
FILE = "cameras.json"
VIDEO_SUFFIXES = (".mp4", ".mkv", ".webm", ".mov", ".avi", ".m4v")
SHARED_KEYS = ("fps", "resample", "units", "near", "far", "origin", "bounds", "masks", "pixel_center", "cameras")
KEYS = (*SHARED_KEYS, "name", "size", "K", "R", "T", "offset", "distortion", "camera_model", "is_fisheye")
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
DISTORTIONS = [(4,), (5,), (8,)]
OWN_FOLDERS = ("masks", "labels")  # reserved, not camera names
CONVERT = {"labels": images.as_labels, "alpha": images.as_opaque}  # others are masks
SAME_RATE = 5e-3  # relative; 29.97 and 30 fps count as equal
MAX_RESAMPLING = 100  # steps per recorded frame of resampled videos
OFF_STEP = 0.1  # frames; larger differences between cameras and their steps are noted
MAX_DRIFT = 0.5  # frames; largest drift between videos of nearly equal rates


def recognises(folder: Path) -> bool:
    """Returns whether ``folder`` has a cameras.json."""
    return (folder / FILE).is_file()


def read(folder: Path, problems: Problems) -> Recording:
    """Reads the scene in ``folder``. Raises InputError if its description cannot be parsed."""
    source = folder / FILE
    description = Description(recording.read_json(source), f"{source}: ", problems)
    entries = _entries(description)
    names = list(entries)
    sizes = {name: entry.size("size") for name, entry in entries.items()}
    sources = {name: _frames_of(folder, name, sizes[name], source, problems) for name in names}
    fps, resample = description.positive("fps"), description.positive("resample")
    given = {n: array(e.values.get("offset", 0), [()], f"{e.where}offset", problems) for n, e in entries.items()}
    offsets = {name: 0.0 if offset is None else float(offset) for name, offset in given.items()}
    aligned = any("offset" in entry.values for entry in entries.values())
    numbers, rate, notes = _steps(sources, offsets, aligned, fps, resample, source, problems)
    unit, center = _unit(description), description.values.get("pixel_center", 0.5)
    if center not in (0, 0.5):
        raise InputError(f"{description.where}pixel_center must be 0 (OpenCV's calibration) or 0.5; got {center!r}")
    cameras = [_camera(entry, name, sizes[name], len(numbers[0]), unit, center) for name, entry in entries.items()]
    masks = _masks(folder, description, list(sources.values()))
    labels = sources if masks == "alpha" else None
    if masks not in ("alpha", "subtract", "none"):
        labels = {name: _Frames(folder, Path(masks) / name, name, sizes[name]) for name in names}
        for name in (name for name, frames in labels.items() if not frames.numbers):
            problems.add(f"{source}: camera {name} has no images <number>.png or .jpg in {folder / masks / name}")

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return sources[names[cam]].read([numbers[cam][step] for step in steps], problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        convert = CONVERT.get(masks, images.as_mask)
        return labels[names[cam]].read([numbers[cam][step] for step in steps], problems, convert)

    found = Recording.of_cameras(
        cameras,
        len(numbers[0]),
        layout=NAME,
        source=source,
        fps=rate,
        read_images=read_images,
        read_labels=read_labels if labels else None,
        real_background=True,
        notes=tuple(notes),
        **description.workspace(unit=unit),
    )
    subtract = masks == "subtract" and len(found.viewmats) == len(found.Ks) == 1 and found.n_steps >= MIN_STEPS
    if description.values.get("masks") == masks == "subtract" and not subtract:
        problems.add(f"{source}: masks: background subtraction requires static cameras and at least {MIN_STEPS} frames")
    return dataclasses.replace(found, subtract_background=subtract)


def _entries(description: Description) -> dict[str, Description]:
    """Returns the camera descriptions by name, with the top-level keys as defaults."""
    shared = {key: value for key, value in description.values.items() if key != "cameras"}
    values, found = description.values.get("cameras"), {}
    most = recording.MAX_CAMS
    if not isinstance(values, list) or not 1 <= len(values) <= most or not all(isinstance(e, dict) for e in values):
        raise InputError(f"{description.where}cameras must be a list of 1 to {most} JSON objects")
    for number, entry in enumerate(values):
        name = entry.get("name")
        plain = isinstance(name, str) and 0 < len(name) <= recording.MAX_NAME and Path(name).name == name
        if not plain or "\0" in name or name in OWN_FOLDERS or name.startswith("."):
            where = f"{description.where}cameras[{number}].name"
            raise InputError(f"{where} must be the name of its folder or video, without ending; got {str(name)[:80]!r}")
        if name in found:
            raise InputError(f"{description.where}two cameras have the same name: {name}")
        values, where = {**shared, **entry}, f"{description.where}camera {name}: "
        if misplaced := next((key for key in SHARED_KEYS if key in entry), None):
            raise InputError(f"{where}{misplaced} belongs to the top level: all cameras have the same")
        found[name] = Description(values, where, description.problems)
        found[name].refuse_misspelt(KEYS)
    return found


def _unit(description: Description) -> float:
    """Returns metres per unit of T, near, far, origin and bounds."""
    unit = description.values.get("units", "m")
    if not isinstance(unit, str) or unit not in UNITS:
        raise InputError(f"{description.where}units must be one of {', '.join(UNITS)}; got {unit!r}")
    return UNITS[unit]


def _camera(entry: Description, name: str, size: tuple[int, int], n_steps: int, unit: float, center: float) -> Camera:
    viewmat, K, problems = np.eye(4), np.eye(3), entry.problems
    R = entry.array("R", (3, 3), (n_steps, 3, 3))
    T = entry.array("T", (3,), (3, 1), (n_steps, 3))
    if R is not None and T is not None:
        T = T[:, 0] if T.shape == (3, 1) and R.ndim == 2 else T
        moving = R.ndim == 3 or T.ndim == 2
        full = np.broadcast_to(np.eye(4), (n_steps if moving else 1, 4, 4)).copy()
        full[:, :3, :3], full[:, :3, 3] = R, T
        full = full if moving else full[0]
        viewmat = full if check_pose(full, f"{entry.where}R", problems) else viewmat
    found = entry.array("K", (3, 3), (n_steps, 3, 3))
    if found is not None:
        found = found.copy()
        found[..., :2, 2] += 0.5 - center
        K = found if check_intrinsics(found, size, f"{entry.where}K", problems) else K
    viewmat[..., :3, 3] *= unit
    return Camera(name, size, viewmat, K, _lens(entry))


def _lens(camera: Description) -> Lens | None:
    """Parses the lens from the key distortion, or from keys as in transforms.json."""
    values, what, problems = camera.values, camera.where.removesuffix(": "), camera.problems
    given = values.get("distortion", values.get("dist_k1k2p1p2k3"))
    values = {key: value for key, value in values.items() if key != "distortion"}
    if given is None:
        return lens_of(values, what, problems)
    numbers = array(given, DISTORTIONS, f"{what}: distortion", problems)
    if numbers is None:
        return None
    order = FISHEYE_ORDER if values.get("camera_model") in FISHEYE or values.get("is_fisheye") else OPENCV_ORDER
    if len(numbers) > len(order):
        problems.add(f"{what}: distortion of a fisheye must be {', '.join(order)}; got {len(numbers)} numbers")
        return None
    named = dict(zip(order, numbers.tolist(), strict=False))
    if twice := next((key for key in named if key in values), None):
        problems.add(f"{what}: {twice} is given twice, also in distortion")
        return None
    return lens_of({**values, **named}, what, problems)


def _masks(folder: Path, description: Description, sources: list[_Frames | Video]) -> str:
    """Returns the source of labels: "labels" or another folder (of masks), "alpha", "subtract" or "none"."""
    wanted = description.values.get("masks", "subtract")
    if wanted not in ("subtract", "none"):
        if not isinstance(wanted, str) or not inside(folder, wanted, f"{description.where}masks").is_dir():
            raise InputError(
                f'{description.where}masks must be "subtract", "none" or a folder beside it; got {wanted!r:.80}'
            )
        return wanted
    if wanted == "none":
        return wanted
    own = next((name for name in reversed(OWN_FOLDERS) if (folder / name).is_dir()), None)
    cut_out = all(isinstance(frames, _Frames) for frames in sources) and any(map(_Frames.is_cut_out, sources))
    return own or ("alpha" if cut_out and "masks" not in description.values else wanted)


def _frames_of(folder: Path, name: str, size: tuple[int, int], source: Path, problems: Problems) -> _Frames | Video:
    """Finds the frames of a camera; they have no numbers on error."""
    named = (path for path in folder.iterdir() if path.stem == name and path.suffix.lower() in VIDEO_SUFFIXES)
    videos = [path for path in named if path.is_file()]
    frames = _Frames(folder, Path(name), name, size)
    if len(videos) == 1 and not (folder / name).is_dir():
        return Video(inside(folder, videos[0].name, f"camera {name}"), name, size, problems)
    if not frames.numbers:
        found = f"found {', '.join(video.name for video in videos)}" if videos else "found neither"
        problems.add(
            f"{source}: camera {name} needs a folder {name} with frames <number>.png or .jpg, or one video {name}.mp4 "
            f"({', '.join(VIDEO_SUFFIXES)}); {found}"
        )
    return frames


def _steps(
    sources: dict[str, _Frames | Video],
    offsets: dict[str, float],
    aligned: bool,
    fps: float | None,
    resample: float | None,
    source: Path,
    problems: Problems,
) -> tuple[list[list[int]], float, list[str]]:
    """Synchronises the cameras: returns frame numbers of each camera by step, steps per second, and notes. ``aligned``
    ones may have other frames before or behind those of all cameras."""
    videos = {name: frames for name, frames in sources.items() if isinstance(frames, Video) and frames.numbers}
    folders = {name: frames for name, frames in sources.items() if isinstance(frames, _Frames) and frames.numbers}
    if folders and fps is None:
        known = sorted({video.rate for video in videos.values() if video.rate})
        problems.add(f"{source}: fps is needed" + (f": the videos have {known}" if known else ""))
        fps = 1.0
    notes = [video.note for video in videos.values() if video.note]
    for video in videos.values():
        if video.is_still:
            how = "it is interlaced, which OpenCV 5 cannot decode (convert it, as by ffmpeg -vf yadif)"
            problems.add(f"{video.what} shows the same picture in all frames: nothing moves in it, or {how}")
        if video.rate is None and resample is None:
            hint = f'set "resample" (steps per second) in {source.name}'
            problems.add(f"{video.what} is uneven: {video.unevenness}; {hint}")
    rates = {name: video.rate for name, video in videos.items() if video.rate}
    slow, fast = min(rates, key=rates.get, default=None), max(rates, key=rates.get, default=None)
    own_rate = rates.get(slow)
    if rates and resample is None:
        drift = max(len(video.numbers) for video in videos.values()) * (rates[fast] / own_rate - 1)
        if drift > MAX_DRIFT:
            problems.add(
                f"{source}: the videos have {own_rate:.5g} (camera {slow}) and {rates[fast]:.5g} (camera {fast}) "
                'frames per second; set "resample" (steps per second)'
            )
    if rates and fps and abs(fps / own_rate - 1) > SAME_RATE:
        if folders:
            problems.add(f"{source}: fps is {fps:g}, but the videos have {own_rate:g} frames per second")
        notes.append(f"the frame rate of the videos, {own_rate:g} per second, is replaced by fps: {fps:g}")
    if resample is not None:
        numbers, more = _resampled({**folders, **videos}, offsets, fps, resample, source)
        n_steps = max(map(len, numbers.values()), default=1)
        return [numbers.get(name, [0] * n_steps) for name in sources], resample, notes + more
    rate = fps or own_rate or 1.0
    starts = {name: (video.times[0] + offsets[name]) * (video.rate or 0) for name, video in videos.items()}
    starts |= {name: offsets[name] * rate for name in folders}
    # Steps have the mean phase of the cameras: of starts at 0.49 and 0.51 frames, none is rounded away from the other.
    phase = np.angle(sum(np.exp(2j * np.pi * start) for start in starts.values())) / (2 * np.pi)
    first = {name: round(start - phase) for name, start in starts.items()}
    off = max((abs(starts[name] - phase - first[name]) for name in starts), default=0.0)
    if off > OFF_STEP:
        notes.append(f"frames are up to {1000 * off / rate:.3g} ms off their steps")
    ticks = {name: [first[name] + number for number in sources[name].numbers] for name in sources if name in first}
    if aligned or any(first.values()):
        low, high = max(own[0] for own in ticks.values()), min(own[-1] for own in ticks.values())
        longest = max(map(len, ticks.values()))
        ticks = {name: [tick for tick in own if low <= tick <= high] for name, own in ticks.items()}
        if high - low + 1 < longest:
            common = max(0, high - low + 1)
            differ = "start" if any(first.values()) else "end"
            notes.append(f"the videos {differ} at different times: {common} of {longest} frames are common")
    common = recording.common_numbers(ticks, source, problems) if ticks else []
    if not common:
        raise InputError(f"{source}: the cameras have no frame number in common")
    stride = common[1] - common[0] if len(common) > 1 else 1
    return [[tick - first.get(name, 0) for tick in common] for name in sources], rate / stride, notes


def _resampled(
    sources: dict[str, _Frames | Video], offsets: dict[str, float], fps: float | None, rate: float, source: Path
) -> tuple[dict[str, list[int]], list[str]]:
    """Resamples to ``rate`` steps per second over the common time: the nearest frame of each camera at each step."""
    if not sources:
        raise InputError(f"{source}: the cameras have no frame in common")
    times = {}
    for name, frames in sources.items():
        own = frames.times if isinstance(frames, Video) else np.array(frames.numbers) / fps
        own = own * frames.rate / fps if fps and isinstance(frames, Video) and frames.rate else own
        times[name] = own + offsets[name]
    low, high = max(own[0] for own in times.values()), min(own[-1] for own in times.values())
    count = math.floor((high - low) * rate + 1e-6) + 1 if high >= low else 0
    if count < 1:
        raise InputError(f"{source}: the cameras have no time in common")
    n_frames = max(map(len, times.values()))
    most = min(recording.MAX_STEPS, MAX_RESAMPLING * n_frames)
    if count > most:
        raise InputError(f"{source}: resample gives {count} steps of {n_frames} frames; at most {most} are allowed")
    grid = low + np.arange(count) / rate
    numbers, off, again = {}, 0.0, 0
    for name, own in times.items():
        nearest = np.searchsorted((own[1:] + own[:-1]) / 2, grid)
        numbers[name] = [sources[name].numbers[at] for at in nearest]
        off, again = max(off, np.abs(own[nearest] - grid).max()), max(again, int((np.diff(nearest) == 0).sum()))
    return numbers, [
        f"resampled: frames are up to {1000 * off:.3g} ms off their steps, {again} of {count} steps repeat the "
        "previous frame"
    ]


class _Frames:
    """Folder of numbered images."""

    def __init__(self, scene: Path, folder: Path, name: str, size: tuple[int, int]):
        self._name, self._size, self._folder = name, size, scene / folder
        self._files: dict[int, Path] = {}
        for path in sorted(self._folder.iterdir()) if self._folder.is_dir() else ():
            number = recording.trailing_number(path.stem) if path.suffix.lower() in images.IMAGE_SUFFIXES else None
            if number is None:
                continue
            if number in self._files:
                raise InputError(f"camera {name}: two images have number {number}: {self._files[number]} and {path}")
            self._files[number] = inside(scene, path.relative_to(scene).as_posix(), f"camera {name}")
        self.numbers = sorted(self._files)

    def is_cut_out(self) -> bool:
        """Returns whether the first image has transparent pixels."""
        for number in self.numbers[:1]:
            header = images.header_of(self._files[number], self._name, Problems(collect=True))
            if header is not None and header.alpha and header.size == self._size:
                image = images.read_image(self._files[number], self._size, self._name, Problems(collect=True))
                return image is not None and not images.is_opaque(image).all()
        return False

    def read(self, numbers: Sequence[int], problems: Problems, convert=images.as_color) -> Iterator[np.ndarray | None]:
        """Reads and converts the images with these numbers; yields None on error."""
        if not self._files:  # already reported when the scene was opened
            yield from [None] * len(numbers)
            return
        for number in numbers:
            frame = f"camera {self._name}, frame {number}"
            if number not in self._files:
                problems.add(f"{self._folder}: the image of {frame} is missing")
                yield None
                continue
            yield from images.read_files(iter([(self._files[number], frame)]), self._size, convert, problems)
