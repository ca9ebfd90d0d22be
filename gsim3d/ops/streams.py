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
    most ``MANY_STREAMS``, for long chains of small kernels. ``late``: nothing reads the results before the end of
    :func:`joined_late`, if that is on.
    """

    def __init__(self, like: Tensor, n_streams: int = N_STREAMS, *, late: bool = False):
        captured = like.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()
        self._streams = _streams(like.device)[:n_streams] if captured else ()
        self._count, self._read, self._late = 0, [], late

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
        used = self._streams[: self._count]
        if self._late and used and _unjoined is not None:
            events = [stream.record_event() for stream in used]
            _join(_unjoined)
            _unjoined.append((events, self._read))
            return
        for stream in used:
            torch.cuda.current_stream().wait_stream(stream)
        self._read.clear()


_unjoined: list[tuple[list[torch.cuda.Event], list]] | None = None  # of all threads: autograd has its own


@contextlib.contextmanager
def joined_late() -> Iterator[None]:
    """A context in which a late context of :class:`Streams` is awaited when the next one is left, and the last one in
    the end: meanwhile the memory that it reads is kept."""
    global _unjoined
    before, _unjoined = _unjoined, []
    try:
        yield
        _join(_unjoined)
    finally:
        _unjoined = before


def _join(contexts: list[tuple[list[torch.cuda.Event], list]]) -> None:
    for events, _ in contexts:
        for event in events:
            torch.cuda.current_stream().wait_event(event)
    contexts.clear()


@functools.cache
def _streams(device: torch.device) -> tuple[torch.cuda.Stream, ...]:
    return tuple(torch.cuda.Stream(device) for _ in range(MANY_STREAMS))
