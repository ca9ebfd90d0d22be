"""Codes, orders, patches, pooling and merging of the published model, bit for bit."""

import numpy as np
import pytest
import torch

from gsim3d.ops import CURVES, PyramidSpec, build_pyramid, curve_encode, curve_sort
from tests.golden_files import golden

pytestmark = pytest.mark.golden


def published_geometry(xyz, spec):
    """The pyramid of clouds [B, T, N, 3] as the published model makes it."""
    B, T, N, _ = xyz.shape
    return build_pyramid(
        xyz.reshape(-1, 3),
        torch.arange(B * T + 1) * N,
        torch.arange(B).repeat_interleave(T),
        torch.arange(T).repeat(B),
        torch.zeros(B, 3, dtype=torch.float64),
        spec,
    )


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
    depth = int(arrays["depth"])
    spec = PyramidSpec(float(arrays["grid_size"]), int(arrays["time_depth"]), (), (), (32,), ((3,),), release=True)
    (stage,) = published_geometry(arrays["xyz"], spec).stages
    assert torch.equal(stage.grid, arrays["grid_coord"].long())
    assert torch.equal(stage.cloud, arrays["batch"])
    assert torch.equal(stage.cu_clouds[1:], arrays["offset"])
    codes = [curve_encode(stage.grid, stage.cloud, curve, depth=depth, shift=3 * depth + 10) for curve in CURVES]
    assert torch.equal(torch.stack(codes), arrays["code"])
    assert torch.equal(stage.order, arrays["order"])
    assert torch.equal(curve_sort(torch.stack(codes))[1], arrays["inverse"])


PATCH_CASES = [f"K32_case{i}" for i in range(7)] + ["K1024_case0", "K1024_case1"]


@pytest.mark.parametrize("case", PATCH_CASES)
def test_patches(case):
    arrays = golden("b_patch_padding") / case
    counts, pad, unpad = arrays["bincount"].tolist(), arrays["pad"], arrays["unpad"]
    n = sum(counts)
    patch_size = int(case[1 : case.index("_")])
    # Every cloud runs along x, so sorted positions are rows.
    x = torch.cat([torch.arange(count) for count in counts]).double()
    positions = torch.stack([x, torch.zeros(n).double(), torch.zeros(n).double()], 1)
    clouds = len(counts)
    pyramid = build_pyramid(
        positions,
        torch.tensor(np.concatenate([[0], np.cumsum(counts)])),
        torch.arange(clouds),
        torch.zeros(clouds, dtype=torch.int64),
        torch.full((clouds, 3), -0.5, dtype=torch.float64),
        PyramidSpec(1.0, 0, (), (), (patch_size,), ((),)),
    )
    table = pyramid.stages[0].patches[0]
    assert torch.equal(table.q_rows, torch.arange(n))
    sequences = [pad[a:b] for a, b in torch.stack([arrays["cu_seqlens"][:-1], arrays["cu_seqlens"][1:]], 1).tolist()]
    read = [table.kv_rows[a:b] for a, b in torch.stack([table.cu_k[:-1], table.cu_k[1:]], 1).tolist()]
    assert [sequence.sort().values.tolist() for sequence in sequences] == [keys.tolist() for keys in read]
    patch_of_row = torch.repeat_interleave(torch.arange(len(read)), table.cu_q.diff())
    sequence_of_slot = torch.repeat_interleave(torch.arange(len(sequences)), arrays["cu_seqlens"].diff().long())
    assert torch.equal(sequence_of_slot[unpad], patch_of_row)


@pytest.mark.parametrize("window", [1, 2, 4, 8])
@pytest.mark.parametrize("stride", [2, 4])
@pytest.mark.parametrize("points", ["nodup", "dup"])
def test_pooling_and_merging(points, stride, window):
    arrays = golden(f"d_pooling_merger_{points}")
    before, pooled = arrays / "point_in", arrays / f"pool{stride}" / "out"
    after = arrays / f"pool{stride}" / f"merge{window}" / "out"
    time_bits = int(before["time_depth"])
    spec = PyramidSpec(
        float(arrays["grid_size"]), time_bits, (stride,), (window,), (32, 32), ((), ()), release=True
    )
    first, second = published_geometry(arrays["in/xyz"], spec).stages
    assert torch.equal(first.order, before["serialized_order"])
    members = torch.empty(first.n_rows, dtype=torch.int64)
    members[second.cluster.rows] = torch.repeat_interleave(torch.arange(second.n_rows), second.cluster.cu_rows.diff())
    assert torch.equal(members, pooled["pooling_inverse"])
    assert torch.equal(second.grid, after["grid_coord"].long())
    assert torch.equal(second.cloud, after["batch"])
    assert torch.equal(second.cu_clouds[1:], after["offset"])
    assert torch.equal(second.order, after["serialized_order"])
    merged = time_bits - int(after["time_depth"])
    assert (second.time_index is not None) == (merged > 0)
    if merged:
        assert torch.equal(second.time_index, pooled["batch_time_coord"].long() % 2**merged)
