"""Validated reading of image files, conversion to colours, labels and masks, and a cache of decoded images."""

import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from gsim3d.data.headers import Header, read_header
from gsim3d.data.recording import BACKGROUND, MOVING, Problems
from gsim3d.errors import InputError

LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
IMAGE_SUFFIXES = (".png", ".tif", ".tiff", *LOSSY_SUFFIXES)
MAX_FILE = 1 << 29  # bytes
HEADER = 1 << 16  # bytes; enough for most image headers
MAX_ID = 16  # masks with only smaller values are taken to hold body ids
MAX_DARK = 4095  # images of 16 bits without larger values are taken to have 8, 10 or 12 bits
MAX_SOFT = 0.2  # largest fraction of mask pixels with values near half of the range
MAX_LABELS, MAX_SMALL = 256, 8  # masks with more distinct values are not label images, also of bodies of few pixels


def read_image(file: Path, size: tuple[int, int], frame: str, problems: Problems) -> np.ndarray | None:
    """Decodes a PNG, JPEG, WebP or TIFF file after validating its header.

    Args:
        file: path.
        size: expected (width, height).
        frame: camera and frame, for messages.
        problems: receives the errors found.

    Returns:
        uint8 or uint16, [h, w] or [h, w, 3 or 4] (BGR or BGRA); None on error.
    """
    what = f"image {file} ({frame})"
    data = _bytes_of(file, what, problems)
    if data is None:
        return None
    header = read_header(data)
    if header is None:
        problems.add(f"{what} cannot be decoded: no PNG, JPEG, WebP or TIFF, or cut off")
    elif header.size != size:
        problems.add(f"{what} has {header.size[0]}x{header.size[1]} pixels, its camera {size[0]}x{size[1]}")
    elif not header.whole:
        problems.add(f"{what} cannot be decoded: it is truncated")
    elif header.refused:
        problems.add(f"{what} {header.refused}; save it as a single plain image")
    else:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.shape[1::-1] != size:
            problems.add(f"{what} cannot be decoded")
        elif image.dtype not in (np.uint8, np.uint16):
            problems.add(f"{what} must have 8 or 16 bits per channel; got {image.dtype}")
        elif header.alpha and not _has_alpha(image):
            problems.add(f"{what} has a kind of transparency that is not supported; save it as RGBA")
        else:
            return image
    return None


def _bytes_of(file: Path, what: str, problems: Problems, most: int = -1) -> bytes | None:
    try:
        if not file.is_file():
            problems.add(f"{what} is missing")
        elif file.stat().st_size > MAX_FILE:
            problems.add(f"{what} is larger than {MAX_FILE >> 20} MiB")
        else:
            with open(file, "rb") as opened:
                return opened.read(most)
    except OSError as error:
        problems.add(f"{what} cannot be read: {error.strerror}")
    return None


def header_of(file: Path, frame: str, problems: Problems) -> Header | None:
    """Reads only the header of an image file; returns None on error."""
    what = f"image {file} ({frame})"
    data = _bytes_of(file, what, problems, HEADER)
    header = None if data is None else read_header(data)
    if header is None and data is not None and len(data) == HEADER:  # longer than usual
        data = _bytes_of(file, what, problems)
        header = None if data is None else read_header(data)
    if data is not None and header is None:
        problems.add(f"{what} cannot be decoded: no PNG, JPEG, WebP or TIFF, or cut off")
    return header


def as_color(image: np.ndarray, file: Path, frame: str, problems: Problems) -> np.ndarray | None:
    """Converts to uint8 RGB [h, w, 3]: grey is replicated, 16 bits are rounded to 8, alpha is composited on black."""
    if image.dtype == np.uint16 and 0 < image.max() <= MAX_DARK:
        problems.add(
            f"image {file} ({frame}) has 16 bits a channel, but no value above {image.max()}; scale its values to 16 "
            "bits, or save it with 8"
        )
        return None
    image = _over_black(image)
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return np.repeat(image[..., None], 3, 2) if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])


def as_labels(image: np.ndarray, file: Path, frame: str, problems: Problems) -> np.ndarray | None:
    """Converts a label image to uint8 [h, w]."""
    if image.ndim == 3 and (image[..., :1] != image[..., :3]).any():
        problems.add(f"image {file} ({frame}) must be a single-channel label image; got a colour image")
        return None
    labels = np.where(is_opaque(image), image if image.ndim == 2 else image[..., 0], BACKGROUND)
    if file.suffix.lower() in LOSSY_SUFFIXES or labels.max() > 255:
        problems.add(f"image {file} ({frame}) must hold labels from 0 to 255, in a lossless format (PNG or TIFF)")
        return None
    return labels.astype(np.uint8)


