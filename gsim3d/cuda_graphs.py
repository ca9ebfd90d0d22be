"""CUDA graphs: a GPU runs all kernels of a rollout back to back, without Python and without waiting.

    with torch.autocast("cuda", torch.bfloat16):
        captured = CapturedRollout(simulator, state, 12, plan, cameras=cameras)
    steps, renderings = captured(state)               # again and again, with other particles in as many rows

A graph repeats the same kernels on the same memory, so that nothing in it may have a size that depends on particles:
geometry is made with given sizes (:class:`gsim3d.ops.PyramidCapacity`), observed in a first rollout and multiplied by
``factor``. Particles that need more are noticed by a flag that is read when the replay is over; the rollout is then
captured anew with more capacity, and repeated.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import gc
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d.cameras import Cameras
from gsim3d.dynamics import FrozenContext, Partition, rollout
from gsim3d.effects.plan import Plan
from gsim3d.errors import CaptureError, InputError
from gsim3d.nn.point_transformer import SparseConv
from gsim3d.numerics.report import StabilityReport, pack
from gsim3d.ops.curve import Pyramid, PyramidCapacity
from gsim3d.ops.raster import Rendering
from gsim3d.state import DYNAMIC, CloudTable, Particles, keeping_constants, newest_clouds

FACTOR = 1.25  # capacity over what was observed
ROUNDED_PARTS = "dynamics", "renderer"  # of a simulator: what a rollout reads
# In messages of errors for lack of memory: torch's, and those of ops, which say no more.
OUT_OF_MEMORY = "out of memory", "DefaultCPUAllocator", "STATUS_ALLOC_FAILED", "aten::new_empty"


class Captured:
    """A function without arguments as a CUDA graph; calling it runs the graph and returns the same tensors each time.

    The function reads and writes the same memory in every replay: inputs are copied to where it reads them, results are
    overwritten by the next call. It must not wait for the device, so the dynamics in it gets geometry of given sizes; a
    backward pass (``torch.autograd.grad``) may be part of it. Autocast rounds weights anew in every replay.

    Args:
        function: is called twice before it is captured.
        device: of all that it does.
        pool: of torch.cuda.graph_pool_handle(), memory that graphs share which run one after another, and whose results
            are not read once another of them has run; None: its own.
    Raises:
        CaptureError: it cannot be captured; the message repeats CUDA's.
    """

    def __init__(
        self, function: Callable[[], Any], device: torch.device | str = "cuda", pool: tuple[int, int] | None = None
    ):
        self._device, self._constants = torch.device(device), {}
        if self._device.type != "cuda":
            raise CaptureError(f"Captured: device must be a GPU; got {device}")
        cached = torch.is_autocast_cache_enabled()
        torch.set_autocast_cache_enabled(False)
        torch.clear_autocast_cache()  # what it holds was made on another stream, for which a backward pass would wait
        try:
            with torch.cuda.device(self._device), keeping_constants(self._constants):
                self._capture(function, pool)
        except (RuntimeError, MemoryError) as error:
            message = f"Captured: {str(error).splitlines()[0]}"
            raise CaptureError(message, out_of_memory=is_out_of_memory(error)) from error
        finally:
            torch.set_autocast_cache_enabled(cached)

    def _capture(self, function: Callable[[], Any], pool: tuple[int, int] | None) -> None:
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(2):  # kernels are loaded and constants made before the capture
                function()
        torch.cuda.current_stream().wait_stream(side)
        self._graph = torch.cuda.CUDAGraph()
        # What other threads do (one of NCCL asks the GPU what is done, at any time) must not end the capture.
        with collecting_nothing(), torch.cuda.graph(self._graph, pool=pool, capture_error_mode="thread_local"):
            self.result = function()

    def __call__(self) -> Any:
        with torch.cuda.device(self._device):
            self._graph.replay()
        return self.result


def is_out_of_memory(error: BaseException) -> bool:
    """Whether it was raised because memory was lacking."""
    if isinstance(error, MemoryError) or any(text in str(error) for text in OUT_OF_MEMORY):
        return True
    cause = error.__cause__ or error.__context__  # a capture that is broken off complains of that, too
    return cause is not None and is_out_of_memory(cause)


@contextlib.contextmanager
def collecting_nothing() -> Iterator[None]:
    """No garbage is collected inside: another graph that happens to be freed then would end a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Prediction(NamedTuple):
    """The steps of a rollout and their images.

    Attributes:
        steps: particles of each predicted step, one cloud a scene.
        renderings: images of each step; empty where no cameras were given.
    """

    steps: list[Particles]
    renderings: list[Rendering]


