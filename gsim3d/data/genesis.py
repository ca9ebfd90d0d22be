"""Scene folders in the published layout: metadata.json, and images of calibrated cameras at every step.

metadata.json holds n_steps, n_cams, file_path_template (fields cam_ix, n_step, img_type; ".png" is appended)
and for each camera cam_<j>: extrinsics (4x4, world-to-camera, OpenCV axes), intrinsics (3x3, pixels) and
resolution [W, H]. Optional: fps, near, far (metres) and origin (lower corner of the workspace).
Image types: rgb; seg (0 background, 1 ground and fixed parts, 3 bodies that may move).
"""

from __future__ import annotations

import json
import math
import re
import string
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.data.images import ImageCache
from gsim3d.errors import InputError
from gsim3d.types import Cameras

DEFAULT_FPS = 42.0  # of the published sets, whose metadata says nothing
DEFAULT_NEAR, DEFAULT_FAR = 1.0, 8.0  # metres, likewise
TEMPLATE_FIELDS = {"cam_ix", "n_step", "img_type"}
MAX_STEPS, MAX_CAMS, MAX_SIZE = 1_000_000, 10_000, 16_384  # beyond them metadata is taken to be broken
ROTATION_TOLERANCE = 1e-3


class Scene:
    """One recorded scene.

    path, name: folder, and its last two parts.
    n_steps, n_cams, fps, near, far: see the metadata.    width, height: pixels, of all cameras.
    origin: float64 [3] metres, lower corner of the workspace.
    cameras: Cameras of n_cams rows, float32, image_cloud zeros.
    """

    def __init__(self, path: Path, metadata: dict, cache_dir: str | Path | None = None):
        where = path / "metadata.json"
        self.path = path
        self.name = "/".join(path.absolute().parts[-2:])
        self.n_steps = _count(metadata, "n_steps", MAX_STEPS, where)
        self.n_cams = _count(metadata, "n_cams", MAX_CAMS, where)
        self.fps = _positive(metadata, "fps", DEFAULT_FPS, where)
        self.near = _positive(metadata, "near", DEFAULT_NEAR, where)
        self.far = _positive(metadata, "far", DEFAULT_FAR, where)
        if self.far <= self.near:
            raise InputError(f"{where}: far must lie beyond near; got near {self.near} and far {self.far}")
        self._template = _template(metadata, where)
        viewmats, Ks, self.width, self.height = _cameras(metadata, self.n_cams, where)
        self.origin = _origin(metadata, where)
        if self.origin is None:
            self.origin = frusta_origin(viewmats, Ks, self.width, self.height, self.near, self.far)
        self.cameras = Cameras(
            viewmats=torch.from_numpy(viewmats).float(),
            Ks=torch.from_numpy(Ks).float(),
            near=torch.full((self.n_cams,), self.near),
            far=torch.full((self.n_cams,), self.far),
            image_cloud=torch.zeros(self.n_cams, dtype=torch.int64),
            width=self.width,
            height=self.height,
        )
        shape = (self.n_steps, self.n_cams, self.height, self.width)
        self._rgb = ImageCache((*shape, 3), lambda step, cam: self._file(cam, step, "rgb"), cache_dir, path, "rgb")
        self._seg = ImageCache(shape, lambda step, cam: self._file(cam, step, "seg"), cache_dir, path, "seg")

    @staticmethod
    def open(folder: str | Path, *, cache_dir: str | Path | None = None) -> Scene:
        """Reads metadata.json of ``folder``; images are decoded when they are asked for, each once.

        Args:
            cache_dir: folder for decoded images as memory-mapped files, for sets larger than the memory;
                default: they stay in memory.

        Raises: InputError that names the file and what is wrong with it.
        """
        path = Path(folder)
        file = path / "metadata.json"
        if not file.is_file():
            raise InputError(f"{path} is not a scene folder: it has no metadata.json")
        try:
            metadata = json.loads(file.read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"{file} cannot be read: {error}") from error
        if not isinstance(metadata, dict):
            raise InputError(f"{file} must hold a JSON object; got {type(metadata).__name__}")
        return Scene(path, metadata, cache_dir)

    def __repr__(self) -> str:
        return f"Scene({str(self.path)!r}: {self.n_steps} steps, {self.n_cams} cameras, {self.width}x{self.height})"

    def images(self, cams, steps) -> Tensor:
        """uint8 [len(steps), len(cams), 3, H, W], RGB. Args: lists of camera and step numbers."""
        images = self._rgb.get(*self._numbers(cams, steps))
        return torch.from_numpy(images).permute(0, 1, 4, 2, 3).contiguous()

    def segmentation(self, cams, steps) -> Tensor:
        """uint8 [len(steps), len(cams), H, W]: 0 background, 1 ground and fixed parts, 3 bodies that may move."""
        return torch.from_numpy(self._seg.get(*self._numbers(cams, steps)))

    def has_segmentation(self) -> bool:
        """Whether the scene comes with label images (looks for the first one only)."""
        return self._file(0, 0, "seg").is_file()

    def _numbers(self, cams, steps) -> tuple[list[int], list[int]]:
        cams, steps = [int(c) for c in cams], [int(s) for s in steps]
        for what, values, count in (("camera", cams, self.n_cams), ("step", steps, self.n_steps)):
            for value in values:
                if not 0 <= value < count:
                    raise InputError(f"{self.path}: {what} {value} does not exist; the scene has {count}")
        return steps, cams

    def _file(self, cam: int, step: int, img_type: str) -> Path:
        relative = self._template.format(cam_ix=cam, n_step=step, img_type=img_type) + ".png"
        file = self.path / relative
        if not file.resolve().is_relative_to(self.path.resolve()):
            raise InputError(f"{self.path / 'metadata.json'}: file_path_template leads out of the scene: {relative!r}")
        return file


