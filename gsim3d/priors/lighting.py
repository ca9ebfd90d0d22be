"""Lighting: how much light of distant lamps reaches each particle, now and when it was encoded."""

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
from gsim3d.priors.base import Prior, PriorConfig, StepContext, bounded
from gsim3d.priors.movable import Movable
from gsim3d.priors.padding import LEAST_LOGIT, Compact, Samples, from_blocks, gaussian, in_blocks, squared_distances
from gsim3d.priors.rigid import SMALLEST, fit_planes
from gsim3d.state import DYNAMIC, FROZEN, Particles

# Standard deviations of windows, in cells.
FLAT = 2.5  # in which a surface is a plane
BODY = 12.5  # whose mean is inside a body: that is how a surface knows its outside
TOWARDS = 1.5  # cells: a surface with as many particles on both sides shows the light its front
START = 3.0  # cells above a movable surface, where its rays begin: its own particles would be in their way
EDGE_LAYERS = 0.7  # surfaces, as a ray meets in its window at the edge of a body
SOFT = 0.15  # cosine by which a face that is turned away is lit still: normals are not exact
EDGE = 0.5  # cells, over which particles on a ray begin to count
NEAREST = 3.0  # cells towards the light, from which on particles count half; closer ones are the particle's own surface


@dataclass(frozen=True)
class DirectionalLightConfig(PriorConfig):
    """Distant lamps, whose directions and strengths are learned.

    Attributes:
        directions: towards the lamps, at first.
        shading: "lambert": surfaces are lit by n.l and shadows; "occlusion": by what is between them and the lamp only.
        strength: of lamps at first: of "lambert" their irradiance over that from everywhere; of "occlusion" the
            logarithm of how much darker a particle is where log(1 + n) of the particles in its light grows by one.
        unit: length of the parameter that is a direction; longer ones turn more slowly in training.
        beam: cells, standard deviation of the rays in which particles are counted.
        min_opacity: of particles that are part of surfaces ("lambert").
        max_gain: limit of the logarithm of what is predicted besides.
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
        "directions": (-1e6, 1e6),
        "strength": (0, 1e6),
        "unit": (1e-6, 1e6),
        "beam": (1e-3, 1e3),
        "min_opacity": (0, 1),
        "max_gain": (0, 100),
    }

    def __post_init__(self):
        super().__post_init__()
        if not self.directions or any(len(light) != 3 or not any(light) for light in self.directions):
            raise InputError(f"directional_light: directions must be vectors (x, y, z); got {self.directions}")
        if self.shading not in ("lambert", "occlusion"):
            raise InputError(f'directional_light: shading must be "lambert" or "occlusion"; got {self.shading!r}')

    def build(self) -> _Light:
        return LambertianLight(self) if self.shading == "lambert" else OcclusionLight(self)


class _Light(Prior, ABC):
    """Colours of a particle are multiplied by its irradiance now over that when it was encoded.

    ``light_occlusion`` holds, for L lamps, columns of the time of encoding, then L of now; the network sees the last L
    and the first L. Sleeping particles keep theirs.
    """

    attributes = ("irradiance_gain",)
    n_gains = 3
    gains_change = "irradiance_gain"
    reads_background = True

    def __init__(self, config: DirectionalLightConfig):
        super().__init__(config)
        self.n_features = 2 * len(config.directions)

    @abstractmethod
    def occlusion(self, ctx: StepContext, known: Tensor | None) -> tuple[Tensor, Tensor]:
        """Columns at encoding, if that were now, and columns of now; ``known``: those of ``ctx.state`` so far."""

    @abstractmethod
    def log_gain(self, occlusion: Tensor) -> Tensor:
        """[N, 3], the logarithm of the irradiance now over that at encoding."""

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        """``particles`` whose newest clouds know their light; its time of encoding defaults to now."""
        known = particles.light_occlusion
        with torch.no_grad():
            found = self._updated(ctx.later(particles), None if known is None else ctx.of_newest(known))
            return replace(particles, light_occlusion=ctx.of_all(found, -1.0))

    def begin(self, particles: Particles, ctx: StepContext) -> Particles:
        if particles.light_occlusion is None:
            particles = self.initialize(particles, ctx)
        return super().begin(particles, ctx)

    def features(self, ctx: StepContext) -> Tensor:
        known, n = ctx.state.light_occlusion, len(self.config.directions)
        return ctx.of_all(torch.cat([known[:, -n:], known[:, :n]], 1))

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        # At the places after the step: with the light of before shadows would lag behind their bodies.
        found = self._updated(ctx.later(step), ctx.state.light_occlusion)
        gain = self._gain(ctx, self.log_gain(found), gains)
        return replace(step, light_occlusion=found, irradiance_gain=gain)

    @abstractmethod
    def _gain(self, ctx: StepContext, log_gain: Tensor, predicted: Tensor | None) -> Tensor:
        """[N, 3]; not relative to the step before, or its errors would add up."""

    def _updated(self, ctx: StepContext, known: Tensor | None) -> Tensor:
        n = len(self.config.directions)
        if ctx.is_empty:
            return ctx.state.means.new_zeros(0, self.n_columns)
        began, now = self.occlusion(ctx, known)
        if known is not None:
            before = known[:, -n:]
            now = torch.where(ctx.movable.awake()[:, None] | (before < 0), now, before)
            known = known[:, : began.shape[1]]
            began = torch.where(known < 0, began, known)
        return torch.cat([began, now], 1)


def _held(share: Tensor, before: Tensor, later: Tensor) -> Tensor:
    return torch.where(share > 0, later, before)


class OcclusionLight(_Light):
    """Transmittance: let n count the movable particles between a particle and a lamp. The logarithm of the gain is
    sum over lamps of extinction (log(1 + n_encoding) - log(1 + n_now)), plus what is predicted, bounded together."""

    def __init__(self, config: DirectionalLightConfig):
        super().__init__(config)
        directions = torch.tensor(config.directions)
        self.n_columns = 2 * len(directions)
        self.directions = nn.Parameter(config.unit * directions)
        self.extinction = nn.Parameter(torch.full((len(directions), 3), config.strength))

    def occlusion(self, ctx: StepContext, known: Tensor | None) -> tuple[Tensor, Tensor]:
        now = optical_depth(ctx.movable, self.directions, ctx.grid_size, self.config.beam)
        return now, now

    def log_gain(self, occlusion: Tensor) -> Tensor:
        n = len(self.directions)
        before, now = occlusion[:, :n], occlusion[:, -n:]
        return ((before - now)[:, :, None] * self.extinction).sum(1)  # a product of matrices would be rounded

    def _gain(self, ctx: StepContext, log_gain: Tensor, predicted: Tensor | None) -> Tensor:
        most = self.config.max_gain
        if predicted is not None:
            log_gain = bounded((predicted + log_gain) / most, most)
        return _held(ctx.share("irradiance_gain"), ctx.state.irradiance_gain, log_gain.exp())


class LambertianLight(_Light):
    """Lambert's law with shadows: let E = 1 + sum over lamps of strength v (n.l), with visibility v and normal n of the
    surface that a particle is part of. The gain is E_now / E_encoding, times the exponential of what is predicted."""

    def __init__(self, config: DirectionalLightConfig):
        super().__init__(config)
        directions = torch.tensor(config.directions)
        self.n_columns = 3 * len(directions)
        self.directions = nn.Parameter(config.unit * F.normalize(directions, dim=1))
        self.strength = nn.Parameter(torch.full((len(directions), 3), config.strength))

    def occlusion(self, ctx: StepContext, known: Tensor | None) -> tuple[Tensor, Tensor]:
        n = len(self.directions)
        facing = None if known is None else torch.where(known[:, n : 2 * n] < 0, 1.0, known[:, n : 2 * n])
        now, faces = lambert(ctx.movable, self.directions, ctx.grid_size, self.config, facing)
        return torch.cat([now, faces], 1), now

    def log_gain(self, occlusion: Tensor) -> Tensor:
        n = len(self.directions)
        now, before = (
            ((lit[:, :, None] * self.strength.clamp(min=0)).sum(1).log1p())
            for lit in (occlusion[:, -n:], occlusion[:, :n])
        )
        return now - before

    def _gain(self, ctx: StepContext, log_gain: Tensor, predicted: Tensor | None) -> Tensor:
        most = self.config.max_gain
        if predicted is not None:
            log_gain = log_gain + ctx.share("irradiance_gain") * bounded(predicted / most, most)
        # Light reaches all, also where other appearance stays.
        return _held(ctx.share("irradiance_gain", "all"), ctx.state.irradiance_gain, log_gain.exp())


def optical_depth(movable: Movable, lights: Tensor, grid_size: float, beam: float) -> Tensor:
    """[N, L]: log(1 + n) for each particle of the newest clouds and each light, where n counts the movable particles of
    its scene between them in a Gaussian beam of ``beam`` cells. 0 for sleeping particles. Gradients: of ``lights``."""
    with torch.autocast(movable.positions.device.type, enabled=False):
        positions, is_lit, _ = _lit_particles(movable)
        cells = (beam * grid_size, NEAREST * grid_size, EDGE * grid_size)
        samples = movable.samples
        each = (samples.n / samples.known.sum(1).clamp(min=1)).to(positions.dtype)[:, None]
        found = [each * particles_between(positions, samples, light, *cells) for light in lights.unbind(0)]
        return movable.together(torch.where(is_lit[:, :, None], torch.stack(found, 2).log1p(), 0))


@torch.no_grad()
def _lit_particles(movable: Movable) -> tuple[Tensor, Tensor, Tensor]:
    """Positions [B, M, 3] of movable and frozen particles from ``movable.center``, bool [B, M], which they are, and
    which of them are frozen."""
    moving, frozen = movable.subset, movable.subset.other(FROZEN)
    positions = torch.where(moving.known[:, :, None], moving.positions, frozen.positions) - movable.center
    return positions, moving.known | frozen.known, frozen.known


def particles_between(
    positions: Tensor, samples: Samples, light: Tensor, beam: float, nearest: float, edge: float
) -> Tensor:
    """[B, M], how many samples are between each of ``positions`` [B, M, 3] and the light, in a Gaussian beam, from
    ``nearest`` on, where they begin to count over ``edge``; metres.

    Gradients:
        of ``light``; a sample near a beam enters it when the light turns.
    """
    direction, targets = light / light.norm(), positions
    positions, there, known = in_blocks(targets, samples.positions, samples.known)
    with torch.no_grad():
        ahead = (there * direction).sum(2)[:, None] - (positions * direction).sum(2)[:, :, None]
        off = squared_distances(positions, there).sub_(ahead.square()).clamp_(min=0)
        begun = (ahead - nearest).div_(edge).sigmoid_()
        counted = off.mul_(-0.5 / beam**2).clamp_(min=LEAST_LOGIT).exp_().mul_(begun)
        counted.masked_fill_(~known[:, None], 0)
        if not direction.requires_grad:
            return from_blocks(counted.sum(2), targets)
        # By the direction, the squared way off changes by -2 ahead * way, and the way ahead by the way.
        by_way = counted * (ahead / beam**2 + (1 - begun) / edge)
        slope = by_way @ there - by_way.sum(2, keepdim=True) * positions
        found = counted.sum(2)
    return from_blocks(found + slope @ (direction - direction.detach()), targets)


def lambert(
    movable: Movable, lights: Tensor, grid_size: float, config: DirectionalLightConfig, facing: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The irradiance v (n.l) and the cosine n.l of each particle of the newest clouds under each light.

    A particle is part of the plane through its opaque neighbours among the movable or among the frozen ones; the
    outside is where there are fewer of them. A ray loses half of its light where it meets the particles of
    ``EDGE_LAYERS`` movable surfaces, and almost all at two.

    Args:
        movable: of the newest clouds.
        lights: [L, 3], directions of any length.
        grid_size: metres, edge of a cell.
        config: of the prior.
        facing: [N, L], n.l of frozen particles; None: it is computed.
    Returns:
        Both [N, L], 0 to 1; 0 for sleeping particles.
    Gradients:
        of ``lights``.
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
            of_static = movable.apart(facing)[:, :, i] if static is None else static.cosine(direction, grid_size)
            cosine = torch.where(moving[:, :, 0], surface.cosine(direction, grid_size), of_static)
            with torch.no_grad():
                start = positions + START * grid_size * torch.where(moving, surface.normals(direction, grid_size), 0)
            beams = (config.beam * grid_size, 0.0, EDGE * grid_size)
            layers = particles_between(start, solid, light, *beams) / one_layer
            cosines.append(cosine)
            lit.append(cosine * (-math.log(2) * (layers / EDGE_LAYERS).square()).exp())
        found = (torch.where(is_lit, torch.stack(values, 2), 0) for values in (lit, cosines))
        return tuple(movable.together(values) for values in found)


class _Surface:
    """The planes through the samples near those of ``positions`` [B, M, 3] that ``compact`` keeps."""

    def __init__(self, positions: Tensor, compact: Compact, samples: Samples, grid_size: float):
        flat, body, kept = FLAT * grid_size, BODY * grid_size, compact.take(positions)
        blocks, around, known = in_blocks(kept, samples.positions, samples.known[:, None])
        far = squared_distances(blocks, around)
        near = torch.where(known, (far * (-0.5 / flat**2)).clamp_(min=LEAST_LOGIT).exp_(), 0)
        window = near.div_(near.sum(2, keepdim=True).clamp(min=SMALLEST))
        _, normal = fit_planes(window, around, flat)
        wide = torch.where(known, far.mul_(-0.5 / body**2).clamp_(min=LEAST_LOGIT).exp_(), 0)
        wide = wide.div_(wide.sum(2, keepdim=True).clamp(min=SMALLEST))
        out = ((blocks - wide @ around) * normal).sum(2, keepdim=True)
        normal, out = (from_blocks(x, kept) for x in (normal, out))
        self._normal, self._out = compact.put(normal), compact.put(out)[:, :, 0]

    def normals(self, direction: Tensor, grid_size: float) -> Tensor:
        """[B, M, 3], towards the outside, or the light ``direction`` where that is not clear."""
        out = self._out + TOWARDS * grid_size * (self._normal @ direction)
        return torch.where((out < 0)[:, :, None], -self._normal, self._normal)

    def cosine(self, direction: Tensor, grid_size: float) -> Tensor:
        """[B, M], n.l, 0 where the surface is turned away."""
        with torch.no_grad():
            normals = self.normals(direction, grid_size)
        return ((normals @ direction + SOFT) / (1 + SOFT)).clamp(min=0)


def _one_layer(samples: Samples, beam: float) -> Tensor:
    """[B, 1], what :func:`particles_between` counts where a ray meets one surface: samples near a sample."""
    near = gaussian(squared_distances(samples.positions, samples.positions), beam)
    both = samples.known[:, :, None] & samples.known[:, None]
    return (torch.where(both, near, 0).sum((1, 2)) / samples.known.sum(1).clamp(min=1)).clamp(min=1)[:, None]
