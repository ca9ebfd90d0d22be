"""Parallel streams of a CUDA graph."""

import pytest
import torch

from gsim3d.cuda_graphs import Captured
from gsim3d.errors import CaptureError
from gsim3d.ops.streams import Streams
from tests.asserts import assert_same_bits


def chain(x, weight):
    """Many small kernels, one after the other."""
    for _ in range(50):
        x = (x @ weight).tanh()
    return x


def chains(x, weight):
    results = []
    with Streams(x) as streams:
        for scale in (1.0, 2.0, 3.0, 4.0, 5.0):
            scaled = x * scale
            results.append(streams.run(chain, scaled, weight))
            del scaled  # what comes next may not take its memory before the chain has read it
            results.append(x * -scale)
    return torch.stack(results).sum(0)


def test_in_order_without_a_graph():
    seen = []
    with Streams(torch.ones(1)) as streams:
        assert streams.run(lambda a, b: seen.append(a) or b, 1, 2) == 2
        seen.append(2)
    assert seen == [1, 2]


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
