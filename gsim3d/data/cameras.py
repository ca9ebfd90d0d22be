"""Validation of camera poses and intrinsics, and scene extents derived from cameras.

All poses are float64, world-to-camera, OpenCV axes (x right, y down, z forward), pixel centres at +0.5.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gsim3d.data.recording import Problems, Recording, evenly_spaced
from gsim3d.math.rotations import rotation_matrices

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes (y up, z backwards) <-> OpenCV's
ROTATION_TOLERANCE = 1e-3
MIN_FOCAL = 1e-3  # pixels; smaller values overflow in ray directions
NORMALISED_FOCAL = 8.0  # pixels; smaller focal lengths of larger images are taken to be divided by the image size
MAX_ERROR = 0.5  # RMS distance of the optical axes from their focus point, over the mean camera distance
MIN_SPREAD = 0.02  # smallest mean squared sine between the axes and their mean direction: about 8 degrees
MANY_STEPS = 64  # steps of moving cameras that checks and extents use
NEAR_SHARE, FAR_SHARE = 0.3, 2.0  # near and far, as multiples of the smallest and largest distance to the focus point
FAR_FROM_ZERO = 16  # times near; beyond it float32 rounds positions at depth near by more than 2^-20 of their depth
MAX_REACH = 1000  # times far; largest distance from the cameras to the lower corner of the workspace
SAMPLES = 12  # points along each side of a frustum


def inverse(viewmats: np.ndarray) -> np.ndarray:
    """Returns the inverses of rigid transforms [..., 4, 4]: world-to-camera to camera-to-world, or the reverse."""
    result = np.zeros_like(viewmats)
    rotation = viewmats[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ viewmats[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1
    return result


def near_zero(recording: Recording) -> Recording:
    """Returns ``recording`` translated towards the origin if its coordinates are too large for float32.

    Georeferenced scenes, for example, have cameras millions of metres from the origin. The translation is the mean
    camera centre, rounded to metres; it is added to ``world_offset``.
    """
    middle = inverse(recording.viewmats)[..., :3, 3].reshape(-1, 3).mean(0)
    near = recording.near or min(depth_range(spread_steps(recording.viewmats).reshape(-1, 4, 4)) or (np.inf,))
    offset = np.round(middle)
    if not np.abs(middle).max() > FAR_FROM_ZERO * near or not offset.any():
        return recording
    viewmats = recording.viewmats.copy()
    viewmats[..., :3, 3] += viewmats[..., :3, :3] @ offset
    points = {name: value - offset for name in ("origin", "bounds") if (value := getattr(recording, name)) is not None}
    points["actions"] = recording.changed_actions(lambda positions: positions - offset)
    return dataclasses.replace(recording, viewmats=viewmats, world_offset=recording.world_offset + offset, **points)


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Returns the rotation matrices [S, 3, 3] of unit quaternions (w, x, y, z) [S, 4]."""
    return rotation_matrices(torch.from_numpy(quaternions)).numpy()


def check_pose(matrices: np.ndarray, what: str, problems: Problems) -> bool:
    """Returns whether [4, 4] or [S, 4, 4] are right-handed rigid transforms; reports the first frame that is not."""
    stack = matrices.reshape(-1, 4, 4)
    rotation = stack[:, :3, :3]
    end = np.abs(stack[:, 3] - [0, 0, 0, 1]).max(1)
    skew = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max((1, 2))
    wrong = (end > ROTATION_TOLERANCE) | (skew > ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0)
    if not wrong.any():
        return True
    step = int(np.argmax(wrong))
    if end[step] > ROTATION_TOLERANCE:
        reason = f"must end in the row 0 0 0 1; got {stack[step, 3].tolist()}"
    elif skew[step] > ROTATION_TOLERANCE:
        reason = (
            f"must be a rigid transform: its rotation is not orthonormal (off by {skew[step]:.3g}); it contains scale "
            "or shear, or its numbers have too few digits"
        )
    else:
        reason = "must be a rigid transform: its rotation is left-handed (determinant -1); one axis is mirrored"
    problems.add(f"{what}{f' (frame {step})' if matrices.ndim == 3 else ''} {reason}")
    return False


def check_intrinsics(Ks: np.ndarray, size: tuple[int, int], what: str, problems: Problems) -> bool:
    """Returns whether [3, 3] or [S, 3, 3] are valid pinhole intrinsics, in pixels, of images of ``size``."""
    moving = Ks.ndim == 3
    for step, K in enumerate(Ks if moving else Ks[None]):
        which = f"{what}{f' (frame {step})' if moving else ''}"
        (fx, fy), (cx, cy) = np.diag(K)[:2], K[:2, 2]
        if np.abs(K[2] - [0, 0, 1]).max() > ROTATION_TOLERANCE or abs(K[1, 0]) > ROTATION_TOLERANCE * abs(K[1, 1]):
            problems.add(f"{which} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]]; got {K.tolist()}")
        elif not (fx >= MIN_FOCAL and fy >= MIN_FOCAL):
            problems.add(f"{which}: focal lengths must be positive, {MIN_FOCAL:g} or more; got fx {fx:g}, fy {fy:g}")
        elif min(fx, fy) < NORMALISED_FOCAL < max(size) and max(cx, cy) <= 2:
            problems.add(
                f"{which}: focal lengths must be in pixels; fx {fx:g}, fy {fy:g} of a {size[0]}x{size[1]} image look "
                "as if divided by its size"
            )
        elif not (0 <= cx <= size[0] and 0 <= cy <= size[1]):
            problems.add(
                f"{which}: the principal point ({cx:g}, {cy:g}) lies outside the image of {size[0]}x{size[1]} pixels"
            )
        else:
            continue
        return False
    return True


