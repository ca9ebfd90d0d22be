"""Where the time of a call goes: medians of many repeats, sections by the ops they run, and the machine."""

from __future__ import annotations

import hashlib
import platform
import statistics
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

import gsim3d
from gsim3d.cuda_graphs import Captured
from gsim3d.simulator import Simulator

REST, GAPS = "state and guards", "host gaps"  # everything in no other section; a GPU that waits for the host
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
CHAIN, REPLAYS = 64, 9  # kernels between which marks are made, to tell what a mark takes
PACKAGE = Path(gsim3d.__file__).parent


# ---- clocks ----


class DeviceClock:
    """The clock of the CPU or of a GPU, whose marks are events."""

    def __init__(self, device: torch.device | str):
        self._gpu = torch.device(device) if torch.device(device).type == "cuda" else None
        self._mark_cost: float | None = None

    def wait(self) -> None:
        """Returns once the device has done all its work."""
        if self._gpu is not None:
            torch.cuda.synchronize(self._gpu)

    def now(self) -> float:
        """Seconds of the host."""
        return time.perf_counter()

    def mark(self) -> Any:
        """The current point in the device's work; in a capture, a point in the work of every replay."""
        if self._gpu is None:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True, external=self.capturing())
        event.record(torch.cuda.current_stream(self._gpu))
        return event

    def capturing(self) -> bool:
        """Whether a graph is being captured."""
        return self._gpu is not None and torch.cuda.is_current_stream_capturing()

    def mark_cost(self) -> float:
        """Seconds that a mark in a graph adds to it."""
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
        """Between two marks that the device has passed."""
        if self._gpu is None:
            return last - first
        last.synchronize()
        return first.elapsed_time(last) / 1e3


# ---- sections of a call ----


class Stopwatch:
    """Splits the time of a call into sections; a section within another counts as itself only.

        stopwatch = Stopwatch(clock)
        with watched(simulator, stopwatch), stopwatch.running():
            simulator.step(state)
        stopwatch.seconds                      # {"convolution": ..., "state and guards": ...}

    Attributes:
        seconds: by section, of the last call.
    """

    def __init__(self, clock: DeviceClock):
        self.seconds: dict[str, float] = {}
        self._clock = clock
        self._marks: list[tuple[str, Any]] = []
        self._open: list[str] = []

    @contextmanager
    def running(self) -> Iterator[None]:
        """One call; what is in no other section is in REST."""
        self._marks, self._open = [], []
        self.enter(REST)
        try:
            yield
        finally:
            self._marks.append(("", self._clock.mark()))
            self._open = []
            self.seconds = self._sums(self._marks)

    def enter(self, name: str) -> None:
        """A section begins."""
        if not self._open or self._open[-1] != name:
            self._note(name)
        self._open.append(name)

    def leave(self) -> None:
        """The section that began last ends."""
        name = self._open.pop()
        if self._open and name != self._open[-1]:
            self._note(self._open[-1])

    @property
    def current(self) -> str:
        """The section that began last and has not ended; "" outside of a call."""
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
    """Splits the time of a CUDA graph: marks become a part of it, and every replay passes them.

        stopwatch = GraphStopwatch(clock)
        with watched(simulator, stopwatch), stopwatch.capturing():
            graph = CapturedRollout(simulator, ...)
        with stopwatch.running():
            graph(state)
        stopwatch.seconds

    The host is not in it: the GPU waits for no launch. What the marks themselves take is measured apart and taken off.
    """

    @contextmanager
    def capturing(self) -> Iterator[None]:
        """The one capture of the graph; what is run before it, to try it out, has no marks."""
        self._marks, self._open, self._behind = [], [REST], None
        try:
            yield
        finally:
            self._open = []

    @contextmanager
    def running(self) -> Iterator[None]:
        """One replay, and what the host launches behind it, such as images that a graph cannot draw."""
        self._open, self._behind, begin = [REST], [], self._clock.mark()
        try:
            yield
        finally:
            end, self._open = self._clock.mark(), []
            seconds = self._sums([(REST, begin), *self._marks, *self._behind, ("", end)])
            for name, _ in [(REST, begin), *self._marks][: len(self._marks)]:  # each ends at a mark in the graph
                seconds[name] -= self._clock.mark_cost()
            self.seconds = {name: max(0.0, value) for name, value in seconds.items()}

    def _note(self, name: str) -> None:
        if self._open and self._clock.capturing():
            self._marks.append((name, self._clock.mark()))
        elif self._behind is not None:
            self._behind.append((name, self._clock.mark()))


