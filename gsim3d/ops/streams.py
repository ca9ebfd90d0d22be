"""Parallel streams of a CUDA graph: work whose results are needed later runs beside what follows it.

Kernels over few rows leave most of a GPU idle. In a graph, those of a stream run beside those that follow them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
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
        self._streams = _streams(like.device)[:n_streams] if captured else ()
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


@functools.cache
def _streams(device: torch.device) -> tuple[torch.cuda.Stream, ...]:
    return tuple(torch.cuda.Stream(device) for _ in range(MANY_STREAMS))
