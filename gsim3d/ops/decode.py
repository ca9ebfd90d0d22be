"""What a network says about the shape and colour of Gaussians -> rotations, scales and colours in the world."""

from torch import Tensor

from gsim3d.ops._arguments import check_numbers, check_real, check_tensors, check_whole
from gsim3d.ops._register import call, fakes, is_narrow, register_autocast, register_gradients, save_inputs

LARGEST_READING = 1e3  # cubes of readings times the largest ``raw`` stay finite; those of the table are below 2


def decode_gaussians(
    raw: Tensor, readings: Tensor, *, degree: int, scale_min: float, scale_max: float, check: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation, scale and colour of Gaussians whose colours are predicted in their own frame.

    The rotation is normalised, the identity where it is shorter than 1e-6; scales are
    ``scale_min + (scale_max - scale_min) * sigmoid``; harmonics of degree l > 0 are damped by ``0.1 / 4^l`` and turn
    with the rotation.

    Args:
        raw: [N, 3 K + 7], K = 0, 1, 4, 9 or 16: harmonics (3, K), rotation (x, y, z, w), scales; float32 or float64, on
            CUDA also float16 and bfloat16 (computed in float32).
        readings: [128], :func:`gsim3d.math.spherical_harmonics.readings`, float32; float64 with float64 rows.
        degree: of the harmonics that are returned, at most that of ``raw``; -1: none.
        scale_min, scale_max: metres, 0 to 1e15.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        quats [N, 4] (w, x, y, z), scales [N, 3], sh [N, (degree + 1)^2, 3]; float32, float64 with float64 rows.
    Gradients:
        ``raw``, once.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150; readings: 1e3); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.

    Example:
        >>> raw = torch.tensor([[0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]])
        >>> decode_gaussians(raw, torch.zeros(128), degree=0, scale_min=0.0, scale_max=1.0)[:2]
        (tensor([[1., 0., 0., 0.]]), tensor([[0.5000, 0.5000, 0.5000]]))
    """
    if check:
        check_tensors("decode_gaussians", raw=raw, readings=readings)
        check_whole("decode_gaussians", degree=degree)
        check_real("decode_gaussians", scale_min=scale_min, scale_max=scale_max)
        check_numbers("decode_gaussians", raw=raw)
        check_numbers("decode_gaussians", readings=readings, largest_of=LARGEST_READING)
    return call("decode_gaussians", raw, readings, degree, scale_min, scale_max)


def _decoded(raw, readings, degree, scale_min, scale_max):
    return tuple(readings.new_empty(raw.shape[0], *sizes) for sizes in ((4,), (3,), ((degree + 1) ** 2, 3)))


def _backward(ctx, *grads):
    grad_raw = call("decode_gaussians_backward", *grads, *ctx.saved_tensors, *ctx.others)
    return grad_raw, None, None, None, None


fakes(decode_gaussians=_decoded, decode_gaussians_backward=lambda *inputs: inputs[3].new_empty(inputs[3].shape))
_gradient_ops = ["decode_gaussians_backward"]
register_gradients("decode_gaussians", _backward, save_inputs, gradient_ops=_gradient_ops, without=["readings"])


def _autocast(device, arguments):
    raw, *others = arguments
    return raw.float() if device == "cpu" and is_narrow(raw) else raw, *others


register_autocast("decode_gaussians", _autocast)
