"""Memory formats of feature maps change no number; other views are the following ones."""

import pytest
import torch

from gsim3d.nn.multiview_encoder import layout
from gsim3d.nn.multiview_encoder.layout import by_pixel, for_convolution
from gsim3d.nn.multiview_encoder.transformer import other_views
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.nn.multiview_encoder.scenes import ROW_FIELDS, make_encoder, make_frames

FORMATS = (torch.contiguous_format, torch.channels_last)


def results(device, dtype):
    """Particles of two clouds and the gradients of all weights."""
    encoder = make_encoder().to(device)
    with torch.autocast(device.type, dtype or torch.bfloat16, enabled=dtype is not None):
        particles = encoder(make_frames([0, 0, 0, 1, 1, 1]).to(device))
    fields = [getattr(particles, name) for name in ROW_FIELDS]
    g = torch.Generator().manual_seed(0)
    loss = sum((field * torch.randn(field.shape, generator=g).to(field)).sum() for field in fields)
    return fields, torch.autograd.grad(loss, list(encoder.parameters()))


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_layout_changes_no_number(dtype, device, monkeypatch):
    """On the CPU as if it were a GPU."""
    if device.type == "cpu" and dtype is not None:
        pytest.skip("layouts follow a GPU's autocast")
    monkeypatch.setattr(layout, "_matters", lambda x: False)
    fields, grads = results(device, dtype)
    moved = []
    monkeypatch.setattr(layout, "_matters", lambda x: moved.append(x.shape) or True)
    fields_moved, grads_moved = results(device, dtype)
    assert len(moved) > 20
    tolerance = 1e-5 if dtype is None else 3e-2
    for a, b in zip(fields_moved, fields, strict=True):
        assert_close_relative_to_max(a, b, tolerance)
    largest = max(grad.abs().max() for grad in grads)
    assert max((a - b).abs().max() for a, b in zip(grads_moved, grads, strict=True)) <= tolerance * largest


@pytest.mark.parametrize("move, kept", [(for_convolution, None), (by_pixel, torch.float32)])
@pytest.mark.parametrize("given", FORMATS)
def test_gradients_come_back_as_the_input_lies(move, kept, given, device, monkeypatch):
    monkeypatch.setattr(layout, "_matters", lambda x: True)
    x = torch.randn(2, 3, 4, 5, device=device).contiguous(memory_format=given).requires_grad_()
    with torch.autocast("cuda", torch.bfloat16, enabled=device.type == "cuda"):
        y = move(x)
    assert y.is_contiguous(memory_format=torch.channels_last)
    assert y.dtype == (kept or (torch.bfloat16 if device.type == "cuda" else torch.float32))
    assert_same_bits(y.detach(), x.detach().to(y.dtype))
    grads = []
    x.register_hook(grads.append)
    (y * 2).sum().backward()
    assert grads[0].is_contiguous(memory_format=given) and torch.equal(x.grad, torch.full_like(x, 2))


@pytest.mark.parametrize("n_views", [2, 3, 5])
def test_other_views_are_the_next_ones(n_views, device):
    n, windows, length, dim = 2, 4, 3, 2
    x = torch.randn(n * n_views, windows, length, dim, device=device, requires_grad=True)
    clouds = x.unflatten(0, (n, n_views))
    wanted = torch.stack(
        [torch.cat([clouds[:, (v + k) % n_views] for k in range(1, n_views)], 2) for v in range(n_views)], 1
    ).flatten(0, 1)
    actual = other_views(x, n_views)
    assert_same_bits(actual.detach(), wanted.detach())
    cotangent = torch.randn_like(wanted)
    a, b = (torch.autograd.grad(y, x, cotangent, retain_graph=True)[0] for y in (actual, wanted))
    torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)