def positions_and_axes(viewmats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns camera centres and optical axes in world space, [..., 3] each."""
    return inverse(viewmats)[..., :3, 3], viewmats[..., 2, :3]


def focus(viewmats: np.ndarray) -> np.ndarray | None:
    """Returns the point [3] closest to the optical axes of [N, 4, 4] by least squares; None if they are parallel."""
    return nearest_point(*positions_and_axes(viewmats))


def nearest_point(centres: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """Returns the point [3] closest to lines [N, 3] by least squares; None if they are nearly parallel."""
    axes = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    if len(axes) < 2 or np.linalg.eigvalsh(across.mean(0))[0] < MIN_SPREAD:
        return None
    return np.linalg.solve(across.sum(0), (across @ centres[:, :, None]).sum(0)[:, 0])


@dataclass(frozen=True)
class _Convergence:
    """Statistics of cameras relative to their focus point, the point closest to all optical axes."""

    behind: np.ndarray  #: bool [N], whether the focus point lies behind a camera
    error: float  #: RMS distance of the axes from the focus point, over the mean camera distance
    plausible: float  #: fraction of the cameras with the focus point in front of them, at a plausible distance

    @property
    def fits(self) -> bool:
        """Whether all cameras look at the focus point."""
        return self.plausible == 1 and self.error < MAX_ERROR


def check_directions(recording: Recording, problems: Problems) -> None:
    """Detects flipped camera axes and inverted poses by testing whether the cameras look at one common scene."""
    viewmats, source = spread_steps(recording.viewmats), recording.source
    _check_origin(recording, viewmats.reshape(-1, 4, 4), problems)
    if recording.bounds is not None:
        _check_view_of_bounds(recording, viewmats, problems)
        return
    depths = (recording.near, recording.far)
    found = _convergence(viewmats.reshape(-1, 4, 4), depths)
    if found is None or found.fits:
        return
    hint = _better_convention(viewmats.reshape(-1, 4, 4), depths)
    if found.behind.all() or (hint and (found.plausible < 0.5 or found.error > MAX_ERROR)):
        hint = hint or "are the camera axes OpenGL's (y up, z backwards)?"
        problems.add(f"{source}: the cameras do not look at a common point: {hint}")
        return
    behind = found.behind.reshape(viewmats.shape[:2])
    for cam in np.flatnonzero(behind.any(0)):
        frame = f", frame {int(np.argmax(behind[:, cam]))}" if len(viewmats) > 1 else ""
        problems.add(
            f"{source}: camera {recording.camera_names[cam]}{frame} looks away from the point that the others look at: "
            "are its y and z axes flipped? (if the pose is correct, give the bounds of the scene)"
        )


def _check_origin(recording: Recording, viewmats: np.ndarray, problems: Problems) -> None:
    """Reports an origin too far from the cameras: float32 coordinates relative to it would be too coarse."""
    key = "bounds" if recording.origin is None else "origin"
    corner = recording.bounds[0] if recording.origin is None and recording.bounds is not None else recording.origin
    if corner is None:
        return
    far = recording.far or (depth_range(viewmats) or (0.0, np.inf))[1]
    distance = float(np.linalg.norm(positions_and_axes(viewmats)[0] - corner, axis=1).min())
    if distance > MAX_REACH * far:
        problems.add(
            f"{recording.source}: {key} lies {distance:.3g} m from the nearest camera, though far is {far:.3g} m; it "
            "must be the lower corner of the box that contains the scene"
        )


def _convergence(viewmats: np.ndarray, depths: tuple[float | None, float | None]) -> _Convergence | None:
    """Returns None if the axes are nearly parallel. ``depths`` are near and far, None if not given."""
    point = focus(viewmats)
    if point is None:
        return None
    centres, axes = positions_and_axes(viewmats)
    to_point = point - centres
    depth = (to_point * axes).sum(1)
    distance = np.linalg.norm(to_point, axis=1)
    off = np.sqrt(np.maximum(distance**2 - depth**2, 0))
    # Inverted poses often place all cameras at nearly one position, where their axes meet too.
    least = 0.2 * np.linalg.norm(viewmats[:, :3, 3], axis=1).mean() if depths[0] is None else depths[0] / 2
    most = np.inf if depths[1] is None else 2 * depths[1]
    plausible = (depth > 0) & (distance >= least) & (distance <= most)
    error = np.sqrt((off**2).mean()) / max(distance.mean(), 1e-12)
    return _Convergence(depth <= 0, float(error), float(plausible.mean()))


def _better_convention(viewmats: np.ndarray, depths: tuple[float | None, float | None]) -> str | None:
    """Returns a question naming the convention in which all cameras look at one point; None if no convention fits."""
    readings = {
        "are the camera axes OpenGL's (y up, z backwards) where OpenCV's are expected, or the reverse?": OPENGL
        @ viewmats,
        "are the matrices camera-to-world where world-to-camera is expected, or the reverse?": inverse(viewmats),
        "are the matrices camera-to-world with OpenGL's axes?": OPENGL @ inverse(viewmats),
    }
    errors = {}
    for hint, reading in readings.items():
        found = _convergence(reading, depths)
        if found is not None and found.fits:
            errors[hint] = found.error
    return min(errors, key=errors.get, default=None)


def _check_view_of_bounds(recording: Recording, viewmats: np.ndarray, problems: Problems) -> None:
    low, high = recording.bounds
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    Ks = spread_steps(recording.Ks)
    sizes = np.array(recording.sizes, dtype=np.float64)
    seen = _visible(low + grid * (high - low), viewmats, Ks, sizes).any((0, 2))
    for cam in np.flatnonzero(~seen):
        problems.add(
            f"{recording.source}: camera {recording.camera_names[cam]} does not see the bounds {low.tolist()} to "
            f"{high.tolist()}: are its y and z axes flipped, or is its matrix camera-to-world?"
        )


def spread_steps(values: np.ndarray) -> np.ndarray:
    """Subsamples [S, ...] to at most MANY_STEPS evenly spaced steps."""
    return values[evenly_spaced(len(values), MANY_STEPS)]


def project(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projects world points [N, 3] with viewmats [..., 4, 4], Ks [..., 3, 3] to pixels [..., N, 2], depths [..., N]."""
    local = points @ viewmats[..., :3, :3].swapaxes(-1, -2) + viewmats[..., None, :3, 3]
    image = local @ Ks.swapaxes(-1, -2)
    depth = local[..., 2]
    return image[..., :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[..., None], depth


def _visible(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Returns bool [S, V, N]: whether points project in front of a camera and inside its image."""
    pixels, depth = project(points, viewmats, Ks)
    return (depth > 0) & (pixels >= 0).all(-1) & (pixels <= sizes[:, None]).all(-1)


def depth_range(viewmats: np.ndarray) -> tuple[float, float] | None:
    """Estimates near and far from the distances of cameras [N, 4, 4] to their focus point; None without one."""
    point = focus(viewmats)
    if point is None:
        return None
    distance = np.linalg.norm(point - positions_and_axes(viewmats)[0], axis=1)
    return NEAR_SHARE * float(distance.min()), FAR_SHARE * float(distance.max())


def frusta_points(viewmats, Ks, sizes: Sequence[tuple[int, int]], near: float, far: float, samples: int) -> np.ndarray:
    """Returns world points [S, V, samples^3, 3] on a grid in the frusta of cameras [S, V, ...], corners included."""
    share = np.linspace(0, 1, samples)
    grid = np.stack(np.meshgrid(share, share, 1 / np.linspace(1 / near, 1 / far, samples), indexing="ij"), -1)
    grid = grid.reshape(-1, 3)
    corner = grid[:, :2] * np.asarray(sizes, dtype=np.float64)[:, None]
    pixels = np.concatenate([corner, np.ones((*corner.shape[:2], 1))], -1)
    rays = pixels @ np.linalg.inv(Ks).swapaxes(-1, -2)
    local = rays * grid[:, 2:]
    poses = inverse(viewmats)
    return local @ poses[..., :3, :3].swapaxes(-1, -2) + poses[..., None, :3, 3]


def frusta_origin(viewmats, Ks, sizes: Sequence[tuple[int, int]], near: float, far: float) -> np.ndarray:
    """Returns the lower corner, float64 [3], of the bounding box of all frusta between ``near`` and ``far``."""
    return frusta_points(viewmats, Ks, sizes, near, far, 2).reshape(-1, 3).min(0)


def shared_view(viewmats, Ks, sizes: Sequence[tuple[int, int]], near: float, far: float) -> np.ndarray:
    """Returns the bounding box [2, 3] of the region that most cameras see at the first step; default scene bounds."""
    points = frusta_points(viewmats[:1], Ks[:1], sizes, near, far, SAMPLES)[0].reshape(-1, 3)
    seen_by = _visible(points, viewmats[:1], Ks[:1], np.asarray(sizes, dtype=np.float64))[0].sum(0)
    shared = points[seen_by >= 0.75 * seen_by.max()]
    return np.stack([shared.min(0), shared.max(0)])
