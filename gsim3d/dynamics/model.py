"""The dynamics: predicts the next steps of particles from their last steps."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d import ops
from gsim3d.cameras import Frames
from gsim3d.dynamics.actions import ActionParticles
from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.frozen_context import FrozenContext
from gsim3d.dynamics.partition import Partition
from gsim3d.dynamics.step import StateLayout
from gsim3d.nn.graph_network import GraphNetwork
from gsim3d.nn.layers import product_dtype
from gsim3d.nn.point_transformer import PointTransformer
from gsim3d.ops.curve import Pyramid, PyramidCapacity
from gsim3d.priors import Motion, StepContext
from gsim3d.priors.base import put_runs
from gsim3d.priors.position_waves import relative_positions
from gsim3d.state import (
    ASLEEP,
    DYNAMIC,
    FROZEN,
    CloudTable,
    Newest,
    Particles,
    concatenate,
    constant,
    newest_clouds,
    single_steps,
    with_attribute,
)

SLACK = 1.1  # capacity over the counted number of particles


class Dynamics(nn.Module):
    """Predicts the next step of particles by a network and priors (:mod:`gsim3d.priors`).

    The network processes all steps of a history together and predicts a change of each particle of the newest step.
    Time slots count back from the newest step, so a model accepts histories of 1 to ``2 ** config.history_bits`` steps.
    Scenes are independent, except in training with ``norm="batch"``. Particles that are asleep, outside the 2^16 cells
    from the scene's origin, or not finite keep their state and are invisible to others.

    Attributes:
        priors: priors in order of application.
        layout: layout of the network's inputs and outputs.
        actions: action particles; None: the model has none.
        rounds: whether sizes of the geometry are rounded up in training; None: on a GPU only.
    """

    def __init__(self, config: DynamicsConfig):
        super().__init__()
        self.config, self.priors, self.rounds = config, config.build_priors(), None
        self._most_movable: int | None = None
        self.layout = StateLayout.of(config, self.priors)
        for prior in self.priors:
            prior.connect(config.encoder_channels[0], config.out_channels)
        network = PointTransformer if config.graph is None else partial(GraphNetwork, config.graph)
        self.net = network(self.layout.in_channels, self.layout.out_channels, config, tuple(self.priors))
        self.actions = ActionParticles(config) if config.actions else None

    def geometry(
        self,
        history: Particles,
        *,
        generator: torch.Generator | None = None,
        capacity: PyramidCapacity | None = None,
        curves: tuple[tuple[int, ...], ...] | None = None,
        rounded: bool = False,
    ) -> Pyramid:
        """Builds the integer geometry of a call from the positions.

        Args:
            history, generator: as :meth:`forward`.
            capacity, rounded: as :func:`gsim3d.ops.build_pyramid`.
            curves: indices of the curves of each level; None: drawn from ``generator``.
        """
        clouds = history.clouds
        slots, history_bits = self._slots(clouds, newest_clouds(clouds))
        curves = self._draw_curves(generator) if curves is None else curves
        options = {"curves": curves, "capacity": capacity, "rounded": rounded}
        seen, cu_rows, chosen = self._seen(history), history.cu_rows, None
        places = history.means.detach()
        if capacity is not None:
            options["capacity"] = capacity = capacity.of_rows(history.n_rows)
        if capacity is not None and capacity.sizes[0] < history.n_rows:
            chosen, cu_rows, seen, n_seen = _seen_first(seen, cu_rows, capacity.sizes[0])
            places = places[chosen]
        places = torch.where(seen[:, None], places, torch.nan)
        clouds = history.cloud_scene, constant(slots, cu_rows.device), history.origin
        pyramid = ops.build_pyramid(places, cu_rows, *clouds, self.config.pyramid_spec(history_bits), **options)
        return pyramid if chosen is None else pyramid.of_rows(chosen, n_seen)

    @contextlib.contextmanager
    def moving_at_most(self, n_rows: int) -> Iterator[None]:
        """Context in which no scene has more than ``n_rows`` movable particles beside action particles: a GPU then pads
        priors to this size without a device sync. A CPU counts them."""
        before, self._most_movable = self._most_movable, n_rows
        try:
            yield
        finally:
            self._most_movable = before

    def capacity(self, history: Particles) -> int:
        """Number of particles for which a pyramid of ``history`` needs capacity.

        With a relightable background it counts the particles that the network sees, which needs a device sync.
        """
        if not self.config.is_relightable:
            return history.n_rows
        return min(history.n_rows, math.ceil(SLACK * int(self._seen(history).sum())))

    def remember(self, background: Particles, *, generator: torch.Generator | None = None) -> FrozenContext:
        """Computes the context of a static ``background``, at most one cloud a scene, for all calls until it changes;
        ``generator`` and gradients as :meth:`forward`."""
        curves = self._draw_curves(generator)
        pyramid = self.geometry(background, curves=curves)
        context, recorders = FrozenContext.begin(pyramid, background, self.config.pyramid_spec(0), curves)
        if recorders:
            base = self.layout.input_columns(background)
            further = sum(prior.n_conv_features + prior.n_features for prior in self.priors)
            x = torch.cat([*base, base[0].new_zeros(len(base[0]), further)], 1)  # no features of priors
            x = ops.pool_mean(x, pyramid.rows, pyramid.cu_rows, check=False)
            self.net(x, pyramid, generator=self._draws(generator, x.device), contexts=recorders)
        return context

    def observe(self, particles: Particles, frames: Frames, n_views: int | None = None) -> Particles:
        """Initializes attributes of priors of ``particles`` that were encoded from ``frames``. ``n_views``: number of
        images of every cloud, if equal and in order of clouds, which avoids a device sync."""
        for prior in self.priors:
            ctx = self.context(particles)
            ctx.n_views = n_views
            particles = prior.initialize(particles, ctx, frames)
        return particles

    def initialize(self, particles: Particles) -> Particles:
        """Initializes attributes of priors at the start of a rollout or after an edit."""
        for prior in self.priors:
            particles = prior.initialize(particles, self.context(particles))
        return particles

    def begin(self, particles: Particles) -> Particles:
        """Adds missing attributes that a step reads."""
        if self.config.is_relightable:
            particles = with_attribute(particles, "initial_latents")
        for prior in self.priors:
            particles = prior.begin(particles, self.context(particles))
        return particles

    def forward(
        self,
        history: Particles,
        *,
        generator: torch.Generator | None = None,
        pyramid: Pyramid | None = None,
        background: FrozenContext | None = None,
        changes: Mapping[str, str] | None = None,
        newest: Newest | None = None,
    ) -> Particles:
        """Predicts the next ``config.steps_per_call`` steps of every scene.

        Args:
            history: clouds sorted by (scene, step). Steps may have different numbers of particles, and may be missing.
            generator: randomness of drop path and curve shuffling in training; None: neither is applied.
            pyramid: ``geometry(history)``; None: built here. A pyramid with a capacity avoids device syncs and gives
                the same values, as long as ``pyramid.found`` fits the capacity.
            background: context of the static particles, from :meth:`remember`; ``history`` then holds the moving
                particles of a :class:`Partition`. None: computed here if ``config.background="asymmetric"``.
            changes: attributes that a step changes, from ``layout.changes``; None: all predicted attributes.
            newest: of ``history``; None: made here.
        Returns:
            One cloud a scene and step, with the particles of the scene's newest step.
        Gradients:
            To features and positions of ``history`` and to parameters. Cell indices are constants.
        Raises:
            ValueError: clouds are not sorted, a history is too long, or a model with ``norm="batch"`` is trained on a
                pyramid with a capacity, whose padding would enter its statistics.
        """
        changes = changes or self.layout.changes()
        if background is None and self.config.is_asymmetric:
            return self._forward_in_parts(history, generator, changes)
        begun = self.begin(history)
        newest = newest if newest is not None and begun is history else Newest(begun)
        history = self._with_initial_latents(begun, changes)
        if pyramid is None:
            curves = None if background is None else background.curves
            rounded = background is None and self._rounds(history)
            pyramid = self.geometry(history, generator=generator, curves=curves, rounded=rounded)
        ctx = self.context(history, changes, partial(self._state, newest, changes))
        outputs, gains = self._predict(ctx, pyramid, generator, background)
        displacements = self.layout.displacements(ctx.state, outputs)
        if any(prior.acts for prior in self.priors) and not ctx.is_empty:
            displacements = self._move(ctx, displacements[0], gains)[None]
        steps = self.layout.advance(ctx.state, outputs, displacements, ctx.awake, changes)
        for prior in () if ctx.is_empty else self.priors:
            steps = [prior.finish(step, gains.get(prior.name), ctx) for step in steps]
        steps = [step.with_clouds(step.clouds.ahead(1 + i)) for i, step in enumerate(steps)]
        return steps[0] if len(steps) == 1 else concatenate(steps)

    def _move(self, ctx: StepContext, network: Tensor, gains: Mapping[str, Tensor]) -> Tensor:
        """Displacement [N, 3] in metres of a step with priors."""
        motion = Motion.of_network(network)
        for prior in self.priors:
            motion = prior.move(motion, gains.get(prior.name), ctx)
        limit = math.inf if self.config.max_step is None else self.config.max_step
        return motion.total().clamp(-limit, limit)

    def _predict(
        self, ctx: StepContext, pyramid: Pyramid, generator: torch.Generator | None, background: FrozenContext | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Outputs and gains of the network for the newest particles, from :meth:`StateLayout.split`."""
        history, n_data = ctx.history, [stage.n_data for stage in pyramid.stages]
        if pyramid.found is not None and self.training and self.config.norm == "batch" and None in n_data:
            said = 'norm="batch" cannot be trained with a pyramid of given capacity; use norm="layer"'
            raise ValueError(f"Dynamics: {said}")
        columns = self._columns(ctx)
        n_seen = pyramid.rows.shape[0] if pyramid.found is None else n_data[0]
        all_seen = n_seen == history.n_rows
        if not all_seen:  # rows of the pyramid <-> rows of the history; unseen rows become 0
            columns = [ops.pool_mean(column, pyramid.rows, pyramid.cu_rows, check=False) for column in columns]
        x = columns[0] if len(columns) == 1 else torch.cat(columns, 1)
        x = x.to(product_dtype(x)) if self.config.graph is None else x
        contexts = () if background is None else background.readers(pyramid, history)
        x = self.net(x, pyramid, generator=self._draws(generator, x.device), contexts=contexts)
        if not all_seen:
            both, lists = (x, x.new_ones(x.shape[0], 1)), (pyramid.rows, pyramid.cu_rows)
            x, seen = (ops.unpool(values, *lists, history.n_rows, check=False) for values in both)
            ctx.awake = ctx.select_newest(seen)[:, 0] > 0
        prediction = self.net.head(ctx.select_newest(x), self.layout.columns(ctx.changes))
        return self.layout.split(prediction, ctx.changes)

    def _columns(self, ctx: StepContext) -> list[Tensor]:
        """Input channels of the history, as columns [M, n]: for a graph network positions in cells, then attributes,
        conv features of priors, and their other features."""
        columns = self.layout.input_columns(ctx.history)
        if self.config.graph is not None:
            columns.insert(0, (relative_positions(ctx.history) / self.config.grid_size).to(columns[0]))
        for width, features in (("n_conv_features", "conv_features"), ("n_features", "features")):
            for prior in self.priors:
                if n := getattr(prior, width):
                    made = None if ctx.is_empty else getattr(prior, features)(ctx)
                    columns.append(columns[0].new_zeros(len(columns[0]), n) if made is None else made)
        return columns

    def context(
        self,
        particles: Particles,
        changes: Mapping[str, str] | None = None,
        state: Callable[[], Particles] | None = None,
    ) -> StepContext:
        """The context of priors for a step from ``particles``, of which ``state`` returns the newest."""
        n_points = 0 if particles.actions is None else particles.actions.n_points  # movable, too
        most = None if self._most_movable is None else self._most_movable + n_points
        options = {"most_movable": most, "changes": changes, "rows": self.layout.rows, "state": state}
        return StepContext(particles, self.priors, self.config.grid_size, 2**self.config.history_bits, **options)

    def _with_initial_latents(self, history: Particles, changes: Mapping[str, str]) -> Particles:
        """For a relightable background, resets the dynamic latents of frozen particles, and of bodies if their latents
        change, to their initial values. Those of particles that sleep, which the network does not receive, are then
        undefined."""
        if not self.config.is_relightable:
            return history
        latents = history.initial_latents.view_as(history.initial_latents)
        if changes["dynamic_latents"] not in ("all", "dynamic"):
            latents = torch.where((history.activity == FROZEN)[:, None], latents, history.dynamic_latents)
        return dataclasses.replace(history, dynamic_latents=latents)

    def _state(self, newest: Newest, changes: Mapping[str, str]) -> Particles:
        """The newest particles of :meth:`_with_initial_latents`; those that sleep keep their latents."""
        particles = newest()
        if not self.config.is_relightable:
            return particles
        latents = self._with_initial_latents(particles, changes).dynamic_latents
        latents = torch.where((particles.activity == ASLEEP)[:, None], particles.dynamic_latents, latents)
        return dataclasses.replace(particles, dynamic_latents=latents)

    def _draws(self, generator: torch.Generator | None, device: torch.device) -> torch.Generator | None:
        """The generator in training: ``generator``, or one on ``device`` seeded by it, to avoid device syncs."""
        if not self.training or generator is None or generator.device.type == device.type:
            return generator if self.training else None
        seed = torch.randint(2**62, (), generator=generator, device=generator.device).item()
        return torch.Generator(device).manual_seed(seed)

    def _seen(self, history: Particles) -> Tensor:
        """bool [N], particles in the network's input."""
        if not self.config.is_relightable:
            return history.activity != ASLEEP
        runs = history.clouds.row_runs(newest_clouds(history.clouds))
        frozen = constant((FROZEN,), history.activity.device).expand(sum(end - begin for begin, end in runs))
        return history.activity <= put_runs(frozen, runs, history.n_rows, DYNAMIC)  # frozen ones in the newest clouds

    def _rounds(self, history: Particles) -> bool:
        """Whether sizes are rounded up, so that matrix products have few different sizes: cuBLAS selects an algorithm
        on the host for every new size."""
        if torch.compiler.is_compiling():
            return False
        return self.training and history.means.is_cuda if self.rounds is None else self.rounds

    def _forward_in_parts(
        self, history: Particles, generator: torch.Generator | None, changes: Mapping[str, str]
    ) -> Particles:
        parts, steps = Partition.of(history, asymmetric=True), [None] * self.config.steps_per_call
        if not parts.nothing_moves:
            background = self.remember(parts.background, generator=generator)
            step = self(parts.moving, generator=generator, background=background, changes=changes)
            steps = single_steps(step)
        steps = [parts.whole(step, 1 + i) for i, step in enumerate(steps)]
        return steps[0] if len(steps) == 1 else concatenate(steps)

    def _slots(self, clouds: CloudTable, newest: list[int]) -> tuple[tuple[int, ...], int]:
        """Time slot of each cloud, and the number of bits of a slot (0 if no scene has several steps)."""
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
        shuffles = self.config.shuffle_orders and self.config.graph is None
        if generator is None or not (self.training and shuffles):
            return None
        draws = (torch.randperm(4, generator=generator, device=generator.device) for _ in range(self.config.n_stages))
        return tuple(tuple(draw.tolist()) for draw in draws)


def _seen_first(seen: Tensor, cu_rows: Tensor, n_rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Selects ``n_rows`` particles, seen ones first, without a device sync. Returns their indices, the offsets of the
    clouds among them, the mask of seen ones, and the total number of seen particles."""
    until = F.pad(seen.cumsum(0), (1, 0))
    rows = torch.sort(seen.view(torch.uint8), descending=True, stable=True).indices[:n_rows]
    starts = until[cu_rows].clamp(max=n_rows)
    starts[-1:].fill_(n_rows)
    return rows, starts, seen[rows], until[-1]
