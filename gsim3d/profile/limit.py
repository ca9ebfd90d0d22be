"""How long a report may take."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

# shares of the time after which nothing more is begun of a part of the report: what follows needs the rest
COMPARE, ROUNDS, PRESETS, REGIMES = 0.4, 0.6, 0.8, 0.9
LEFT_OUT = "no time left"


class TimeLimit:
    """Seconds that may be used from now on; None: as many as it takes."""

    def __init__(self, seconds: float | None = None, now: Callable[[], float] = time.monotonic):
        self._seconds, self._now, self._start = seconds or math.inf, now, now()

    def left(self, share: float = 1.0) -> float:
        """Seconds until ``share`` of it is used."""
        return share * self._seconds - (self._now() - self._start)

    def part(self, share: float) -> float:
        """Seconds that ``share`` of it is, whatever is used."""
        return share * self._seconds

    def is_over(self, share: float = 1.0) -> bool:
        return self.left(share) <= 0
