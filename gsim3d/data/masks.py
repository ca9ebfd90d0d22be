"""Labels of real videos: moving bodies cut out of a background that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

MEDIAN_STEPS = 51  # evenly spread; more change the median little
MIN_STEPS = 8  # fewer show no background
NOISE_FACTOR = 6.0  # a pixel is foreground where it differs by so many times the camera's noise ...
MIN_DIFFERENCE = 18.0  # ... and by at least so much of 255
BLUR = 1.2  # pixels; noise of single pixels and blocks of JPEG are smoothed before they are compared
CLOSE_SHARE = 0.012  # of the image's height: gaps so wide are closed
MIN_AREA = 0.001  # of the image; smaller spots are noise ...
MAX_HOLE = 0.005  # ... and smaller holes are body that looks like what is behind it


def median_image(read: Callable[[Sequence[int]], np.ndarray], n_steps: int) -> np.ndarray:
    """uint8 [h, w, 3], the background of a camera that stands still: its median over at most MEDIAN_STEPS steps.

    Args:
        read: steps -> uint8 [S, h, w, 3].
        n_steps: of the camera.
    """
    steps = np.unique(np.linspace(0, n_steps - 1, min(n_steps, MEDIAN_STEPS)).round().astype(int)).tolist()
    frames = read(steps)
    middle = len(steps) // 2
    return np.partition(frames, middle, axis=0)[middle]


def foreground(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """bool [h, w], pixels that differ from ``background`` by more than noise; gaps closed, spots removed."""
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
    """bool [h, w], the connected parts of ``mask`` that cover at least ``least`` of the image."""
    import cv2

    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least * mask.size
    large[0] = False
    return large[parts]
