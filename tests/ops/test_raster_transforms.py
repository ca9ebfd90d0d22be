"""The rasterizer under torch.func: grad, vjp, vmap and their nesting; forward mode."""

import functools

import pytest
import torch
from torch.autograd import forward_ad

from gsim3d.errors import GradientError
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.cuda_graph import captured
from tests.ops.raster_scene import Scene, facing, random_scene
from tests.ops.test_raster import DTYPES, OUTPUTS, operator_args
from tests.ops.test_raster_active import shown, some_tiles

NAMES = ("means", "quats", "scales", "opacities", "color", "features", "background", "viewmats")


def scene_on(device, dtype=torch.float64) -> Scene:
    return random_scene(n=15, clouds=2, images=3, width=14, height=12, sh_terms=4, seed=3, dtype=dtype).to(device)


def loss_of(scene, *inputs):
    cotangents = scene.cotangents()
    return sum((c * x).sum() for c, x in zip(cotangents, scene.render(*inputs), strict=True))


def moved(scene, size):
    """``size`` times each input, a little apart."""
    g = torch.Generator().manual_seed(1)
    return [x[None] * (1 + 0.02 * torch.rand(size, *[1] * x.dim(), generator=g).to(x)) for x in scene.inputs]


def test_grad_and_vjp_equal_autograd(device):
    scene = scene_on(device)
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    expected = torch.autograd.grad(loss_of(scene, *leaves), leaves)
    numbers = tuple(range(len(NAMES)))
    for a, e in zip(torch.func.grad(lambda *x: loss_of(scene, *x), numbers)(*scene.inputs), expected, strict=True):
        assert_same_bits(a, e)
    _, pull = torch.func.vjp(lambda *x: scene.render(*x), *scene.inputs)
    for a, e in zip(pull(scene.cotangents()), expected, strict=True):
        assert_same_bits(a, e)


@pytest.mark.parametrize("which", [NAMES, ("means",), ("viewmats", "background"), ("opacities", "color")], ids=str)
def test_vmap_equals_one_call_after_the_other(device, which):
    scene = scene_on(device)
    dims = tuple(0 if name in which else None for name in NAMES)
    batches = [m if name in which else x for name, m, x in zip(NAMES, moved(scene, 3), scene.inputs, strict=True)]
    together = torch.func.vmap(lambda *x: scene.render(*x), dims)(*batches)
    for b in range(3):
        alone = scene.render(*(x[b] if dim == 0 else x for x, dim in zip(batches, dims, strict=True)))
        for a, e in zip(together, alone, strict=True):
            assert_same_bits(a[b], e)


def test_gradients_of_each_scene_of_a_batch(device):
    scene = scene_on(device)
    batches, numbers = moved(scene, 3), tuple(range(len(NAMES)))
    each = torch.func.grad(lambda *x: loss_of(scene, *x), numbers)
    grads = torch.func.vmap(each, randomness="same")(*batches)
    for b in range(3):
        leaves = [x[b].clone().requires_grad_() for x in batches]
        expected = torch.autograd.grad(loss_of(scene, *leaves), leaves)
        for name, a, e in zip(NAMES, grads, expected, strict=True):
            assert_close_relative_to_max(a[b], e, "raster_grad_float64", name)


def test_rows_of_a_jacobian(device):
    scene = scene_on(device)

    def alpha(means):
        return scene.render(means, *scene.inputs[1:])[1][0, 4:6, 5:7].flatten()

    rows = torch.func.jacrev(alpha)(scene.means)
    leaf = scene.means.clone().requires_grad_()
    for row, value in zip(rows, alpha(leaf), strict=True):
        assert_close_relative_to_max(row, torch.autograd.grad(value, leaf, retain_graph=True)[0], "raster_grad_float64")


# ---- derivatives of the gradients, on the CPU ------------------------------------------------------------------------


def small(sh_terms=4, jacobian="exact", cutoff="smooth", device="cpu"):
    """A scene away from jumps, and a function of its inputs that mixes all pixels of all images."""
    scene = random_scene(
        n=5, clouds=2, images=2, width=11, height=9, n_features=2, sh_terms=sh_terms, seed=3, spread=0.3
    )
    scene = scene.replace(scales=2 * scene.scales, color=scene.color + (0.5 if sh_terms else 0)).to(
        torch.device(device)
    )
    mix = scene.cotangents()

    def f(*inputs):
        images = scene.render(*inputs, cutoff=cutoff, jacobian=jacobian)
        return sum((m * x).sum() for m, x in zip(mix, images, strict=True))

    return scene, f


