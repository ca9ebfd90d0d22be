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
}


def tolerance(name: str) -> float:
    return TOLERANCES[name].value
