"""Why a training run ends before its last step: signals, and processes or a launcher that are gone.

Processes of a run exchange signs of life; where the launcher or one of them is gone, the others end, too.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from gsim3d.errors import RunStopped

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
TWICE = 2.0  # seconds: a launcher passes on what its processes also got themselves
INTERVAL = 2.0  # seconds between two signs of life
SILENCE = 40.0  # seconds without one after which a process is gone; one that loads a library gives none meanwhile
GRACE = 45.0  # seconds in which a run without a launcher may save and end by itself

_MESSAGE = struct.Struct("!i")  # one of these two, or the rank of a process that is gone
_ALIVE, _LEFT = -1, -2


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


class Liveness:
    """Watches the launcher of this process and, over connections to the first process, all others.

    An operation between processes waits for minutes, or for ever, where one is gone, and cannot be interrupted. So a
    thread ends this process with one line and exit code 2 where it has not ended by itself soon after.

    Attributes:
        lost: what is gone, a sentence; None while all are there.
    """

    def __init__(self, rank: int):
        self.lost: str | None = None
        self._rank = rank
        # A process that was started by hand may outlive its shell.
        self._launcher = os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else None
        self._over, self._found = threading.Event(), threading.Event()
        self._others: dict[int, socket.socket] = {}
        self._heard: dict[int, float] = {}
        threading.Thread(target=self._watch, daemon=True).start()

    def connect(self, count: int, gather: Callable) -> None:
        """Connects ``count`` processes, whose ``gather`` works already."""
        try:
            others = self._accepted(count, gather) if self._rank == 0 else self._connected(gather)
        except OSError as error:
            raise RunStopped(f"MASTER_ADDR: processes of this run cannot be reached: {error}") from None
        for other in others.values():
            other.settimeout(INTERVAL)
        self._others = others
        self._heard = dict.fromkeys(others, time.monotonic())

    def _accepted(self, count: int, gather: Callable) -> dict[int, socket.socket]:
        family = socket.AF_INET6 if socket.has_dualstack_ipv6() else socket.AF_INET
        with socket.create_server(("", 0), family=family, dualstack_ipv6=family == socket.AF_INET6) as server:
            gather(server.getsockname()[1])
            server.settimeout(SILENCE)
            others: dict[int, socket.socket] = {}
            while len(others) < count - 1:
                other, _ = server.accept()
                other.settimeout(INTERVAL)
                if (rank := _received(other)) in range(1, count):
                    others[rank] = other
        return others

    def _connected(self, gather: Callable) -> dict[int, socket.socket]:
        first = socket.create_connection((os.environ["MASTER_ADDR"], gather(None)[0]), SILENCE)
        first.sendall(_MESSAGE.pack(self._rank))
        return {0: first}

    def end(self, *, failed: bool) -> None:
        """Ends the watch; ``failed``: the others cannot go on without this process."""
        if not self._over.is_set():
            self._over.set()
            self._send(self._rank if failed else _LEFT)

    def error(self) -> RunStopped:
        """What to raise where an operation between processes failed."""
        self._found.wait(INTERVAL)
        what = self.lost or "the connection to another process of this run broke"
        return RunStopped(f"{what}; start the command again: a training run goes on from its last checkpoint")

    def _watch(self) -> None:
        while not self._over.is_set():
            if self._launcher not in (None, os.getppid()):
                return self._lose("the launcher of this run (torchrun) has ended", GRACE)
            self._send(_ALIVE)
            gone = self._listen(time.monotonic() + INTERVAL)
            if gone is not None and not self._over.is_set():
                self._send(gone)
                return self._lose(f"process {gone} of this run has ended or does not answer", INTERVAL)

    def _listen(self, until: float) -> int | None:
        """The rank of a process that is gone, after listening for a while; None: all are there."""
        with selectors.DefaultSelector() as selector:
            for rank in self._heard:
                selector.register(self._others[rank], selectors.EVENT_READ, rank)
            while selector.get_map() and (left := until - time.monotonic()) > 0:
                for key, _ in selector.select(left):
                    message = _received(key.fileobj)
                    if message == _LEFT:
                        selector.unregister(key.fileobj)
                        del self._heard[key.data]
                    elif message == _ALIVE:
                        self._heard[key.data] = time.monotonic()
                    else:
                        return key.data if message is None else message
        self._over.wait(max(0, until - time.monotonic()))
        silent = (rank for rank, heard in self._heard.items() if time.monotonic() - heard > SILENCE)
        return next(silent, None)

    def _send(self, message: int) -> None:
        for other in self._others.values():
            try:
                other.send(_MESSAGE.pack(message))
            except OSError:  # what reads from it notices
                pass

    def _lose(self, what: str, grace: float) -> None:
        self.lost = what
        self._found.set()
        if not self._over.wait(grace):
            print(f"\ngsim3d: error: {self.error()}", file=sys.stderr, flush=True)
            os._exit(2)


def _received(other: socket.socket) -> int | None:
    """A message; None where the connection has ended."""
    try:
        return _MESSAGE.unpack(other.recv(_MESSAGE.size, socket.MSG_WAITALL))[0]
    except (OSError, struct.error):
        return None
