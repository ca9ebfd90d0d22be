"""Blending of Gaussians that are projected already: the second half of the rasterizer, with any channels."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d.errors import check_one_of
from gsim3d.ops._arguments import (
    check_floating,
    check_numbers,
    check_splits,
    check_tensors,
    check_whole,
    constant,
    offsets,
    within_memory,
)
from gsim3d.ops._register import call, fakes, register_autocast, register_gradients
from gsim3d.ops.raster import CUTOFFS, LARGEST, Rendering, empty_images, sizes_of_state, state_bytes

OP = "rasterize_projected"


def rasterize_projected(
    means2d: Tensor,
    conics: Tensor,
    depths: Tensor,
    opacities: Tensor,
    colors: Tensor,
    *,
    width: int,
    height: int,
    cu_pairs: Tensor | None = None,
    background: Tensor | None = None,
    absolute: Tensor | None = None,
    cutoff: str = "exact",
    check: bool = True,
) -> Rendering:
    """Renders what :func:`project_gaussians` returns, as :func:`rasterize_gaussians` does in one call.

    A row whose conic is not positive definite, or whose depth is not positive, is left out.

    Args:
        means2d: [P, 2] pixels; float32 or float64.
        conics: [P, 3] px^-2, entries (xx, xy, yy) of the inverse covariance.
        depths: [P] metres.
        opacities: [P] in [0, 1].
        colors: [P, D], any D; float16 and bfloat16 are blended in the dtype of ``means2d``.
        width, height: pixels.
        cu_pairs: int64 [I + 1], rows of image i are cu_pairs[i] .. cu_pairs[i + 1]; default one image.
        background: [D] or [I, D]; default black.
        absolute: [P, 2], zeros that ask for a gradient; theirs is the sum over pixels of the absolute values of what
            each adds to the gradient of ``means2d`` (AbsGS).
        cutoff: "exact" or "smooth", as of :func:`rasterize_gaussians`.
        check: as of :func:`project_gaussians`.
    Returns:
        Rendering with ``color`` [I, H, W, D] and without features, dtype of ``means2d``.
    Gradients:
        means2d, conics, depths (of ``depth``), opacities, colors and background, once.
    Determinism:
        equal bits for any number of threads; on a GPU from run to run, and nothing waits for the device.
    Raises:
        NumericalError: numbers not finite or beyond 1e15, opacities outside [0, 1]; on a GPU such rows are left out.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source:
        Kerbl et al. 2023 (3D Gaussian splatting), Ye et al. 2024 (AbsGS).

    Example:
        >>> mean, conic, one = torch.tensor([[4.0, 4.0]]), torch.tensor([[0.5, 0.0, 0.5]]), torch.ones(1)
        >>> image = rasterize_projected(mean, conic, one, 0.5 * one, torch.ones(1, 5), width=8, height=8)
        >>> image.color.shape, round(float(image.alpha[0, 4, 4]), 3)
        (torch.Size([1, 8, 8, 5]), 0.441)
    """
    if check:
        rows = {"means2d": means2d, "conics": conics, "depths": depths, "opacities": opacities, "colors": colors}
        optional = {"cu_pairs": cu_pairs, "background": background, "absolute": absolute}
        _check(rows, {name: value for name, value in optional.items() if value is not None}, cutoff)
    check_whole(OP, width=width, height=height)
    if not (0 < width < 2**16 and 0 < height < 2**16):
        raise ValueError(f"{OP}: width and height must be in [1, 65535]; got {width} and {height}")
    device = means2d.device
    if cu_pairs is None:
        cu_pairs = constant(offsets, 1, means2d.shape[0], device=device)
    n_images, n_channels = cu_pairs.shape[0] - 1, colors.shape[1]
    if background is None:
        background = constant(torch.zeros, n_images, n_channels, device=device, dtype=means2d.dtype)
    else:
        background = background.expand(n_images, n_channels).to(means2d.dtype)
    colors = colors.to(means2d.dtype)
    features = colors[:, 3:] if n_channels > 3 else colors.new_empty(colors.shape[0], 0)
    args = (
        *(means2d, conics, depths, opacities, _first_three(colors), features, _first_three(background), absolute),
        *(constant(torch.arange, n_images, device=device), cu_pairs, width, height, CUTOFFS[cutoff]),
        *sizes_of_state(means2d, n_images, n_images, width, height),
    )
    color, alpha, depth, features, *_ = within_memory(OP, f"width={width}, height={height}", call, OP, *args)
    if n_channels > 3:
        behind = (1 - alpha)[..., None] * background[:, None, None, 3:]
        color = torch.cat([color, features + behind], -1)
    return Rendering(color[..., :n_channels] if n_channels < 3 else color, alpha, depth, None)


def _first_three(channels: Tensor) -> Tensor:
    """[N, 3] of [N, D], zeros where there are fewer; copies nothing of three."""
    d = channels.shape[1]
    return channels if d == 3 else channels[:, :3] if d > 3 else F.pad(channels, (0, 3 - d))


def _check(rows: dict[str, Tensor], optional: dict[str, Tensor], cutoff: str) -> None:
    check_tensors(OP, **rows, **optional)
    check_floating(OP, {"colors": rows["colors"], "background": optional.get("background")}, means2d=rows["means2d"])
    check_one_of(f"{OP}: cutoff", cutoff, ("exact", "smooth"))
    n = rows["means2d"].shape[0] if rows["means2d"].dim() else 0
    shapes = {"means2d": (n, 2), "conics": (n, 3), "depths": (n,), "opacities": (n,), "absolute": (n, 2)}
    for name, value in (rows | optional).items():
        if name in shapes and value.shape != shapes[name]:
            raise ValueError(f"{OP}: {name} must be {list(shapes[name])}; got {list(value.shape)}")
    colors, cu_pairs, background = rows["colors"], optional.get("cu_pairs"), optional.get("background")
    if colors.dim() != 2 or colors.shape[0] != n or not colors.is_floating_point():
        raise ValueError(f"{OP}: colors must be [P={n}, D] of floats; got {colors.dtype} {list(colors.shape)}")
    check_splits(OP, n, cu_pairs=cu_pairs)
    n_images, d = 1 if cu_pairs is None else cu_pairs.shape[0] - 1, colors.shape[1]
    if background is not None and background.shape not in ((d,), (n_images, d)):
        raise ValueError(f"{OP}: background must be [D={d}] or [I={n_images}, D]; got {list(background.shape)}")
    check_numbers(OP, largest_of=LARGEST, **rows, background=background)
    check_numbers(OP, largest_of=1.0, negative=False, opacities=rows["opacities"])


def _images(means2d, conics, depths, opacities, color, features, background, absolute, image_cloud, cu_rows, *rest):
    (width, height, _, *sizes), n_images = rest, background.shape[0]
    state = state_bytes(means2d, n_images, n_images, width, height, sizes[0], sizes[2])
    return tuple(empty_images(means2d, n_images, width, height, features.shape[1], state))


def _gradients(grad_color, grad_alpha, grad_depth, grad_features, transmittance, last, state, *inputs):
    *inputs, of_background, absolute = inputs
    shapes = [x.shape for x in inputs[:7]]
    shapes[5] = (shapes[5][0], shapes[5][1] + (2 if absolute else 0))
    shapes[6] = (shapes[6][0] if of_background else 0, 3)
    return tuple(inputs[0].new_empty(shape) for shape in shapes)


fakes(rasterize_projected=_images, rasterize_projected_backward=_gradients)


def _setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[4:])
    ctx.save_for_backward(*output[4:], *inputs[:7], *inputs[8:10])
    ctx.options = inputs[10:]


def _backward(ctx, *grads):
    saved, (of_background, with_absolute) = ctx.saved_tensors, ctx.needs_input_grad[6:8]
    options = *ctx.options, of_background, with_absolute
    *rows, features, background = call("rasterize_projected_backward", *grads[:4], *saved, *options)
    features, absolute = features.tensor_split([saved[8].shape[1]], 1) if with_absolute else (features, None)
    return (*rows, features, background if of_background else None, absolute, *[None] * 8)


register_gradients("rasterize_projected", _backward, _setup, gradient_ops=["rasterize_projected_backward"])
register_autocast("rasterize_projected", "float32")
