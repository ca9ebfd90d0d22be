"""How matter has moved: a velocity for every particle, read off clouds whose rows do not correspond."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from torch import Tensor

from gsim3d.dynamics.clouds import newest_clouds
from gsim3d.dynamics.rigid import Lattice, RigidFit, onward_at, solved
from gsim3d.dynamics.samples import Rows, Samples, squares, weights
from gsim3d.types import CloudTable, Particles, constant

PASSES = 3  # in which the window follows the matter, and in which rows are matched
REACH = 0.2  # of the window's length: how far from where it is expected a row is looked for
FINE = 0.1  # of the window's length: Gaussian windows in which looks are compared; a cell at least
PLAIN = 0.03  # squares of looks by radian, added to those of a body: one without any paint does not turn
LIKENESS = 0.12  # how far apart the latents of one place may be, relative to how far they spread
LEAST_SPREAD = 1e-12  # of latents, squared: where all look the same the place alone counts


def motion(history: Particles, length: float, grid_size: float, looks: Tensor | None = None) -> Tensor:
    """[N, 2, 3] metres a step: how movable matter around each row of the newest clouds moved since the step before it;
    and how the row itself will if it goes on as since the oldest step, turning as it did. 0 of rows that do not move,
    and where there is one step only.

    Of two clouds the means within a Gaussian window are compared. The window lies around a place in the newer cloud,
    and around where that place came from in the older one (mean shift), so that a body that flies as a whole has its
    velocity everywhere, beside others too, and a squeezed one that of its parts. How it turns is found in what it looks
    like over the whole history: the turn of a window that leaves the fewest differences. All this is done at the nodes
    of a lattice and interpolated between them: rows have no order (up to ``SAMPLES`` of them), and scenes do not see
    each other.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
        looks: [C, latents], what matter looks like by its latents. These change as it turns in the light, what of them
            does not must be learned. None: rows with like latents are matched.
    Returns:
        Rows of the newest clouds, packed. Gradients: of ``looks``.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    if not any(clouds.count(q) for q in newest):
        return history.means.new_zeros(0, 2, 3)
    first = [0, *(q + 1 for q in newest[:-1])]
    before = [max(f, q - 1) for f, q in zip(first, newest, strict=True)]
    with torch.autocast(history.means.device.type, enabled=False):
        with torch.no_grad():
            now, last, oldest = (Samples(history, chosen, grid_size) for chosen in (newest, before, first))
            here = now.mean[:, None]
            for samples in (now, last, oldest):
                samples.seen_from(here)
            lattice = Lattice(now.places, now.known)
            window = weights(squares(lattice.nodes, now.places) * (-0.5 / length**2), now.known)
            moved, velocity = (_shift(now, then, lattice.nodes, window, length) for then in (last, oldest))
            a_step, all_steps = _share(clouds, before, newest, now, last), _share(clouds, first, newest, now, oldest)
            rows = Rows(history, newest, grid_size)
            places = rows.places - here
        if looks is None:
            velocity, spin, centre = _matched(now, oldest, lattice, window, velocity, length)
        else:
            centre = window @ now.places
            fine = max(FINE * length, grid_size)  # between rows that are farther apart nothing is known of slopes
            spin = _turned(now, oldest, lattice, window, velocity, centre, fine, looks)
        moved, *rigid = lattice.at(places, moved * a_step, velocity * all_steps, spin * all_steps, centre)
        onward = onward_at(places, *rigid)
        result = torch.where(rows.wanted[:, :, None, None], torch.stack([moved, onward], 2), 0)
    return torch.cat([result[b, : clouds.count(q)] for b, q in enumerate(newest)])


def _shift(now: Samples, then: Samples, nodes: Tensor, window: Tensor, length: float) -> Tensor:
    """[B, G, 3], how far the matter in the window around each node has moved."""
    around = window @ now.places
    moved = (now.mean - then.mean)[:, None].expand_as(nodes)
    for _ in range(PASSES):
        moved = around - weights(squares(nodes - moved, then.places) * (-0.5 / length**2), then.known) @ then.places
    return moved