@pytest.mark.parametrize(("sh_terms", "jacobian"), [(0, "exact"), (1, "clamped"), (4, "exact"), (16, "exact")])
def test_gradgradcheck(sh_terms, jacobian):
    scene, f = small(sh_terms, jacobian)
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    assert torch.autograd.gradgradcheck(f, leaves, atol=1e-5, rtol=1e-4, nondet_tol=0.0, fast_mode=True)


def test_hessian_of_opacities():
    scene, f = small()

    def of_opacities(opacities):
        return f(*scene.inputs[:3], opacities, *scene.inputs[4:])

    leaf = scene.opacities.clone().requires_grad_()
    gradient = torch.autograd.grad(of_opacities(leaf), leaf, create_graph=True)[0]
    expected = torch.stack([torch.autograd.grad(g, leaf, retain_graph=True)[0] for g in gradient])
    assert expected.abs().max() > 0
    assert_close_relative_to_max(expected, expected.mT, 1e-10)
    hessians = (torch.func.hessian(of_opacities), torch.func.jacrev(torch.func.jacrev(of_opacities)))
    for hessian in hessians:
        assert_close_relative_to_max(hessian(scene.opacities), expected, 1e-10)


def test_what_is_not_there_is_refused_by_name(device):
    scene, f = small()
    scene = scene.to(device)

    def loss(means):
        return scene.render(means, *scene.inputs[1:])[0].square().sum()

    leaf = scene.means.clone().requires_grad_()
    with pytest.raises(GradientError, match="rasterize_gaussians"):
        value = loss(leaf)
        for _ in range(2 if device.type == "cuda" else 3):
            value = torch.autograd.grad(value.sum(), leaf, create_graph=True)[0]
    transforms = [(outer, torch.func.jacfwd) for outer in (torch.func.jacfwd, torch.func.jacrev)]
    if device.type == "cuda":
        transforms += [(outer, torch.func.jacrev) for outer in (torch.func.jacfwd, torch.func.jacrev)]
    for outer, inner in transforms:
        with pytest.raises(GradientError, match=r"rasterize_gaussians \(order 2\)") as caught:
            outer(inner(loss))(scene.means)
        assert caught.value.order == 2


def test_vmap_of_no_scenes(device):
    scene, _ = small()
    scene = scene.to(device)
    none = scene.means[None][:0]
    assert torch.vmap(lambda means: scene.render(means, *scene.inputs[1:])[1])(none).shape[0] == 0


def test_gradients_of_Ks_are_refused_by_name():
    scene, _ = small()

    def alpha(Ks, means):
        return scene.replace(Ks=Ks).render(means, *scene.inputs[1:])[1].sum()

    Ks, means = scene.Ks, torch.stack([scene.means, scene.means])
    transformed = {
        "grad": lambda: torch.func.grad(alpha)(Ks, scene.means),
        "vmap of grad": lambda: torch.func.vmap(torch.func.grad(alpha), (None, 0))(Ks, means),
        "grad of vmap": lambda: torch.func.grad(lambda K: torch.func.vmap(alpha, (None, 0))(K, means).sum())(Ks),
        "jvp": lambda: torch.func.jvp(lambda K: alpha(K, scene.means), (Ks,), (Ks,)),
    }
    for call in transformed.values():
        with pytest.raises(GradientError, match="Ks has no gradient"):
            call()
    assert torch.func.grad(alpha, 1)(Ks, scene.means).abs().max() > 0


# ---- forward mode ----------------------------------------------------------------------------------------------------


def directions(scene, which=NAMES, seed=2) -> tuple[torch.Tensor, ...]:
    """Tangents of the inputs of these names, about as large as the inputs; of the others 0."""
    g = torch.Generator().manual_seed(seed)
    random = [torch.randn(x.shape, generator=g, dtype=torch.float64).to(x) for x in scene.inputs]
    random[2], random[3] = 0.3 * scene.scales * random[2], 0.3 * random[3]
    random[7][:, 3] = 0  # the last row of a viewmat has no gradient
    return tuple(t if name in which else 0 * t for name, t in zip(NAMES, random, strict=True))


def tangents(scene, along, render=None, **options) -> tuple[torch.Tensor, ...]:
    """Derivatives of the images of a scene along tangents of its inputs."""
    f = functools.partial(render or scene.render, **options)
    return torch.func.jvp(lambda *inputs: f(*inputs), scene.inputs, along)[1]


