"""Ranges of the numbers of a configuration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gsim3d.errors import InputError


def check_ranges(config: Any, **ranges: tuple[float, float]) -> None:
    """Raises InputError where a number of ``config``, or one of a tuple of it, lies outside of its (least, most)."""
    for name, (least, most) in ranges.items():
        for value in _numbers(getattr(config, name)):
            if not least <= value <= most:  # NaN does not, either
                bound = f"at most {most}" if value > most else f"at least {least}"
                raise InputError(f"{name} must be {bound}; got {value}")


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif value is not None:
        yield value
