"""rasterize_gaussians against a dense float64 renderer; edge cases are in test_raster_edges.py."""

import pytest
import torch

from tests.asserts import (
    assert_close_relative_to_max,
    assert_same_bits,
    assert_same_bits_for_any_threads,
)
from tests.cuda_graph import captured
from tests.ops.raster_scene import Scene, facing, gradients, random_scene

OUTPUTS = ("color", "alpha", "depth", "features")
DTYPES = {torch.float32: "float32", torch.float64: "float64"}


def operator_args(scene):
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    sizes = [factor * len(scene.means) if scene.means.is_cuda else 0 for factor in (2, 4, 8)]
    return (*leaves, scene.Ks, scene.image_cloud, scene.cu_rows, scene.width, scene.height, 0.01, 0, 0, *sizes)


# ---- 1 forward against the oracle ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("sh_terms", [0, 1, 4, 9, 16])
@pytest.mark.parametrize("cutoff", ["exact", "tile3sigma", "smooth"])
@pytest.mark.parametrize("jacobian", ["exact", "clamped"])
def test_forward(device, sh_terms, cutoff, jacobian, dtype):
    scene = random_scene(sh_terms=sh_terms, seed=sh_terms)
    expected = scene.render_oracle(cutoff=cutoff, jacobian=jacobian)
    actual = scene.to(dtype).to(device).render(cutoff=cutoff, jacobian=jacobian)
    for name, a, e in zip(OUTPUTS, actual, expected, strict=True):
        assert a.dtype == dtype
        assert_close_relative_to_max(a, e, f"raster_{DTYPES[dtype]}", name)


def test_long_lists_are_sorted_by_depth(device):
    # Thousands of faint Gaussians in every tile: several chunks of rows, and the radix sort in place of the insertion
    # sort.
    scene = random_scene(n=5000, clouds=1, images=1, width=24, height=20, sh_terms=0, n_features=1, spread=0.3, seed=1)
    scene = scene.replace(opacities=0.02 * scene.opacities + 0.004, scales=0.3 * scene.scales)
    expected = scene.render_oracle()
    for dtype, name in DTYPES.items():
        for a, e in zip(scene.to(dtype).to(device).render(), expected, strict=True):
            assert_close_relative_to_max(a, e, f"raster_many_{name}")


# ---- 2 backward against autograd of the oracle ---------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("sh_terms", [0, 1, 4, 9, 16])
@pytest.mark.parametrize("cutoff", ["exact", "tile3sigma", "smooth"])
@pytest.mark.parametrize("jacobian", ["exact", "clamped"])
def test_backward(device, sh_terms, cutoff, jacobian, dtype):
    scene, options = random_scene(sh_terms=sh_terms, seed=sh_terms), {"cutoff": cutoff, "jacobian": jacobian}
    expected = gradients(scene.render_oracle, scene, **options)
    moved = scene.to(dtype).to(device)
    for name, a, e in zip(Scene.NAMES, gradients(moved.render, moved, **options), expected, strict=True):
        assert e.abs().max() > 0
        assert_close_relative_to_max(a, e, f"raster_grad_{DTYPES[dtype]}", name)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
def test_gradients_of_gaussians_over_many_tiles(device, dtype):
    # On a GPU a warp shares the sums of a Gaussian over more than 32 quarters of tiles; here up to 99.
    scene = random_scene(n=40, clouds=1, images=2, width=85, height=67, sh_terms=4, seed=8)
    scene = scene.replace(scales=3 * scene.scales, opacities=0.6 * scene.opacities)
    expected = gradients(scene.render_oracle, scene)
    moved = scene.to(dtype).to(device)
    for name, a, e in zip(Scene.NAMES, gradients(moved.render, moved), expected, strict=True):
        assert_close_relative_to_max(a, e, f"raster_grad_{DTYPES[dtype]}", name)


