"""Signals that ask a run to end: it saves first."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
TWICE = 2.0  # seconds: a launcher passes on what its processes also got themselves


@contextmanager
def noted_signals() -> Iterator[list[int]]:
    """Within it SIGINT, SIGTERM and SIGUSR1 end nothing: their numbers are in the list, the first one first.

    A second SIGINT raises KeyboardInterrupt. In other threads than the main one the list stays empty.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    first = 0.0

    def note(number: int, _frame: FrameType | None) -> None:
        nonlocal first
        if not noted:
            first = time.monotonic()
            text = f"\ngsim3d: {signal.Signals(number).name}: ends after this step, with a checkpoint\n"
            os.write(2, text.encode())  # print may be in use
        elif number == signal.SIGINT and time.monotonic() - first > TWICE:
            raise KeyboardInterrupt
        noted.append(number)

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
