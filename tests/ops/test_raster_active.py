"""rasterize_gaussians with a mask of active pixels: tiles without any show their background."""

import pytest
import torch
from torch.func import vmap

from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.cuda_graph import captured
from tests.ops.raster_scene import Scene, gradients, random_scene
from tests.ops.test_raster import operator_args

TILE = 16


def some_tiles(scene: Scene, seed=1) -> tuple[torch.Tensor, torch.Tensor]:
    """One pixel of about half of the tiles as mask ``active``, and all pixels of these tiles."""
    shape = (len(scene.viewmats), -(-scene.height // TILE), -(-scene.width // TILE))
    chosen = torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < 0.5
    tiles = chosen.repeat_interleave(TILE, 1).repeat_interleave(TILE, 2)[:, : scene.height, : scene.width]
    y, x = torch.arange(scene.height)[:, None], torch.arange(scene.width)
    return (tiles & (y % TILE == 0) & (x % TILE == 0)).to(scene.means.device), tiles.to(scene.means.device)


def shown(images, tiles, background):
    """Full images, with the background alone outside of ``tiles``."""
    color, alpha, depth, features = images
    kept, behind = tiles[..., None], background[:, None, None].expand_as(color)
    return (
        torch.where(kept, color, behind),
        alpha.masked_fill(~tiles, 0),
        depth.masked_fill(~tiles, 0),
        features.masked_fill(~kept, 0),
    )


# ---- 1 forward, 2 backward -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("cutoff", ["exact", "tile3sigma", "smooth"])
def test_forward_and_backward(device, dtype, cutoff):
    scene = random_scene(n=300, sh_terms=4, dtype=dtype).to(device)
    active, tiles = some_tiles(scene)
    assert 0.2 < tiles.float().mean() < 0.8 and active.sum() < 0.02 * active.numel()
    for a, e in zip(
        scene.render(active=active, cutoff=cutoff),
        shown(scene.render(cutoff=cutoff), tiles, scene.background),
        strict=True,
    ):
        assert_same_bits(a, e)

    def of_whole(*inputs):
        return shown(scene.render(*inputs, cutoff=cutoff), tiles, inputs[6])

    masked = gradients(scene.render, scene, active=active, cutoff=cutoff)
    for name, a, e in zip(Scene.NAMES, masked, gradients(of_whole, scene), strict=True):
        assert e.abs().max() > 0
        if name == "background":  # summed in another order
            assert_close_relative_to_max(a, e, 1e-6, name)
        else:
            assert torch.equal(a, e), name


def test_against_the_oracle(device):
    scene = random_scene(n=60, sh_terms=1)
    active, tiles = some_tiles(scene)
    expected = shown(scene.render_oracle(), tiles, scene.background)
    for a, e in zip(scene.to(device).render(active=active.to(device)), expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")


def test_a_masked_loss_has_the_same_gradient(device):
    scene = random_scene(n=300, sh_terms=1, dtype=torch.float32).to(device)
    active, _ = some_tiles(scene)

    def loss(**options):
        leaves = [x.detach().clone().requires_grad_() for x in scene.inputs]
        error = (scene.render(*leaves, **options)[0].square().mean(-1) * active).sum()
        return error, *torch.autograd.grad(error, leaves, materialize_grads=True)

    for a, e in zip(loss(active=active), loss(), strict=True):
        assert torch.equal(a, e)


# ---- 3 gradcheck ---------------------------------------------------------------------------------------------------


def few(device):
    scene = random_scene(n=6, clouds=1, images=1, width=24, height=9, n_features=1, sh_terms=0, seed=3, spread=0.3)
    scene = scene.replace(scales=2 * scene.scales, background=0.5 * scene.background).to(device)
    active = torch.zeros(1, 9, 24, dtype=torch.bool, device=device)
    active[0, 2, 20] = True
    leaves = [x.clone().requires_grad_() for x in scene.inputs]
    cotangents = scene.cotangents()

    def mixed(*inputs):
        out = scene.render(*inputs, cutoff="smooth", active=active)
        return sum((c * x).sum() for c, x in zip(cotangents, out, strict=True))

    return mixed, leaves


@pytest.mark.unsanitized("runs the kernels of test_against_the_oracle thousands of times")
def test_gradcheck(device):
    assert torch.autograd.gradcheck(*few(device), atol=1e-6, nondet_tol=0.0)


def test_gradgradcheck():
    mixed, leaves = few("cpu")
    assert torch.autograd.gradgradcheck(mixed, leaves, atol=1e-5, fast_mode=True)


# ---- 4 CPU against CUDA --------------------------------------------------------------------------------------------


def test_devices_agree(devices):
    images, grads = [], []
    for device in devices:
        scene = random_scene(n=400, sh_terms=4, dtype=torch.float32).to(device)
        active, _ = some_tiles(scene)
        images.append(scene.render(active=active))
        grads.append(gradients(scene.render, scene, active=active))
    for a, e in zip(*images, strict=True):
        assert_close_relative_to_max(e, a, "raster_float32")
    for name, a, e in zip(Scene.NAMES, *grads, strict=True):
        assert_close_relative_to_max(e, a, "raster_grad_float32", name)


@pytest.mark.parametrize("limits", [(1, 1, 4), (2, 4, 8), (8, 64, 128)], ids=str)
def test_any_limits_and_a_cuda_graph(devices, limits):
    """Further groups of images, down to parts of one image, and a replay."""
    scene = random_scene(n=800, clouds=2, images=6, width=40, height=33, sh_terms=4, dtype=torch.float32, seed=8)
    scene = scene.replace(opacities=0.01 + 0.02 * scene.opacities, scales=8 * scene.scales).to(devices[1])
    leaves, args = [x.clone().requires_grad_() for x in scene.inputs], operator_args(scene)[8:-3]
    cotangents, sizes = scene.cotangents(), [factor * len(scene.means) for factor in limits]
    active, tiles = some_tiles(scene)
    every_tile = tiles[:, ::TILE, ::TILE].contiguous()

    def run():
        out = torch.ops.gsim3d.rasterize_gaussians(*leaves, *args, *sizes, False, every_tile)[:4]
        return [*out, *torch.autograd.grad(out, leaves, cotangents)]

    expected = [*scene.render(active=active), *gradients(scene.render, scene, active=active)]
    computed = [x.detach() for x in run()]
    for a, e in zip(computed, expected, strict=True):
        assert_close_relative_to_max(a, e, 1e-5)
    graph, results = captured(run)
    graph.replay()
    for a, e in zip(results, computed, strict=True):
        assert_same_bits(a, e)


# ---- 5 opcheck, 6 torch.compile ------------------------------------------------------------------------------------


def test_opcheck(device):
    scene = random_scene(n=8, images=2, clouds=2, width=20, height=7).to(device)
    args = (*operator_args(scene), False, torch.tensor([[[True, False]]] * 2, device=device))
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.rasterize_gaussians, args, test_utils=tests)


def test_compile_equals_eager(device):
    scene = random_scene(n=30, sh_terms=1, dtype=torch.float32).to(device)
    active, _ = some_tiles(scene)

    def images(active, *inputs):
        return scene.render(*inputs, active=active)[0]

    compiled, leaves = torch.compile(images, fullgraph=True), [x.clone().requires_grad_() for x in scene.inputs]
    value, expected = compiled(active, *leaves), images(active, *leaves)
    assert_same_bits(value, expected)
    for a, e in zip(
        torch.autograd.grad(value.square().sum(), leaves[:2]),
        torch.autograd.grad(expected.square().sum(), leaves[:2]),
        strict=True,
    ):
        assert_close_relative_to_max(a, e, 1e-6)


def test_vmap_over_scenes_and_masks(device):
    scene = random_scene(n=15, clouds=2, images=3, width=24, height=18, sh_terms=0, seed=3).to(device)
    masks = torch.stack([some_tiles(scene, seed)[0] for seed in range(3)])
    means = torch.stack([scene.means * (1 + 0.01 * b) for b in range(3)])

    def alpha(means, active):
        return scene.render(means, *scene.inputs[1:], active=active)[1]

    for in_dims in ((0, 0), (0, None)):
        active = masks if in_dims[1] == 0 else masks[0]
        together = vmap(alpha, in_dims)(means, active)
        slopes = vmap(torch.func.grad(lambda *x: alpha(*x).sum()), in_dims)(means, active)
        for b in range(3):
            one, leaf = active[b] if in_dims[1] == 0 else active, means[b].clone().requires_grad_()
            alone = alpha(leaf, one)
            assert_same_bits(together[b], alone)
            assert_close_relative_to_max(slopes[b], torch.autograd.grad(alone.sum(), leaf)[0], "raster_grad_float64")


# ---- 7 edges -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", [False, True])
def test_no_pixel_and_every_pixel(device, wanted):
    scene = random_scene(n=60, sh_terms=0).to(device)
    active = torch.full((4, scene.height, scene.width), wanted, device=device)
    expected = shown(scene.render(), active, scene.background)
    for a, e in zip(scene.render(active=active), expected, strict=True):
        assert_same_bits(a, e)
    means = gradients(scene.render, scene, active=active)[0]
    assert (means.abs().max() > 0) == wanted


def test_same_bits_for_any_threads():
    scene = random_scene(n=5000, sh_terms=4, dtype=torch.float32, seed=2)
    options = {"active": some_tiles(scene)[0]}
    assert_same_bits_for_any_threads(lambda: (*scene.render(**options), *gradients(scene.render, scene, **options)))


# ---- 8 error messages ----------------------------------------------------------------------------------------------


def test_messages():
    scene = random_scene(n=3)
    shape = f"{[4, scene.height, scene.width]}".replace("[", r"\[").replace("]", r"\]")
    for wrong in (torch.ones(4, scene.height, scene.width), torch.ones(3, scene.height, scene.width, dtype=torch.bool)):
        with pytest.raises(ValueError, match=rf"active must be bool \[I, H, W\] = {shape}; got torch"):
            scene.render(active=wrong)
    with pytest.raises(TypeError, match="active must be a tensor; got list"):
        scene.render(active=[True])
