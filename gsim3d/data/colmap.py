"""Reader of COLMAP sparse models, text or binary: cameras, images, and points3D for the depth range.

All camera models are supported except FOV and thin prism. If scene.json gives fps, the last number in an image's name
is its frame number and the rest names its camera; otherwise each image is its own camera at a single step. Lengths are
in model units. All keys: docs/reference/data.md.
"""

import dataclasses
import mmap
import struct
from array import array as numbers_of
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np

from gsim3d.data import transforms
from gsim3d.data.cameras import OPENGL, inverse, project, rotations, spread_steps
from gsim3d.data.recording import MAX_NUMBER, Description, Problems, Recording, read_json, trailing_number
from gsim3d.errors import InputError

NAME = "colmap"
FILE = "sparse/0"
FOLDERS = (FILE, "sparse", "colmap/sparse/0", ".")
SETTINGS, KEYS = "scene.json", ("fps", "near", "far", "origin", "bounds")
MODELS = (  # indexed by COLMAP's model id
    ("SIMPLE_PINHOLE", "f cx cy"), ("PINHOLE", "fl_x fl_y cx cy"), ("SIMPLE_RADIAL", "f cx cy k1"),
    ("RADIAL", "f cx cy k1 k2"), ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2"),
    ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"), ("FULL_OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    ("FOV", ""), ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"), ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    ("THIN_PRISM_FISHEYE", ""), ("RAD_TAN_THIN_PRISM_FISHEYE", ""),
)  # fmt: skip
MAX_LINE, MAX_PATH = 1 << 25, 4096  # bytes of a text line, and of an image name
MAX_ENTRIES = 100_000
MAX_POINTS, FEW_POINTS = 3_000_000, 20_000  # points read, and points projected
MIN_SEEN = 8  # points; cameras that see fewer do not contribute depths
QUANTILES, MARGINS = (0.01, 0.99), (0.8, 1.2)  # near and far: quantiles of point depths, times margins
QUATERNION_TOLERANCE = 1e-2


def recognises(folder: Path) -> bool:
    """Returns whether ``folder`` has a sparse model."""
    return _model_of(folder) is not None


def read(folder: Path, problems: Problems) -> Recording:
    """Reads the scene in ``folder``. Raises InputError if its description cannot be parsed."""
    model = _model_of(folder)
    settings = read_json(folder / SETTINGS) if (folder / SETTINGS).is_file() else {}
    if other := next((key for key in settings if key not in KEYS), None):
        raise InputError(f"{folder / SETTINGS}: {other:.80} is no key of this file; it has {', '.join(KEYS)}")
    fps = Description(settings, f"{folder / SETTINGS}: ", problems).positive("fps")
    source = _file(model, "images")
    cameras = dict(_bounded(_cameras(_file(model, "cameras")), model))
    frames = []
    for name, camera, quaternion, translation in _bounded(_images(source), model):
        if camera not in cameras:
            raise InputError(f"{source}: image {name} has camera {camera}, which is not in {_file(model, 'cameras')}")
        pose = inverse(_viewmat(quaternion, translation, f"{source}: image {name}")) @ OPENGL
        frame = {"file_path": f"images/{name}", "transform_matrix": pose, **cameras[camera]}
        if fps is not None:
            number = trailing_number(PurePosixPath(name).stem)
            if number is None:
                raise InputError(f"{source}: image {name} has no frame number, needed because {SETTINGS} gives fps")
            frame["time"] = number / fps
        frames.append(frame)
    if len({frame["file_path"] for frame in frames}) < len(frames):
        raise InputError(f"{source}: two images have the same name")
    frames = transforms.frames_of(folder, source, {"frames": frames})
    recording = transforms.recording_of(folder, source, settings | {"fps": None}, frames, problems)
    if recording.near is None or recording.far is None:
        near, far = _depths(model, recording) or (None, None)
        recording = dataclasses.replace(recording, near=recording.near or near, far=recording.far or far)
    notes = [f"{SETTINGS} has no fps: each image is its own camera at a single step"] if fps is None else []
    others = sum(path.is_dir() for path in model.parent.iterdir()) - 1 if model.name == "0" else 0
    if others > 0:
        notes.append(f"{model} is used; {others} other models are ignored")
    return dataclasses.replace(recording, layout=NAME, notes=tuple(notes))


