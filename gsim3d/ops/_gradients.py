"""The one place where ops get their gradients, and where gradients that an op does not have are refused by name.

An op has a first derivative in reverse mode of the arguments that its rule knows. Other arguments that ask for a
gradient, second derivatives and forward mode end with a :class:`gsim3d.GradientError`, never with None or 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch._library.autograd import Info, make_autograd_impl
from torch.autograd import forward_ad

from gsim3d.errors import GradientError

_library = torch.library.Library("gsim3d", "FRAGMENT")


def register_gradients(
    op: str, backward: Callable, setup_context: Callable, *, gradient_ops: Sequence[str], without: Sequence[str] = ()
) -> None:
    """As torch.library.register_autograd, of gsim3d::``op``.

    Args:
        gradient_ops: what ``backward`` calls and what has no derivative itself.
        without: tensor arguments that have no gradient.
    """
    _register(op, op, Info(backward, setup_context), without)
    for name in gradient_ops:
        _register(name, op, Info(_second_derivative_of(op), None), ())


def refuse(op: str, tensors: dict[str, Tensor], *, forward_only: bool = False) -> None:
    """Raises GradientError where one of ``tensors`` asks for a gradient that ``op`` does not have.

    Args:
        forward_only: whether reverse mode has one.
    """
    is_forward = forward_ad._current_level >= 0
    if not is_forward and (forward_only or not torch.is_grad_enabled()):
        return
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            continue
        if is_forward and forward_ad.unpack_dual(value).tangent is not None:
            raise GradientError(
                f"{op}: {name} has no derivative in forward mode (jvp); use reverse mode, as torch.func.vjp",
                op=op,
                argument=name,
                order=1,
            )
        if not forward_only and value.requires_grad:
            raise GradientError(
                f"{op}: {name} has no gradient (order 1); give {name}.detach(), or ask for other gradients",
                op=op,
                argument=name,
                order=1,
            )


def _register(name: str, op: str, info: Info, without: Sequence[str]) -> None:
    overload = getattr(torch.ops.gsim3d, name).default
    names, rule = [argument.name for argument in overload._schema.arguments], make_autograd_impl(overload, info)

    def kernel(keyset, *arguments):
        refuse(op, dict(zip(names, arguments)), forward_only=True)
        if without:
            refuse(op, {name: value for name, value in zip(names, arguments) if name in without})
        return rule(keyset, *arguments)

    _library.impl(name, kernel, "Autograd", with_keyset=True)


def _second_derivative_of(op: str) -> Callable:
    def backward(ctx, *_):
        raise GradientError(
            f"{op}: its arguments have no second derivative (order 2): its gradient cannot be differentiated; "
            "detach it, or leave create_graph=True out",
            op=op,
            argument=None,
            order=2,
        )

    return backward