def check_tangents(scene, device, dtype=torch.float64, render=None, kind="raster_tangent", which=NAMES, **options):
    """On a device and in a dtype against ``render``, by default the oracle, in float64."""
    along = directions(scene, which)
    expected = tangents(scene, along, render or scene.render_oracle, **options)
    assert any(e.abs().max() > 0 for e in expected)
    there, along = scene.to(dtype).to(device), tuple(t.to(dtype).to(device) for t in along)
    for name, a, e in zip(OUTPUTS, tangents(there, along, **options), expected, strict=True):
        assert a.dtype == dtype
        assert_close_relative_to_max(a, e, f"{kind}_{DTYPES[dtype]}", name)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("sh_terms", [0, 1, 4, 9, 16])
@pytest.mark.parametrize("cutoff", ["exact", "tile3sigma", "smooth"])
@pytest.mark.parametrize("jacobian", ["exact", "clamped"])
def test_jvp(device, sh_terms, cutoff, jacobian, dtype):
    scene = random_scene(sh_terms=sh_terms, seed=sh_terms)
    check_tangents(scene, device, dtype, cutoff=cutoff, jacobian=jacobian)


@pytest.mark.parametrize("which", [(name,) for name in NAMES], ids=lambda which: which[0])
def test_jvp_along_one_input_equals_differences(device, which):
    scene = random_scene(n=40, n_features=11, sh_terms=9, seed=4)
    scene = scene.replace(color=scene.color * 0.3).to(device)  # no colour is clamped at 0
    along, step = directions(scene, which), 1e-5

    def moved(sign):
        inputs = [x + sign * step * t for x, t in zip(scene.inputs, along, strict=True)]
        return scene.render(*inputs, cutoff="smooth")

    actual = tangents(scene, along, cutoff="smooth")
    assert any(a.abs().max() > 0 for a in actual)
    for name, a, high, low in zip(OUTPUTS, actual, moved(1), moved(-1), strict=True):
        assert_close_relative_to_max(a, (high - low) / (2 * step), 1e-5, name)


@pytest.mark.parametrize("cutoff", ["exact", "smooth"])
def test_jvp_equals_rows_of_the_gradient(device, cutoff):
    scene, f = small(cutoff=cutoff, device=device)
    along = directions(scene)
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    expected = sum((a * b).sum() for a, b in zip(torch.autograd.grad(f(*leaves), leaves), along, strict=True))
    value, slope = torch.func.jvp(f, scene.inputs, along)
    assert_close_relative_to_max(slope, expected, 1e-11)
    assert_close_relative_to_max(value, f(*scene.inputs), 1e-14)


# In float32 some alphas are beside 1/255 but for rounding: only a smooth cut is compared.
@pytest.mark.unsanitized("runs the kernels of test_jvp on many more pixels")
@pytest.mark.parametrize(
    ("dtype", "cutoff"),
    [(torch.float64, "exact"), (torch.float64, "tile3sigma"), (torch.float64, "smooth"), (torch.float32, "smooth")],
)
@pytest.mark.parametrize("which", [NAMES, ("viewmats",), ("background",), ("features", "quats")], ids=str)
def test_devices_agree_on_large_gaussians(devices, which, cutoff, dtype):
    scene = random_scene(n=200, clouds=2, images=3, width=333, height=251, n_features=9, sh_terms=16, seed=6)
    scene = scene.replace(scales=4 * scene.scales, opacities=0.4 * scene.opacities)
    check_tangents(scene, devices[1], dtype, scene.render, which=which, cutoff=cutoff)


def layers(n):
    """Thousands of faint Gaussians in every tile; no two of nearly equal depth, which float32 might swap."""
    scene = random_scene(n=n, clouds=1, images=2, width=40, height=33, sh_terms=4, n_features=9, spread=0.2, seed=1)
    g = torch.Generator().manual_seed(3)
    scene.means[:, 2] = torch.linspace(-0.5, 0.5, n, dtype=torch.float64)[torch.randperm(n, generator=g)]
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = torch.tensor([0.05, -0.05]), 3
    return scene.replace(viewmats=viewmats, opacities=0.02 * scene.opacities + 0.005, scales=2 * scene.scales)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("n", [1500, 5000])
def test_jvp_of_long_lists(device, n, dtype):
    check_tangents(layers(n), device, dtype, kind="raster_many_tangent", cutoff="smooth")


def test_jvp_where_pixels_end(device):
    scene = random_scene(n=400, clouds=1, images=2, sh_terms=1, seed=9)
    scene = scene.replace(scales=3 * scene.scales)
    assert (1 - scene.render()[1]).min() < 1e-3
    check_tangents(scene, device)


def test_jvp_where_alpha_is_cut(device):
    scene = random_scene(n=100, sh_terms=1, seed=9)
    scene = scene.replace(scales=3 * scene.scales, opacities=0.98 + 0.02 * scene.opacities)
    check_tangents(scene, device)


