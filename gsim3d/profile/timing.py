"""Where the time of a call goes: stages told apart by the ops they run, medians of many repeats, memory and energy."""

from __future__ import annotations

import resource
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch

from gsim3d.cuda_graphs import Captured
from gsim3d.simulator import Simulator

STAGES = (
    "encode",
    "serialise",
    "convolution",
    "attention",
    "pooling",
    "dense layers",
    "state and guards",
    "head",
    "sort and raster",
    "host gaps",
)
STAGE_OF_OP = {
    "build_pyramid": "serialise",
    "sparse_conv_plan": "serialise",
    "sparse_conv": "convolution",
    "patch_attention": "attention",
    "pool_max": "pooling",
    "pool_mean": "pooling",
    "unpool": "pooling",
    "rasterize_gaussians": "sort and raster",
}
REST, GAPS = "state and guards", "host gaps"  # everything in no other stage; a GPU that waits for the host
CHAIN, REPLAYS = 64, 9  # kernels between which marks are made, to tell what a mark takes
WARM_UP, REPEATS = 3, 20
ADDS_UP = 0.03  # the stages of a call may differ from the whole by this share


class Clock(Protocol):
    """What a stopwatch reads."""

    def wait(self) -> None:
        """Returns once the device has done everything asked of it."""

    def now(self) -> float:
        """Seconds of the host."""

    def mark(self) -> Any:
        """The point in the device's work that has been asked for so far; in a capture, in the work of every replay."""

    def capturing(self) -> bool:
        """Whether a graph is being captured."""

    def mark_cost(self) -> float:
        """Seconds that a mark in a graph adds to it."""

    def seconds(self, first: Any, last: Any) -> float:
        """Between two marks that the device has passed."""

    def delay(self, seconds: float) -> None:
        """Keeps the device busy."""


class DeviceClock:
    """The clock of the CPU or a GPU, whose marks are events.

    waits: False leaves out the wait for the device, which a timing must never do: see :mod:`gsim3d.profile.self_check`.
    """

    def __init__(self, device: torch.device | str, waits: bool = True):
        self._gpu = torch.device(device) if torch.device(device).type == "cuda" else None
        self._waits, self._mark_cost = waits, None

    def wait(self) -> None:
        if self._gpu is not None and self._waits:
            torch.cuda.synchronize(self._gpu)

    def now(self) -> float:
        return time.perf_counter()

    def mark(self) -> Any:
        if self._gpu is None:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True, external=self.capturing())
        event.record(torch.cuda.current_stream(self._gpu))
        return event

    def capturing(self) -> bool:
        return self._gpu is not None and torch.cuda.is_current_stream_capturing()

    def mark_cost(self) -> float:
        if self._gpu is None:
            return 0.0
        if self._mark_cost is None:
            marked, plain = self._chain(marks=True), self._chain(marks=False)
            found = [(self._of(marked) - self._of(plain)) / CHAIN for _ in range(REPLAYS)]
            self._mark_cost = max(0.0, statistics.median(found))
        return self._mark_cost

    def _chain(self, marks: bool) -> Captured:
        """A graph of small kernels one after another between two marks, and with or without a mark behind each."""
        cell = torch.zeros((), device=self._gpu)

        def chain() -> list[Any]:
            made = [self.mark()]
            for _ in range(CHAIN):
                cell.add_(1)
                if marks:
                    made.append(self.mark())
            return [*made, self.mark()]

        return Captured(chain, self._gpu)

    def _of(self, graph: Captured) -> float:
        marks = graph()
        return self.seconds(marks[0], marks[-1])

    def seconds(self, first: Any, last: Any) -> float:
        if self._gpu is None:
            return last - first
        last.synchronize()
        return first.elapsed_time(last) / 1e3

    def delay(self, seconds: float) -> None:
        if self._gpu is None:
            end = time.perf_counter() + seconds
            while time.perf_counter() < end:
                pass
        else:
            kilohertz = torch.cuda.get_device_properties(self._gpu).clock_rate
            torch.cuda._sleep(int(seconds * 1e3 * kilohertz))


