"""Scenes of one batch that call for different effects: one plan each, and each is computed as if it were alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.dynamics import concatenate
from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError
from gsim3d.ops.raster import Rendering
from gsim3d.simulator import Simulator
from gsim3d.state import Particles


def rollout_by_scene(
    simulator: Simulator, state: Particles, n_steps: int, plans: Sequence[Plan], **options
) -> list[Particles]:
    """:meth:`Simulator.rollout` with a plan for each scene; scenes whose plans are equal share their calls.

    Args:
        plans: as many as ``state.origin`` has scenes.
        options: as of :meth:`Simulator.rollout`.
    """
    parts = [
        simulator.rollout(state.select_clouds(clouds), n_steps, plan, **options)
        for plan, clouds in _groups(state, plans)
    ]
    return [concatenate(step) for step in zip(*parts, strict=True)]


def render_by_scene(
    simulator: Simulator,
    particles: Particles,
    cameras: Cameras,
    background: Tensor | None,
    plans: Sequence[Plan],
    **options,
) -> Rendering:
    """:meth:`Simulator.render` with a plan for each scene.

    Raises:
        InputError: the plans ask for different images.
    """
    if len({plan.spec.outputs for plan in plans}) > 1:
        raise InputError("plans: those of one batch must ask for the same images (outputs)")
    shown, order, images = cameras.image_cloud.tolist(), [], []
    for plan, clouds in _groups(particles, plans):
        rows = [i for i, cloud in enumerate(shown) if cloud in clouds]
        places = torch.tensor([clouds.index(shown[i]) for i in rows], device=cameras.image_cloud.device)
        chosen = torch.tensor(rows, device=cameras.near.device, dtype=torch.int64)
        behind = background if background is None or background.dim() == 1 else background[chosen]
        selected = cameras.select(chosen, places.to(torch.int64))
        images.append(simulator.render(particles.select_clouds(clouds), selected, behind, plan, **options))
        order += rows
    back = torch.argsort(torch.tensor(order, device=cameras.near.device))
    fields = zip(*images, strict=True)
    return Rendering(*(None if parts[0] is None else torch.cat(parts)[back] for parts in fields))


def _groups(particles: Particles, plans: Sequence[Plan]) -> Iterator[tuple[Plan, list[int]]]:
    """Each plan, once, and the clouds that it is for."""
    n_scenes = particles.origin.shape[0]
    if len(plans) != n_scenes:
        raise InputError(f"plans: there must be one for each of {n_scenes} scenes; got {len(plans)}")
    kinds: dict[str, tuple[Plan, list[int]]] = {}
    for cloud, scene in enumerate(particles.clouds.scenes):
        kinds.setdefault(plans[scene].spec.hash, (plans[scene], []))[1].append(cloud)
    yield from kinds.values()
