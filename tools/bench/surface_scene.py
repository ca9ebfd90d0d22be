"""The scene of the full-size benchmarks: an ellipsoid sinks 4 cm a step above a ground disc of 1.5 m radius.

As points it is the scene of which the authors' release was recorded; as a video, 12 cameras around it see the body in a
quarter of their pixels and the ground in all others. Masked means the body alone: 16k particles a step from 4 views of
128 px, 6 mm apart, as the points are.

What a step costs depends on where particles lie, and untrained weights would scatter them. So :func:`as_if_trained`
keeps all of a model's work and gradients, but puts encoded particles onto the surfaces that the pixels show, and lets
the last layers predict little more than that bodies sink on and that Gaussians are as wide as 0.7 pixels (untrained
they are 5 cm wide, and each is in sight of a quarter of all pixels).
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.simulator import Simulator
from gsim3d.state import Particles

N_CAMS = 12
DISC_RADIUS, HALF_AXES, FIRST_HEIGHT, FALL = 1.5, (0.25, 0.2, 0.22), 0.9, 0.04  # metres; FALL a step
CAMERA_RADIUS, CAMERA_HEIGHT, LOOKED_AT, FOCAL = 1.45, 2.7, 0.72, 3.02  # FOCAL in image widths
NEAR, FAR, CORNER = 1.2, 4.5, -4.0  # CORNER of the workspace on each axis
LITTLE = 1e-3  # what is left of the weights of last layers
WIDTH = 0.0045  # metres, of a Gaussian


def points(n_steps: int, n: int, moving_share: float) -> Tensor:
    """[T, n, 3] metres on the GPU."""
    g = torch.Generator(device="cuda").manual_seed(0)
    n_body = int(n * moving_share)
    n_ground = n - n_body
    angle = 6.2832 * torch.rand(n_ground, device="cuda", generator=g)
    radius = DISC_RADIUS * torch.rand(n_ground, device="cuda", generator=g).sqrt()
    height = 0.003 * torch.rand(n_ground, device="cuda", generator=g)
    ground = torch.stack([radius * angle.cos(), radius * angle.sin(), height], -1)
    direction = torch.randn(n_body, 3, device="cuda", generator=g)
    body = direction / direction.norm(dim=-1, keepdim=True) * torch.tensor(HALF_AXES, device="cuda")
    lift = torch.tensor([0.0, 0.0, 1.0], device="cuda")
    return torch.stack([torch.cat([ground, body + (FIRST_HEIGHT - FALL * t) * lift]) for t in range(n_steps)])


def poses() -> Tensor:
    """float64 [12, 4, 4] world-to-camera: cameras on a circle look down at the body."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(N_CAMS, 1, 1)
    for cam in range(N_CAMS):
        angle = 2 * math.pi * cam / N_CAMS
        place = CAMERA_RADIUS * torch.tensor([math.cos(angle), math.sin(angle), 0], dtype=torch.float64)
        place[2] = CAMERA_HEIGHT
        forward = torch.nn.functional.normalize(torch.tensor([0, 0, LOOKED_AT]) - place, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0, 0, 1.0]).double()), dim=0)
        viewmats[cam, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmats[cam, :3, 3] = -viewmats[cam, :3, :3] @ place
    return viewmats


def intrinsics(size: int) -> Tensor:
    return torch.tensor([[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1]], dtype=torch.float64)


def cameras(cams: Sequence[int], image_cloud: Tensor, size: int) -> Cameras:
    """Camera ``cams[i]`` sees cloud ``image_cloud[i]``; on the CPU."""
    n = len(cams)
    bounds = torch.full((n,), NEAR), torch.full((n,), FAR)
    Ks = intrinsics(size).float().repeat(n, 1, 1)
    return Cameras(poses()[list(cams)].float(), Ks, *bounds, image_cloud, size, size)


def clip(step: int, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """What the 12 cameras see: images [12, 3, size, size], where the body is [12, size, size], and the places in the
    world that the pixels show [12, size, size, 3]."""
    viewmats, K = poses(), intrinsics(size)
    x = (torch.arange(size, dtype=torch.float64) + 0.5).expand(size, size)
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (x.T - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    rays = rays @ viewmats[:, None, :3, :3]
    origin = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[:, None, None, :, 0]
    places = origin - rays * (origin[..., 2:] / rays[..., 2:])
    checks = (places[..., :2] * 4).floor().sum(-1, keepdim=True) % 2
    images = (0.4 + 0.3 * checks).expand_as(places).clone()
    axes = torch.tensor(HALF_AXES, dtype=torch.float64)
    start = (origin - torch.tensor([0, 0, FIRST_HEIGHT - FALL * step])) / axes  # where the body is a unit sphere
    along = rays / axes
    square, slope = along.square().sum(-1, keepdim=True), (start * along).sum(-1, keepdim=True)
    inside = slope.square() - square * (start.square().sum(-1, keepdim=True) - 1)
    reach = (-slope - inside.clamp(min=0).sqrt()) / square
    body = inside[..., 0] > 0
    images[body], places[body] = (0.5 + 0.5 * (start + along * reach))[body], (origin + rays * reach)[body]
    return images.permute(0, 3, 1, 2).float(), body, places.float()


def frames(n_scenes: int, views: Sequence[Sequence[int]], size: int, masked: bool) -> tuple[Frames, Tensor]:
    """The first ``len(views)`` steps of as many equal scenes, step t seen by the cameras ``views[t]``; and the places
    [N, 3] of the particles that an encoder makes of them. On the CPU."""
    n_steps, n_views = len(views), len(views[0])
    clips = [clip(step, size) for step in range(n_steps)]
    images, body, places = (
        torch.cat([clips[t][kind][list(views[t])] for t in range(n_steps)]).repeat(n_scenes, 1, 1, *[1] * rest)
        for kind, rest in ((0, 1), (1, 0), (2, 1))
    )
    seen = [cam for step in views for cam in step] * n_scenes
    of_scenes = Frames(
        images=images,
        cameras=cameras(seen, torch.arange(n_scenes * n_steps).repeat_interleave(n_views), size),
        cloud_scene=torch.arange(n_scenes).repeat_interleave(n_steps),
        cloud_step=torch.arange(n_steps).repeat(n_scenes),
        origin=torch.full((n_scenes, 3), CORNER, dtype=torch.float64),
        masks=body if masked else None,
        dynamic=body,
    )
    return of_scenes, places[body] if masked else places.flatten(0, 2)


def evenly(n_views: int) -> list[int]:
    """Cameras as far apart as they can be."""
    return [view * N_CAMS // n_views for view in range(n_views)]


def _true_places(frames: Frames, particles: Particles, places: Tensor) -> Tensor:
    """``places`` for the rows that are a pixel's; where clouds have more rows than pixels, the others stay where they
    are. A CUDA graph may capture it."""
    n_clouds, pixels = len(frames.cloud_scene), frames.images[:, 0]
    kept = torch.ones_like(pixels, dtype=torch.bool) if frames.masks is None else frames.masks
    counts = kept.reshape(n_clouds, -1).sum(1)
    row = torch.arange(particles.n_rows, device=places.device)
    cloud = torch.searchsorted(particles.cu_rows[1:], row, right=True)
    number = row - particles.cu_rows[cloud]
    place = (counts.cumsum(0) - counts)[cloud] + number
    is_one = (number < counts[cloud])[:, None]
    return torch.where(is_one, places[place.clamp(max=len(places) - 1)], particles.means.detach())


def as_if_trained(simulator: Simulator, places: Tensor) -> Simulator:
    """``simulator``, changed: what it encodes lies at ``places``, whatever depth it predicts; bodies sink."""
    encode = simulator.encode

    def encode_truly(frames: Frames, **options) -> Particles:
        particles = encode(frames, **options)
        found = particles.means.detach()
        return dataclasses.replace(particles, means=_true_places(frames, particles, places) + (particles.means - found))

    simulator.encode = encode_truly
    dynamics, first = simulator.dynamics, 0
    with torch.no_grad():
        last = dynamics.net.head.fc2
        last.weight.mul_(LITTLE)
        last.bias.zero_()
        for name, n in dynamics.layout.outputs:
            if name == "means":
                limit = dynamics.config.max_step
                last.bias[first + 2] = -FALL if limit is None else math.atanh(-FALL / limit)
            first += n
        head = simulator.renderer
        if head.config.latents:
            share = (WIDTH - head.config.scale_min) / (head.config.scale_max - head.config.scale_min)
            head.fc2.weight[-3:].mul_(LITTLE)
            head.fc2.bias[-3:] = math.log(share / (1 - share))
    return simulator
