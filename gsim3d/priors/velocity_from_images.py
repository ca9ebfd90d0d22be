"""Velocity from images: encoded particles are found again in older images, and the motion between is their velocity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.cameras import Frames
from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Windows
from gsim3d.priors.padding import PaddedClouds, Samples, Subset, squared_distances, weights
from gsim3d.priors.rigid import next_displacement, solve3
from gsim3d.state import CloudTable, Particles, constant

PASSES = 5  # of the alignment
SHIFT_PASSES = 3  # in which a window follows its particles from cloud to cloud
SHOWN = 0.9  # share of a window of pixels that must show movable particles
STIFF, STILL = 1e-4, 0.3  # against turning, and against leaving the displacement of the means, relative to what is seen
GREY = 0.02  # added to the sum that a colour is divided by
LEAST = 1e-8  # of what is seen: where nothing is, nothing is solved
NEAR = 0.01  # metres, from a camera


@dataclass(frozen=True)
class VelocityFromImagesConfig(PriorConfig):
    """Photometric alignment of rigid motions.

    Attributes:
        radius: metres, standard deviation of the windows that move as one; about the radius of a body.
        blur: pixels, standard deviation of the window in which images are smoothed.
        facing: least cosine between where a surface faces and a camera in which it is looked for.
        robust: differences of colours, from which on they count as if they were as small.
        inside: metres: particles are encoded so far below the surface that images show, which turns on a larger circle.
    """

    type = "velocity_from_images"
    radius: float = 0.3
    blur: float = 1.0
    facing: float = 0.6
    robust: float = 0.02
    inside: float = 0.02

    RANGES = {"radius": (1e-6, 1e6), "blur": (1e-3, 100), "facing": (-1, 1), "robust": (1e-6, 10), "inside": (0, 1e6)}


class VelocityFromImages(Prior, config=VelocityFromImagesConfig):
    """Gives encoded particles their ``velocity``: of the newest cloud the mean displacement a step since the oldest of
    its history or, in a model with gravity, that of the last step; 0 for others.

    The rigid motion of each window is the one with which its particles have in the oldest images, where they were, the
    colours that they have in the newest, in all cameras together. Colours are divided by their sum, which does not
    change as a body turns in white light. Alignment begins with the displacement of the means, and with the spin found
    in the images of the last step: since the oldest a body may have turned too far to be found again.

    Source:
        Lucas and Kanade 1981.
    """

    attributes = ("velocity",)

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        if frames is None:
            return particles
        gravity = ctx.priors.get("gravity")
        fall = None if gravity is None or ctx.is_empty else gravity.fall(ctx)
        velocity = estimate_velocity(ctx, frames, self.config, fall)
        return replace(particles, velocity=velocity)


@torch.no_grad()
def estimate_velocity(
    ctx: StepContext, frames: Frames, config: VelocityFromImagesConfig, fall: Tensor | None = None
) -> Tensor:
    """The velocity of encoded particles. Scenes do not see each other.

    Args:
        ctx: of ``frames`` encoded. Views of the newest and the oldest step are compared in the order of their images:
            best those of the same camera.
        frames: with ``ctx.n_views`` images of each cloud, one cloud after another; nothing then waits for the device.
        config: of the prior.
        fall: [N, 3] metres a step squared, of the newest particles: they are faster at last than on average.
    Returns:
        [M, 3] metres a step, of all particles; 0 for those of older clouds, and where there is one step only.
    """
    particles, clouds, newest = ctx.history, ctx.history.clouds, ctx.newest
    result = torch.zeros_like(particles.means)
    first = [_oldest(clouds, begin, q, ctx.max_steps) for begin, q in zip([0, *(q + 1 for q in newest)], newest)]
    if first == newest or ctx.is_empty:
        return result
    with torch.autocast(particles.means.device.type, enabled=False):
        movable = ctx.movable
        windows = Windows(movable, particles, config.radius, evenly=False)
        now, images = movable.samples, _images(frames, len(clouds), ctx.n_views)
        seen = _Views(frames, particles, *images, newest, movable.center, config)
        center = windows.weights @ now.positions
        spin = torch.zeros_like(center)  # a step
        for earlier in ([max(f, q - 1) for f, q in zip(first, newest)], first):
            then = Samples(Subset(PaddedClouds(particles, earlier, ctx.grid_size), particles))
            then.center(movable.center)
            before = _Views(frames, particles, *images, earlier, movable.center, config)
            spans = constant(tuple(clouds.steps[q] - clouds.steps[e] for e, q in zip(earlier, newest)), spin.device)
            begin = _shift(now, then, windows.nodes, config.radius), spans[:, None, None] * spin
            a_step = _per_step(clouds, earlier, newest, now, then)
            velocity, spin = (x * a_step for x in _align(windows, center, *begin, seen, before, config))
        velocity, spin, middle = windows.to_particles(velocity, spin, center)
        found = -next_displacement(movable.positions, -velocity, -spin, middle)
        if fall is not None:
            spans = [clouds.steps[q] - clouds.steps[f] for f, q in zip(first, newest)]
            later = constant(tuple(max(0, span - 1) for span in spans), found.device)
            found = found + 0.5 * later[:, None, None] * movable.padded(fall)
        found = movable.packed(found)
    for q, part in zip(newest, found.split([clouds.count(q) for q in newest]), strict=True):
        result[clouds.starts[q] : clouds.starts[q + 1]] = part
    return result


def _oldest(clouds: CloudTable, begin: int, newest: int, n_steps: int) -> int:
    """Of the clouds from ``begin`` to ``newest`` the first that is less than ``n_steps`` steps older than the last."""
    return next(q for q in range(begin, newest + 1) if clouds.steps[newest] - clouds.steps[q] < n_steps)


def _align(
    windows: Windows,
    center: Tensor,
    velocity: Tensor,
    spin: Tensor,
    seen: _Views,
    before: _Views,
    config: VelocityFromImagesConfig,
) -> tuple[Tensor, Tensor]:
    """Velocity and spin (rad) [B, G, 3] of each window since an earlier step, beginning with those that are given."""
    now, window = windows.movable.samples, windows.weights
    outwards = F.normalize(now.positions - windows.to_samples(center)[0], dim=2)
    positions = now.positions + config.inside * outwards
    wanted = []
    for view in range(seen.n_views):
        colours, is_shown = seen.colours(view, positions)
        wanted.append((colours, now.known & is_shown & seen.faces(view, positions, outwards)))
    for _ in range(PASSES):
        gone, turned, middle = windows.to_samples(velocity, spin, center)
        back = positions + next_displacement(positions, -gone, -turned, middle)
        squared, missed = back.new_zeros(*back.shape[:2], 6, 6), back.new_zeros(*back.shape[:2], 6)
        for view, (colours, is_shown) in enumerate(wanted):
            found, was_shown, slopes = before.slopes(view, back)
            off, counts = colours - found, is_shown & was_shown & before.faces(view, back, outwards)
            counts = counts * (config.robust / off.norm(dim=2).clamp(min=config.robust))
            by_spin = torch.linalg.cross(slopes, (back + gone - middle)[:, :, None].expand_as(slopes))
            by_motion = torch.cat([by_spin, -slopes], 3)
            squared = squared + counts[..., None, None] * (by_motion.mT @ by_motion)
            missed = missed + counts[..., None] * (by_motion * off[..., None]).sum(2)
        change = _solve6((window @ squared.flatten(2)).unflatten(2, (6, 6)), window @ missed)
        spin, velocity = spin + change[..., :3], velocity + change[..., 3:]
    return velocity, spin


def _solve6(matrices: Tensor, values: Tensor) -> Tensor:
    """[B, G, 6] of [B, G, 6, 6] and [B, G, 6], turns before ways: the turns are eliminated, so that a graph can capture
    it."""
    size = matrices.diagonal(dim1=2, dim2=3).mean(2)[..., None, None] + LEAST
    one = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    turns, mixed, ways = matrices[..., :3, :3], matrices[..., :3, 3:], matrices[..., 3:, 3:]
    turns, ways = turns + STIFF * size * one, ways + STILL * size * one
    by_way = solve3(turns[..., None, :, :], mixed.mT)  # [B, G, 3, 3], rows: of each way
    by_value = solve3(turns, values[..., :3])
    way = solve3(ways - by_way @ mixed, values[..., 3:] - (mixed.mT @ by_value[..., None])[..., 0])
    return torch.cat([by_value - (by_way.mT @ way[..., None])[..., 0], way], 2)


def _images(frames: Frames, n_clouds: int, n_views: int | None) -> tuple[Tensor, Tensor]:
    """int64 [Q, V], images of each cloud; bool [Q, V], where there is one."""
    of_images = frames.cameras.image_cloud
    if n_views is not None:
        images = torch.arange(n_clouds * n_views, device=of_images.device).unflatten(0, (n_clouds, n_views))
        return images, torch.ones_like(images, dtype=torch.bool)
    counts, order = torch.bincount(of_images, minlength=n_clouds), torch.argsort(of_images, stable=True)
    place = torch.arange(int(counts.max()), device=of_images.device)
    begin = counts.cumsum(0) - counts
    return order[(begin[:, None] + place).clamp(max=len(order) - 1)], place < counts[:, None]


class _Views:
    """Images of the clouds ``chosen``, one for each scene: colours of movable particles, divided by their sum and
    smoothed. Positions count from ``center`` [B, 1, 3], which counts from the origins."""

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
        device, cameras, self._facing = center.device, frames.cameras, config.facing
        clouds = constant(tuple(chosen), device)
        scenes = constant(tuple(particles.clouds.scenes[q] for q in chosen), device)
        chosen_images = images[clouds]
        self.n_views = images.shape[1]
        pixels = frames.images[chosen_images].to(center.dtype)
        moves = is_image[clouds][:, :, None, None, None].to(center.dtype).expand_as(pixels[:, :, :1])
        if frames.dynamic is not None:
            moves = moves * frames.dynamic[chosen_images][:, :, None]
        shown = _smoothed(moves, config.blur)
        colours = _smoothed(pixels / (pixels.sum(2, keepdim=True) + GREY) * moves, config.blur) / shown.clamp(min=SHOWN)
        self._values = torch.cat([colours, _slope(colours, 4), _slope(colours, 3), shown], 2)
        viewmats = cameras.viewmats[chosen_images].double()
        rotation, start = viewmats[..., :3, :3], (center.double() + particles.origin[scenes][:, None])[..., None]
        way = (rotation @ start)[..., 0] + viewmats[..., :3, 3]
        self._eyes = -(rotation.mT @ way[..., None])[..., 0].to(center.dtype)
        self._rotation, self._way = rotation.to(center.dtype), way.to(center.dtype)
        self._Ks = cameras.Ks[chosen_images].to(center.dtype)

    def faces(self, view: int, positions: Tensor, outwards: Tensor) -> Tensor:
        """bool [B, S], whether what is at ``positions`` faces the camera."""
        towards = F.normalize(self._eyes[:, view, None] - positions, dim=2)
        return (towards * outwards).sum(2) > self._facing

    def colours(self, view: int, positions: Tensor) -> tuple[Tensor, Tensor]:
        """[B, S, 3] at ``positions``, and bool [B, S], where there is one."""
        values, _ = self._at(view, positions)
        return values[..., :3], values[..., 9] > SHOWN

    def slopes(self, view: int, positions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`colours`; and [B, S, 3, 3], how each colour changes by the place."""
        values, at = self._at(view, positions)
        K, depth = self._Ks[:, view], at[..., 2:]
        nothing = torch.zeros_like(depth)
        across = torch.cat([depth, nothing, -at[..., :1]], 2) * (K[:, :1, :1] / depth.square())
        down = torch.cat([nothing, depth, -at[..., 1:2]], 2) * (K[:, 1:2, 1:2] / depth.square())
        by_pixel = torch.stack([values[..., 3:6], values[..., 6:9]], 3)
        by_place = torch.stack([across, down], 2) @ self._rotation[:, view, None]
        return values[..., :3], values[..., 9] > SHOWN, by_pixel @ by_place

    def _at(self, view: int, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the pixels that show ``positions``, and the positions as the camera sees them."""
        at = positions @ self._rotation[:, view].mT + self._way[:, view, None]
        at = torch.cat([at[..., :2], at[..., 2:].clamp(min=NEAR)], 2)
        pixel = (at @ self._Ks[:, view].mT)[..., :2] / at[..., 2:]
        values = self._values[:, view]
        place = torch.stack([2 * pixel[..., k] / values.shape[3 - k] - 1 for k in (0, 1)], 2)
        found = F.grid_sample(values, place[:, :, None], padding_mode="border", align_corners=False)
        return found[..., 0].mT, at


def _smoothed(images: Tensor, blur: float) -> Tensor:
    """[B, V, C, H, W] in a Gaussian window."""
    ticks = (torch.arange(n, device=images.device, dtype=images.dtype) for n in images.shape[3:])
    down, across = (((x[:, None] - x).square() * (-0.5 / blur**2)).softmax(1) for x in ticks)
    return down @ images @ across.T


def _slope(images: Tensor, axis: int) -> Tensor:
    """Differences over two pixels, halved; at the border over one."""
    return torch.gradient(images, dim=axis)[0]


def _shift(now: Samples, then: Samples, nodes: Tensor, length: float) -> Tensor:
    """[B, G, 3], how far the particles in the window around each node have moved."""
    around = _mean_around(nodes, now, length)
    moved = (now.mean - then.mean)[:, None].expand_as(nodes)
    for _ in range(SHIFT_PASSES):
        moved = around - _mean_around(nodes - moved, then, length)
    return moved


def _mean_around(nodes: Tensor, samples: Samples, length: float) -> Tensor:
    return weights(squared_distances(nodes, samples.positions) * (-0.5 / length**2), samples.known) @ samples.positions


def _per_step(clouds: CloudTable, earlier: list[int], newest: list[int], now: Samples, then: Samples) -> Tensor:
    """[B, 1, 1], one over the steps between two clouds; 0 where they are one or one has no movable particle."""
    gaps = tuple(clouds.steps[q] - clouds.steps[e] for q, e in zip(newest, earlier, strict=True))
    gaps = constant(gaps, now.n.device)
    known = (gaps > 0) & (now.n > 0) & (then.n > 0)
    return (known / gaps.clamp(min=1))[:, None, None].to(now.positions.dtype)
