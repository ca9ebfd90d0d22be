"""Argument parsing shared by all commands: no abbreviations, hints for unknown words, numbers with a range."""

import argparse
import math
from collections.abc import Callable
from typing import Any

from gsim3d.errors import InputError, did_you_mean
from gsim3d.pretrained import KEEP


class Parser(argparse.ArgumentParser):
    """Argument parser without abbreviations, which raises InputError with suggestions."""

    def __init__(self, *args: Any, **options: Any):
        options = {"formatter_class": argparse.RawDescriptionHelpFormatter, **options, "allow_abbrev": False}
        super().__init__(*args, **options)

    def parsed(self, arguments: list[str]) -> argparse.Namespace:
        """Parses arguments; options and positional arguments may be mixed."""
        for word in arguments[: arguments.index("--")] if "--" in arguments else arguments:
            name = word.partition("=")[0]
            if word.startswith("--") and name not in self._option_string_actions:
                self.error(f"unrecognized arguments: {name}{did_you_mean(name, self._option_string_actions)}")
        parsed = self.parse_intermixed_args(arguments)
        if empty := next((name for name, value in vars(parsed).items() if value == "" or value == [""]), None):
            self.error(f"{empty} must not be empty")
        return parsed

    def error(self, message: str) -> None:
        raise InputError(f"{message} (see {self.prog} --help)")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            hint = did_you_mean(str(value), known)
            raise argparse.ArgumentError(action, f"invalid choice: {value!r} (choose from {', '.join(known)}){hint}")


def add_fitting(parser: argparse.ArgumentParser) -> None:
    """Adds the options of commands that open scenes for a model."""
    parser.add_argument(
        "--keep",
        nargs="+",
        choices=KEEP,
        default=(),
        help="parts of the scene to preserve: image (scaled instead of cropped), depth (near and far)",
    )
    parser.add_argument(
        "--resample",
        action="store_true",
        help="subsample a scene with k times the model's frame rate to every k-th frame",
    )


def whole(least: int, most: float = math.inf) -> Callable[[str], int]:
    """Returns the type of an option that takes an integer from ``least`` to ``most``."""

    def convert(text: str) -> int:
        return _within(int(text), least, most)

    convert.__name__ = "int"
    return convert


def number(least: float, most: float = math.inf, *, above: bool = False) -> Callable[[str], float]:
    """Returns the type of an option that takes a finite number from ``least`` (excluded if ``above``) to ``most``."""

    def convert(text: str) -> float:
        value = float(text)
        if above and value == least or not math.isfinite(value):
            raise argparse.ArgumentTypeError(f"must be a finite number above {least:g}; got {text}")
        return _within(value, least, most)

    convert.__name__ = "float"
    return convert


def decibels(text: str) -> float:
    """Type of an option that takes a number of dB of at least 0, such as "0.1dB"."""
    try:
        value = float(text.removesuffix("dB"))
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number of dB of at least 0, such as 0.1dB; got {text!r}")
    return value


def _within(value: float, least: float, most: float) -> Any:
    if not least <= value <= most:
        wanted = f"at least {least:g}" if most == math.inf else f"from {least:g} to {most:g}"
        raise argparse.ArgumentTypeError(f"must be {wanted}; got {value}")
    return value