class Stopwatch:
    """Splits the time of a call into stages; a stage within another counts as itself only.

        stopwatch = Stopwatch(clock)
        with stopwatch.running():
            with stopwatch.stage("encode"):
                ...
        stopwatch.seconds                      # {"encode": ..., "state and guards": ...}

    delays: stage -> seconds to waste the first time that it is entered in each run; shows what the stopwatch sees.
    """

    def __init__(self, clock: Clock, delays: dict[str, float] | None = None):
        self.seconds: dict[str, float] = {}
        self._clock, self._delays = clock, delays or {}
        self._marks: list[tuple[str, Any]] = []
        self._open: list[str] = []

    @contextmanager
    def running(self, rest: str = REST) -> Iterator[None]:
        """One call. ``rest``: the stage of everything outside any other."""
        self._marks, self._open, self._due = [], [], dict(self._delays)
        self._enter(rest)
        try:
            yield
        finally:
            self._marks.append(("", self._clock.mark()))
            self._open = []
            self._add_up(self._marks)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._enter(name)
        try:
            yield
        finally:
            self._leave()

    def _enter(self, name: str) -> None:
        if not self._open or self._open[-1] != name:
            self._note(name)
        self._open.append(name)
        if name in self._due and self._counts():
            self._clock.delay(self._due.pop(name))

    def _leave(self) -> None:
        name = self._open.pop()
        if self._open and name != self._open[-1]:
            self._note(self._open[-1])

    def _note(self, name: str) -> None:
        if self._counts():
            self._marks.append((name, self._clock.mark()))

    def _counts(self) -> bool:
        return True

    def _add_up(self, marks: list[tuple[str, Any]]) -> None:
        self._clock.wait()
        totals: dict[str, float] = defaultdict(float)
        for (name, begin), (_, end) in zip(marks, marks[1:]):
            totals[name] += self._clock.seconds(begin, end)
        self.seconds = dict(totals)


class GraphStopwatch(Stopwatch):
    """Splits the time of a CUDA graph: marks and delays become part of it, and every replay passes them.

        stopwatch = GraphStopwatch(clock)
        with watched(simulator, stopwatch), stopwatch.capturing():
            graph = CapturedRollout(simulator, ...)
        with stopwatch.running():
            graph(state)
        stopwatch.seconds

    The host is not in it: a GPU that waits for no launch shows in each stage what that stage takes. What the marks
    themselves take is measured apart and taken off.
    """

    @contextmanager
    def capturing(self, rest: str = REST) -> Iterator[None]:
        """The one capture of the graph; what is run before it, to try it out, has no marks."""
        self._marks, self._open, self._due, self._behind = [], [rest], dict(self._delays), None
        try:
            yield
        finally:
            self._open = []

    @contextmanager
    def running(self, rest: str = REST) -> Iterator[None]:
        """One replay, and what the host launches behind it, such as images that a graph cannot draw."""
        self._open, self._behind, begin = [rest], [], self._clock.mark()
        try:
            yield
        finally:
            end, self._open = self._clock.mark(), []
            self._add_up([(rest, begin), *self._marks, *self._behind, ("", end)])
            for name, _ in [(rest, begin), *self._marks][: len(self._marks)]:  # each ends at a mark in the graph
                self.seconds[name] -= self._clock.mark_cost()
            self.seconds = {name: max(0.0, seconds) for name, seconds in self.seconds.items()}

    def _note(self, name: str) -> None:
        if self._counts():
            self._marks.append((name, self._clock.mark()))
        elif self._behind is not None:
            self._behind.append((name, self._clock.mark()))

    def _counts(self) -> bool:
        return bool(self._open) and self._clock.capturing()


@contextmanager
def watched(simulator: Simulator, stopwatch: Stopwatch) -> Iterator[None]:
    """Within it, calls of ``simulator`` tell ``stopwatch`` their stages; ops are known wherever they are called."""
    hooks = []
    rooms = {simulator.encoder: "encode", simulator.dynamics.net: "dense layers", simulator.renderer: "head"}
    for module, name in rooms.items():
        hooks.append(module.register_forward_pre_hook(lambda *_, name=name: stopwatch._enter(name)))
        hooks.append(module.register_forward_hook(lambda *_: stopwatch._leave(), always_call=True))
    ops = torch.ops.gsim3d
    known = {name: getattr(ops, name) for name in STAGE_OF_OP}
    for name, op in known.items():
        setattr(ops, name, _TimedOp(op, STAGE_OF_OP[name], stopwatch))
    try:
        yield
    finally:
        for name, op in known.items():
            setattr(ops, name, op)
        for hook in hooks:
            hook.remove()