class CapturedRollout:
    """:meth:`Simulator.rollout`, and a rendering of every step, replayed from a CUDA graph. Without gradients.

    The graph belongs to the numbers of particles, scenes and steps of ``state``, to the plan, to autocast as it is when
    the object is made, and to the model in evaluation. Under autocast the weights of matrix products and convolutions
    are rounded once, into a copy: call :meth:`reload` after the model has changed. Else it reads the model's own.

    With ``background="asymmetric"`` the graph advances the movable particles, as many in every call. The frozen context
    is computed outside of the graph whenever it has changed (call :meth:`reload` after the model has); where it needs
    more capacity the graph is captured anew. Particles do not sleep in a graph.

    On the CPU there are no graphs: calls run the same steps one by one, with the same sizes and the same results.

    Args:
        simulator: :class:`gsim3d.Simulator` in evaluation mode.
        state: last steps of every scene; its clouds fix the numbers of particles.
        n_steps: how many steps to predict.
        plan: what to compute; default that of ``simulator.plan()``.
        cameras: render these of every step, which has one cloud a scene.
        background: of the images, [3] or [I, 3], default black.
        factor: capacity of the geometry over what the rollout of ``state`` needs, at least 1.
        copies: results are copies; False: the graph's own memory, which the next call overwrites.
        report: counts numbers that cannot be used; default ``simulator.report``.
        cutoff: of Gaussians, see :meth:`Simulator.render`.
    Raises:
        InputError: an argument does not fit; the message names it.

    Attributes:
        captures: how often the graph was captured, 1 as long as the capacity sufficed.
    """

    def __init__(
        self,
        simulator: Any,
        state: Particles,
        n_steps: int,
        plan: Plan | None = None,
        *,
        cameras: Cameras | None = None,
        background: Tensor | None = None,
        factor: float = FACTOR,
        copies: bool = True,
        report: StabilityReport | None = None,
        cutoff: str = "exact",
    ):
        if simulator.training:
            raise InputError("CapturedRollout: simulator must be in evaluation mode; call simulator.eval()")
        if n_steps < 1:
            raise InputError(f"CapturedRollout: n_steps must be at least 1; got {n_steps}")
        if not factor >= 1:
            raise InputError(f"CapturedRollout: factor must be at least 1; got {factor}")
        if cameras is not None and not simulator.draws_in_graphs:
            raise InputError("CapturedRollout: this model draws outside of graphs only; leave cameras out")
        self._simulator, self._n_steps, self._factor, self._copies = simulator, n_steps, factor, copies
        self._plan, self._drawn = plan or simulator.plan(), plan
        self._report = simulator.report if report is None else report
        self._report.poll()
        self._background, self._cutoff = background, cutoff
        if self._plan.spec.dynamics.sleep is not None:
            raise InputError("CapturedRollout: plan must be one without dynamics.sleep: it is not part of a graph")
        prepared = simulator._prepare(state, self._plan)
        self._table, self._state, self._frozen = prepared.clouds, _own(prepared), None
        self._cameras = None if cameras is None else cameras.map(torch.clone)
        self._device = prepared.means.device
        kind = self._device.type
        self._dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else None
        self._model = simulator
        if self._dtype is not None and kind == "cuda":
            self._model = copy.copy(simulator)
            parts = {name: rounded(getattr(simulator, name), self._dtype) for name in ROUNDED_PARTS}
            self._model.__dict__["_modules"] = {**simulator._modules, **parts}
        self.captures = 0
        self._launched = self._is_stale = False
        if simulator.config.dynamics.is_asymmetric:
            parts = self._partition(prepared)
            if parts.nothing_moves:
                raise InputError("CapturedRollout: state has no particle that moves; there is nothing to capture")
            self._state = _own(parts.moving)
            own = Partition(_own(parts.newest), self._state, _own(parts.background), parts.rows.clone())
            self._frozen = _Frozen(own, self._remember(parts.background))
        self._moving = self._capacity_for(int(self._count_moving()))
        self._resize(self._observed())

    def __call__(self, state: Particles, cameras: Cameras | None = None) -> Prediction:
        """The rollout of ``state``, which has as many particles, scenes and steps as the first one.

        Args:
            state: steps may be numbered otherwise.
            cameras: as many and as large as the first; default the last ones given.
        Raises:
            InputError: ``state`` or ``cameras`` does not fit the graph.
        """
        self.launch(state, cameras)
        return self.finish()

    def launch(self, state: Particles, cameras: Cameras | None = None) -> None:
        """Starts what :meth:`__call__` does and waits for nothing (except to leave out a masked background, and to
        separate an asymmetric one).

        Raises:
            NumericalError: of an earlier call, under the policy "raise".
        """
        state = self._simulator._prepare(state, self._plan)
        self._check(state, self._table)
        tables, self._world_offset = state.clouds, state.world_offset
        if self._frozen is not None:
            state = self._load_parts(self._partition(state))
        _copy(self._state, state)
        if cameras is not None:
            self._load(cameras)
        self._tables = tables
        self._launched = True
        self._replay()
        self._report.poll()  # here the host reads while the device works

    def finish(self) -> Prediction:
        """Waits for what was launched; repeats it with more capacity where it did not fit."""
        if not self._launched:
            raise InputError("CapturedRollout: finish() must follow launch()")
        self._launched = False
        found, moving, counted = self._arrive()
        while moving > self._moving or not self._fits(found):
            self._moving = max(self._moving, self._capacity_for(moving))
            calls = zip(self._capacities, found, strict=True)
            grown = [capacity.grown(numbers, self._factor) for capacity, numbers in calls]
            self._resize([a.grown((0, *b.sizes)) for a, b in zip(grown, self._observed(), strict=True)])
            self._replay()
            found, moving, counted = self._arrive()
        self._records.replayed(self._report, counted)
        return self._results()

    def reload(self) -> None:
        """Reads the weights of the simulator again, and makes the background anew in the next call."""
        self._is_stale = True
        if self._model is not self._simulator:
            for name in ROUNDED_PARTS:
                getattr(self._model, name).load_state_dict(getattr(self._simulator, name).state_dict())

    # ---- what runs ----

    def _rollout(self, geometry, report: StabilityReport) -> Prediction:
        """The rollout of the graph's own state."""
        plan, frozen = of_prepared_state(self._plan), self._frozen
        options, renderings = {"geometry": geometry, "report": report}, []
        at_most = self._model.dynamics.moving_at_most(self._moving)
        with torch.no_grad(), self._autocast(), at_most:
            if frozen is None:
                steps = self._model.rollout(self._state, self._n_steps, plan, **options)
            else:
                moving = self._advance(frozen.context, plan, **options)
                steps = [frozen.partition.whole(step, 1 + i) for i, step in enumerate(moving)]
            if self._cameras is not None:
                drawn = {"plan": self._drawn, "cutoff": self._cutoff, "report": report}
                renderings += [self._model._draw(step, self._cameras, self._background, **drawn) for step in steps]
        return Prediction(steps, renderings)

    def _partition(self, prepared: Particles) -> Partition:
        """Movable and frozen particles of a state, for a model with an asymmetric background."""
        validated = self._simulator._guard("rollout", None, self._report)(prepared)
        return Partition.of(validated, asymmetric=True)

    def _advance(self, context: FrozenContext, plan: Plan, geometry, report: StabilityReport) -> list[Particles]:
        """The rollout of the movable particles alone."""
        guard = self._model._guard("rollout", None, report)
        options = {"plan": plan, "generator": None, "guard": guard, "geometry": geometry, "background": context}
        predict = functools.partial(self._model._predict, **options)
        return rollout(predict, self._state, self._n_steps, plan.history)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self._device.type, self._dtype, enabled=self._dtype is not None, cache_enabled=False)

    def _remember(self, background: Particles) -> FrozenContext:
        with torch.no_grad(), self._autocast():
            return self._model.dynamics.remember(background).with_capacity(self._factor)

    def _observed(self) -> list[PyramidCapacity]:
        """Capacities that the calls of the dynamics need; from a rollout that waits for every count."""
        needed = []

        def geometry(history: Particles) -> Pyramid:
            pyramid = self._model.dynamics.geometry(history)
            needed.append(PyramidCapacity.of(pyramid, self._model.dynamics.capacity(history), self._factor))
            return pyramid

        self._rollout(geometry, StabilityReport())
        return needed

    def _count_moving(self) -> Tensor:
        """int64 [1], largest number of movable particles of a scene of the graph's own state."""
        table, until = self._state.clouds, F.pad((self._state.activity == DYNAMIC).cumsum(0), (1, 0))
        counts = [until[table.starts[q + 1]] - until[table.starts[q]] for q in newest_clouds(table)]
        return torch.stack(counts).amax(0, keepdim=True)

    def _capacity_for(self, moving: int) -> int:
        return min(self._state.n_rows, math.ceil(self._factor * moving))

    def _fits(self, found: list[list[int]]) -> bool:
        return all([capacity.fits(numbers) for capacity, numbers in zip(self._capacities, found, strict=True)])

    def _given(self, report: StabilityReport) -> tuple[Prediction, Tensor]:
        """The rollout with the sizes of this object, and what the geometry of every call found."""
        sizes, found = iter(self._capacities), []

        def geometry(history: Particles) -> Pyramid:
            found.append(self._model.dynamics.geometry(history, capacity=next(sizes)))
            return found[-1]

        predicted = self._rollout(geometry, report)
        return predicted, torch.stack([pyramid.found for pyramid in found])

    def _resize(self, capacities: list[PyramidCapacity]) -> None:
        """Takes ``capacities`` as sizes and, on a GPU, makes the graph."""
        self._capacities, self._records = capacities, StabilityReport()
        self.captures += 1
        if self._device.type != "cuda":
            return
        # their memory goes back before the next graph takes its own
        self._graph = self._predicted = self._found = self._packed = None
        self._graph = Captured(self._capture, self._device)
        self._predicted, self._found, self._packed = self._graph.result
        self._on_host = torch.empty(self._packed.shape, dtype=self._packed.dtype, pin_memory=True)
        self._arrived = torch.cuda.Event()

    def _capture(self) -> tuple[Prediction, Tensor, Tensor]:
        report = self._records if torch.cuda.is_current_stream_capturing() else StabilityReport()
        predicted, found = self._given(report)
        return predicted, found, pack([found, self._count_moving(), *report.captured()])

    def _replay(self) -> None:
        if self._device.type != "cuda":
            self._records = StabilityReport()
            self._predicted, self._found = self._given(self._records)
            return
        with torch.cuda.device(self._device):
            self._graph()
            self._on_host.copy_(self._packed, non_blocking=True)
            self._arrived.record()

    def _arrive(self) -> tuple[list[list[int]], int, Tensor | None]:
        """Waits for the replay: what the geometry of every call found, rows that may move, and what the
        validation in the graph counted."""
        if self._device.type != "cuda":
            return self._found.tolist(), int(self._count_moving()), None
        self._arrived.synchronize()
        found, moving, counted = self._on_host.clone().tensor_split([n := self._found.numel(), n + 1])
        return found.view(self._found.shape).tolist(), int(moving), counted

    # ---- what goes in and comes out ----

    def _load_parts(self, parts: Partition) -> Particles:
        """Copies the frozen particles into the graph's memory; returns the movable ones."""
        own = self._frozen.partition
        self._check(parts.moving, own.moving.clouds, " in what moves")
        background = parts.background.row_fields()
        own_background = own.background.row_fields()
        changed = self._is_stale or not all(torch.equal(background[name], x) for name, x in own_background.items())
        _copy(own.newest, parts.newest)
        _copy(own.background, parts.background)
        own.rows.copy_(parts.rows)
        if changed:
            self._is_stale = False
            remembered = self._remember(parts.background)
            if not self._frozen.context.load(remembered):
                self._frozen = _Frozen(own, remembered)
                self._resize(self._observed())
        return parts.moving

    def _check(self, state: Particles, own: CloudTable, where: str = "") -> None:
        table = state.clouds
        if (table.starts, table.scenes) != (own.starts, own.scenes):
            raise InputError(
                f"CapturedRollout: state must have the rows and scenes of the first one{where}, clouds that start at "
                f"rows {[*own.starts]} of scenes {[*own.scenes]}; got {[*table.starts]} of {[*table.scenes]}"
            )
        if _gaps(table) != _gaps(own):
            raise InputError(
                f"CapturedRollout: state must have steps as far apart as the first one, {list(own.steps)}; "
                f"got {list(table.steps)}"
            )
        for name, value in self._state.row_fields().items():
            given, shape = getattr(state, name), (table.starts[-1], *value.shape[1:])
            if given is None or given.shape != shape or given.device != value.device:
                raise InputError(f"CapturedRollout: state.{name} must be {list(shape)} on {value.device}")

    def _load(self, cameras: Cameras) -> None:
        own = self._cameras
        fixed = None if own is None else (len(own), own.width, own.height)
        if fixed != (len(cameras), cameras.width, cameras.height):
            wanted = "none" if own is None else "{} of {} x {} pixels".format(*fixed)
            raise InputError(
                f"CapturedRollout: cameras must be those of the first call in number and size, {wanted}; "
                f"got {len(cameras)} of {cameras.width} x {cameras.height}"
            )
        for name in ("viewmats", "Ks", "near", "far", "image_cloud"):
            getattr(own, name).copy_(getattr(cameras, name))

    def _results(self) -> Prediction:
        """The results with the step numbers of the state that was given."""
        later = {s: given - own for s, given, own in zip(self._table.scenes, self._tables.steps, self._table.steps)}
        steps = []
        for step in self._predicted.steps:
            table, device = step.clouds, self._device
            counts = [table.count(q) for q in range(len(table))]
            numbers = [number + later[scene] for scene, number in zip(table.scenes, table.steps)]
            fields = step.row_fields() | {"origin": step.origin}
            fields = (_clones(fields) if self._copies else fields) | {"world_offset": self._world_offset}
            steps.append(step.with_clouds(CloudTable.make(counts, table.scenes, numbers, device), **fields))
        renderings = self._predicted.renderings
        if self._copies:
            renderings = [Rendering(*(x if x is None else x.clone() for x in image)) for image in renderings]
        return Prediction(steps, list(renderings))


