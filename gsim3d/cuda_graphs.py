"""Rollouts captured in CUDA graphs, which launch all kernels without Python overhead or synchronisation.

    with torch.autocast("cuda", torch.bfloat16):
        captured = CapturedRollout(simulator, state, 12, plan, cameras=cameras)
    steps, renderings = captured(state)               # repeatedly, with other states of the same shapes

A graph replays the same kernels on the same memory, so no size in it may depend on values: geometry has a fixed
capacity (:class:`gsim3d.ops.PyramidCapacity`), which is observed in a first rollout and multiplied by ``factor``. If
particles exceed it, a flag read after the replay reports this, and the rollout is captured again with more capacity.
"""

import contextlib
import copy
import dataclasses
import functools
import gc
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d.cameras import Cameras
from gsim3d.dynamics import Dynamics, FrozenContext, Partition, rollout
from gsim3d.effects.plan import Plan
from gsim3d.errors import CaptureError, InputError
from gsim3d.nn.point_transformer import SparseConv
from gsim3d.numerics.report import StabilityReport, pack
from gsim3d.ops.curve import Pyramid, PyramidCapacity
from gsim3d.ops.raster import Rendering
from gsim3d.state import DYNAMIC, Actions, CloudTable, Particles, keeping_constants, newest_clouds

FACTOR = 1.25  # capacity over the observed size
ROUNDED_PARTS = "dynamics", "renderer"  # modules whose weights are cast for autocast
# Substrings of out-of-memory messages of torch and of ops.
OUT_OF_MEMORY = "out of memory", "DefaultCPUAllocator", "STATUS_ALLOC_FAILED", "aoti_torch_empty_strided"


class Captured:
    """A function without arguments captured in a CUDA graph; a call replays it and returns the same tensors each time.

    Inputs must be copied into the tensors that the function reads; results are overwritten by the next call. The
    function must not synchronise, so dynamics in it needs geometry of fixed capacity; it may contain a backward pass
    (``torch.autograd.grad``). Under autocast every replay casts the weights again.

    Args:
        function: function to capture; called twice before, for warm-up.
        device: device of the function.
        pool: memory pool of torch.cuda.graph_pool_handle(), which may be shared by graphs that run one after another
            and whose results are not used after another of them ran. Default: its own pool.

    Raises:
        CaptureError: the function cannot be captured; the message contains CUDA's.
    """

    def __init__(
        self, function: Callable[[], Any], device: torch.device | str = "cuda", pool: tuple[int, int] | None = None
    ):
        self._device, self._constants = torch.device(device), {}
        if self._device.type != "cuda":
            raise CaptureError(f"Captured: device must be a GPU; got {device}")
        cached = torch.is_autocast_cache_enabled()
        torch.set_autocast_cache_enabled(False)
        torch.clear_autocast_cache()  # its tensors are of another stream, with which a backward pass would synchronise
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
            for _ in range(2):  # warm-up: loads kernels and creates constants
                function()
        torch.cuda.current_stream().wait_stream(side)
        self._graph = torch.cuda.CUDAGraph()
        # Calls of other threads, such as NCCL's watchdog, must not invalidate the capture.
        with collecting_nothing(), torch.cuda.graph(self._graph, pool=pool, capture_error_mode="thread_local"):
            self.result = function()

    def __call__(self) -> Any:
        with torch.cuda.device(self._device):
            self._graph.replay()
        return self.result


def is_out_of_memory(error: BaseException) -> bool:
    """Returns whether an error was caused by exhausted memory."""
    if isinstance(error, MemoryError) or any(text in str(error) for text in OUT_OF_MEMORY):
        return True
    cause = error.__cause__ or error.__context__  # an aborted capture raises another error on top
    return cause is not None and is_out_of_memory(cause)


