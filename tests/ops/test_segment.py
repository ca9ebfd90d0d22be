"""segment_sum, segment_min and segment_softmax against loops."""

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from gsim3d import ops
from gsim3d.errors import NumericalError

pytestmark = pytest.mark.usefixtures("one_thread")
CU = torch.tensor([0, 3, 3, 7])  # the second is empty; rows 7 and 8 are in none
OPS = {"segment_sum": ops.segment_sum, "segment_min": ops.segment_min, "segment_softmax": ops.segment_softmax}
EVERY_OP = pytest.mark.parametrize("op", OPS)


def rows(dtype=torch.float64) -> torch.Tensor:
    return torch.randn(9, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def loop(op: str, x: torch.Tensor) -> torch.Tensor:
    parts = [x[a:b] for a, b in zip(CU[:-1].tolist(), CU[1:].tolist(), strict=True)]
    if op == "segment_softmax":
        return torch.cat([*(part.softmax(0) for part in parts), torch.zeros_like(x[7:])])
    zero = x.new_zeros(x.shape[1])
    return torch.stack([(p.sum(0) if op == "segment_sum" else p.amin(0)) if len(p) else zero for p in parts])


@EVERY_OP
def test_forward(op, device):
    x = rows().to(device)
    torch.testing.assert_close(OPS[op](x, CU.to(device)).cpu(), loop(op, rows()))


@EVERY_OP
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_16_bit_rows_are_computed_in_float32(op, dtype, device):
    x, cu = rows(dtype).to(device), CU.to(device)
    assert torch.equal(OPS[op](x, cu), OPS[op](x.float(), cu).to(dtype))


@EVERY_OP
def test_gradient_equals_that_of_the_loop(op, device):
    x, cotangent = rows(), rows().cos()[: len(loop(op, rows()))]
    (expected,) = torch.autograd.grad(loop(op, x.requires_grad_()), x, cotangent)
    moved = rows().to(device).requires_grad_()
    (found,) = torch.autograd.grad(OPS[op](moved, CU.to(device)), moved, cotangent.to(device))
    torch.testing.assert_close(found.cpu(), expected)


@EVERY_OP
def test_gradients_against_finite_differences(op, device):
    x, cu = rows().to(device).requires_grad_(), CU.to(device)
    assert gradcheck(lambda x: OPS[op](x, cu), x, check_forward_ad=True)
    assert gradgradcheck(lambda x: OPS[op](x, cu), x)


@EVERY_OP
def test_vmap_equals_a_loop(op, device):
    x, cu = torch.stack([rows(), rows() + 1]).to(device), CU.to(device)
    expected = torch.stack([OPS[op](each, cu) for each in x])
    torch.testing.assert_close(torch.vmap(lambda each: OPS[op](each, cu))(x), expected)


@EVERY_OP
def test_compiled(op):
    compiled = torch.compile(OPS[op], fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(rows(), CU), OPS[op](rows(), CU))


@EVERY_OP
def test_large_scores_and_no_rows(op, device):
    x, cu = torch.linspace(0, 1e4, 9, device=device)[:, None], CU.to(device)
    assert OPS[op](x, cu).isfinite().all()
    assert OPS[op](x[:0], cu[:1]).shape == (0, 1)


@EVERY_OP
def test_equal_bits_for_any_number_of_threads(op):
    x, cu = torch.randn(20000, 8), torch.arange(0, 20001, 40)
    expected = OPS[op](x, cu)
    torch.set_num_threads(3)
    assert torch.equal(OPS[op](x, cu), expected)


@EVERY_OP
def test_errors(op):
    for cu in ([1, 2], [0, 10], [0, 3, 2]):
        with pytest.raises(ValueError, match=f"{op}: cu_rows must ascend from 0"):
            OPS[op](rows(), torch.tensor(cu))
    with pytest.raises(ValueError, match=f"{op}: cu_rows must be an int64 list"):
        OPS[op](rows(), CU.int())
    with pytest.raises(ValueError, match=f"{op}: cu_rows must be an int64 list"):
        OPS[op](rows(), CU[:0])
    for x in (rows()[0], rows().long()):
        with pytest.raises(ValueError, match=f"{op}: x must be"):
            OPS[op](x, CU)
    with pytest.raises(NumericalError, match=f"{op}: x must be finite"):
        OPS[op](rows().fill_(torch.nan), CU)
