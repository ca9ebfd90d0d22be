"""Reading of video files: frame times from the container, integrity checks, and frames as RGB images."""

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from gsim3d.data.recording import MAX_STEPS, Problems
from gsim3d.errors import InputError
from gsim3d.io.files import opencv_path

RESOLUTION = 1.01e-3  # seconds; many containers round times to milliseconds
UNEVEN = 0.1  # largest deviation from even spacing, as a fraction of the frame interval
MAX_APART, MIN_EVEN = 2, 8  # isolated frames at the end that are dropped, if there are more than MIN_EVEN frames
TURNS = (0, 90, 180, 270)  # degrees of supported display rotations
MP4_KINDS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
EBML, SEGMENT = b"\x1aE\xdf\xa3", b"\x18S\x80g"


class Video:
    """A video file, opened only during reads and always decoded from its first frame.

    Attributes:
        numbers: frame numbers from 0; empty on error.
        times: float64 [N], seconds.
        rate: frames per second; None if frames are not evenly spaced.
        note: remark about dropped frames; "" if there are none.
        is_still: whether all frames show the same picture.
    """

    def __init__(self, file: Path, name: str, size: tuple[int, int], problems: Problems):
        self.what, self._file, self._size = f"video {file} (camera {name})", file, size
        self.numbers, self.times, self.rate, self.note, self.is_still = [], np.zeros(0), None, "", False
        try:
            stat = file.stat()
            times, header, self.is_still = _scan(file, size, (stat.st_mtime_ns, stat.st_size))
        except (InputError, OSError) as error:
            problems.add(f"{self.what} {error if isinstance(error, InputError) else error.strerror}")
            return
        cut, self.rate = _even_part(times, header)
        self.times = times[: len(times) - cut]
        self.numbers = list(range(len(self.times)))
        if cut:
            self.note = f"{self.what}: the last {cut} of {len(times)} frames are isolated and are dropped"
        if self.rate is None:
            gaps = (1000 * np.diff(times)).round(1)
            self.unevenness = (
                f"its {len(times)} frames are {gaps.min():g} to {gaps.max():g} ms apart, but its header gives "
                f"{header:.4g} fps"
            )

    def read(self, numbers: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
        """Yields the frames of ascending ``numbers`` (may repeat), uint8 RGB [h, w, 3]; None on error."""
        capture = open_video(self._file, self.what + " ")
        try:
            at, ended = -1, False
            for number in numbers:
                while at < number and not ended:
                    ended = not capture.grab()
                    at += 1
                done, frame = (False, None) if ended else capture.retrieve()
                if not done or frame.shape != (self._size[1], self._size[0], 3):
                    problems.add(f"{self.what} cannot be decoded at frame {number}; has the file changed?")
                    yield None
                    continue
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        finally:
            capture.release()


@lru_cache(maxsize=10_000)
def _scan(file: Path, size: tuple[int, int], stamp: tuple) -> tuple[np.ndarray, float, bool]:
    """Decodes a file once: returns the times of all decodable frames, float64 [N] seconds, the header's frame rate,
    which may be invalid, and ``is_still``. ``stamp`` is part of the key; errors do not name the file."""
    index = _index(file)
    capture = open_video(file)
    try:
        rate, count, turn = (
            capture.get(key) for key in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_ORIENTATION_META)
        )
        found = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if turn not in TURNS or index.mirrored:
            raise InputError("has a display matrix that is not a rotation by 0, 90, 180 or 270 degrees")
        if found != size:
            turned = f" (rotated by {turn:g} degrees by its display matrix)" if turn else ""
            raise InputError(f"has {found[0]}x{found[1]} pixels{turned}, its camera {size[0]}x{size[1]}")
        times, marks, pictures = [], [], []
        while capture.grab():
            if len(pictures) < 2 and len(times) & (len(times) - 1) <= 0:  # frames 0, 1, 2, 4, 8 ...
                picture = capture.retrieve()[1]
                pictures += [picture] if not pictures or not np.array_equal(picture, pictures[0]) else []
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
            marks.append(capture.get(cv2.CAP_PROP_PTS))
            if len(times) > MAX_STEPS:
                raise InputError(f"has more than {MAX_STEPS} frames")
    finally:
        capture.release()
    if not times:
        raise InputError("cannot be decoded: it is damaged, or this OpenCV lacks its codec")
    times = np.array(times)
    back = np.flatnonzero(np.diff(times) < 0)
    if len(times) > 1 and (len(back) or times[-1] <= times[0]):
        at = f"decrease after frame {back[0]}" if len(back) else "are all equal"
        raise InputError(f"has invalid time stamps: they {at}; convert it to a constant frame rate")
    times += _start(times, np.array(marks), rate)
    if len(times) < count and index.duration:
        gap = (times[-1] - times[0]) / max(len(times) - 1, 1)
        if times[-1] + 2.5 * gap < index.duration:
            raise InputError(
                f"cannot be decoded to its end: {times[-1] + gap:.4g} of {index.duration:.4g} s, {len(times)} of "
                f"{count:g} frames; it is damaged"
            )
    return times, rate, len(pictures) == 1 < len(times)


