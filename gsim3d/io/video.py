"""Video files that browsers play: VP9 in MP4."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.files import opencv_path, whole_file


def write_video(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Writes RGB frames as VP9 in MP4; the file appears complete or not at all.

    Args:
        path: ends in .mp4.
        frames: uint8 [H, W, 3] each, RGB, H and W even and the same for all; at least one.
        fps: frames a second, positive.
    Raises:
        InputError: wrong name, shape or rate, or OpenCV cannot write VP9 here.
    """
    import cv2

    path = Path(path)
    if path.suffix != ".mp4":
        raise InputError(f"{path}: a video file must end in .mp4")
    if not fps > 0:
        raise InputError(f"{path}: frames a second must be positive; got {fps}")
    shapes = {(frame.dtype.name, frame.shape) for frame in frames}
    kind, shape = next(iter(shapes), ("nothing", ()))
    if len(shapes) != 1 or kind != "uint8" or len(shape) != 3 or shape[2] != 3 or shape[0] % 2 or shape[1] % 2:
        raise InputError(f"{path}: frames must be uint8 [H, W, 3] of one even size; got {sorted(map(str, shapes))[:3]}")
    log_level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with whole_file(path) as part:
            codec = cv2.VideoWriter.fourcc(*"vp09")
            writer = cv2.VideoWriter(opencv_path(part), codec, float(fps), (shape[1], shape[0]))
            if not writer.isOpened():
                raise InputError(f"{path}: this OpenCV cannot write VP9 here (folder missing or codec not built in)")
            for frame in frames:
                writer.write(np.ascontiguousarray(frame[..., ::-1]))
            writer.release()  # reports no full disk, which leaves a file without an index
            if not _is_whole(part):
                raise OSError(errno.EIO, "the video could not be written as a whole; is the disk full?")
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
