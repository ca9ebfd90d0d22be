"""Layers over packed rows: on one thread a row's result has the same bits whatever rows are packed with it.

(Batch normalisation in training is the exception.) Gradients repeat bit by bit on the same number of threads; how BLAS
splits the rows of a matrix product over threads is its own affair, and on some processors changes the last bits.
"""

import contextlib
import contextvars
from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gsim3d.ops import norm_gelu, row_norm
from gsim3d.ops.streams import Streams

MIN_ROWS = 16  # matrix products of fewer rows go through other code in BLAS, which rounds differently


def linear(x: Tensor, weight: Tensor, bias: Tensor | None, *, gelu: bool = False) -> Tensor:
    """``F.linear``, or ``F.gelu`` of it; in float32 on the CPU by oneDNN, which is faster than BLAS on some."""
    traced = torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0
    unsuited = not x.is_cpu or not x.dtype == weight.dtype == torch.float32 or torch.is_autocast_enabled("cpu")
    if torch.compiler.is_compiling() or traced or unsuited or not torch.backends.mkldnn.is_available():
        out = F.linear(x, weight, bias)
    elif torch.is_grad_enabled():
        out = _OneDnnLinear.apply(x, weight, bias)
    else:
        return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "gelu" if gelu else "none", [], "none")
    return F.gelu(out) if gelu else out


class _OneDnnLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, bias):
        ctx.save_for_backward(x, weight)
        return linear(x, weight, bias)

    @staticmethod
    def backward(ctx, grad):
        (x, weight), (for_x, for_weight, for_bias) = ctx.saved_tensors, ctx.needs_input_grad
        rows = grad.flatten(0, -2)
        grad_x = linear(grad, weight.t(), None) if for_x else None
        grad_weight = rows.t() @ x.flatten(0, -2) if for_weight else None
        return grad_x, grad_weight, rows.sum(0) if for_bias else None


def row_linear(x: Tensor, weight: Tensor, bias: Tensor | None, *, gelu: bool = False) -> Tensor:
    """:func:`linear` of [N, C]."""
    n_rows = x.shape[0]
    if n_rows >= MIN_ROWS:
        return linear(x, weight, bias, gelu=gelu)
    return linear(F.pad(x, (0, 0, 0, MIN_ROWS - n_rows)), weight, bias, gelu=gelu)[:n_rows]


def linear_grad_weight(grad: Tensor, x: Tensor) -> Tensor:
    """The gradient of weight of ``x @ weight.T``, float32 or wider."""
    wide = torch.promote_types(grad.dtype, torch.float32)
    return grad.t() @ x if wide == grad.dtype else torch.mm(grad.t(), x, out_dtype=wide)


