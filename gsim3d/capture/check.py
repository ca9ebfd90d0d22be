"""Whether a capture can be learned from: angles between its cameras, and the fit of their calibration."""

import cv2
import numpy as np

from gsim3d.capture.calibrate import MAX_ERROR
from gsim3d.data import Scene
from gsim3d.data.cameras import focus, nearest_point, positions_and_axes, project
from gsim3d.data.recording import MOVING, evenly_spaced

MAX_ANGLE = 45.0  # degrees from a camera to its nearest neighbour, seen from what they look at
MIN_MATCHES = 16  # of two images, to judge their calibration by
MIN_LIMIT = 1.5  # pixels, smallest limit of the reprojection error
SAMPLES = 24  # steps of a take at which masks are looked at
MIN_STEPS = 4  # with whole masks, to judge calibrations by them
WHOLE = 0.85  # of the radius of masks; bodies at rest are partly background in smaller ones
BORDER = 0.04  # of the width of an image; bodies that reach into it may be cut
MAX_SHIFT = 0.15  # of that radius; right cameras are below 0.08, those turned by 3 degrees above 0.2
RATIO = 0.75  # between the distances of the best and the second-best feature
NO_CENTRE = (
    "the calibration does not fit the masks: rays through the centres of the moving bodies miss each other by "
    '{:.1f} px (at most {:.1f}). Calibrate again (gsim3d calibrate), or mend "offset" in cameras.json, or the masks'
)


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
        (of_a, one), (of_b, other) = features[a], features[b]
        good = sorted(_best(one, other) & {pair[::-1] for pair in _best(other, one)})  # few of repeated patterns
        if len(good) < MIN_MATCHES:
            continue
        pixels = [np.float64([of[k].pt for k in own]) for of, own in zip((of_a, of_b), zip(*good), strict=True)]
        _, agrees = cv2.findFundamentalMat(*pixels, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
        if agrees is None or agrees.sum() < MIN_MATCHES:
            continue
        seen = [own[agrees.ravel() > 0] + 0.5 for own in pixels]  # OpenCV's pixel centres are integers
        matrices = [Ks[cam] @ viewmats[cam, :3] for cam in (a, b)]
        points = cv2.triangulatePoints(*matrices, *(own.T for own in seen))
        points = (points[:3] / np.where(np.abs(points[3]) < 1e-12, 1e-12, points[3])).T
        off = [np.linalg.norm(project(points, viewmats[c], Ks[c])[0] - own, axis=1) for c, own in zip((a, b), seen)]
        pair = "-".join(scene.camera_names[cam] for cam in (a, b))
        errors[pair] = float(np.median(np.mean(off, 0))), int(agrees.sum())
    return errors


def _best(a: np.ndarray, b: np.ndarray) -> set[tuple[int, int]]:
    """Returns pairs of each descriptor in ``a`` with its nearest in ``b``, where the second-best is much further."""
    found = cv2.BFMatcher().knnMatch(a, b, 2) if a is not None and b is not None else ()
    pairs = (pair for pair in found if len(pair) == 2)
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


def moving_bodies(scene: Scene, step: int, border: int = 0) -> tuple | None:
    """Locates the moving bodies in the masks of a step.

    Returns:
        Cameras [C] whose masks show them and leave ``border`` pixels free; the pixels [n, 2] and the centroid [2] of
        each mask; the point [3] nearest to the rays through the centroids. None without such a point.
    """
    viewmats, Ks = scene.recording.cameras_at_step(step)
    masks = (scene.segmentation(range(scene.n_cams), [step])[0] == MOVING).numpy()
    inner = masks[:, border : scene.height - border, border : scene.width - border]
    seen = np.flatnonzero(inner.any((1, 2)) & (inner.sum((1, 2)) == masks.sum((1, 2))))
    pixels = [np.argwhere(masks[cam])[:, ::-1] + 0.5 for cam in seen]
    middles = np.array([own.mean(0) for own in pixels])
    rays = [viewmats[c, :3, :3].T @ np.linalg.solve(Ks[c], [*middle, 1]) for c, middle in zip(seen, middles)]
    point = nearest_point(positions_and_axes(viewmats[seen])[0], np.array(rays)) if len(seen) > 1 else None
    return None if point is None else (seen, pixels, middles, point)


def centre_error(take: Scene) -> tuple[float, float] | None:
    """Measures cameras and time offsets by the moving bodies: the rays through the centroids of their masks meet.

    Returns:
        Median distance in pixels between centroids and the projected point nearest to the rays, and the largest that
        fits; None if fewer than MIN_STEPS steps show whole bodies in two cameras.
    """
    (viewmats, Ks), rows = take.recording.cameras_at_step(0), []
    for step in evenly_spaced(take.n_steps, SAMPLES) if take.has_segmentation() else ():
        if found := moving_bodies(take, step, round(BORDER * take.width)):
            seen, pixels, middles, point = found
            off = np.linalg.norm(project(point[None], viewmats[seen], Ks[seen])[0][:, 0] - middles, axis=1)
            rows.append((off.mean(), np.mean([np.sqrt(len(own) / np.pi) for own in pixels])))
    whole = WHOLE * np.quantile([radius for _, radius in rows] or [0], 0.9)
    rows = [row for row in rows if row[1] >= whole]
    if len(rows) < MIN_STEPS:
        return None
    off, radius = np.median(rows, axis=0)
    return float(off), float(max(MIN_LIMIT, MAX_ERROR * take.width, MAX_SHIFT * radius))


def summary(found: np.ndarray, errors: dict[str, tuple[float, int]], centres: tuple[float, float] | None) -> str:
    """Returns the results of :func:`angles`, :func:`match_errors` and :func:`centre_error` in words."""
    nearest = ", ".join(f"{angle:.0f}" for angle in np.sort(found, axis=1)[:, 1:2].ravel())
    errors = [f"of matched features {max(errors.values())[0]:.2f} px"] if errors else []
    errors += [f"of moving bodies {centres[0]:.2f} px"] if centres else []
    fit = ", ".join(errors) or "unknown: nothing shows whether the calibration fits, look at gsim3d check-data"
    return f"{nearest} degrees to the nearest camera; reprojection error {fit}"
