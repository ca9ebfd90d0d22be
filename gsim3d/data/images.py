"""Image files, checked before they are decoded, and decoded images, each read once: in memory or memory-mapped."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data.recording import BACKGROUND, MOVING, Problems
from gsim3d.errors import InputError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
PNG_START, JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
MAX_FILE = 1 << 30  # bytes of one image file


def read_image(file: Path, size: tuple[int, int], place: str, problems: Problems) -> np.ndarray | None:
    """The pixels of a PNG or JPEG file as it stores them, uint8 or uint16, [h, w] or [h, w, 3 or 4] (blue first).

    Args:
        size: (width, height) that it must have; the file's header is asked before pixels are decoded.
        place: camera and frame, for messages.
    Returns: None where there is a problem.
    """
    import cv2

    what = f"image {file} ({place})"
    try:
        if not file.is_file():
            problems.add(f"{what} is missing")
            return None
        if file.stat().st_size > MAX_FILE:
            problems.add(f"{what} is larger than {MAX_FILE >> 20} MiB")
            return None
        data = file.read_bytes()
    except OSError as error:
        problems.add(f"{what} cannot be read: {error.strerror}")
        return None
    found, whole = _header(data)
    if found is None:
        problems.add(f"{what} cannot be decoded: neither PNG nor JPEG, or cut off")
    elif found != size:
        problems.add(f"{what} has {found[0]}x{found[1]} pixels, its camera {size[0]}x{size[1]}")
    elif not whole:
        problems.add(f"{what} cannot be decoded: its end is missing")
    else:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if image is not None and image.shape[1::-1] == size:
            return image
        problems.add(f"{what} cannot be decoded")
    return None


def _header(data: bytes) -> tuple[tuple[int, int] | None, bool]:
    """((width, height), whether the file has its end) of PNG or JPEG bytes; (None, False) for anything else."""
    if data.startswith(PNG_START) and len(data) >= 33 and data[12:16] == b"IHDR":
        size = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
        return size, data.rfind(b"IEND") > 24
    if not data.startswith(JPEG_START):
        return None, False
    place, size = 2, None
    while place + 9 < len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # fill byte
            place += 1
            continue
        if marker == 0xDA:  # start of scan; inside a scan 0xFF 0xD9 can only be the end of the image
            return size, data.rfind(b"\xff\xd9") > place
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            size = int.from_bytes(data[place + 7 : place + 9], "big"), int.from_bytes(
                data[place + 5 : place + 7], "big"
            )
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return size, False


def as_color(image: np.ndarray, file: Path, place: str, problems: Problems) -> np.ndarray | None:
    """uint8 [h, w, 3], RGB; alpha is dropped, grey repeated."""
    import cv2

    if image.dtype != np.uint8:
        problems.add(f"image {file} ({place}) must have 8 bits a channel; got {image.dtype}")
        return None
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, 2)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB)


def as_labels(image: np.ndarray, file: Path, place: str, problems: Problems) -> np.ndarray | None:
    """uint8 [h, w], the one channel of a label image."""
    if image.dtype != np.uint8:
        problems.add(f"image {file} ({place}) must have 8 bits a channel; got {image.dtype}")
        return None
    if image.ndim == 3 and (image[..., :1] != image[..., :3]).any():
        problems.add(f"image {file} ({place}) must hold labels in one channel; got a colour image")
        return None
    return image if image.ndim == 2 else image[..., 0]


def as_mask(image: np.ndarray, file: Path, place: str, problems: Problems) -> np.ndarray:
    """uint8 [h, w]: MOVING where any channel but alpha is not zero, else BACKGROUND."""
    return np.where(is_marked(image), MOVING, BACKGROUND).astype(np.uint8)


def is_marked(image: np.ndarray) -> np.ndarray:
    """bool [h, w]: where any channel but alpha is not zero."""
    return image > 0 if image.ndim == 2 else (image[..., :3] > 0).any(-1)


class ImageCache:
    """Images of one kind of one scene, uint8 [H, W, 3] or [H, W], decoded once.

    Args:
        shape: [T, V, H, W, ...] of all of them; memory is taken for what was asked for only.
        read: (cam, steps) -> the images of one camera, in the order of ``steps``.
        cache_dir: where to keep all of them decoded, a .npy file of which single images are read; None: in memory.
            A file is open while it is read only, so a set may have any number of scenes.
        key: tells this scene, kind and state of its files from any other.
    """

    def __init__(self, shape, read, cache_dir: str | Path | None, key: tuple):
        self._shape, self._read = tuple(shape), read
        self._file = None
        if cache_dir is not None:
            name = hashlib.sha256(repr((*key, self._shape)).encode()).hexdigest()[:32]
            self._file = Path(cache_dir) / f"{name}.npy"
        self._start: int | None = None  # where the pixels of the file begin, once it was seen to be ours
        self._images: dict[tuple[int, int], np.ndarray] = {}
        self._lock = threading.Lock()  # samples of a training step are read side by side

    def get(self, steps: Sequence[int], cams: Sequence[int]) -> np.ndarray:
        """A copy of the images at ``steps`` x ``cams``."""
        images = np.empty((len(steps), len(cams), *self._shape[2:]), np.uint8)
        if self._file is not None:
            self._fetch(steps, cams, images)
            return images
        with self._lock:
            for cam in set(cams):
                missing = sorted({step for step in steps if (step, cam) not in self._images})
                for step, image in zip(missing, self._read(cam, missing), strict=True):
                    self._images[step, cam] = image
        for i, step in enumerate(steps):
            for j, cam in enumerate(cams):
                images[i, j] = self._images[step, cam]
        return images

    def _fetch(self, steps: Sequence[int], cams: Sequence[int], images: np.ndarray) -> None:
        """Reads from the file, which is made if it is missing; the kernel's page cache keeps what is read often."""
        with self._lock:
            if self._start is None:
                if not self._file.is_file():
                    self._write()
                self._start = self._checked_start()
        n_bytes = images[0, 0].nbytes if images.size else 0
        with open(self._file, "rb", buffering=0) as file:
            for i, step in enumerate(steps):
                for j, cam in enumerate(cams):
                    place = self._start + (step * self._shape[1] + cam) * n_bytes
                    if os.preadv(file.fileno(), [memoryview(images[i, j]).cast("B")], place) != n_bytes:
                        raise InputError(f"{self._file} has become shorter; remove it")

    def _checked_start(self) -> int:
        with open(self._file, "rb") as file:
            try:
                if np.lib.format.read_magic(file) != (1, 0):
                    raise ValueError("another version of the format")
                shape, by_column, dtype = np.lib.format.read_array_header_1_0(file)
            except ValueError as error:
                raise InputError(f"{self._file} is no cache of this scene ({error}); remove it") from error
            whole = self._file.stat().st_size == file.tell() + int(np.prod(self._shape, dtype=object))
            if shape != self._shape or by_column or dtype != np.uint8 or not whole:
                raise InputError(f"{self._file} is no cache of this scene; remove it")
            return file.tell()

    def _write(self) -> None:
        """Decodes everything into the file, which appears whole or not at all."""
        folder = self._file.parent
        folder.mkdir(parents=True, exist_ok=True)
        needed, free = int(np.prod(self._shape, dtype=object)), shutil.disk_usage(folder).free
        if needed > free:
            raise InputError(f"{folder}: the decoded images need {needed >> 20} MiB, {free >> 20} MiB are free")
        handle, unfinished = tempfile.mkstemp(dir=folder, prefix=".", suffix=".unfinished")
        os.close(handle)
        try:
            images = np.lib.format.open_memmap(unfinished, mode="w+", dtype=np.uint8, shape=self._shape)
            for cam in range(self._shape[1]):
                for step, image in enumerate(self._read(cam, range(self._shape[0]))):
                    images[step, cam] = image
            images.flush()
            del images
            os.replace(unfinished, self._file)
        except BaseException:
            os.unlink(unfinished)
            raise


def read_files(files: Iterator[tuple[Path, str]], size, convert, problems: Problems) -> Iterator[np.ndarray | None]:
    """``convert`` of the image in each of ``files`` (with its place for messages); None where there is a problem."""
    for file, place in files:
        image = read_image(file, size, place, problems)
        yield None if image is None else convert(image, file, place, problems)
