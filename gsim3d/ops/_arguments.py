"""What an op asks of its arguments before its kernel sees them.

The kernels check shapes, dtypes and index lists. Here it is made sure that tensors are tensors of one device, and on
the CPU that features and weights are numbers that an op can use; looking for those on a GPU would wait for it.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsim3d.errors import NumericalError

# Sums of products of so large numbers are finite, forward and backward, for any size of a tensor.
LARGEST = {torch.float32: 1e15, torch.float64: 1e150, torch.float16: 65504.0, torch.bfloat16: 1e15}


def check_tensors(op: str, **tensors: Any) -> None:
    """Raises TypeError, naming the argument, unless all are dense tensors on one device."""
    if torch.compiler.is_compiling():
        return
    first = None
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise TypeError(f"{op}: {name} must be a tensor; got {type(value).__name__}")
        if value.layout != torch.strided:
            raise TypeError(f"{op}: {name} must be a dense tensor; got {value.layout}")
        first = first or (name, value.device)
        if value.device != first[1]:
            raise TypeError(f"{op}: {name} is on {value.device}, but {first[0]} on {first[1]}")


def check_floating(op: str, narrow: dict[str, Tensor | None] | None = None, **first: Tensor) -> None:
    """Raises ValueError, naming the argument whose dtype all others follow, unless it is float32 or float64, or one of
    ``narrow``, unless it has that dtype or 16 bits.

    On a GPU, where some ops take half precision, and under autocast, which casts, the op itself looks.
    """
    for name, value in first.items():
        device, dtype = value.device.type, value.dtype
        if device == "cpu" and dtype not in (torch.float32, torch.float64) and not torch.is_autocast_enabled("cpu"):
            raise ValueError(f"{op}: {name} must be float32 or float64; got {str(dtype).removeprefix('torch.')}")
        for other, x in (narrow or {}).items():
            allowed = x is None or x.dtype in (dtype, torch.float16, torch.bfloat16)
            if not allowed and not torch.is_autocast_enabled(device):
                wanted = str(dtype).removeprefix("torch.")
                raise ValueError(f"{op}: {other} must be {wanted}, as {name}, or of 16 bits; got {x.dtype}")


def check_splits(op: str, n: int, *, to_end: bool = True, **offsets: Tensor | None) -> None:
    """Raises ValueError, naming the argument, unless offsets are int64 and, on the CPU, ascend from 0 to ``n``, or at
    most to it."""
    for name, cu in offsets.items():
        if cu is None:
            continue
        if cu.dim() != 1 or len(cu) == 0 or cu.dtype != torch.int64:
            raise ValueError(f"{op}: {name} must be an int64 list of offsets; got {cu.dtype} {list(cu.shape)}")
        if cu.device.type == "cpu" and not torch.compiler.is_compiling():
            ends = cu.tolist()
            if ends[0] != 0 or ends[-1] > n or (to_end and ends[-1] < n) or ends != sorted(ends):
                last = n if to_end else f"at most {n}"
                raise ValueError(f"{op}: {name} must ascend from 0 to {last}; got {ends[0]} .. {ends[-1]}")


def check_numbers(op: str, *, largest_of: float = math.inf, negative: bool = True, **tensors: Tensor | None) -> None:
    """Raises NumericalError, naming the argument and its row, where a number is not finite or too large: beyond what
    its dtype allows, or ``largest_of``; or negative. None and tensors without numbers, or on a GPU, are passed over."""
    if torch.compiler.is_compiling():
        return
    for name, value in tensors.items():
        while value is not None and torch._C._functorch.is_functorch_wrapped_tensor(value):
            value = torch._C._functorch.get_unwrapped(value)  # all entries of a batch are looked at
        if value is None or value.device.type != "cpu" or value.dtype not in LARGEST or value.numel() == 0:
            continue
        largest = min(LARGEST[value.dtype], largest_of)
        least = -largest if negative else 0.0
        low, high = (x.item() for x in torch.aminmax(value.detach()))
        if not (low >= least and high <= largest):  # NaN is in neither range
            _refuse(op, name, value.detach(), largest, least)


def constant(make: Callable[..., Any], *sizes: int, device: torch.device, **options: Any) -> Any:
    """``make(*sizes, device=device, **options)``, tensors that must not be modified; kept for later calls, unless they
    are traced or captured in a graph, whose memory ends with it."""
    traced = torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack() > 0
    if traced or (device.type == "cuda" and torch._C._cuda_isCurrentStreamCapturing()):
        return make(*sizes, device=device, **options)
    stream = torch._C._cuda_getCurrentRawStream(device.index) if device.type == "cuda" else None
    return _recent(stream, make, *sizes, device=device, **options)


@functools.lru_cache(maxsize=256)
def _recent(stream: int | None, make: Callable[..., Any], *sizes: int, **options: Any) -> Any:
    with torch.inference_mode(False):
        return make(*sizes, **options)


def offsets(count: int, n: int, *, device: torch.device) -> Tensor:
    """int64 [count + 1], offsets of ``count`` lists of ``n``."""
    return torch.arange(count + 1, device=device) * n


def widened(x: Tensor) -> Tensor:
    """``x``, in float32 where it has 16 bits."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def as_given(out: Tensor, x: Tensor) -> Tensor:
    """``out`` in the dtype of ``x``; under autocast as it is."""
    casts = x.device.type != "meta" and torch.is_autocast_enabled(x.device.type)
    return out if casts else out.to(x.dtype)


