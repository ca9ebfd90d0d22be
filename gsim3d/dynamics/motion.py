"""How matter has moved: a velocity for every particle, read off clouds whose rows do not correspond."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import RigidFit, onward_at
from gsim3d.dynamics.samples import Padded, Rows, Samples, squares, weights
from gsim3d.state import CloudTable, Particles, constant

PASSES = 3  # in which the window follows the matter, and in which rows are matched
REACH = 0.2  # of the window's length: how far from where it is expected a row is looked for
LIKENESS = 0.12  # how far apart the latents of one place may be, relative to how far they spread
LEAST_SPREAD = 1e-12  # of latents, squared: where all look the same the place alone counts


@torch.no_grad()
def motion(history: Particles, length: float, grid_size: float) -> Tensor:
    """[N, 2, 3] metres a step: how movable matter around each row of the newest clouds moved since the step before it;
    and how the row itself will if it goes on as since the oldest step, turning as it did. 0 of rows that do not move,
    and where there is one step only.

    Of two clouds the means within a Gaussian window are compared. The window lies around a place in the newer cloud,
    and around where that place came from in the older one (mean shift), so that a body that flies as a whole has its
    velocity everywhere, beside others too, and a squeezed one that of its parts. Over the whole history rows are
    matched as well, by place and latents, and the rigid motion that fits the matches in a window tells how it turns.
    All this is done at the nodes of a lattice and interpolated between them: rows have no order (up to ``SAMPLES`` of
    them), and scenes do not see each other.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    matter = Matter.of(history, grid_size, length)
    if matter is None:
        return history.means.new_zeros(0, 2, 3)
    clouds, newest, now = history.clouds, matter.newest, matter.samples
    first = [0, *(q + 1 for q in newest[:-1])]
    before = [max(f, q - 1) for f, q in zip(first, newest, strict=True)]
    with torch.autocast(history.means.device.type, enabled=False):
        last, oldest = (Samples(Rows(Padded(history, chosen, grid_size), history)) for chosen in (before, first))
        for samples in (last, oldest):
            samples.seen_from(matter.here)
        moved, expected = (shift(now, then, matter.nodes, length) for then in (last, oldest))
        looks = tuple(samples.of(history.latents) for samples in (now, oldest))
        velocity, spin, centre = _rigid_motion(matter, oldest, looks, expected, length)
        a_step = share_of_a_step(clouds, before, newest, now, last)
        all_steps = share_of_a_step(clouds, first, newest, now, oldest)
        moved, *rigid = matter.of_rows(moved * a_step, velocity * all_steps, spin * all_steps, centre)
        onward = onward_at(matter.places, *rigid)
        return matter.packed(torch.stack([moved, onward], 2))


def shift(now: Samples, then: Samples, nodes: Tensor, length: float) -> Tensor:
    """[B, G, 3], how far the matter in the window around each node has moved."""
    around = _mean_around(nodes, now, length)
    moved = (now.mean - then.mean)[:, None].expand_as(nodes)
    for _ in range(PASSES):
        moved = around - _mean_around(nodes - moved, then, length)
    return moved


def _mean_around(nodes: Tensor, samples: Samples, length: float) -> Tensor:
    return weights(squares(nodes, samples.places) * (-0.5 / length**2), samples.known) @ samples.places


def _rigid_motion(
    matter: Matter, then: Samples, looks: tuple[Tensor, Tensor], moved: Tensor, length: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, spin (rad) and centre [B, G, 3] of the rigid motion that takes matter in each window from ``then`` to
    now, if it moved about as far as ``moved``. looks: latents of the samples now and then."""
    now = matter.samples
    mean = now.mean_of(looks[0])[:, None]
    look, looked = (x - mean for x in looks)
    spread = now.mean_of(look.square().sum(2, keepdim=True)).clamp(min=LEAST_SPREAD)[:, None]
    unlike = squares(look, looked) * (-0.5 / (LIKENESS**2 * spread))
    body, spin = RigidFit(matter.window, now.places, length), torch.zeros_like(moved)
    for _ in range(PASSES):
        velocity, turns, middle = matter.of_samples(moved, spin, body.centre)
        expected = now.places - velocity - torch.linalg.cross(turns, now.places - middle)
        match = weights(unlike - squares(expected, then.places) * (0.5 / (REACH * length) ** 2), then.known)
        moved, spin = body.fit(now.places - match @ then.places)
    return moved, spin, body.centre


def share_of_a_step(clouds: CloudTable, earlier: list[int], newest: list[int], now: Samples, then: Samples) -> Tensor:
    """[B, 1, 1], one over the steps between two clouds; 0 where they are one, or one of them has nothing that moves."""
    gaps = tuple(clouds.steps[q] - clouds.steps[e] for q, e in zip(newest, earlier, strict=True))
    gaps = constant(gaps, now.n.device)
    known = (gaps > 0) & (now.n > 0) & (then.n > 0)
    return (known / gaps.clamp(min=1))[:, None, None].to(now.places.dtype)
