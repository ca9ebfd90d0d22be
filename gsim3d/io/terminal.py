"""Text that is safe on a terminal, and progress with the time left."""

import errno
import io
import os
import re
from collections.abc import Callable
from typing import Any

# C0 and C1 control characters, lone surrogates, and those that turn the direction of writing
HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def plain(text: str) -> str:
    """``text`` with escapes such as \\x1b for characters that are not shown, but change the text."""
    return HIDDEN.sub(lambda match: match[0].encode("unicode_escape", "surrogatepass").decode(), text)


class Terminal:
    """A text stream whose text is :func:`plain`, whatever names of files are in it.

    A carriage return passes at the begin of a text: progress bars write them. Once a pipe has no reader or the
    terminal is gone, what is written is lost, and the command goes on.
    """

    def __init__(self, stream: Any):
        self._stream, self._is_open = stream or io.StringIO(), True  # None: closed before Python began

    def write(self, text: str) -> int:
        begin = "\r" if text.startswith("\r") else ""
        shown = begin + plain(text[len(begin) :])
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        self._try(lambda: self._stream.write(shown.encode(encoding, "backslashreplace").decode(encoding)))
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, action: Callable[[], Any]) -> None:
        if not self._is_open:
            return
        try:
            action()
        except OSError as error:
            self._is_open = False
            with open(os.devnull, "wb") as nothing:  # where what Python still holds goes at the end
                os.dup2(nothing.fileno(), self._stream.fileno())
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise OSError(error.errno, error.strerror, self._stream.name) from None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def progress(
    iterable: Any = None, what: str = "", total: int | None = None, *, unit: str = "it", quiet: bool = False
) -> Any:
    """A progress bar with the time left; hidden where stderr is no terminal."""
    from tqdm import tqdm

    return tqdm(iterable, what, total, unit=unit, disable=True if quiet else None)


def in_columns(rows: list[tuple[str, ...]]) -> str:
    """A table whose columns are as wide as their longest entry."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows)