def as_mask(image: np.ndarray, file: Path | None, frame: str, problems: Problems) -> np.ndarray | None:
    """Converts a mask to labels uint8 [h, w]: MOVING where it is set, else BACKGROUND.

    Binary masks, including those with compression noise or soft borders, are thresholded at half of their range; label
    images are set where they are not 0. Colours are reduced to their maximum; of one colour, alpha is the mask.
    """
    is_cut_out = _has_alpha(image) and np.ptp(image[..., 3]) > 0 and (image[..., :3] == image[0, 0, :3]).all()
    grey = image[..., 3] if is_cut_out else _over_black(image)
    grey = np.ascontiguousarray(grey if grey.ndim == 2 else grey.max(-1))
    lossy = file is not None and file.suffix.lower() in LOSSY_SUFFIXES
    marked = _marked(grey, lossy)
    if marked is None:
        problems.add(
            f"image {file} ({frame}) is not a mask: it is neither binary (up to noise and soft borders) nor a label "
            "image; save it with the values 0 and 255"
        )
        return None
    return np.where(marked, MOVING, BACKGROUND).astype(np.uint8)


def as_opaque(image: np.ndarray, file: Path, frame: str, problems: Problems) -> np.ndarray:
    """Converts alpha to labels uint8 [h, w]: MOVING where an image is opaque, else BACKGROUND."""
    return np.where(is_opaque(image), MOVING, BACKGROUND).astype(np.uint8)


def is_opaque(image: np.ndarray) -> np.ndarray:
    """Returns bool [h, w]: whether alpha is above half of its range; True everywhere without alpha."""
    if not _has_alpha(image):
        return np.ones(image.shape[:2], bool)
    return image[..., 3] > np.iinfo(image.dtype).max // 2


def is_marked(image: np.ndarray) -> np.ndarray:
    """Returns bool [h, w]: whether any channel except alpha is nonzero."""
    return image > 0 if image.ndim == 2 else (image[..., :3] > 0).any(-1)


def _has_alpha(image: np.ndarray) -> bool:
    return image.ndim == 3 and image.shape[2] == 4


