"""Checks of cameras in one convention, and quantities that follow from cameras alone.

Everything here is float64, world-to-camera, OpenCV axes (x right, y down, z forward), pixel centres at +0.5.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gsim3d.data.recording import Problems, Recording
from gsim3d.math.rotations import rotation_matrices

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes (y up, z backwards) <-> OpenCV's
ROTATION_TOLERANCE = 1e-3
MIN_FOCAL = 1e-3  # pixels; shorter ones make rays that overflow
NORMALISED_FOCAL = 8.0  # pixels; a focal length below it, of an image larger than it, is no focal length in pixels
MAX_ERROR = 0.5  # of axes that meet: their distance from the point over its distance
MIN_SPREAD = 0.02  # mean squared sine of the optical axes around their mean: about 8 degrees
MANY_STEPS = 64  # of moving cameras; so many show where they look
NEAR_SHARE, FAR_SHARE = 0.3, 2.0  # near and far relative to the distances of the point that the cameras look at
FAR_FROM_ZERO = 16  # near depths; farther away float32 moves near points by more than 2^-20 of their depth
MAX_REACH = 1000  # times far: how far away from the cameras the lower corner of the workspace may lie
SAMPLES = 12  # points along each side of a frustum


def inverse(viewmats: np.ndarray) -> np.ndarray:
    """Inverses [..., 4, 4] of rigid motions: camera-to-world from world-to-camera, or back."""
    result = np.zeros_like(viewmats)
    rotation = viewmats[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ viewmats[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1
    return result


def near_zero(recording: Recording) -> Recording:
    """``recording`` with positions that float32 holds.

    Where cameras lie far from 0 for what they see, as in survey coordinates, positions count from a ``world_offset``
    amid them, in whole metres.
    """
    middle = inverse(recording.viewmats)[..., :3, 3].reshape(-1, 3).mean(0)
    near = recording.near or min(depth_range(spread_steps(recording.viewmats).reshape(-1, 4, 4)) or (np.inf,))
    offset = np.round(middle)
    if not np.abs(middle).max() > FAR_FROM_ZERO * near or not offset.any():
        return recording
    viewmats = recording.viewmats.copy()
    viewmats[..., :3, 3] += viewmats[..., :3, :3] @ offset
    points = {name: value - offset for name in ("origin", "bounds") if (value := getattr(recording, name)) is not None}
    return dataclasses.replace(recording, viewmats=viewmats, world_offset=recording.world_offset + offset, **points)


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices [S, 3, 3] of unit quaternions (w, x, y, z) [S, 4]."""
    return rotation_matrices(torch.from_numpy(quaternions)).numpy()


def check_pose(matrices: np.ndarray, what: str, problems: Problems) -> bool:
    """Whether [4, 4] or [S, 4, 4] are rigid motions of right-handed axes; names the frame of the first that is not."""
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
            f"must be a rigid motion: its rotation is not orthonormal (off by {skew[step]:.3g}); it holds a scale or "
            "shear, or is cut off"
        )
    else:
        reason = "must be a rigid motion: its rotation is left-handed (determinant -1); one axis is mirrored"
    problems.add(f"{what}{f' (frame {step})' if matrices.ndim == 3 else ''} {reason}")
    return False


def check_intrinsics(Ks: np.ndarray, size: tuple[int, int], what: str, problems: Problems) -> bool:
    """Whether [3, 3] or [S, 3, 3] are pinhole intrinsics in pixels of an image of ``size``."""
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
    """Camera centres and optical axes in the world, [..., 3] each."""
    return inverse(viewmats)[..., :3, 3], viewmats[..., 2, :3]


def focus(viewmats: np.ndarray) -> np.ndarray | None:
    """The point [3] nearest to all optical axes of [N, 4, 4]; None where the axes are nearly parallel."""
    centres, axes = positions_and_axes(viewmats)
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    if len(axes) < 2 or np.linalg.eigvalsh(across.mean(0))[0] < MIN_SPREAD:
        return None
    return np.linalg.solve(across.sum(0), (across @ centres[:, :, None]).sum(0)[:, 0])


@dataclass(frozen=True)
class _Convergence:
    """How cameras look at the point nearest to all their axes.

    Attributes:
        behind: bool [N], cameras that have it behind them.
        error: distance of the axes from it over its distance.
        plausible: share of the cameras that have it before them at a distance that a scene may have.
    """

    behind: np.ndarray
    error: float
    plausible: float

    @property
    def fits(self) -> bool:
        """Whether all cameras look at one point."""
        return self.plausible == 1 and self.error < MAX_ERROR


def check_directions(recording: Recording, problems: Problems) -> None:
    """Finds flipped axes and exchanged directions, which no single matrix shows: cameras look at one scene."""
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
        problems.add(f"{source}: the cameras look away from one another's views: {hint}")
        return
    behind = found.behind.reshape(viewmats.shape[:2])
    for cam in np.flatnonzero(behind.any(0)):
        frame = f", frame {int(np.argmax(behind[:, cam]))}" if len(viewmats) > 1 else ""
        problems.add(
            f"{source}: camera {recording.camera_names[cam]}{frame} looks away from the point that the others look at: "
            "are its y and z axes flipped? (if it is right, give the bounds of the scene)"
        )


