"""Video files that browsers and phones play: H.264 in MP4 where PyAV is installed, VP9 in MP4 otherwise."""

import errno
import math
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.files import opencv_path, whole_file

H264, BT709 = "libx264", 1  # encoder; primaries, transfer and matrix as H.273 numbers them
QUALITY = "18"  # constant rate factor of x264: no loss that is seen
FINEST = 90_000  # ticks a second of MP4 at most


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Writes RGB frames as MP4; the file appears complete or not at all.

    H.264 with ``pip install 'gsim3d[video]'`` (PyAV), VP9 by OpenCV without.

    Args:
        path: ends in .mp4.
        frames: uint8 [H, W, 3] each, RGB, H and W even and the same for all; at least one.
        fps: frames a second, positive.
    Raises:
        InputError: wrong name, shape or rate, or OpenCV cannot write VP9 here.
    """
    path = Path(path)
    if path.suffix != ".mp4":
        raise InputError(f"{path}: a video file must end in .mp4")
    if not 0 < fps < math.inf:
        raise InputError(f"{path}: frames a second must be positive; got {fps}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot write a video here: the folder is missing")
    checked = _checked(path, frames)
    first = next(checked)
    try:
        import av
    except ImportError:
        av = None
    with whole_file(path) as part:
        if av is not None and H264 in av.codecs_available:
            _write_h264(av, part, first, checked, fps)
        else:
            _write_vp9(path, part, first, checked, fps)
        if not _is_whole(part):  # encoders report no full disk, which leaves a file without an index
            raise OSError(errno.EIO, "the video could not be written as a whole; is the disk full?")


def _checked(path: Path, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames, one at least, while all are images of one even size."""
    shape = None
    for frame in frames:
        fits = frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3
        if not fits or frame.shape != (shape or frame.shape) or frame.shape[0] % 2 or frame.shape[1] % 2:
            got = f"{frame.dtype} {list(frame.shape)}" + (f" after {list(shape)}" if shape else "")
            raise InputError(f"{path}: frames must be uint8 [H, W, 3] of one even size; got {got}")
        shape = frame.shape
        yield np.ascontiguousarray(frame)
    if shape is None:
        raise InputError(f"{path}: frames must be uint8 [H, W, 3], one at least; got none")


def _write_h264(av, part: Path, first: np.ndarray, rest: Iterable[np.ndarray], fps: float) -> None:
    rate = Fraction(fps).limit_denominator(FINEST)
    with av.open(opencv_path(part), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(H264, rate=rate, options={"crf": QUALITY, "bf": "0"})  # frames in their order
        stream.height, stream.width, stream.pix_fmt = *first.shape[:2], "yuv420p"
        stream.color_primaries = stream.color_trc = stream.colorspace = BT709
        for image in chain([first], rest):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))
        container.mux(stream.encode())


def _write_vp9(path: Path, part: Path, first: np.ndarray, rest: Iterable[np.ndarray], fps: float) -> None:
    import cv2

    log_level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        codec = cv2.VideoWriter.fourcc(*"vp09")
        writer = cv2.VideoWriter(opencv_path(part), codec, float(fps), first.shape[1::-1])
        if not writer.isOpened():
            raise InputError(f"{path}: this OpenCV cannot write VP9 here; pip install 'gsim3d[video]' writes H.264")
        for frame in chain([first], rest):
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
        writer.release()
    finally:
        cv2.utils.logging.setLogLevel(log_level)


def _is_whole(path: Path) -> bool:
    """Whether the boxes of an MP4 file fill it, and its index is one of them."""
    size, at, kinds = path.stat().st_size, 0, []
    with open(path, "rb") as file:
        while at + 8 <= size:
            file.seek(at)
            length, kind = int.from_bytes(file.read(4)), file.read(4)
            length = int.from_bytes(file.read(8)) if length == 1 else length
            at += max(8, length)
            kinds.append(kind)
    return at == size and b"moov" in kinds
