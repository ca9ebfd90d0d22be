"""Whether a machine can compile a model, and whether its matrix products would gain from fp8: measured, not assumed."""

from __future__ import annotations

import statistics
from collections import Counter
from typing import TYPE_CHECKING

import torch
from torch.nn import functional as F

from gsim3d.cuda_graphs import Captured
from gsim3d.errors import CaptureError
from gsim3d.nn.layers import RowLinear
from gsim3d.simulator import Simulator
from gsim3d.state import Particles

if TYPE_CHECKING:
    from gsim3d.profile.subject import Subject

FIRST_WITH_FP8 = (8, 9)
MULTIPLE = 16  # of the channels that fp8 products can have
REPEATS, REPLAYS = 20, 5
Product = tuple[int, int, int]  # rows, channels that come in, channels that go out


def compiler_problem(device: torch.device) -> str:
    """Why torch.compile makes nothing for ``device``; "" where it can."""
    if device.type == "cuda":
        from torch.utils._triton import has_triton

        return "" if has_triton() else "triton, which compiles for the GPU"
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except Exception:  # whatever it tried failed: there is no compiler that torch finds
        return "a C++ compiler"
    return ""


def why_not(subject: Subject) -> str:
    """Why fp8 is no setting: what it needs, or what the products of a step would take.

    Activations must be rounded to fp8 before every product, and the layers are narrow: the report measures both on its
    machine. The best case is taken for fp8: a scale that is known beforehand, so that no maximum is looked for.
    """
    device = subject.device
    if device.type != "cuda" or torch.cuda.get_device_capability(device) < FIRST_WITH_FP8:
        return "a GPU that multiplies fp8"
    products = products_of(subject.restored.simulator, subject.start(subject.runner(), 0))
    if not products:
        return f"layers of a multiple of {MULTIPLE} channels"
    try:
        halves, eighths = _milliseconds(products, device, fp8=False), _milliseconds(products, device, fp8=True)
    except (CaptureError, RuntimeError) as error:
        return f"a torch that multiplies fp8 here: {str(error).splitlines()[0]}"
    return verdict(products.total(), halves, eighths)


def verdict(n_products: int, halves: float, eighths: float) -> str:
    """In words, from milliseconds of all products in bf16, and in fp8 with the rounding of what comes in."""
    gain = "nothing to gain" if eighths >= halves else f"at most {halves - eighths:.3f} ms of a step to gain"
    return (
        f"wider layers: {gain} on this GPU, where the {n_products} linear layers of a step's blocks take "
        f"{halves:.3f} ms in bf16, and {eighths:.3f} ms in fp8 with the rounding of what comes in"
    )


def products_of(simulator: Simulator, state: Particles) -> Counter[Product]:
    """The matrix products of the blocks in one step that fp8 could do, and how often each is done."""
    net, counts = simulator.dynamics.net, Counter()
    pyramid = simulator.dynamics.geometry(state)
    for part in (net.encoder, net.decoder):
        for room, stage in zip(part, pyramid.stages):
            for layer in room.blocks.modules():
                if isinstance(layer, RowLinear) and not (layer.in_features % MULTIPLE or layer.out_features % MULTIPLE):
                    counts[stage.n_rows, layer.in_features, layer.out_features] += 1
    return counts


def _milliseconds(products: Counter[Product], device: torch.device, *, fp8: bool) -> float:
    """Of all products once, on the GPU alone: launches by the host are left out."""
    total = 0.0
    one = torch.ones((), device=device)
    for (rows, width, out), count in products.items():
        x = torch.randn(rows, width, device=device, dtype=torch.bfloat16)
        weight = torch.randn(out, width, device=device, dtype=torch.bfloat16)
        bias = torch.zeros(out, device=device, dtype=torch.bfloat16)
        small = weight.to(torch.float8_e4m3fn)

        def product(x=x, weight=weight, bias=bias, small=small):
            if not fp8:
                return F.linear(x, weight, bias)
            x = x.to(torch.float8_e4m3fn)
            return torch._scaled_mm(x, small.t(), scale_a=one, scale_b=one, bias=bias, out_dtype=torch.bfloat16)

        repeated = Captured(lambda product=product: [product() for _ in range(REPEATS)][-1], device)
        total += count * _milliseconds_of(repeated) / REPEATS
    return total


def _milliseconds_of(graph: Captured) -> float:
    """Median of some replays, by the GPU's own clock; the first does not count."""
    first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    seen = []
    for _ in range(1 + REPLAYS):
        first.record()
        graph()
        last.record()
        last.synchronize()
        seen.append(first.elapsed_time(last))
    return statistics.median(seen[1:])