@contextlib.contextmanager
def collecting_nothing() -> Iterator[None]:
    """Context that disables garbage collection: freeing another graph would invalidate a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Prediction(NamedTuple):
    """Predicted steps and their images.

    Attributes:
        steps: particles of each predicted step, with one cloud per scene.
        renderings: images of each step; empty without cameras.
    """

    steps: list[Particles]
    renderings: list[Rendering]


class CapturedRollout:
    """:meth:`Simulator.rollout` and rendering of every step as a CUDA graph, without gradients.

    A graph is specific to the shapes, scenes and steps of ``state``, the plan, the autocast state at construction, and
    the model in evaluation mode. Under autocast, weights of matrix products and convolutions are cast once to a copy:
    call :meth:`reload` after the model has changed. Otherwise the graph reads the model's weights.

    With ``background="asymmetric"``, the graph advances the movable particles, whose number must stay equal. The frozen
    context is computed outside of the graph when it has changed (call :meth:`reload` after the model has changed). If
    it exceeds its capacity, the graph is captured again. Sleep is not supported.

    On the CPU there are no graphs: calls run the steps eagerly, with the same capacities and the same results.

    Args:
        simulator: :class:`gsim3d.Simulator` in evaluation mode.
        state: last steps of every scene; fixes the number of particles of each cloud.
        n_steps: number of steps to predict.
        plan: plan of the effects. Default: ``simulator.plan()``.
        cameras: cameras to render at every step; each step has one cloud per scene.
        background: [3] or [I, 3], background colour. Default: black.
        factor: capacity of the geometry over the size observed for ``state``, at least 1.
        copies: return copies; False returns the graph's own memory, which the next call overwrites.
        report: counts invalid numbers. Default: ``simulator.report``.
        cutoff: see :meth:`Simulator.render`.

    Attributes:
        captures: number of captures; 1 as long as the capacity sufficed.

    Raises:
        InputError: an argument is invalid; the message names it.
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
            raise InputError("CapturedRollout: this model cannot render in a graph; leave cameras out")
        self._simulator, self._n_steps, self._factor, self._copies = simulator, n_steps, factor, copies
        self._plan, self._drawn = plan or simulator.plan(), plan
        self._report = simulator.report if report is None else report
        self._report.poll()
        self._background, self._cutoff = background, cutoff
        if self._plan.spec.dynamics.sleep is not None:
            raise InputError("CapturedRollout: plan must not have dynamics.sleep, which a graph does not support")
        prepared = self._with_own_actions(simulator._prepare(state, self._plan))
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
                raise InputError("CapturedRollout: state has no movable particles")
            self._state = _own(parts.moving)
            # In the graph's static memory, as the frozen context.
            own = Partition(_own(parts.newest), self._state, _own(parts.background), parts.rows.clone())
            self._frozen, self._context = own, self._remember(parts.background)
        self._moving = self._capacity_for(int(self._count_moving()))
        self._resize(self._observed())

    def __call__(self, state: Particles, cameras: Cameras | None = None) -> Prediction:
        """Returns the rollout of ``state``.

        Args:
            state: state with as many particles, scenes and steps as the first one; step numbers may be shifted.
            cameras: cameras of the same number and size as the first ones. Default: the last ones given.

        Raises:
            InputError: ``state`` or ``cameras`` do not fit the graph.
        """
        self.launch(state, cameras)
        return self.finish()

    def launch(self, state: Particles, cameras: Cameras | None = None) -> None:
        """Starts :meth:`__call__` without synchronising, except for a masked-out or asymmetric background.

        Raises:
            NumericalError: found in an earlier call, under the policy "raise".
        """
        others = {"world_offset": state.world_offset, "actions": state.actions}
        state = self._with_own_actions(self._simulator._prepare(state, self._plan))
        self._check(state, self._table)
        tables, self._others = state.clouds, others
        if self._frozen is not None:
            state = self._load_parts(self._partition(state))
        _copy(self._state, state)
        if cameras is not None:
            self._load(cameras)
        self._tables = tables
        self._launched = True
        self._replay()
        self._report.poll()  # host work that overlaps with the replay

    def finish(self) -> Prediction:
        """Waits for the launched replay and returns its results; repeats it with more capacity if exceeded."""
        if not self._launched:
            raise InputError("CapturedRollout: finish() must follow launch()")
        self._launched = False
        found, moving, counted = self._arrive()
        while moving > self._moving or not fit(self._capacities, found):
            self._moving = max(self._moving, self._capacity_for(moving))
            calls = zip(self._capacities, found, strict=True)
            grown = [capacity.grown(numbers, self._factor) for capacity, numbers in calls]
            self._resize([a.grown((0, *b.sizes)) for a, b in zip(grown, self._observed(), strict=True)])
            self._replay()
            found, moving, counted = self._arrive()
        self._records.replayed(self._report, counted)
        return self._results()

    def reload(self) -> None:
        """Reads the weights of the simulator again; the next call recomputes the frozen context."""
        self._is_stale = True
        if self._model is not self._simulator:
            for name in ROUNDED_PARTS:
                getattr(self._model, name).load_state_dict(getattr(self._simulator, name).state_dict())

    # ---- computation ----

    def _rollout(self, geometry, report: StabilityReport) -> Prediction:
        """Computes the rollout of the graph's static state."""
        plan, frozen = of_prepared_state(self._plan), self._frozen
        options, renderings = {"geometry": geometry, "report": report}, []
        at_most = self._model.dynamics.moving_at_most(self._moving)
        with torch.no_grad(), self._autocast(), at_most:
            if frozen is None:
                steps = self._model.rollout(self._state, self._n_steps, plan, **options)
            else:
                guard = self._model._guard("rollout", None, report)
                options = {"generator": None, "guard": guard, "geometry": geometry, "background": self._context}
                predict = functools.partial(self._model._predict, plan=plan, **options)
                moving = rollout(predict, self._state, self._n_steps, plan.history)
                steps = [frozen.whole(step, 1 + i) for i, step in enumerate(moving)]
            if self._cameras is not None:
                drawn = {"plan": self._drawn, "cutoff": self._cutoff, "report": report}
                renderings += [self._model._draw(step, self._cameras, self._background, **drawn) for step in steps]
        return Prediction(steps, renderings)

    def _with_own_actions(self, prepared: Particles) -> Particles:
        """Returns a state whose actions, in new memory, are those of the graph's steps; None if they are not read."""
        if prepared.actions is None or not self._plan.spec.dynamics.actions:
            return dataclasses.replace(prepared, actions=None)
        oldest = dict(reversed(list(zip(prepared.clouds.scenes, prepared.clouds.steps, strict=True))))
        first = [oldest.get(scene, 0) for scene in range(len(prepared.origin))]
        n_steps = 2**self._simulator.config.dynamics.history_bits + self._n_steps
        return dataclasses.replace(prepared, actions=prepared.actions.between(first, n_steps))

    def _partition(self, prepared: Particles) -> Partition:
        """Validates a state and splits it into movable and frozen particles."""
        validated = self._simulator._guard("rollout", None, self._report)(prepared)
        return Partition.of(validated, asymmetric=True)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self._device.type, self._dtype, enabled=self._dtype is not None, cache_enabled=False)

    def _remember(self, background: Particles) -> FrozenContext:
        with torch.no_grad(), self._autocast():
            return self._model.dynamics.remember(background).with_capacity(self._factor)

    def _observed(self) -> list[PyramidCapacity]:
        """Observes the capacities that the calls of the dynamics need, in a synchronising rollout."""
        geometry, needed = observing_geometry(self._model.dynamics, self._factor)
        self._rollout(geometry, StabilityReport())
        return needed

    def _count_moving(self) -> Tensor:
        """Returns int64 [1], the largest number of movable particles of a scene in the graph's state."""
        table, until = self._state.clouds, F.pad((self._state.activity == DYNAMIC).cumsum(0), (1, 0))
        counts = [until[table.starts[q + 1]] - until[table.starts[q]] for q in newest_clouds(table)]
        return torch.stack(counts).amax(0, keepdim=True)

    def _capacity_for(self, moving: int) -> int:
        return min(self._state.n_rows, math.ceil(self._factor * moving))

    def _given(self, report: StabilityReport) -> tuple[Prediction, Tensor]:
        """Computes the rollout with the current capacities; also returns the sizes found by each geometry."""
        geometry, found = fixed_geometry(self._model.dynamics, self._capacities)
        predicted = self._rollout(geometry, report)
        return predicted, torch.stack(found)

    def _resize(self, capacities: list[PyramidCapacity]) -> None:
        """Sets the capacities and, on a GPU, captures the graph."""
        self._capacities, self._records = capacities, StabilityReport()
        self.captures += 1
        if self._device.type != "cuda":
            return
        # Free the memory of the previous graph before the new capture.
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
        """Waits for the replay; returns sizes found by each geometry, number of movable rows, validation counts."""
        if self._device.type != "cuda":
            return self._found.tolist(), int(self._count_moving()), None
        self._arrived.synchronize()
        found, moving, counted = self._on_host.clone().tensor_split([n := self._found.numel(), n + 1])
        return found.view(self._found.shape).tolist(), int(moving), counted

    # ---- inputs and results ----

    def _load_parts(self, parts: Partition) -> Particles:
        """Copies the frozen particles into the graph's memory; returns the movable particles."""
        own = self._frozen
        self._check(parts.moving, own.moving.clouds, " among movable particles")
        known, given = own.background.row_fields(), parts.background.row_fields()
        changed = self._is_stale or not all(torch.equal(given[name], x) for name, x in known.items())
        _copy(own.newest, parts.newest)
        _copy(own.background, parts.background)
        own.rows.copy_(parts.rows)
        if changed:
            self._is_stale = False
            remembered = self._remember(parts.background)
            if not self._context.load(remembered):
                self._context = remembered
                self._resize(self._observed())
        return parts.moving

    def _check(self, state: Particles, own: CloudTable, where: str = "") -> None:
        table = state.clouds
        if (table.starts, table.scenes) != (own.starts, own.scenes):
            rows, got = (f"rows {[*of.starts]} of scenes {[*of.scenes]}" for of in (own, table))
            wanted = f"the rows and scenes of the first one{where}, clouds that start at {rows}"
            raise InputError(f"CapturedRollout: state must have {wanted}; got {got}")
        if gaps_of(table) != gaps_of(own):
            wanted = f"the same differences between steps as the first one, {list(own.steps)}"
            raise InputError(f"CapturedRollout: state must have {wanted}; got {list(table.steps)}")
        for name, value in self._state.row_fields().items():
            given, shape = getattr(state, name), (table.starts[-1], *value.shape[1:])
            if given is None or given.shape != shape or given.device != value.device:
                raise InputError(f"CapturedRollout: state.{name} must be {list(shape)} on {value.device}")
        if kind_of(state.actions) != kind_of(self._state.actions):
            raise InputError("CapturedRollout: state.actions must have as many points, of the same types, as the first")

    def _load(self, cameras: Cameras) -> None:
        own = self._cameras
        fixed = None if own is None else (len(own), own.width, own.height)
        if fixed != (len(cameras), cameras.width, cameras.height):
            wanted = "none" if own is None else "{} of {} x {} pixels".format(*fixed)
            wanted, got = f"the number and size of the first ones, {wanted}", f"{cameras.width} x {cameras.height}"
            raise InputError(f"CapturedRollout: cameras must have {wanted}; got {len(cameras)} of {got}")
        for name in ("viewmats", "Ks", "near", "far", "image_cloud"):
            getattr(own, name).copy_(getattr(cameras, name))

    def _results(self) -> Prediction:
        """Returns the results with the step numbers of the given state."""
        later = {s: given - own for s, given, own in zip(self._table.scenes, self._tables.steps, self._table.steps)}
        steps = []
        for step in self._predicted.steps:
            table, device = step.clouds, self._device
            numbers = [number + later[scene] for scene, number in zip(table.scenes, table.steps)]
            fields = step.row_fields() | {"origin": step.origin}
            fields = (_clones(fields) if self._copies else fields) | self._others
            steps.append(step.with_clouds(CloudTable.make(table.counts, table.scenes, numbers, device), **fields))
        renderings = self._predicted.renderings
        if self._copies:
            renderings = [Rendering(*(x if x is None else x.clone() for x in image)) for image in renderings]
        return Prediction(steps, list(renderings))