def operator_tangents(scene, along, limits=None, active=None) -> tuple[torch.Tensor, ...]:
    """What the op says with the state of a forward pass of these limits."""
    args = list(operator_args(scene))
    args = [x.detach() if isinstance(x, torch.Tensor) else x for x in args]
    args[-3:] = limits or args[-3:]
    state = torch.ops.gsim3d.rasterize_gaussians(*args, False, active)[6]
    return torch.ops.gsim3d.rasterize_gaussians_tangent(*along, state, *args, active)


@pytest.mark.parametrize("limits", [(1, 1, 4), (2, 4, 8), (3, 10, 12)], ids=str)
@pytest.mark.parametrize("masked", [False, True])
def test_jvp_of_any_limits_on_cuda(devices, limits, masked):
    """What exceeds the limits is done in further groups of images, down to parts of one image."""
    scene = random_scene(n=800, clouds=2, images=6, width=40, height=33, sh_terms=4, n_features=9, seed=8)
    scene = scene.replace(opacities=0.01 + 0.02 * scene.opacities, scales=8 * scene.scales).to(devices[1])
    along, active = directions(scene), some_tiles(scene)[1][:, ::16, ::16].contiguous() if masked else None
    found = [
        operator_tangents(scene, along, [factor * len(scene.means) for factor in limits], active)
        for limits in (limits, (6, 100, 400))
    ]
    for name, a, e in zip(OUTPUTS, *found, strict=True):
        assert e.abs().max() > 0
        assert_close_relative_to_max(a, e, "raster_tangent_float64", name)


@pytest.mark.parametrize("cutoff", ["exact", "tile3sigma", "smooth"])
def test_jvp_of_active_tiles(device, cutoff):
    scene = random_scene(n=300, sh_terms=4, dtype=torch.float32).to(device)
    active, tiles = some_tiles(scene)
    along = directions(scene)
    whole = tangents(scene, along, cutoff=cutoff)
    for a, e in zip(tangents(scene, along, active=active, cutoff=cutoff), shown(whole, tiles, along[6]), strict=True):
        assert torch.equal(a, e)


def test_jvp_of_nothing(device):
    empty = facing(torch.zeros(0, 3), dtype=torch.float64).to(device)
    color, *others = tangents(empty, directions(empty))
    assert torch.equal(color, directions(empty)[6].expand(1, 16, 16, 3))
    assert all(x.abs().max() == 0 for x in others if x.numel())
    scene = random_scene(n=12, clouds=4, images=3, sh_terms=0, width=23, height=18)
    none = {name: getattr(scene, name)[:0] for name in ("background", "viewmats", "Ks", "image_cloud")}
    images = scene.replace(**none).to(device)
    assert tangents(images, directions(images))[0].shape == (0, 18, 23, 3)
    scene = scene.replace(cu_rows=torch.tensor([0, 0, 5, 5, 12]), image_cloud=torch.tensor([1, 0, 1])).to(device)
    color, alpha, _, _ = tangents(scene, directions(scene))
    assert alpha[0].abs().max() > 0 and alpha[1].abs().max() == 0
    assert torch.equal(color[1], directions(scene)[6][1].expand(18, 23, 3))


def test_jvp_of_rows_that_are_left_out(device):
    scene = random_scene(n=30, sh_terms=4, seed=5).to(device)
    bad, good = scene.means.clone(), torch.ones(30, dtype=torch.bool)
    bad[3], bad[17], good[3], good[17] = float("nan"), float("inf"), False, False
    spoiled, along = scene.replace(means=bad), directions(scene)
    kept = scene.opacities.clone()
    kept[~good.to(device)] = 0
    dropped = [t.clone() for t in along]
    for t in dropped[:6]:
        t[~good.to(device)] = 0
    expected = tangents(scene.replace(opacities=kept), tuple(dropped), on_invalid="drop")
    for a, e in zip(tangents(spoiled, along, on_invalid="drop"), expected, strict=True):
        assert torch.equal(a, e)


def test_jvp_of_zero_quaternions_and_scales(device):
    scene = random_scene(n=30, sh_terms=4, seed=5)
    quats, scales = scene.quats.clone(), scene.scales.clone()
    quats[:10], scales[5:15, 1], scales[12:20] = 0, 0, 0
    scene, identity = scene.replace(quats=quats, scales=scales), torch.eye(4, dtype=torch.float64)[0]

    def render(means, quats, *others):
        without_direction = (torch.arange(30) < 10)[:, None]
        return scene.render_oracle(means, torch.where(without_direction, identity, quats), *others)

    check_tangents(scene, device, render=render)


