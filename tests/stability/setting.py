"""Where and how precisely a hard case is computed, and what it measures there."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from gsim3d.cameras import Frames
from gsim3d.state import Particles
from tests.asserts import assert_same_bits, relative_to_max
from tests.tolerances import tolerance

NAMES = ("cpu float64", "cpu float32", "cuda float32", "cuda tf32", "cuda bf16")


@dataclass(frozen=True)
class Setting:
    """precision: "float64", "float32", "tf32" (float32 numbers, products of fewer bits) or "bf16" (autocast)."""

    device: torch.device
    precision: str

    @property
    def name(self) -> str:
        return f"{self.device.type} {self.precision}"

    @property
    def dtype(self) -> torch.dtype:
        """Of what goes in."""
        return torch.float64 if self.precision == "float64" else torch.float32

    @property
    def exact(self) -> str:
        """The precision of ops that follow neither TF32 nor autocast."""
        return "float64" if self.precision == "float64" else "float32"

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Within it torch computes as the setting says."""
        flags = torch.backends.cuda.matmul, torch.backends.cudnn
        before = [flag.allow_tf32 for flag in flags]
        for flag in flags:
            flag.allow_tf32 = self.precision == "tf32"
        try:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
                yield
        finally:
            for flag, value in zip(flags, before, strict=True):
                flag.allow_tf32 = value

    def to(self, x):
        """On the device and in the dtype: a tensor, particles, frames (their calibration stays as it is), a module."""
        if isinstance(x, Tensor):
            return x.to(self.device, self.dtype) if x.is_floating_point() else x.to(self.device)
        if isinstance(x, Particles):
            return dataclasses.replace(x.map(self.to), origin=x.origin.to(self.device))
        if isinstance(x, Frames):
            return dataclasses.replace(x.to(self.device), images=self.to(x.images))
        if isinstance(x, nn.Module):
            return x.to(self.device, self.dtype)
        return x.to(self.dtype).to(self.device)


@dataclass
class Measured:
    """What one test saw; the documentation shows it. Every method fails the test where the case is not met."""

    outcomes: list[str] = field(default_factory=list)
    error: float | None = None
    bound: float | None = None

    def outcome(self, text: str) -> None:
        if text not in self.outcomes:
            self.outcomes.append(text)

    def finite(self, *tensors: Tensor | None) -> None:
        for i, tensor in enumerate(tensors):
            if tensor is not None:
                assert torch.isfinite(tensor).all(), f"tensor {i} of {len(tensors)} is not finite"
        self.outcome("finite")

    def close(
        self, actual: Tensor, expected: Tensor, limit: float | str, what: str = "result", *, floor: float = 0.0
    ) -> None:
        """``limit``: largest error relative to the largest expected value, or its name in tests/tolerances.py.

        floor: a largest expected value below it counts as it.
        """
        bound = tolerance(limit) if isinstance(limit, str) else limit
        error = relative_to_max(actual, expected)
        largest = expected.abs().max().item() if expected.numel() else 0.0
        if largest < floor:
            error *= (largest or 1.0) / floor
        assert error <= bound, f"{what}: error relative to max {error:.3g}, tolerance {bound:.3g}"
        if self.error is None or error > self.error:
            self.error, self.bound = error, bound

    def unchanged(self, setting: Setting, actual: Tensor, expected: Tensor, what: str) -> None:
        """Results of rows in calls of different sizes: bit-equal in float32 on the CPU.

        Elsewhere BLAS rounds a matrix product by its number of rows, and they are equal to rounding.
        """
        if setting.name == "cpu float32":
            return self.same_bits(actual, expected, what)
        self.close(actual, expected, f"other_rows_{setting.precision}", what)
        self.outcome("others equal to rounding")

    def same_bits(self, actual: Tensor, expected: Tensor, what: str = "result") -> None:
        assert_same_bits(actual, expected, what)
        self.outcome("bit-equal")
