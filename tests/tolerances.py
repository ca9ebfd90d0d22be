"""Every tolerance of the tests in one table: value, worst error seen, the machine, and the reason.

Unless the reason says otherwise a value is an absolute error over the largest absolute expected value.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    value: float
    worst: float  # the largest error seen when the value was chosen
    machine: str
    reason: str


EPYC = "AMD EPYC (Zen 4), torch 2.13 CPU"

TOLERANCES = {
    "pool_float32": Tolerance(1e-6, 2e-7, EPYC, "float32 sums of up to 20 rows against float64"),
    "pool_float64": Tolerance(1e-14, 4e-16, EPYC, "float64 sums of up to 20 rows, another order of additions"),
    "raster_float32": Tolerance(1e-5, 2.2e-6, EPYC, "float32 exponents and products of up to 60 layers against float64"),
    "raster_float64": Tolerance(2e-13, 1.5e-14, EPYC, "as raster_float32, in float64"),
    "raster_many_float32": Tolerance(1e-5, 6.5e-7, EPYC, "thousands of layers in one pixel"),
    "raster_many_float64": Tolerance(1e-13, 1.7e-15, EPYC, "thousands of layers in one pixel"),
    "raster_needle_float32": Tolerance(1e-5, 1.6e-6, EPYC, "long thin Gaussians: the projected covariance is nearly singular"),
    "raster_grad_float32": Tolerance(3e-5, 6.3e-6, EPYC, "gradients of up to 60 layers, float32 against float64"),
    "raster_golden": Tolerance(1e-5, 3e-6, EPYC, "the published camera constants are float32"),
    "raster_golden_grad": Tolerance(3e-5, 8.2e-6, EPYC, "as raster_golden"),
    "raster_golden_float32": Tolerance(3e-5, 5.8e-6, EPYC, "float32 on both sides"),
    "raster_grad_float64": Tolerance(2e-13, 1.1e-14, EPYC, "as raster_grad_float32, in float64"),
}


def tolerance(name: str) -> float:
    return TOLERANCES[name].value
