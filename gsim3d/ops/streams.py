"""Parallel streams of a CUDA graph: work whose results are needed later runs beside what follows it.

Kernels over few rows leave most of a GPU idle. In a graph, those of a stream run beside those that follow them.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

N_STREAMS = 4  # what more branches than these are given is queued behind one of them
MANY_STREAMS = 8


class Streams:
    """A context; what is run in it is done when the context is left, and may be read only then.

    While a graph is captured on the device of ``like``, :meth:`run` makes nodes that wait for the work before them, not
    the other way round. Else, and on the CPU, everything runs in order. The numbers are the same. ``n_streams``: at
    most ``MANY_STREAMS``, for long chains of small kernels.
    """

    def __init__(self, like: Tensor, n_streams: int = N_STREAMS):
        captured = like.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()
        # Parts of a graph that run beside each other (:class:`Turns`) must not wait for each other's work.
        self._streams = _streams(like.device, torch.cuda.current_stream())[:n_streams] if captured else ()
        self._count, self._read = 0, []

    def __enter__(self) -> Streams:
        return self

    def run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function(*arguments)``."""
        if not self._streams:
            return function(*arguments)
        stream = self._streams[self._count % len(self._streams)]
        self._count += 1
        self._read.append(arguments)  # their memory must not be used anew before the context is left
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            return function(*arguments)

    def __exit__(self, *_) -> None:
        for stream in self._streams[: self._count]:
            torch.cuda.current_stream().wait_stream(stream)
        self._read.clear()


class Turns:
    """Parts of a graph that take turns on two streams: a part may begin once the one before it has handed over.

    What a part does after :meth:`hand_over` runs beside the next part. Outside of a capture on the device of ``like``,
    and on the CPU, everything runs in order. The numbers are the same.
    """

    def __init__(self, like: Tensor):
        captured = like.is_cuda and torch.cuda.is_current_stream_capturing()
        self._lanes = (now := torch.cuda.current_stream(), _streams(like.device, now, 1)[0]) if captured else ()
        self._count, self._handed = 0, None

    @contextlib.contextmanager
    def take(self) -> Iterator[None]:
        """The context of the next part. What it reads of earlier ones must live until :meth:`join`."""
        lane, self._count = self._lanes[self._count % 2] if self._lanes else None, self._count + 1
        if self._handed is not None:
            lane.wait_event(self._handed)
        with torch.cuda.stream(lane):  # None: no change
            yield

    def hand_over(self) -> None:
        """Lets the next part begin; called in the context of a part."""
        if self._lanes:
            self._handed = torch.cuda.current_stream().record_event()

    def join(self) -> None:
        """Waits for all parts."""
        for lane in self._lanes[1 : self._count]:
            self._lanes[0].wait_stream(lane)


@functools.cache
def _streams(device: torch.device, of: torch.cuda.Stream, count: int = MANY_STREAMS) -> tuple[torch.cuda.Stream, ...]:
    """Streams of the work that ``of`` runs."""
    return tuple(torch.cuda.Stream(device) for _ in range(count))
