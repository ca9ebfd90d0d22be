"""rasterize_projected against a dense float64 renderer."""

import pytest
import torch

from gsim3d.errors import GradientError, NumericalError
from gsim3d.ops import rasterize_projected
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads

DTYPES = {torch.float32: "float32", torch.float64: "float64"}
NAMES = ("means2d", "conics", "depths", "opacities", "colors", "background")
WIDTH, HEIGHT = 37, 29


def random_rows(n=60, images=2, channels=5, seed=0, dtype=torch.float64, device="cpu"):
    """means2d, conics, depths, opacities, colors, background, and cu_pairs."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    half = 2.5 * normal(n, 2, 2)
    inverse = torch.linalg.inv(half @ half.mT + 0.3 * torch.eye(2, dtype=torch.float64))
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    means2d = torch.tensor([WIDTH, HEIGHT]) * (0.5 + 0.4 * normal(n, 2))
    opacities = 0.05 + 0.9 * torch.rand(n, generator=g, dtype=torch.float64)
    rows = (means2d, conics, normal(n).exp(), opacities, normal(n, channels), normal(images, channels))
    cu_pairs = torch.tensor([0, *[n * (i + 1) // images - i % 2 for i in range(images - 1)], n])
    return [x.to(dtype).to(device) for x in rows], cu_pairs.to(device)


def oracle(rows, cu_pairs, cutoff="exact", pixel_means=None):
    """color [I, H, W, D], alpha, depth; ``pixel_means`` [P, H, W, 2] in place of the means, for each pixel its own."""
    means2d, conics, depths, opacities, colors, background = rows
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    centres = torch.stack([x, y], -1).double() + 0.5
    if pixel_means is None:
        pixel_means = means2d[:, None, None].expand(-1, HEIGHT, WIDTH, 2)
    images = []
    for i in range(len(cu_pairs) - 1):
        of_image = torch.arange(int(cu_pairs[i]), int(cu_pairs[i + 1]))
        light = torch.ones(HEIGHT, WIDTH, dtype=torch.float64)
        going = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        total = torch.zeros(HEIGHT, WIDTH, colors.shape[1] + 1, dtype=torch.float64)
        for n in of_image[torch.argsort(depths[of_image].detach(), stable=True)]:
            dx, dy = (centres - pixel_means[n]).unbind(-1)
            a, b, c = conics[n]
            alpha = (opacities[n] * torch.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)).clamp_max(0.99)
            if cutoff == "smooth":
                t = (alpha * 255 - 1).clamp(0, 1)
                alpha = alpha * (3 * t**2 - 2 * t**3)
            else:
                alpha = torch.where(alpha >= 1 / 255, alpha, 0)
            rest = light * (1 - alpha)
            going = going & (rest >= 1e-4)
            weight = torch.where(going, light * alpha, 0)
            total = total + weight[..., None] * torch.cat([colors[n], depths[n : n + 1]])
            light = torch.where(going, rest, light)
        images.append((total[..., :-1] + light[..., None] * background[i], 1 - light, total[..., -1]))
    return [torch.stack(part) for part in zip(*images)]


def render(rows, cu_pairs, **options):
    *rows, background = rows
    size = {"width": WIDTH, "height": HEIGHT}
    return rasterize_projected(*rows, **size, cu_pairs=cu_pairs, background=background, **options)[:3]


def mixed(images, seed=2):
    g = torch.Generator().manual_seed(seed)
    return sum((torch.randn(x.shape, generator=g, dtype=torch.float64).to(x) * x).sum() for x in images)


def leaves_of(rows):
    return [x.detach().clone().requires_grad_() for x in rows]


# ---- 1 forward, 2 backward -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("channels", [0, 1, 2, 3, 4, 33])
def test_forward_and_backward(device, channels, dtype):
    rows, cu_pairs = random_rows(channels=channels, seed=channels)
    expected_leaves = leaves_of(rows)
    expected = oracle(expected_leaves, cu_pairs)
    moved, cu_moved = random_rows(channels=channels, seed=channels, dtype=dtype, device=device)
    actual_leaves = leaves_of(moved)
    actual = render(actual_leaves, cu_moved)
    for a, e in zip(actual, expected, strict=True):
        assert a.dtype == dtype
        assert_close_relative_to_max(a, e, f"raster_{DTYPES[dtype]}")
    grads = torch.autograd.grad(mixed(actual), actual_leaves)
    for name, a, e in zip(NAMES, grads, torch.autograd.grad(mixed(expected), expected_leaves), strict=True):
        assert e.numel() == 0 or e.abs().max() > 0
        assert_close_relative_to_max(a, e, f"raster_grad_{DTYPES[dtype]}", name)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("channels", [3, 6])
def test_absolute_gradients(device, channels, dtype):
    # As if every pixel had means of its own.
    rows, cu_pairs = random_rows(n=20, channels=channels, seed=1)
    pixel_means = rows[0][:, None, None].repeat(1, HEIGHT, WIDTH, 1).requires_grad_()
    each = torch.autograd.grad(mixed(oracle(rows, cu_pairs, pixel_means=pixel_means)), pixel_means)[0]
    moved, cu_moved = random_rows(n=20, channels=channels, seed=1, dtype=dtype, device=device)
    leaves = leaves_of(moved)
    absolute = torch.zeros_like(leaves[0]).requires_grad_()
    grads = torch.autograd.grad(mixed(render(leaves, cu_moved, absolute=absolute)), [*leaves, absolute])
    assert_close_relative_to_max(grads[-1], each.abs().sum((1, 2)), f"raster_grad_{DTYPES[dtype]}")
    without = torch.autograd.grad(mixed(render(leaves, cu_moved)), leaves)
    for a, e in zip(grads, without, strict=False):
        assert_close_relative_to_max(a, e, f"raster_grad_{DTYPES[dtype]}")


# ---- 3 gradcheck ---------------------------------------------------------------------------------------------------


@pytest.mark.unsanitized("runs the kernels of test_forward_and_backward thousands of times")
def test_gradcheck(device):
    rows, cu_pairs = random_rows(n=6, channels=4, seed=3, device=device)
    leaves = leaves_of(rows)

    def mixtures(*leaves):
        images = render(leaves, cu_pairs, cutoff="smooth")
        return torch.stack([mixed(images, seed) for seed in range(5)])

    assert torch.autograd.gradcheck(mixtures, leaves, atol=1e-6, nondet_tol=0.0)


# ---- 4 CPU against CUDA --------------------------------------------------------------------------------------------


def test_same_bits_every_time_on_cuda(devices):
    rows, cu_pairs = random_rows(n=20_000, images=3, channels=5, dtype=torch.float32, device=devices[1])

    def run():
        leaves = leaves_of(rows)
        absolute = torch.zeros_like(leaves[0]).requires_grad_()
        images = render(leaves, cu_pairs, absolute=absolute)
        return (*images, *torch.autograd.grad(mixed(images), [*leaves, absolute]))

    for a, e in zip(run(), run(), strict=True):
        assert_same_bits(a, e)


@pytest.mark.parametrize("limits", [(1, 1, 4), (3, 10, 12)], ids=str)
def test_any_limits_give_the_same_result_on_cuda(devices, limits):
    """What exceeds the limits is done in further groups of images, down to parts of one image."""
    n = 800
    rows, cu_pairs = random_rows(n=n, images=3, channels=5, dtype=torch.float32, device=devices[1], seed=6)
    leaves = leaves_of(rows)
    absolute = torch.zeros_like(leaves[0]).requires_grad_()
    lists = (torch.arange(3, device=devices[1]), cu_pairs)

    def run(*limits):
        *first, colors, background = leaves
        args = (*first, colors[:, :3], colors[:, 3:], background[:, :3], absolute, *lists, WIDTH, HEIGHT, 0)
        out = torch.ops.gsim3d.rasterize_projected(*args, *(factor * n for factor in limits))[:4]
        return (*out, *torch.autograd.grad(mixed(out), [*leaves[:5], absolute]))

    for a, e in zip(run(*limits), run(6, 100, 400), strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float32")


# ---- 5 opcheck -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("absolute", [False, True])
def test_opcheck(device, absolute):
    rows, cu_pairs = random_rows(n=8, channels=5, device=device)
    *first, colors, background = leaves_of(rows)
    probe = torch.zeros_like(first[0]).requires_grad_() if absolute else None
    args = (*first, colors[:, :3], colors[:, 3:], background[:, :3], probe, torch.arange(2, device=device), cu_pairs)
    sizes = [factor * 8 if device.type == "cuda" else 0 for factor in (2, 4, 8)]
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.rasterize_projected, (*args, WIDTH, HEIGHT, 0, *sizes), test_utils=tests)


# ---- 6 torch.compile -----------------------------------------------------------------------------------------------


def test_compile_equals_eager(device):
    rows, cu_pairs = random_rows(n=20, channels=4, dtype=torch.float32, device=device)
    leaves = leaves_of(rows)

    def loss(*leaves):
        color, alpha, depth = render(leaves, cu_pairs)
        return (color**2).sum() + alpha.sum() + depth.mean()

    expected = loss(*leaves)
    value = torch.compile(loss, fullgraph=True)(*leaves)
    assert_close_relative_to_max(value, expected, 1e-5)
    for a, e in zip(torch.autograd.grad(value, leaves), torch.autograd.grad(expected, leaves), strict=True):
        assert_close_relative_to_max(a, e, 1e-5)


# ---- 7 edges -------------------------------------------------------------------------------------------------------


def test_same_bits_for_any_threads():
    rows, cu_pairs = random_rows(n=5000, channels=5, dtype=torch.float32)

    def run():
        leaves = leaves_of(rows)
        absolute = torch.zeros_like(leaves[0]).requires_grad_()
        images = render(leaves, cu_pairs, absolute=absolute)
        return (*images, *torch.autograd.grad(mixed(images), [*leaves, absolute]))

    assert_same_bits_for_any_threads(run)


def test_rows_that_are_no_gaussians_are_left_out(device):
    rows, cu_pairs = random_rows(device=device)
    expected = render([x[30:] if len(x) == 60 else x for x in rows], cu_pairs.new_tensor([0, 0, 30]))
    rows[1][:10] = 0  # what the projection writes for a pair that is not seen
    rows[1][10:20, 1] = 100  # not positive definite
    rows[2][20:30] = -1  # behind the camera
    leaves = leaves_of(rows)
    images = render(leaves, cu_pairs.new_tensor([0, 30, 60]))
    for a, e in zip(images, expected, strict=True):
        assert_same_bits(a.detach(), e)
    for grad in torch.autograd.grad(mixed(images), leaves[:5]):
        assert grad[:30].abs().max() == 0 and grad[30:].abs().max() > 0


def test_no_rows_show_the_background(device):
    rows, _ = random_rows(n=1, images=1, device=device)
    color, alpha, _ = render([*(x[:0] for x in rows[:5]), rows[5]], torch.tensor([0, 0], device=device))
    assert alpha.abs().max() == 0
    assert_same_bits(color, rows[5].expand(1, HEIGHT, WIDTH, -1).contiguous())


def test_one_image_is_the_default(device):
    (*rows, _), _ = random_rows(device=device)
    size, white = {"width": WIDTH, "height": HEIGHT}, torch.ones(1, 5, dtype=torch.float64, device=device)
    expected = rasterize_projected(*rows, **size, cu_pairs=torch.tensor([0, 60], device=device), background=white)
    for background in (white, white[0]):
        assert_same_bits(rasterize_projected(*rows, **size, background=background).color, expected.color)


def test_half_precision_colors(device):
    rows, cu_pairs = random_rows(dtype=torch.float32, device=device)
    rows[4] = rows[4].half()
    leaves = leaves_of(rows)
    color = render(leaves, cu_pairs)[0]
    color.sum().backward()
    assert color.dtype == torch.float32 and leaves[4].grad.dtype == torch.float16
    assert_same_bits(color, render([*rows[:4], rows[4].float(), rows[5]], cu_pairs)[0])


# ---- 8 errors ------------------------------------------------------------------------------------------------------


def test_errors_name_the_argument():
    rows, cu_pairs = random_rows()
    *first, colors, background = rows
    size = {"width": WIDTH, "height": HEIGHT, "cu_pairs": cu_pairs}
    with pytest.raises(ValueError, match="conics must be"):
        rasterize_projected(first[0], first[1][:, :2], *first[2:], colors, **size)
    with pytest.raises(ValueError, match="depths must be"):
        rasterize_projected(*first[:2], first[2][:5], first[3], colors, **size)
    with pytest.raises(ValueError, match="colors must be"):
        rasterize_projected(*first, colors[:, 0], **size)
    with pytest.raises(ValueError, match="background must be"):
        rasterize_projected(*first, colors, background=background[:, :2], **size)
    with pytest.raises(ValueError, match="cutoff must be one of"):
        rasterize_projected(*first, colors, cutoff="tile3sigma", **size)
    for width, height in ((0, 4), (4, 0), (2**16, 4), (4, 2**16)):
        with pytest.raises(ValueError, match="width and height"):
            rasterize_projected(*first, colors, width=width, height=height, cu_pairs=cu_pairs)
    with pytest.raises(ValueError, match="cu_pairs must ascend from 0 to 60"):
        rasterize_projected(*first, colors, width=4, height=4, cu_pairs=torch.tensor([0, 10]))
    with pytest.raises(NumericalError, match="means2d must be finite"):
        rasterize_projected(first[0] / 0, *first[1:], colors, **size)
    for wrong in (first[3] - 1, first[3] + 1):
        with pytest.raises(NumericalError, match="opacities must be finite, not negative and at most 1; got"):
            rasterize_projected(*first[:3], wrong, colors, **size)
    with pytest.raises(NumericalError, match="rasterize_projected: background must be finite"):
        rasterize_projected(*first, colors, background=background / 0, **size)


def test_dtypes_are_not_changed_silently():
    (*first, colors, background), cu_pairs = random_rows(dtype=torch.float32)
    size = {"width": WIDTH, "height": HEIGHT, "cu_pairs": cu_pairs}
    with pytest.raises(ValueError, match="colors must be float32, as means2d, or of 16 bits; got torch.float64"):
        rasterize_projected(*first, colors.double(), **size)
    with pytest.raises(ValueError, match="background must be float32"):
        rasterize_projected(*first, colors, background=background.int(), **size)


def test_second_derivatives_are_refused_by_name():
    rows, cu_pairs = random_rows()
    leaves = leaves_of(rows)
    grad = torch.autograd.grad(render(leaves, cu_pairs)[0].sum(), leaves[0], create_graph=True)[0]
    with pytest.raises(GradientError, match="rasterize_projected"):
        grad.sum().backward()