def _check_origin(recording: Recording, viewmats: np.ndarray, problems: Problems) -> None:
    """Voxels are counted from the origin: far from it float32 cannot separate them."""
    key = "bounds" if recording.origin is None else "origin"
    corner = recording.bounds[0] if recording.origin is None and recording.bounds is not None else recording.origin
    if corner is None:
        return
    far = recording.far or (depth_range(viewmats) or (0.0, np.inf))[1]
    distance = float(np.linalg.norm(positions_and_axes(viewmats)[0] - corner, axis=1).min())
    if distance > MAX_REACH * far:
        problems.add(
            f"{recording.source}: {key} lies {distance:.3g} m from the nearest camera, though far is {far:.3g} m; it "
            "must be the lower corner of the box in which the scene happens"
        )


def _convergence(viewmats: np.ndarray, depths: tuple[float | None, float | None]) -> _Convergence | None:
    """None where the axes are nearly parallel. ``depths``: near and far, None where they are not given."""
    point = focus(viewmats)
    if point is None:
        return None
    centres, axes = positions_and_axes(viewmats)
    to_point = point - centres
    depth = (to_point * axes).sum(1)
    distance = np.linalg.norm(to_point, axis=1)
    off = np.sqrt(np.maximum(distance**2 - depth**2, 0))
    # Cameras read the wrong way round often have nearly one position, where their axes meet too.
    least = 0.2 * np.linalg.norm(viewmats[:, :3, 3], axis=1).mean() if depths[0] is None else depths[0] / 2
    most = np.inf if depths[1] is None else 2 * depths[1]
    plausible = (depth > 0) & (distance >= least) & (distance <= most)
    error = np.sqrt((off**2).mean()) / max(distance.mean(), 1e-12)
    return _Convergence(depth <= 0, float(error), float(plausible.mean()))


def _better_convention(viewmats: np.ndarray, depths: tuple[float | None, float | None]) -> str | None:
    """The convention of the matrices, as a question, in which all cameras look at one point; None: there is none."""
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
            f"{recording.source}: camera {recording.camera_names[cam]} sees nothing of the bounds {low.tolist()} to "
            f"{high.tolist()}: are its y and z axes flipped, or is its matrix camera-to-world?"
        )


def spread_steps(values: np.ndarray) -> np.ndarray:
    """At most MANY_STEPS of the steps of [S, ...], evenly spread."""
    chosen = np.linspace(0, len(values) - 1, min(len(values), MANY_STEPS)).round().astype(int)
    return values[chosen]


def project(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., N, 2] and depths [..., N] of world points [N, 3] in cameras [..., 4, 4], [..., 3, 3]."""
    local = points @ viewmats[..., :3, :3].swapaxes(-1, -2) + viewmats[..., None, :3, 3]
    image = local @ Ks.swapaxes(-1, -2)
    depth = local[..., 2]
    return image[..., :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[..., None], depth


def _visible(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """bool [S, V, N], points in front of a camera and inside its image."""
    pixels, depth = project(points, viewmats, Ks)
    return (depth > 0) & (pixels >= 0).all(-1) & (pixels <= sizes[:, None]).all(-1)


def depth_range(viewmats: np.ndarray) -> tuple[float, float] | None:
    """near and far around the point that cameras [N, 4, 4] look at; None where there is no such point."""
    point = focus(viewmats)
    if point is None:
        return None
    distance = np.linalg.norm(point - positions_and_axes(viewmats)[0], axis=1)
    return NEAR_SHARE * float(distance.min()), FAR_SHARE * float(distance.max())


def frusta_points(viewmats, Ks, sizes: Sequence[tuple[int, int]], near: float, far: float, samples: int) -> np.ndarray:
    """World points [S, V, samples^3, 3] on a grid inside the frusta of cameras [S, V, ...], corners included."""
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
    """Lower corner, float64 [3], of the box around all camera frusta between ``near`` and ``far``."""
    return frusta_points(viewmats, Ks, sizes, near, far, 2).reshape(-1, 3).min(0)


def shared_view(viewmats, Ks, sizes: Sequence[tuple[int, int]], near: float, far: float) -> np.ndarray:
    """Box [2, 3] around what most cameras see at one step: the default of a scene's bounds."""
    points = frusta_points(viewmats[:1], Ks[:1], sizes, near, far, SAMPLES)[0].reshape(-1, 3)
    seen_by = _visible(points, viewmats[:1], Ks[:1], np.asarray(sizes, dtype=np.float64))[0].sum(0)
    shared = points[seen_by >= 0.75 * seen_by.max()]
    return np.stack([shared.min(0), shared.max(0)])
