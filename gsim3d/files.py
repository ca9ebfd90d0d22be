"""Files that somebody else may have written, read with bounded memory."""

from __future__ import annotations

from pathlib import Path

from gsim3d.errors import InputError

MAX_TEXT = 256 * 2**20  # bytes of a description or of settings


def read_file(path: str | Path, most: int) -> bytes:
    """The bytes of a file.

    Raises:
        InputError: it is missing, no file (pipes and devices are not opened), has more than ``most`` bytes, or cannot be
            read; the message names it.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(f"{path} cannot be read: {'it is not a file' if path.exists() else 'no such file'}")
        size = path.stat().st_size
        if size > most:
            raise InputError(f"{path} cannot be read: it has {size} bytes; more than {most} are refused")
        with open(path, "rb") as file:
            return file.read(size)
    except MemoryError:
        raise InputError(f"{path} cannot be read: no memory for {size} bytes") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
