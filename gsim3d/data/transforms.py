"""Reader of Nerfstudio's transforms.json with frame times and any number of cameras, and of NeRF-synthetic splits.

Top-level keys are defaults of every frame. Frames without ``camera`` belong to one camera if their paths differ only in
the last number. All keys: docs/reference/data.md.
"""

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data import lenses, recording
from gsim3d.data.cameras import OPENGL, check_intrinsics, check_pose, inverse
from gsim3d.data.images import IMAGE_SUFFIXES, as_color, as_labels, as_mask, as_opaque, header_of, read_files
from gsim3d.data.recording import Camera, Description, Problems, Recording, array, inside, read_json
from gsim3d.errors import InputError

NAME = "transforms"
FILE = "transforms.json"
SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
ANGLES = ("camera_angle_x", "camera_angle_y")
OWN = ("frames", "file_path", "transform_matrix", "time", "camera", "mask_path", "label_path")  # never defaults
SAME_FOCAL = 0.02  # relative difference between focal lengths given as such and as angles
MAX_TIME, SAME_TIME = 1e19, 1e-6  # nanoseconds since 1970 are below; fraction of the duration that is one step


def recognises(folder: Path) -> bool:
    """Returns whether ``folder`` has a transforms.json or NeRF-synthetic splits."""
    return any((folder / name).is_file() for name in (FILE, *SPLITS))


def read(folder: Path, problems: Problems) -> Recording:
    """Reads the scene in ``folder``. Raises InputError if its description cannot be parsed."""
    sources = [folder / name for name in (FILE, *SPLITS) if (folder / name).is_file()]
    source, *splits = sources[:1] if sources[0].name == FILE else sources
    description, notes = read_json(source), []
    frames = frames_of(folder, source, description)
    for other in splits:
        more = frames_of(folder, other, read_json(other))
        if _times(more) == _times(frames):
            frames += more
            notes.append(f"the views of {other.name} are added as cameras")
        else:
            notes.append(f"{other.name} is ignored: its times differ from those of {source.name}")
    return dataclasses.replace(recording_of(folder, source, description, frames, problems), notes=tuple(notes))


def recording_of(folder: Path, source: Path, description: dict, frames: list[dict], problems: Problems) -> Recording:
    """Builds a recording from ``frames`` in Nerfstudio's format, see :func:`frames_of`. ``description``: fps, near,
    far, origin and bounds; ``source``: the file that describes the scene, for messages."""
    if len(frames) > recording.MAX_STEPS:
        raise InputError(f"{source}: {len(frames)} frames exceed the limit of {recording.MAX_STEPS}")
    table, times = _table(frames, source, problems)
    names = sorted(table, key=recording.natural_order)
    if len(names) > recording.MAX_CAMS:
        raise InputError(f"{source}: {len(names)} cameras exceed the limit of {recording.MAX_CAMS}")
    cameras = [_CameraFrames(name, table[name], folder, source, problems) for name in names]
    given = Description(description, f"{source}: ", problems)
    fps = given.positive("fps")
    if len(times) > 1:
        rate, broken = recording.step_rate(times)
        if broken is not None:
            problems.add(
                f"{source}: times must be evenly spaced by {1 / rate:g}; {times[broken]:g} is followed by "
                f"{times[broken + 1]:g}"
            )
        fps = fps or rate
    has_labels = any("mask_path" in frame or "label_path" in frame for frame in frames)

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return cameras[cam].read("file_path", as_color, steps, problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        camera = cameras[cam]
        if not has_labels:
            yield from camera.read("file_path", as_opaque, steps, problems)
            return
        for step in steps:
            frame = camera.frames[step]
            key, convert = ("label_path", as_labels) if "label_path" in frame else ("mask_path", as_mask)
            if key in frame:
                yield from camera.read(key, convert, [step], problems)
            else:
                problems.add(f"{source}: {camera.frame(step)} has no mask_path, but other frames have one")
                yield None

    return Recording.of_cameras(
        [camera.camera() for camera in cameras],
        len(times),
        layout=NAME,
        source=source,
        fps=fps or 1.0,
        read_images=read_images,
        read_labels=read_labels if has_labels or any(camera.has_alpha() for camera in cameras) else None,
        real_background=True,
        **given.workspace(),
    )


def frames_of(folder: Path, source: Path, description: dict) -> list[dict]:
    """Returns the frames of a description with its top-level keys as defaults; validates that paths are in folder."""
    frames = description.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source}: frames must be a list of one or more JSON objects")
    if isinstance(description.get("camera"), dict):
        raise InputError(f"{source}: camera must not be an object; give its keys (fl_x, k1 ...) at the top level")
    for number, frame in enumerate(frames):
        for key in ("file_path", *(key for key in ("mask_path", "label_path") if key in frame)):
            if not isinstance(frame.get(key), str):
                raise InputError(f"{source}: frames[{number}].{key} must be a string; got {str(frame.get(key))[:80]!r}")
            inside(folder, frame[key], f"{source}: frames[{number}].{key}")
    shared = {key: value for key, value in description.items() if key not in OWN}
    if len(shared) > 200:
        raise InputError(f"{source}: {len(shared)} keys beside frames exceed the limit of 200")
    without_angles = {key: value for key, value in shared.items() if key not in ANGLES}
    return [{**(without_angles if "fl_x" in frame else shared), **frame} for frame in frames]


