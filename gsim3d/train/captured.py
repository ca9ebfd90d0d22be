"""Loss and gradients of simulated steps as one CUDA graph.

A training step through a rollout launches tens of thousands of small kernels; a GPU would wait for Python most of the
time. Everything behind the encoder (rollout, images, loss and their gradients) is captured once for each kind of batch
and replayed with other particles. A graph has fixed sizes: each cloud gets as many rows as the largest, those without a
particle sleep, and geometry has room for more than was observed. Where a batch needs more, the graph is made anew, so
results never depend on the room.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from gsim3d.dynamics import DynamicsConfig, concatenate
from gsim3d.errors import InputError
from gsim3d.graphs import Captured, with_background_as_it_is
from gsim3d.ops import PyramidCapacity
from gsim3d.ops.curve import Pyramid
from gsim3d.plans import Plan
from gsim3d.simulator import Simulator
from gsim3d.stability import StabilityReport
from gsim3d.train.samples import Batch
from gsim3d.types import ASLEEP, DYNAMIC, CloudTable, Frames, Particles

FACTOR = 1.3  # room for geometry over what was observed: little costs captures, much costs time in every step
ROWS_FACTOR = 1.15  # likewise, for the particles of a cloud
ROW_UNIT = 256  # rows of a cloud are a multiple of it
MOST_KINDS = 2  # of steps whose graphs are kept at a time
# Of encoded particles, what has gradients; a latent model has the first four only.
LEARNED = ("means", "opacities", "dynamic_latents", "static_latents", "quats", "scales", "sh")


@dataclass(frozen=True)
class Gradients:
    """loss: a number.   errors: [S], of each step.

    particles: gradients of those of LEARNED that have one, by name.
    parameters: gradients of ``CapturedLoss.parameters``, or None.
    """

    loss: Tensor
    errors: Tensor
    particles: dict[str, Tensor]
    parameters: tuple[Tensor | None, ...]


def check_capturable(config: DynamicsConfig) -> None:
    """Raises InputError for a model whose training steps no graph can repeat."""
    if config.drop_path or config.shuffle_orders or config.norm == "batch" or config.is_asymmetric:
        wanted = 'drop_path 0, shuffle_orders false, norm "layer" and a symmetric background'
        raise InputError(f"captured: the model must have {wanted}")


class CapturedLoss:
    """The loss of batches of one kind, and its gradients, from particles and targets.

    Without a GPU the same is computed call by call.

    Args:
        simulator: that is trained; without drop path and shuffled curves, whose draws a graph would repeat.
        plan: what a step computes.
        loss: (images [I, H, W, 3], targets, weights of the steps) -> loss and errors by step.
        precision: makes the context in which a part ("dynamics", "renderer") computes.

    Attributes:
        parameters: those whose gradients it returns.
        alone: a context in which no other thread uses the GPU, which a capture does not allow.
        captures: how often a graph was made.
    """

    def __init__(
        self,
        simulator: Simulator,
        plan: Plan,
        loss: Callable[[Tensor, Frames, Tensor], tuple[Tensor, Tensor]],
        precision: Callable[[str], torch.autocast],
    ):
        check_capturable(simulator.config.dynamics)
        self.simulator, self.plan, self.loss, self.precision = simulator, plan, loss, precision
        self.parameters = [*simulator.dynamics.parameters(), *simulator.renderer.parameters()]
        self.alone: AbstractContextManager = nullcontext()
        self.captures = 0
        self._steps: dict[tuple, _Step] = {}

    def __call__(self, particles: Particles, batch: Batch, weights: Tensor, report: StabilityReport) -> Gradients:
        """Of ``particles``, which the encoder made of ``batch``; gradients are overwritten by the next call.

        Args:
            weights: of the steps.
            report: is told what the simulator's guards find; rows that cannot be used sleep.
        """
        table = particles.clouds
        kind = (table.scenes, table.steps, batch.n_lead, batch.n_future, len(batch.targets.cameras))
        largest = max(table.count(q) for q in range(len(table)))
        step = self._steps.pop(kind, None)
        if step is None or largest > step.rows:
            step = None  # its memory goes back first
            while len(self._steps) >= MOST_KINDS:
                del self._steps[next(iter(self._steps))]
            step = _Step(self, _rounded_up(ROWS_FACTOR * largest), particles, batch, weights)
        self._steps[kind] = step  # now the newest
        return step(particles, batch, weights, report)


class _Step:
    """A step of one kind, with ``rows`` rows a cloud."""

    def __init__(self, owner: CapturedLoss, rows: int, particles: Particles, batch: Batch, weights: Tensor):
        self._owner, self.rows, self._capacities = owner, rows, []
        self._graph = self._records = None
        table, device = particles.clouds, particles.means.device
        known = CloudTable.make([rows] * len(table), table.scenes, table.steps, device)
        fields = {name: x.new_zeros(rows * len(table), *x.shape[1:]) for name, x in particles.row_fields().items()}
        if "quats" in fields:
            fields["quats"][:, 0] = 1
        self._learned = [name for name in LEARNED if name in fields]
        for name in self._learned:
            fields[name].requires_grad_()
        self._state = particles.with_clouds(known, **fields, origin=particles.origin.clone())
        targets = batch.targets
        self._targets = dataclasses.replace(targets.map(torch.clone), cameras=targets.cameras.map(torch.clone))
        self._n_lead, self._n_future, self._weights = batch.n_lead, batch.n_future, weights.clone()
        self._first_rows = torch.arange(len(table), device=device) * rows

    def __call__(self, particles: Particles, batch: Batch, weights: Tensor, report: StabilityReport) -> Gradients:
        places = self._load(particles, batch, weights)
        if not self._capacities:
            self._capacities = self._observed()
            self._capture()
        while True:
            loss, errors, gradients, found, records = self._replay()
            numbers = found.tolist()
            if all([capacity.fits(row) for capacity, row in zip(self._capacities, numbers, strict=True)]):
                break
            self._graph = self._records = loss = errors = gradients = found = None  # their memory goes back first
            grown = (c.grown(row, FACTOR) for c, row in zip(self._capacities, numbers, strict=True))
            self._capacities = [c.grown((0, *o.sizes), 1) for c, o in zip(grown, self._observed(), strict=True)]
            self._capture()
        records.replayed(report)
        n = len(self._learned)
        of_rows = {
            name: gradient.index_select(0, places)
            for name, gradient in zip(self._learned, gradients[:n], strict=True)
            if gradient is not None
        }
        return Gradients(loss, errors, of_rows, tuple(gradients[n:]))

    # ---- what runs ----

    def _rollout(self, geometry: Callable[[Particles], Pyramid], report: StabilityReport) -> list[Particles]:
        """The simulated steps that are looked at."""
        owner, state, plan = self._owner, self._state, self._owner.plan
        if plan.spec.dynamics.background == "masked_out":
            state, plan = _without_background(state), with_background_as_it_is(plan)
        rollout = partial(owner.simulator.rollout, plan=plan, geometry=geometry, report=report, on_bad="drop")
        with owner.precision("dynamics"):
            if self._n_lead:
                with torch.no_grad():
                    state = concatenate([state, *rollout(state, self._n_lead)])
            return rollout(state, self._n_future)

    def _compute(self, geometry: Callable[[Particles], Pyramid], report: StabilityReport) -> tuple:
        owner = self._owner
        leaves = [getattr(self._state, name) for name in self._learned]
        particles = concatenate([self._state, *self._rollout(geometry, report)])
        with owner.precision("renderer"):
            images = owner.simulator.draw(
                particles, self._targets.cameras, plan=owner.plan, report=report, on_bad="drop"
            ).color
        loss, errors = owner.loss(images, self._targets, self._weights)
        gradients = torch.autograd.grad(loss, [*leaves, *owner.parameters], allow_unused=True)
        return loss.detach(), errors, gradients

    def _observed(self) -> list[PyramidCapacity]:
        """What the geometry of each step needs, with room."""
        needed = []

        def geometry(history: Particles) -> Pyramid:
            pyramid = self._owner.simulator.dynamics.geometry(history)
            needed.append(PyramidCapacity.of(pyramid, history.n_rows, FACTOR))
            return pyramid

        with torch.no_grad():
            self._rollout(geometry, StabilityReport())
        return needed

    def _given(self, report: StabilityReport) -> tuple:
        """With geometry of the sizes of this object."""
        sizes, found = iter(self._capacities), []

        def geometry(history: Particles) -> Pyramid:
            found.append(self._owner.simulator.dynamics.geometry(history, capacity=next(sizes)))
            return found[-1]

        loss, errors, gradients = self._compute(geometry, report)
        return loss, errors, gradients, torch.stack([pyramid.found for pyramid in found])

    def _capture(self) -> None:
        self._owner.captures += 1
        if self._state.means.device.type != "cuda":
            return
        torch.cuda.empty_cache()
        self._records = StabilityReport()

        def function() -> tuple:
            capturing = torch.cuda.is_current_stream_capturing()
            return self._given(self._records if capturing else StabilityReport())

        with self._owner.alone:
            self._graph = Captured(function, self._state.means.device)

    def _replay(self) -> tuple:
        if self._graph is None:
            records = StabilityReport()
            return *self._given(records), records
        return *self._graph(), self._records

    @torch.no_grad()
    def _load(self, particles: Particles, batch: Batch, weights: Tensor) -> Tensor:
        """Copies a batch to where the graph reads it; the rows there of the particles' rows."""
        cloud = particles.row_cloud()
        places = (
            torch.arange(particles.n_rows, device=cloud.device) - particles.cu_rows[cloud] + self._first_rows[cloud]
        )
        state = self._state
        state.activity.fill_(ASLEEP)
        state.opacities.zero_()
        for name, value in state.row_fields().items():
            value.index_copy_(0, places, getattr(particles, name).detach().to(value.dtype))
        state.origin.copy_(particles.origin)
        self._weights.copy_(weights)
        for own, given in ((self._targets, batch.targets), (self._targets.cameras, batch.targets.cameras)):
            for name, value in vars(given).items():
                if isinstance(value, Tensor):
                    getattr(own, name).copy_(value)
        return places


def _without_background(state: Particles) -> Particles:
    """As if only what may move were there, in as many rows."""
    left_out = state.activity != DYNAMIC
    opacities = torch.where(left_out, 0.0, state.opacities)
    return dataclasses.replace(state, activity=torch.where(left_out, ASLEEP, state.activity), opacities=opacities)


def _rounded_up(rows: float) -> int:
    return math.ceil(rows / ROW_UNIT) * ROW_UNIT
