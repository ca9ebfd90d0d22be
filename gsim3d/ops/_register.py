"""Registers fakes, gradients and rules of autocast; refuses gradients that an op does not have, by name.

An op has a first derivative in reverse mode of the arguments that its rule knows. Other arguments that ask for a
gradient, second derivatives and forward mode end with a :class:`gsim3d.GradientError`, never with None or 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._library.autograd import Info, make_autograd_impl
from torch.autograd import forward_ad

from gsim3d.errors import GradientError
from gsim3d.ops import _load  # noqa: F401

_library = torch.library.Library("gsim3d", "FRAGMENT")


def fake(name: str) -> Callable[[Callable], Callable]:
    """A decorator: the function makes the results of gsim3d::``name`` without computing them."""
    return torch.library.register_fake(f"gsim3d::{name}")


def register_gradients(
    op: str, backward: Callable, setup: Callable, *, gradient_ops: Sequence[str], without: Sequence[str] = ()
) -> None:
    """As torch.library.register_autograd, of gsim3d::``op``.

    Args:
        op: name.
        backward: of torch.
        setup: of torch.
        gradient_ops: what ``backward`` calls and what has no derivative itself.
        without: tensor arguments that have no gradient.
    """
    _register(op, op, Info(backward, setup), without)
    for name in gradient_ops:
        _register(name, op, Info(_second_derivative_of(op), None), ())


def register_autocast(op: str, rule: str | Callable[[str, Sequence[Any]], Sequence[Any]]) -> None:
    """What gsim3d::``op`` computes in under ``torch.autocast``.

    Args:
        op: name.
        rule: "float32": in float32; "follow": the same on the CPU, and in autocast's dtype on CUDA (float64 stays, as
            in torch); or a function (device, arguments) -> arguments.
    """
    overload = getattr(torch.ops.gsim3d, op).default
    for device in ("cpu", "cuda"):
        if rule == "float32" or (rule == "follow" and device == "cpu"):
            torch.library.register_autocast(f"gsim3d::{op}", device, torch.float32)
            continue
        _library.impl(op, _cast(overload, device, _follow if rule == "follow" else rule), f"Autocast{device.upper()}")


def _cast(overload: Callable, device: str, rule: Callable) -> Callable:
    keys = torch._C.DispatchKeySet(getattr(torch._C.DispatchKey, f"Autocast{device.upper()}"))

    def kernel(*arguments):
        arguments = rule(device, arguments)
        with torch._C._ExcludeDispatchKeyGuard(keys):
            return overload(*arguments)

    return kernel


def _follow(device: str, arguments: Sequence[Any]) -> list[Any]:
    dtype = torch.get_autocast_dtype(device)
    return [x.to(dtype) if is_narrow(x) else x for x in arguments]


def is_narrow(x: Any) -> bool:
    """Whether it is a tensor that autocast may cast."""
    return isinstance(x, Tensor) and x.is_floating_point() and x.dtype != torch.float64


def refuse(op: str, tensors: dict[str, Tensor], *, forward_only: bool = False) -> None:
    """Raises GradientError where one of ``tensors`` asks for a gradient that ``op`` does not have.

    Args:
        op: name, for the message.
        tensors: by name.
        forward_only: whether reverse mode has one.
    """
    is_forward = forward_ad._current_level >= 0
    if not is_forward and (forward_only or not torch.is_grad_enabled()):
        return
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            continue
        if is_forward and forward_ad.unpack_dual(value).tangent is not None:
            said = "has no derivative in forward mode (jvp); use reverse mode, as torch.func.vjp"
        elif not forward_only and value.requires_grad:
            said = f"has no gradient (order 1); give {name}.detach(), or ask for other gradients"
        else:
            continue
        raise GradientError(f"{op}: {name} {said}", op=op, argument=name, order=1)


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
