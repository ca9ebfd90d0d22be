"""A plain folder: for each camera one video file or one folder of frames, and cameras.json.

cameras.json holds ``cameras``, a list of objects with name; size [W, H]; K (3x3, pixels); R (3x3) and T (3),
world-to-camera with OpenCV's axes; optional distortion, OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]] (dist_k1k2p1p2k3 is the
same), or the lens keys of :mod:`gsim3d.data.lenses`. Of a camera that moves K, R and T may be lists with one entry a
step. Optional beside ``cameras``: fps (needed for folders of frames), resample, near, far, origin, bounds; units of T
and of those (m, cm or mm); pixel_center, the coordinate of the first pixel's centre in K: 0.5, or 0 as in OpenCV's
calibration; masks: "subtract" or "none".

Frames lie in <name>/<number>.png (.jpg, .webp, .tif), or in <name>.mp4 (.mkv, .webm, .mov, .avi). Frame number n was
taken at n / fps seconds, that of a video at the time that the file has for it; cameras are aligned by time. A video
whose frames are not evenly spaced needs resample, steps a second: the nearest frame of each camera is taken. Labels,
where there are any: masks/<name>/<number>.png, not 0 on bodies that may move, or labels/<name>/<number>.png with 0
background, 1 fixed parts, 3 bodies that may move (frames of a video count from 0). Without them alpha above half may
move, and without alpha the background of cameras that stand still is subtracted, unless masks is "none".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data.cameras import by_step, check_intrinsics, check_pose
from gsim3d.data.images import (
    IMAGE_SUFFIXES,
    as_color,
    as_labels,
    as_mask,
    as_opaque,
    header_of,
    is_opaque,
    read_files,
    read_image,
)
from gsim3d.data.lenses import FISHEYE, FISHEYE_ORDER, OPENCV_ORDER, lens_of
from gsim3d.data.masks import MIN_STEPS
from gsim3d.data.recording import (
    MAX_CAMS,
    MAX_NAME,
    MAX_STEPS,
    Lens,
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
from gsim3d.data.video_file import Video
from gsim3d.errors import InputError

NAME = "videos"
FILE = "cameras.json"
VIDEO_SUFFIXES = (".mp4", ".mkv", ".webm", ".mov", ".avi")
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
DISTORTIONS = [(4,), (5,), (8,)]
OWN_FOLDERS = ("masks", "labels")  # not names of cameras
CONVERT = {"labels": as_labels, "masks": as_mask, "alpha": as_opaque}
SAME_RATE = 5e-3  # 29.97 frames a second are called 30
MAX_DRIFT = 0.5  # frames by which videos of nearly one rate may run apart


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
    resample = positive(description.get("resample"), f"{source}: resample", problems)
    numbers, rate, notes = _steps(dict(zip(names, sources)), fps, resample, source, problems)
    n_steps = len(numbers[0])
    unit = description.get("units", "m")
    if not isinstance(unit, str) or unit not in UNITS:
        raise InputError(f"{source}: units must be one of {', '.join(UNITS)}; got {unit!r}")
    cameras = [
        _camera(entry, name, size, n_steps, description, source, problems)
        for name, entry, size in zip(names, entries, sizes)
    ]
    viewmats, Ks = (by_step([camera[i] for camera in cameras], n_steps) for i in (0, 1))
    viewmats[..., :3, 3] *= UNITS[unit]
    given = {
        key: None if value is None else value * UNITS[unit]
        for key, value in workspace(description, source, problems).items()
    }
    masks = _masks(folder, description, source, sources)
    stills = len(viewmats) == len(Ks) == 1
    subtract = masks == "subtract" and stills and n_steps >= MIN_STEPS
    if description.get("masks") == "subtract" and not subtract and masks == "subtract":
        problems.add(
            f"{source}: masks: the background can be subtracted from {MIN_STEPS} frames or more of still cameras"
        )

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return sources[cam].read([numbers[cam][step] for step in steps], problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return labels[cam].read([numbers[cam][step] for step in steps], problems, CONVERT[masks])

    labels = [_Frames(folder, Path(masks) / n, n, s) for n, s in zip(names, sizes)] if masks in OWN_FOLDERS else None
    if masks == "alpha":
        labels = sources
    return Recording(
        layout=NAME,
        source=source,
        n_steps=n_steps,
        fps=rate,
        camera_names=tuple(names),
        viewmats=viewmats,
        Ks=Ks,
        sizes=tuple(sizes),
        read_images=read_images,
        read_labels=read_labels if labels else None,
        distortions=tuple(camera[2] for camera in cameras),
        real_background=True,
        subtract_background=subtract,
        notes=tuple(notes),
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
) -> tuple[np.ndarray, np.ndarray, Lens | None]:
    """viewmat [4, 4] or [S, 4, 4], K [3, 3] or [S, 3, 3], lens."""
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
    return viewmat, K, _lens(entry, what, problems)


def _lens(entry: dict, what: str, problems: Problems) -> Lens | None:
    """The lens of distortion, or of keys as in transforms.json."""
    given = entry.get("distortion", entry.get("dist_k1k2p1p2k3"))
    entry = {key: value for key, value in entry.items() if key != "distortion"}
    if given is None:
        return lens_of(entry, what, problems)
    numbers = array(given, DISTORTIONS, f"{what}: distortion", problems)
    if numbers is None:
        return None
    order = FISHEYE_ORDER if entry.get("camera_model") in FISHEYE or entry.get("is_fisheye") else OPENCV_ORDER
    if len(numbers) > len(order):
        problems.add(f"{what}: distortion of a fisheye must be {', '.join(order)}; got {len(numbers)} numbers")
        return None
    named = dict(zip(order, numbers.tolist(), strict=False))
    if twice := next((key for key in named if key in entry), None):
        problems.add(f"{what}: {twice} is given twice, also in distortion")
        return None
    return lens_of({**entry, **named}, what, problems)


def _pixel_center(description: dict, source: Path) -> float:
    center = description.get("pixel_center", 0.5)
    if center not in (0, 0.5):
        raise InputError(f"{source}: pixel_center must be 0 (OpenCV's calibration) or 0.5; got {center!r}")
    return center


def _masks(folder: Path, description: dict, source: Path, sources: list[_Frames | Video]) -> str:
    """Where labels come from: the folder labels or masks, "alpha", "subtract", or "none"."""
    wanted = description.get("masks", "subtract")
    if wanted not in ("subtract", "none"):
        raise InputError(f'{source}: masks must be "subtract" or "none"; got {wanted!r}')
    if wanted == "none":
        return wanted
    own = next((name for name in reversed(OWN_FOLDERS) if (folder / name).is_dir()), None)
    cut_out = all(isinstance(frames, _Frames) for frames in sources) and any(map(_Frames.is_cut_out, sources))
    return own or ("alpha" if cut_out and "masks" not in description else wanted)


def _frames_of(folder: Path, name: str, size: tuple[int, int], source: Path, problems: Problems) -> _Frames | Video:
    """Where the frames of a camera come from; without any numbers where there is a problem."""
    videos = [folder / f"{name}{suffix}" for suffix in VIDEO_SUFFIXES if (folder / f"{name}{suffix}").is_file()]
    frames = _Frames(folder, Path(name), name, size)
    if len(videos) == 1 and not (folder / name).is_dir():
        return Video(inside(folder, videos[0].name, f"camera {name}"), name, size, problems)
    if not frames.numbers:
        found = f"found {', '.join(video.name for video in videos)}" if videos else "neither is there"
        problems.add(
            f"{source}: camera {name} needs a folder {name} with frames <number>.png or .jpg, or one video {name}.mp4 "
            f"({', '.join(VIDEO_SUFFIXES)}); {found}"
        )
    return frames


def _steps(
    sources: dict[str, _Frames | Video], fps: float | None, resample: float | None, source: Path, problems: Problems
) -> tuple[list[list[int]], float, list[str]]:
    """Frame numbers of every camera step by step, steps a second, notes: frames of all cameras that show one time."""
    videos = {name: frames for name, frames in sources.items() if isinstance(frames, Video) and frames.numbers}
    folders = {name: frames for name, frames in sources.items() if isinstance(frames, _Frames) and frames.numbers}
    if folders and fps is None:
        known = sorted({video.rate for video in videos.values() if video.rate})
        problems.add(f"{source}: fps is needed" + (f": the videos have {known}" if known else ""))
        fps = 1.0
    notes = [video.note for video in videos.values() if video.note]
    for video in videos.values():
        if video.rate is None and resample is None:
            hint = f'give "resample", steps a second, in {source.name}'
            problems.add(f"{video.what} is uneven: {video.unevenness}; {hint}")
    rates = {name: video.rate for name, video in videos.items() if video.rate}
    slow, fast = min(rates, key=rates.get, default=None), max(rates, key=rates.get, default=None)
    own_rate = rates.get(slow)
    if rates and resample is None:
        drift = max(len(video.numbers) for video in videos.values()) * (rates[fast] / own_rate - 1)
        if drift > MAX_DRIFT:
            problems.add(
                f"{source}: the videos have {own_rate:.5g} (camera {slow}) and {rates[fast]:.5g} (camera {fast}) "
                'frames a second; give "resample", steps a second'
            )
    if rates and fps and abs(fps / own_rate - 1) > SAME_RATE:
        if folders:
            problems.add(f"{source}: fps is {fps:g}, but the videos have {own_rate:g} frames a second")
        notes.append(f"videos of {own_rate:g} frames a second are taken to have {fps:g}, as fps says")
    if resample is not None:
        numbers, more = _resampled({**folders, **videos}, fps, resample, source)
        n_steps = max(map(len, numbers.values()), default=1)
        return [numbers.get(name, [0] * n_steps) for name in sources], resample, notes + more
    rate = fps or own_rate or 1.0
    first = {name: round(video.times[0] * (video.rate or 0)) for name, video in videos.items()}
    ticks = {name: [first[name] + number for number in video.numbers] for name, video in videos.items()}
    ticks = {name: ticks.get(name) or sources[name].numbers for name in sources if sources[name].numbers}
    if any(first.values()):
        low, high = max(own[0] for own in ticks.values()), min(own[-1] for own in ticks.values())
        longest = max(map(len, ticks.values()))
        ticks = {name: [tick for tick in own if low <= tick <= high] for name, own in ticks.items()}
        if high - low + 1 < longest:
            common = max(0, high - low + 1)
            notes.append(f"the videos start at different times: {common} of {longest} frames are common")
    common = common_numbers(ticks, source, problems) if ticks else []
    if not common:
        raise InputError(f"{source}: the cameras have no frame number in common")
    stride = common[1] - common[0] if len(common) > 1 else 1
    return [[tick - first.get(name, 0) for tick in common] for name in sources], rate / stride, notes


def _resampled(
    sources: dict[str, _Frames | Video], fps: float | None, rate: float, source: Path
) -> tuple[dict[str, list[int]], list[str]]:
    """For every camera the frames nearest to steps at ``rate`` a second, from where all have one to where all end."""
    if not sources:
        raise InputError(f"{source}: the cameras have no frame in common")
    times = {}
    for name, frames in sources.items():
        own = frames.times if isinstance(frames, Video) else np.array(frames.numbers) / fps
        times[name] = own * frames.rate / fps if fps and isinstance(frames, Video) and frames.rate else own
    low, high = max(own[0] for own in times.values()), min(own[-1] for own in times.values())
    count = math.floor((high - low) * rate + 1e-6) + 1 if high >= low else 0
    if count < 1:
        raise InputError(f"{source}: the cameras have no time in common")
    if count > MAX_STEPS:
        raise InputError(f"{source}: resample gives {count} steps; more than {MAX_STEPS} are taken to be a mistake")
    grid = low + np.arange(count) / rate
    numbers, off, again = {}, 0.0, 0
    for name, own in times.items():
        nearest = np.searchsorted((own[1:] + own[:-1]) / 2, grid)
        numbers[name] = [sources[name].numbers[at] for at in nearest]
        off, again = max(off, np.abs(own[nearest] - grid).max()), max(again, int((np.diff(nearest) == 0).sum()))
    return numbers, [
        f"resampled: frames lie up to {1000 * off:.3g} ms beside their steps, {again} of {count} steps show the frame "
        "before again"
    ]


class _Frames:
    """A folder of numbered images."""

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

    def is_cut_out(self) -> bool:
        """Whether some pixel of the first image is transparent."""
        for number in self.numbers[:1]:
            header = header_of(self._files[number], self._name, Problems(collect=True))
            if header is not None and header.alpha and header.size == self._size:
                image = read_image(self._files[number], self._size, self._name, Problems(collect=True))
                return image is not None and not is_opaque(image).all()
        return False

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
