"""How encoded matter moves: its newest particles are found again in older images."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.cameras import Frames
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.motion import share_of_a_step, shift
from gsim3d.dynamics.rigid import onward_at, solved
from gsim3d.dynamics.samples import Padded, Rows, Samples
from gsim3d.state import CloudTable, Particles, constant, newest_clouds

PASSES = 5
BLUR = 1.0  # pixels: standard deviation of the window in which images are smoothed
FACING = 0.6  # least cosine between where matter faces and a camera that it is looked for in
SHOWN = 0.9  # share of a window of pixels that must show what moves
ROBUST = 0.02  # differences of colours, from which on they count as if they were as small
STIFF, STILL = 1e-4, 0.3  # against turning, and against leaving the way of the means, relative to what is seen
GREY = 0.02  # added to the sum that a colour is divided by
INSIDE = 0.02  # metres: rows are encoded so far below the surface that images show, which turns on a larger circle
LEAST = 1e-8  # of what is seen: where nothing is, nothing is solved
NEAR = 0.01  # metres, from a camera


@torch.no_grad()
def follow(
    particles: Particles,
    frames: Frames,
    length: float,
    grid_size: float,
    n_steps: int,
    n_views: int | None = None,
    falls: Tensor | None = None,
) -> Tensor:
    """[N, 3] metres a step, how movable rows of each scene's newest cloud moved on average since the oldest of its
    history, or with ``falls`` in their last step; 0 of others, and where there is one step only.

    The rigid motion of each Gaussian window of matter is the one with which its rows have in the oldest images, at the
    places where they were, the colours that they have in the newest (Lucas and Kanade, in all cameras at once): colours
    divided by their sum, which do not change as a body turns in white light. It is found at the nodes of a lattice,
    beginning with how far the means moved, and with the spin that is found likewise in the images of the last step:
    since the oldest a body may have turned too far to be found again. Scenes do not see each other.

    Args:
        particles: ``frames`` encoded, clouds sorted by (scene, step). Views of the newest and the oldest step are
            compared in the order of their images: best those of the same camera.
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
        n_steps: of a history; older clouds are not looked at.
        n_views: of every cloud, whose images follow each other, cloud by cloud; nothing then waits for the device.
        falls: [N, 3] metres a step, of every step, of the rows of the newest clouds, packed: they are faster at last
            than on average. None: nothing falls.
    """
    clouds, newest = particles.clouds, newest_clouds(particles.clouds)
    result = torch.zeros_like(particles.means)
    first = [_oldest(clouds, begin, q, n_steps) for begin, q in zip([0, *(q + 1 for q in newest)], newest)]
    if first == newest or not any(clouds.count(q) for q in newest):
        return result
    with torch.autocast(particles.means.device.type, enabled=False):
        matter = Matter(particles, grid_size, length)
        now, images = matter.samples, _images(frames, len(clouds), n_views)
        seen = _Views(frames, particles, *images, newest, matter.here)
        centre = matter.window @ now.places
        spin = torch.zeros_like(centre)  # a step
        for earlier in ([max(f, q - 1) for f, q in zip(first, newest)], first):
            then = Samples(Rows(Padded(particles, earlier, grid_size), particles))
            then.seen_from(matter.here)
            before = _Views(frames, particles, *images, earlier, matter.here)
            spans = constant(tuple(clouds.steps[q] - clouds.steps[e] for e, q in zip(earlier, newest)), spin.device)
            begin = shift(now, then, matter.nodes, length), spans[:, None, None] * spin
            a_step = share_of_a_step(clouds, earlier, newest, now, then)
            velocity, spin = (x * a_step for x in _aligned(matter, centre, *begin, seen, before))
        velocity, spin, middle = matter.of_rows(velocity, spin, centre)
        found = -onward_at(matter.places, -velocity, -spin, middle)
        if falls is not None:
            spans = [clouds.steps[q] - clouds.steps[f] for f, q in zip(first, newest)]
            later = constant(tuple(max(0, span - 1) for span in spans), found.device)
            found = found + 0.5 * later[:, None, None] * matter.padded(falls)
        found = matter.packed(found)
    for q, part in zip(newest, found.split([clouds.count(q) for q in newest]), strict=True):
        result[clouds.starts[q] : clouds.starts[q + 1]] = part
    return result


def _oldest(clouds: CloudTable, begin: int, newest: int, n_steps: int) -> int:
    """Of the clouds from ``begin`` to ``newest`` the first that is less than ``n_steps`` steps older than the last."""
    return next(q for q in range(begin, newest + 1) if clouds.steps[newest] - clouds.steps[q] < n_steps)


def _aligned(
    matter: Matter, centre: Tensor, velocity: Tensor, spin: Tensor, seen: _Views, before: _Views
) -> tuple[Tensor, Tensor]:
    """Velocity and spin (rad) [B, G, 3] of each window since an earlier step, beginning with those that are given."""
    now, window = matter.samples, matter.window
    places = now.places
    outwards = F.normalize(places - matter.of_samples(centre)[0], dim=2)
    places = places + INSIDE * outwards
    wanted = []
    for view in range(seen.n_views):
        colours, is_shown = seen.colours(view, places)
        wanted.append((colours, now.known & is_shown & seen.faces(view, places, outwards)))
    for _ in range(PASSES):
        gone, turned, middle = matter.of_samples(velocity, spin, centre)
        back = places + onward_at(places, -gone, -turned, middle)
        squared, missed = back.new_zeros(*back.shape[:2], 6, 6), back.new_zeros(*back.shape[:2], 6)
        for view, (colours, is_shown) in enumerate(wanted):
            found, was_shown, slopes = before.slopes(view, back)
            off, counts = colours - found, is_shown & was_shown & before.faces(view, back, outwards)
            counts = counts * (ROBUST / off.norm(dim=2).clamp(min=ROBUST))
            by_spin = torch.linalg.cross(slopes, (back + gone - middle)[:, :, None].expand_as(slopes))
            by_motion = torch.cat([by_spin, -slopes], 3)
            squared = squared + counts[..., None, None] * (by_motion.mT @ by_motion)
            missed = missed + counts[..., None] * (by_motion * off[..., None]).sum(2)
        change = _solved((window @ squared.flatten(2)).unflatten(2, (6, 6)), window @ missed)
        spin, velocity = spin + change[..., :3], velocity + change[..., 3:]
    return velocity, spin


def _solved(matrices: Tensor, values: Tensor) -> Tensor:
    """[B, G, 6] of [B, G, 6, 6] and [B, G, 6], turns before ways: the turns are eliminated, so that a graph can capture
    it."""
    size = matrices.diagonal(dim1=2, dim2=3).mean(2)[..., None, None] + LEAST
    one = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    turns, mixed, ways = matrices[..., :3, :3], matrices[..., :3, 3:], matrices[..., 3:, 3:]
    turns, ways = turns + STIFF * size * one, ways + STILL * size * one
    by_way = solved(turns[..., None, :, :], mixed.mT)  # [B, G, 3, 3], rows: of each way
    by_value = solved(turns, values[..., :3])
    way = solved(ways - by_way @ mixed, values[..., 3:] - (mixed.mT @ by_value[..., None])[..., 0])
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
    """Images of the clouds ``chosen``, one for each scene: colours of what moves, divided by their sum and smoothed.
    Places count from ``here`` [B, 1, 3], which counts from the origins."""

    def __init__(
        self, frames: Frames, particles: Particles, images: Tensor, is_image: Tensor, chosen: list[int], here: Tensor
    ):
        device, cameras = here.device, frames.cameras
        clouds = constant(tuple(chosen), device)
        scenes = constant(tuple(particles.clouds.scenes[q] for q in chosen), device)
        chosen_images = images[clouds]
        self.n_views = images.shape[1]
        pixels = frames.images[chosen_images].to(here.dtype)
        moves = is_image[clouds][:, :, None, None, None].to(here.dtype).expand_as(pixels[:, :, :1])
        if frames.dynamic is not None:
            moves = moves * frames.dynamic[chosen_images][:, :, None]
        shown = _smoothed(moves)
        colours = _smoothed(pixels / (pixels.sum(2, keepdim=True) + GREY) * moves) / shown.clamp(min=SHOWN)
        self._values = torch.cat([colours, _slope(colours, 4), _slope(colours, 3), shown], 2)
        viewmats = cameras.viewmats[chosen_images].double()
        rotation, start = viewmats[..., :3, :3], (here.double() + particles.origin[scenes][:, None])[..., None]
        way = (rotation @ start)[..., 0] + viewmats[..., :3, 3]
        self._eyes = -(rotation.mT @ way[..., None])[..., 0].to(here.dtype)
        self._rotation, self._way = rotation.to(here.dtype), way.to(here.dtype)
        self._Ks = cameras.Ks[chosen_images].to(here.dtype)

    def faces(self, view: int, places: Tensor, outwards: Tensor) -> Tensor:
        """bool [B, S], whether what is at ``places`` faces the camera."""
        towards = F.normalize(self._eyes[:, view, None] - places, dim=2)
        return (towards * outwards).sum(2) > FACING

    def colours(self, view: int, places: Tensor) -> tuple[Tensor, Tensor]:
        """[B, S, 3] at ``places``, and bool [B, S], where there is one."""
        values, _ = self._at(view, places)
        return values[..., :3], values[..., 9] > SHOWN

    def slopes(self, view: int, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`colours`; and [B, S, 3, 3], how each colour changes by the place."""
        values, at = self._at(view, places)
        K, depth = self._Ks[:, view], at[..., 2:]
        nothing = torch.zeros_like(depth)
        across = torch.cat([depth, nothing, -at[..., :1]], 2) * (K[:, :1, :1] / depth.square())
        down = torch.cat([nothing, depth, -at[..., 1:2]], 2) * (K[:, 1:2, 1:2] / depth.square())
        by_pixel = torch.stack([values[..., 3:6], values[..., 6:9]], 3)
        by_place = torch.stack([across, down], 2) @ self._rotation[:, view, None]
        return values[..., :3], values[..., 9] > SHOWN, by_pixel @ by_place

    def _at(self, view: int, places: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the pixels that show ``places``, and the places as the camera sees them."""
        at = places @ self._rotation[:, view].mT + self._way[:, view, None]
        at = torch.cat([at[..., :2], at[..., 2:].clamp(min=NEAR)], 2)
        pixel = (at @ self._Ks[:, view].mT)[..., :2] / at[..., 2:]
        values = self._values[:, view]
        place = torch.stack([2 * pixel[..., k] / values.shape[3 - k] - 1 for k in (0, 1)], 2)
        found = F.grid_sample(values, place[:, :, None], padding_mode="border", align_corners=False)
        return found[..., 0].mT, at


def _smoothed(images: Tensor) -> Tensor:
    """[B, V, C, H, W] in a Gaussian window."""
    ticks = (torch.arange(n, device=images.device, dtype=images.dtype) for n in images.shape[3:])
    down, across = (((x[:, None] - x).square() * (-0.5 / BLUR**2)).softmax(1) for x in ticks)
    return down @ images @ across.T


def _slope(images: Tensor, axis: int) -> Tensor:
    """Differences over two pixels, halved; at the border over one."""
    return torch.gradient(images, dim=axis)[0]
