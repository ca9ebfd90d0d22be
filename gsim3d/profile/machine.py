"""What the numbers were measured on, and with; clocks and energy of a GPU where its driver tells them."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch

import gsim3d

PACKAGE = Path(gsim3d.__file__).parent
CLOCKS = {"graphics_mhz": 0, "memory_mhz": 2}  # nvmlClockType_t
TEXT = 96  # bytes of a driver's version


def facts(device: torch.device) -> dict[str, object]:
    """Names and versions, and which sources: the commit where git knows it, and a hash of the package's files."""
    found: dict[str, object] = {
        "gsim3d": gsim3d.__version__,
        "commit": _commit(),
        "sources": _hash_of_sources(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    if device.type == "cuda":
        found |= {"device": torch.cuda.get_device_name(device), "cuda": torch.version.cuda, "driver": _driver()}
        found |= {name: _clock(device, kind) for name, kind in CLOCKS.items()}
    else:
        found |= {"device": f"CPU, {torch.get_num_threads()} threads", "processor": _processor()}
    return {name: value for name, value in found.items() if value is not None}


def _commit() -> str | None:
    """Of the checkout that this package is in, with "+" where it was changed; None outside of one."""
    root = PACKAGE.parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root.resolve():
            return None
        return git("rev-parse", "--short=12", "HEAD") + "+" * bool(git("status", "--porcelain", "-uno"))
    except (OSError, subprocess.CalledProcessError):
        return None


def _hash_of_sources() -> str:
    digest = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


# ---- what the driver tells: libnvidia-ml, which comes with it ----


@cache
def _nvml() -> ctypes.CDLL | None:
    try:
        library = ctypes.CDLL("libnvidia-ml.so.1")
        return library if library.nvmlInit_v2() == 0 else None
    except (OSError, AttributeError):
        return None


@cache
def _handle(device: torch.device) -> ctypes.c_void_p | None:
    library, handle = _nvml(), ctypes.c_void_p()
    uuid = getattr(torch.cuda.get_device_properties(device), "uuid", None)
    if library is None or uuid is None:
        return None
    name = f"GPU-{uuid}".encode()
    return handle if library.nvmlDeviceGetHandleByUUID(name, ctypes.byref(handle)) == 0 else None


def _driver() -> str | None:
    text, library = ctypes.create_string_buffer(TEXT), _nvml()
    return text.value.decode() if library and library.nvmlSystemGetDriverVersion(text, TEXT) == 0 else None


def _clock(device: torch.device, kind: int) -> int | None:
    value, handle = ctypes.c_uint(), _handle(device)
    return value.value if handle and _nvml().nvmlDeviceGetClockInfo(handle, kind, ctypes.byref(value)) == 0 else None


def _millijoules(device: torch.device) -> int | None:
    value = ctypes.c_ulonglong()
    if device.type != "cuda" or (handle := _handle(device)) is None:
        return None
    return value.value if _nvml().nvmlDeviceGetTotalEnergyConsumption(handle, ctypes.byref(value)) == 0 else None


@contextmanager
def energy(device: torch.device) -> Iterator[Callable[[], float | None]]:
    """A function that says how many joules the GPU used in the block so far; None where that cannot be read."""
    start = _millijoules(device)
    yield lambda: None if start is None else (_millijoules(device) - start) / 1e3