def test_dual_levels_equal_jvp(device):
    scene = scene_on(device)
    along = directions(scene)
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(x, t) for x, t in zip(scene.inputs, along, strict=True)]
        found = [forward_ad.unpack_dual(x) for x in scene.render(*duals)]
    for a, value, e in zip(found, scene.render(), tangents(scene, along), strict=True):
        assert_same_bits(a.primal, value)
        assert_same_bits(a.tangent, e)


def test_jacfwd_equals_jacrev(device):
    scene = scene_on(device)

    def patch(opacities, viewmats):
        images = scene.render(*scene.inputs[:3], opacities, *scene.inputs[4:7], viewmats)
        return torch.cat([x[0, 4:6, 5:7].flatten() for x in images])

    inputs = scene.opacities, scene.viewmats
    columns, rows = (jacobian(patch, (0, 1))(*inputs) for jacobian in (torch.func.jacfwd, torch.func.jacrev))
    for a, e in zip(columns, rows, strict=True):
        assert e.abs().max() > 0
        assert_close_relative_to_max(a, e, "raster_grad_float64")


@pytest.mark.parametrize("which", [NAMES, ("means",), ("viewmats", "background")], ids=str)
@pytest.mark.parametrize("masked", [False, True])
def test_vmap_of_jvp_equals_one_after_the_other(device, which, masked):
    scene = scene_on(device)
    active = some_tiles(scene)[0] if masked else None
    dims = tuple(0 if name in which else None for name in NAMES)
    batches = [m if name in which else x for name, m, x in zip(NAMES, moved(scene, 3), scene.inputs, strict=True)]
    along = directions(scene)

    def slopes(*inputs):
        return torch.func.jvp(lambda *x: scene.render(*x, active=active), inputs, along)[1]

    together = torch.func.vmap(slopes, dims)(*batches)
    for b in range(3):
        alone = slopes(*(x[b] if dim == 0 else x for x, dim in zip(batches, dims, strict=True)))
        for a, e in zip(together, alone, strict=True):
            assert_same_bits(a[b], e)


def test_vmap_of_no_directions(device):
    scene = scene_on(device)
    none = torch.zeros(0, *scene.means.shape, dtype=torch.float64, device=device)

    def slope(along):
        return torch.func.jvp(lambda means: scene.render(means, *scene.inputs[1:])[1], (scene.means,), (along,))[1]

    assert torch.vmap(slope)(none).shape == (0, 3, 12, 14)


def test_opcheck_of_tangents(device):
    scene = random_scene(n=8, images=2, clouds=2, width=9, height=7).to(device)
    args = [x.detach() if isinstance(x, torch.Tensor) else x for x in operator_args(scene)]
    state = torch.ops.gsim3d.rasterize_gaussians(*args, False)[6]
    torch.library.opcheck(
        torch.ops.gsim3d.rasterize_gaussians_tangent,
        (*directions(scene), state, *args),
        test_utils=("test_schema", "test_faketensor"),
    )


def test_tangents_of_other_shapes_are_refused(device):
    scene = scene_on(device)
    along = list(directions(scene))
    along[1] = along[1][:, :3]
    with pytest.raises(ValueError, match="rasterize_gaussians_tangent: tangents must have the shapes"):
        operator_tangents(scene, along)


def test_same_bits_of_jvp_for_any_threads():
    scene = random_scene(n=2000, sh_terms=4, dtype=torch.float32, seed=2)
    assert_same_bits_for_any_threads(lambda: tangents(scene, directions(scene)))


@pytest.mark.unsanitized("runs the kernels of test_jvp_of_any_limits on many more rows")
def test_same_bits_of_jvp_every_time_on_cuda(devices):
    scene = random_scene(n=20_000, width=64, height=48, sh_terms=4, dtype=torch.float32, seed=2).to(devices[1])
    along = directions(scene)
    first = tangents(scene, along)
    for _ in range(3):
        for a, e in zip(tangents(scene, along), first, strict=True):
            assert_same_bits(a, e)


def test_jvp_in_a_cuda_graph(devices):
    scene = random_scene(n=300, sh_terms=4, dtype=torch.float32).to(devices[1])
    along = directions(scene)
    expected = operator_tangents(scene, along)
    graph, results = captured(lambda: operator_tangents(scene, along))
    for tensor in results:
        tensor.fill_(float("nan"))
    graph.replay()
    for a, e in zip(results, expected, strict=True):
        assert_same_bits(a, e)
