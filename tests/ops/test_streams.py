"""Parallel streams of a CUDA graph."""

import weakref
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from gsim3d.cuda_graphs import Captured
from gsim3d.errors import CaptureError
from gsim3d.ops import streams as streams_module
from gsim3d.ops.streams import Streams, joined_late
from tests.asserts import assert_same_bits


def chain(x, weight):
    """Many small kernels, one after the other."""
    for _ in range(50):
        x = (x @ weight).tanh()
    return x


def results_of_chains(x, weight, late=False):
    results = []
    with Streams(x, late=late) as streams:
        for scale in (1.0, 2.0, 3.0, 4.0, 5.0):
            scaled = x * scale
            results.append(streams.run(chain, scaled, weight))
            del scaled  # what comes next may not take its memory before the chain has read it
            results.append(x * -scale)
    return results


def chains(x, weight):
    with joined_late():
        results = results_of_chains(x, weight, late=True) + results_of_chains(x + 1, weight, late=True)
    return torch.stack(results + results_of_chains(x - 1, weight)).sum(0)


def test_in_order_without_a_graph():
    seen = []
    with Streams(torch.ones(1)) as streams:
        assert streams.run(lambda a, b: seen.append(a) or b, 1, 2) == 2
        seen.append(2)
    assert seen == [1, 2]


def test_late_contexts_are_awaited_when_the_next_is_left(monkeypatch):
    log = []

    class Stream:
        def __init__(self, name):
            self.name, self.count = name, 0

        def wait_stream(self, other):
            log.append(f"{self.name} waits for all of {other.name}")

        def wait_event(self, event):
            log.append(f"{self.name} waits for {event}")

        def record_event(self):
            self.count += 1
            return f"{self.name}{self.count}"

    main, side = Stream("main"), Stream("side")
    monkeypatch.setattr(streams_module, "_streams", lambda device: (side,))
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: main)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())

    def run(name, late=True):
        x = torch.ones(1)
        with Streams(SimpleNamespace(is_cuda=True, device="cuda"), late=late) as streams:
            streams.run(lambda _: log.append(name), x)
        return weakref.ref(x)

    with joined_late():
        read = [run("a"), run("b"), run("read at once", late=False)]
        assert read[0]() is None and read[1]() is not None and read[2]() is None
    assert read[1]() is None
    run("c")
    starts, waits = "side waits for all of main", "main waits for all of side"
    assert log == [
        *(starts, "a"),
        *(starts, "b", "main waits for side1"),
        *(starts, "read at once", waits),
        "main waits for side2",
        *(starts, "c", waits),
    ]


def test_graph_with_parallel_streams_has_the_same_bits(devices):
    g = torch.Generator().manual_seed(0)
    x, weight = (torch.randn(64, 64, generator=g).to(devices[1]) for _ in range(2))
    expected = chains(x, weight)
    captured = Captured(lambda: chains(x, weight), devices[1])
    for _ in range(3):
        assert_same_bits(captured(), expected)
    x.mul_(0.5)
    assert_same_bits(captured(), chains(x, weight))


def test_failure_in_a_stream_is_raised(devices):
    def wrong(x):
        with Streams(x) as streams:
            streams.run(lambda: x[0].item())

    x = torch.ones(3, device=devices[1])
    with pytest.raises(CaptureError, match="captur"):
        Captured(lambda: wrong(x), devices[1])
    assert_same_bits(Captured(lambda: x + 1, devices[1])(), x + 1)
