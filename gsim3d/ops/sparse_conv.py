"""Submanifold convolution over voxels: features of occupied neighbour cells, outputs at the same rows."""

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.ops._arguments import as_given, check_numbers, check_tensors, check_whole, widened, widened_on_cpu
from gsim3d.ops._register import call, fakes, one_by_one, register_autocast, register_gradients
from gsim3d.ops.curve import KernelMap, Voxels


def sparse_conv(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    voxels: Voxels,
    kernel_map: KernelMap,
    *,
    duplicates: str = "mean",
    check: bool = True,
) -> Tensor:
    """Convolution over the occupied voxels, with one output a row.

    ``out[p] = bias + W_centre x[p] + sum over taps t of W_t xbar[u]``, where ``u`` is the voxel at offset
    ``t - K // 2`` cells from the voxel of row ``p`` (nothing where it is empty) and ``xbar[u]`` is one value a voxel:
    the mean of its rows, or its lowest row. Rows that share a voxel keep their own centre term.

    Args:
        x: features [N, C_in], floating point; 16-bit ones are summed in float32. Under ``torch.autocast`` the CPU
            computes in float32, CUDA in autocast's dtype. N of a map with stride: inputs; inverted: outputs.
        weight: [C_out, Kx, Ky, Kz, C_in]; axes 1 to 3 walk x, y, z.
        bias: [C_out] or None.
        voxels: which rows share a voxel (``Stage.voxels`` of :func:`gsim3d.ops.build_pyramid`, or of
            :meth:`KernelMap.from_indices`). Where there are more voxels than rows, the last ones are empty.
        kernel_map: pairs of neighbouring voxels for K (``Stage.kernel_maps[K]``); those behind the last offset take no
            part.
        duplicates: "mean", or "first" for the lowest row, which depends on the order of the rows.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [N, C_out], dtype of ``x``; of a map with stride [M, C_out], its outputs; inverted, its inputs.
    Gradients:
        ``x``, ``weight``, ``bias``, to any order and in forward mode.
    Determinism:
        the same bits for any number of threads, and in every run on CUDA. On the CPU an output is one chain of
        sums in the order of taps.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: shapes, dtypes, ``voxels`` or ``kernel_map`` are malformed; the message names it.
            CUDA does not look into the index lists: pairs and rows out of range take no part, rows not listed are 0.
    Source:
        Graham et al., "3D semantic segmentation with submanifold sparse convolutional networks", 2018.

    Example, two rows in one voxel and no neighbours:
        >>> from gsim3d.ops import KernelMap, Voxels
        >>> none = torch.zeros(0, dtype=torch.int64)
        >>> voxels = Voxels(torch.tensor([0, 0]), torch.tensor([0, 1]), torch.tensor([0, 2]))
        >>> kernel_map = KernelMap(3, none, none, torch.zeros(28, dtype=torch.int64))
        >>> sparse_conv(torch.tensor([[1.0], [2.0]]), torch.ones(1, 3, 3, 3, 1), None, voxels, kernel_map)
        tensor([[1.],
                [2.]])
    """
    op = "sparse_conv"
    if duplicates not in ("mean", "first"):
        raise ValueError(f'sparse_conv: duplicates must be "mean" or "first"; got {duplicates!r}')
    if check:
        floats = {"x": x, "weight": weight} | ({} if bias is None else {"bias": bias})
        lists = {f"voxels.{name}": getattr(voxels, name, voxels) for name in ("row_voxel", "rows", "cu_rows")}
        taps = {f"kernel_map.{key}": getattr(kernel_map, key, kernel_map) for key in ("tap_in", "tap_out", "cu_taps")}
        check_tensors(op, **floats, **lists, **taps)
        check_whole(op, kernel_size=kernel_map.kernel_size)
        check_numbers(op, **floats)
    own, wanted = tuple(weight.shape[1:4]), kernel_map.shape or (kernel_map.kernel_size,) * 3
    if weight.dim() == 5 and own != wanted:
        raise ValueError(f"sparse_conv: kernel_map must have the weight's kernel size {own}; got {wanted}")
    given = x
    x, weight, bias = widened_on_cpu(x, weight, bias)
    if kernel_map.outputs is not None:
        return as_given(_strided(x, weight, bias, voxels, kernel_map, duplicates == "first"), given)
    if kernel_map.shape is not None and weight.dim() == 5:
        weight = _in_the_middle(weight, kernel_map.kernel_size)
    return as_given(_convolved(x, weight, bias, voxels, kernel_map, duplicates == "first"), given)


