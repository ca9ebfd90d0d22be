"""Sparse convolution against spconv 2.3.8 (no duplicates) and the lowest-row rule of the published model's goldens."""

import pytest
import torch

from gsim3d.ops import KernelMap, Voxels, sparse_conv
from tests.asserts import assert_close_relative_to_max, gradients
from tests.golden_files import golden
from tests.oracle.sparse_conv import kernel_tables, racing_conv

pytestmark = pytest.mark.golden
CASES = [f"k{k}_{dup}_{bias}" for k in (3, 5) for dup in ("nodup", "dup") for bias in ("bias", "nobias")]


def inputs_of(case, device="cpu"):
    weight = case["weight"].to(device)
    tables = [table.to(device) for table in kernel_tables(case["indices"].long(), weight.shape[1])]
    bias = [case["bias"].to(device)] if "bias" in case else []
    return [case["features"].to(device), weight, *bias], Voxels(*tables[:3]), KernelMap(weight.shape[1], *tables[3:])


@pytest.mark.parametrize("name", CASES)
def test_lowest_row_rule_and_its_gradients(name, device):
    case = golden("c_submconv3d") / name
    inputs, voxels, kernel_map = inputs_of(case, device)

    def conv(x, weight, bias=None):
        return sparse_conv(x, weight, bias, voxels, kernel_map, duplicates="first")

    out, grad_x, grad_weight, *_ = gradients(conv, inputs, case["cotangent"])
    assert_close_relative_to_max(out, case["out_simple"], "golden_float32", "result")
    assert_close_relative_to_max(grad_x, case["grad_features_simple"], "golden_float32", "gradient of the features")
    assert_close_relative_to_max(grad_weight, case["grad_weight_simple"], "golden_float32", "gradient of the weight")


@pytest.mark.parametrize("name", [name for name in CASES if "nodup" in name])
@pytest.mark.parametrize("duplicates", ["mean", "first"])
def test_equals_spconv_without_duplicates(name, duplicates, device):
    case = golden("c_submconv3d") / name
    inputs, voxels, kernel_map = inputs_of(case, device)
    x, weight, bias = [*inputs, None][:3]
    out = sparse_conv(x, weight, bias, voxels, kernel_map, duplicates=duplicates)
    assert torch.equal(voxels.cu_rows.cpu(), torch.arange(len(x) + 1))
    assert_close_relative_to_max(out, case["spconv_cpu_out"], "golden_float32")


@pytest.mark.parametrize("name", [name for name in CASES if "_dup_" in name])
@pytest.mark.parametrize("rule", ["native", "implicit"])
def test_racing_rules_of_the_oracle(name, rule):
    """The rules under which whole networks are compared; "native" is what spconv computes on one thread."""
    case = golden("c_submconv3d") / name
    inputs, voxels, kernel_map = inputs_of(case)

    def conv(x, weight, bias=None):
        return racing_conv(x, weight, bias, voxels, kernel_map, rule)

    out, grad_x, grad_weight, *_ = gradients(conv, inputs, case["cotangent"])
    assert_close_relative_to_max(out, case[f"out_{rule}"], "golden_float32", "result")
    assert_close_relative_to_max(grad_x, case[f"grad_features_{rule}"], "golden_float32", "gradient of the features")
    assert_close_relative_to_max(grad_weight, case[f"grad_weight_{rule}"], "golden_float32", "gradient of the weight")
    if rule == "native":
        assert_close_relative_to_max(out, case["spconv_cpu_out"], "golden_float32", "spconv")
