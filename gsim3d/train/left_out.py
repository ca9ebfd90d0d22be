"""Images of the input cameras, each drawn from the particles of the other cameras."""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.nn.multiview_encoder import StaticShapes, pixel_rows
from gsim3d.state import Particles


def with_views(particles: Particles, frames: Frames, shapes: StaticShapes | None = None) -> Particles:
    """Returns particles, encoded from ``frames`` with equally many images in every cloud, sorted by cloud, with their
    view as ``label``. ``shapes`` as of :meth:`gsim3d.Simulator.encode`."""
    image = torch.arange(len(frames.cameras), device=particles.means.device) % images_per_cloud(frames)
    view = pixel_rows(frames, image[:, None, None].expand(-1, *frames.images.shape[2:]), shapes)
    return dataclasses.replace(particles, label=view)


def images_per_cloud(frames: Frames) -> int:
    """Returns the number of images of each cloud."""
    return len(frames.cameras) // frames.cloud_scene.shape[0]


def draw_left_out(
    draw: Callable[[Particles, Cameras, Tensor | None], Tensor], particles: Particles, targets: Frames, n_views: int
) -> Tensor:
    """Draws each image without the particles that came from its own camera.

    Args:
        draw: function (particles, cameras, valid) -> images [I, H, W, 3].
        particles: particles with their view as ``label``; those of left-out views have opacity 0.
        targets: frames of I cameras, ``n_views`` for each cloud, in the order of the input images.
        n_views: input images of each cloud.

    Returns:
        Images [I, H, W, 3].

    Gradients:
        Exactly 0 from an image to the particles of its own camera.
    """
    images, cameras, valid = [], targets.cameras, targets.valid
    number = torch.arange(len(cameras), device=particles.means.device).view(-1, n_views)
    for view in range(n_views):
        opacities = particles.opacities.masked_fill(particles.label == view, 0)
        others = dataclasses.replace(particles, opacities=opacities)
        chosen = number[:, view]
        images.append(draw(others, cameras.select(chosen), None if valid is None else valid[chosen]))
    return torch.stack(images, 1).flatten(0, 1)
