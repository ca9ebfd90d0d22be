"""Layer normalisation of packed rows, with the residual sum that follows it."""

import torch
from torch import Tensor

from gsim3d.ops import _load  # noqa: F401
from gsim3d.ops._arguments import check_numbers, check_real, check_tensors


def row_norm(
    x: Tensor,
    weight: Tensor,
    bias: Tensor,
    residual: Tensor | None = None,
    *,
    eps: float = 1e-5,
    check: bool = True,
) -> Tensor:
    """Normalises every row over its channels, scales, shifts and adds ``residual``.

    ``out = (x - mean(x)) / sqrt(var(x) + eps) * weight + bias + residual``, mean and variance over a row. A row's result
    has the same bits whatever rows it is packed with.

    Args:
        x: [N, C], float32 or float64, on CUDA also float16 and bfloat16 (computed in float32) and then C at most 1024.
        weight, bias: [C], float32; float64 with float64 rows.
        residual: [N, C] or None.
        eps: positive, keeps rows of equal values finite.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [N, C], dtype of ``residual``, else of ``x``. Under ``torch.autocast`` CUDA returns autocast's dtype where there is
        no residual, ready for the matrix product that follows; the CPU computes in float32.
    Gradients: ``x``, ``weight``, ``bias``, ``residual``, once; sums over rows have one order.
    Raises:
        HardCaseError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source: Ba et al. 2016, Layer Normalization.

    Example:
        >>> row_norm(torch.tensor([[1.0, 3.0]]), torch.ones(2), torch.zeros(2), torch.ones(1, 2)).round(decimals=3)
        tensor([[0., 2.]])
    """
    if check:
        tensors = {"x": x, "weight": weight, "bias": bias} | ({} if residual is None else {"residual": residual})
        check_tensors("row_norm", **tensors)
        check_real("row_norm", eps=eps)
        check_numbers("row_norm", **tensors)
    dtype = x.dtype if residual is None else residual.dtype
    return torch.ops.gsim3d.row_norm(x, weight, bias, residual, eps, dtype)[0]


@torch.library.register_fake("gsim3d::row_norm")
def _(x, weight, bias, residual, eps, dtype):
    return x.new_empty(x.shape, dtype=dtype), weight.new_empty(x.shape[0], 2)


@torch.library.register_fake("gsim3d::row_norm_backward")
def _(grad, x, weight, stats):
    return torch.empty_like(x, memory_format=torch.contiguous_format), torch.empty_like(weight), torch.empty_like(weight)


def _setup(ctx, inputs, output):
    x, weight, _, residual, _, _ = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(x, weight, output[1])
    ctx.has_residual = residual is not None


def _backward(ctx, grad, _grad_stats):
    grad_x, grad_weight, grad_bias = torch.ops.gsim3d.row_norm_backward(grad, *ctx.saved_tensors)
    return grad_x, grad_weight, grad_bias, grad if ctx.has_residual else None, None, None


torch.library.register_autograd("gsim3d::row_norm", _backward, setup_context=_setup)
_library = torch.library.Library("gsim3d", "FRAGMENT")


def _autocast(device: str):
    keys = torch._C.DispatchKeySet(getattr(torch._C.DispatchKey, f"Autocast{device.upper()}"))

    def rule(x, weight, bias, residual, eps, dtype):
        if x.dtype != torch.float64:
            weight, bias = weight.float(), bias.float()
            if device == "cpu":
                x, residual, dtype = x.float(), residual if residual is None else residual.float(), torch.float32
            elif residual is None:
                dtype = torch.get_autocast_dtype("cuda")
        with torch._C._ExcludeDispatchKeyGuard(keys):
            return torch.ops.gsim3d.row_norm(x, weight, bias, residual, eps, dtype)

    return rule


for _device in ("cpu", "cuda"):
    _library.impl("row_norm", _autocast(_device), f"Autocast{_device.upper()}")
