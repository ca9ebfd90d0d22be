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

import torch
from torch import Tensor

from gsim3d.dynamics import concatenate
from gsim3d.errors import InputError
from gsim3d.graphs import Captured
from gsim3d.ops import PyramidCapacity
from gsim3d.ops.curve import Pyramid
from gsim3d.plans import Plan
from gsim3d.simulator import Simulator
from gsim3d.stability import StabilityReport
from gsim3d.train.samples import Batch
from gsim3d.types import ASLEEP, CloudTable, Frames, Particles

FACTOR = 1.3  # room for geometry over what was observed: little costs captures, much costs time in every step
ROWS_FACTOR = 1.15  # likewise, for the particles of a cloud
ROW_UNIT = 256  # rows of a cloud are a multiple of it
LEARNED = ("means", "opacities", "dynamic_latents", "static_latents")  # of encoded particles, what has gradients


@dataclass(frozen=True)
class Gradients:
    """loss: a number.   errors: [S], of each step.

    particles: gradients of LEARNED, by name.   parameters: gradients of ``CapturedLoss.parameters``, or None.
    """

    loss: Tensor
    errors: Tensor
    particles: dict[str, Tensor]
    parameters: tuple[Tensor | None, ...]


class CapturedLoss:
    """The loss of batches of one kind, and its gradients, from particles and targets.

    Without a GPU the same is computed call by call.

    Args:
        simulator: that is trained; without drop path and shuffled curves, whose draws a graph would repeat.
        plan: what a step computes.
        loss: (images [I, H, W, 3], targets, weights of the steps) -> loss and errors by step.
        precision: makes the context in which a part ("dynamics", "renderer") computes.

    Attributes:
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
        config = simulator.config.dynamics
        if (
            config.drop_path
            or config.shuffle_orders
            or config.norm == "batch"
            or config.explicit
            or config.is_asymmetric
        ):
            wanted = 'drop_path 0, shuffle_orders false, norm "layer", explicit false and a symmetric background'
            raise InputError(f"captured: the model must have {wanted}")
        self._simulator, self._plan, self._loss, self._precision = simulator, plan, loss, precision
        self._parameters = [*simulator.dynamics.parameters(), *simulator.renderer.parameters()]
        self._kind: tuple | None = None
        self._rows, self._capacities = 0, []
        self.alone: AbstractContextManager = nullcontext()
        self._release()
        self.captures = 0

    @property
    def parameters(self) -> list[Tensor]:
        """Those whose gradients it returns."""
        return self._parameters

    def __call__(self, particles: Particles, batch: Batch, weights: Tensor, report: StabilityReport) -> Gradients:
        """Of ``particles``, which the encoder made of ``batch``; gradients are overwritten by the next call.

        Args:
            weights: of the steps.
            report: is told what the simulator's guards find; rows that cannot be used sleep.
        """
        table = particles.clouds
        largest = max(table.count(q) for q in range(len(table)))
        kind = (table.scenes, table.steps, batch.n_future, len(batch.targets.cameras), particles.means.device)
        if kind != self._kind or largest > self._rows:
            self._release()
            self._kind, self._rows, self._capacities = kind, _rounded_up(ROWS_FACTOR * largest), []
            self._allocate(particles, batch, weights)
        places = self._load(particles, batch, weights)
        if not self._capacities:
            self._capacities = self._observed()
            self._capture()
        while True:
            loss, errors, gradients, found, records = self._replay()
            numbers = found.tolist()
            if all([capacity.fits(row) for capacity, row in zip(self._capacities, numbers, strict=True)]):
                break
            self._release()
            self._capacities = [c.grown(row, FACTOR) for c, row in zip(self._capacities, numbers, strict=True)]
            self._capacities = [c.grown((0, *o.sizes)) for c, o in zip(self._capacities, self._observed(), strict=True)]
            self._capture()
        records.replayed(report)
        n = len(LEARNED)
        of_rows = {name: g.index_select(0, places) for name, g in zip(LEARNED, gradients[:n], strict=True)}
        return Gradients(loss, errors, of_rows, tuple(gradients[n:]))

    # ---- what runs ----

    def _compute(self, geometry: Callable[[Particles], Pyramid], report: StabilityReport) -> tuple:
        simulator, options = self._simulator, {"report": report, "on_bad": "drop"}
        leaves = [getattr(self._state, name) for name in LEARNED]
        with self._precision("dynamics"):
            steps = simulator.rollout(self._state, self._n_future, self._plan, geometry=geometry, **options)
        with self._precision("renderer"):
            images = simulator.draw(
                concatenate([self._state, *steps]), self._targets.cameras, plan=self._plan, **options
            ).color
        loss, errors = self._loss(images, self._targets, self._weights)
        gradients = torch.autograd.grad(loss, [*leaves, *self._parameters], allow_unused=True)
        return loss.detach(), errors, gradients

    def _observed(self) -> list[PyramidCapacity]:
        """What the geometry of each step needs, with room."""
        needed = []

        def geometry(history: Particles) -> Pyramid:
            pyramid = self._simulator.dynamics.geometry(history)
            needed.append(PyramidCapacity.of(pyramid, history.n_rows, FACTOR))
            return pyramid

        with torch.no_grad(), self._precision("dynamics"):
            options = {"report": StabilityReport(), "on_bad": "drop"}
            self._simulator.rollout(self._state, self._n_future, self._plan, geometry=geometry, **options)
        return needed

    def _given(self, report: StabilityReport) -> tuple:
        """With geometry of the sizes of this object."""
        sizes, found = iter(self._capacities), []

        def geometry(history: Particles) -> Pyramid:
            found.append(self._simulator.dynamics.geometry(history, capacity=next(sizes)))
            return found[-1]

        loss, errors, gradients = self._compute(geometry, report)
        return loss, errors, gradients, torch.stack([pyramid.found for pyramid in found])

    def _capture(self) -> None:
        self.captures += 1
        if self._state.means.device.type != "cuda":
            return
        torch.cuda.empty_cache()
        self._records = StabilityReport()

        def function() -> tuple:
            capturing = torch.cuda.is_current_stream_capturing()
            return self._given(self._records if capturing else StabilityReport())

        with self.alone:
            self._graph = Captured(function, self._state.means.device)

    def _replay(self) -> tuple:
        if self._graph is None:
            records = StabilityReport()
            return *self._given(records), records
        return *self._graph(), self._records

    def _release(self) -> None:
        """Gives the graph's memory back."""
        self._graph = self._records = None

    # ---- what goes in ----

    def _allocate(self, particles: Particles, batch: Batch, weights: Tensor) -> None:
        table, device = particles.clouds, particles.means.device
        n_rows = self._rows * len(table)
        known = CloudTable.make([self._rows] * len(table), table.scenes, table.steps, device)
        fields = {name: x.new_zeros(n_rows, *x.shape[1:]) for name, x in particles.row_fields().items()}
        self._state = particles.with_clouds(known, **fields, origin=particles.origin.clone())
        for name in LEARNED:
            fields[name].requires_grad_()
        targets = batch.targets
        self._targets = dataclasses.replace(targets.map(torch.clone), cameras=targets.cameras.map(torch.clone))
        self._n_future, self._weights = batch.n_future, weights.clone()
        clouds = torch.arange(len(table), device=device)
        self._first_rows = clouds * self._rows

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


def _rounded_up(rows: float) -> int:
    return math.ceil(rows / ROW_UNIT) * ROW_UNIT