Geometry = Callable[[Particles], Pyramid]  # of a history


def observing_geometry(dynamics: Dynamics, factor: float) -> tuple[Geometry, list[PyramidCapacity]]:
    """Returns a geometry function of exact sizes, and the list of capacities, with a margin, that its calls fill."""
    needed: list[PyramidCapacity] = []

    def geometry(history: Particles) -> Pyramid:
        pyramid = dynamics.geometry(history)
        needed.append(PyramidCapacity.of(pyramid, dynamics.capacity(history), factor))
        return pyramid

    return geometry, needed


def fixed_geometry(dynamics: Dynamics, capacities: Sequence[PyramidCapacity]) -> tuple[Geometry, list[Tensor]]:
    """Returns a geometry function of fixed capacities, and the list of sizes found, which its calls fill."""
    sizes, found = iter(capacities), []

    def geometry(history: Particles) -> Pyramid:
        pyramid = dynamics.geometry(history, capacity=next(sizes))
        found.append(pyramid.found)
        return pyramid

    return geometry, found


def fit(capacities: Sequence[PyramidCapacity], found: Sequence[Sequence[int]]) -> bool:
    """Returns whether the sizes found by all geometries fit their capacities."""
    return all([capacity.fits(sizes) for capacity, sizes in zip(capacities, found, strict=True)])


