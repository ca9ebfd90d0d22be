"""Background subtraction: masks of moving bodies in videos of static cameras."""

from collections.abc import Callable, Sequence

import cv2
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
FREQUENT = 3  # colours of a pixel that may be its background
MIN_SHARE = 0.05  # of the steps, of a frequent colour
INPAINT_RADIUS = 5  # pixels
FREQUENCY_BONUS = 120  # difference of colours, of 255, that outweighs being in all steps rather than in none
MAX_HOLE = 0.005  # fraction of the image; smaller holes are filled


def background_image(read: Callable[[Sequence[int]], np.ndarray], n_steps: int) -> np.ndarray:
    """Estimates the background, uint8 [h, w, 3], of a static camera from at most BACKGROUND_STEPS steps.

    It is the most frequent colour of each pixel, because a body that moves changes its shading. Where a body rests it
    may be the most frequent colour, and leave a ghost where it was: of several frequent colours, the background has the
    one most like the surroundings, weighed against its frequency.

    Args:
        read: function steps -> uint8 [S, h, w, 3].
        n_steps: number of steps recorded.
    """
    frames = read(evenly_spaced(n_steps, BACKGROUND_STEPS))
    n, shape = len(frames), frames.shape[1:3]
    blocks = [_frequent(rows.reshape(n, -1, 3)) for rows in np.split(frames, range(ROWS, shape[0], ROWS), axis=1)]
    colors, shares = (np.concatenate(parts, 1).reshape(FREQUENT, *shape, -1) for parts in zip(*blocks, strict=True))
    uncertain = cv2.dilate((shares[1, ..., 0] > 0).astype(np.uint8), np.ones((5, 5), np.uint8))
    expected = cv2.inpaint(colors[0], uncertain, INPAINT_RADIUS, cv2.INPAINT_TELEA)
    unlike = np.abs(colors.astype(np.int16) - expected).max(-1, keepdims=True) - FREQUENCY_BONUS * shares
    unlike[shares == 0] = np.inf
    return np.take_along_axis(colors, unlike.argmin(0)[None], 0)[0]


def _frequent(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the most frequent colours of pixels [S, n, 3], uint8 [FREQUENT, n, 3], and their shares [FREQUENT, n].

    A colour is the mean of the largest set of values around one of them. Later shares below MIN_SHARE are 0.
    """
    colors, shares = np.zeros((FREQUENT, *frames.shape[1:]), np.uint8), np.zeros((FREQUENT, frames.shape[1]))
    at, left = np.arange(frames.shape[1]), np.ones(frames.shape[:2], bool)  # pixels, and values without a colour
    for number in range(FREQUENT):
        best, members = np.zeros(len(at), np.int32), np.zeros_like(left)
        for frame in frames[:: -(-len(frames) // CANDIDATES)]:
            near = left & (_difference(frames, frame) <= SAME_COLOR)
            count = near.sum(0)
            members = np.where(count > best, near, members)
            best = np.maximum(best, count)
        mean = (frames * members[..., None].astype(np.uint16)).sum(0) / np.maximum(best, 1)[:, None]
        color, share = np.rint(mean).astype(np.uint8), best / len(frames)
        found = (share >= MIN_SHARE) | (number == 0)
        colors[number, at[found]], shares[number, at[found]] = color[found], share[found]
        left &= _difference(frames, color) > 2 * SAME_COLOR  # values just outside of the set are the same colour
        rest = left.mean(0) >= MIN_SHARE
        at, left, frames = at[rest], left[:, rest], frames[:, rest]
    return colors, shares


def _difference(frames: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Returns the largest difference [S, n] of a channel."""
    apart = np.maximum(frames, color) - np.minimum(frames, color)
    return np.maximum(np.maximum(apart[..., 0], apart[..., 1]), apart[..., 2])  # faster than a maximum of 3 elements


def foreground(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Returns bool [h, w]: pixels that differ from ``background`` by more than noise, cleaned by morphology."""
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
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least * mask.size
    large[0] = False
    return large[parts]
