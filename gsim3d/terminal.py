"""What commands share: text that is safe on a terminal, progress with the time left, and options with a range."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable
from typing import Any

from gsim3d.errors import InputError, did_you_mean

# C0 and C1 control characters, lone surrogates, and those that turn the direction of writing
HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def plain(text: str) -> str:
    """``text`` with escapes such as \\x1b in place of characters that are not shown, but change what is."""
    return HIDDEN.sub(lambda match: match[0].encode("unicode_escape", "surrogatepass").decode(), text)


class Terminal:
    """A text stream whose text is :func:`plain`, whatever names of files are in it.

    A carriage return passes at the begin of a text: progress bars write them. Once a pipe has no reader, what is
    written to it is lost, and the command goes on.
    """

    def __init__(self, stream: Any):
        self._stream, self._is_open = stream, True

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
        except BrokenPipeError:
            self._is_open = False
            with open(os.devnull, "wb") as nothing:  # where what Python still holds goes at the end
                os.dup2(nothing.fileno(), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Parser(argparse.ArgumentParser):
    """Takes no abbreviations; its errors are InputErrors that suggest the nearest known word."""

    def __init__(self, *args: Any, **options: Any):
        options = {"formatter_class": argparse.RawDescriptionHelpFormatter, **options, "allow_abbrev": False}
        super().__init__(*args, **options)

    def parsed(self, arguments: list[str]) -> argparse.Namespace:
        """The arguments; options may stand between and behind the others."""
        for word in arguments[: arguments.index("--")] if "--" in arguments else arguments:
            name = word.partition("=")[0]
            if word.startswith("--") and name not in self._option_string_actions:
                self.error(f"unrecognized arguments: {name}{did_you_mean(name, self._option_string_actions)}")
        return self.parse_intermixed_args(arguments)

    def error(self, message: str) -> None:
        raise InputError(f"{message} (see {self.prog} --help)")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            hint = did_you_mean(str(value), known)
            raise argparse.ArgumentError(action, f"invalid choice: {value!r} (choose from {', '.join(known)}){hint}")


def whole(least: int, most: float = math.inf) -> Callable[[str], int]:
    """The type of an option that takes a whole number from ``least`` to ``most``."""

    def convert(text: str) -> int:
        return _within(int(text), least, most)

    convert.__name__ = "int"
    return convert


def number(least: float, most: float = math.inf, *, above: bool = False) -> Callable[[str], float]:
    """The type of an option that takes a finite number of at least ``least`` (or ``above`` it) and at most ``most``."""

    def convert(text: str) -> float:
        value = float(text)
        if above and value == least or not math.isfinite(value):
            raise argparse.ArgumentTypeError(f"must be a finite number above {least:g}; got {text}")
        return _within(value, least, most)

    convert.__name__ = "float"
    return convert


def _within(value: float, least: float, most: float) -> Any:
    if not least <= value <= most:
        wanted = f"at least {least:g}" if most == math.inf else f"from {least:g} to {most:g}"
        raise argparse.ArgumentTypeError(f"must be {wanted}; got {value}")
    return value


def progress(iterable: Any = None, what: str = "", total: int | None = None, *, unit: str = "it", quiet: bool = False):
    """A bar that shows how far something is and how long the rest takes; none where stderr is no terminal."""
    from tqdm import tqdm

    return tqdm(iterable, what, total, unit=unit, disable=True if quiet else None)
