"""Particles of the last steps -> particles of the next steps."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d import ops
from gsim3d.dynamics.background import Background
from gsim3d.dynamics.bodies import bodies
from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.contact import FIRM, SOLID, Beside
from gsim3d.dynamics.daylight import daylight
from gsim3d.dynamics.deformation import deformation
from gsim3d.dynamics.flight import Flight
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.momentum import momentum, turned
from gsim3d.dynamics.motion import motion
from gsim3d.dynamics.parts import Parts
from gsim3d.dynamics.push import Pushes
from gsim3d.dynamics.shade import shade
from gsim3d.dynamics.state import LIGHT_CHANNELS, StateLayout
from gsim3d.nn.point_transformer import PointTransformer
from gsim3d.ops.curve import Pyramid, PyramidCapacity
from gsim3d.state import (
    ASLEEP,
    FROZEN,
    CloudTable,
    Particles,
    concatenate,
    constant,
    newest_clouds,
    single_steps,
    take_runs,
    with_attribute,
)

ROOM = 1.1  # for rows that a call reads, over what was counted
LIGHT_SIZE = 0.1  # of the parameter that is a direction: smaller ones are turned faster in training
DIMMING = 0.2  # logarithm of how much darker a row is where log(1 + n) of the matter before its lamp grows by one
GRAVITY_SIZE = 0.01  # metres a step, of every step: of the parameter's unit, so that training changes it little
SKIN, SKIN_SIZE = 0.02, 0.1  # metres, where it begins; and its unit, likewise
STEADY = 20.0  # as LIGHT_SIZE, of lamps that light surfaces: training turned them away from the true ones
STRENGTH = 2.0  # of the light that a surface facing the lamp gets, over that which comes from everywhere


class Dynamics(nn.Module):
    """Predicts how particles change in one step.

    The network reads all steps of a history at once; each row of the newest step gets an increment. Steps are counted
    back from the newest, so one model serves any history of 1 to ``2 ** config.history_bits`` steps. Scenes do not
    change each other (in training with ``norm="batch"`` they do). Rows that are asleep, outside the 2^16 cells from the
    scene's origin, or at no finite place, keep their state and nobody sees them.
    """

    def __init__(self, config: DynamicsConfig):
        super().__init__()
        self.config = config
        self.layout = StateLayout.of(config)
        self.rounds = None  # whether geometry is rounded in training; None: on a GPU
        self._most_moving: int | None = None
        layout = self.layout
        self.net = PointTransformer(layout.in_channels, layout.told_channels, layout.out_channels, config)
        self.lights = self.dimming = self.strength = None
        if config.lights:
            directions, each = torch.tensor(config.lights), (len(config.lights), LIGHT_CHANNELS)
            if config.surfaces:
                self.lights = nn.Parameter(STEADY * F.normalize(directions, dim=1))
                self.strength = nn.Parameter(torch.full(each, STRENGTH))
            else:
                self.lights = nn.Parameter(LIGHT_SIZE * directions)
                self.dimming = nn.Parameter(torch.full(each, DIMMING))
        self.gravity = None
        if config.gravity is not None:
            self.gravity = nn.Parameter(torch.tensor(config.gravity) / GRAVITY_SIZE)
        self.friction = self.skin = None
        if config.pushes:
            self.friction = nn.Parameter(torch.ones(()))
            self.skin = nn.Parameter(torch.tensor(SKIN / SKIN_SIZE))

    def geometry(
        self,
        history: Particles,
        *,
        generator: torch.Generator | None = None,
        capacity: PyramidCapacity | None = None,
        curves: tuple[tuple[int, ...], ...] | None = None,
        rounded: bool = False,
    ) -> Pyramid:
        """All that the network reads of the positions, as integers.

        Args:
            history, generator: as :meth:`forward`.
            capacity: sizes of the result, so that nothing waits for the device; None: what the positions need.
            curves: of each stage, as of a background that is read; None: drawn from ``generator``.
            rounded: as of :func:`gsim3d.ops.build_pyramid`.
        """
        clouds = history.clouds
        slots, history_bits = self._slots(clouds, newest_clouds(clouds))
        curves = self._draw_curves(generator) if curves is None else curves
        options = {"curves": curves, "capacity": capacity, "rounded": rounded}
        seen, cu_rows, chosen = self._seen(history), history.cu_rows, None
        places = torch.where(seen[:, None], history.means.detach(), torch.nan)
        if capacity is not None:
            options["capacity"] = capacity = capacity.of_rows(history.n_rows)
        if capacity is not None and capacity.sizes[0] < history.n_rows:
            chosen, cu_rows, is_row, n_seen = _packed(seen, cu_rows, capacity.sizes[0])
            places = torch.where(is_row[:, None], places[chosen], torch.nan)
        pyramid = ops.build_pyramid(
            places,
            cu_rows,
            history.cloud_scene,
            constant(slots, cu_rows.device),
            history.origin,
            self.config.pyramid_spec(history_bits),
            **options,
        )
        return pyramid if chosen is None else pyramid.of_rows(chosen, n_seen)

    @contextlib.contextmanager
    def moving_at_most(self, n_rows: int) -> Iterator[None]:
        """Within it no scene has more rows that may move than ``n_rows``: a GPU computes what is told of these alone,
        as a CPU does that counts them."""
        before, self._most_moving = self._most_moving, n_rows
        try:
            yield
        finally:
            self._most_moving = before

    def room(self, history: Particles) -> int:
        """Rows that the network needs room for in calls like that of ``history``: with a background that is relit only
        those that it sees, which waits for the device."""
        if not self.config.is_relightable:
            return history.n_rows
        return min(history.n_rows, math.ceil(ROOM * int(self._seen(history).sum())))

    def remember(self, background: Particles, *, generator: torch.Generator | None = None) -> Background:
        """What moving rows read of a background, for all calls until it changes.

        Args:
            background: at most one cloud a scene.
            generator: as :meth:`forward`.
        Gradients: as :meth:`forward`.
        """
        curves = self._draw_curves(generator)
        pyramid = self.geometry(background, curves=curves)
        remembered, recorders = Background.begin(pyramid, background, self.config.pyramid_spec(0), curves)
        if recorders:
            draws = generator if self.training else None
            x = ops.pool_mean(self.layout.pack(background), pyramid.rows, pyramid.cu_rows, check=False)
            self.net(x, pyramid, generator=draws and _beside(draws, x.device), besides=recorders)
        return remembered

    @torch.no_grad()
    def in_light(self, particles: Particles) -> Particles:
        """``particles`` of which the newest clouds know what stands in their light; where they do not know what stood
        there as they were encoded, that is what stands there now."""
        if self.lights is None:
            return particles
        runs = particles.clouds.row_runs(newest_clouds(particles.clouds))
        known = None if particles.light_occlusion is None else take_runs(particles.light_occlusion, runs)
        shaded = self._shaded(particles, known)
        return dataclasses.replace(particles, light_occlusion=_put_runs(shaded, runs, particles.n_rows, -1.0))

    def with_bodies(self, particles: Particles) -> Particles:
        """``particles`` of which the newest clouds know their bodies, if that is asked for; others know no more than
        where they are."""
        if not self.config.pushes or particles.body is not None:
            return particles
        runs = particles.clouds.row_runs(newest_clouds(particles.clouds))
        here = with_attribute(particles, "body").body
        found = bodies(particles, self.config.grid_size)
        newest = _put_runs(torch.ones_like(found[:, :1], dtype=torch.bool), runs, particles.n_rows)
        return dataclasses.replace(particles, body=torch.where(newest, _put_runs(found, runs, particles.n_rows), here))

    def flight(self, history: Particles, matter: Matter | None = None, beside: Beside | None = None) -> Flight | None:
        """How far the rows of the newest clouds are from flying; None of a model without ``gravity``.

        matter, beside: of ``history``; None: found here.
        """
        if self.gravity is None:
            return None
        matter = matter or self._matter(history)
        beside = beside or self._beside(history, matter)
        pushes = None
        if self.friction is not None and matter is not None:
            numbers = self.friction, SKIN_SIZE * self.skin
            pushes = Pushes(history, matter, beside, self.config.motion_length, *numbers, self.config.solid)
        return Flight.of(beside.contact[:, -1:], matter, GRAVITY_SIZE * self.gravity, pushes)

    def begin(self, state: Particles) -> Particles:
        """``state`` with the fields in which simulated rows know how they began."""
        if self.config.is_relightable:
            state = with_attribute(state, "initial_latents")
        if self.config.deformation:
            state = with_attribute(state, "rest_positions")
        if self.config.turning:
            state = with_attribute(state, "orientations")
        state = self.with_bodies(state)
        return state if self.lights is None else with_attribute(state, "irradiance_gain")

    def forward(
        self,
        history: Particles,
        *,
        generator: torch.Generator | None = None,
        pyramid: Pyramid | None = None,
        background: Background | None = None,
        changes: Mapping[str, str] | None = None,
    ) -> Particles:
        """The next step of every scene, or the next ``config.steps_per_call`` steps.

        Args:
            history: clouds sorted by (scene, step); steps may have different numbers of rows, and gaps are fine. What
                stands in the light of the newest ones is known (:meth:`in_light`), or of none.
            generator: of drop path and of the curves' shuffling, both in training only; None: neither happens.
            pyramid: ``geometry(history)``; None: made here. With one of a given capacity nothing waits for the device,
                and the result has the same values as long as ``pyramid.found`` fits the capacity.
            background: what rests, of :meth:`remember`; then ``history`` holds what moves, as :class:`Parts` tells them
                apart. None: with ``config.background="asymmetric"`` all that is done here.
            changes: what a step changes, of ``layout.changes``; the rest is not computed. None: all that is predicted.
        Returns:
            One cloud a scene and step, each with the rows of the scene's newest step.
        Gradients: features and positions of ``history``, parameters. Cells are constants.
        Raises:
            ValueError: clouds are not sorted, a history is longer than the model's, or a model with ``norm="batch"`` is
                trained on a pyramid of given capacity: its statistics would count rows that are none.
        """
        changes = changes or self.layout.changes()
        if background is None and self.config.is_asymmetric:
            return self._forward_in_parts(history, generator, changes)
        history = self.begin(history if history.light_occlusion is not None else self.in_light(history))
        if self.config.is_relightable:
            history = _as_it_began(history, changes["dynamic_latents"] in ("all", "dynamic"))
        clouds = history.clouds
        newest = newest_clouds(clouds)
        if pyramid is None:
            curves = None if background is None else background.curves
            rounded = background is None and self._rounds(history)
            pyramid = self.geometry(history, generator=generator, curves=curves, rounded=rounded)
        n_data = [stage.n_data for stage in pyramid.stages]
        if pyramid.found is not None and self.training and self.config.norm == "batch" and None in n_data:
            raise ValueError(
                'Dynamics: norm="batch" cannot be trained with a pyramid of given capacity; use norm="layer"'
            )
        runs, config = clouds.row_runs(newest), self.config
        moved = drift = near = flight = dark = shaded = None
        matter = self._matter(history)
        if config.velocity:
            drift = momentum(history, config.motion_length, config.grid_size, matter)
        elif config.motion_length is not None:
            drift = motion(history, config.motion_length, config.grid_size)
        if config.deformation:
            bent = deformation(history, config.motion_length, config.grid_size, matter)
            drift = torch.cat([drift, bent[:, None].to(drift.dtype)], 1)
        if drift is not None:
            moved = _put_runs(drift, runs, history.n_rows)
        if config.contact_length is not None:
            beside = self._beside(history, matter)
            flight = self.flight(history, matter, beside)
            near = _put_runs(beside.contact, runs, history.n_rows)
        if self.lights is not None:
            shaded, n_lights = take_runs(history.light_occlusion, runs), len(self.lights)
            dark = torch.cat([shaded[:, -n_lights:], shaded[:, :n_lights]], 1)  # now and then
            dark = _put_runs(dark, runs, history.n_rows)
        features, is_awake = self.layout.pack(history, moved, near, dark), None
        n_awake = pyramid.rows.shape[0] if pyramid.found is None else n_data[0]
        everyone = n_awake == history.n_rows
        if not everyone:  # rows of the pyramid <-> rows of the history; those that sleep become 0
            features = ops.pool_mean(features, pyramid.rows, pyramid.cu_rows, check=False)
        draws = generator if self.training else None
        besides = () if background is None else background.readers(pyramid, history)
        features = self.net(features, pyramid, generator=draws and _beside(draws, features.device), besides=besides)
        if not everyone:
            one = features.new_ones(features.shape[0], 1)
            features, is_awake = (
                ops.unpool(x, pyramid.rows, pyramid.cu_rows, history.n_rows, check=False) for x in (features, one)
            )
        prediction = self.net.head(take_runs(features, runs), self.layout.columns(changes))
        if is_awake is not None:
            is_awake = take_runs(is_awake, runs)[:, 0] > 0

        state = history.select_clouds(newest)
        table = state.clouds
        counts = [table.count(q) for q in range(len(table))]
        steps = [
            step.with_clouds(
                CloudTable.make(counts, table.scenes, (s + 1 + i for s in table.steps), state.cu_rows.device)
            )
            for i, step in enumerate(self.layout.advance(state, prediction, is_awake, changes, drift, flight))
        ]
        if config.velocity:
            steps = [
                dataclasses.replace(step, velocity=step.means - before.means)
                for before, step in zip([state, *steps], steps)
            ]
        if config.turning:
            turns = turned(state.orientations, steps[0].velocity, config.motion_length, matter)
            steps = [dataclasses.replace(steps[0], orientations=turns)]
        if self.lights is not None:
            # Where rows have come to: with the light of where they were shadows would lag behind their bodies.
            found = [self._shaded(step, shaded) for step in steps]
            brighter = torch.stack([self._brighter(values) for values in found])
            light = self.layout.later_light(state, prediction, brighter, is_awake, changes)
            steps = [
                dataclasses.replace(step, light_occlusion=values, irradiance_gain=lit)
                for step, values, lit in zip(steps, found, light.unbind(0), strict=True)
            ]
        return steps[0] if len(steps) == 1 else concatenate(steps)

    def _shaded(self, particles: Particles, known: Tensor | None) -> Tensor:
        """Of the newest rows: what stood in the light of each lamp where they were encoded, with ``surfaces`` how much
        they faced it there, and what stands there now. The former are ``known``, as far as they are not negative; rows
        that sleep keep what they knew."""
        n_lights, grid_size = len(self.lights), self.config.grid_size
        matter = Matter.of(particles, grid_size, most=self._most_moving)
        if self.config.surfaces:
            facing = None if known is None else known[:, n_lights : 2 * n_lights]
            facing = None if facing is None else torch.where(facing < 0, 1.0, facing)
            now, faces = daylight(particles, self.lights, grid_size, matter, facing)
            began = torch.cat([now, faces], 1)
        else:
            now = began = shade(particles, self.lights, grid_size, matter)
        if known is not None and matter is not None:
            before = known[:, -n_lights:]
            now = torch.where(matter.awake(particles)[:, None] | (before < 0), now, before)
            known = known[:, : began.shape[1]]
            began = torch.where(known < 0, began, known)
        return torch.cat([began, now], 1)

    def _brighter(self, shaded: Tensor) -> Tensor:
        """[N, 3], logarithm of how much more light reaches rows now than where they were encoded."""
        before, now = shaded[:, : len(self.lights)], shaded[:, -len(self.lights) :]
        if not self.config.surfaces:
            return ((before - now)[:, :, None] * self.dimming).sum(1)  # a product of matrices would be rounded
        now, then = ((lit[:, :, None] * self.strength.clamp(min=0)).sum(1).log1p() for lit in (now, before))
        return now - then

    def _matter(self, history: Particles) -> Matter | None:
        """What all that rows are told begins with; None where nothing is told of it."""
        config = self.config
        if config.velocity or config.deformation:
            return Matter.of(history, config.grid_size, config.motion_length, self._most_moving, evenly=config.pushes)
        if config.contact_length is not None:
            return Matter.of(history, config.grid_size, most=self._most_moving)
        return None

    def _beside(self, history: Particles, matter: Matter | None) -> Beside:
        return Beside(history, self.config.contact_length, matter, FIRM if self.config.pushes else SOLID)

    def _seen(self, history: Particles) -> Tensor:
        """bool [N], rows that the network sees."""
        seen = history.activity != ASLEEP
        if self.config.is_relightable:
            runs = history.clouds.row_runs(newest_clouds(history.clouds))
            newest = torch.ones_like(seen[: sum(end - begin for begin, end in runs)])
            seen = seen & ((history.activity != FROZEN) | _put_runs(newest, runs, history.n_rows))
        return seen

    def _rounds(self, history: Particles) -> bool:
        """Whether the network sees rows that are none, so that its matrix products have few sizes: cuBLAS chooses an
        algorithm on the host for every new one, and clouds that move have new ones at each step."""
        if torch.compiler.is_compiling():
            return False
        return self.training and history.means.is_cuda if self.rounds is None else self.rounds

    def _forward_in_parts(
        self, history: Particles, generator: torch.Generator | None, changes: Mapping[str, str] | None
    ) -> Particles:
        parts, n_steps = Parts.of(history, asymmetric=True), self.config.steps_per_call
        steps = [None] * n_steps
        if not parts.nothing_moves:
            background = self.remember(parts.background, generator=generator)
            step = self(parts.moving, generator=generator, background=background, changes=changes)
            steps = single_steps(step)
        wholes = [parts.whole(step, 1 + i) for i, step in enumerate(steps)]
        return wholes[0] if n_steps == 1 else concatenate(wholes)

    def _slots(self, clouds: CloudTable, newest: list[int]) -> tuple[tuple[int, ...], int]:
        """Time slot of each cloud, and the bits they are counted in: none where no scene has two steps to merge."""
        slots, longest, begin, bits = [], 1, 0, self.config.history_bits
        from_newest = self.config.slots_from_newest
        for last in newest:
            span = clouds.steps[last] - clouds.steps[begin]
            longest = max(longest, span + 1)
            shift = 2**bits - 1 - span if from_newest else 0
            slots += [shift + clouds.steps[q] - clouds.steps[begin] for q in range(begin, last + 1)]
            begin = last + 1
        if longest > 2**bits:
            raise ValueError(f"Dynamics: a history must span at most {2**bits} steps; got {longest}")
        if longest == 1 and from_newest:
            return (0,) * len(slots), 0
        return tuple(slots), bits if from_newest else (longest - 1).bit_length()

    def _draw_curves(self, generator: torch.Generator | None) -> tuple[tuple[int, ...], ...] | None:
        if generator is None or not (self.training and self.config.shuffle_orders):
            return None
        return tuple(
            tuple(torch.randperm(4, generator=generator, device=generator.device).tolist())
            for _ in range(self.config.n_stages)
        )


def _beside(generator: torch.Generator, device: torch.device) -> torch.Generator:
    """``generator``, or one on ``device`` that follows from it: a GPU would wait for rows drawn on the host."""
    if generator.device.type == device.type:
        return generator
    seed = torch.randint(2**62, (), generator=generator, device=generator.device).item()
    return torch.Generator(device).manual_seed(seed)


def _put_runs(x: Tensor, runs: Sequence[tuple[int, int]], n_rows: int, other: float = 0.0) -> Tensor:
    """[n_rows, ...], the rows of ``x`` one run after another; ``other`` elsewhere."""
    pieces, end = [], 0
    for part, (begin, until) in zip(x.split([until - begin for begin, until in runs]), runs, strict=True):
        pieces += [x.new_full((begin - end, *x.shape[1:]), other), part]
        end = until
    return torch.cat([*pieces, x.new_full((n_rows - end, *x.shape[1:]), other)])


def _packed(seen: Tensor, cu_rows: Tensor, n_rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``n_rows`` rows, those that are ``seen`` first: int64 [n_rows] which, where clouds begin among them (the last one
    ends with all), bool [n_rows] whether they are seen, and how many are seen in all. Waits for nothing."""
    until = F.pad(seen.cumsum(0), (1, 0))
    rows = torch.sort((~seen).to(torch.uint8), stable=True).indices[:n_rows]
    starts = until[cu_rows].clamp(max=n_rows)
    return rows, torch.cat([starts[:-1], starts.new_full((1,), n_rows)]), seen[rows], until[-1]


def _as_it_began(history: Particles, bodies: bool) -> Particles:
    """``history`` whose frozen rows look as they did when the simulation began; with ``bodies`` all rows."""
    relit = ((history.activity == FROZEN) | bodies & (history.activity != ASLEEP))[:, None]
    latents = torch.where(relit, history.initial_latents, history.dynamic_latents)
    return dataclasses.replace(history, dynamic_latents=latents)
