"""Registers fakes, gradients and rules of autocast; refuses gradients that an op does not have, by name.

An op has a first derivative in reverse mode of the arguments that its rule knows. Where its gradients are ops with a
rule themselves, it has higher ones; with rules of forward mode and vmap, the transforms of ``torch.func``.
What it does not have ends with a :class:`gsim3d.GradientError`, never with None or 0.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from gsim3d.errors import GradientError
from gsim3d.ops import _load  # noqa: F401

_library = torch.library.Library("gsim3d", "FRAGMENT")
_functions: dict[str, tuple[type[torch.autograd.Function], dict[str, int]]] = {}  # and places without a gradient
_kernels: dict[str, Callable] = {}  # what the key Autograd runs
_casts: dict[str, Callable[[str, Sequence[Any]], Sequence[Any]]] = {}  # rules of autocast
_no_autocast = torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastCPU)
_no_autocast = _no_autocast | torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastCUDA)


def fakes(**functions: Callable) -> None:
    """Registers by op what makes results of the right shapes without computing them."""
    for name, function in functions.items():
        torch.library.register_fake(f"gsim3d::{name}", function)


def save_inputs(ctx: Any, inputs: Sequence[Any], output: Any) -> None:
    """The rule ``setup`` of a gradient that reads the inputs: tensors are saved, the others are ``ctx.others``."""
    ctx.save_for_backward(*(x for x in inputs if isinstance(x, Tensor)))
    ctx.others = [x for x in inputs if not isinstance(x, Tensor)]


def define(schema: str, kernel: Callable) -> None:
    """Defines gsim3d::``schema``, which ``kernel`` computes by other operations on any device."""
    _library.define(schema)
    for device in ("CPU", "CUDA"):
        _library.impl(schema.partition("(")[0], kernel, device)


def register_gradients(
    op: str,
    backward: Callable,
    setup: Callable,
    *,
    gradient_ops: Sequence[str] = (),
    without: Sequence[str] = (),
    jvp: Callable | None = None,
    batched: Callable | None = None,
) -> None:
    """As torch.library.register_autograd, of gsim3d::``op``.

    Args:
        op, backward, setup: of torch.
        gradient_ops: what ``backward`` calls and what has no derivative itself.
        without: tensor arguments that have no gradient.
        jvp: (inputs, their tangents or None, outputs) -> tangents of the outputs; :func:`call` then has forward mode.
        batched: (size, inputs, is_batched) -> outputs with the batch in front, of inputs that have it in front where
            ``is_batched``; with ``jvp``, :func:`call` then has ``torch.func``.
    """
    backward = _without_autocast(backward)
    _register(op, op, backward, setup, without)
    if batched is not None:
        names = [argument.name for argument in getattr(torch.ops.gsim3d, op).default._schema.arguments]
        function = _function_of(op, backward, setup, jvp, batched)
        _functions[op] = function, {name: names.index(name) for name in without}
    for name in gradient_ops:
        _register(name, op, _second_derivative_of(op), None, ())


def call(op: str, *arguments: Any) -> Any:
    """What gsim3d::``op`` returns, also under the transforms of ``torch.func`` and in forward mode."""
    overload = getattr(torch.ops.gsim3d, op).default
    if torch.compiler.is_compiling():
        return overload(*arguments)
    device = next(x for x in arguments if isinstance(x, Tensor)).device.type
    casts = device != "meta" and torch.is_autocast_enabled(device)
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        if op not in _functions:
            return overload(*arguments)
        function, without = _functions[op]
        refuse(op, {name: arguments[k] for name, k in without.items()})
        if op in _casts and casts:
            arguments = tuple(_casts[op](device, arguments))  # rules of gradients see what is computed with
        return _without_autocast(function.apply)(*arguments)
    watched = torch._C._len_torch_dispatch_stack() > 0 or not isinstance(overload, torch._ops.OpOverload)
    if watched or casts or device == "meta" or op not in _kernels:
        return overload(*arguments)
    return _kernels[op](None, *arguments)  # the dispatcher would convert all arguments there and back


def _function_of(op: str, backward: Callable, setup: Callable, jvp: Callable | None, batched: Callable) -> type:
    overload = getattr(torch.ops.gsim3d, op)

    class Function(torch.autograd.Function):
        @staticmethod
        def forward(*inputs):
            return overload(*inputs)

        @staticmethod
        def setup_context(ctx, inputs, output):
            setup(ctx, inputs, output)
            outputs = output if isinstance(output, tuple) else (output,)
            ctx.is_tensor = [isinstance(x, Tensor) for x in inputs]
            ctx.others = [x for x in inputs if not isinstance(x, Tensor)]
            ctx.save_for_forward(*(x for x in (*inputs, *outputs) if isinstance(x, Tensor)))

        @staticmethod
        def jvp(ctx, *tangents):
            # Of a jvp around this one the tangents count as well: torch leaves them out in here.
            with forward_ad._set_fwd_grad_enabled(True):
                tensors = (forward_ad.unpack_dual(x, level=0).primal for x in ctx.saved_tensors)
                others = iter(ctx.others)
                inputs = [next(tensors if is_tensor else others) for is_tensor in ctx.is_tensor]
                return jvp(inputs, tangents, tuple(tensors))

        @staticmethod
        def vmap(info, in_dims, *inputs):
            pairs = list(zip(inputs, in_dims, strict=True))
            moved = [x if dim is None else x.movedim(dim, 0) for x, dim in pairs]
            size, has = info.batch_size, [dim is not None for dim in in_dims]
            if size == 0:  # the shapes of results are those of an entry
                moved = [x.new_zeros(1, *x.shape[1:]) if is_batched else x for x, is_batched in zip(moved, has)]
            outputs = batched(size or 1, moved, has)
            if isinstance(outputs, tuple):
                return tuple(x[:size] for x in outputs), (0,) * len(outputs)
            return outputs[:size], 0

    Function.backward = staticmethod(backward)
    Function.__name__ = Function.__qualname__ = op
    return Function


def expanded(size: int, inputs: Sequence[Any], is_batched: Sequence[bool]) -> list[Any]:
    """``inputs``, each tensor with the batch in front."""
    pairs = zip(inputs, is_batched, strict=True)
    return [x if has or not isinstance(x, Tensor) else x.expand(size, *x.shape) for x, has in pairs]


def one_by_one(op: str) -> Callable:
    """The rule ``batched`` of an op that is called for each entry of the batch."""

    def batched(size: int, inputs: Sequence[Any], is_batched: Sequence[bool]) -> Any:
        rows = [[x[b] if has else x for x, has in zip(inputs, is_batched, strict=True)] for b in range(size)]
        results = [call(op, *row) for row in rows]
        if isinstance(results[0], tuple):
            return tuple(map(torch.stack, zip(*results, strict=True)))
        return torch.stack(results)

    return batched


def register_autocast(op: str, rule: str | Callable[[str, Sequence[Any]], Sequence[Any]]) -> None:
    """What gsim3d::``op`` computes in under ``torch.autocast``: "float32"; "follow": the same on the CPU, and
    autocast's dtype on CUDA (float64 stays, as in torch); or by a function (device, arguments) -> arguments."""
    overload = getattr(torch.ops.gsim3d, op).default
    _casts[op] = cast = partial(_cast, rule) if isinstance(rule, str) else rule
    for device in ("cpu", "cuda"):
        kernel = _without_autocast(lambda *arguments, device=device: overload(*cast(device, arguments)))
        _library.impl(op, kernel, f"Autocast{device.upper()}")