class Linear(nn.Linear):
    """``nn.Linear``, by :func:`linear`."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


class RowLinear(nn.Linear):
    """``nn.Linear`` of [N, C]."""

    def forward(self, x: Tensor, *, gelu: bool = False) -> Tensor:
        """``gelu``: with ``F.gelu`` behind it."""
        if not x.is_cuda or torch.compiler.is_compiling() or self.bias is None:
            return row_linear(x, self.weight, self.bias, gelu=gelu)
        x = x.to(product_dtype(x))
        out = _RowLinear.apply(x, self.weight, self.bias, *rounded_weights(self, x.dtype))
        return F.gelu(out) if gelu else out

    def some(self, x: Tensor, outputs: Sequence[tuple[int, int]]) -> Tensor:
        """The channels in ``outputs``, (first, one behind the last) of each run; the others are not computed."""
        x = x.to(product_dtype(x))
        return row_linear(x, *self._some_weights(outputs, x.dtype))

    def _some_weights(self, outputs: Sequence[tuple[int, int]], dtype: torch.dtype) -> Sequence[Tensor]:
        """Weight and bias of ``outputs``; without gradients they are kept until a weight changes."""
        tensors = self.weight, self.bias
        passing = torch.is_grad_enabled() or torch.compiler.is_compiling() or self.weight.is_inference()
        if passing or (self.weight.is_cuda and torch.cuda.is_current_stream_capturing()):
            return [torch.cat([t[a:b] for a, b in outputs]).to(dtype) for t in tensors]
        key = (dtype, *outputs, *(key for t in tensors for key in (t.data_ptr(), t._version)))
        known, some = self.__dict__.get("_some", (None, ()))
        if known != key:
            with torch.inference_mode(False), torch.no_grad():
                some = [torch.cat([t[a:b] for a, b in outputs]).to(dtype) for t in tensors]
            self.__dict__["_some"] = key, some
        return some


def rounded_linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """As :class:`RowLinear`, of weights that are made anew at each call."""
    if not x.is_cuda or torch.compiler.is_compiling():
        return row_linear(x, weight, bias)
    x = x.to(product_dtype(x))
    return _RowLinear.apply(x, weight, bias, *(t.detach().to(x.dtype) for t in (weight, bias)))


class _RowLinear(torch.autograd.Function):
    """On a GPU torch would sum the gradients of biases slowly, and those of weights in 16 bits."""

    @staticmethod
    def forward(ctx, x, weight, bias, rounded_weight, rounded_bias):
        ctx.save_for_backward(x, weight)  # the weight is saved for torch to notice if it changes
        ctx.rounded_weight = rounded_weight
        return row_linear(x, rounded_weight, rounded_bias)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        x, _ = ctx.saved_tensors
        grad = grad.contiguous()
        with Streams(grad) as streams:
            weight = streams.run(linear_grad_weight, grad, x)
            bias = streams.run(torch.ops.gsim3d.linear_grad_bias, grad)
            grad_x = grad @ ctx.rounded_weight
        return grad_x, weight, bias, None, None


def product_dtype(x: Tensor) -> torch.dtype:
    """The dtype in which products of ``x`` are formed: that of ``torch.autocast`` on a GPU, else its own."""
    follows = x.is_cuda and x.dtype != torch.float64 and torch.is_autocast_enabled("cuda")
    return torch.get_autocast_dtype("cuda") if follows else x.dtype


def rounded_weights(module: nn.Module, dtype: torch.dtype) -> tuple[Tensor | None, ...]:
    """``module.weight`` and ``module.bias`` in ``dtype``, without gradients.

    The copies are kept and made again, in the same memory, once a weight has changed: a simulation rounds its weights
    once. Changes are noticed as autograd notices them, so not those made through ``weight.data``.
    """
    if module.weight.dtype == dtype:
        return module.weight, module.bias
    ready = _ready.get().get(id(module))
    weight, *bias = ready or _rounded([module], dtype)[0]
    return weight, bias[0] if bias else None


def round_weights(modules: Sequence[nn.Module], dtype: torch.dtype) -> dict[int, Sequence[Tensor]]:
    """The :func:`rounded_weights` of ``modules``, made in a few launches, not two a layer."""
    modules = [module for module in modules if module.weight.dtype != dtype]
    return dict(zip(map(id, modules), _rounded(modules, dtype), strict=True))


@contextlib.contextmanager
def use_rounded(rounded: dict[int, Sequence[Tensor]]):
    """A context in which :func:`rounded_weights` returns what :func:`round_weights` has made."""
    token = _ready.set(rounded)
    try:
        yield
    finally:
        _ready.reset(token)


_ready: contextvars.ContextVar[dict[int, Sequence[Tensor]]] = contextvars.ContextVar("ready", default={})


@torch.inference_mode(False)
@torch.no_grad()
def _rounded(modules: Sequence[nn.Module], dtype: torch.dtype) -> list[Sequence[Tensor]]:
    """Weights and biases of ``modules`` in ``dtype``; all that is not known is rounded by one operation."""
    results, sources, targets = [], [], []
    for module in modules:
        tensors = [t for t in (module.weight, module.bias) if t is not None]
        if module.weight.is_cuda and torch.cuda.is_current_stream_capturing():
            copies = [torch.empty_like(t, dtype=dtype) for t in tensors]  # part of the graph: made at each replay
            sources, targets = sources + tensors, targets + copies
        else:
            key = (dtype, *(key for t in tensors for key in (t.data_ptr(), t._version)))
            known, copies = module.__dict__.get("_rounded", (None, ()))
            if known != key:
                if known is None or known[0] != dtype or copies[0].device != module.weight.device:
                    copies = [torch.empty_like(t, dtype=dtype) for t in tensors]
                sources, targets = sources + tensors, targets + list(copies)
                module.__dict__["_rounded"] = key, copies
        results.append(copies)
    if sources:
        torch._foreach_copy_(targets, sources)
    return results


class RowLayerNorm(nn.LayerNorm):
    """``nn.LayerNorm`` of [N, C], and the residual sum behind it; see :func:`gsim3d.ops.row_norm`."""

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        return row_norm(x, self.weight, self.bias, residual, eps=self.eps, check=False)

    def activated(self, x: Tensor, n_data: int | None = None) -> Tensor:
        return F.gelu(self(x))


class RowBatchNorm(nn.Module):
    """Normalises each channel by statistics over rows; running statistics in evaluation.

    Differs from ``nn.BatchNorm1d`` in three ways: one row or none is fine (running statistics are then kept),
    statistics are float32 or wider; processes combine theirs in the order of their ranks: a run repeats bit by bit.
    """

    EPS = 1e-3
    MOMENTUM = 0.01

    def __init__(self, channels: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        mean, scale = self._mean_and_scale(x)
        return (x - mean) * scale + self.bias

    def activated(self, x: Tensor, n_data: int | None = None) -> Tensor:
        """``F.gelu(self(x))``, on a GPU in as few passes over the rows as can be.

        n_data: statistics are those of the first ``n_data`` rows; None: of all.
        """
        is_padded = self.training and n_data is not None and n_data < x.shape[0]
        if not (x.is_cuda or is_padded) or torch.compiler.is_compiling():
            return F.gelu(self(x))
        if self.training:
            return self.activated_in_training(x, n_data)
        return norm_gelu(x, *self._mean_and_scale(x), self.bias, check=False)

    def activated_in_training(self, x: Tensor, n_data: int | None = None) -> Tensor:
        """As :meth:`activated`, with one node of autograd; once differentiable. Gradients of other rows must be 0."""
        with torch.no_grad():
            mean, var, n_rows = _statistics_at_once(x[:n_data])
            self._follow(mean, var, n_rows)
        return _BatchNormGelu.apply(x, self.weight, self.bias, mean, torch.rsqrt(var + self.EPS), n_rows, n_data)

    def _mean_and_scale(self, x: Tensor) -> tuple[Tensor, Tensor]:
        if not self.training:
            return self.running_mean, self.weight * torch.rsqrt(self.running_var + self.EPS)
        mean, var, n_rows = _statistics(widened(x))
        with torch.no_grad():
            self._follow(mean, var, n_rows)
        return mean, self.weight * torch.rsqrt(var + self.EPS)

    def _follow(self, mean: Tensor, var: Tensor, n_rows: Tensor | int) -> None:
        """Moves the running statistics towards those of ``n_rows`` rows."""
        if isinstance(n_rows, int):
            rate, unbiased = self.MOMENTUM * (n_rows > 1), var * (n_rows / max(n_rows - 1, 1))
        else:
            rate = self.MOMENTUM * (n_rows > 1).to(self.running_var)
            unbiased = var * n_rows / (n_rows - 1).clamp(min=1)
        self.running_mean.lerp_(mean.to(self.running_mean), rate)
        self.running_var.lerp_(unbiased.to(self.running_var), rate)


class _BatchNormGelu(torch.autograd.Function):
    """Normalised by statistics of all rows, scaled, shifted, activated; torch would keep and add five such tensors."""

    @staticmethod
    def forward(ctx, x, weight, bias, mean, rsqrt, n_rows, n_data):
        scale = weight * rsqrt
        ctx.save_for_backward(x, bias, mean, rsqrt, scale)
        ctx.n_rows, ctx.n_data = n_rows, n_data
        return norm_gelu(x, mean, scale, bias, check=False)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        x, bias, mean, rsqrt, scale = ctx.saved_tensors
        grad_x, grad_scale, grad_bias = torch.ops.gsim3d.norm_gelu_backward(grad, x, mean, scale, bias)
        sums = torch.stack([grad_scale, grad_bias])
        if _shares_rows():
            sums = sum(_gathered(sums))
        # What changes because mean and deviation change with x.
        by_scale, by_bias = (sums * (-scale / ctx.n_rows)).unbind()
        slope = by_scale * rsqrt.square()
        correction = torch.addcmul(by_bias - mean * slope, x[: ctx.n_data], slope)
        grad_x[: ctx.n_data].add_(correction)
        return grad_x, grad_scale * rsqrt, grad_bias, None, None, None, None


def _statistics(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and biased variance of each column over the rows of all processes, and the number of rows."""
    n_rows = x.new_full((), x.shape[0])
    mean = x.sum(0) / n_rows.clamp(min=1)
    spread = (x - mean).square().sum(0)
    if _shares_rows():
        mine = torch.cat([n_rows[None], mean, spread])
        n_rows, mean, spread = _combine(_OfAllProcesses.apply(mine), x.shape[1])
    return mean, spread / n_rows.clamp(min=1), n_rows


