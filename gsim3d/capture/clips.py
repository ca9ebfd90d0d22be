"""The videos of a capture: takes, frames, and the times of several videos relative to each other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from gsim3d.data.recording import Problems, natural_order
from gsim3d.data.video_file import Video, open_video
from gsim3d.data.videos import VIDEO_SUFFIXES
from gsim3d.errors import InputError
from gsim3d.io.terminal import progress

BOARD = "board"  # folder with videos of the board
MOTION_WIDTH = 160  # pixels, of the images in which motion is measured
MAX_LAG = 10.0  # seconds; videos that start further apart cannot be aligned
MIN_OVERLAP = 0.5  # of the shorter video, at any tested lag
MIN_AGREEMENT = 0.5  # correlation of the motion in two videos
CHANCE = 1.0  # standard deviations; less agreement without offsets counts as this
MARGIN = 2.5  # standard deviations a video; synchronous ones at most 60 degrees apart reach 2.3, late ones from 2.9
MIN_VARIATION = 0.1  # of the motion, over its mean; videos that show less are not aligned
MIN_FRAMES = 16
REPEATED = 0.1  # of the median motion; frames that change less repeat the one before
GRID = 4  # samples of the motion a frame
APART = 3 * GRID  # samples between independent ones


@dataclass(frozen=True)
class Clip:
    """One video of a take."""

    name: str  #: camera, the name of the file without its ending
    size: tuple[int, int]  #: (width, height) in pixels
    video: Video  #: its frames and their times

    @classmethod
    def open(cls, file: Path) -> Clip:
        """Opens a video; raises InputError if it cannot be decoded, or is a single picture."""
        capture = open_video(file, f"{file} ")
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        capture.release()
        video = Video(file, file.stem, size, Problems())
        if len(video.times) < 2:
            raise InputError(f"{video.what} has one frame")
        return cls(file.stem, size, video)

    def grey(self, numbers: Sequence[int]):
        """Yields the frames of ascending ``numbers``, uint8 [h, w]."""
        for image in progress(self.video.read(numbers, Problems()), self.name, len(numbers), unit="frame"):
            yield cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

    @cached_property
    def motion(self) -> np.ndarray:
        """Returns [N - 1], the root mean squared difference between consecutive frames.

        Where a frame was dropped and the one before is shown again, the motion of the next one is spread over both.
        """
        width, height = self.size
        small = MOTION_WIDTH, max(1, round(height * MOTION_WIDTH / width))
        images = (cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in self.grey(self.video.numbers))
        pairs = itertools.pairwise(image.astype(np.float32) for image in images)
        found = [float(np.sqrt(np.square(image - before).mean())) for before, image in pairs]
        begin, limit = 0, REPEATED * np.median(found)
        for end, change in enumerate(found):
            if change >= limit:
                found[begin : end + 1] = [change / (end + 1 - begin)] * (end + 1 - begin)
                begin = end + 1
        return np.array(found)


def takes_of(folder: Path) -> dict[Path, list[Path]]:
    """Returns the videos of each take: those in ``folder``, or else those of each of its subfolders.

    Raises:
        InputError: there is no take of two videos or more, or the takes have different cameras.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    below = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != "." and path.name != BOARD]
    own = clips_in(folder)
    takes = {folder: own} if own else {take: clips for take in below if (clips := clips_in(take))}
    for take, clips in takes.items():
        names, first = [clip.stem for clip in clips], [clip.stem for clip in next(iter(takes.values()))]
        if len(names) < 2 or names != first:
            raise InputError(
                f"{take}: has videos of {', '.join(names)}; every take needs one video of the same two cameras or more "
                f"({', '.join(first)})"
            )
    if not takes:
        raise InputError(f"{folder}: no videos (<camera>{'|'.join(VIDEO_SUFFIXES)}) in it or in its subfolders")
    return takes


def clips_in(folder: Path) -> list[Path]:
    """Returns the video files in ``folder``, in natural order. Raises InputError if two are of one camera."""
    files = filter(Path.is_file, folder.iterdir()) if folder.is_dir() else ()
    clips = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES and file.name[0] != "."]
    clips.sort(key=lambda file: natural_order(file.name))
    for clip, other in itertools.combinations(clips, 2):
        if clip.stem == other.stem:
            raise InputError(f"{folder}: two videos of camera {clip.stem}: {clip.name} and {other.name}; remove one")
    return clips


