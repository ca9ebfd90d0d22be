"""Lighting: irradiance of particles under directional lights, relative to the time of encoding."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d.cameras import Frames
from gsim3d.errors import InputError
from gsim3d.priors import padding
from gsim3d.priors.base import Prior, PriorConfig, StepContext, bounded, hold
from gsim3d.priors.movable import Movable
from gsim3d.priors.padding import LEAST_LOGIT, Compact, Samples, from_blocks, in_blocks, squared_distances
from gsim3d.priors.rigid import SMALLEST, fit_planes
from gsim3d.state import DYNAMIC, FROZEN, Particles

# Lengths in cells.
FLAT = 2.5  # standard deviation of the windows of plane fits
BODY = 12.5  # standard deviation of the windows whose mean is inside a body, to orient normals
TOWARDS = 1.5  # bias of normals towards the light, for surfaces with as many particles on both sides
START = 3.0  # height over a movable surface at which shadow rays start, to avoid self-shadowing
EDGE = 0.5  # width of the sigmoid with which particles on a ray begin to count
NEAREST = 3.0  # distance along a ray at which particles count half; closer ones belong to the same surface
EDGE_LAYERS = 0.7  # number of surfaces on a ray that halves its light
SOFT = 0.15  # softening of the cosine n.l at the terminator, since normals are not exact


@dataclass(frozen=True)
class DirectionalLightConfig(PriorConfig):
    """Directional lights with learned directions and strengths.

    Attributes:
        directions: initial directions towards the lights.
        shading: "lambert": n.l with shadows; "occlusion": optical depth towards the light only.
        strength: initial strength. "lambert": irradiance over that of the ambient light; "occlusion": extinction, the
            decrease of the log irradiance as log(1 + n) grows by one, with n particles on the ray.
        unit: norm of the direction parameters; a larger norm lowers their learning rate.
        beam: standard deviation of the Gaussian ray that counts particles, in cells.
        min_opacity: smallest opacity of particles on surfaces ("lambert").
        max_gain: bound of the predicted log gain.
    """

    type = "directional_light"
    directions: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 1.0),)
    shading: Literal["lambert", "occlusion"] = "lambert"
    strength: float = 2.0
    unit: float = 20.0
    beam: float = 1.5
    min_opacity: float = 0.3
    max_gain: float = 2.0

    RANGES = {
        "directions": (-1e6, 1e6), "strength": (0, 1e6), "unit": (1e-6, 1e6), "beam": (1e-3, 1e3),
        "min_opacity": (0, 1), "max_gain": (0, 100),
    }  # fmt: skip

    def __post_init__(self):
        super().__post_init__()
        if not self.directions or any(len(light) != 3 or not any(light) for light in self.directions):
            raise InputError(f"directional_light: directions must be nonzero vectors (x, y, z); got {self.directions}")
        if self.shading not in ("lambert", "occlusion"):
            raise InputError(f'directional_light: shading must be "lambert" or "occlusion"; got {self.shading!r}')

    def build(self) -> _Light:
        return LambertianLight(self) if self.shading == "lambert" else OcclusionLight(self)


class _Light(Prior, ABC):
    """Multiplies the colours of a particle by its irradiance now over that at encoding.

    For L lights, ``light_occlusion`` [N, n_values * L] holds the values at encoding, then L current values. The
    features are the last L and the first L columns. Sleeping particles keep their values.
    """

    attributes = ("irradiance_gain",)
    n_gains = 3
    gains_change = "irradiance_gain"
    reads_background = True
    n_values = 2

    def __init__(self, config: DirectionalLightConfig):
        super().__init__(config)
        self.n_features = 2 * len(config.directions)

    @abstractmethod
    def occlusion(self, ctx: StepContext, known: Tensor | None) -> tuple[Tensor, Tensor]:
        """Values at encoding, if the state were just encoded, and current values. ``known``: light_occlusion so far."""

    @abstractmethod
    def log_gain(self, occlusion: Tensor) -> Tensor:
        """Log of the current irradiance over that at encoding, [N, 3]."""

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        """Sets ``light_occlusion`` of the newest clouds. Values at encoding default to the current ones."""
        known = particles.light_occlusion
        with torch.no_grad():
            found = self._updated(ctx.with_particles(particles), None if known is None else ctx.select_newest(known))
            return replace(particles, light_occlusion=ctx.scatter_newest(found, -1.0))

    def begin(self, particles: Particles, ctx: StepContext) -> Particles:
        if particles.light_occlusion is None:
            particles = self.initialize(particles, ctx)
        return super().begin(particles, ctx)

    def features(self, ctx: StepContext) -> Tensor:
        known, n = ctx.state.light_occlusion, len(self.config.directions)
        return ctx.scatter_newest(torch.cat([known[:, -n:], known[:, :n]], 1))

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        # At the positions after the step, so that shadows do not lag one step behind their bodies.
        found = self._updated(ctx.with_particles(step), ctx.state.light_occlusion)
        gain = self._gain(ctx, self.log_gain(found), gains)
        return replace(step, light_occlusion=found, irradiance_gain=gain)

    @abstractmethod
    def _gain(self, ctx: StepContext, log_gain: Tensor, predicted: Tensor | None) -> Tensor:
        """Irradiance gain [N, 3] since encoding. A gain since the previous step would accumulate errors."""

    def _updated(self, ctx: StepContext, known: Tensor | None) -> Tensor:
        n = len(self.config.directions)
        if ctx.is_empty:
            return ctx.state.means.new_zeros(0, self.n_values * n)
        began, now = self.occlusion(ctx, known)
        if known is not None:
            before = known[:, -n:]
            now = torch.where(ctx.movable.awake()[:, None] | (before < 0), now, before)
            known = known[:, : began.shape[1]]
            began = torch.where(known < 0, began, known)
        return torch.cat([began, now], 1)


class OcclusionLight(_Light):
    """Let n be the number of movable particles between a particle and a light. The log gain is the sum over lights of
    extinction * (log(1 + n_encoding) - log(1 + n_now)) plus the predicted log gain, bounded by ``max_gain``."""

    def __init__(self, config: DirectionalLightConfig):
        super().__init__(config)
        self.directions = nn.Parameter(config.unit * torch.tensor(config.directions))
        self.extinction = nn.Parameter(torch.full((len(self.directions), 3), config.strength))

    def occlusion(self, ctx: StepContext, known: Tensor | None) -> tuple[Tensor, Tensor]:
        now = optical_depth(ctx.movable, self.directions, ctx.grid_size, self.config.beam)
        return now, now

    def log_gain(self, occlusion: Tensor) -> Tensor:
        n = len(self.directions)
        before, now = occlusion[:, :n], occlusion[:, -n:]
        return ((before - now)[:, :, None] * self.extinction).sum(1)  # no matmul: TF32 would round it

    def _gain(self, ctx: StepContext, log_gain: Tensor, predicted: Tensor | None) -> Tensor:
        most = self.config.max_gain
        if predicted is not None:
            log_gain = bounded((predicted + log_gain) / most, most)
        return hold(ctx.rows("irradiance_gain"), ctx.state.irradiance_gain, log_gain.exp())


class LambertianLight(_Light):
    """Lambert's law with shadows: E = 1 + sum over lights of strength * v (n.l), with visibility v and normal n of the
    surface of a particle. The gain is E_now / E_encoding times the exponential of the predicted log gain."""

    n_values = 3

    def __init__(self, config: DirectionalLightConfig):
        super().__init__(config)
        self.directions = nn.Parameter(config.unit * F.normalize(torch.tensor(config.directions), dim=1))
        self.strength = nn.Parameter(torch.full((len(self.directions), 3), config.strength))

    def occlusion(self, ctx: StepContext, known: Tensor | None) -> tuple[Tensor, Tensor]:
        n = len(self.directions)
        facing = None if known is None else torch.where(known[:, n : 2 * n] < 0, 1.0, known[:, n : 2 * n])
        now, faces = lambert(ctx.movable, self.directions, ctx.grid_size, self.config, facing)
        return torch.cat([now, faces], 1), now

    def log_gain(self, occlusion: Tensor) -> Tensor:
        n = len(self.directions)
        lit = occlusion[:, -n:], occlusion[:, :n]
        now, before = ((x[:, :, None] * self.strength.clamp(min=0)).sum(1).log1p() for x in lit)
        return now - before

    def _gain(self, ctx: StepContext, log_gain: Tensor, predicted: Tensor | None) -> Tensor:
        most = self.config.max_gain
        if predicted is not None:
            log_gain = log_gain + ctx.rows("irradiance_gain") * bounded(predicted / most, most)
        # The light changes all particles, also those whose other appearance is frozen.
        return hold(ctx.rows("irradiance_gain", "all"), ctx.state.irradiance_gain, log_gain.exp())


def optical_depth(movable: Movable, lights: Tensor, grid_size: float, beam: float) -> Tensor:
    """log(1 + n) [N, L] with the number n of movable particles between each particle of the newest clouds and each
    light, in a Gaussian beam of ``beam`` cells; 0 for sleeping particles. Gradients flow to ``lights`` [L, 3]."""
    with torch.autocast(movable.positions.device.type, enabled=False):
        positions, is_lit, _ = _lit_particles(movable)
        cells = (beam * grid_size, NEAREST * grid_size, EDGE * grid_size)
        samples = movable.samples
        each = (samples.n / samples.known.sum(1).clamp(min=1)).to(positions.dtype)[:, None]
        found = [each * particles_between(positions, samples, light, *cells) for light in lights.unbind(0)]
        return movable.unpad(torch.where(is_lit[:, :, None], torch.stack(found, 2).log1p(), 0))


@torch.no_grad()
def _lit_particles(movable: Movable) -> tuple[Tensor, Tensor, Tensor]:
    """Positions [B, M, 3] of movable and frozen particles relative to ``movable.center``, the mask [B, M] of both, and
    the mask [B, M] of frozen ones."""
    moving, frozen = movable.subset, movable.subset.other(FROZEN)
    positions = torch.where(moving.known[:, :, None], moving.positions, frozen.positions) - movable.center
    return positions, moving.known | frozen.known, frozen.known


def particles_between(
    positions: Tensor, samples: Samples, light: Tensor, beam: float, nearest: float, edge: float
) -> Tensor:
    """Number of ``samples`` [B, M] between each of ``positions`` [B, M, 3] and the ``light``, a direction [3] of any
    norm to which gradients flow: in a Gaussian ``beam``, from ``nearest`` on, with an ``edge``, all in metres."""
    direction = light / light.norm()

    def count(positions: Tensor, there: Tensor, known: Tensor) -> tuple[Tensor, ...]:
        ahead = (there * direction).sum(2)[:, None] - (positions * direction).sum(2)[:, :, None]
        off = squared_distances(positions, there).sub_(ahead.square()).clamp_(min=0)
        begun = (ahead - nearest).div_(edge).sigmoid_()
        counted = off.mul_(-0.5 / beam**2).clamp_(min=LEAST_LOGIT).exp_().mul_(begun)
        counted.masked_fill_(~known[:, None], 0)
        if not light.requires_grad:
            return (counted.sum(2),)
        # d off / d direction = -2 ahead * offset; d ahead / d direction = offset.
        by_way = counted * (ahead / beam**2 + (1 - begun) / edge)
        return counted.sum(2), by_way @ there - by_way.sum(2, keepdim=True) * positions

    with torch.no_grad():
        found, *slopes = padding.block_by_block(count, *in_blocks(positions, samples.positions, samples.known))
    for slope in slopes:
        found = found + slope @ (direction - direction.detach())
    return from_blocks(found, positions)


def lambert(
    movable: Movable, lights: Tensor, grid_size: float, config: DirectionalLightConfig, facing: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Irradiance v (n.l) and cosine n.l of each particle of the newest clouds under each light.

    The normal is that of a plane fit to opaque neighbours, movable or frozen as the particle, and points to the side
    with fewer of them. A ray through ``EDGE_LAYERS`` movable surfaces loses half of its light. Gradients flow to the
    directions ``lights`` [L, 3] of any norm; ``facing``: n.l [N, L] of frozen particles, None: computed here.

    Returns:
        Irradiance and cosine, [N, L] each, in [0, 1]; 0 for sleeping particles.
    """
    with torch.autocast(movable.positions.device.type, enabled=False):
        positions, is_lit, is_frozen = _lit_particles(movable)
        moving, is_lit = movable.subset.known[:, :, None], is_lit[:, :, None]
        with torch.no_grad():
            solid = movable.samples_of(DYNAMIC, config.min_opacity)
            surface = _Surface(positions, movable.compact, solid, grid_size)
            one_layer, static = _one_layer(solid, config.beam * grid_size), None
            if facing is None:
                ground = movable.samples_of(FROZEN, config.min_opacity)
                static = _Surface(positions, Compact(is_frozen), ground, grid_size)
        cosines, lit = [], []
        for i, light in enumerate(lights.unbind(0)):
            direction = light / light.norm()
            of_static = movable.pad(facing)[:, :, i] if static is None else static.cosine(direction, grid_size)
            cosine = torch.where(moving[:, :, 0], surface.cosine(direction, grid_size), of_static)
            with torch.no_grad():
                start = positions + START * grid_size * torch.where(moving, surface.normals(direction, grid_size), 0)
            beams = (config.beam * grid_size, 0.0, EDGE * grid_size)
            layers = particles_between(start, solid, light, *beams) / one_layer
            cosines.append(cosine)
            lit.append(cosine * (-math.log(2) * (layers / EDGE_LAYERS).square()).exp())
        found = (torch.where(is_lit, torch.stack(values, 2), 0) for values in (lit, cosines))
        return tuple(movable.unpad(values) for values in found)