def _statistics_at_once(x: Tensor) -> tuple[Tensor, Tensor, Tensor | int]:
    """As :func:`_statistics`, without gradients, on a GPU in one pass; at least one row is counted."""
    n_rows = x.shape[0]
    if n_rows == 0:
        mean, var = torch.zeros(2, x.shape[1], dtype=torch.promote_types(x.dtype, torch.float32), device=x.device)
    elif x.is_cuda:
        mean, var = torch.batch_norm_update_stats(x.contiguous(), None, None, 0.0)
    else:
        var, mean = torch.var_mean(widened(x), 0, correction=0)
    if not _shares_rows():
        return mean, var, max(n_rows, 1)
    parts = _gathered(torch.cat([mean.new_full((1,), n_rows), mean, var * n_rows]))
    n_rows, mean, spread = _combine(tuple(parts), x.shape[1])
    n_rows = n_rows.clamp(min=1)
    return mean, spread / n_rows, n_rows


def _shares_rows() -> bool:
    """Whether other processes have rows of the same batch."""
    return dist.is_available() and dist.is_initialized()


def _gathered(mine: Tensor) -> list[Tensor]:
    """``mine`` of every process, in the order of their ranks."""
    parts = [torch.empty_like(mine) for _ in range(dist.get_world_size())]
    dist.all_gather(parts, mine)
    return parts