class _Frozen(NamedTuple):
    """Frozen particles during the rollouts of a graph, in the graph's own memory."""

    partition: Partition
    context: FrozenContext


def _own(particles: Particles) -> Particles:
    table = particles.clouds
    return particles.with_clouds(table, **_clones(particles.row_fields()), origin=particles.origin.clone())


def _copy(own: Particles, given: Particles) -> None:
    for name, value in own.row_fields().items():
        value.copy_(getattr(given, name))
    own.origin.copy_(given.origin)


def _clones(fields: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in fields.items()}


def _gaps(table: CloudTable) -> list[int | None]:
    """Steps between each cloud and the one before it of the same scene."""
    places = list(zip(table.scenes, table.steps))
    return [b[1] - a[1] if a[0] == b[0] else None for a, b in zip(places, places[1:])]


def of_prepared_state(plan: Plan) -> Plan:
    """``plan`` for a state that is prepared already."""
    if plan.spec.dynamics.background not in ("masked_out", "dynamic"):
        return plan
    dynamics = dataclasses.replace(plan.spec.dynamics, background="frozen")
    return dataclasses.replace(plan, spec=dataclasses.replace(plan.spec, dynamics=dynamics))


def rounded(module: nn.Module, dtype: torch.dtype) -> nn.Module:
    """A copy without gradients whose matrix products and convolutions hold what ``torch.autocast`` would round them to.

    Under autocast it computes the same numbers, and rounds no weights.
    """
    module = copy.deepcopy(module).requires_grad_(False)
    for part in module.modules():
        if isinstance(part, (nn.Linear, SparseConv)):
            for parameter in part.parameters(recurse=False):
                if parameter.dtype == torch.float32:
                    parameter.data = parameter.data.to(dtype)
    return module
