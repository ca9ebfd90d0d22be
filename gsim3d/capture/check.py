"""Whether a capture can be learned from: angles between its cameras, and the fit of their calibration."""

import cv2
import numpy as np

from gsim3d.capture.calibrate import MAX_ERROR
from gsim3d.data import Scene
from gsim3d.data.cameras import focus, positions_and_axes, project

MAX_ANGLE = 45.0  # degrees from a camera to its nearest neighbour, seen from what they look at
MIN_MATCHES = 16  # of two images, to judge their calibration by
MIN_LIMIT = 1.5  # pixels, smallest limit of the reprojection error
RATIO = 0.75  # between the distances of the best and the second-best feature


def angles(viewmats: np.ndarray) -> np.ndarray:
    """Returns the angles [V, V] in degrees between cameras [V, 4, 4], seen from the point that they look at."""
    centres, axes = positions_and_axes(viewmats)
    point = focus(viewmats)
    rays = -axes if point is None else centres - point
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.degrees(np.arccos((rays @ rays.T).clip(-1, 1)))


def overlap_problem(names: tuple[str, ...], found: np.ndarray) -> str | None:
    """Returns why the views do not overlap, with the angles between all cameras; None if they do."""
    nearest = np.where(np.eye(len(found), dtype=bool), np.inf, found).min(1)
    if (nearest <= MAX_ANGLE).all():
        return None
    pairs = ", ".join(
        f"{names[a]}-{names[b]} {found[a, b]:.0f}" for a in range(len(names)) for b in range(a + 1, len(names))
    )
    far = ", ".join(f"{names[cam]} ({nearest[cam]:.0f})" for cam in np.flatnonzero(nearest > MAX_ANGLE))
    return (
        f"the views do not overlap: every camera needs another within {MAX_ANGLE:.0f} degrees, seen from the scene; "
        f"further from their nearest are {far}. Angles in degrees: {pairs}. Move cameras closer together, or add some"
    )


def match_errors(scene: Scene, found: np.ndarray) -> dict[str, tuple[float, int]]:
    """Measures the calibration by features that neighbouring cameras share.

    Features that are each other's best match, and agree with some fundamental matrix, are triangulated with the given
    cameras.

    Args:
        scene: its first step is used.
        found: result of :func:`angles`.

    Returns:
        "camera-camera" -> median reprojection error in pixels and number of matches; only pairs within MAX_ANGLE that
        share MIN_MATCHES or more.
    """
    sift, features = cv2.SIFT_create(2000), []
    for cam in range(scene.n_cams):
        image = scene.recorded_images([cam], [0])[0, 0].permute(1, 2, 0).numpy()
        features.append(sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None))
    viewmats, Ks = scene.recording.cameras_at_step(0)
    errors = {}
    for a, b in zip(*np.nonzero(np.triu(found <= MAX_ANGLE, 1)), strict=True):
        if any(features[cam][1] is None for cam in (a, b)):
            continue
        (of_a, one), (of_b, other) = features[a], features[b]
        good = sorted(_best(one, other) & {pair[::-1] for pair in _best(other, one)})  # few of repeated patterns
        if len(good) < MIN_MATCHES:
            continue
        pixels = [np.float64([of[k].pt for k in own]) for of, own in zip((of_a, of_b), zip(*good), strict=True)]
        _, agrees = cv2.findFundamentalMat(*pixels, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
        agrees = np.zeros(len(good), bool) if agrees is None else agrees.ravel() > 0
        if agrees.sum() < MIN_MATCHES:
            continue
        seen = [own[agrees] + 0.5 for own in pixels]  # OpenCV's pixel centres are integers
        matrices = [Ks[cam] @ viewmats[cam, :3] for cam in (a, b)]
        points = cv2.triangulatePoints(*matrices, *(own.T for own in seen))
        points = (points[:3] / np.where(np.abs(points[3]) < 1e-12, 1e-12, points[3])).T
        off = [np.linalg.norm(project(points, viewmats[c], Ks[c])[0] - own, axis=1) for c, own in zip((a, b), seen)]
        names = scene.camera_names
        errors[f"{names[a]}-{names[b]}"] = float(np.median(np.mean(off, 0))), int(agrees.sum())
    return errors


def _best(a: np.ndarray, b: np.ndarray) -> set[tuple[int, int]]:
    """Returns pairs of each descriptor in ``a`` with its nearest in ``b``, where the second-best is much further."""
    pairs = (pair for pair in cv2.BFMatcher().knnMatch(a, b, 2) if len(pair) == 2)
    return {(best.queryIdx, best.trainIdx) for best, second in pairs if best.distance < RATIO * second.distance}


def fit_problem(errors: dict[str, tuple[float, int]], width: int) -> str | None:
    """Returns why the calibration does not fit, with the pairs of cameras; None if it fits or cannot be judged."""
    limit = max(MIN_LIMIT, MAX_ERROR * width)
    bad = [f"{pair} {error:.1f} px ({count} matches)" for pair, (error, count) in errors.items() if error > limit]
    if not bad:
        return None
    return (
        f"the calibration does not fit the images: the median reprojection error of matched features must be at most "
        f"{limit:.1f} px; got {', '.join(bad)}. Calibrate again (gsim3d calibrate), with cameras that do not move"
    )
