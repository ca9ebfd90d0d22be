"""Loads the compiled op library, once; says what to type when it is missing."""

import ctypes
import os

import torch  # its libraries must be in the process before ours

try:
    from gsim3d import _ops  # noqa: F401
except ImportError as error:
    raise ImportError(
        "gsim3d's compiled ops could not be loaded. Build them from the repository with\n"
        "    pip install --no-build-isolation -e .\n"
        f"(torch {torch.__version__}; the loader said: {error})"
    ) from error

# The threads of torch's pool stay behind in a fork: whatever asks for several of them in the child waits for ever.
os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))

# glibc would give the memory of large tensors back to the kernel, which clears the pages of each new one: up to a third
# of the time on the CPU. Up to 2 GiB of freed memory stay with the process; settings of its environment come first.
_chosen = {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"} & set(os.environ)
if mallopt := getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" and not _chosen else None:
    mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD
    mallopt(-3, 2**30)  # M_MMAP_THRESHOLD


def cuda_compiled() -> bool:
    """Whether this build holds CUDA kernels."""
    return torch._C._dispatch_has_kernel_for_dispatch_key("gsim3d::pool_max", "CUDA")
