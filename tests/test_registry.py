"""Every op in csrc/gsim3d/torch/schemas.cpp has a CPU kernel, a fake, and, where it has gradients, an autograd rule."""

import pytest
import torch

import gsim3d.ops  # noqa: F401

OPS = sorted({name.split(".")[0] for name in torch._C._dispatch_get_all_op_names() if name.startswith("gsim3d::")})
# positions or indices in, integers out, or nothing at all: nothing to differentiate
INTEGER_OPS = tuple(
    f"gsim3d::{name}"
    for name in (
        "curve_ build_pyramid sparse_conv_plan validate_state join_records row_scenes find_cells overlapping_patches"
    ).split()
)


def has_kernel(op: str, key: str) -> bool:
    return torch._C._dispatch_has_kernel_for_dispatch_key(op, key)


def needs_autograd(op: str) -> bool:
    return not op.startswith(INTEGER_OPS)


def is_gradient(op: str) -> bool:
    return "_backward" in op or "_grad_" in op or "_tangent" in op


def test_ops_are_found():
    assert "gsim3d::pool_max" in OPS and "gsim3d::sparse_conv_grad_weight" in OPS


@pytest.mark.parametrize("op", OPS)
def test_has_a_cpu_kernel(op):
    assert has_kernel(op, "CPU"), f"{op} is declared in schemas.cpp but no *_torch.cpp registers it"


@pytest.mark.parametrize("op", OPS)
def test_has_a_fake(op):
    assert has_kernel(op, "Meta"), f"{op} needs torch.library.register_fake in gsim3d/ops"


@pytest.mark.parametrize("op", OPS)
def test_has_an_autograd_rule_exactly_where_needed(op):
    assert has_kernel(op, "Autograd") == needs_autograd(op), f"{op}: register_gradients in gsim3d/ops"


@pytest.mark.parametrize("op", [op for op in OPS if needs_autograd(op) and not is_gradient(op)])
@pytest.mark.parametrize("device", ["CPU", "CUDA"])
def test_has_an_autocast_rule(op, device):
    """Without one the op meets the half-precision results of the layers around it, which most kernels do not take."""
    assert has_kernel(op, f"Autocast{device}"), f"{op}: torch.library.register_autocast in gsim3d/ops"


def test_a_missing_autograd_rule_is_an_error():
    """torch only warns and drops the gradient; the filter in pyproject.toml must match its text."""
    library = torch.library.Library("gsim3d_registry_test", "DEF")
    library.define("double(Tensor x) -> Tensor")
    library.impl("double", lambda x: x * 2, "CPU")
    y = torch.ops.gsim3d_registry_test.double(torch.ones(2, requires_grad=True))
    with pytest.raises(UserWarning, match="autograd kernel was not registered"):
        y.sum().backward()