def _own(particles: Particles) -> Particles:
    table = particles.clouds
    return particles.with_clouds(table, **_clones(particles.row_fields()), origin=particles.origin.clone())


def _copy(own: Particles, given: Particles) -> None:
    for name, value in own.row_fields().items():
        value.copy_(getattr(given, name))
    own.origin.copy_(given.origin)
    if own.actions is not None:
        own.actions.positions.copy_(given.actions.positions)
        own.actions.types.copy_(given.actions.types)


def kind_of(actions: Actions | None) -> tuple | None:
    """Returns what a graph fixes of actions."""
    return None if actions is None else (actions.positions.shape, actions.names)


def _clones(fields: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in fields.items()}


def gaps_of(table: CloudTable) -> list[int | None]:
    """Returns the difference of steps between consecutive clouds; None between scenes."""
    keys = list(zip(table.scenes, table.steps))
    return [b[1] - a[1] if a[0] == b[0] else None for a, b in zip(keys, keys[1:])]


def of_prepared_state(plan: Plan) -> Plan:
    """Returns ``plan`` for a state to which its background mode was already applied."""
    if plan.spec.dynamics.background not in ("masked_out", "dynamic"):
        return plan
    dynamics = dataclasses.replace(plan.spec.dynamics, background="frozen")
    return dataclasses.replace(plan, spec=dataclasses.replace(plan.spec, dynamics=dynamics))


def rounded(module: nn.Module, dtype: torch.dtype) -> nn.Module:
    """Returns a copy without gradients, whose linear and convolution weights are cast as ``torch.autocast`` would.

    Under autocast it computes the same numbers without casting weights in every call.
    """
    module = copy.deepcopy(module).requires_grad_(False)
    for part in module.modules():
        if isinstance(part, (nn.Linear, SparseConv)):
            for parameter in part.parameters(recurse=False):
                if parameter.dtype == torch.float32:
                    parameter.data = parameter.data.to(dtype)
    return module
