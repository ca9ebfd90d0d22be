"""The self-test of gsim3d doctor covers every op, and notices one that computes wrongly."""

import dataclasses
from pathlib import Path

import pytest
import torch

from gsim3d import ops
from gsim3d.ops import selftest

CORE = Path(__file__).parents[2] / "csrc" / "gsim3d"


def test_every_op_is_tested():
    assert set(selftest.CHECKS) == {file.name.removesuffix("_torch.cpp") for file in CORE.glob("*/*_torch.cpp")}


@pytest.mark.parametrize("name", selftest.CHECKS)
def test_ops_pass(name, device):
    assert selftest.CHECKS[name](str(device)) <= selftest.TOLERANCE


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
        ("sentinel", "watch_rows"),
    ],
)
def test_an_op_that_computes_wrongly_is_noticed(monkeypatch, check, op):
    right = getattr(ops, op)

    def wrong(*args, **options):
        found = right(*args, **options)
        return found._replace(status=found.status + 1) if op == "watch_rows" else _off(found)

    monkeypatch.setattr(ops, op, wrong)
    with pytest.raises(AssertionError):
        selftest.CHECKS[check]("cpu")