def open_video(file: Path, what: str = ""):
    """Returns the opened file; raises InputError if it is not a video."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # errors are reported here, with their file and camera
    capture = cv2.VideoCapture(opencv_path(file), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        capture.release()
        raise InputError(f"{what}cannot be opened: it is damaged, truncated or not a video")
    return capture


def _start(times: np.ndarray, marks: np.ndarray, rate: float) -> float:
    """Returns the time of the first frame in the container: ``times`` count from it, ``marks`` are rounded frames."""
    if not 0 < rate < 1e6:
        return 0.0
    low, high = ((marks - 0.5) / rate - times).max(), ((marks + 0.5) / rate - times).min()
    return float((low + high) / 2 if low <= high else marks[0] / rate)


def _even_part(times: np.ndarray, header: float) -> tuple[int, float | None]:
    """Returns the number of isolated frames at the end, left by cutting without re-encoding, and the others' rate."""
    for cut in range(MAX_APART + 1 if len(times) > MIN_EVEN else 1):
        rate = _even_rate(times[: len(times) - cut], header)
        if rate is not None:
            return cut, rate
    return 0, None


def _even_rate(times: np.ndarray, header: float) -> float | None:
    """Returns frames per second from the header or measured; None if frames are not evenly spaced."""
    header = header if 0 < header < 1e6 else None
    if len(times) == 1:
        return header or 1.0
    for rate in filter(None, (header, (len(times) - 1) / (times[-1] - times[0]))):
        off = np.abs(times - times[0] - np.arange(len(times)) / rate).max()
        if off <= max(RESOLUTION, UNEVEN / rate):
            return rate
    return None


@dataclass(frozen=True)
class _Index:
    """Container metadata that OpenCV does not report."""

    mirrored: bool = False  #: whether the display matrix of an MP4 mirrors the image
    duration: float | None = None  #: seconds of the video track after edit lists; None if unknown


def _index(file: Path) -> _Index:
    """Parses a container's metadata. Raises InputError if it declares more bytes than the file has."""
    size = file.stat().st_size
    with open(file, "rb") as opened:
        start = opened.read(12)
        try:
            if start[:4] == b"RIFF":
                end = 8 + int.from_bytes(start[4:8], "little")
            elif start[:4] == EBML:
                end = _segment_end(opened)
            elif start[4:8] in MP4_KINDS:
                end, index = _mp4(opened, size)
                if end <= size:
                    return index
            else:
                return _Index()
        except (struct.error, IndexError, OverflowError):
            return _Index()  # left to the decoder
    if end > size:
        raise InputError(f"cannot be decoded to its end: it has {size} of {end} bytes; it is truncated")
    return _Index()


def _segment_end(file: BinaryIO) -> int:
    """Returns the byte offset of the end of a Matroska or WebM segment; 0 if not stored, as in live streams."""

    def number() -> int:
        first = file.read(1)[0]
        length = 9 - first.bit_length()
        value = int.from_bytes(bytes([first & (0xFF >> length)]) + file.read(length - 1), "big")
        return 0 if value == (1 << 7 * length) - 1 else value

    file.seek(4)
    head = number()
    file.seek(head, os.SEEK_CUR)
    if file.read(4) != SEGMENT:
        return 0
    length = number()
    return file.tell() + length if length else 0


def _mp4(file: BinaryIO, size: int) -> tuple[int, _Index]:
    """Returns the byte offset of the end of the last MP4 or MOV box, and the index of the video track."""
    end, index = 0, _Index()
    for kind, start, stop in _boxes(file, 0, size):
        if kind in (b"mdat", b"moov", b"moof"):
            end = max(end, stop)
        if kind == b"moov" and stop <= size:
            boxes = list(_boxes(file, start, stop))
            clock = next((at for kind, at, _ in boxes if kind == b"mvhd"), None)
            clock = clock and _read(file, clock + (20 if _read(file, clock, 1) == b"\1" else 12), 4)
            scale = struct.unpack(">I", clock)[0] if clock else 0
            for kind, at, last in boxes:
                if kind == b"trak" and _is_video(file, at, last):
                    index = next((_track(file, a, scale) for k, a, _ in _boxes(file, at, last) if k == b"tkhd"), index)
    return end, index


def _boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yields kind, and start and end of the payload, of each box between two byte offsets."""
    while start + 8 <= end:
        file.seek(start)
        length, kind = struct.unpack(">I4s", file.read(8))
        body = start + 8
        if length == 1:
            length, body = int.from_bytes(file.read(8), "big"), start + 16
        stop = end if length == 0 else start + length
        if stop < body:
            return
        yield kind, body, stop
        start = stop


def _is_video(file: BinaryIO, start: int, end: int) -> bool:
    for kind, at, stop in _boxes(file, start, end):
        if kind == b"mdia":
            return any(k == b"hdlr" and _read(file, a + 8, 4) == b"vide" for k, a, _ in _boxes(file, at, stop))
    return False


def _track(file: BinaryIO, at: int, scale: int) -> _Index:
    wide = _read(file, at, 1) == b"\1"
    duration = int.from_bytes(_read(file, at + (28 if wide else 20), 8 if wide else 4), "big")
    a, b, _, c, d = struct.unpack(">5i", _read(file, at + (52 if wide else 40), 20))
    return _Index(a * d < b * c, duration / scale if scale and duration < 1 << 31 else None)


def _read(file: BinaryIO, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count)