def _cast(rule: str, device: str, arguments: Sequence[Any]) -> list[Any]:
    dtype = torch.get_autocast_dtype(device) if (rule, device) == ("follow", "cuda") else torch.float32
    return [x.to(dtype) if is_narrow(x) else x for x in arguments]


def _without_autocast(function: Callable) -> Callable:
    def run(*arguments):
        with torch._C._ExcludeDispatchKeyGuard(_no_autocast):
            return function(*arguments)

    return run


def is_narrow(x: Any) -> bool:
    """Whether it is a tensor that autocast may cast."""
    return isinstance(x, Tensor) and x.is_floating_point() and x.dtype != torch.float64


def refuse(op: str, tensors: dict[str, Tensor], *, forward_only: bool = False) -> None:
    """Raises GradientError where one of ``tensors``, by name, asks for a gradient that ``op`` does not have;
    ``forward_only``: reverse mode has one."""
    is_forward = forward_ad._current_level >= 0
    if not is_forward and (forward_only or not torch.is_grad_enabled()):
        return
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            continue
        along = is_forward and forward_ad.unpack_dual(value).tangent is not None
        if along and forward_only:
            said = "has no derivative in forward mode (jvp); use reverse mode, as torch.func.vjp"
        elif not forward_only and (along or value.requires_grad):
            said = f"has no gradient (order 1); give {name}.detach(), or ask for other gradients"
        else:
            continue
        raise GradientError(f"{op}: {name} {said}", op=op, argument=name, order=1)


def _register(name: str, op: str, backward: Callable, setup: Callable | None, without: Sequence[str]) -> None:
    """As torch.library.register_autograd, but reads the schema once, not in every call."""
    overload = getattr(torch.ops.gsim3d, name).default
    arguments = overload._schema.arguments
    names, defaults = [a.name for a in arguments], [a.default_value for a in arguments]
    places = {name: names.index(name) for name in without}

    def compute(keyset, inputs):
        with torch._C._AutoDispatchBelowAutograd():
            if keyset is None:
                return overload(*inputs)
            return overload.redispatch(keyset & torch._C._after_autograd_keyset, *inputs)

    class Function(torch.autograd.function._SingleLevelFunction):  # transforms of torch.func do not come here
        @staticmethod
        def forward(ctx, *inputs):
            *inputs, keyset = inputs
            output = compute(keyset, inputs)
            if setup is not None:  # the dispatcher leaves out what equals its default
                setup(ctx, (*inputs, *defaults[len(inputs) :]), output)
            return output

        @staticmethod
        def backward(ctx, *grads):
            found = backward(ctx, *grads)
            return (*found, None) if isinstance(found, tuple) else (found, None)

    def kernel(keyset, *inputs):
        if forward_ad._current_level >= 0:
            refuse(op, dict(zip(names, inputs)), forward_only=True)
        if not torch.is_grad_enabled() or not torch._C._any_requires_grad(*inputs):
            return compute(keyset, inputs)
        if without:
            refuse(op, {name: inputs[k] for name, k in places.items() if k < len(inputs)})
        if torch._C._are_functorch_transforms_active() and not torch.compiler.is_compiling():  # not by :func:`call`
            said = "has no transforms of torch.func; use torch.autograd.grad"
            raise GradientError(f"{op}: {said}", op=op, argument=None, order=1)
        return Function.apply(*inputs, keyset)

    Function.__name__ = Function.__qualname__ = f"{name}_backward"
    _kernels[name] = kernel
    _library.impl(name, kernel, "Autograd", with_keyset=True)


def _second_derivative_of(op: str) -> Callable:
    def backward(ctx, *_):
        said = "its arguments have no second derivative (order 2): its gradient cannot be differentiated; "
        said += "detach it, or leave create_graph=True out"
        raise GradientError(f"{op}: {said}", op=op, argument=None, order=2)

    return backward