class _TimedOp:
    """An op of torch.ops that tells the stopwatch when it runs; what is an overload of it does so too."""

    def __init__(self, op: Any, stage: str, stopwatch: Stopwatch):
        self._op, self._stage, self._stopwatch = op, stage, stopwatch

    def __call__(self, *args, **kwargs):
        if self._stopwatch._open and self._stopwatch._open[-1] == "encode":  # all of the encoder is one stage
            return self._op(*args, **kwargs)
        with self._stopwatch.stage(self._stage):
            return self._op(*args, **kwargs)

    def __getattr__(self, name: str):
        value = getattr(self._op, name)
        return _TimedOp(value, self._stage, self._stopwatch) if name == "default" else value


@dataclass(frozen=True)
class Timing:
    """Seconds of one call: all repeats, in order; stages by name, medians of repeats in which they were watched."""

    repeats: tuple[float, ...]
    stages: dict[str, float] = field(default_factory=dict)

    @property
    def median(self) -> float:
        return statistics.median(self.repeats)

    @property
    def steady(self) -> float:
        """Mean of the middle half: repeats of two scenes have two levels, between which a median jumps."""
        ordered, cut = sorted(self.repeats), len(self.repeats) // 4
        return statistics.fmean(ordered[cut : len(ordered) - cut])

    @property
    def p95(self) -> float:
        ordered = sorted(self.repeats)
        return ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1)))]


def time_call(call: Callable[[], Any], clock: Clock, repeats: int = REPEATS, warm_up: int = WARM_UP) -> Timing:
    """Times ``call``, each time from an idle device to an idle device; the first ``warm_up`` do not count."""
    seconds = []
    for n in range(warm_up + repeats):
        clock.wait()
        start = clock.now()
        call()
        clock.wait()
        if n >= warm_up:
            seconds.append(clock.now() - start)
    return Timing(tuple(seconds))


def time_stages(
    call: Callable[[], Any],
    simulators: Sequence[Simulator],
    clock: Clock,
    repeats: int = REPEATS,
    warm_up: int = WARM_UP,
    *,
    alone: bool = True,
) -> Timing:
    """As :func:`time_call`, and the stages of it.

    alone: plain and watched calls take turns, so that both see the same machine; False: the watched call is the one
        that is timed, where marks cost next to nothing.
    """
    seconds, stages = [], defaultdict(list)
    stopwatch = Stopwatch(clock)
    for n in range(warm_up + repeats):
        with _all_watched([] if alone else simulators, stopwatch):
            clock.wait()
            start = clock.now()
            with nullcontext() if alone else stopwatch.running():
                call()
            clock.wait()
            whole = clock.now() - start
        if alone:
            with _all_watched(simulators, stopwatch), stopwatch.running():
                call()
        if n >= warm_up:
            seconds.append(whole)
            for name in STAGES:
                stages[name].append(stopwatch.seconds.get(name, 0.0))
    medians = {name: statistics.median(values) for name, values in stages.items()}
    return Timing(tuple(seconds), {name: value for name, value in medians.items() if value > 0})


@contextmanager
def _all_watched(simulators: Sequence[Simulator], stopwatch: Stopwatch) -> Iterator[None]:
    if not simulators:
        yield
        return
    with watched(simulators[0], stopwatch), _all_watched(simulators[1:], stopwatch):
        yield


@contextmanager
def peak_memory(device: torch.device, held: int = 0) -> Iterator[Callable[[], int]]:
    """A function that says how many bytes the block needed at most: of the GPU beyond what lay there before, and
    ``held`` of that; of a CPU the whole process so far."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        yield lambda: torch.cuda.max_memory_allocated(device) - before + held
    else:
        yield lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