def _strided(x, weight, bias, voxels: Voxels, kernel_map: KernelMap, first: bool) -> Tensor:
    """Inputs and outputs are rows of one matrix, of which one part is 0 and the other is left out.

    In float32 or wider: 16-bit kernels on CUDA want pairs that have mirror images.
    """
    n_outputs = kernel_map.outputs.shape[0]
    n_inputs = voxels.row_voxel.shape[0] - n_outputs
    before, behind = (n_inputs, 0) if kernel_map.inverted else (0, n_outputs)
    expected = n_outputs if kernel_map.inverted else n_inputs
    if x.dim() != 2 or x.shape[0] != expected:
        raise ValueError(f"sparse_conv: x must be [{expected}, C_in], of the rows of kernel_map; got {list(x.shape)}")
    if weight.dim() != 5:
        raise ValueError(f"sparse_conv: weight must be [C_out, Kx, Ky, Kz, C_in]; got {list(weight.shape)}")
    with torch.autocast(x.device.type, enabled=False):
        x, weight, bias = (t if t is None else widened(t) for t in (x, weight, bias))
        x, weight = F.pad(x, (0, 0, before, behind)), _around_the_centre(weight, kernel_map.kernel_size)
        out = _convolved(x, weight, bias, voxels, kernel_map, first)
    return out[:n_inputs] if kernel_map.inverted else out[n_inputs:]