class _OfAllProcesses(torch.autograd.Function):
    """A tensor of every process, in the order of their ranks, to each of them."""

    @staticmethod
    def forward(ctx, mine):
        return tuple(_gathered(mine))

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads):
        total = torch.stack(grads)
        dist.all_reduce(total)
        return total[dist.get_rank()]


def _combine(parts: tuple[Tensor, ...], n_channels: int) -> tuple[Tensor, Tensor, Tensor]:
    """Row counts, means and sums of squared deviations of several processes as one, added in the order given."""
    counts, means, spreads = zip(*(part.split([1, n_channels, n_channels]) for part in parts), strict=True)
    n_rows = sum(counts).clamp(min=1)
    mean = sum(count * mean for count, mean in zip(counts, means, strict=True)) / n_rows
    between = sum(count * (part - mean).square() for count, part in zip(counts, means, strict=True))
    return sum(counts)[0], mean, sum(spreads) + between


def widened(x: Tensor) -> Tensor:
    """What 16-bit layers computed, as float32: positions, depths and what is added up over steps are never 16-bit."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def make_norm(kind: str, channels: int) -> nn.Module:
    """Of the ``kind`` "layer" or "batch"."""
    return RowLayerNorm(channels) if kind == "layer" else RowBatchNorm(channels)


@contextlib.contextmanager
def tf32_only_if_asked():
    """A context in which a GPU's float32 convolutions use TF32 only if matrix products may: how it rounds depends on
    the algorithm, which cuDNN chooses by the number of images: a scene would differ from itself in a larger batch."""
    products, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    unasked = cudnn.conv.fp32_precision == "tf32" and products.fp32_precision != "tf32"
    if unasked:
        cudnn.allow_tf32 = False
    try:
        yield
    finally:
        if unasked:
            cudnn.allow_tf32 = True


def exact_convolutions():
    """A context in which a GPU's dense convolutions are float32 proper (no TF32) and repeat bit by bit."""
    return torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
