"""Background subtraction: masks of moving bodies in videos of static cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gsim3d.data.recording import evenly_spaced

BACKGROUND_STEPS = 51  # evenly spaced steps from which the background is computed
CANDIDATES = 17  # steps whose colours may be the background's
SAME_COLOR = 9  # largest difference of a channel between equal colours, of 255
ROWS = 32  # of the images that are compared at a time
MIN_STEPS = 8  # fewest steps from which a background is estimated
NOISE_FACTOR = 6.0  # foreground threshold, in multiples of the median difference ...
MIN_DIFFERENCE = 18.0  # ... and its minimum, of 255
BLUR = 1.2  # pixels, sigma of the Gaussian that suppresses noise and JPEG blocks
CLOSE_SHARE = 0.012  # radius of the morphological closing, as a fraction of the image height
MIN_AREA = 0.001  # fraction of the image; smaller components are removed
OUTLINE = 2  # pixels on either side of the border of a component
OUTLINE_FACTOR = 1.5  # by which the background's gradient exceeds the image's along the outline of a ghost
MAX_HOLE = 0.005  # fraction of the image; smaller holes are filled


def background_image(read: Callable[[Sequence[int]], np.ndarray], n_steps: int) -> np.ndarray:
    """Estimates the background, uint8 [h, w, 3], of a static camera from at most BACKGROUND_STEPS steps.

    It is the most frequent colour of each pixel: a body that moves before it changes its shading. A body that rests
    longest at its place is part of it, and leaves a ghost where it was: there the background has the outline of a
    body and the image has none. Such pixels become the median of the images that show the ghost.

    Args:
        read: function steps -> uint8 [S, h, w, 3].
        n_steps: number of steps recorded.
    """
    frames = read(evenly_spaced(n_steps, BACKGROUND_STEPS))
    blocks = np.split(frames, range(ROWS, frames.shape[1], ROWS), axis=1)
    background = np.concatenate([_most_frequent(rows) for rows in blocks])
    uncovered = np.stack([_ghosts(frame, background) for frame in frames])
    for y, x in np.argwhere(uncovered.any(0)):
        seen = frames[uncovered[:, y, x], y, x]
        background[y, x] = np.partition(seen, len(seen) // 2, axis=0)[len(seen) // 2]
    return background


def _most_frequent(frames: np.ndarray) -> np.ndarray:
    """Returns the mean [h, w, 3] of the largest set of values of a pixel around one of them, uint8 [S, h, w, 3]."""
    best = np.zeros(frames.shape[1:3], np.int32)
    result = frames[0].copy()
    for frame in frames[:: -(-len(frames) // CANDIDATES)]:
        near = (np.maximum(frames, frame) - np.minimum(frames, frame)).max(-1) <= SAME_COLOR
        count = near.sum(0)
        mean = (frames * near[..., None].astype(np.uint16)).sum(0) / count[..., None]
        result = np.where((count > best)[..., None], np.rint(mean).astype(np.uint8), result)
        best = np.maximum(best, count)
    return result


def _ghosts(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Returns bool [h, w]: components of the foreground whose outline is in ``background``, not in ``image``."""
    import cv2

    mask = foreground(image, background).astype(np.uint8)
    edges = []
    for picture in (image, background):
        grey = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), BLUR).astype(np.float32)
        edges.append(np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)))
    n_parts, parts = cv2.connectedComponents(mask, connectivity=8)
    wide = np.ones((2 * OUTLINE + 1,) * 2, np.uint8)
    outline = np.where(cv2.dilate(mask, wide) > cv2.erode(mask, wide), 1, 0).astype(np.uint8)
    nearest = cv2.dilate(parts.astype(np.float32), wide).astype(int)
    ghosts = np.zeros(n_parts, bool)
    for part in range(1, n_parts):
        on = (nearest == part) & (outline > 0)
        ghosts[part] = on.any() and edges[1][on].mean() > OUTLINE_FACTOR * edges[0][on].mean()
    return ghosts[parts]


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
