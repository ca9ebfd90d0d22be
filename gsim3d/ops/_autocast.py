"""Ops that compute in the dtype of ``torch.autocast`` on CUDA; the other ops run in float32 under autocast."""

import torch
from torch import Tensor

_library = torch.library.Library("gsim3d", "FRAGMENT")
_autocast = torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastCUDA)


def follow_autocast(name: str) -> None:
    """Under ``torch.autocast("cuda")`` casts the op's floating-point arguments to its dtype, but float64, as torch."""
    op = getattr(torch.ops.gsim3d, name).default

    def kernel(*arguments):
        dtype = torch.get_autocast_dtype("cuda")

        def cast(argument):
            narrow = isinstance(argument, Tensor) and argument.is_floating_point() and argument.dtype != torch.float64
            return argument.to(dtype) if narrow else argument

        with torch._C._ExcludeDispatchKeyGuard(_autocast):
            return op(*(cast(argument) for argument in arguments))

    _library.impl(name, kernel, "AutocastCUDA")
