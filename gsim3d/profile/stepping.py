"""What is timed of a setting: some steps and their images, launched by the host or replayed from a CUDA graph."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch

from gsim3d.cameras import Cameras
from gsim3d.profile.runner import Runner
from gsim3d.profile.settings import Setting
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import Clock, GraphStopwatch, Stopwatch, watched
from gsim3d.state import Particles


class Stepping:
    """Simulates and draws ``span`` steps of a setting when called, always from the same state, and waits for a graph.

    Args:
        numbers: of scenes, that are simulated together.   span: of steps; default as many as must be timed together.
        stopwatch: is told the stages in every call; one of a graph makes its marks a part of it.
    Raises:
        CaptureError, InputError: the setting cannot be captured.

    Attributes:
        once: seconds that the capture took.
    """

    def __init__(
        self,
        subject: Subject,
        setting: Setting,
        clock: Clock,
        numbers: Sequence[int] = (0,),
        span: int | None = None,
        stopwatch: Stopwatch | None = None,
    ):
        self.runner = subject.runner(setting)
        self.state, self.cameras = _seen(subject, self.runner, numbers)
        self.span = self.runner.span(subject.n_steps) if span is None else span
        self.once, self._graph, self._stopwatch = 0.0, None, stopwatch
        if setting.captured:
            clock.wait()
            start = clock.now()
            with self._marking():
                self._graph = self.runner.captured(self.state, self.span, self.cameras)
            clock.wait()
            self.once = clock.now() - start

    def __call__(self) -> None:
        if self._stopwatch is None:
            return self._run()
        with watched(self.runner.simulator, self._stopwatch), self._stopwatch.running():
            self._run()

    def launch(self) -> None:
        """As a call, without a wait for the device."""
        if self._graph is None:
            self._run()
        else:
            self._graph.launch(self.state)

    def _run(self) -> None:
        if self._graph is None:
            self._draw(self.runner.steps(self.state, self.span))
            return
        steps = self._graph(self.state).steps
        if not self.runner.draws_in_graph:
            self._draw(steps)

    def _draw(self, steps) -> None:
        for n, newest in enumerate(steps):
            if n % self.runner.setting.every == 0:
                self.runner.images(newest, self.cameras)

    @contextmanager
    def _marking(self) -> Iterator[None]:
        if isinstance(self._stopwatch, GraphStopwatch):
            with watched(self.runner.simulator, self._stopwatch), self._stopwatch.capturing():
                yield
        else:
            yield


def _seen(subject: Subject, runner: Runner, numbers: Sequence[int]) -> tuple[Particles, Cameras]:
    if len(numbers) == 1:
        return subject.start(runner, numbers[0]), subject.cameras(numbers[0], 0)
    frames = runner.frames([subject.scenes[n] for n in numbers], [subject.views[n][0] for n in numbers])
    return runner.encode(frames), subject.cameras_of(numbers, 0)


def bytes_held(subject: Subject, setting: Setting) -> int:
    """Of the model and of the state from which it starts."""
    runner = subject.runner(setting)
    tensors = [*runner.simulator.parameters(), *subject.start(runner, 0).row_fields().values()]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


# ---- compilation ----


class TooLong(BaseException):
    """A compiler took longer than it may; no Exception, which compilers catch."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raises TooLong in the block once so much time is over. Without a limit where no signal can interrupt it."""
    alarms = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not alarms or not math.isfinite(seconds):
        yield
        return

    def ring(*_: object) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def compile_once(call: Callable[[], None], clock: Clock, limit: float) -> float:
    """Seconds of the first ``call``, which compiles all anew.

    Raises:
        TooLong: it is not over after ``limit`` seconds; what was begun is ended.
        Exception: of any kind, from the compiler.
    """
    from torch._inductor.utils import fresh_cache

    clock.wait()
    start = clock.now()
    try:
        with fresh_cache(), at_most(limit):
            call()
            clock.wait()
    except TooLong:
        _end_compilers()
        raise
    return clock.now() - start


def _end_compilers() -> None:
    from torch._inductor.async_compile import shutdown_compile_workers

    shutdown_compile_workers()  # they would go on, beside what is timed next
    torch.compiler.reset()
