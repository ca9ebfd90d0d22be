"""A video of Gaussians from a camera that circles around them."""

import math
from collections.abc import Iterable

import numpy as np
import torch

from gsim3d.cameras import Cameras
from gsim3d.ops import project_gaussians, rasterize_gaussians
from gsim3d.state import Gaussians

ELEVATION, FIELD_OF_VIEW = 25.0, 42.0  # degrees
MARGIN = 1.15  # of the distance at which all is in view
QUANTILE = 0.98  # of the distances from the middle, that is in view
NEAR = 0.01  # metres, of large scenes
FAINT = 0.1  # opacity below which a Gaussian does not count for the view


@torch.no_grad()
def orbit_frames(frames: Iterable[Gaussians], count: int, size: int, turns: float) -> Iterable[np.ndarray]:
    """Images uint8 [size, size, 3] of ``frames``, from a camera that turns about the vertical through their middle.

    There are ``count`` frames, one packed frame each, z up; the camera makes ``turns`` over all of them.
    """
    reach = None
    for index, gaussians in enumerate(frames):
        reach = reach or _reach(gaussians)
        yield picture(gaussians, _camera(*reach, 2 * math.pi * turns * index / count, size))


def camera_around(gaussians: Gaussians, azimuth: float, size: int) -> Cameras:
    """A camera of ``size`` by ``size`` pixels that sees ``gaussians`` from ``azimuth`` (radians) and a little above."""
    return _camera(*_reach(gaussians), azimuth, size)


@torch.no_grad()
def picture(gaussians: Gaussians, camera: Cameras, background: torch.Tensor | None = None) -> np.ndarray:
    """One image uint8 [H, W, 3]."""
    fields, opacities = (gaussians.means, gaussians.quats, gaussians.scales), gaussians.opacities
    if gaussians.antialiased:
        opacities = opacities * project_gaussians(*fields, camera, antialiased=True).compensations
    options = {"near_plane": min(NEAR, 0.1 * float(camera.near[0])), "on_invalid": "drop", "background": background}
    image = rasterize_gaussians(*fields, opacities, camera, sh=gaussians.sh, **options).color[0]
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def _reach(gaussians: Gaussians) -> tuple[torch.Tensor, float]:
    """The middle of what is seen, and the distance from it at which all is in view."""
    shown = gaussians.means[gaussians.opacities > FAINT]
    shown = shown if len(shown) else gaussians.means
    if not len(shown):
        return torch.zeros(3), MARGIN
    centre = shown.median(0).values
    radius = float(torch.quantile((shown - centre).norm(dim=1)[:1_000_000], QUANTILE))
    return centre, MARGIN * max(radius, 1e-3) / math.sin(math.radians(FIELD_OF_VIEW / 2))


def _camera(centre: torch.Tensor, distance: float, azimuth: float, size: int) -> Cameras:
    elevation = math.radians(ELEVATION)
    toward = [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    position = centre.double() + distance * torch.tensor(toward, dtype=torch.float64)
    forward = torch.nn.functional.normalize(centre.double() - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]).double()), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    focal = size / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    near, far = torch.tensor([1e-2 * distance]), torch.tensor([10 * distance])
    return Cameras(viewmat.float()[None], K[None], near, far, torch.tensor([0]), size, size)
