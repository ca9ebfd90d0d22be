"""How bodies are bent: the way from each particle to where it would be had the matter around it kept its shape."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import turned_most
from gsim3d.state import Particles, constant, take_runs, with_attribute

DEFORMATION_CHANNELS = 3


@torch.no_grad()
def deformation(history: Particles, length: float, grid_size: float, matter: Matter | None = None) -> Tensor:
    """[N, 3] metres, from each movable row of the newest clouds to where it would be if the matter in a Gaussian window
    around it had only moved and turned since ``history.rest_positions``; 0 of other rows.

    What pulls an elastic body back is a function of it, and a history of a few steps does not tell it: a body that is
    squeezed looks like one that was made so.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``, with windows of that length; None: found here.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    matter = matter or Matter.of(history, grid_size, length)
    if matter is None:
        return history.means.new_zeros(0, 3)
    clouds = history.clouds
    reference = take_runs(with_attribute(history, "rest_positions").rest_positions, clouds.row_runs(matter.newest))
    with torch.autocast(reference.device.type, enabled=False):
        scenes = constant(tuple(clouds.scenes[q] for q in matter.newest), reference.device)
        before = (matter.padded(reference).double() - history.origin[scenes][:, None]).to(reference.dtype)
        way = Shape(matter, before).way_back(matter.places, matter.samples.places)
        return matter.packed(way)


class Shape:
    """The shape that ``matter`` had where its rows were at ``before`` [B, M, 3], from the origins of their scenes."""

    def __init__(self, matter: Matter, before: Tensor):
        now = matter.samples
        self._matter, then = matter, now.take(before)
        there = now.mean_of(then)[:, None]
        self._then = torch.where(now.known[:, :, None], then - there, 0)
        self._before = before - there

    def way_back(self, places: Tensor, sampled: Tensor) -> Tensor:
        """[B, M, 3], from each of the rows' ``places`` [B, M, 3] to where it would be in that shape, moved and turned
        as the matter around it, whose samples are at ``sampled`` [B, S, 3]. Windows are those of ``matter``."""
        window, then = self._matter.window, self._then
        centre, began = window @ sampled, window @ then
        products = window @ (sampled[:, :, :, None] * then[:, :, None]).flatten(2)
        turns = turned_most(products.unflatten(2, (3, 3)) - centre[:, :, :, None] * began[:, :, None])
        shifts = centre - (turns @ began[:, :, :, None])[..., 0]
        *columns, shift = self._matter.of_rows(*turns.unbind(3), shifts)
        return (torch.stack(columns, 3) @ self._before[:, :, :, None])[..., 0] + shift - places