def test_gradients_of_many_rows(device):
    # More rows than a chunk holds: sums over rows (viewmats, background) add up chunks.
    scene = random_scene(n=2500, clouds=1, images=1, width=9, height=7, sh_terms=0, n_features=1, spread=0.3, seed=1)
    scene = scene.replace(opacities=0.02 * scene.opacities + 0.004, scales=0.3 * scene.scales)
    expected = gradients(scene.render_oracle, scene)
    moved = scene.to(device)
    for name, a, e in zip(Scene.NAMES, gradients(moved.render, moved), expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float64", name)


@pytest.mark.parametrize("n_features", [0, 1, 8, 33])
def test_any_number_of_features(device, n_features):
    scene = random_scene(n=20, n_features=n_features, sh_terms=0, seed=n_features)
    moved = scene.to(device)
    for a, e in zip(moved.render(), scene.render_oracle(), strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")
    expected = gradients(scene.render_oracle, scene)
    for name, a, e in zip(Scene.NAMES, gradients(moved.render, moved), expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float64", name)


def test_gradients_where_pixels_end(device):
    # Nearly opaque layers: most pixels end before their list does, each after another number of entries.
    scene = random_scene(n=80, clouds=2, images=2, width=20, height=18, sh_terms=0, seed=7, spread=0.2)
    scene = scene.replace(opacities=0.9 + 0.08 * scene.opacities, scales=4 * scene.scales)
    kept = torch.ops.gsim3d.rasterize_gaussians(*operator_args(scene), False)
    assert (kept[4] < 1e-3).double().mean() > 0.2 and len(kept[5].unique()) > 20
    expected = gradients(scene.render_oracle, scene)
    moved = scene.to(device)
    for name, a, e in zip(Scene.NAMES, gradients(moved.render, moved), expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float64", name)


def test_no_gradient_where_alpha_is_cut(device):
    scene = facing([0, 0, 2.0], scales=0.5, opacities=1.0, width=1, height=1, dtype=torch.float64).to(device)
    for name, grad in zip(Scene.NAMES, gradients(scene.render, scene), strict=True):
        if name in ("means", "quats", "scales", "opacities"):  # of the mean, depth alone has a gradient
            rest = grad[:, :2] if name == "means" else grad
            assert rest.abs().max() == 0, name


def test_unused_inputs_have_no_gradient(device):
    scene = random_scene(n=10).to(device)
    means = scene.means.clone().requires_grad_()
    out = scene.render(means, *scene.inputs[1:])
    out[2].sum().backward()
    assert means.grad.abs().max() > 0 and scene.quats.grad is None


# ---- 3 gradcheck in float64, all inputs together -------------------------------------------------------------------


@pytest.mark.unsanitized("runs the kernels of test_any_number_of_features thousands of times")
@pytest.mark.parametrize(("sh_terms", "jacobian"), [(0, "exact"), (4, "exact"), (16, "exact"), (0, "clamped")])
def test_gradcheck(device, sh_terms, jacobian):
    scene = random_scene(
        n=5, clouds=2, images=2, width=11, height=9, n_features=2, sh_terms=sh_terms, seed=3, spread=0.3
    )
    color = scene.color + (0.5 if sh_terms else 0)  # away from the clamp at 0
    scales, means = 2 * scene.scales, scene.means.clone()
    means[0], scales[0] = torch.tensor([2.5, 0.3, -1.0]), 1.0  # far outside of the image, where a Jacobian is clamped
    scene = scene.replace(means=means, scales=scales, color=color).to(device)
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    mixes = [scene.cotangents(seed) for seed in range(6)]

    def mixed(*inputs):  # six random mixtures of all pixels of all images
        out = scene.render(*inputs, cutoff="smooth", jacobian=jacobian)
        return torch.stack([sum((m * o).sum() for m, o in zip(mix, out, strict=True)) for mix in mixes])

    assert torch.autograd.gradcheck(mixed, leaves, atol=1e-6, nondet_tol=0.0)


# ---- 4 CPU against CUDA --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sh_terms", [0, 16])
def test_devices_agree(devices, sh_terms):
    cpu, cuda = (random_scene(n=400, sh_terms=sh_terms, dtype=torch.float32).to(device) for device in devices)
    for name, a, e in zip(OUTPUTS, cuda.render(), cpu.render(), strict=True):
        assert_close_relative_to_max(a, e, "raster_float32", name)
    for name, a, e in zip(Scene.NAMES, gradients(cuda.render, cuda), gradients(cpu.render, cpu), strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float32", name)


@pytest.mark.unsanitized("runs the kernels of test_any_limits on many more rows")
def test_same_bits_every_time_on_cuda(devices):
    # Overlapping Gaussians, so that thousands of threads work on one tile and on one row.
    scene = random_scene(n=20_000, width=64, height=48, sh_terms=4, dtype=torch.float32, seed=2).to(devices[1])
    first = (*scene.render(), *gradients(scene.render, scene))
    for _ in range(3):
        for a, e in zip((*scene.render(), *gradients(scene.render, scene)), first, strict=True):
            assert_same_bits(a, e)


@pytest.mark.parametrize("limits", [(1, 1, 4), (2, 4, 8), (3, 10, 12)], ids=str)
def test_any_limits_give_the_same_result_on_cuda(devices, limits):
    """What exceeds the limits is done in further groups of images, down to parts of one image."""
    scene = random_scene(n=800, clouds=2, images=6, width=40, height=33, sh_terms=4, dtype=torch.float32, seed=8)
    scene = scene.replace(opacities=0.01 + 0.02 * scene.opacities, scales=8 * scene.scales).to(devices[1])
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    args, cotangents = operator_args(scene)[8:-3], scene.cotangents()

    def render(*limits):
        limits = [factor * len(scene.means) for factor in limits]
        out = torch.ops.gsim3d.rasterize_gaussians(*leaves, *args, *limits, False)[:4]
        return (*out, *torch.autograd.grad(out, leaves, cotangents))

    # Other kernels render what exceeds the limits: the compiler may fuse other products and sums.
    for a, e in zip(render(*limits), render(6, 100, 400), strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float32")


def test_more_than_the_first_group_holds_on_cuda(devices):
    # All images show the larger cloud: more pairs than where every cloud has as many images.
    scene = random_scene(n=4000, clouds=2, images=6, width=40, height=33, sh_terms=4, dtype=torch.float32, seed=8)
    scene = scene.replace(opacities=0.01 + 0.02 * scene.opacities, cu_rows=torch.tensor([0, 3900, 4000]))
    cpu = scene.replace(image_cloud=torch.zeros(6, dtype=torch.int64))
    cuda = cpu.to(devices[1])
    for name, a, e in zip(OUTPUTS, cuda.render(), cpu.render(), strict=True):
        assert_close_relative_to_max(a, e, "raster_many_float32", name)
    for name, a, e in zip(Scene.NAMES, gradients(cuda.render, cuda), gradients(cpu.render, cpu), strict=True):
        assert_close_relative_to_max(a, e, "raster_grad_float32", name)


def test_gradient_of_the_viewmats_only_when_wanted_on_cuda(devices):
    scene = random_scene(n=200, sh_terms=4, dtype=torch.float32).to(devices[1])
    expected = gradients(scene.render, scene)[:7]
    leaves = [x.clone().requires_grad_() for x in scene.inputs[:7]]
    out = scene.render(*leaves, scene.viewmats)
    for a, e in zip(torch.autograd.grad(out, leaves, scene.cotangents()), expected, strict=True):
        assert_same_bits(a, e)


def test_render_in_a_cuda_graph(devices):
    scene = random_scene(n=300, sh_terms=4, dtype=torch.float32).to(devices[1])
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    cotangents, args = scene.cotangents(), operator_args(scene)[8:]

    def run():
        out = torch.ops.gsim3d.rasterize_gaussians(*leaves, *args, True)[:4]
        return [*out, *torch.autograd.grad(out, leaves, cotangents)]

    expected = [x.detach() for x in run()]  # a graph kept alive would tie its leaves to this stream
    graph, results = captured(run)
    for tensor in results:
        tensor.detach().fill_(float("nan"))
    graph.replay()
    for a, e in zip(results, expected, strict=True):
        assert_same_bits(a, e)


# ---- 5 opcheck -----------------------------------------------------------------------------------------------------


def test_opcheck():
    args = (*operator_args(random_scene(n=8, images=2, clouds=2, width=9, height=7)), True)
    torch.library.opcheck(torch.ops.gsim3d.rasterize_gaussians, args)


def test_opcheck_on_cuda(devices):
    # Traced and eager outputs are not compared: what is kept for the backward pass has bytes that are never set.
    args = (*operator_args(random_scene(n=8, images=2, clouds=2, width=9, height=7).to(devices[1])), True)
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.rasterize_gaussians, args, test_utils=tests)


def test_opcheck_backward(device):
    scene = random_scene(n=8, images=2, clouds=2, width=9, height=7).to(device)
    args = [x.detach() if isinstance(x, torch.Tensor) else x for x in operator_args(scene)]
    kept = torch.ops.gsim3d.rasterize_gaussians(*args, False)[4:7]
    torch.library.opcheck(
        torch.ops.gsim3d.rasterize_gaussians_backward,
        (*scene.cotangents(), *kept, *args, True),
        test_utils=("test_schema", "test_faketensor"),
    )


# ---- 6 torch.compile -----------------------------------------------------------------------------------------------


def test_compile_equals_eager(device):
    scene = random_scene(n=30, dtype=torch.float32).to(device)
    leaves = [x.clone().requires_grad_() for x in scene.inputs]

    def loss(*inputs):
        color, alpha, depth, features = scene.render(*inputs)
        return (color**2).sum() + alpha.sum() + depth.mean() + (features * 3).sum()

    expected = loss(*leaves)
    value = torch.compile(loss, fullgraph=True)(*leaves)
    assert_close_relative_to_max(value, expected, 1e-5)
    for a, e in zip(torch.autograd.grad(value, leaves), torch.autograd.grad(expected, leaves), strict=True):
        assert_close_relative_to_max(a, e, 1e-6)


# ---- determinism and independence (the rest of 7 is in test_raster_edges.py) ---------------------------------------


def test_same_bits_for_any_threads():
    scene = random_scene(n=5000, sh_terms=4, dtype=torch.float32, seed=2)
    assert_same_bits_for_any_threads(lambda: (*scene.render(), *gradients(scene.render, scene)))


@pytest.mark.unsanitized("runs the kernels of test_any_limits on many more rows")
def test_images_do_not_see_each_other(device):
    # Enough pairs of rows and images for several groups of images.
    scene = random_scene(n=60_000, clouds=2, images=6, width=33, height=20, sh_terms=0, dtype=torch.float32).to(device)
    together = scene.render()
    grads = gradients(scene.render, scene)
    summed = [torch.zeros_like(g) for g in grads]
    for i in range(6):
        alone = scene.replace(
            background=scene.background[i : i + 1],
            viewmats=scene.viewmats[i : i + 1],
            Ks=scene.Ks[i : i + 1],
            image_cloud=scene.image_cloud[i : i + 1],
        )
        for a, e in zip(alone.render(), together, strict=True):
            assert_same_bits(a[0], e[i])
        leaves = [x.detach().clone().requires_grad_() for x in alone.inputs]
        cotangents = [c[i : i + 1] for c in scene.cotangents()]
        parts = torch.autograd.grad(alone.render(*leaves), leaves, cotangents)
        for name, total, part in zip(Scene.NAMES, summed, parts, strict=True):
            if name in ("background", "viewmats"):
                total[i] = part[0]
            else:
                total += part
    for name, a, e in zip(Scene.NAMES, grads, summed, strict=True):
        assert_close_relative_to_max(a, e, 1e-6, name)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sh_terms", [0, 4])
def test_float16_colors(device, sh_terms, dtype):
    scene = random_scene(n=20, sh_terms=sh_terms, dtype=dtype).to(device)
    leaves = [x.detach().clone() for x in scene.inputs]
    half = leaves[4].half().requires_grad_()
    full = half.detach().to(dtype).requires_grad_()
    grads = []
    for color in (half, full):
        images = scene.render(*leaves[:4], color, *leaves[5:])
        grads += torch.autograd.grad(images, color, scene.cotangents())
        assert images[0].dtype == dtype
        assert_same_bits(images[0], scene.render(*leaves[:4], full, *leaves[5:])[0])
    assert grads[0].dtype == torch.float16 and grads[1].abs().max() > 0
    assert_same_bits(grads[0], grads[1].half())


def test_autocast_renders_in_float32(device):
    scene = random_scene(n=20, dtype=torch.float32).to(device)
    expected = scene.render()
    inputs = list(scene.inputs)
    inputs[4] = inputs[4].bfloat16()
    with torch.autocast(device.type, dtype=torch.bfloat16):
        actual = scene.render(*inputs)
    assert actual[0].dtype == torch.float32
    assert_same_bits(actual[1], expected[1])
    assert_close_relative_to_max(actual[0], expected[0], 1e-2)
