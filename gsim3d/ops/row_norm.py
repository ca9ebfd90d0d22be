"""Normalisations of packed rows, with the residual sums and activations around them."""

import torch
from torch import Tensor

from gsim3d.ops._arguments import check_floating, check_numbers, check_real, check_tensors
from gsim3d.ops._register import call, fakes, is_narrow, register_autocast, register_gradients, save_inputs


def row_norm(
    x: Tensor, weight: Tensor, bias: Tensor, residual: Tensor | None = None, *, eps: float = 1e-5, check: bool = True
) -> Tensor:
    """Normalises every row over its channels, scales, shifts and adds ``residual``.

    ``out = (x - mean(x)) / sqrt(var(x) + eps) * weight + bias + residual``, mean and variance over a row. A row's
    result has the same bits whatever rows it is packed with.

    Args:
        x: [N, C], float32 or float64, on CUDA also float16 and bfloat16 (computed in float32) and then C at most 1024.
        weight, bias: [C], float32; float64 with float64 rows.
        residual: [N, C] or None.
        eps: at least 1e-30, keeps rows of equal values finite.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [N, C], dtype of ``residual``, else of ``x``. Under ``torch.autocast`` CUDA returns autocast's dtype where there
        is no residual, ready for the matrix product that follows; the CPU computes in float32.
    Gradients:
        ``x``, ``weight``, ``bias``, ``residual``, once; sums over rows have one order.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source:
        Ba et al. 2016, Layer Normalization.

    Example:
        >>> row_norm(torch.tensor([[1.0, 3.0]]), torch.ones(2), torch.zeros(2), torch.ones(1, 2)).round(decimals=3)
        tensor([[0., 2.]])
    """
    if check:
        tensors = {"x": x, "weight": weight, "bias": bias} | ({} if residual is None else {"residual": residual})
        _check("row_norm", tensors, eps)
    dtype = x.dtype if residual is None else residual.dtype
    return call("row_norm", x, weight, bias, residual, eps, dtype)[0]


def residual_norm(
    x: Tensor,
    branch: Tensor,
    *,
    keep: Tensor | None = None,
    branch_norm: tuple[Tensor, Tensor] | None = None,
    norm: tuple[Tensor, Tensor] | None = None,
    eps: float = 1e-5,
    check: bool = True,
) -> tuple[Tensor, Tensor]:
    """The next value of a residual stream, and what the layer behind it reads.

    ``sum = x + keep * N(branch)`` and ``out = N(sum)``, where ``N`` is the layer normalisation of :func:`row_norm` with
    the weight and bias given, and nothing where there are none. All in one pass over the rows.

    Args:
        x: [N, C], float32 or float64.
        branch: [N, C], dtype of ``x``; with float32 rows on CUDA also float16 and bfloat16, and then C at most 1024.
            Under ``torch.autocast`` CUDA takes it in autocast's dtype and the CPU in float32.
        keep: [N, 1], dtype of ``x``, a factor of each row's branch; None: 1.
        branch_norm, norm: weight and bias [C] each, dtype of ``x``.
        eps, check: as in :func:`row_norm`.
    Returns:
        sum [N, C], dtype of ``x``; out [N, C], dtype of ``branch``.
    Gradients:
        ``x``, ``branch``, weights and biases, once; sums over rows have one order.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.

    Example:
        >>> norm = torch.ones(2), torch.zeros(2)
        >>> total, out = residual_norm(torch.ones(1, 2), torch.tensor([[1.0, 3.0]]), norm=norm)
        >>> total, out.round(decimals=3)
        (tensor([[2., 4.]]), tensor([[-1.,  1.]]))
    """
    if check:
        tensors = {"x": x, "branch": branch} | ({} if keep is None else {"keep": keep})
        for name, pair in {"branch_norm": branch_norm, "norm": norm}.items():
            if pair is not None and (not isinstance(pair, (tuple, list)) or len(pair) != 2):
                raise TypeError(f"residual_norm: {name} must be a pair (weight, bias); got {type(pair).__name__}")
            tensors |= {} if pair is None else {f"{name}[0]": pair[0], f"{name}[1]": pair[1]}
        _check("residual_norm", tensors, eps)
    weights = *(branch_norm or (None, None)), *(norm or (None, None))
    return call("residual_norm", x, branch, keep, *weights, eps)[:2]


def _check(op: str, tensors: dict[str, Tensor], eps: float) -> None:
    check_tensors(op, **tensors)
    check_floating(op, x=tensors["x"])
    check_real(op, eps=eps)
    check_numbers(op, **tensors)


def _setup(ctx, inputs, output):
    x, weight, _, residual, _, _ = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(x, weight, output[1])
    ctx.has_residual = residual is not None


def _backward(ctx, grad, _grad_stats):
    if grad is None:
        return (None,) * 6
    grad_x, grad_weight, grad_bias = call("row_norm_backward", grad, *ctx.saved_tensors)
    return grad_x, grad_weight, grad_bias, grad if ctx.has_residual else None, None, None


register_gradients("row_norm", _backward, _setup, gradient_ops=["row_norm_backward"])