@contextmanager
def watched(simulator: Simulator, stopwatch: Stopwatch) -> Iterator[None]:
    """Within it ``stopwatch`` follows the sections of ``simulator``: its modules, and ops wherever they are called."""
    hooks = []
    sections = {simulator.encoder: "encode", simulator.dynamics.net: "dense layers", simulator.renderer: "head"}
    for module, name in sections.items():
        hooks.append(module.register_forward_pre_hook(lambda *_, name=name: stopwatch.enter(name)))
        hooks.append(module.register_forward_hook(lambda *_: stopwatch.leave(), always_call=True))
    ops = torch.ops.gsim3d
    known = {name: getattr(ops, name) for name in SECTION_OF_OP}
    for name, op in known.items():
        setattr(ops, name, _TimedOp(op, SECTION_OF_OP[name], stopwatch))
    try:
        yield
    finally:
        for name, op in known.items():
            setattr(ops, name, op)
        for hook in hooks:
            hook.remove()


class _TimedOp:
    """An op of torch.ops, or an overload of one, that is a section of the stopwatch."""

    def __init__(self, op: Any, section: str, stopwatch: Stopwatch):
        self._op, self._section, self._stopwatch = op, section, stopwatch

    def __call__(self, *args, **kwargs):
        if self._stopwatch.current == "encode":  # all of the encoder is one section
            return self._op(*args, **kwargs)
        self._stopwatch.enter(self._section)
        try:
            return self._op(*args, **kwargs)
        finally:
            self._stopwatch.leave()

    def __getattr__(self, name: str):
        value = getattr(self._op, name)
        return _TimedOp(value, self._section, self._stopwatch) if name == "default" else value


# ---- timings ----


@dataclass(frozen=True)
class Timing:
    """Seconds of one call.

    Attributes:
        repeats: all of them, in order.
        sections: medians by name, where they were watched.
    """

    repeats: tuple[float, ...]
    sections: dict[str, float] = field(default_factory=dict)

    @property
    def median(self) -> float:
        return statistics.median(self.repeats)

    @property
    def p95(self) -> float:
        ordered = sorted(self.repeats)
        return ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1)))]

    def split_over(self, n_steps: int) -> Timing:
        """The timing of one of ``n_steps`` that are a call."""
        sections = {name: seconds / n_steps for name, seconds in self.sections.items()}
        return Timing(tuple(seconds / n_steps for seconds in self.repeats), sections)


def time_call(call: Callable[[], Any], clock: DeviceClock, repeats: int, warm_up: int = 1, sections=None) -> Timing:
    """Times ``call``, each time from an idle device to an idle device; the first ``warm_up`` do not count.

    Args:
        sections: gives those of the call that has just ended; None: they are not watched.
    """
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
    """Of each section over calls, in the order of SECTIONS."""
    names = [name for name in SECTIONS if any(name in sections for sections in found)]
    return {name: statistics.median(sections.get(name, 0.0) for sections in found) for name in names}


# ---- the machine ----


def machine(device: torch.device) -> dict[str, str]:
    """What numbers were measured on, and with; "sources" is a hash of the package's Python files."""
    found = {
        "gsim3d": gsim3d.__version__,
        "sources": _hash_of_sources(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    if device.type == "cuda":
        found |= {"device": torch.cuda.get_device_name(device), "cuda": torch.version.cuda, "driver": _driver(device)}
    else:
        found |= {"device": f"CPU, {torch.get_num_threads()} threads", "processor": _processor()}
    return found


def _hash_of_sources() -> str:
    digest = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _driver(device: torch.device) -> str:
    """Its version and the clocks of the GPU, as nvidia-smi prints them; "" where it does not."""
    uuid = torch.cuda.get_device_properties(device).uuid
    query = [
        "nvidia-smi",
        f"--id=GPU-{uuid}",
        "--query-gpu=driver_version,clocks.gr,clocks.mem",
        "--format=csv,noheader",
    ]
    try:
        return subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
