"""Typed errors, which the command line reports in one line with exit code 2, and shared checks."""

import difflib
import math
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import Any

X86_64_V3 = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}  # flags of /proc/cpuinfo


class InputError(ValueError):
    """Invalid file, folder, option or argument; the message names it and suggests a remedy."""


class NumericalError(ValueError):
    """Invalid numbers (NaN, Inf, out of range); the message gives their location and suggests a remedy.

    Attributes:
        tensor: name of the tensor; None if unknown, as for the others.
        scene, step: cloud of the particle.
        row: index in the packed rows of the call.
        camera: index of the image in the call.
    """

    def __init__(
        self,
        message: str,
        *,
        tensor: str | None = None,
        scene: int | None = None,
        step: int | None = None,
        row: int | None = None,
        camera: int | None = None,
    ):
        super().__init__(message)
        self.tensor, self.scene, self.step, self.row, self.camera = tensor, scene, step, row, camera


class ProcessorError(ImportError):
    """The processor lacks instructions that the compiled kernels require; the message names them."""


class CaptureError(RuntimeError):
    """A function cannot be captured in a CUDA graph; the message gives the reason.

    Attributes:
        out_of_memory: whether memory was exhausted.
    """

    def __init__(self, message: str, *, out_of_memory: bool = False):
        super().__init__(message)
        self.out_of_memory = out_of_memory


class FitWarning(UserWarning):
    """Data was changed to fit a model or a file format; the message says what was changed, and how to avoid it."""


class UnfamiliarInput(FitWarning):
    """The input is unlike the scenes that a model was validated on; the message has each measure and its range."""


class GradientError(NotImplementedError):
    """An unsupported derivative of an op; the message names op, argument and order.

    Attributes:
        op: name of the op.
        argument: argument that requires the gradient; None: any.
        order: 1, or 2 for a derivative of a gradient.
    """

    def __init__(self, message: str, *, op: str, argument: str | None, order: int):
        super().__init__(message)
        self.op, self.argument, self.order = op, argument, order


class RunStopped(RuntimeError):
    """A run was stopped by a signal, or by the loss of its launcher or another process; the message says how to resume.

    Attributes:
        code: exit code of the command; 128 + number of the signal, if stopped by a signal.
    """

    def __init__(self, message: str, code: int = 2):
        super().__init__(message)
        self.code = code


@contextmanager
def naming(where: str, kinds: type[Exception] | tuple[type[Exception], ...] = InputError) -> Iterator[None]:
    """Context that raises errors of ``kinds`` as an InputError whose message begins with ``where``."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{where}: {error}") from None


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Returns "; did you mean X?" with the known name closest to ``name``, or "" if none is close."""
    lower = {str(word).lower(): str(word) for word in known}
    near = difflib.get_close_matches(str(name)[:100].lower(), lower, 1)
    return f"; did you mean {lower[near[0]]}?" if near else ""


def check_one_of(name: str, value: object, known: Iterable[str]) -> None:
    """Raises InputError if ``value`` is not one of ``known``; the message names it, all of them, and the closest."""
    if not isinstance(value, str) or value not in known:
        got = f"got {repr(value)[:100]}{did_you_mean(value, known)}"
        raise InputError(f"{name} must be one of {', '.join(known)}; {got}")


def check_whole(name: str, value: object, least: int = 1, most: float = math.inf) -> None:
    """Raises InputError if ``value`` is not a whole number from ``least`` to ``most``."""
    if not isinstance(value, Integral) or isinstance(value, bool) or not least <= value <= most:
        bound = f"of at least {least}" if most == math.inf else f"from {least} to {most}"
        raise InputError(f"{name} must be a whole number {bound}; got {value!r}")


def check_ranges(config: Any, **ranges: tuple[float, float]) -> None:
    """Raises InputError if an attribute of ``config``, a number or tuple of numbers, is outside of its (min, max)."""
    for name, (least, most) in ranges.items():
        for value in _numbers(getattr(config, name)):
            if not least <= value <= most:  # also rejects NaN
                bound = f"at most {most}" if value > most else f"at least {least}"
                raise InputError(f"{name} must be {bound}; got {value}")


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, (tuple, list)):
        for item in value:
            yield from _numbers(item)
    elif value is not None:
        yield value


def check_processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> None:
    """Raises ProcessorError if the processor lacks an instruction of x86-64-v3."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return
    try:
        with open(cpuinfo) as lines:
            flags = next((line.split(":", 1)[1].split() for line in lines if line.startswith("flags")), None)
    except OSError:
        return
    if flags is not None and (missing := sorted(X86_64_V3.difference(flags))):
        needed = "gsim3d needs an x86-64-v3 processor (Intel Haswell, AMD Zen or later)"
        raise ProcessorError(f"{needed}; this one lacks {', '.join(missing)}")
