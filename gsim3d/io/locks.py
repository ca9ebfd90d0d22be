"""One writer in a folder."""

import errno
import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsim3d.errors import InputError

LOCK_FILE = ".lock"

_held: set[Path] = set()  # folders that this process locked as a whole


@contextmanager
def only_one_writer(out: Path, parts: range | None = None) -> Iterator[None]:
    """Locks an existing folder, or the numbered ``parts`` of it, for this process, also on a network file system.

    Where this process has locked all of it already, nothing is done.

    Raises:
        InputError: another process writes there; the message has its number, if it locked the folder as a whole.
    """
    folder = out.resolve()
    if folder in _held:
        yield
        return
    # Each part is one byte of a file, which calls that lock all of it remove when they end.
    file = out / LOCK_FILE
    while True:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(handle, parts)
            if os.path.samestat(os.fstat(handle), os.stat(file)):
                break  # else another call has removed it meanwhile
        except FileNotFoundError:
            pass
        except BlockingIOError:
            writer = os.read(handle, 200).decode(errors="replace").strip()
            os.close(handle)
            named = f"process {writer}" if writer else "another process"
            raise InputError(f"{named} is writing to {out}; wait for it or choose another folder") from None
        os.close(handle)
    os.ftruncate(handle, 0)
    if parts is None:
        os.write(handle, f"{os.getpid()} on {socket.gethostname()}\n".encode())
        _held.add(folder)
    try:
        yield
    finally:
        if parts is None:
            _held.discard(folder)
            file.unlink(missing_ok=True)
        os.close(handle)


def _lock(handle: int, parts: range | None) -> None:
    ranges = [(0, 0)] if parts is None else [(1, number) for number in parts]  # length 0: to the end, however far
    try:
        for length, start in ranges:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, length, start)
    except PermissionError as error:  # what some systems say instead
        raise BlockingIOError from error
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP):  # file systems that know no locks
            raise