def widened_on_cpu(x: Tensor, *others: Tensor | None) -> tuple[Tensor | None, ...]:
    """``x`` and ``others``, in float32 where all have one dtype of 16 bits on the CPU and autocast does not cast."""
    tensors = x, *others
    same = all(t is None or t.dtype == x.dtype for t in tensors)
    if x.device.type != "cpu" or not same or torch.is_autocast_enabled("cpu"):
        return tensors
    return tuple(t if t is None else widened(t) for t in tensors)


def _refuse(op: str, name: str, value: Tensor, largest: float, least: float) -> None:
    bad = ~((value >= least) & (value <= largest))
    row = int(bad.reshape(len(value), -1).any(1).nonzero()[0]) if value.dim() else 0
    first = float(value[bad][0])
    wanted = f"finite and at most {largest:g} in size" if least else f"finite, not negative and at most {largest:g}"
    raise NumericalError(f"{op}: {name} must be {wanted}; got {first:g} in row {row}", tensor=name, row=row)


def within_memory(op: str, what: str, kernel, *arguments):
    """``kernel(*arguments)``. Raises MemoryError, naming the argument ``what``, where its result finds no room."""
    try:
        return kernel(*arguments)
    except MemoryError:  # of a list that the kernel makes
        raise MemoryError(f"{op}: there is no memory for the result of {what}") from None
    except RuntimeError as error:
        if "aoti_torch_empty_strided" in str(error) and not torch.compiler.is_compiling():  # of torch's allocator
            raise MemoryError(f"{op}: there is no memory for the result of {what}") from None
        raise


def check_whole(op: str, **numbers: Any) -> None:
    """Raises TypeError or ValueError, naming the argument, unless all are whole numbers that 64 bits hold."""
    if torch.compiler.is_compiling():
        return
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, torch.SymInt)):
            raise TypeError(f"{op}: {name} must be a whole number; got {value!r}")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ValueError(f"{op}: {name} must fit into 64 bits; got {value}")


def check_real(op: str, **numbers: Any) -> None:
    """Raises TypeError, naming the argument, unless all are numbers."""
    if torch.compiler.is_compiling():
        return
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float, torch.SymInt, torch.SymFloat)):
            raise TypeError(f"{op}: {name} must be a number; got {value!r}")
