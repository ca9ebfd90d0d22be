"""Background subtraction: masks of moving bodies in videos of static cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gsim3d.data.recording import evenly_spaced

MEDIAN_STEPS = 51  # evenly spaced steps from which the median is computed
MIN_STEPS = 8  # fewest steps from which a background is estimated
NOISE_FACTOR = 6.0  # foreground threshold, in multiples of the median difference ...
MIN_DIFFERENCE = 18.0  # ... and its minimum, of 255
BLUR = 1.2  # pixels, sigma of the Gaussian that suppresses noise and JPEG blocks
CLOSE_SHARE = 0.012  # radius of the morphological closing, as a fraction of the image height
MIN_AREA = 0.001  # fraction of the image; smaller components are removed
MAX_HOLE = 0.005  # fraction of the image; smaller holes are filled


def median_image(read: Callable[[Sequence[int]], np.ndarray], n_steps: int) -> np.ndarray:
    """Estimates the background, uint8 [h, w, 3], of a static camera as its median over at most MEDIAN_STEPS steps.

    Args:
        read: function steps -> uint8 [S, h, w, 3].
        n_steps: number of steps recorded.
    """
    steps = evenly_spaced(n_steps, MEDIAN_STEPS)
    frames = read(steps)
    middle = len(steps) // 2
    return np.partition(frames, middle, axis=0)[middle]


def foreground(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Returns bool [h, w]: pixels that differ from ``background`` by more than noise, cleaned by morphology."""
    import cv2

    smooth = [cv2.GaussianBlur(picture, (0, 0), BLUR).astype(np.float32) for picture in (image, background)]
    difference = np.abs(smooth[0] - smooth[1]).max(-1)
    # Most of the image is background, so the median difference is a robust estimate of the noise.
    mask = (difference > max(MIN_DIFFERENCE, NOISE_FACTOR * float(np.median(difference)))).astype(np.uint8)
    radius = max(1, round(CLOSE_SHARE * image.shape[0]))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc)
    mask = (~_large(1 - mask, MAX_HOLE)).astype(np.uint8)
    return _large(mask, MIN_AREA)


def _large(mask: np.ndarray, least: float) -> np.ndarray:
    """Returns bool [h, w]: the connected components of ``mask`` with at least the fraction ``least`` of the image."""
    import cv2

    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least * mask.size
    large[0] = False
    return large[parts]