def _times(frames: list[dict]) -> set[str]:
    return {f"{time:.6g}" if isinstance(time := frame.get("time"), (int, float)) else repr(time) for frame in frames}


def _table(frames: list[dict], source: Path, problems: Problems) -> tuple[dict, np.ndarray]:
    """Groups frames by camera. Returns (camera name -> its frames ordered by step, times of the steps)."""
    timeless = [number for number, frame in enumerate(frames) if "time" not in frame]
    if len(timeless) == len(frames):
        table = {str(frame.get("camera", Path(frame["file_path"]))): [frame] for frame in frames}
        if len(table) < len(frames):
            raise InputError(
                f"{source}: {len(frames)} frames of {len(table)} cameras have no time; give every frame a time"
            )
        return table, np.zeros(1)
    if timeless:
        raise InputError(
            f"{source}: frames[{timeless[0]}] ({frames[timeless[0]]['file_path']}) has no time, but other frames have"
        )
    stamps = array(
        [frame["time"] for frame in frames], [(len(frames),)], f"{source}: time of frames", problems, MAX_TIME
    )
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
                f"missing: time {times[missing[0]]:g} (frame {missing[0]}); if frames were grouped into cameras "
                "wrongly, give every frame its camera"
            )
            first = next(frame for frame in own if frame is not None)
            table[name] = [frame or first for frame in own]
    return table, times


def _camera_name(frame: dict) -> str:
    if "camera" in frame:
        return str(frame["camera"])
    return re.sub(r"[_\-/]?\d+(?=\D*$)", "", str(Path(frame["file_path"]).with_suffix(""))) or "camera"


