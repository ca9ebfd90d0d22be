"""Priors outside of a model, for tests of what each does."""

import dataclasses

from gsim3d.dynamics import DynamicsConfig
from gsim3d.priors import DirectionalLightConfig, PriorConfig, PriorList, StepContext
from gsim3d.priors.movable import Movable, Windows

OCCLUSION = DirectionalLightConfig(directions=((0.1, 0.2, 1.0),), shading="occlusion", strength=0.2, unit=0.1, beam=2.0)


def build(history, *configs):
    """The priors of ``configs`` where ``history`` is."""
    return PriorList([config.build() for config in configs]).to(history.means)


def context(history, *configs, grid_size, max_steps=4, priors=None):
    """What priors with ``configs``, or ``priors`` that are built, share in a step from ``history``."""
    priors = build(history, *configs) if priors is None else priors
    for prior in priors:
        history = prior.begin(history, StepContext(history, priors, grid_size, max_steps))
    return StepContext(history, priors, grid_size, max_steps)


def windows(history, radius, grid_size, *, evenly=False, most=None):
    return Windows(Movable(history, grid_size, most), history, radius, evenly=evenly)


def with_priors(config: DynamicsConfig, *priors: PriorConfig, **changes) -> DynamicsConfig:
    """``config`` with ``priors`` behind its own; those of a type that it has replace that."""
    known = {prior.type: prior for prior in config.priors}
    return dataclasses.replace(config, priors=tuple((known | {p.type: p for p in priors}).values()), **changes)


def without_prior(config: DynamicsConfig, name: str) -> DynamicsConfig:
    return dataclasses.replace(config, priors=tuple(prior for prior in config.priors if prior.type != name))