def _residual(x, branch, keep, branch_weight, branch_bias, weight, bias, eps):
    stats = [x.new_empty(x.shape[0] if w is not None else 0, 2) for w in (branch_weight, weight)]
    return x.new_empty(x.shape), branch.new_empty(x.shape), *stats


def _residual_gradients(grad_sum, grad_out, branch, sum, keep, branch_weight, weight, branch_stats, stats):
    channels = sum.shape[1]
    of_norms = [sum.new_empty(channels if w is not None else 0) for w in (branch_weight, branch_weight, weight, weight)]
    return sum.new_empty(sum.shape), branch.new_empty(sum.shape), sum.new_empty(channels), *of_norms


def _bias_gradient(grad):
    return grad.new_empty(grad.shape[1], dtype=torch.promote_types(grad.dtype, torch.float32))


def _residual_setup(ctx, inputs, output):
    _, branch, keep, branch_weight, _, weight, _, _ = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[2:])
    ctx.save_for_backward(branch, output[0], keep, branch_weight, weight, *output[2:])


def _residual_backward(ctx, grad_sum, grad_out, *_):
    if grad_sum is None and grad_out is None:
        return (None,) * 8
    saved = ctx.saved_tensors  # read once: a checkpoint gives them once
    branch_weight, weight = saved[3:5]
    x, branch, _, *of_norms = call("residual_norm_backward", grad_sum, grad_out, *saved)
    given = [w is not None for w in (branch_weight, branch_weight, weight, weight)]
    return x, branch, None, *(g if has else None for g, has in zip(of_norms, given, strict=True)), None


_residual_ops = ["residual_norm_backward", "linear_grad_bias"]  # of the linear layer of a branch
register_gradients("residual_norm", _residual_backward, _residual_setup, gradient_ops=_residual_ops, without=["keep"])


def _row_norm_autocast(device, arguments):
    x, weight, bias, residual, eps, dtype = arguments
    if is_narrow(x):
        weight, bias = weight.float(), bias.float()
        if device == "cpu":
            x, residual, dtype = x.float(), residual if residual is None else residual.float(), torch.float32
        elif residual is None:
            dtype = torch.get_autocast_dtype("cuda")
    return x, weight, bias, residual, eps, dtype


def norm_gelu(x: Tensor, mean: Tensor, scale: Tensor, bias: Tensor, *, check: bool = True) -> Tensor:
    """Normalises the channels by values given and applies the activation: ``gelu((x - mean) * scale + bias)``.

    Args:
        x: [N, C], float32 or float64, on CUDA also float16 and bfloat16 (computed in float32).
        mean, scale, bias: [C], float32; float64 with float64 rows.
        check: as in :func:`row_norm`.
    Returns:
        [N, C], float32; float64 with float64 rows.
    Gradients:
        all arguments, once; sums over rows have one order.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source:
        Ioffe & Szegedy 2015, Batch Normalization; Hendrycks & Gimpel 2016, GELU (the exact one).

    Example:
        >>> norm_gelu(torch.tensor([[3.0]]), torch.tensor([1.0]), torch.tensor([0.5]), torch.zeros(1)).round(decimals=3)
        tensor([[0.8410]])
    """
    if check:
        tensors = {"x": x, "mean": mean, "scale": scale, "bias": bias}
        check_tensors("norm_gelu", **tensors)
        check_numbers("norm_gelu", **tensors)
    return call("norm_gelu", x, mean, scale, bias, scale.dtype)


def _norm(x, weight, bias, residual, eps, dtype):
    return x.new_empty(x.shape, dtype=dtype), weight.new_empty(x.shape[0], 2)


def _norm_gradients(grad, x, weight, *_):
    return x.new_empty(x.shape), weight.new_empty(weight.shape), weight.new_empty(weight.shape)


fakes(
    row_norm=_norm,
    row_norm_backward=_norm_gradients,
    residual_norm=_residual,
    residual_norm_backward=_residual_gradients,
    linear_grad_bias=_bias_gradient,
    norm_gelu=lambda x, mean, scale, bias, dtype: x.new_empty(x.shape, dtype=dtype),
    norm_gelu_backward=_norm_gradients,
)


def _gelu_backward(ctx, grad):
    saved = ctx.saved_tensors
    x, scale, bias = call("norm_gelu_backward", grad, *saved)
    return x, -saved[2] * bias, scale, bias, None


register_gradients("norm_gelu", _gelu_backward, save_inputs, gradient_ops=["norm_gelu_backward"])


def _gelu_autocast(device, arguments):
    x, *others = arguments
    if x.dtype != torch.float64:
        x = x.float() if device == "cpu" else x
        others = [t.float() if isinstance(t, Tensor) else t for t in others]
    return x, *others


def _residual_autocast(device, arguments):
    x, branch, *others = arguments
    if branch.dtype != torch.float64:
        branch = branch.to(torch.get_autocast_dtype("cuda") if device == "cuda" else torch.float32)
        x, *others = (t.float() if isinstance(t, Tensor) else t for t in (x, *others))
    return x, branch, *others


register_autocast("row_norm", _row_norm_autocast)
register_autocast("residual_norm", _residual_autocast)
register_autocast("norm_gelu", _gelu_autocast)
