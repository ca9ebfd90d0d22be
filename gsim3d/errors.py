"""Typed errors, which the command line turns into one line and exit code 2, and the checks that every module shares."""

from __future__ import annotations

import difflib
import platform
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

X86_64_V3 = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}  # as Linux names them


class InputError(ValueError):
    """A file, folder, option or argument is not what it must be; the message names it and says what to do."""


class NumericalError(ValueError):
    """Numbers that no op can use (NaN, Inf, out of range); the message names where they are and what to do.

    tensor: name of the tensor. scene, step: of the particle's cloud. row: of the packed rows of the call.
    camera: image of the call. None where it is not known.
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
    """The processor lacks instructions that the compiled kernels use; the message names them."""


class CaptureError(RuntimeError):
    """Something cannot be made a CUDA graph; the message says why.

    out_of_memory: whether memory was lacking.
    """

    def __init__(self, message: str, *, out_of_memory: bool = False):
        super().__init__(message)
        self.out_of_memory = out_of_memory


class FitWarning(UserWarning):
    """Data is changed to fit a model or a file format; the message says what is changed and how to keep it."""


class GradientError(NotImplementedError):
    """A derivative that an op does not have; the message names the op, the argument and the order.

    argument: name of the argument that asked for it; None: any. order: 1, or 2 for the derivative of a gradient.
    """

    def __init__(self, message: str, *, op: str, argument: str | None, order: int):
        super().__init__(message)
        self.op, self.argument, self.order = op, argument, order


class RunStopped(RuntimeError):
    """A run ended before its work was done: by a signal, or because its launcher or another process of it is gone; the
    message says how to go on.

    code: exit code of the command; 128 and the signal's number where a signal ended it.
    """

    def __init__(self, message: str, code: int = 2):
        super().__init__(message)
        self.code = code


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown ``name``: "; did you mean X?", or nothing where no known one is near."""
    lower = {str(word).lower(): str(word) for word in known}
    near = difflib.get_close_matches(str(name)[:100].lower(), lower, 1)
    return f"; did you mean {lower[near[0]]}?" if near else ""


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


def check_processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> None:
    """Raises ProcessorError where the processor is known to lack an instruction of x86-64-v3."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return
    try:
        with open(cpuinfo) as lines:
            flags = next((line.split(":", 1)[1].split() for line in lines if line.startswith("flags")), None)
    except OSError:
        return
    if flags is not None and (missing := sorted(X86_64_V3.difference(flags))):
        raise ProcessorError(
            "gsim3d needs an x86-64-v3 processor (Intel Haswell, AMD Zen or later); "
            f"this one lacks {', '.join(missing)}"
        )
