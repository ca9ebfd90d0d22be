"""The learning rate as a function of the step."""

import math

START_DIVISOR = 25  # the first rate is the peak over this
END_DIVISOR = 1e4  # the last rate is the first over this


def one_cycle(step: int, n_steps: int, peak: float, warm_up: float = 0.01) -> float:
    """One-cycle rate at ``step``: a cosine from peak / 25 up to the peak, then a cosine down to peak / 250 000.

    Args:
        step: from 0 to n_steps - 1.
        warm_up: share of the steps until the peak.
    Source: Smith and Topin 2019, "Super-convergence".
    """
    start, end = peak / START_DIVISOR, peak / START_DIVISOR / END_DIVISOR
    turn = max(1.0, warm_up * n_steps - 1)
    if step <= turn:
        return _cosine(start, peak, step / turn)
    return _cosine(peak, end, min(1.0, (step - turn) / max(1.0, n_steps - 1 - turn)))


def _cosine(a: float, b: float, share: float) -> float:
    return b + (a - b) * (1 + math.cos(math.pi * share)) / 2