def _model_of(folder: Path) -> Path | None:
    for name in FOLDERS:
        model = folder / name
        if all(_file(model, kind) for kind in ("cameras", "images")) and (name != "." or (folder / "images").is_dir()):
            return model
    return None


def _file(model: Path, kind: str) -> Path | None:
    return next((file for suffix in (".bin", ".txt") if (file := model / f"{kind}{suffix}").is_file()), None)


def _bounded(entries: Iterator[tuple], model: Path) -> Iterator[tuple]:
    for number, entry in enumerate(entries):
        if number == MAX_ENTRIES:
            raise InputError(f"{model} has more than {MAX_ENTRIES} images or cameras")
        yield entry


def _viewmat(quaternion: tuple, translation: tuple, what: str) -> np.ndarray:
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise InputError(f"{what}: the quaternion must have length 1; got {length:.4g}")
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotations(np.array([quaternion]) / length)[0]
    viewmat[:3, 3] = translation
    return viewmat


def _depths(model: Path, recording: Recording) -> tuple[float, float] | None:
    """Estimates near and far from the depths of visible 3D points; None if too few are visible."""
    file = _file(model, "points3D")
    points = np.frombuffer(_points(file) if file else b"", dtype=np.float64).reshape(-1, 3)
    points = points[(np.abs(points) <= MAX_NUMBER).all(1)]
    points = points[:: -(-len(points) // FEW_POINTS) or 1]
    viewmats, Ks, sizes = spread_steps(recording.viewmats), spread_steps(recording.Ks), np.array(recording.sizes)
    ends = []
    for step, cam in np.ndindex(viewmats.shape[:2]):
        pixels, depth = project(points, viewmats[step, cam], Ks[step if len(Ks) > 1 else 0, cam])
        seen = depth[(depth > 0) & (pixels >= 0).all(-1) & (pixels <= sizes[cam]).all(-1)]
        if len(seen) >= MIN_SEEN:
            ends.append(np.quantile(seen, QUANTILES))
    if not ends:
        return None
    return float(MARGINS[0] * np.min(ends, 0)[0]), float(MARGINS[1] * np.max(ends, 0)[1])


def _cameras(file: Path) -> Iterator[tuple[int, dict]]:
    """Yields (camera id, keys as in transforms.json)."""
    if file.suffix == ".bin":
        data = _Binary(file)
        for _ in range(data.take("Q")[0]):
            number, model, width, height = data.take("iiQQ")
            name, keys = MODELS[model] if 0 <= model < len(MODELS) else (str(model), "")
            yield number, _keys(file, number, name, keys, (width, height), data.take(f"{len(keys.split())}d"))
        return
    models = dict(MODELS)
    for line, what in _lines(file):
        try:
            number, name, width, height, *values = line.split()
            number, size, values = int(number), (int(width), int(height)), [float(value) for value in values]
        except ValueError:
            raise _unreadable(what, line) from None
        yield number, _keys(file, number, name, models.get(name, ""), size, values)


def _keys(file: Path, number: int, model: str, keys: str, size: tuple[int, int], values) -> dict:
    what = f"{file}: camera {number}"
    if not keys:
        raise InputError(f"{what}: camera model {model[:80]} is not supported; run colmap image_undistorter")
    if len(values) != len(keys.split()):
        raise InputError(f"{what}: {model} has {len(keys.split())} parameters; got {len(values)}")
    found = dict(zip(keys.split(), values, strict=True))
    if "f" in found:
        found["fl_x"] = found["fl_y"] = found.pop("f")
    return {"camera_model": model, "w": size[0], "h": size[1], **found}


def _images(file: Path) -> Iterator[tuple[str, int, tuple, tuple]]:
    """Yields (name, camera id, quaternion (w, x, y, z), translation) of every image."""
    if file.suffix == ".bin":
        data = _Binary(file)
        for _ in range(data.take("Q")[0]):
            _, *pose, camera = data.take("i7di")
            name = data.text()
            data.skip(24 * data.take("Q")[0])
            yield name, camera, tuple(pose[:4]), tuple(pose[4:])
        return
    for line, what in _lines(file, pairs=True):
        try:
            _, *pose, camera, name = line.split(maxsplit=9)
            pose, camera = tuple(float(value) for value in pose), int(camera)
        except ValueError:
            raise _unreadable(what, line) from None
        if len(pose) != 7:
            raise _unreadable(what, line)
        yield name, camera, pose[:4], pose[4:]


def _points(file: Path) -> numbers_of:
    """Returns the first MAX_POINTS positions as a flat array x, y, z, x, ..."""
    points = numbers_of("d")
    if file.suffix == ".bin":
        data = _Binary(file)
        for _ in range(min(data.take("Q")[0], MAX_POINTS)):
            points.extend(data.take("8x3d3x8x"))
            data.skip(8 * data.take("Q")[0])
        return points
    for line, what in _lines(file):
        try:
            x, y, z = (float(value) for value in line.split(maxsplit=4)[1:4])
        except ValueError:
            raise _unreadable(what, line) from None
        points.extend((x, y, z))
        if len(points) >= 3 * MAX_POINTS:
            break
    return points


def _unreadable(what: str, line: str) -> InputError:
    return InputError(f"{what} cannot be read: {line[:80]!r}")


def _lines(file: Path, pairs: bool = False) -> Iterator[tuple[str, str]]:
    """Yields (line, location for messages) without comments; ``pairs`` skips the 2D points line after each line."""
    with open(file, "rb") as opened:
        number = 0
        while raw := _line(opened, file):
            number += 1
            what = f"{file}: line {number}"
            try:
                line = raw.decode("utf-8-sig").strip()
            except UnicodeDecodeError:
                raise InputError(f"{what} cannot be read: it is not UTF-8") from None
            if len(raw) == MAX_LINE:
                raise InputError(f"{what} has more than {MAX_LINE >> 20} MiB")
            if not line or line.startswith("#"):
                continue
            yield line, what
            if pairs:
                number += 1
                if len(_line(opened, file).split()) % 3:
                    raise InputError(f"{file}: line {number} must hold the previous image's 2D points, or be empty")


def _line(opened: BinaryIO, file: Path) -> bytes:
    try:
        return opened.readline(MAX_LINE)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None


class _Binary:
    """Sequential reader of a little-endian binary file."""

    def __init__(self, file: Path):
        self._file, self._at = file, 0
        with open(file, "rb") as opened:
            try:
                self._data = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
            except ValueError:  # an empty file
                raise self._short() from None
            except OSError as error:
                raise InputError(f"{file} cannot be read: {error.strerror}") from None

    def take(self, form: str) -> tuple:
        try:
            values = struct.unpack_from("<" + form, self._data, self._at)
        except struct.error:
            raise self._short() from None
        self._at += struct.calcsize("<" + form)
        return values

    def skip(self, count: int) -> None:
        if count > len(self._data) - self._at:
            raise self._short()
        self._at += count

    def text(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + MAX_PATH)
        if end < 0:
            raise self._short()
        try:
            name = self._data[self._at : end].decode()
        except UnicodeDecodeError:
            raise InputError(f"{self._file} cannot be read: the name of an image is not UTF-8") from None
        self._at = end + 1
        return name

    def _short(self) -> InputError:
        return InputError(f"{self._file} cannot be read: it ends too early; it is truncated or not a COLMAP model")
