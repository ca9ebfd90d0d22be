"""Decoded images, each PNG read once: in memory, or in memory-mapped files."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError


def read_png(file: Path, height: int, width: int, channels: int) -> np.ndarray:
    """uint8 [H, W, 3] (RGB) or [H, W] (labels). Raises InputError when absent, broken or of another size or kind."""
    import cv2

    if not file.is_file():
        raise InputError(f"image {file} is missing")
    image = cv2.imdecode(np.frombuffer(file.read_bytes() or b"\0", dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"image {file} cannot be decoded")
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(f"image {file} has {found} pixels, its camera {width}x{height}")
    if image.dtype != np.uint8:
        raise InputError(f"image {file} must have 8 bits a channel; got {image.dtype}")
    if channels == 1:
        if image.ndim == 3 and (image[..., :1] != image[..., :3]).any():
            raise InputError(f"image {file} must hold labels in one channel; got a colour image")
        return image if image.ndim == 2 else image[..., 0]
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, 2)
    return image[..., 2::-1]


class ImageCache:
    """Images of one kind of one scene, uint8 [T, V, H, W, 3] or [T, V, H, W], filled as they are asked for.

    Args:
        shape: of the whole array; memory is taken only for what is filled.
        file_of: (step, cam) -> PNG file.
        cache_dir: where to keep the whole decoded array as a memory-mapped .npy file; None: in memory.
        scene, kind: they name that file, together with the state of the scene's metadata.json.
    """

    def __init__(self, shape, file_of: Callable[[int, int], Path], cache_dir, scene: Path, kind: str):
        self._shape, self._file_of = tuple(shape), file_of
        self._cache_dir = None if cache_dir is None else Path(cache_dir)
        self._scene, self._kind = scene, kind
        self._array = None
        self._filled = None

    def get(self, steps: list[int], cams: list[int]) -> np.ndarray:
        """A copy of the images at ``steps`` x ``cams``."""
        if self._array is None:
            self._open()
        if self._filled is not None:
            for step in steps:
                for cam in cams:
                    if not self._filled[step, cam]:
                        self._array[step, cam] = self._read(step, cam)
                        self._filled[step, cam] = True
        return self._array[np.ix_(steps, cams)]

    def _read(self, step: int, cam: int) -> np.ndarray:
        channels = 3 if len(self._shape) == 5 else 1
        return read_png(self._file_of(step, cam), *self._shape[2:4], channels)

    def _open(self) -> None:
        if self._cache_dir is None:
            self._array = np.empty(self._shape, dtype=np.uint8)
            self._filled = np.zeros(self._shape[:2], dtype=bool)
            return
        file = self._cache_dir / f"{self._key()}.npy"
        if not file.is_file():
            self._write(file)
        self._array = np.load(file, mmap_mode="r")
        if self._array.shape != self._shape or self._array.dtype != np.uint8:
            raise InputError(f"{file} is no cache of {self._scene}; remove it")

    def _key(self) -> str:
        metadata = self._scene / "metadata.json"
        stamp = (str(self._scene.resolve()), self._kind, metadata.stat().st_mtime_ns, self._shape)
        return hashlib.sha256(repr(stamp).encode()).hexdigest()[:32]

    def _write(self, file: Path) -> None:
        """Decodes everything into ``file``, which appears whole or not at all."""
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, unfinished = tempfile.mkstemp(dir=file.parent, prefix=".", suffix=".unfinished")
        os.close(handle)
        try:
            array = np.lib.format.open_memmap(unfinished, mode="w+", dtype=np.uint8, shape=self._shape)
            for step, cam in np.ndindex(*self._shape[:2]):
                array[step, cam] = self._read(step, cam)
            array.flush()
            del array
            os.replace(unfinished, file)
        except BaseException:
            os.unlink(unfinished)
            raise
