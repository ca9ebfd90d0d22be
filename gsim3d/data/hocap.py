"""Reader of HO-Cap sequences: eight synchronised cameras, segmentation, and hand joints as actions.

Both versions of the layout are read: YAML descriptions with label_<frame>.npz, and the older JSON descriptions with
mask_<frame>.png and no joints. World = the frame of calibration tag 1: metres, z up, the table near z = 0.
"""

import io
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.data import recording
from gsim3d.data.actions import MAX_BYTES, UNREADABLE
from gsim3d.data.cameras import check_intrinsics, check_pose, depth_range, inverse, project
from gsim3d.data.images import as_color, as_mask, read_files
from gsim3d.data.recording import (
    FIXED,
    MOVING,
    Camera,
    Description,
    Problems,
    RecordedActions,
    Recording,
    array,
    evenly_spaced,
    inside,
)
from gsim3d.errors import InputError
from gsim3d.io.files import read_file, read_yaml

NAME = "hocap"
FILE = "meta.yaml"
FILES = (FILE, "meta.json")
FPS = 30.0
WORLD_TAG = "tag_1"
WORKSPACE = np.array([[-0.60, -0.35, -0.01], [0.60, 0.35, 0.80]])  # metres
MIN_NEAR = 0.1  # metres
JOINTS = 21  # of a hand: wrist, then four of thumb, index, middle, ring and little finger, from base to tip
SIDES = ("right", "left")
ABSENT = -1.0  # in labels
MAX_GAP = 3  # frames without joints that are interpolated
JOINT_CAMERAS = 3  # cameras over which the joints of a frame are averaged
CHECKED_FRAMES = 16
MAX_SPREAD = 1.0  # mm, median distance between the joints of several cameras
MAX_ERROR = 2.0  # pixels, median reprojection error of the joints


def recognises(folder: Path) -> bool:
    """Returns whether ``folder`` is a sequence: meta.yaml or meta.json beside poses_m.npy or frames of cameras."""
    if not any((folder / file).is_file() for file in FILES):
        return False
    return (folder / "poses_m.npy").is_file() or next(folder.glob("*/color_000000.jpg"), None) is not None


def read(folder: Path, problems: Problems) -> Recording:
    """Reads the sequence in ``folder``. Raises InputError if its description cannot be parsed."""
    sequence = _Sequence(folder, problems)
    cameras, n_steps = sequence.cameras(), sequence.n_steps
    sequence.notes += sequence.check_rig(cameras)
    actions = sequence.actions(cameras)
    near, far = _depths(np.stack([camera.viewmats for camera in cameras]))
    return Recording.of_cameras(
        cameras,
        n_steps,
        layout=NAME,
        source=sequence.source,
        fps=FPS,
        read_images=sequence.read_images,
        read_labels=sequence.read_labels if sequence.labelled else None,
        near=near,
        far=far,
        bounds=WORKSPACE,
        actions=actions,
        notes=tuple(sequence.notes),
    )


