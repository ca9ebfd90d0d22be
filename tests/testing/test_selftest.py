"""The self-test of gsim3d doctor covers every op, and notices one that computes wrongly; ops equal plain torch."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsim3d import ops
from gsim3d.testing import selftest
from tests.testing import plain_torch

# What a fused network calls itself (tests/nn/test_fused_block.py), a GPU alone needs, and derivatives along tangents.
TANGENTS = {"rasterize_gaussians_tangent", "rasterize_gaussians_backward_tangent"}
NOT_ALONE = {"patch_attention_backward_packed", "sparse_conv_plan"} | TANGENTS
CORE = Path(__file__).parents[2] / "csrc" / "gsim3d"


def test_every_op_is_tested():
    files = {file.name.removesuffix("_torch.cpp") for file in CORE.glob("*/*_torch.cpp")}
    assert set(selftest.CHECKS) == set(selftest.ANSWERS) == files


class Called(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.namespace == "gsim3d":
            self.names.add(function._schema.name.removeprefix("gsim3d::"))
        return function(*args, **(kwargs or {}))


def test_every_registered_op_is_called_forward_and_backward():
    names = {name.split(".")[0] for name in torch._C._dispatch_get_all_op_names() if name.startswith("gsim3d::")}
    with Called() as called:
        for name in selftest.CHECKS:
            selftest.check(name, "cpu")
    assert called.names == {name.removeprefix("gsim3d::") for name in names} - NOT_ALONE


@pytest.mark.parametrize("name", selftest.CHECKS)
def test_ops_pass(name, device):
    assert selftest.check(name, str(device)) <= selftest.TOLERANCE
    assert plain_torch.CHECKS[name](str(device)) <= plain_torch.TOLERANCE


def _off(value):
    if isinstance(value, torch.Tensor):
        return value + 1
    if isinstance(value, ops.PatchTable):
        return dataclasses.replace(value, q_rows=value.q_rows + 1)
    return type(value)(map(_off, value))


@pytest.mark.parametrize(
    "check, op",
    [
        ("decode", "decode_gaussians"),
        ("background", "find_cells"),
        ("background", "row_scenes"),
        ("background", "add_cells"),
        ("background", "overlapping_patches"),
        ("validate_state", "validate_state"),
        ("patch_attn", "joint_attention"),
        ("row_norm", "residual_norm"),
        ("row_norm", "norm_gelu"),
    ],
)
def test_op_that_computes_wrongly_is_noticed(monkeypatch, check, op):
    right = getattr(ops, op)

    def wrong(*args, **options):
        found = right(*args, **options)
        return found._replace(status=found.status + 1) if op == "validate_state" else _off(found)

    monkeypatch.setattr(ops, op, wrong)
    with pytest.raises((AssertionError, ValueError)):  # an op may refuse what the wrong one made
        selftest.check(check, "cpu")
    with pytest.raises(AssertionError):
        plain_torch.CHECKS[check]("cpu")