def _over_black(image: np.ndarray) -> np.ndarray:
    """Removes alpha by compositing on black."""
    if not _has_alpha(image):
        return image
    alpha, full = image[..., 3:].astype(np.uint32), np.iinfo(image.dtype).max
    return ((image[..., :3] * alpha + full // 2) // full).astype(image.dtype)


def _marked(grey: np.ndarray, lossy: bool) -> np.ndarray | None:
    """Returns bool [h, w]: where a mask is set; None if it is neither binary nor a label image."""
    levels = np.flatnonzero(np.bincount(grey.ravel()))
    low, high = int(levels[0]), int(levels[-1])
    full = np.iinfo(grey.dtype).max
    if high == 0 or (not lossy and (high < MAX_ID or _are_labels(grey, levels))):
        return grey > 0
    if len(levels) == 1 or lossy:  # lossy compression keeps 0 and 255, but adds values between
        low, high = 0, full
    upper, step = high - (high - low) // 4, (high - low) // 16
    soft = (grey > low + (high - low) // 4) & (grey < upper)
    block = np.ones((5, 5), np.uint8)  # wider than soft borders of JPEG chroma at half resolution
    wide = cv2.erode(soft.astype(np.uint8), block, borderType=cv2.BORDER_REPLICATE)
    least, most = cv2.erode(grey, block), cv2.dilate(grey, block)
    flat = (least > low + step) & (most - least <= step) & (most < upper)  # compression noise is not
    if soft.mean() > MAX_SOFT or wide.any() or flat.any() or (lossy and not (grey > upper).any()):
        return None
    return grey > (low + high) // 2


def _are_labels(grey: np.ndarray, levels: np.ndarray) -> bool:
    """Returns whether most intermediate values form flat regions, unlike noise and soft borders."""
    inner = levels[1:-1]
    if not 0 < len(inner) <= MAX_LABELS:
        return False
    flat = cv2.erode(grey, np.ones((3, 3), np.uint8)) == cv2.dilate(grey, np.ones((3, 3), np.uint8))
    are_flat = 2 * np.isin(inner, grey[flat]).sum() >= len(inner)
    if are_flat or len(inner) > MAX_SMALL:
        return are_flat
    small, wide = np.ones((2, 2), np.uint8), np.ones((7, 7), np.uint8)  # a body of few pixels, apart from others
    alone = (cv2.erode(grey, small) == cv2.dilate(grey, small)) & (cv2.dilate(grey, wide) < levels[-1])
    return bool(alone[grey > levels[0]].any())


class ImageCache:
    """Cache of the decoded images or labels of one scene, uint8 [H, W, 3] or [H, W], in memory or in a .npy file.

    Args:
        shape: [T, V, H, W, ...]; in memory, only images that were read are stored.
        read: function (cam, steps) -> the images of one camera, in the order of ``steps``.
        cache_dir: folder for the .npy file, which holds all images; None caches in memory. The file is open only
            during a read, so that a data set may have any number of scenes.
        key: identifies the scene, the kind of image and the version of the source files.
    """

    def __init__(self, shape, read, cache_dir: str | Path | None, key: tuple):
        self._shape, self._read = tuple(shape), read
        self._file = None
        if cache_dir is not None:
            name = hashlib.sha256(repr((*key, self._shape)).encode()).hexdigest()[:32]
            self._file = Path(cache_dir) / f"{name}.npy"
        self._start: int | None = None  # byte offset of the pixels in the file, known once the file was validated
        self._images: dict[tuple[int, int], np.ndarray] = {}
        self._lock = threading.Lock()  # samples of a training step are read by concurrent threads

    def get(self, steps: Sequence[int], cams: Sequence[int]) -> np.ndarray:
        """Returns a copy of the images at ``steps`` x ``cams``, [len(steps), len(cams), ...]."""
        images = np.empty((len(steps), len(cams), *self._shape[2:]), np.uint8)
        if self._file is not None:
            self._fetch(steps, cams, images)
            return images
        with self._lock:
            for cam in set(cams):
                missing = sorted({step for step in steps if (step, cam) not in self._images})
                for step, image in zip(missing, self._read(cam, missing), strict=True):
                    self._images[step, cam] = image
        for i, j in np.ndindex(images.shape[:2]):
            images[i, j] = self._images[steps[i], cams[j]]
        return images

    def _fetch(self, steps: Sequence[int], cams: Sequence[int], images: np.ndarray) -> None:
        """Reads from the file, which is written first if missing; the page cache serves repeated reads."""
        with self._lock:
            if self._start is None:
                if not self._file.is_file():
                    self._write()
                self._start = self._checked_start()
        n_bytes = images[0, 0].nbytes if images.size else 0
        with open(self._file, "rb", buffering=0) as file:
            for i, j in np.ndindex(images.shape[:2]):
                begin = self._start + (steps[i] * self._shape[1] + cams[j]) * n_bytes
                if os.preadv(file.fileno(), [memoryview(images[i, j]).cast("B")], begin) != n_bytes:
                    raise InputError(f"{self._file} has become shorter; remove it")

    def _checked_start(self) -> int:
        with open(self._file, "rb") as file:
            try:
                if np.lib.format.read_magic(file) != (1, 0):
                    raise ValueError("another version of the format")
                shape, by_column, dtype = np.lib.format.read_array_header_1_0(file)
            except ValueError as error:
                raise InputError(f"{self._file} is not a cache of this scene ({error}); remove it") from error
            whole = self._file.stat().st_size == file.tell() + int(np.prod(self._shape, dtype=object))
            if shape != self._shape or by_column or dtype != np.uint8 or not whole:
                raise InputError(f"{self._file} is not a cache of this scene; remove it")
            return file.tell()

    def _write(self) -> None:
        """Decodes all images into the file, which is moved into place once complete."""
        folder = self._file.parent
        folder.mkdir(parents=True, exist_ok=True)
        needed, free = int(np.prod(self._shape, dtype=object)), shutil.disk_usage(folder).free
        if needed > free:
            raise InputError(f"{folder}: the decoded images need {needed >> 20} MiB, {free >> 20} MiB are free")
        with tempfile.TemporaryDirectory(dir=folder, prefix=".") as unfinished:
            file = Path(unfinished) / self._file.name
            images = np.lib.format.open_memmap(file, mode="w+", dtype=np.uint8, shape=self._shape)
            for cam in range(self._shape[1]):
                for step, image in enumerate(self._read(cam, range(self._shape[0]))):
                    images[step, cam] = image
            images.flush()
            os.replace(file, self._file)


def read_files(files: Iterator[tuple[Path, str]], size, convert, problems: Problems) -> Iterator[np.ndarray | None]:
    """Reads image files, pairs of path and "camera, frame" for messages, of the expected ``size``; yields them
    converted by :func:`as_color`, :func:`as_labels`, :func:`as_mask` or :func:`as_opaque`, None on error."""
    for file, frame in files:
        image = read_image(file, size, frame, problems)
        yield None if image is None else convert(image, file, frame, problems)
