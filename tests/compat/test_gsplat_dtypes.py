"""gsplat's call: what is cast, and what is not under autocast."""

import math

import pytest
import torch

from gsim3d.compat.gsplat import rasterization
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.compat.gsplat_scene import SIZE, scene_of


def test_cameras_are_cast_to_the_dtype_of_the_means():
    arguments = scene_of(dtype=torch.float32) | {"colors": torch.randn(40, 4, 3)}
    expected = rasterization(**arguments, **SIZE, sh_degree=1)[0]
    cameras = {name: arguments[name].double() for name in ("viewmats", "Ks")}
    assert_same_bits(rasterization(**arguments | cameras, **SIZE, sh_degree=1)[0], expected)
    images = [
        rasterization(**arguments, **SIZE, sh_degree=1, radial_coeffs=torch.full((2, 6), 0.125).to(dtype))[0]
        for dtype in (torch.float32, torch.float64)
    ]
    assert_same_bits(*images)


@pytest.mark.parametrize("sh_degree", [None, 1])
def test_16_bit_rows_under_autocast_leave_cameras_as_they_are(sh_degree):
    arguments = scene_of(dtype=torch.float32)
    arguments["colors"] = torch.rand(40, 4, 3)[:, : 4 if sh_degree else 1].squeeze(1)
    rows = {name: x.bfloat16() for name, x in arguments.items() if name not in ("viewmats", "Ks")}
    expected, *_ = rasterization(**arguments | {k: x.float() for k, x in rows.items()}, **SIZE, sh_degree=sh_degree)
    wide, *_ = rasterization(**arguments, **SIZE, sh_degree=sh_degree)
    with torch.autocast("cpu", torch.bfloat16):
        color, *_ = rasterization(**arguments | rows, **SIZE, sh_degree=sh_degree)
        again, *_ = rasterization(**arguments, **SIZE, sh_degree=sh_degree)
    assert_close_relative_to_max(color, expected, 1e-6)
    assert_same_bits(again, wide)


WRONG = [
    ({"width": 0}, "width and height must be"), ({"height": 70_000}, "width and height must be"),
    ({"near_plane": -1.0}, "near_plane must not be negative"), ({"far_plane": 0.0}, "near_plane must not be negative"),
    ({"far_plane": "x"}, "far_plane must be a number"), ({"radius_clip": math.nan}, "radius_clip must be finite"),
    ({"Ks": torch.zeros(2, 3, 3, dtype=torch.float64)}, "focal lengths in Ks must be positive"),
    ({"viewmats": torch.full((2, 4, 4), 1e20, dtype=torch.float64)}, "viewmats"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "message"), WRONG, ids=[next(iter(given)) for given, _ in WRONG])
def test_errors_of_cameras_size_and_planes_name_the_call(given, message):
    with pytest.raises((ValueError, TypeError), match=f"^rasterization: {message}"):
        rasterization(**scene_of() | SIZE | given)