def find_scenes(root: str | Path) -> list[Path]:
    """Scene folders at or below ``root`` (at most three levels down), in natural order of their paths.

    Hidden folders are skipped: a scene that is being written lies in one.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    found = []
    for depth in range(4):
        found += [file.parent for file in root.glob("*/" * depth + "metadata.json")]
    found = [path for path in found if not any(part.startswith(".") for part in path.relative_to(root).parts)]
    if not found:
        raise InputError(f"{root} holds no scene: no metadata.json in it or up to three folders below")
    return sorted(found, key=lambda path: _natural(path.relative_to(root).as_posix()))


def _natural(text: str) -> list:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text)]


def frusta_origin(viewmats, Ks, width: int, height: int, near: float, far: float) -> np.ndarray:
    """Lower corner, float64 [3], of the box around all camera frusta between ``near`` and ``far``."""
    viewmats, Ks = np.asarray(viewmats, dtype=np.float64), np.asarray(Ks, dtype=np.float64)
    corners = np.array([[x, y, 1.0] for x in (0, width) for y in (0, height)])
    rays = corners @ np.linalg.inv(Ks).swapaxes(1, 2)
    local = np.concatenate([rays * near, rays * far], 1)
    world = (local - viewmats[:, None, :3, 3]) @ viewmats[:, :3, :3]
    return world.reshape(-1, 3).min(0)


def _count(metadata: dict, key: str, limit: int, where: Path) -> int:
    value = metadata.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= limit:
        raise InputError(f"{where}: {key} must be a whole number from 1 to {limit}; got {value!r}")
    return value


def _positive(metadata: dict, key: str, default: float, where: Path) -> float:
    value = metadata.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise InputError(f"{where}: {key} must be a positive number; got {value!r}")
    return float(value)


def _template(metadata: dict, where: Path) -> str:
    template = metadata.get("file_path_template")
    if not isinstance(template, str):
        raise InputError(f"{where}: file_path_template must be text; got {template!r}")
    try:
        parts = [part for part in string.Formatter().parse(template) if part[1] is not None]
    except ValueError as error:
        raise InputError(f"{where}: file_path_template {template!r} is no format string: {error}") from error
    fields = {field for _, field, _, _ in parts}
    if fields != TEMPLATE_FIELDS:
        raise InputError(
            f"{where}: file_path_template must use the fields {', '.join(sorted(TEMPLATE_FIELDS))}, each as it is; "
            f"got {', '.join(sorted(fields)) or 'none'}"
        )
    # Only plain fields and zero-padded numbers: a format width of 10^9 would fill the memory.
    for _, field, spec, conversion in parts:
        if conversion or not re.fullmatch(r"" if field == "img_type" else r"(0?\d{1,2})?d?", spec):
            raise InputError(f"{where}: file_path_template may format numbers like n_step:04d only; got {template!r}")
    return template


def _array(value, shape: tuple[int, ...], what: str, where: Path) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {what} must be numbers of shape {list(shape)}; got {value!r}") from None
    if array.shape != shape:
        raise InputError(f"{where}: {what} must have shape {list(shape)}; got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise InputError(f"{where}: {what} holds values that are not finite")
    return array


def _origin(metadata: dict, where: Path) -> np.ndarray | None:
    return None if metadata.get("origin") is None else _array(metadata["origin"], (3,), "origin", where)


def _cameras(metadata: dict, n_cams: int, where: Path) -> tuple[np.ndarray, np.ndarray, int, int]:
    viewmats, Ks, sizes = [], [], []
    for cam in range(n_cams):
        entry = metadata.get(f"cam_{cam}")
        if not isinstance(entry, dict):
            raise InputError(f"{where}: cam_{cam} is missing, though n_cams is {n_cams}")
        viewmat = _array(entry.get("extrinsics"), (4, 4), f"cam_{cam}.extrinsics", where)
        K = _array(entry.get("intrinsics"), (3, 3), f"cam_{cam}.intrinsics", where)
        size = _array(entry.get("resolution"), (2,), f"cam_{cam}.resolution", where)
        rotation = viewmat[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError(f"{where}: cam_{cam}.extrinsics must be a rigid motion, world to camera")
        if np.abs(viewmat[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
            raise InputError(f"{where}: cam_{cam}.extrinsics must end in the row 0 0 0 1; got {viewmat[3].tolist()}")
        if not (K[0, 0] > 0 and K[1, 1] > 0 and np.abs(K[2] - [0, 0, 1]).max() <= ROTATION_TOLERANCE):
            raise InputError(f"{where}: cam_{cam}.intrinsics must hold focal lengths in pixels and end in 0 0 1")
        if (size != np.round(size)).any() or (size < 1).any() or (size > MAX_SIZE).any():
            raise InputError(f"{where}: cam_{cam}.resolution must be [width, height] in pixels; got {size.tolist()}")
        if sizes and (size != sizes[0]).any():
            raise InputError(f"{where}: cam_{cam} has resolution {size.tolist()}, but cam_0 {sizes[0].tolist()}")
        viewmats.append(viewmat)
        Ks.append(K)
        sizes.append(size)
    return np.stack(viewmats), np.stack(Ks), int(sizes[0][0]), int(sizes[0][1])
