"""Kubric's output and the MOVi layout made of it: one folder for each camera, each with its own metadata.json.

SCENE/cam_<j>/metadata.json: ``camera`` with positions [P, 3] and quaternions [P, 4] (w, x, y, z) of a camera with
Blender's axes (x right, y up, z backwards), and K (normalised, Kubric's signs) or focal_length and sensor_width;
``metadata`` with resolution [W, H] or width and height, and frame_rate. Frames: rgba/rgba_<t>.png and
segmentation/segmentation_<t>.png, or without those folders, as Kubric itself writes them; the number in the file name
is the number of the pose. What segmentation marks may move; the rest is fixed, and background where alpha is 0.
A folder with such a metadata.json and frames of its own is a scene of one camera.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data.cameras import OPENGL, by_step, check_intrinsics, inverse, rotations
from gsim3d.data.images import as_color, is_marked, is_opaque, read_files, read_image
from gsim3d.data.recording import (
    BACKGROUND,
    FIXED,
    MAX_STEPS,
    MOVING,
    Problems,
    Recording,
    array,
    common_numbers,
    image_size,
    inside,
    natural_order,
    positive,
    read_json,
    trailing_number,
    workspace,
)
from gsim3d.errors import InputError

NAME = "kubric"
FILE = "metadata.json"
DEFAULT_FPS = 12.0  # of the MOVi sets
DEFAULT_NEAR, DEFAULT_FAR = 1.0, 20.0  # metres, as the published loader has them for MOVi
CAMERA_FOLDER = re.compile(r"(cam|camera|view)[_-]?\d+")
QUATERNION_TOLERANCE = 1e-2


def recognises(folder: Path) -> bool:
    """Camera folders with metadata.json, or a metadata.json that describes one camera."""
    return bool(_camera_folders(folder))


def read(folder: Path, problems: Problems) -> Recording:
    """The scene in ``folder``. Raises InputError where its description cannot be read at all."""
    cameras = [_Camera(folder, path, problems) for path in _camera_folders(folder)]
    source = folder if len(cameras) > 1 else cameras[0].source
    numbers = common_numbers({camera.name: list(camera.images) for camera in cameras}, source, problems)
    if not numbers:
        raise InputError(f"{source}: the cameras have no frame in common (rgba/rgba_<number>.png or rgba_<number>.png)")
    has_labels = any(camera.segmentation for camera in cameras)

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        camera = cameras[cam]
        files = ((camera.images[numbers[step]], camera.place(numbers[step])) for step in steps)
        return read_files(files, camera.size, as_color, problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return (cameras[cam].labels(numbers[step], has_labels, problems) for step in steps)

    stride = numbers[1] - numbers[0] if len(numbers) > 1 else 1
    given = workspace(cameras[0].description, cameras[0].source, problems)
    fps = positive(cameras[0].description.get("fps"), f"{cameras[0].source}: fps", problems)
    return Recording(
        layout=NAME,
        source=cameras[0].source,
        n_steps=len(numbers),
        fps=(fps or cameras[0].frame_rate) / stride,
        camera_names=tuple(camera.name for camera in cameras),
        viewmats=by_step([camera.viewmats(numbers, problems) for camera in cameras], len(numbers)),
        Ks=np.stack([camera.K for camera in cameras])[None],
        sizes=tuple(camera.size for camera in cameras),
        read_images=read_images,
        read_labels=read_labels,
        **{**given, "near": given["near"] or DEFAULT_NEAR, "far": given["far"] or DEFAULT_FAR},
    )


def _camera_folders(folder: Path) -> list[Path]:
    if _describes_camera(folder / FILE):
        return [folder]
    if (folder / FILE).exists() or not folder.is_dir():
        return []
    folders = [path for path in folder.iterdir() if CAMERA_FOLDER.fullmatch(path.name) and (path / FILE).is_file()]
    return sorted(folders, key=lambda path: natural_order(path.name))


def _describes_camera(file: Path) -> bool:
    try:
        return file.is_file() and "camera" in read_json(file)
    except InputError:
        return False


class _Camera:
    """One camera's folder.

    images, segmentation: frame number -> file.    K [3, 3]: pixels.
    """

    def __init__(self, scene: Path, folder: Path, problems: Problems):
        self.name = folder.name
        self.source = inside(scene, (folder / FILE).relative_to(scene).as_posix(), f"camera {folder.name}")
        self.description = read_json(self.source)
        entry, metadata = self.description.get("camera"), self.description.get("metadata", {})
        if not isinstance(entry, dict) or not isinstance(metadata, dict):
            raise InputError(f"{self.source}: camera and metadata must be JSON objects")
        self._entry = entry
        resolution = metadata.get("resolution", [metadata.get("width"), metadata.get("height")])
        self.size = image_size(resolution, f"{self.source}: metadata.resolution", problems)
        rate = positive(metadata.get("frame_rate"), f"{self.source}: metadata.frame_rate", problems)
        self.frame_rate = rate or DEFAULT_FPS
        self.K = self._intrinsics(problems)
        self.images = self._frames(scene, folder, "rgba")
        self.segmentation = self._frames(scene, folder, "segmentation")

    def place(self, number: int) -> str:
        return f"camera {self.name}, frame {number}"

    def labels(self, number: int, has_segmentation: bool, problems: Problems) -> np.ndarray | None:
        """uint8 [h, w] of frame ``number``; without any segmentation all that is no background may move."""
        image = read_image(self.images[number], self.size, self.place(number), problems)
        if image is None:
            return None
        solid = is_opaque(image)
        if not has_segmentation:
            return np.where(solid, MOVING, BACKGROUND).astype(np.uint8)
        if number not in self.segmentation:
            problems.add(f"{self.source.parent}: segmentation of {self.place(number)} is missing")
            return None
        marked = read_image(self.segmentation[number], self.size, self.place(number), problems)
        if marked is None:
            return None
        return np.where(is_marked(marked), MOVING, np.where(solid, FIXED, BACKGROUND)).astype(np.uint8)

    def viewmats(self, numbers: Sequence[int], problems: Problems) -> np.ndarray:
        """[S, 4, 4], world-to-camera, OpenCV axes, of the poses ``numbers``."""
        matrices = np.broadcast_to(np.eye(4), (len(numbers), 4, 4)).copy()
        what = f"{self.source}: camera {self.name}"
        positions = self._entry.get("positions")
        count = len(positions) if isinstance(positions, list) else 0
        positions = array(positions, [(count, 3)], f"{what}: camera.positions", problems)
        quaternions = array(self._entry.get("quaternions"), [(count, 4)], f"{what}: camera.quaternions", problems)
        if positions is None or quaternions is None or not 0 < count <= MAX_STEPS:
            return matrices
        late = [number for number in numbers if number >= count]
        if late:
            problems.add(f"{what}: frame {late[0]} has no pose: positions and quaternions hold {count}")
            return matrices
        lengths = np.linalg.norm(quaternions[numbers], axis=1)
        wrong = np.abs(lengths - 1) > QUATERNION_TOLERANCE
        if wrong.any():
            bad = int(np.argmax(wrong))
            problems.add(f"{what}, frame {numbers[bad]}: the quaternion must have length 1; got {lengths[bad]:.4g}")
            return matrices
        matrices[:, :3, :3] = rotations(quaternions[numbers] / lengths[:, None])
        matrices[:, :3, 3] = positions[numbers]
        return OPENGL @ inverse(matrices)

    def _intrinsics(self, problems: Problems) -> np.ndarray:
        what = f"{self.source}: camera {self.name}: camera.K"
        width, height = self.size
        if self._entry.get("K") is not None:
            normalised = array(self._entry["K"], [(3, 3)], what, problems)
            K = np.eye(3) if normalised is None else normalised @ np.diag([1.0, -1.0, -1.0])
            K = np.diag([width, height, 1.0]) @ K
        else:
            focal = positive(self._entry.get("focal_length"), f"{self.source}: camera.focal_length", problems)
            sensor = positive(self._entry.get("sensor_width"), f"{self.source}: camera.sensor_width", problems)
            if focal is None or sensor is None:
                problems.add(f"{what} is missing, and so are focal_length and sensor_width")
                return np.eye(3)
            pixels = focal / sensor * width
            K = np.array([[pixels, 0, width / 2], [0, pixels, height / 2], [0, 0, 1]])
        return K if check_intrinsics(K, self.size, what, problems) else np.eye(3)

    @staticmethod
    def _frames(scene: Path, folder: Path, kind: str) -> dict[int, Path]:
        where = folder / kind if (folder / kind).is_dir() else folder
        found = {}
        for file in where.glob(f"{kind}_*.png"):
            number = trailing_number(file.stem)
            if number is not None:
                found[number] = inside(scene, file.relative_to(scene).as_posix(), f"camera {folder.name}")
        return found