def _in_the_middle(weight: Tensor, cube: int) -> Tensor:
    """A kernel of odd edges inside a cube."""
    margins = [(cube - k) // 2 for k in weight.shape[3:0:-1]]
    return F.pad(weight, (0, 0, *(m for m in margins for _ in range(2))))


def _around_the_centre(weight: Tensor, cube: int) -> Tensor:
    """The taps of a kernel as the first ones of a cube but for its centre, which is 0."""
    taps, centre = weight.flatten(1, 3), cube**3 // 2
    first, last = taps[:, :centre], taps[:, centre:]
    first = F.pad(first, (0, 0, 0, centre + 1 - first.shape[1]))
    last = F.pad(last, (0, 0, 0, cube**3 - centre - 1 - last.shape[1]))
    return torch.cat([first, last], 1).unflatten(1, (cube, cube, cube))


def _convolved(x, weight, bias, voxels: Voxels, kernel_map: KernelMap, first: bool) -> Tensor:
    geometry = voxels.row_voxel, voxels.rows, voxels.cu_rows, kernel_map.tap_in, kernel_map.tap_out, kernel_map.cu_taps
    return call("sparse_conv", x, weight, bias, *geometry, first, kernel_map.plan)


def _plan(row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out, cu_taps, kernel_size):
    taps, groups = kernel_size**3, (row_voxel.shape[0] + 255) // 256 * 4
    return row_voxel.new_empty(groups * (64 * (taps + 1) + (taps + 31) // 32), dtype=torch.int32)


def _weight_gradients(grad, x, k, row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out, cu_taps, first, rounded=False):
    c_out, dtype = grad.shape[1], grad.dtype if rounded else torch.promote_types(grad.dtype, torch.float32)
    return grad.new_empty(c_out, k, k, k, x.shape[1], dtype=dtype), grad.new_empty(c_out, dtype=dtype)


fakes(
    sparse_conv=lambda x, weight, *_: x.new_empty(x.shape[0], weight.shape[0]),
    sparse_conv_grad_input=lambda grad, weight, *_: grad.new_empty(grad.shape[0], weight.shape[4]),
    sparse_conv_grad_weight=_weight_gradients,
    sparse_conv_plan=_plan,
)


def _setup(ctx, inputs, output):
    x, weight, bias, *geometry, first, plan = inputs
    ctx.save_for_backward(x, weight, plan, *geometry)
    ctx.first = first
    ctx.has_bias = bias is not None


def _backward(ctx, grad):
    x, weight, plan, *geometry = ctx.saved_tensors
    needs_x, needs_weight, needs_bias = ctx.needs_input_grad[:3]
    grad_x = grad_weight = grad_bias = None
    if needs_x:
        grad_x = call("sparse_conv_grad_input", grad, weight, *geometry, ctx.first, plan)
    if needs_weight or needs_bias:
        # Autograd wants the dtype of the parameters: rounded where they are written, without a pass over them.
        grad_weight, grad_bias = call("sparse_conv_grad_weight", grad, x, weight.shape[1], *geometry, ctx.first, True)
    return grad_x, grad_weight, grad_bias if ctx.has_bias else None, *[None] * 8


# The convolution is linear in features and in weights, so its gradients are, and their gradients are convolutions.


def _input_setup(ctx, inputs, output):
    grad, weight, *geometry, ctx.first, plan = inputs
    ctx.save_for_backward(grad, weight, plan, *geometry)


def _input_backward(ctx, by_x):
    grad, weight, plan, *geometry = ctx.saved_tensors
    by_grad = by_weight = None
    if ctx.needs_input_grad[0]:
        by_grad = call("sparse_conv", by_x, weight, None, *geometry, ctx.first, plan)
    if ctx.needs_input_grad[1]:
        by_weight = call("sparse_conv_grad_weight", grad, by_x, weight.shape[1], *geometry, ctx.first, True)[0]
    return by_grad, by_weight, *[None] * 8


def _weight_setup(ctx, inputs, output):
    grad, x, _, *geometry, ctx.first, _ = inputs
    ctx.save_for_backward(grad, x, *geometry)


def _weight_backward(ctx, by_weight, by_bias):
    grad, x, *geometry = ctx.saved_tensors
    by_weight, by_bias = by_weight.to(x.dtype), by_bias.to(x.dtype)
    by_grad = by_x = None
    if ctx.needs_input_grad[0]:
        by_grad = call("sparse_conv", x, by_weight, by_bias, *geometry, ctx.first, None)
    if ctx.needs_input_grad[1]:
        by_x = call("sparse_conv_grad_input", grad, by_weight, *geometry, ctx.first, None)
    return by_grad, by_x, *[None] * 9


def _jvp(inputs, tangents, outputs):
    terms = [*_along("sparse_conv", (*inputs[:2], None, *inputs[3:]), tangents), tangents[2]]
    return sum((x for x in terms if x is not None), torch.zeros_like(outputs[0]))


def _along(op, inputs, tangents):
    """What an op that is linear in each of its first two inputs adds along the tangent of either, or None."""
    a, b, *rest = inputs
    directions = ((tangents[0], b), (a, tangents[1]))
    return [None if x is None or y is None else call(op, x, y, *rest) for x, y in directions]


def _input_jvp(inputs, tangents, outputs):
    return sum(x for x in _along(_of_input, inputs, tangents) if x is not None)


def _weight_jvp(inputs, tangents, outputs):
    by_grad, by_x = _along(_of_weight, inputs, tangents)
    zeros = [torch.zeros_like(x) for x in outputs]
    (weight, bias), (more, _) = by_grad or zeros, by_x or zeros
    return weight + more, bias


def _batched(op: str, n_floats: int):
    """Clouds of a batch beside each other where they share weights and geometry; else one by one."""

    def batched(size, inputs, is_batched):
        if not is_batched[0] or any(is_batched[1:]):
            return one_by_one(op)(size, inputs, is_batched)
        x, *weights = inputs[:n_floats]
        geometry = _beside(size, *inputs[n_floats:-2])
        return call(op, x.flatten(0, 1), *weights, *geometry, inputs[-2], None).unflatten(0, (size, -1))

    return batched


def _beside(size, row_voxel, voxel_rows, cu_voxel_rows, tap_in, tap_out, cu_taps):
    """The geometry of ``size`` copies; pairs stay sorted by tap."""
    n, n_voxels = row_voxel.shape[0], cu_voxel_rows.shape[0] - 1
    entry = torch.arange(size, device=tap_in.device)[:, None]
    tap = torch.searchsorted(cu_taps[1:], torch.arange(tap_in.shape[0], device=tap_in.device), right=True)
    order = torch.argsort(tap.expand(size, -1).flatten(), stable=True)
    cu_voxel_rows = torch.cat([(cu_voxel_rows[:-1] + n * entry).flatten(), size * cu_voxel_rows[-1:]])
    taps = ((tap + n_voxels * entry).flatten()[order] for tap in (tap_in, tap_out))
    voxels = (row_voxel + n_voxels * entry).flatten(), (voxel_rows + n * entry).flatten(), cu_voxel_rows
    return *voxels, *taps, size * cu_taps


_of_input, _of_weight = "sparse_conv_grad_input", "sparse_conv_grad_weight"
register_gradients("sparse_conv", _backward, _setup, jvp=_jvp, batched=_batched("sparse_conv", 3))
register_gradients(_of_input, _input_backward, _input_setup, jvp=_input_jvp, batched=_batched(_of_input, 2))
register_gradients(_of_weight, _weight_backward, _weight_setup, jvp=_weight_jvp, batched=one_by_one(_of_weight))
register_autocast("sparse_conv", "follow")