@torch.no_grad()
def _matched(
    now: Samples, then: Samples, lattice: Lattice, window: Tensor, moved: Tensor, length: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, spin (rad) and centre [B, G, 3] of the rigid motion that takes matter in each window from ``then`` to
    ``now``, if it moved about as far as ``moved``."""
    mean = now.mean_of(now.latents)[:, None]
    looks, looked = now.latents - mean, then.latents - mean
    spread = now.mean_of(looks.square().sum(2, keepdim=True)).clamp(min=LEAST_SPREAD)[:, None]
    unlike = squares(looks, looked) * (-0.5 / (LIKENESS**2 * spread))
    body, spin = RigidFit(window, now.places, length), torch.zeros_like(moved)
    for _ in range(PASSES):
        velocity, turns, middle = lattice.at(now.places, moved, spin, body.centre)
        expected = now.places - velocity - torch.linalg.cross(turns, now.places - middle)
        match = weights(unlike - squares(expected, then.places) * (0.5 / (REACH * length) ** 2), then.known)
        moved, spin = body.fit(now.places - match @ then.places)
    return moved, spin, body.centre


def _turned(
    now: Samples,
    then: Samples,
    lattice: Lattice,
    window: Tensor,
    velocity: Tensor,
    centre: Tensor,
    fine: float,
    looks: Tensor,
) -> Tensor:
    """Spin (rad) [B, G, 3] of matter in each window that moved by ``velocity`` from ``then`` to ``now``, about its
    ``centre``: that with which it looked then, at the places where it was, as it looks now, in Gaussian windows of
    ``fine`` metres (Lucas and Kanade, of clouds). The last pass has a gradient.
    """
    seen, before = (samples.latents @ looks.T for samples in (now, then))
    mean = now.mean_of(seen)[:, None]
    spread = now.mean_of((seen - mean).square().sum(2, keepdim=True)).clamp(min=LEAST_SPREAD)[:, None].sqrt()
    seen, before = (seen - mean) / spread, (before - mean) / spread
    places, plain = now.places, PLAIN * torch.eye(3, device=centre.device, dtype=centre.dtype)
    seen, _ = _field(places, now, seen, fine)
    spin = torch.zeros_like(centre)
    for n in range(PASSES):
        with torch.no_grad() if n + 1 < PASSES else nullcontext():
            gone, turned, middle = lattice.at(places, velocity, spin, centre)
            back = places + onward_at(places, -gone, -turned, middle)
            found, slopes = _field(back, then, before, fine)
            by_spin = torch.linalg.cross(slopes, (back + gone - middle)[:, :, None].expand_as(slopes))
            squared = (by_spin.mT @ by_spin).flatten(2)
            missed = (by_spin * (seen - found)[..., None]).sum(2)
            spin = spin + solved((window @ squared).unflatten(2, (3, 3)) + plain, window @ missed)
    return spin


def _field(at: Tensor, samples: Samples, values: Tensor, length: float) -> tuple[Tensor, Tensor]:
    """``values`` [B, S, C] of the samples in a Gaussian window around each of ``at`` [B, Q, 3], and their slopes
    [B, Q, C, 3] there."""
    with torch.no_grad():
        near = weights(squares(at, samples.places) * (-0.5 / length**2), samples.known)
        around = near @ samples.places
    products = values[:, :, :, None] * samples.places[:, :, None]
    mean = near @ values
    slopes = (near @ products.flatten(2)).unflatten(2, products.shape[2:]) - mean[..., None] * around[:, :, None]
    return mean, slopes / length**2


def _share(clouds: CloudTable, earlier: list[int], newest: list[int], now: Samples, then: Samples) -> Tensor:
    """[B, 1, 1], one over the steps between two clouds; 0 where they are one, or one of them has nothing that moves."""
    gaps = tuple(clouds.steps[q] - clouds.steps[e] for q, e in zip(newest, earlier, strict=True))
    gaps = constant(gaps, now.n.device)
    known = (gaps > 0) & (now.n > 0) & (then.n > 0)
    return (known / gaps.clamp(min=1))[:, None, None].to(now.places.dtype)
