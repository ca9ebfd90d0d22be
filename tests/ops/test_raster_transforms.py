"""The rasterizer under torch.func: grad, vjp, vmap and their nesting."""

import pytest
import torch

from gsim3d.errors import GradientError
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.ops.raster_scene import Scene, random_scene

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


# ---- second derivatives and forward mode, on the CPU ---------------------------------------------------------------


def small(sh_terms=4, jacobian="exact", cutoff="smooth"):
    """A scene away from jumps, and a function of its inputs that mixes all pixels of all images."""
    scene = random_scene(
        n=5, clouds=2, images=2, width=11, height=9, n_features=2, sh_terms=sh_terms, seed=3, spread=0.3
    )
    scene = scene.replace(scales=2 * scene.scales, color=scene.color + (0.5 if sh_terms else 0))
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


@pytest.mark.parametrize("cutoff", ["exact", "smooth"])
def test_jvp_equals_rows_of_the_gradient(cutoff):
    scene, f = small(cutoff=cutoff)
    g = torch.Generator().manual_seed(2)
    along = tuple(torch.randn(x.shape, generator=g, dtype=torch.float64) for x in scene.inputs)
    along[7][:, 3] = 0  # the last row of a viewmat has no gradient
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    expected = sum((a * b).sum() for a, b in zip(torch.autograd.grad(f(*leaves), leaves), along, strict=True))
    value, slope = torch.func.jvp(f, scene.inputs, along)
    assert_close_relative_to_max(slope, expected, 1e-11)
    assert_close_relative_to_max(value, f(*scene.inputs), 1e-14)


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
    for outer in (torch.func.jacfwd, torch.func.jacrev):
        with pytest.raises(GradientError, match="rasterize_gaussians"):
            outer(torch.func.jacfwd(loss))(scene.means)


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
