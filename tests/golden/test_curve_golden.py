"""Codes, orders and patches of the published model, bit for bit (a_*, b_*; stages of d_*, e_*, f_* in their tests)."""

import pytest
import torch

from gsim3d.ops import CURVES, PyramidSpec, build_pyramid, curve_encode, curve_sort
from tests.golden.published import assert_published_patches, cloud_table
from tests.golden_files import golden

pytestmark = pytest.mark.golden


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("depth", [4, 10, 16])
def test_codes(depth, curve):
    arrays = golden("a_serialization") / f"d{depth}"
    grid = arrays["grid_coord"].long()
    assert torch.equal(curve_encode(grid, None, curve, depth=depth), arrays[f"{curve}/code_nobatch"])
    codes = curve_encode(grid, arrays["batch"], curve, depth=depth, shift=3 * depth + 10)
    assert torch.equal(codes, arrays[f"{curve}/code_batch"])
    assert torch.equal(curve_sort(codes[None])[0][0], arrays[f"{curve}/argsort_stable"])


def test_point_serialization():
    arrays = golden("a_point_serialization")
    xyz, depth = arrays["xyz"], int(arrays["depth"])
    spec = PyramidSpec(float(arrays["grid_size"]), int(arrays["time_depth"]), (), (), (32,), ((3,),), release=True)
    n_scenes, n_steps, n, _ = xyz.shape
    cu_rows, origin = torch.arange(n_scenes * n_steps + 1) * n, torch.zeros(n_scenes, 3, dtype=torch.float64)
    (stage,) = build_pyramid(xyz.reshape(-1, 3), cu_rows, *cloud_table(xyz), origin, spec).stages
    assert torch.equal(stage.grid, arrays["grid_coord"].long())
    assert torch.equal(stage.cloud, arrays["batch"])
    assert torch.equal(stage.cu_clouds[1:], arrays["offset"])
    scene, step = (t.repeat_interleave(n) for t in cloud_table(xyz))
    assert torch.equal(scene << int(arrays["time_depth"]) | step, arrays["batch_time_coord"].long())
    codes = [curve_encode(stage.grid, stage.cloud, curve, depth=depth, shift=3 * depth + 10) for curve in CURVES]
    assert torch.equal(torch.stack(codes), arrays["code"])
    assert torch.equal(stage.order, arrays["order"])
    assert torch.equal(curve_sort(torch.stack(codes))[1], arrays["inverse"])


PATCH_CASES = [f"K32_case{i}" for i in range(7)] + ["K1024_case0", "K1024_case1"]


@pytest.mark.parametrize("case", PATCH_CASES)
def test_patches(case):
    arrays = golden("b_patch_padding") / case
    counts = arrays["bincount"].tolist()
    patch_size, n = int(case[1 : case.index("_")]), sum(counts)
    # Every cloud runs along x, so sorted positions are rows.
    x = torch.cat([torch.arange(count) for count in counts]).double()
    positions = torch.stack([x, torch.zeros(n).double(), torch.zeros(n).double()], 1)
    clouds = len(counts)
    pyramid = build_pyramid(
        positions,
        torch.tensor([0, *counts]).cumsum(0),
        torch.arange(clouds),
        torch.zeros(clouds, dtype=torch.int64),
        torch.full((clouds, 3), -0.5, dtype=torch.float64),
        PyramidSpec(1.0, 0, (), (), (patch_size,), ((),)),
    )
    assert_published_patches(pyramid.stages[0].patches[0], torch.arange(n), arrays)
