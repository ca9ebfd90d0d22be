"""The films of a capture: takes, frames, and the times of several films relative to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsim3d.data.recording import Problems, natural_order
from gsim3d.data.video_file import Video
from gsim3d.data.videos import VIDEO_SUFFIXES
from gsim3d.errors import InputError
from gsim3d.io.files import opencv_path
from gsim3d.io.terminal import progress

BOARD = "board"  # folder with films of the board
MOTION_WIDTH = 160  # pixels, of the images in which motion is measured
MAX_LAG = 10.0  # seconds; films that start further apart cannot be aligned
MIN_OVERLAP = 0.5  # of the shorter film, at any tested lag
MIN_AGREEMENT = 0.5  # correlation of the motion in two films
MIN_VARIATION = 0.1  # of the motion, over its mean; films that show less are not aligned
MIN_FRAMES = 16
REPEATED = 0.1  # of the median motion; frames that change less repeat the one before
GRID = 4  # samples of the motion a frame


@dataclass(frozen=True)
class Film:
    """One film of a take."""

    name: str  #: camera, the name of the file without its ending
    size: tuple[int, int]  #: (width, height) in pixels
    video: Video  #: its frames and their times

    @classmethod
    def open(cls, file: Path) -> Film:
        """Opens a film; raises InputError if it cannot be decoded."""
        capture = cv2.VideoCapture(opencv_path(file), cv2.CAP_FFMPEG)
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        capture.release()
        return cls(file.stem, size, Video(file, file.stem, size, Problems()))

    def grey(self, numbers: Sequence[int]):
        """Yields the frames of ascending ``numbers``, uint8 [h, w]."""
        for image in progress(self.video.read(numbers, Problems()), self.name, len(numbers), unit="frame"):
            yield cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

    def nearest(self, times: np.ndarray) -> list[int]:
        """Returns the frame number nearest to each of ``times``, seconds of this film."""
        own = self.video.times
        return np.searchsorted((own[1:] + own[:-1]) / 2, times).tolist()


def takes_of(folder: Path) -> dict[Path, list[Path]]:
    """Returns the films of each take: those in ``folder``, or else those of each of its subfolders.

    Raises:
        InputError: there is no take of two films or more, or the takes have different cameras.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    below = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != "." and path.name != BOARD]
    takes = {take: films_in(take) for take in (folder, *below)}
    takes = {folder: takes[folder]} if takes[folder] else {take: films for take, films in takes.items() if films}
    for take, films in takes.items():
        names, first = [film.stem for film in films], [film.stem for film in next(iter(takes.values()))]
        if len(set(names)) < max(2, len(names)) or names != first:
            raise InputError(
                f"{take}: has films of {', '.join(names)}; every take needs one film of the same two cameras or more "
                f"({', '.join(first)})"
            )
    if not takes:
        raise InputError(f"{folder}: no films (<camera>{'|'.join(VIDEO_SUFFIXES)}) in it or in its subfolders")
    return takes


def films_in(folder: Path) -> list[Path]:
    """Returns the film files in ``folder``, in natural order."""
    files = filter(Path.is_file, folder.iterdir()) if folder.is_dir() else ()
    films = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES and file.name[0] != "."]
    return sorted(films, key=lambda file: natural_order(file.name))


def motion(film: Film) -> np.ndarray:
    """Returns [N - 1], the root mean squared difference between consecutive frames.

    Where a frame was dropped and the one before is shown again, the motion of the next one is spread over both.
    """
    width, height = film.size
    small = MOTION_WIDTH, max(1, round(height * MOTION_WIDTH / width))
    before, found = None, []
    for image in film.grey(film.video.numbers):
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float32)
        if before is not None:
            found.append(float(np.sqrt(np.square(image - before).mean())))
        before = image
    begin, limit = 0, REPEATED * np.median(found or [0])
    for end, change in enumerate(found):
        if change >= limit:
            found[begin : end + 1] = [change / (end + 1 - begin)] * (end + 1 - begin)
            begin = end + 1
    return np.array(found)


def time_offsets(times: Sequence[np.ndarray], motions: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Aligns films by the motion that they show.

    The lag of two films is the peak of the normalised cross-correlation of the relative change of their motion, which
    depends less on the view than motion itself; the offsets are the least squares solution of all pairs, weighted by
    correlation.

    Args:
        times: seconds of the frames of each of V films.
        motions: :func:`motion` of each film.

    Returns:
        Offsets [V] in seconds to add to the times of each film, that of the first is 0; and the best correlation [V]
        of each film with another. Films that correlate by less than MIN_AGREEMENT with all others have offset 0.
    """
    n = len(times)
    step = min(float(np.median(np.diff(own))) for own in times) / GRID
    signals = []
    for own, values in zip(times, motions, strict=True):
        middle = (own[1:] + own[:-1]) / 2
        grid = np.arange(middle[0], middle[-1], step)
        signals.append((middle[0], np.gradient(_smooth(np.interp(grid, middle, np.log1p(values)), GRID))))
    varied = [len(own) >= MIN_FRAMES and own.std() > MIN_VARIATION * own.mean() for own in motions]
    rows, lags, weights, best = [], [], [], np.zeros(n)
    for a in range(n):
        for b in range(a + 1, n):
            shift, agreement = (
                _lag(signals[a][1], signals[b][1], round(MAX_LAG / step)) if varied[a] & varied[b] else (0, 0)
            )
            best[[a, b]] = np.maximum(best[[a, b]], agreement)
            if agreement >= MIN_AGREEMENT:
                rows.append((np.arange(n) == b) * 1.0 - (np.arange(n) == a))
                lags.append(shift * step + signals[a][0] - signals[b][0])
                weights.append(agreement)
    if not rows:
        return np.zeros(n), best
    weights, rows = np.array(weights), np.stack(rows)
    offsets = np.linalg.lstsq(rows * weights[:, None], np.array(lags) * weights, rcond=None)[0]
    offsets[best < MIN_AGREEMENT] = 0
    return offsets - offsets[0] * (best >= MIN_AGREEMENT), best


def _smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    reach = round(4 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), "valid")


def _lag(a: np.ndarray, b: np.ndarray, most: int) -> tuple[float, float]:
    """Returns by how many samples ``b`` must be delayed to match ``a``, and their correlation there."""
    least = max(3, int(MIN_OVERLAP * min(len(a), len(b))))
    lags = [lag for lag in range(-most, most + 1) if min(len(a), len(b) + lag) - max(0, lag) >= least]
    found = []
    for lag in lags:
        low, high = max(0, lag), min(len(a), len(b) + lag)
        x, y = a[low:high] - a[low:high].mean(), b[low - lag : high - lag] - b[low - lag : high - lag].mean()
        found.append((x * y).sum() / max(1e-12, np.sqrt((x * x).sum() * (y * y).sum())))
    if not found:
        return 0.0, 0.0
    top = int(np.argmax(found))
    fine = 0.0
    if 0 < top < len(found) - 1:
        left, middle, right = found[top - 1 : top + 2]
        fine = 0.5 * (left - right) / min(-1e-12, left - 2 * middle + right)
    return lags[top] + fine, float(found[top])
