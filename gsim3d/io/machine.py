"""Facts about the machine and the versions, for files that state how they were made."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from pathlib import Path
from typing import TYPE_CHECKING

import gsim3d

if TYPE_CHECKING:
    import torch

PACKAGE = Path(gsim3d.__file__).parent


def machine(device: torch.device) -> dict[str, str]:
    """Versions, device and processor of a measurement. "sources" is a hash of the package's Python files."""
    import torch  # not above: workers that generate data run without torch

    digest = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0" + file.read_bytes())
    found = {"gsim3d": gsim3d.__version__, "sources": digest.hexdigest()[:12]}
    found |= {"torch": torch.__version__, "python": platform.python_version()}
    if device.type == "cuda":
        return found | {"device": torch.cuda.get_device_name(device), "cuda": str(torch.version.cuda)}
    return found | {"device": f"CPU, {torch.get_num_threads()} threads", "processor": processor_name()}


def version_of(distribution: str) -> str | None:
    """Version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor_name() -> str:
    """Model name of the CPU, or its architecture if the system does not give one."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
