"""Which operations a piece of code calls, how many bytes they make, and which modules it enters."""

from collections import Counter
from contextlib import contextmanager

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class counted(TorchDispatchMode):
    """A context. calls: of each operation, by name.   bytes: of all tensors that they made."""

    def __init__(self):
        super().__init__()
        self.calls, self.bytes = Counter(), 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        self.calls[str(func)] += 1
        given = {t.untyped_storage().data_ptr() for t in args if isinstance(t, torch.Tensor)}
        for tensor in out if isinstance(out, (tuple, list)) else (out,):
            if isinstance(tensor, torch.Tensor) and tensor.untyped_storage().data_ptr() not in given:
                self.bytes += tensor.untyped_storage().nbytes()
        return out


@contextmanager
def entered(module: torch.nn.Module):
    """A set that fills with the names of the submodules of ``module`` that are called."""
    names, hooks = set(), []
    for name, part in module.named_modules():
        hooks.append(part.register_forward_pre_hook(lambda *_, name=name: names.add(name)))
    try:
        yield names
    finally:
        for hook in hooks:
            hook.remove()
