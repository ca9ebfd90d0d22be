"""Loss and gradients of a training step as a CUDA graph.

A training step launches tens of thousands of small kernels, so that a GPU mostly waits for Python. The whole step
(encoder, rollout, images, loss, gradients) is captured once per kind of batch and replayed with other images. A graph
has static shapes: clouds are padded to the largest one with sleeping particles, and geometry has spare capacity. A
batch that exceeds the capacity triggers a new capture, so results do not depend on it. Each graph has its own memory
pool; when the GPU's memory is exhausted, graphs share one.
"""

from __future__ import annotations

import dataclasses
import gc
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.modules.conv import _ConvNd

from gsim3d.cameras import Frames, TensorRecord
from gsim3d.cuda_graphs import Captured, fit, fixed_geometry, of_prepared_state
from gsim3d.dynamics import DynamicsConfig
from gsim3d.effects.plan import Plan
from gsim3d.errors import CaptureError, InputError
from gsim3d.io.checkpoint import laid_out_as
from gsim3d.nn.layers import RowLinear
from gsim3d.nn.multiview_encoder import Encoder, StaticShapes
from gsim3d.numerics.report import StabilityReport
from gsim3d.ops import PyramidCapacity
from gsim3d.ops.curve import Pyramid
from gsim3d.simulator import Simulator
from gsim3d.state import ASLEEP, DYNAMIC, Particles, concatenate
from gsim3d.train.gradients import in_segments, recomputing
from gsim3d.train.left_out import draw_left_out, images_per_cloud, with_views
from gsim3d.train.samples import Batch, displaced

# Capacity of geometry and clouds over the largest size so far: smaller causes more captures, larger makes steps slower.
FACTOR, PARTICLES_FACTOR = 1.1, 1.05
PARTICLES_UNIT = 256  # cloud capacities are multiples of it
MOST_KINDS = 4  # graphs kept at a time


@dataclass(frozen=True)
class Gradients:
    """Result of a call of :class:`CapturedLoss`."""

    loss: Tensor  #: scalar
    errors: Tensor  #: [S], mean squared error of each step
    #: gradient of each of ``CapturedLoss.parameters``; None if the loss does not depend on it
    parameters: tuple[Tensor | None, ...]


@dataclass(frozen=True)
class Prepared:
    """A batch with the sizes that the host needs to run its graph."""

    batch: Batch  #: the batch
    counts: tuple[int, ...]  #: number of particles of each cloud
    moving: int  #: largest number of movable particles of a cloud
    shapes: StaticShapes  #: static shapes of the encoder

    @property
    def kind(self) -> tuple:
        """Key of the graph: batches of equal kind can use the same one."""
        batch, table = self.batch, self.shapes.clouds
        images = len(batch.context.cameras), len(batch.targets.cameras)
        points = None if (actions := batch.context.actions) is None else (actions.positions.shape, actions.names)
        return table.scenes, table.steps, batch.n_future, batch.cut, images, points


def check_capturable(config: DynamicsConfig) -> None:
    """Raises InputError if training steps of the model cannot be captured in a CUDA graph."""
    if config.drop_path or config.shuffle_orders or config.norm == "batch" or config.is_asymmetric:
        wanted = 'drop_path 0, shuffle_orders false, norm "layer" and a symmetric background'
        raise InputError(f"captured: the model must have {wanted}")


