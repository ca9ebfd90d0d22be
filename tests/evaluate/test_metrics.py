"""PSNR and SSIM against independent float64 references, and their edges."""

import math

import numpy as np
import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.evaluate.metrics import PSNR_CAP, mean_of_counted, psnr, ssim
from tests.oracle.metrics import psnr_reference, ssim_reference


def images(seed, *shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_psnr_equals_its_definition():
    pred, target = images(0, 3, 9, 7, 3), images(1, 3, 9, 7, 3)
    mask = images(2, 3, 9, 7) > 0.6
    for chosen in (None, mask):
        for i in range(3):
            expected = psnr_reference(pred[i].numpy(), target[i].numpy(), None if chosen is None else mask[i].numpy())
            assert psnr(pred, target, chosen)[i].item() == pytest.approx(expected, abs=1e-9)


def test_psnr_is_capped_and_an_empty_mask_is_not_counted():
    image = images(0, 2, 4, 4, 3)
    assert psnr(image, image).tolist() == [PSNR_CAP, PSNR_CAP]
    mask = torch.zeros(2, 4, 4, dtype=torch.bool)
    mask[0, 0, 0] = True
    values = psnr(image, image, mask)
    assert values[0] == PSNR_CAP and values[1].isnan()
    assert mean_of_counted(values) == PSNR_CAP
    assert mean_of_counted(values[1:]) is None


def test_psnr_of_a_known_error():
    target = torch.full((1, 5, 5, 3), 0.5)
    assert psnr(target + 0.1, target).item() == pytest.approx(20.0, abs=1e-5)
    assert psnr(target + 0.5, target).item() == pytest.approx(-20 * math.log10(0.5), abs=1e-9)


def test_ssim_equals_its_definition():
    pred, target = images(3, 2, 17, 13, 3), images(4, 2, 17, 13, 3)
    pred[1] = 0.95 * target[1] + 0.05 * pred[1]
    for i in range(2):
        expected = ssim_reference(pred[i].numpy().astype(np.float64), target[i].numpy().astype(np.float64))
        assert ssim(pred, target)[i].item() == pytest.approx(expected, abs=1e-10)


def test_ssim_edges():
    image = images(5, 1, 11, 11, 3)
    assert ssim(image, image).item() == pytest.approx(1.0, abs=1e-12)
    flat = torch.full((1, 12, 12, 1), 0.3)
    assert ssim(flat, flat).item() == pytest.approx(1.0, abs=1e-12)
    with pytest.raises(ValueError, match="at least 11"):
        ssim(image[:, :10], image[:, :10])


def test_shapes_are_checked():
    image = images(6, 1, 12, 12, 3)
    with pytest.raises(ValueError, match="images must both be"):
        psnr(image, image[:, :5])
    with pytest.raises(ValueError, match="mask must be bool"):
        psnr(image, image, torch.ones(1, 12, 12))


METRICS = (psnr, ssim)
BAD = {
    "as_bytes": lambda x: x * 255,
    "slightly_above": lambda x: x + 1e-3 * (x == x.max()) + (1 - x.max()),
    "below": lambda x: x - 0.5,
    "nan": lambda x: torch.where(x == x.max(), torch.nan, x),
    "inf": lambda x: torch.where(x == x.max(), torch.inf, x),
    "int64": lambda x: (x * 255).long(),
    "int8": lambda x: (x * 100).to(torch.int8),
    "cast_to_bytes": lambda x: x.round().to(torch.uint8),
    "uint16": lambda x: (x * 65535).to(torch.int32).to(torch.uint16),
    "bool": lambda x: x > 0.5,
    "complex": lambda x: x.to(torch.complex64),
    "numpy": lambda x: x.numpy(),
}


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("what", BAD)
def test_images_of_another_range_or_dtype_are_refused(metric, what):
    good = images(0, 2, 12, 13, 3)
    bad = BAD[what](good)
    for arguments, name in (((bad, good), "pred"), ((good, bad), "target")):
        with pytest.raises(InputError, match=f"^{name}: (colours (must be in|are 0 and 1 of 255)|must be)"):
            metric(*arguments)


@pytest.mark.parametrize("metric", METRICS)
def test_bytes_are_scaled_and_every_float_is_read(metric):
    a, b = ((255 * images(seed, 2, 12, 13, 3)).to(torch.uint8) for seed in (0, 1))
    expected = metric(a / 255, b / 255)
    assert torch.equal(metric(a, b), expected) and torch.equal(metric(a, b / 255), expected)
    assert expected.max() < 20
    for dtype, tolerance in ((torch.float16, 1e-2), (torch.bfloat16, 0.1), (torch.float64, 1e-6)):
        assert torch.allclose(metric((a.double() / 255).to(dtype), b), expected, rtol=tolerance, atol=tolerance)
    rounded = (a / 255) * (1 + 1e-7)
    assert torch.allclose(metric(rounded, b), expected, rtol=1e-5)


def test_images_without_pixels_are_refused():
    for shape in ((1, 0, 12, 3), (1, 12, 12, 0)):
        with pytest.raises(InputError, match="images must both be"):
            psnr(torch.zeros(shape), torch.zeros(shape))
    assert psnr(torch.zeros(0, 4, 4, 3), torch.zeros(0, 4, 4, 3)).shape == (0,)


# structural_similarity of scikit-image 0.26 (gaussian_weights, sigma 1.5, win_size 11, data_range 1, channel_axis 2).
SCIKIT_IMAGE = [-0.021749193141947943, 0.9751051739546357]


def test_ssim_equals_scikit_image():
    i, y, x, c = np.meshgrid(np.arange(2), np.arange(48), np.arange(64), np.arange(3), indexing="ij")
    a, b = (0.5 + 0.5 * np.sin(0.37 * (s + 1) * y + 0.21 * (c + 1) * x + 0.9 * i + s) for s in (0, 1))
    b[1] = 0.9 * a[1] + 0.1 * b[1]
    assert ssim(torch.from_numpy(b), torch.from_numpy(a)).tolist() == pytest.approx(SCIKIT_IMAGE, abs=1e-12)
