"""Timing of calls on CPU and CUDA: medians over repeats, and the time of each section of a step."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch

from gsim3d.cuda_graphs import Captured
from gsim3d.simulator import Simulator

REST = "state and guards"  # time outside all other sections
GAPS = "host gaps"  # time in which the GPU waits for kernel launches
SECTION_OF_OP = {
    "build_pyramid": "serialise",
    "sparse_conv_plan": "serialise",
    "sparse_conv": "convolution",
    "patch_attention": "attention",
    "pool_max": "pooling",
    "pool_mean": "pooling",
    "unpool": "pooling",
    "rasterize_gaussians": "sort and raster",
}
SECTIONS = ("encode", *dict.fromkeys(SECTION_OF_OP.values()), "dense layers", "head", REST, GAPS)
CHAIN, REPLAYS = 64, 9  # kernels in a graph, and its replays, that measure the cost of an event


class DeviceClock:
    """Clock of the CPU, or of a CUDA device by its events."""

    def __init__(self, device: torch.device | str):
        self._gpu = torch.device(device) if torch.device(device).type == "cuda" else None
        self._mark_cost: float | None = None

    def wait(self) -> None:
        """Synchronizes with the device."""
        if self._gpu is not None:
            torch.cuda.synchronize(self._gpu)

    def now(self) -> float:
        """Host time in seconds."""
        return time.perf_counter()

    def mark(self) -> Any:
        """Records a time stamp in the current stream; during graph capture, it becomes a node of the graph."""
        if self._gpu is None:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True, external=self.capturing())
        event.record(torch.cuda.current_stream(self._gpu))
        return event

    def capturing(self) -> bool:
        """Whether the current stream is captured into a CUDA graph."""
        return self._gpu is not None and torch.cuda.is_current_stream_capturing()

    def mark_cost(self) -> float:
        """Seconds that each mark adds to a CUDA graph (0 on the CPU), measured once."""
        if self._gpu is None:
            return 0.0
        if self._mark_cost is None:
            graphs = [Captured(partial(self._chain, marks), self._gpu) for marks in (True, False)]
            runs = ((graph() for graph in graphs) for _ in range(REPLAYS))
            times = [[self.seconds(run[0], run[-1]) for run in pair] for pair in runs]
            self._mark_cost = max(0.0, statistics.median((marked - plain) / CHAIN for marked, plain in times))
        return self._mark_cost

    def _chain(self, marks: bool) -> list[Any]:
        """Launches small kernels, a mark behind each if ``marks``. Returns all marks: they must outlive the graph."""
        value, all_marks = torch.zeros((), device=self._gpu), [self.mark()]
        for _ in range(CHAIN):
            value.add_(1)
            if marks:
                all_marks.append(self.mark())
        return [*all_marks, self.mark()]

    def seconds(self, first: Any, last: Any) -> float:
        """Seconds between two marks; waits for the second one."""
        if self._gpu is None:
            return last - first
        last.synchronize()
        return first.elapsed_time(last) / 1e3


class Stopwatch:
    """Splits the time of a call into sections. The time of a nested section counts for that section alone.

        stopwatch = Stopwatch(clock)
        with watched(simulator, stopwatch), stopwatch.running():
            simulator.step(state)
        stopwatch.seconds                      # {"convolution": ..., "state and guards": ...}

    Attributes:
        seconds: section -> seconds in the last call.
    """

    def __init__(self, clock: DeviceClock):
        self.seconds: dict[str, float] = {}
        self._clock = clock
        self._marks: list[tuple[str, Any]] = []
        self._open: list[str] = []

    @contextmanager
    def running(self) -> Iterator[None]:
        """Times one call. Time outside all sections counts as REST."""
        self._marks, self._open = [], []
        self.enter(REST)
        try:
            yield
        finally:
            self._marks.append(("", self._clock.mark()))
            self._open = []
            self.seconds = self._sums(self._marks)

    def enter(self, name: str) -> None:
        """Begins a section."""
        if not self._open or self._open[-1] != name:
            self._note(name)
        self._open.append(name)

    def leave(self) -> None:
        """Ends the innermost section."""
        name = self._open.pop()
        if self._open and name != self._open[-1]:
            self._note(self._open[-1])

    @property
    def current(self) -> str:
        """Name of the innermost open section; "" outside a call."""
        return self._open[-1] if self._open else ""

    def _note(self, name: str) -> None:
        self._marks.append((name, self._clock.mark()))

    def _sums(self, marks: list[tuple[str, Any]]) -> dict[str, float]:
        self._clock.wait()
        totals: dict[str, float] = defaultdict(float)
        for (name, begin), (_, end) in zip(marks, marks[1:]):
            totals[name] += self._clock.seconds(begin, end)
        return dict(totals)


class GraphStopwatch(Stopwatch):
    """Splits the time of a CUDA graph into sections by events captured with it.

    Launches cost no time in a replay. The cost of the events is measured and subtracted.
    """

    @contextmanager
    def capturing(self) -> Iterator[None]:
        """Encloses the capture of the graph. Warm-up runs before the capture are not recorded."""
        self._marks, self._open, self._behind = [], [REST], None
        try:
            yield
        finally:
            self._open = []

    @contextmanager
    def running(self) -> Iterator[None]:
        """Times one replay and the kernels launched after it, such as rendering outside the graph."""
        self._open, self._behind, begin = [REST], [], self._clock.mark()
        try:
            yield
        finally:
            end, self._open = self._clock.mark(), []
            seconds = self._sums([(REST, begin), *self._marks, *self._behind, ("", end)])
            for name, _ in [(REST, begin), *self._marks][: len(self._marks)]:  # one event in the graph ends each
                seconds[name] -= self._clock.mark_cost()
            self.seconds = {name: max(0.0, value) for name, value in seconds.items()}

    def _note(self, name: str) -> None:
        if self._open and self._clock.capturing():
            self._marks.append((name, self._clock.mark()))
        elif self._behind is not None:
            self._behind.append((name, self._clock.mark()))


@contextmanager
def watched(simulator: Simulator, stopwatch: Stopwatch) -> Iterator[None]:
    """Makes ``stopwatch`` record sections of ``simulator``: its encoder, network and head, and all gsim3d ops.

    Forward hooks and ``torch.ops.gsim3d`` are restored on exit.
    """
    sections = {simulator.encoder: "encode", simulator.dynamics.net: "dense layers", simulator.renderer: "head"}
    with ExitStack() as on_exit:
        for module, name in sections.items():
            enter = module.register_forward_pre_hook(lambda *_, name=name: stopwatch.enter(name))
            leave = module.register_forward_hook(lambda *_: stopwatch.leave(), always_call=True)
            on_exit.callback(enter.remove)
            on_exit.callback(leave.remove)
        for name, section in SECTION_OF_OP.items():
            op = getattr(torch.ops.gsim3d, name)
            on_exit.callback(setattr, torch.ops.gsim3d, name, op)
            setattr(torch.ops.gsim3d, name, _TimedOp(op, section, stopwatch))
        yield


class _TimedOp:
    """Wraps an op of ``torch.ops``, or an overload of one, in a section of the stopwatch."""

    def __init__(self, op: Any, section: str, stopwatch: Stopwatch):
        self._op, self._section, self._stopwatch = op, section, stopwatch

    def __call__(self, *args, **kwargs):
        if self._stopwatch.current == "encode":  # ops of the encoder count for the encoder
            return self._op(*args, **kwargs)
        self._stopwatch.enter(self._section)
        try:
            return self._op(*args, **kwargs)
        finally:
            self._stopwatch.leave()

    def __getattr__(self, name: str):
        value = getattr(self._op, name)
        return _TimedOp(value, self._section, self._stopwatch) if name == "default" else value


@dataclass(frozen=True)
class Timing:
    """Durations of repeated calls."""

    repeats: tuple[float, ...]  #: seconds of each call, in order
    #: section -> median seconds; empty if sections were not recorded
    sections: dict[str, float] = field(default_factory=dict)

    @property
    def median(self) -> float:
        return statistics.median(self.repeats)

    @property
    def p95(self) -> float:
        return sorted(self.repeats)[round(0.95 * (len(self.repeats) - 1))]

    def split_over(self, n_steps: int) -> Timing:
        """The timing of a single step of a call of ``n_steps``."""
        sections = {name: seconds / n_steps for name, seconds in self.sections.items()}
        return Timing(tuple(seconds / n_steps for seconds in self.repeats), sections)


def time_call(call: Callable[[], Any], clock: DeviceClock, repeats: int, warm_up: int = 1, sections=None) -> Timing:
    """Times ``repeats`` of ``call`` after ``warm_up`` untimed ones, each between two synchronizations of the ``clock``.
    ``sections`` returns the seconds by section of the last call; None: they are not recorded."""
    seconds, found = [], []
    for n in range(warm_up + repeats):
        clock.wait()
        start = clock.now()
        call()
        clock.wait()
        if n >= warm_up:
            seconds.append(clock.now() - start)
            found.append({} if sections is None else dict(sections()))
    return Timing(tuple(seconds), medians_of(found))


def medians_of(found: list[dict[str, float]]) -> dict[str, float]:
    """Median of each section over calls, in the order of SECTIONS; a missing section counts as 0."""
    names = [name for name in SECTIONS if any(name in sections for sections in found)]
    return {name: statistics.median(sections.get(name, 0.0) for sections in found) for name in names}
