"""Calibrated cameras on two rings around the scene."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rig:
    """The cameras of a scene."""

    viewmats: np.ndarray  #: world-to-camera matrices [V, 4, 4], OpenCV axes (x right, y down, z forward)
    Ks: np.ndarray  #: intrinsics [V, 3, 3] in pixels, pixel centres at +0.5
    size: int  #: width and height of the images in pixels
    near: float  #: smallest visible depth in metres
    far: float  #: largest visible depth in metres

    @property
    def n_cams(self) -> int:
        """Number of cameras."""
        return len(self.viewmats)


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """World-to-camera matrix [4, 4] of a camera at ``position`` that looks at ``target``, with world z up."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -(rotation * position).sum(1)
    return matrix


def two_rings(n_cams, size, near, far, *, distance, target_height, elevations, fov, turned=0.0) -> Rig:
    """Cameras on two rings, alternately at the low and the high of ``elevations`` (degrees), that look at a point on
    the z axis. ``distance`` and ``target_height`` of that point, ``near`` and ``far`` in metres; images of ``size``
    pixels; vertical ``fov`` in degrees; ``turned``: rotation of both rings about the z axis in rad."""
    target = np.array([0.0, 0.0, target_height])
    focal = size / 2 / np.tan(np.radians(fov) / 2)
    viewmats = []
    for cam in range(n_cams):
        azimuth, elevation = turned + 2 * np.pi * cam / n_cams, np.radians(elevations[cam % 2])
        toward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        viewmats.append(look_at(target + distance * np.array(toward), target))
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Rig(np.stack(viewmats), np.repeat(K[None], n_cams, 0), size, near, far)


def project(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projects world points [N, 3] to pixels [V, N, 2] and depths [V, N] of every camera."""
    local = np.einsum("vij,nj->vni", viewmats[:, :3, :3], points) + viewmats[:, None, :3, 3]
    image = np.einsum("vij,vnj->vni", Ks, local)
    return image[..., :2] / image[..., 2:], local[..., 2]


def pixel_rays(rig: Rig, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays through ``samples`` x ``samples`` points of every pixel.

    Returns:
        Origins [V, 3] and unit directions [V, H, W, samples^2, 3] in world coordinates.
    """
    steps = (np.arange(samples) + 0.5) / samples
    grid = np.arange(rig.size)[:, None] + steps[None]
    y, x = np.meshgrid(grid.reshape(-1), grid.reshape(-1), indexing="ij")
    x, y = (a.reshape(rig.size, samples, rig.size, samples).swapaxes(1, 2).reshape(-1) for a in (x, y))
    K = rig.Ks[:, None]
    local = np.stack(
        [(x - K[..., 0, 2]) / K[..., 0, 0], (y - K[..., 1, 2]) / K[..., 1, 1], np.ones((rig.n_cams, x.size))], -1
    )
    rotations = rig.viewmats[:, :3, :3]
    directions = np.einsum("vji,vnj->vni", rotations, local)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = -(rotations * rig.viewmats[:, :3, 3:]).sum(1)
    return origins, directions.reshape(rig.n_cams, rig.size, rig.size, samples**2, 3)


def workspace_origin(rig: Rig) -> np.ndarray:
    """Lower corner [3] of the bounding box of all camera frusta between near and far, rounded down to 0.1 m.

    Cell indices relative to it are never negative.
    """
    corner = np.array([[x, y] for x in (0.0, rig.size) for y in (0.0, rig.size)])
    lowest = []
    for viewmat, K in zip(rig.viewmats, rig.Ks):
        rays = np.stack([(corner[:, 0] - K[0, 2]) / K[0, 0], (corner[:, 1] - K[1, 2]) / K[1, 1], np.ones(4)], 1)
        for depth in (rig.near, rig.far):
            local = rays * depth - viewmat[:3, 3]
            lowest.append((viewmat[:3, :3][None] * local[:, :, None]).sum(1).min(0))
    return np.floor(np.min(lowest, axis=0) * 10) / 10