class _Surface:
    """Plane fits to ``samples`` around those of ``positions`` [B, M, 3] that ``compact`` retains."""

    def __init__(self, positions: Tensor, compact: Compact, samples: Samples, grid_size: float):
        flat, body, kept = FLAT * grid_size, BODY * grid_size, compact.take(positions)

        def fit(blocks: Tensor, around: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
            far = squared_distances(blocks, around)
            near = torch.where(known, (far * (-0.5 / flat**2)).clamp_(min=LEAST_LOGIT).exp_(), 0)
            window = near.div_(near.sum(2, keepdim=True).clamp(min=SMALLEST))
            _, normal = fit_planes(window, around, flat)
            wide = torch.where(known, far.mul_(-0.5 / body**2).clamp_(min=LEAST_LOGIT).exp_(), 0)
            wide = wide.div_(wide.sum(2, keepdim=True).clamp(min=SMALLEST))
            return normal, ((blocks - wide @ around) * normal).sum(2, keepdim=True)

        blocks = in_blocks(kept, samples.positions, samples.known[:, None])
        normal, out = (from_blocks(x, kept) for x in padding.block_by_block(fit, *blocks))
        self._normal, self._out = compact.put(normal), compact.put(out)[:, :, 0]

    def normals(self, direction: Tensor, grid_size: float) -> Tensor:
        """Normals [B, M, 3] towards the outside, or towards the light if the outside is ambiguous."""
        out = self._out + TOWARDS * grid_size * (self._normal @ direction)
        return torch.where((out < 0)[:, :, None], -self._normal, self._normal)

    def cosine(self, direction: Tensor, grid_size: float) -> Tensor:
        """Softened cosine n.l [B, M], 0 for surfaces that face away."""
        with torch.no_grad():
            normals = self.normals(direction, grid_size)
        return ((normals @ direction + SOFT) / (1 + SOFT)).clamp(min=0)


def _one_layer(samples: Samples, beam: float) -> Tensor:
    """Number of samples [B, 1] that :func:`particles_between` counts for one surface: mean count around a sample."""
    near = padding.gaussian(squared_distances(samples.positions, samples.positions), beam)
    both = samples.known[:, :, None] & samples.known[:, None]
    return (torch.where(both, near, 0).sum((1, 2)) / samples.known.sum(1).clamp(min=1)).clamp(min=1)[:, None]
