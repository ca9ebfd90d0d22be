"""Comparisons that tests share. A tolerance is a number or a name in tests/tolerances.py."""

import torch
from torch import Tensor

from tests.tolerances import tolerance as named_tolerance


def relative_to_max(actual: Tensor, expected: Tensor) -> float:
    """Largest absolute error over the largest absolute expected value; 0 where both are zero or empty."""
    assert actual.shape == expected.shape, f"shape {tuple(actual.shape)}, expected {tuple(expected.shape)}"
    if expected.numel() == 0:
        return 0.0
    actual, expected = actual.detach().double().cpu(), expected.detach().double().cpu()
    assert torch.isfinite(expected).all(), "the expected values are not finite"
    error, largest = (actual - expected).abs().max().item(), expected.abs().max().item()
    return error / largest if largest > 0 else error


def assert_close_relative_to_max(actual: Tensor, expected: Tensor, tolerance: float | str, what: str = "") -> None:
    """Fails unless every error is at most ``tolerance`` times the largest absolute expected value."""
    limit = named_tolerance(tolerance) if isinstance(tolerance, str) else tolerance
    error = relative_to_max(actual, expected)
    assert error <= limit, f"{what or 'result'}: error relative to max {error:.3g}, tolerance {limit:.3g}"


def assert_same_bits(actual: Tensor, expected: Tensor, what: str = "") -> None:
    """Fails unless dtype, shape and every bit agree (NaN equals the same NaN, 0 differs from -0)."""
    assert actual.dtype == expected.dtype and actual.shape == expected.shape, (
        f"{what or 'result'}: {actual.dtype} {tuple(actual.shape)}, expected {expected.dtype} {tuple(expected.shape)}"
    )
    actual, expected = (t.detach().cpu().contiguous().reshape(-1).view(torch.uint8) for t in (actual, expected))
    assert torch.equal(actual, expected), f"{what or 'result'}: {int((actual != expected).sum())} bytes differ"


def with_threads(n_threads: int, f):
    """f() on ``n_threads`` threads of torch's pool."""
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads)
    try:
        return f()
    finally:
        torch.set_num_threads(before)


def assert_same_bits_for_any_threads(f, counts=(1, 2, 3)) -> None:
    """Fails unless f() -> tensors gives the same bits on every number of threads."""
    first = with_threads(counts[0], f)
    for count in counts[1:]:
        for i, (actual, expected) in enumerate(zip(with_threads(count, f), first, strict=True)):
            assert_same_bits(actual, expected, f"output {i} on {count} threads against {counts[0]}")


def gradients(f, inputs, cotangent: Tensor) -> tuple[Tensor, ...]:
    """(f(*inputs), then d sum(cotangent * f) / d input for every input); inputs are detached first."""
    leaves = [t.detach().clone().requires_grad_() for t in inputs]
    out = f(*leaves)
    return (out.detach(), *torch.autograd.grad(out, leaves, cotangent.to(out)))