def time_offsets(times: Sequence[np.ndarray], motions: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Aligns videos by the motion that they show.

    The lag of two videos is the peak of the normalised cross-correlation of the relative change of their motion, which
    depends less on the view than motion itself, by its significance (Fisher's z): a few frames that happen to agree
    count less than many. Offsets follow from the pairs whose peaks are most significant. All are 0 unless they make the
    videos agree clearly better: views of one motion differ, so that synchronous videos have peaks elsewhere, too.

    Args:
        times: seconds of the frames of each of V videos.
        motions: :attr:`Clip.motion` of each video.

    Returns:
        Offsets [V] in seconds to add to the times of each video, that of the first is 0; and the best correlation [V]
        of each video with another at these offsets. Those that correlate by less than MIN_AGREEMENT with all others
        have offset 0.
    """
    n = len(times)
    step = min(float(np.median(np.diff(own))) for own in times) / GRID
    signals = []
    for own, values in zip(times, motions, strict=True):
        middle = (own[1:] + own[:-1]) / 2
        grid = np.arange(middle[0], middle[-1], step)
        signals.append((middle[0], np.gradient(_smooth(np.interp(grid, middle, np.log1p(values)), GRID))))
    varied = [k for k, own in enumerate(motions) if len(own) >= MIN_FRAMES and own.std() > MIN_VARIATION * own.mean()]
    pairs = {(a, b): _correlations(signals[a], signals[b], step) for a, b in itertools.combinations(varied, 2)}
    peaks = {pair: _peak(*own) for pair, own in pairs.items()}
    known: dict[int, float] = {}
    while joins := [p for p in pairs if peaks[p][1] >= MIN_AGREEMENT and len(known.keys() & p) == bool(known)]:
        a, b = max(joins, key=lambda pair: peaks[pair][2])
        known |= {a: known[b] - peaks[a, b][0]} if b in known else {b: known.setdefault(a, 0.0) + peaks[a, b][0]}
    offsets = np.array([known[k] - known.get(0, 0) if k in known else 0.0 for k in range(n)])
    lags = {(a, b): [0.0, offsets[b] - offsets[a]] for a, b in pairs}
    matches = {pair: [np.interp(lags[pair], own[0], row) for row in own[1:]] for pair, own in pairs.items()}
    late = sum(z[1] - max(z[0], CHANCE) for _, z in matches.values()) > MARGIN * max(0, len(known) - 1)
    agreement = [max((r[int(late)] for pair, (r, _) in matches.items() if k in pair), default=0.0) for k in range(n)]
    return np.where(late, offsets, 0.0), np.array(agreement)


def _smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    reach = round(4 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), "valid")


def _correlations(first: tuple, second: tuple, step: float) -> np.ndarray:
    """Returns [3, K]: lags in seconds of ``second`` (begin, samples of duration ``step``) relative to ``first``, their
    correlations and significances."""
    (start, a), (other, b), most, found = first, second, round(MAX_LAG / step), []
    least = max(3, int(MIN_OVERLAP * min(len(a), len(b))))
    for lag in range(-most, most + 1):
        low, high = max(0, lag), min(len(a), len(b) + lag)
        if high - low >= least:
            x, y = a[low:high] - a[low:high].mean(), b[low - lag : high - lag] - b[low - lag : high - lag].mean()
            r = float((x * y).sum() / max(1e-12, np.sqrt((x * x).sum() * (y * y).sum())))
            z = np.arctanh(min(r, 0.9999)) * np.sqrt(max(1, (high - low) / APART - 3))
            found.append((lag * step + start - other, r, z))
    return np.array(found).T


def _peak(lags: np.ndarray, r: np.ndarray, z: np.ndarray) -> tuple[float, float, float]:
    """Returns the lag of largest significance, between samples, and its correlation and significance."""
    top, fine = int(z.argmax()), 0.0
    if 0 < top < len(z) - 1:
        left, right = r[top - 1], r[top + 1]
        fine = float(np.clip(0.5 * (left - right) / min(-1e-12, left - 2 * r[top] + right), -1, 1))
    return lags[top] + fine * (lags[1] - lags[0]), r[top], z[top]
