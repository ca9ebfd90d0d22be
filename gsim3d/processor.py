"""What compiled kernels need of the processor, checked before they load: an older one would end the process."""

import platform
from pathlib import Path

from gsim3d.errors import ProcessorError

X86_64_V3 = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}  # as Linux names them


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
