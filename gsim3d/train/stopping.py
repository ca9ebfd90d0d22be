"""Early end of a training run: signals, and loss of the launcher or of a process.

Processes of a run exchange heartbeats; if the launcher or a process is lost, the others exit.
"""

import os
import selectors
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from gsim3d.errors import RunStopped

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
TWICE = 2.0  # seconds; a signal repeated within them is one that the launcher forwards
INTERVAL = 2.0  # seconds between heartbeats
SILENCE = 40.0  # seconds without heartbeat after which a process is lost; loading a library can block it for long
GRACE = 45.0  # seconds in which a run without a launcher may save and exit by itself

_MESSAGE = struct.Struct("!i")  # one of the two below, or the rank of a lost process
_ALIVE, _LEFT = -1, -2


@contextmanager
def noted_signals() -> Iterator[list[int]]:
    """Context that records SIGNALS in the yielded list instead of ending the process; ignored ones stay ignored.

    A second SIGINT raises KeyboardInterrupt. Outside of the main thread nothing is recorded.
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
            text = f"\ngsim3d: {signal.Signals(number).name}: stopping after this step, with a checkpoint\n"
            with suppress(OSError):  # the terminal is gone
                os.write(2, text.encode())  # print is not reentrant
        elif number == signal.SIGINT and time.monotonic() - first > TWICE:
            raise KeyboardInterrupt
        noted.append(number)

    heard = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in heard}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


class Liveness:
    """Monitors the launcher of this process and, through connections to the first process, all other processes.

    Communication with a lost process blocks for minutes or forever, and cannot be interrupted. So if this process does
    not exit by itself soon after a loss, a thread prints a message and exits with code 2.

    Attributes:
        lost: message about what was lost; None while all are alive.
    """

    def __init__(self, rank: int):
        self.lost: str | None = None
        self._rank = rank
        # Without torchrun, the parent is a shell, which the process may outlive.
        self._launcher = os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else None
        self._over, self._found = threading.Event(), threading.Event()
        self._others: dict[int, socket.socket] = {}
        self._heard: dict[int, float] = {}
        threading.Thread(target=self._watch, daemon=True).start()

    def connect(self, count: int, gather: Callable) -> None:
        """Connects ``count`` processes; ``gather`` exchanges values between them."""
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
        """Stops monitoring; ``failed`` informs the others that this process is lost."""
        if not self._over.is_set():
            self._over.set()
            self._send(self._rank if failed else _LEFT)

    def error(self) -> RunStopped:
        """Returns the error to raise after failed communication."""
        self._found.wait(INTERVAL)
        what = self.lost or "the connection to another process of this run was lost"
        return RunStopped(f"{what}; run the command again to resume from the last checkpoint")

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
        """Listens for heartbeats; returns the rank of a lost process, None if all are alive."""
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
            except OSError:  # noticed when reading
                pass

    def _lose(self, what: str, grace: float) -> None:
        self.lost = what
        self._found.set()
        if not self._over.wait(grace):
            print(f"\ngsim3d: error: {self.error()}", file=sys.stderr, flush=True)
            os._exit(2)


def _received(other: socket.socket) -> int | None:
    """Receives a message; returns None if the connection was closed."""
    try:
        return _MESSAGE.unpack(other.recv(_MESSAGE.size, socket.MSG_WAITALL))[0]
    except (OSError, struct.error):
        return None