def _depths(viewmats: np.ndarray) -> tuple[float, float]:
    """Returns the smallest and largest depth of the workspace's corners in all cameras, near not below the usual guess:
    particles right before their own camera are seen by no other, and get no gradient from the others' images."""
    corners = np.array([[WORKSPACE[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    depths = corners @ viewmats[:, 2, :3].T + viewmats[:, 2, 3]
    near = max((depth_range(viewmats) or (MIN_NEAR,))[0], float(depths.min()))
    return near, max(2 * near, float(depths.max()))


class _Sequence:
    """One sequence: its description and files."""

    def __init__(self, folder: Path, problems: Problems):
        self.folder, self.problems, self.notes = folder, problems, []
        self.source = next(file for name in FILES if (file := folder / name).is_file())
        self.is_first = self.source.suffix == ".json"  # the first version of the layout
        self._meta = Description(read_yaml(self.source), f"{self.source}: ", problems)
        self.n_steps = self._meta.whole("num_frames", recording.MAX_STEPS)
        rig = self._meta.values.get("realsense")
        serials = rig.get("serials") if isinstance(rig, dict) else None
        if not isinstance(serials, list) or not 1 <= len(serials) <= recording.MAX_CAMS:
            raise InputError(f"{self.source}: realsense.serials must be a list of cameras; got {str(serials)[:80]}")
        self.size = Description(
            {"size": [rig.get("width"), rig.get("height")]}, f"{self.source}: realsense.", problems
        ).size("size")
        self.serials = [self._serial(value) for value in serials]
        if twice := next((serial for k, serial in enumerate(self.serials) if serial in self.serials[:k]), None):
            raise InputError(f"{self.source}: realsense.serials lists camera {twice} twice")
        sides = self._meta.values.get("mano_sides", [])
        if not isinstance(sides, list) or any(side not in SIDES for side in sides) or len(set(sides)) < len(sides):
            raise InputError(f"{self.source}: mano_sides must be of {', '.join(SIDES)}; got {str(sides)[:80]}")
        self.sides = [side for side in SIDES if side in sides]
        self._rows = sides
        self._label_frames = [self._find_labels(serial) for serial in self.serials]
        bare = [serial for serial, own in zip(self.serials, self._label_frames, strict=True) if not own]
        self.labelled = self.is_first or not bare
        if self.has_joints and bare:
            self.notes.append(f"camera {', '.join(bare)}: has no label files, so masks are read of no camera")
        if self.has_joints and "mano_sides" not in self._meta.values:
            self.notes.append("mano_sides is missing: joints of hands are not read")
        self.types = [f"{side}_{joint}" for side in self.sides for joint in range(JOINTS)] if self.has_joints else []

    @property
    def has_joints(self) -> bool:
        """Whether some camera has label files."""
        return not self.is_first and any(self._label_frames)

    def _serial(self, value: Any) -> str:
        """Returns the serial of a camera, and checks its number of frames."""
        name = next((name for name in _names(value) if Path(name).name == name and (self.folder / name).is_dir()), None)
        if name is None:
            raise InputError(f"{self.source}: realsense.serials lists camera {str(value)[:80]!r}, which has no folder")
        present = len(list((self.folder / name).glob("color_*.jpg")))
        if present < self.n_steps:
            first = next(k for k in range(self.n_steps) if not self._file(name, "color", k, "jpg").is_file())
            self.problems.add(
                f"{self.folder / name} has {present} of num_frames {self.n_steps} frames; the first missing is {first}"
            )
            self.n_steps = max(1, present)
        return name

    def _file(self, serial: str, kind: str, frame: int, suffix: str) -> Path:
        return self.folder / serial / f"{kind}_{frame:06d}.{suffix}"

    def _find_labels(self, serial: str) -> list[int]:
        numbers = (recording.trailing_number(file.stem) for file in (self.folder / serial).glob("label_*.npz"))
        found = sorted(number for number in numbers if number is not None and number < self.n_steps)
        if found and len(found) < self.n_steps:
            self.notes.append(f"camera {serial}: {self.n_steps - len(found)} frames have no label: the nearest is used")
        return found

    # ---- cameras ----

    def cameras(self) -> list[Camera]:
        """Reads intrinsics and poses."""
        calibration = self.folder.resolve().parent.parent / "calibration"
        poses = self._poses(calibration)
        return [
            Camera(serial, self.size, inverse(pose), self._intrinsics(calibration / "intrinsics", serial))
            for serial, pose in zip(self.serials, poses, strict=True)
        ]

    def _poses(self, calibration: Path) -> list[np.ndarray]:
        """Returns the camera-to-world matrices [4, 4]."""
        values = self._meta.values
        given = values.get("calibration") if self.is_first else values
        name = given.get("extrinsics") if isinstance(given, dict) else None
        if not isinstance(name, str):
            raise InputError(f"{self.source}: extrinsics must name a file of calibration/extrinsics; got {name!r:.80}")
        name = f"{name}/extrinsics.json" if self.is_first else name
        file = inside(calibration / "extrinsics", name, f"{self.source}: extrinsics")
        entries = read_yaml(file).get("extrinsics")
        entries = entries if isinstance(entries, dict) else {}
        entries = {name: value for key, value in entries.items() for name in _names(key)}
        description = Description(entries, f"{file}: extrinsics.", self.problems)
        matrices = {}
        for key in (WORLD_TAG, *self.serials):
            numbers = description.array(key, (12,))
            matrix = np.eye(4)
            if numbers is not None:
                matrix[:3] = numbers.reshape(3, 4)
            matrices[key] = matrix if check_pose(matrix, f"{file}: extrinsics.{key}", self.problems) else np.eye(4)
        world = inverse(matrices[WORLD_TAG])
        return [world @ matrices[serial] for serial in self.serials]

    def _intrinsics(self, folder: Path, serial: str) -> np.ndarray:
        files = sorted(folder.glob(f"{serial}_*.json")) if self.is_first else [folder / f"{serial}.yaml"]
        if not files:
            raise InputError(f"{folder}: the intrinsics of camera {serial} are missing")
        values = read_yaml(files[0]).get("color")
        values = values if isinstance(values, dict) else {}
        keys, what = ("fx", "fy", "ppx", "ppy"), f"{files[0]}: color: fx, fy, ppx, ppy"
        numbers = array([values.get(key) for key in keys], [(4,)], what, self.problems)
        if numbers is None:
            return np.eye(3)
        lens = values.get("coeffs")
        if any(lens if isinstance(lens, list) else [lens]):
            self.notes.append(f"camera {serial}: lens coefficients are ignored, as the data set's tools do")
        # Pixel centres are integers in the files.
        fx, fy, cx, cy = numbers
        K = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]])
        return K if check_intrinsics(K, self.size, f"{files[0]}: color", self.problems) else np.eye(3)

    # ---- images and labels ----

    def read_images(self, cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        """Yields frames of a camera, see :class:`gsim3d.data.recording.Recording`."""
        serial = self.serials[cam]
        files = ((self._file(serial, "color", step, "jpg"), f"camera {serial}, frame {step}") for step in steps)
        return read_files(files, self.size, as_color, problems)

    def read_labels(self, cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        """Yields labels of a camera: MOVING on objects and hands, FIXED elsewhere."""
        serial, shape = self.serials[cam], self.size[::-1]
        for step in steps:
            if self.is_first:
                file = self._file(serial, "mask", step, "png")
                mask = np.zeros(shape, np.uint8)  # frames without objects have no file
                if file.is_file():
                    given = iter([(file, f"camera {serial}, frame {step}")])
                    mask = next(read_files(given, self.size, as_mask, problems))
            else:
                frames = self._label_frames[cam]
                mask = self._label(serial, min(frames, key=lambda frame: abs(frame - step)), problems, seg_mask=shape)
                mask = None if mask is None else mask["seg_mask"]
            yield None if mask is None else np.where(mask > 0, MOVING, FIXED).astype(np.uint8)

    def _label(self, serial: str, frame: int, problems: Problems, **shapes: tuple) -> dict[str, np.ndarray] | None:
        """Reads arrays of a label file with these shapes (None: any size); returns None on error."""
        file = self._file(serial, "label", frame, "npz")
        try:
            content = io.BytesIO(read_file(file, MAX_BYTES))
            with zipfile.ZipFile(content) as archive:
                if max((entry.file_size for entry in archive.infolist()), default=0) > MAX_BYTES:
                    raise ValueError(f"an array has more than {MAX_BYTES} bytes")
            with np.load(content, allow_pickle=False) as arrays:
                found = {key: np.asarray(arrays[key]) for key in shapes}  # a member without array header: bytes
        except (InputError, *UNREADABLE) as error:
            problems.add(str(error) if isinstance(error, InputError) else f"{file} cannot be read: {str(error)[:200]}")
            return None
        for key, shape in shapes.items():
            value = found[key]
            fits = value.ndim == len(shape) and all(s in (None, n) for s, n in zip(shape, value.shape, strict=True))
            if not fits or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
                got = f"{value.dtype} {list(value.shape)}"
                problems.add(f"{file}: {key} must be finite numbers of shape {list(shape)}; got {got}")
                return None
        return found

    # ---- joints ----

    def _rows_of(self, joints: np.ndarray) -> list[np.ndarray]:
        """Returns the rows of ``joints`` [hands, ...] of each side, right first."""
        order = list(SIDES) if len(joints) == 2 and len(self._rows) == 1 else self._rows
        joints = np.concatenate([joints, np.full((1, *joints.shape[1:]), ABSENT)])
        return [joints[min(order.index(side), len(joints) - 1)] for side in self.sides]

    def _seen(self, cam: int, frame: int, camera: Camera) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the joints that a camera's label has: world positions [A, 3] (NaN: absent), and pixels [A, 2]."""
        if frame not in self._label_frames[cam]:
            return None
        shapes = {"hand_joints_3d": (None, JOINTS, 3), "hand_joints_2d": (None, JOINTS, 2)}
        found = self._label(self.serials[cam], frame, self.problems, **shapes)
        if found is None or not len(found["hand_joints_3d"]):
            return None
        local, pixels = (np.concatenate(self._rows_of(found[key].astype(np.float64))) for key in shapes)
        pose = inverse(camera.viewmats)
        local[(local == ABSENT).all(1)] = np.nan
        pixels[(pixels == ABSENT).any(1)] = np.nan
        return local @ pose[:3, :3].T + pose[:3, 3], pixels

    def actions(self, cameras: Sequence[Camera]) -> RecordedActions | None:
        """Returns the joints that are ever known, by the median over cameras; adds notes. Short gaps are interpolated;
        in long ones a joint is absent, and its position is the nearest known."""
        positions = np.full((self.n_steps, len(self.types), 3), np.nan)
        for frame in range(self.n_steps if self.types else 0):
            seen = []
            for cam, camera in enumerate(cameras):
                found = self._seen(cam, frame, camera)
                seen += [] if found is None or np.isnan(found[0]).all() else [found[0]]
                if len(seen) == JOINT_CAMERAS:
                    break
            if seen:
                positions[frame] = _median(np.stack(seen))
        present, frames = ~np.isnan(positions).any(2), np.arange(self.n_steps)
        points = np.flatnonzero(present.any(0))
        for point in points:
            known = np.flatnonzero(present[:, point])
            held = positions[known[np.searchsorted((known[1:] + known[:-1]) / 2, frames)], point]
            for before, after in zip(known[:-1], known[1:]):
                if 1 < after - before <= MAX_GAP + 1:
                    share = np.linspace(0, 1, after - before + 1)[:, None]
                    ends = positions[before, point], positions[after, point]
                    held[before : after + 1] = ends[0] + share * (ends[1] - ends[0])
                    present[before:after, point] = True
            positions[:, point] = held
        for side in SIDES:
            absent = (~present[:, [p for p in points if self.types[p].startswith(side)]]).sum(0).max(initial=0)
            if absent:
                self.notes.append(f"{side} hand: absent at {absent} of {self.n_steps} frames")
        names = tuple(self.types[point] for point in points)
        return RecordedActions(positions[:, points], names, present[:, points]) if names else None

    def check_rig(self, cameras: Sequence[Camera]) -> list[str]:
        """Compares the joints of each camera with their median and its labels; returns notes, reports a bad fit."""
        apart, errors = ([[np.zeros(0)] for _ in cameras] for _ in range(2))
        for frame in evenly_spaced(self.n_steps, CHECKED_FRAMES) if self.types else ():
            seen = {cam: found for cam, camera in enumerate(cameras) if (found := self._seen(cam, frame, camera))}
            if len(seen) < 2:
                continue
            middle = _median(np.stack([positions for positions, _ in seen.values()]))
            for cam, (positions, pixels) in seen.items():
                projected, _ = project(np.nan_to_num(middle), cameras[cam].viewmats, cameras[cam].Ks)
                off = np.linalg.norm(projected - 0.5 - pixels, axis=1)
                errors[cam].append(np.where(np.isnan(middle[:, 0]), np.nan, off))
                apart[cam].append(1000 * np.linalg.norm(positions - middle, axis=1))
        (distance, farthest), (error, worst) = (self._worst(values) for values in (apart, errors))
        found = (
            f"hand joints lie up to {distance:.1f} mm (camera {farthest}) from the median of all cameras, which "
            f"projects up to {error:.1f} px (camera {worst}) off the labels"
        )
        if error > MAX_ERROR:
            self.problems.add(f"{self.source}: the calibration does not fit: {found} (at most {MAX_ERROR:g} px)")
        return [found] if distance > MAX_SPREAD or error > MAX_ERROR else []

    def _worst(self, values: Sequence[Sequence[np.ndarray]]) -> tuple[float, str]:
        """Returns the largest median of the finite values of a camera, and the camera's serial."""
        joined = [np.concatenate(own) for own in values]
        known = [(own[np.isfinite(own)], serial) for own, serial in zip(joined, self.serials, strict=True)]
        return max(((float(np.median(own)), serial) for own, serial in known if len(own)), default=(0.0, ""))


def _names(serial: Any) -> list[str]:
    """Returns what a serial may be: without quotes, YAML parses it as a decimal or octal number."""
    return [f"{serial:012d}", f"0{serial:o}"] if type(serial) is int and serial >= 0 else [str(serial)[:200]]


def _median(points: np.ndarray) -> np.ndarray:
    """Returns the median [A, 3] over [V, A, 3], ignoring NaN; NaN where all are."""
    missing = np.isnan(points).any(2).all(0)
    middle = np.nanmedian(np.where(missing[:, None], 0, points), 0)
    return np.where(missing[:, None], np.nan, middle)
