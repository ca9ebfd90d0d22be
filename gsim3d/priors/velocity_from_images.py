"""Velocity of encoded particles, by photometric alignment of rigid motions with older images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.cameras import Frames
from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Windows
from gsim3d.priors.padding import PaddedClouds, Samples, Subset, mean_shift
from gsim3d.priors.rigid import next_displacement, solve3
from gsim3d.state import Particles, constant

PASSES = 5  # Gauss-Newton iterations of the alignment
SHOWN = 0.9  # smallest fraction of a pixel window that must show movable particles
STIFF, STILL = 1e-4, 0.3  # damping of rotation and translation, relative to the mean diagonal of the normal equations
GREY = 0.02  # added to the sum of a colour in its normalisation
LEAST = 1e-8  # smallest diagonal, for windows without valid pixels
NEAR = 0.01  # smallest depth in metres


@dataclass(frozen=True)
class VelocityFromImagesConfig(PriorConfig):
    """Photometric alignment of rigid motions.

    Attributes:
        radius: standard deviation in metres of the windows that move rigidly; about the radius of a body.
        blur: standard deviation in pixels of the Gaussian blur of the images.
        facing: smallest cosine between the surface normal and the direction to a camera that is used.
        robust: threshold of colour differences in the Huber loss.
        inside: depth in metres of encoded particles below the visible surface.
    """

    type = "velocity_from_images"
    radius: float = 0.3
    blur: float = 1.0
    facing: float = 0.6
    robust: float = 0.02
    inside: float = 0.02

    RANGES = {"radius": (1e-6, 1e6), "blur": (1e-3, 100), "facing": (-1, 1), "robust": (1e-6, 10), "inside": (0, 1e6)}


class VelocityFromImages(Prior, config=VelocityFromImagesConfig):
    """Sets ``velocity`` of the newest cloud: the mean displacement a step since the oldest cloud of its history or,
    with gravity, the displacement in the last step. Other clouds get 0.

    Estimates the rigid motion of each window that aligns the colours of its particles in the newest and the oldest
    images, over all cameras. Colours are divided by their sum, which is constant as a body rotates in white light. The
    alignment starts from the displacement of the means and from the spin estimated over the last step.

    Source:
        Lucas and Kanade 1981.
    """

    attributes = ("velocity",)

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        if frames is None:
            return particles
        gravity = ctx.priors.get("gravity")
        fall = None if gravity is None or ctx.is_empty else gravity.fall(ctx)
        return replace(particles, velocity=estimate_velocity(ctx, frames, self.config, fall))


@torch.no_grad()
def estimate_velocity(
    ctx: StepContext, frames: Frames, config: VelocityFromImagesConfig, fall: Tensor | None = None
) -> Tensor:
    """Velocity [M, 3] in m/step of all particles encoded from ``frames``, each scene on its own; 0 in older clouds, and
    in scenes with a single step.

    The i-th image of the newest step is compared with the i-th image of the oldest; they should be of the same camera.
    With ``ctx.n_views`` images for each cloud in order, there is no device sync. ``fall``: acceleration [N, 3] of the
    newest particles in m/step^2, which converts a mean to a final velocity.
    """
    particles, clouds, newest = ctx.history, ctx.history.clouds, ctx.newest
    steps, histories = clouds.steps, zip([0, *(q + 1 for q in newest)], newest)
    oldest = [next(f for f in range(begin, q + 1) if steps[q] - steps[f] < ctx.max_steps) for begin, q in histories]
    if oldest == newest or ctx.is_empty:
        return torch.zeros_like(particles.means)
    with torch.autocast(particles.means.device.type, enabled=False):
        movable = ctx.movable
        windows = Windows(movable, particles, config.radius, evenly=False)
        now, images = movable.samples, _images(frames, len(clouds), ctx.n_views)
        seen = _Views(frames, particles, *images, newest, movable.center, config)
        center = windows.weights @ now.positions
        spin = torch.zeros_like(center)  # rad/step
        for earlier in ([max(f, q - 1) for f, q in zip(oldest, newest)], oldest):
            then = Samples(Subset(PaddedClouds(particles, earlier, ctx.grid_size), particles))
            then.center(movable.center)
            before = _Views(frames, particles, *images, earlier, movable.center, config)
            spans = constant(tuple(steps[q] - steps[e] for e, q in zip(earlier, newest)), spin.device)
            start = mean_shift(now, then, windows.nodes, config.radius), spans[:, None, None] * spin
            known = (spans > 0) & (now.n > 0) & (then.n > 0)
            per_step = (known / spans.clamp(min=1))[:, None, None].to(now.positions.dtype)
            velocity, spin = (x * per_step for x in _align(windows, center, *start, seen, before))
        velocity, spin, pivot = windows.to_particles(velocity, spin, center)
        displacement = -next_displacement(movable.positions, -velocity, -spin, pivot)
        if fall is not None:
            spans = [steps[q] - steps[f] for f, q in zip(oldest, newest)]
            remaining = constant(tuple(max(0, span - 1) for span in spans), displacement.device)
            displacement = displacement + 0.5 * remaining[:, None, None] * movable.gather(fall)
        return ctx.scatter_newest(movable.scatter(displacement))


def _align(
    windows: Windows, center: Tensor, velocity: Tensor, spin: Tensor, seen: _Views, before: _Views
) -> tuple[Tensor, Tensor]:
    """Refines displacement (m) and spin (rad) of each window since an earlier step, [B, G, 3] each."""
    now, window, config = windows.movable.samples, windows.weights, seen.config
    outwards = F.normalize(now.positions - windows.to_samples(center)[0], dim=2)
    positions = now.positions + config.inside * outwards
    targets, is_visible = seen.colours(positions)
    is_visible = is_visible & now.known[:, None] & seen.faces(positions, outwards)
    for _ in range(PASSES):
        shift, rotation, pivot = windows.to_samples(velocity, spin, center)
        earlier = positions + next_displacement(positions, -shift, -rotation, pivot)
        matched, was_visible, jacobian = before.slopes(earlier)
        residual, confidence = targets - matched, is_visible & was_visible & before.faces(earlier, outwards)
        confidence = confidence * (config.robust / residual.norm(dim=3).clamp(min=config.robust))
        by_spin = torch.linalg.cross(jacobian, (earlier + shift - pivot)[:, None, :, None].expand_as(jacobian))
        by_motion = torch.cat([by_spin, -jacobian], 4)
        sums = by_motion.mT @ (confidence[..., None, None] * torch.cat([by_motion, residual[..., None]], 4))
        sums = (window @ sums.sum(1).flatten(2)).unflatten(2, (6, 7))
        change = _solve6(sums[..., :6], sums[..., 6])
        spin, velocity = spin + change[..., :3], velocity + change[..., 3:]
    return velocity, spin


def _solve6(matrices: Tensor, values: Tensor) -> Tensor:
    """Solves damped systems [B, G, 6, 6] for [B, G, 6] (spin, translation), by block elimination of the spin.

    CUDA graphs can capture it.
    """
    scale = matrices.diagonal(dim1=2, dim2=3).mean(2)[..., None, None] + LEAST
    eye = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    spins, mixed, shifts = matrices[..., :3, :3], matrices[..., :3, 3:], matrices[..., 3:, 3:]
    spins, shifts = spins + STIFF * scale * eye, shifts + STILL * scale * eye
    by_shift = solve3(spins[..., None, :, :], mixed.mT)  # [B, G, 3, 3]
    by_value = solve3(spins, values[..., :3])
    shift = solve3(shifts - by_shift @ mixed, values[..., 3:] - (mixed.mT @ by_value[..., None])[..., 0])
    return torch.cat([by_value - (by_shift.mT @ shift[..., None])[..., 0], shift], 2)


def _images(frames: Frames, n_clouds: int, n_views: int | None) -> tuple[Tensor, Tensor]:
    """Images of each cloud, int64 [Q, V], and the mask bool [Q, V] of valid entries."""
    of_images = frames.cameras.image_cloud
    if n_views is not None:
        images = torch.arange(n_clouds * n_views, device=of_images.device).unflatten(0, (n_clouds, n_views))
        return images, torch.ones_like(images, dtype=torch.bool)
    counts, order = torch.bincount(of_images, minlength=n_clouds), torch.argsort(of_images, stable=True)
    place = torch.arange(int(counts.max()), device=of_images.device)
    begin = counts.cumsum(0) - counts
    return order[(begin[:, None] + place).clamp(max=len(order) - 1)], place < counts[:, None]


class _Views:
    """Normalised, blurred images of movable particles, of one cloud (``chosen``) a scene. Positions are relative to
    ``center`` [B, 1, 3], which is relative to the origins of the scenes."""

    def __init__(
        self,
        frames: Frames,
        particles: Particles,
        images: Tensor,
        is_image: Tensor,
        chosen: list[int],
        center: Tensor,
        config: VelocityFromImagesConfig,
    ):
        device, cameras, self.config = center.device, frames.cameras, config
        clouds = constant(tuple(chosen), device)
        scenes = constant(tuple(particles.clouds.scenes[q] for q in chosen), device)
        chosen_images = images[clouds]
        pixels = frames.images[chosen_images].to(center.dtype)
        moves = is_image[clouds][:, :, None, None, None].to(center.dtype).expand_as(pixels[:, :, :1])
        if frames.dynamic is not None:
            moves = moves * frames.dynamic[chosen_images][:, :, None]
        shown = _smoothed(moves, config.blur)
        colours = _smoothed(pixels / (pixels.sum(2, keepdim=True) + GREY) * moves, config.blur) / shown.clamp(min=SHOWN)
        self._values = torch.cat([colours, *torch.gradient(colours, dim=(4, 3)), shown], 2)
        viewmats = cameras.viewmats[chosen_images].double()
        rotation, start = viewmats[..., :3, :3], (center.double() + particles.origin[scenes][:, None])[..., None]
        way = (rotation @ start)[..., 0] + viewmats[..., :3, 3]
        self._eyes = -(rotation.mT @ way[..., None])[..., 0].to(center.dtype)
        self._rotation, self._way = rotation.to(center.dtype), way.to(center.dtype)
        self._Ks = cameras.Ks[chosen_images].to(center.dtype)

    def faces(self, positions: Tensor, outwards: Tensor) -> Tensor:
        """bool [B, V, S]: whether a surface at ``positions`` [B, S, 3] with normals ``outwards`` faces the cameras."""
        towards = F.normalize(self._eyes[:, :, None] - positions[:, None], dim=3)
        return (towards * outwards[:, None]).sum(3) > self.config.facing

    def colours(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [B, V, S, 3] at ``positions``, and the mask bool [B, V, S] of valid ones."""
        values, _ = self._at(positions)
        return values[..., :3], values[..., 9] > SHOWN

    def slopes(self, positions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`colours`, and the Jacobian of the colours by the positions [B, V, S, 3, 3]."""
        values, at = self._at(positions)
        focal, depth = self._Ks[:, :, None, :2], at[..., 2:]
        nothing = torch.zeros_like(depth)
        across = torch.cat([depth, nothing, -at[..., :1]], 3) * (focal[..., 0, :1] / depth.square())
        down = torch.cat([nothing, depth, -at[..., 1:2]], 3) * (focal[..., 1, 1:2] / depth.square())
        by_pixel = torch.stack([values[..., 3:6], values[..., 6:9]], 4)
        by_place = torch.stack([across, down], 3) @ self._rotation[:, :, None]
        return values[..., :3], values[..., 9] > SHOWN, by_pixel @ by_place

    def _at(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Bilinear samples of the images at ``positions``, and the positions in camera coordinates."""
        at = positions[:, None] @ self._rotation.mT + self._way[:, :, None]
        at = torch.cat([at[..., :2], at[..., 2:].clamp(min=NEAR)], 3)
        pixel = (at @ self._Ks.mT)[..., :2] / at[..., 2:]
        place = torch.stack([2 * pixel[..., k] / self._values.shape[4 - k] - 1 for k in (0, 1)], 3)
        images, places = self._values.flatten(0, 1), place.flatten(0, 1)[:, :, None]
        found = F.grid_sample(images, places, padding_mode="border", align_corners=False)
        return found[..., 0].mT.unflatten(0, place.shape[:2]), at


def _smoothed(images: Tensor, blur: float) -> Tensor:
    """Gaussian blur of images [B, V, C, H, W]."""
    ticks = (torch.arange(n, device=images.device, dtype=images.dtype) for n in images.shape[3:])
    down, across = (((x[:, None] - x).square() * (-0.5 / blur**2)).softmax(1) for x in ticks)
    return down @ images @ across.T