class _CameraFrames:
    """All frames of one camera, ordered by step."""

    def __init__(self, name: str, frames: list[dict], folder: Path, source: Path, problems: Problems):
        self.name, self.frames, self._folder, self._source, self._problems = name, frames, folder, source, problems
        self.size = self._size()

    def camera(self) -> Camera:
        """Returns the camera with lens, poses and intrinsics of all steps."""
        steps = range(len(self.frames))
        found = [
            lenses.lens_of(frame, f"{self._source}: {self.frame(step)}", self._problems)
            for step, frame in enumerate(self.frames)
        ]
        if any(lens != found[0] for lens in found):
            self._problems.add(
                f"{self._source}: camera {self.name}: the lens (camera_model, k1 ...) must be the same in all frames"
            )
        viewmats = np.stack([self._viewmat(step) for step in steps])
        return Camera(self.name, self.size, viewmats, np.stack([self._K(step) for step in steps]), found[0])

    def frame(self, step: int) -> str:
        """Returns "camera, frame" for messages."""
        return f"camera {self.name}, frame {step}"

    def read(self, key: str, convert, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        """Reads and converts the images at ``steps`` whose paths are stored under ``key``."""
        return read_files((self._file(key, step) for step in steps), self.size, convert, problems)

    def has_alpha(self) -> bool:
        """Returns whether the first image has an alpha channel."""
        header = header_of(*self._file("file_path", 0), Problems(collect=True))
        return header is not None and header.alpha

    def _file(self, key: str, step: int) -> tuple[Path, str]:
        file = inside(self._folder, self.frames[step][key], f"{self._source}: {key} of {self.frame(step)}")
        if file.suffix.lower() not in IMAGE_SUFFIXES and not file.is_file():  # NeRF-synthetic omits the suffix
            found = [file.with_name(file.name + suffix) for suffix in IMAGE_SUFFIXES]
            file = next((path for path in found if path.is_file()), found[0])
        return file, self.frame(step)

    def _size(self) -> tuple[int, int]:
        given, key = [self.frames[0].get(key) for key in ("w", "h")], f"w, h of camera {self.name}"
        if given == [None, None]:
            header = header_of(*self._file("file_path", 0), self._problems)
            given = [1, 1] if header is None else list(header.size)
        return Description({key: given}, f"{self._source}: ", self._problems).size(key)

    def _viewmat(self, step: int) -> np.ndarray:
        what = f"{self._source}: transform_matrix of {self.frame(step)}"
        pose = array(self.frames[step].get("transform_matrix"), [(4, 4), (3, 4)], what, self._problems)
        if pose is None:
            return np.eye(4)
        if len(pose) == 3:
            pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
        return OPENGL @ inverse(pose) if check_pose(pose, what, self._problems) else np.eye(4)

    def _K(self, step: int) -> np.ndarray:
        frame, what, problems = self.frames[step], f"{self._source}: intrinsics of {self.frame(step)}", self._problems
        size = [frame.get(key) for key in ("w", "h")]
        if size != list(self.size) and size != [None, None]:
            problems.add(f"{what}: w, h are {size}, but {list(self.size)} in the camera's first frame")
        keys = ("fl_x", "fl_y", "cx", "cy")
        given = {key: frame[key] for key in keys if frame.get(key) is not None}
        angles = [self._focal(Description(frame, f"{what}: ", problems), axis) for axis in (0, 1)]
        known = {"fl_x": angles[0] or angles[1], "fl_y": angles[1] or given.get("fl_x") or angles[0]}
        if any(angles):  # fields of view are symmetric, so the principal point defaults to the centre
            known |= {"cx": self.size[0] / 2, "cy": self.size[1] / 2}
        given = {key: value for key, value in known.items() if value is not None} | given
        missing = [key for key in keys if key not in given]
        if missing:
            angle = ", or camera_angle_x instead" if missing[0] == "fl_x" else ""
            problems.add(f"{what}: {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing{angle}")
            return np.eye(3)
        values = array([given[key] for key in keys], [(4,)], f"{what}: fl_x, fl_y, cx, cy", problems)
        if values is None:
            return np.eye(3)
        for axis, angle in enumerate(angles):
            if angle and abs(values[axis] / angle - 1) > SAME_FOCAL:
                problems.add(
                    f"{what}: {keys[axis]} is {values[axis]:g}, but {angle:g} by {ANGLES[axis]}; remove one of them"
                )
        K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
        return K if check_intrinsics(K, self.size, what, problems) else np.eye(3)

    def _focal(self, frame: Description, axis: int) -> float | None:
        """Returns the focal length in pixels from the field of view along an image axis; None if not given."""
        angle = frame.positive(ANGLES[axis])
        if angle is None:
            return None
        if angle >= math.pi:
            frame.problems.add(f"{frame.where}{ANGLES[axis]} must be below pi (radians); got {angle:g}")
            return None
        return 0.5 * self.size[axis] / math.tan(0.5 * angle)
