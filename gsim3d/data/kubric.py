"""Reader of Kubric output and the MOVi layout: one folder per camera, each with its own metadata.json.

Cameras have Blender's axes (x right, y up, z backwards); the number in a file name indexes the poses. Segmented pixels
are movable bodies, other opaque pixels are fixed, transparent ones are background. All keys: docs/reference/data.md.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data import recording
from gsim3d.data.cameras import OPENGL, check_intrinsics, inverse, rotations
from gsim3d.data.images import as_color, is_marked, is_opaque, read_files, read_image
from gsim3d.data.lenses import lens_of
from gsim3d.data.recording import BACKGROUND, FIXED, MOVING, Camera, Description, Problems, Recording, inside, read_json
from gsim3d.errors import InputError

NAME = "kubric"
FILE = "metadata.json"
DEFAULT_FPS = 12.0  # of the MOVi data sets
DEFAULT_NEAR, DEFAULT_FAR = 1.0, 20.0  # metres, of the published MOVi loader
CAMERA_FOLDER = re.compile(r"(cam|camera|view)[_-]?\d+")
QUATERNION_TOLERANCE = 1e-2


def recognises(folder: Path) -> bool:
    """Returns whether ``folder`` is a camera folder with metadata.json, or contains such folders."""
    return bool(_camera_folders(folder))


def read(folder: Path, problems: Problems) -> Recording:
    """Reads the scene in ``folder``. Raises InputError if its description cannot be parsed."""
    files = [_CameraFiles(folder, path, problems) for path in _camera_folders(folder)]
    first = files[0]
    source = folder if len(files) > 1 else first.source
    numbers = recording.common_numbers({camera.name: list(camera.images) for camera in files}, source, problems)
    if not numbers:
        raise InputError(f"{source}: the cameras have no frame in common (rgba/rgba_<number>.png or rgba_<number>.png)")
    has_labels = any(camera.segmentation for camera in files)

    def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        camera = files[cam]
        images = ((camera.images[numbers[step]], camera.frame(numbers[step])) for step in steps)
        return read_files(images, camera.size, as_color, problems)

    def read_labels(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        return (files[cam].labels(numbers[step], has_labels, problems) for step in steps)

    stride = numbers[1] - numbers[0] if len(numbers) > 1 else 1
    given = first.description.workspace(DEFAULT_NEAR, DEFAULT_FAR)
    fps = first.description.positive("fps") or first.frame_rate
    return Recording.of_cameras(
        [camera.camera(numbers) for camera in files],
        len(numbers),
        layout=NAME,
        source=first.source,
        fps=fps / stride,
        read_images=read_images,
        read_labels=read_labels,
        **given,
    )


def _camera_folders(folder: Path) -> list[Path]:
    if _describes_camera(folder / FILE):
        return [folder]
    if (folder / FILE).exists() or not folder.is_dir():
        return []
    folders = [path for path in folder.iterdir() if CAMERA_FOLDER.fullmatch(path.name) and (path / FILE).is_file()]
    return sorted(folders, key=lambda path: recording.natural_order(path.name))


def _describes_camera(file: Path) -> bool:
    try:
        return file.is_file() and "camera" in read_json(file)
    except InputError:
        return False


class _CameraFiles:
    """Folder of one camera. ``images`` and ``segmentation`` map frame numbers to files."""

    def __init__(self, scene: Path, folder: Path, problems: Problems):
        self.name = folder.name
        self.source = inside(scene, (folder / FILE).relative_to(scene).as_posix(), f"camera {folder.name}")
        self.description = Description(read_json(self.source), f"{self.source}: ", problems)
        entry, metadata = self.description.values.get("camera"), self.description.values.get("metadata", {})
        if not isinstance(entry, dict) or not isinstance(metadata, dict):
            raise InputError(f"{self.source}: camera and metadata must be JSON objects")
        self._entry = Description(entry, f"{self.source}: camera {self.name}: camera.", problems)
        size = {"resolution": [metadata.get("width"), metadata.get("height")]}
        metadata = Description(size | metadata, f"{self.source}: metadata.", problems)
        self.size = metadata.size("resolution")
        self.frame_rate = metadata.positive("frame_rate") or DEFAULT_FPS
        self.images = self._files(scene, folder, "rgba")
        self.segmentation = self._files(scene, folder, "segmentation")

    def frame(self, number: int) -> str:
        """Returns "camera, frame" for messages."""
        return f"camera {self.name}, frame {number}"

    def labels(self, number: int, has_segmentation: bool, problems: Problems) -> np.ndarray | None:
        """Reads labels uint8 [h, w] of a frame; without segmentation the whole foreground is MOVING."""
        image = read_image(self.images[number], self.size, self.frame(number), problems)
        if image is None:
            return None
        solid = is_opaque(image)
        if not has_segmentation:
            return np.where(solid, MOVING, BACKGROUND).astype(np.uint8)
        if number not in self.segmentation:
            problems.add(f"{self.source.parent}: segmentation of {self.frame(number)} is missing")
            return None
        marked = read_image(self.segmentation[number], self.size, self.frame(number), problems)
        if marked is None:
            return None
        return np.where(is_marked(marked), MOVING, np.where(solid, FIXED, BACKGROUND)).astype(np.uint8)

    def camera(self, numbers: Sequence[int]) -> Camera:
        """Returns the camera with the poses at frame ``numbers``."""
        values, what = self.description.values, f"{self.source}: camera {self.name}"
        lens = lens_of({**values, **values["camera"], "camera": None}, what, self.description.problems)
        return Camera(self.name, self.size, self._viewmats(numbers), self._K(), lens)

    def _viewmats(self, numbers: Sequence[int]) -> np.ndarray:
        poses = np.broadcast_to(np.eye(4), (len(numbers), 4, 4)).copy()
        positions, what = self._entry.values.get("positions"), f"{self.source}: camera {self.name}"
        count = len(positions) if isinstance(positions, list) else 0
        positions = self._entry.array("positions", (count, 3))
        quaternions = self._entry.array("quaternions", (count, 4))
        if positions is None or quaternions is None or not 0 < count <= recording.MAX_STEPS:
            return poses
        late = [number for number in numbers if number >= count]
        if late:
            self._entry.problems.add(f"{what}: frame {late[0]} has no pose: positions and quaternions hold {count}")
            return poses
        lengths = np.linalg.norm(quaternions[numbers], axis=1)
        wrong = np.abs(lengths - 1) > QUATERNION_TOLERANCE
        if wrong.any():
            bad = int(np.argmax(wrong))
            self._entry.problems.add(
                f"{what}, frame {numbers[bad]}: the quaternion must have length 1; got {lengths[bad]:.4g}"
            )
            return poses
        poses[:, :3, :3] = rotations(quaternions[numbers] / lengths[:, None])
        poses[:, :3, 3] = positions[numbers]
        return OPENGL @ inverse(poses)

    def _K(self) -> np.ndarray:
        """Returns the intrinsics [3, 3] in pixels."""
        entry, (width, height) = self._entry, self.size
        if entry.values.get("K") is not None:
            normalised = entry.array("K", (3, 3))
            K = np.eye(3) if normalised is None else normalised @ np.diag([1.0, -1.0, -1.0])
            K = np.diag([width, height, 1.0]) @ K
        else:
            focal, sensor = entry.positive("focal_length"), entry.positive("sensor_width")
            if focal is None or sensor is None:
                entry.problems.add(f"{entry.where}K is missing, and so are focal_length and sensor_width")
                return np.eye(3)
            pixels = focal / sensor * width
            K = np.array([[pixels, 0, width / 2], [0, pixels, height / 2], [0, 0, 1]])
        return K if check_intrinsics(K, self.size, f"{entry.where}K", entry.problems) else np.eye(3)

    @staticmethod
    def _files(scene: Path, folder: Path, kind: str) -> dict[int, Path]:
        found = {}
        for file in (folder / kind if (folder / kind).is_dir() else folder).glob(f"{kind}_*.png"):
            number = recording.trailing_number(file.stem)
            if number is not None:
                found[number] = inside(scene, file.relative_to(scene).as_posix(), f"camera {folder.name}")
        return found