class CapturedLoss:
    """Computes the loss of a batch and its gradients with CUDA graphs; without a GPU, step by step.

    Args:
        simulator: model to train, without drop path and shuffled curves, whose random draws a graph would repeat.
        plan: plan of the training.
        loss: function (images [I, H, W, 3], targets, weights of the steps) -> loss and errors by step.
        precision: function that returns the autocast context of a part ("encoder", "dynamics", "renderer").
        recompute: see TrainConfig.
        leaves_out: see ``leave_one_out`` of DataConfig.
        whole: the loss compares images of different steps. Otherwise each segment of a rollout (``Batch.cut``) has its
            backward pass before the next one begins, which frees its activations.

    Attributes:
        parameters: all parameters of the simulator, in the order of the gradients returned.
        alone: context in which no other thread uses the GPU or the simulator, entered for captures.
        meanwhile: called while the graph runs, for host work that should overlap with it.
        captures: number of captured graphs.
        most_particles: largest number of particles of a cloud so far.
        most_moving: largest number of movable particles of a cloud so far.
        most: largest geometry sizes that any simulated step needed so far, by (scenes, steps) of the encoded clouds.
    """

    def __init__(
        self,
        simulator: Simulator,
        plan: Plan,
        loss: Callable[[Tensor, Frames, Tensor], tuple[Tensor, Tensor]],
        precision: Callable[[str], torch.autocast],
        recompute: Collection[str] = (),
        leaves_out: bool = False,
        whole: bool = False,
    ):
        check_capturable(simulator.config.dynamics)
        self.simulator, self.plan, self.loss, self.precision = simulator, plan, loss, precision
        self.again, self.leaves_out = recomputing(recompute, simulator), leaves_out
        self.whole = whole
        self.parameters = list(simulator.parameters())
        self.alone: AbstractContextManager = nullcontext()
        self.meanwhile: Callable[[], None] = lambda: None
        self.captures = self.most_particles = self.most_moving = 0
        self.most: dict[tuple, tuple[int, ...]] = {}
        self._steps: dict[tuple, _Step] = {}
        self._pool: tuple[int, int] | None = None

    @property
    def needed(self) -> dict[str, Any]:
        """``most_particles``, ``most_moving`` and ``most`` as JSON values, for :meth:`reserve`."""
        geometry = [[*map(list, clouds), list(sizes)] for clouds, sizes in self.most.items()]
        return {"rows": self.most_particles, "moving": self.most_moving, "geometry": geometry, "margin": 1}

    def reserve(self, needed: dict[str, Any]) -> None:
        """Reserves capacity for the sizes ``needed`` in another run or process in all later captures."""
        self.most_particles = max(self.most_particles, needed["rows"])
        self.most_moving = max(self.most_moving, needed.get("moving", 0))
        margin = needed.get("margin", 1.5)  # that older versions had added
        for scenes, times, sizes in needed["geometry"]:
            self.grow((tuple(scenes), tuple(times)), [tuple(math.ceil(size / margin) for size in sizes)])

    def grow(self, clouds: tuple, sizes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
        """Raises ``most`` of these clouds to at least all of ``sizes``, and returns it."""
        known = [self.most[clouds]] if clouds in self.most else []
        if sizes or known:
            self.most[clouds] = tuple(map(max, zip(*sizes, *known, strict=True)))
        return self.most.get(clouds, ())

    def graph(self, step: _Step, function: Callable[[], Any]) -> Captured:
        """Captures the graph of ``step``.

        If the GPU's memory is exhausted, the graphs of other steps are freed (and captured again when needed), and from
        then on all graphs share one memory pool.

        Raises:
            CaptureError: the graph does not fit into memory alone, or cannot be captured.
        """
        device = self.parameters[0].device
        if self._pool is not None and all(other is step for other in self._steps.values()):
            self._pool = torch.cuda.graph_pool_handle()  # a pool cannot be reused after all its graphs are freed
        for is_last in (False, True):
            try:
                return Captured(function, device, self._pool)
            except CaptureError as error:
                if not error.out_of_memory:
                    raise
                if is_last:
                    raise CaptureError(
                        f"captured: {error}; lower batch, target_views or horizon of the phase, or set captured: false "
                        "and recompute: [encoder, steps]",
                        out_of_memory=True,
                    ) from error
            # Outside of the except block, because the error's traceback references the tensors to free.
            self._steps = {kind: other for kind, other in self._steps.items() if other is step}
            self._pool = torch.cuda.graph_pool_handle()
            gc.collect()
            torch.cuda.empty_cache()

    @torch.no_grad()
    def prepare(self, batch: Batch) -> Prepared:
        """Counts the particles of a batch; synchronises the device, also while a graph runs. Raises InputError or
        NumericalError if the batch is not a valid input of the encoder."""
        context, masks = batch.context, batch.context.masks
        n_clouds, (n_images, _, *size) = context.cloud_scene.shape[0], context.images.shape
        if masks is None:
            masks = torch.ones(n_images, *size, dtype=torch.bool, device=context.images.device)
        all_move = context.dynamic is None or self.plan.spec.dynamics.background == "dynamic"
        moving = masks if all_move else masks & context.dynamic
        counts, moving = torch.stack([x.reshape(n_clouds, -1).sum(1) for x in (masks, moving)]).tolist()
        return Prepared(batch, tuple(counts), max(moving), self.simulator.encoder.static_shapes(context, max(counts)))

    def __call__(self, prepared: Prepared, weights: Tensor, report: StabilityReport) -> Gradients:
        """Computes loss and gradients with the ``weights`` [S] of the steps; the next call overwrites the gradients.
        ``report`` counts invalid numbers; particles with some are put to sleep during a rollout."""
        kind, largest = prepared.kind, max(prepared.counts)
        self.most_particles = max(self.most_particles, largest)
        self.most_moving = max(self.most_moving, prepared.moving)
        step = self._steps.pop(kind, None)
        if step is None or largest > step.particles or prepared.moving > step.moving:
            step = None  # frees its memory before the new capture
            while len(self._steps) >= MOST_KINDS:
                del self._steps[next(iter(self._steps))]
            units = (PARTICLES_FACTOR * most / PARTICLES_UNIT for most in (self.most_particles, self.most_moving))
            step = _Step(self, *(PARTICLES_UNIT * math.ceil(n) for n in units), prepared, weights)
        self._steps[kind] = step  # most recently used
        return step(prepared, weights, report)


class _Step:
    """Graph of one kind of batch, for up to ``particles`` particles per cloud, of which ``moving`` are movable."""

    def __init__(self, owner: CapturedLoss, particles: int, moving: int, prepared: Prepared, weights: Tensor):
        self._owner, self._capacities, self._is_ready = owner, [], False
        self.particles, self.moving = particles, moving
        self._graph = self._records = None
        self._batch, self._clouds = prepared.batch.map(torch.clone), prepared.kind[:2]
        self._shapes = owner.simulator.encoder.static_shapes(prepared.batch.context, particles)
        self._weights = weights.clone()

    def __call__(self, prepared: Prepared, weights: Tensor, report: StabilityReport) -> Gradients:
        self._load(prepared, weights)
        done = self._replay() if self._is_ready else self._fitted()
        self._owner.meanwhile()
        while not fit(self._capacities, numbers := done[3].tolist()):
            self._graph = self._records = done = None  # frees memory before the capture
            too_small = [not c.fits(sizes) for c, sizes in zip(self._capacities, numbers, strict=True)].index(True)
            done = self._fitted([tuple(sizes[1:]) for sizes in numbers[: too_small + 1]])  # those behind it are wrong
        self._owner.grow(self._clouds, [tuple(sizes[1:]) for sizes in numbers])
        done[4].replayed(report)
        return Gradients(*done[:3])

    def _fitted(self, found: Sequence[tuple[int, ...]] = ()) -> tuple:
        """Captures with room for the batch and sizes ``found``, and computes it; alone, as it rounds weights."""
        with self._owner.alone:
            self._grow(self._observed(), found)
            self._capture()
            return self._replay()

    def _grow(self, observed: Sequence[PyramidCapacity], found: Sequence[tuple[int, ...]] = ()) -> None:
        """Makes capacity for the largest sizes of all kinds of batches: what was exceeded once will soon be again."""
        if not observed:
            return
        most = self._owner.grow(self._clouds, [*(capacity.sizes for capacity in observed), *found])
        empty = PyramidCapacity(observed[0].n_stages, (0,) * len(most))
        self._capacities = [empty.grown((0, *most), FACTOR)] * len(observed)

    # ---- computation ----

    def _encode(self, report: StabilityReport) -> Particles:
        owner = self._owner

        def encode(context: Frames) -> Particles:
            with _rounded(owner.simulator.encoder):
                return owner.simulator.encode(context, shapes=self._shapes, report=report)

        with owner.precision("encoder"):
            state = owner.again("encoder")(encode)(self._batch.context)
        return with_views(state, self._batch.context, self._shapes) if owner.leaves_out else state

    def _segments(
        self,
        state: Particles,
        geometry: Callable[[Particles], Pyramid],
        report: StabilityReport,
        wrap: Callable[[Callable], Callable] | None = None,
    ) -> Iterator[list[Particles]]:
        """Yields the simulated steps of each segment; ``wrap`` as in Simulator.rollout."""
        owner, plan = self._owner, self._owner.plan
        if self._batch.n_future and plan.spec.dynamics.background == "masked_out":
            left_out, plan = state.activity != DYNAMIC, of_prepared_state(plan)  # the number of particles stays
            hidden = {"activity": torch.where(left_out, ASLEEP, state.activity)}
            state = dataclasses.replace(state, opacities=torch.where(left_out, 0.0, state.opacities), **hidden)
        elif self._batch.n_future:
            state = owner.simulator._prepare(state, plan)
        state = displaced(state, self._batch.noise, owner.simulator.config.dynamics.grid_size)

        def rollout(state: Particles, n_steps: int) -> list[Particles]:
            given = {"geometry": geometry, "report": report, "on_invalid": "drop", "wrap": wrap}
            with owner.precision("dynamics"):
                return owner.simulator.rollout(state, n_steps, plan=plan, **given)

        return in_segments(rollout, state, self._batch.n_future, self._batch.cut, plan.history)

    def _compute(self, geometry: Callable[[Particles], Pyramid], report: StabilityReport) -> tuple:
        owner, dynamics, of_calls, n_calls = self._owner, self._owner.simulator.dynamics, [], itertools.count(1)
        geometry = _OfCalls(geometry)

        def aliases_of(weights: Sequence[Tensor]) -> list[Tensor]:  # whose gradients few multi-tensor kernels add
            return [weight.detach().requires_grad_() for weight in weights]

        def with_own_weights(predict: Callable[[Particles], Particles]) -> Callable[[Particles], Particles]:
            def call(state: Particles) -> Particles:
                with _replaced(dynamics.modules(), aliases_of) as aliases:
                    of_calls.append(aliases)
                    return owner.again("steps")(geometry.in_call(next(n_calls), predict))(state)

            return call

        state = self._encode(report)
        segments = self._segments(state, geometry, report, with_own_weights)
        if owner.whole:
            segments = iter([list(chain.from_iterable(segments))])
        once = [*owner.simulator.encoder.parameters(), *owner.simulator.renderer.parameters()]
        losses, errors, total = [], [], [None] * (len(once) + len(list(dynamics.parameters())))
        begin, steps = 0, [state, *next(segments, [])]
        while steps:
            particles = concatenate(steps)
            end = begin + particles.n_clouds // len(self._batch.targets.origin)
            loss, wrong = self._loss(particles, begin, end, report)
            gradients = torch.autograd.grad(loss, [*once, *chain.from_iterable(of_calls)], allow_unused=True)
            n = len(total) - len(once)
            by_call = [gradients[first : first + n] for first in range(len(once), len(gradients), n)]
            found = [*gradients[: len(once)], *(_sums(by_call[::-1]) if by_call else [None] * n)]
            total = _sums([total, found])
            losses.append(loss.detach())
            errors.append(wrong)
            of_calls.clear()
            report.is_closed = False
            begin, steps = end, next(segments, [])
        report.close()
        known = dict(zip([*once, *dynamics.parameters()], total, strict=True))
        gradients = tuple(
            None if (gradient := known.get(parameter)) is None else laid_out_as(parameter, gradient)
            for parameter in owner.parameters
        )
        return sum(losses[1:], losses[0]), torch.cat(errors), gradients

    def _loss(self, particles: Particles, begin: int, end: int, report: StabilityReport) -> tuple[Tensor, Tensor]:
        """Loss and errors of the steps from ``begin`` to ``end`` of the window; closes the report, since recomputation
        in the backward pass must not count again."""
        owner, targets = self._owner, self._targets_of(begin, end)
        with owner.precision("renderer"):
            shown = {"plan": owner.plan, "report": report, "on_invalid": "drop"}
            draw = owner.again("images")(
                lambda p, cameras, valid: owner.simulator._draw(p, cameras, active=valid, **shown).color
            )
            if owner.leaves_out:
                images = draw_left_out(draw, particles, targets, images_per_cloud(self._batch.context))
            else:
                images = draw(particles, targets.cameras, targets.valid)
        report.close()
        return owner.loss(images, targets, self._weights[begin:end])

    def _targets_of(self, begin: int, end: int) -> Frames:
        """The target images of the steps from ``begin`` to ``end`` of each scene's window."""
        targets, n_steps = self._batch.targets, len(self._weights)
        if end - begin == n_steps:
            return targets
        number = torch.arange(len(targets.cameras), device=self._weights.device)
        chosen = number.view(len(targets.origin), n_steps, -1)[:, begin:end].flatten()
        shows = number[: len(chosen)] // (len(chosen) // (len(targets.origin) * (end - begin)))
        fields = {name: getattr(targets, name) for name in ("images", "dynamic", "valid")}
        fields = {name: None if value is None else value[chosen] for name, value in fields.items()}
        return dataclasses.replace(targets, cameras=targets.cameras.select(chosen, shows), **fields)

    @torch.no_grad()
    def _observed(self) -> list[PyramidCapacity]:
        """Observes the geometry sizes of each step."""
        dynamics, needed = self._owner.simulator.dynamics, []

        def geometry(history: Particles) -> Pyramid:
            pyramid = dynamics.geometry(history)
            needed.append(PyramidCapacity.of(pyramid, pyramid.stages[0].n_rows, 1))
            return pyramid

        if self._batch.n_future:
            with dynamics.moving_at_most(self.moving):
                list(self._segments(self._encode(StabilityReport()), geometry, StabilityReport()))
        return needed

    def _given(self, report: StabilityReport) -> tuple:
        """Computes the step with geometry of the current capacities."""
        geometry, found = fixed_geometry(self._owner.simulator.dynamics, self._capacities)
        with self._owner.simulator.dynamics.moving_at_most(self.moving):
            computed = self._compute(geometry, report)
        return *computed, torch.stack(found) if found else self._weights.new_empty(0)

    def _capture(self) -> None:
        self._owner.captures += 1
        self._is_ready = False
        if self._weights.device.type == "cuda":
            torch.cuda.empty_cache()

            def function() -> tuple:
                report = StabilityReport()
                if torch.cuda.is_current_stream_capturing():
                    self._records = report
                return self._given(report)

            self._graph = self._owner.graph(self, function)
        self._is_ready = True

    def _replay(self) -> tuple:
        if self._graph is None:
            records = StabilityReport()
            return *self._given(records), records
        return *self._graph(), self._records

    @torch.no_grad()
    def _load(self, prepared: Prepared, weights: Tensor) -> None:
        """Copies a batch into the static input tensors of the graph."""
        self._shapes.copy_(prepared.shapes)
        self._weights.copy_(weights)
        _copy(self._batch, prepared.batch)


class _OfCalls:
    """Caches the geometry of each call of the dynamics, so that recomputation in the backward pass reuses it."""

    def __init__(self, make: Callable[[Particles], Pyramid]):
        self._make, self._made, self._call = make, {}, 0

    def __call__(self, history: Particles) -> Pyramid:
        if self._call not in self._made:
            made = self._make(history)
            if not self._call:
                return made
            self._made[self._call] = made
        return self._made[self._call]

    def in_call(self, number: int, predict: Callable[[Particles], Particles]) -> Callable[[Particles], Particles]:
        """Wraps ``predict`` as call ``number`` (from 1); geometry made outside of calls is not cached."""

        def run(state: Particles) -> Particles:
            self._call = number
            try:
                return predict(state)
            finally:
                self._call = 0

        return run


@contextmanager
def _replaced(modules: Iterable[nn.Module], make: Callable[[list[Tensor]], Sequence[Tensor]]) -> Iterator:
    """Replaces the parameters of ``modules`` by what ``make`` returns for them; yields it, in their order."""
    owners = [(of, name, value) for of in modules for name, value in of._parameters.items() if value is not None]
    made = make([value for *_, value in owners])
    try:
        for (part, name, _), value in zip(owners, made, strict=True):
            part._parameters[name] = value
        yield made
    finally:
        for part, name, value in owners:
            part._parameters[name] = value


def _rounded(encoder: Encoder) -> AbstractContextManager:
    """Replaces weights by those that ``torch.autocast`` would round one by one, rounded by one operation."""
    device = next(encoder.parameters()).device.type
    if encoder.config.backbone == "vit_dpt" or not torch.is_autocast_enabled(device):  # the former is float32 in parts
        return nullcontext()
    products = (p for p in encoder.modules() if isinstance(p, (nn.Linear, _ConvNd)) and not isinstance(p, RowLinear))
    return _replaced(products, lambda values: _Rounded.apply(torch.get_autocast_dtype(device), *values))


class _Rounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx, dtype: torch.dtype, *values: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        return tuple(_in_dtype(values, dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        wide = iter(_in_dtype([grad for grad in grads if grad is not None], torch.float32))
        return None, *(grad if grad is None else next(wide) for grad in grads)


def _in_dtype(values: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    copies = [torch.empty_like(value, dtype=dtype) for value in values]
    torch._foreach_copy_(copies, list(values))
    return copies


def _sums(by_call: Sequence[Sequence[Tensor | None]]) -> list[Tensor | None]:
    """Sums lists of tensors over calls, in order; None counts as zero."""
    total = list(by_call[0])
    for call in by_call[1:]:
        both = [k for k, (a, b) in enumerate(zip(total, call, strict=True)) if a is not None and b is not None]
        added = torch._foreach_add([total[k] for k in both], [call[k] for k in both]) if both else []
        total = [b if a is None else a for a, b in zip(total, call, strict=True)]
        for k, value in zip(both, added, strict=True):
            total[k] = value
    return total


def _copy(own: TensorRecord, given: TensorRecord) -> None:
    for name, mine in vars(own).items():
        if isinstance(mine, TensorRecord):
            _copy(mine, getattr(given, name))
        elif isinstance(mine, Tensor) and name != "world_offset":  # nothing here reads it
            mine.copy_(getattr(given, name))
