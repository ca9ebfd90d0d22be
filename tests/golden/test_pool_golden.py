"""Pooling against the published model's SerializedPooling, given its clusters."""

import pytest
import torch

from gsim3d.ops import pool_max, pool_mean, unpool
from tests.asserts import assert_close_relative_to_max
from tests.golden_files import golden

pytestmark = pytest.mark.golden


@pytest.mark.parametrize("stride", [2, 4])
@pytest.mark.parametrize("file", ["d_pooling_merger_nodup", "d_pooling_merger_dup"])
def test_features_and_positions_of_clusters(file, stride):
    case = golden(file)
    stage = case / f"pool{stride}"
    cluster = stage["out/pooling_inverse"]
    rows = torch.argsort(cluster, stable=True)
    cu_rows = torch.cat([torch.zeros(1, dtype=torch.int64), torch.cumsum(torch.bincount(cluster), 0)])

    w = stage / "w"
    x = torch.nn.functional.linear(case["point_in/feat"], w["proj.weight"], w["proj.bias"])
    x = pool_max(x, rows, cu_rows)
    norm = [w[f"norm.0.{name}"] for name in ("running_mean", "running_var", "weight", "bias")]
    x = torch.nn.functional.gelu(torch.nn.functional.batch_norm(x, *norm, eps=1e-3))
    assert_close_relative_to_max(x, stage["out/feat"], "golden_float32", "features")

    positions = pool_mean(case["point_in/coord"], rows, cu_rows)
    assert_close_relative_to_max(positions, stage["out/coord"], "golden_float32", "positions")
    assert torch.equal(unpool(x, rows, cu_rows, len(cluster)), x[cluster])
