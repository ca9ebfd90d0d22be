"""Background that is shown as movable, at random: so a model learns that what rests may be awake or asleep."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from gsim3d.dynamics import DynamicsConfig
from gsim3d.effects.spec import EffectsSpec, Sleep
from gsim3d.errors import InputError
from gsim3d.state import DYNAMIC, FROZEN, Particles
from gsim3d.train.config import DataConfig


def check_thawing(data: DataConfig, dynamics: DynamicsConfig) -> None:
    if data.thawed and not dynamics.is_asymmetric:
        raise InputError(
            'data.thawed: needs a model of background "asymmetric"; another does not tell frozen rows apart'
        )


def thaw(particles: Particles, most: float, spec: EffectsSpec, rng: np.random.Generator) -> Particles:
    """``particles`` of which a random share of the background, up to ``most``, is not frozen but only at rest.

    Each scene draws its share; space is cut into cubes, and all frozen rows of a cube thaw, at every step, or none.

    Args:
        most: 0 to 1.
        spec: whose rule of sleep says how large cubes are; without one, that of a new rule.
        rng: is drawn from as often as scenes and cubes ask for, wherever rows are.
    """
    edge = (spec.dynamics.sleep or Sleep()).halo
    scene = particles.cloud_scene[particles.row_cloud()]
    cube = torch.floor((particles.means.detach().double() - particles.origin[scene]) / edge).nan_to_num().long()
    _, place = torch.unique(torch.cat([scene[:, None], cube], 1), dim=0, return_inverse=True)
    shares = torch.as_tensor(most * rng.random(particles.origin.shape[0]), device=scene.device)
    draws = torch.as_tensor(rng.random(int(place.max()) + 1 if place.numel() else 0), device=scene.device)
    thawed = (particles.activity == FROZEN) & (draws[place] < shares[scene])
    return dataclasses.replace(particles, activity=torch.where(thawed, DYNAMIC, particles.activity))
