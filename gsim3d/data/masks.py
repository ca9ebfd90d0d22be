"""From films of real cameras to what the model reads: lenses undistorted, moving bodies cut out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

MEDIAN_STEPS = 51  # of the film, evenly spread; more change the median little
MIN_STEPS = 8  # fewer show no background
NOISE_FACTOR = 6.0  # a pixel is foreground where it differs by so many times the camera's noise ...
MIN_DIFFERENCE = 18.0  # ... and by at least so much of 255
BLUR = 1.2  # pixels; noise of single pixels and blocks of JPEG are smoothed before they are compared
CLOSE_SHARE = 0.012  # of the image's height: gaps so wide are closed
MIN_AREA = 0.001  # of the image; smaller spots are noise ...
MAX_HOLE = 0.005  # ... and smaller holes are body that looks like what is behind it


class Undistorter:
    """Images of one camera as a pinhole of the same intrinsics would see them.

    Args:
        coefficients: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]].    size: (width, height).
    """

    def __init__(self, coefficients: np.ndarray, size: tuple[int, int]):
        self._coefficients, self._size = coefficients, size
        self._key, self._maps = None, None

    def __call__(self, image: np.ndarray, K: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        import cv2

        x, y = self._sources(K)
        return cv2.remap(image, x, y, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR, borderValue=0)

    def valid(self, K: np.ndarray) -> np.ndarray:
        """bool [h, w]: pixels that come from inside the distorted image."""
        x, y = self._sources(K)
        return (x >= 0) & (x <= self._size[0] - 1) & (y >= 0) & (y <= self._size[1] - 1)

    def _sources(self, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel lies in the distorted image, x and y, float32 [h, w]; kept for the next image."""
        import cv2

        if self._key is None or not np.array_equal(self._key, K):
            centred = K.copy()
            centred[:2, 2] -= 0.5  # OpenCV's pixel centres are whole numbers
            self._maps = cv2.initUndistortRectifyMap(
                centred, self._coefficients, None, centred, self._size, cv2.CV_32FC1
            )
            self._key = K.copy()
        return self._maps


def median_image(film: Callable[[Sequence[int]], np.ndarray], n_steps: int) -> np.ndarray:
    """uint8 [h, w, 3]: the median over at most MEDIAN_STEPS steps of a camera that stands still: its background."""
    steps = np.unique(np.linspace(0, n_steps - 1, min(n_steps, MEDIAN_STEPS)).round().astype(int)).tolist()
    frames = film(steps)
    middle = len(steps) // 2
    return np.partition(frames, middle, axis=0)[middle]


def foreground(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """bool [h, w]: where ``image`` differs from ``background`` by more than noise, gaps closed, spots removed."""
    import cv2

    smooth = [cv2.GaussianBlur(picture, (0, 0), BLUR).astype(np.float32) for picture in (image, background)]
    difference = np.abs(smooth[0] - smooth[1]).max(-1)
    # Most of the image is background: the median of the differences is a robust measure of its noise.
    mask = (difference > max(MIN_DIFFERENCE, NOISE_FACTOR * float(np.median(difference)))).astype(np.uint8)
    radius = max(1, round(CLOSE_SHARE * image.shape[0]))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc)
    mask = (~_large(1 - mask, MAX_HOLE)).astype(np.uint8)
    return _large(mask, MIN_AREA)


def _large(mask: np.ndarray, least: float) -> np.ndarray:
    """bool [h, w]: the connected parts of ``mask`` that cover at least ``least`` of the image."""
    import cv2

    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least * mask.size
    large[0] = False
    return large[parts]
