"""Higher derivatives and the transforms of torch.func, against finite differences and plain loops in float64."""

import functools

import pytest
import torch
from torch.autograd import forward_ad, gradcheck, gradgradcheck

from gsim3d import ops

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")
OPS = ("pool_max", "pool_mean", "unpool", "sparse_conv", "patch_attention")
EVERY_OP = pytest.mark.parametrize("op", OPS)


def values(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@functools.cache
def calls(device: torch.device) -> dict:
    """Of each op a function and its inputs."""
    # Row 2 is in no segment, the second is empty.
    rows, cu = torch.tensor([4, 0, 3, 1, 5, 2], device=device), torch.tensor([0, 2, 2, 5], device=device)
    keys, cu_keys = torch.tensor([0, 3, 3, 1, 2, 4], device=device), torch.tensor([0, 3, 4, 6], device=device)
    table = ops.PatchTable(rows, keys, cu, cu_keys)
    zero, origin = torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.float64)
    clouds = (x.to(device) for x in (values(6, 3), torch.tensor([0, 6]), zero, zero, origin))
    stage = ops.build_pyramid(*clouds, ops.PyramidSpec(0.4, 0, (), (), (4,), ((3,),))).stages[0]
    made = {
        "pool_max": (lambda x: ops.pool_max(x, rows, cu), [values(6, 3)]),
        "pool_mean": (lambda x: ops.pool_mean(x, rows, cu), [values(6, 3)]),
        "unpool": (lambda x: ops.unpool(x, rows, cu, 6), [values(3, 3)]),
        "sparse_conv": (
            lambda x, w, b: ops.sparse_conv(x, w, b, stage.voxels, stage.kernel_maps[3]),
            [values(6, 2), values(3, 3, 3, 3, 2), values(3)],
        ),
        "patch_attention": (
            lambda q, k, v: ops.patch_attention(q, k, v, table),
            [values(6, 2, 4), values(5, 2, 4, seed=1), values(5, 2, 4, seed=2)],
        ),
    }
    return {op: (function, [x.to(device) for x in inputs]) for op, (function, inputs) in made.items()}


def leaves(inputs):
    return [x.clone().requires_grad_() for x in inputs]


@EVERY_OP
def test_second_derivatives_and_forward_mode_against_finite_differences(op, device):
    function, inputs = calls(device)[op]
    assert gradcheck(function, leaves(inputs), check_forward_ad=True, check_batched_grad=True)
    assert gradgradcheck(function, leaves(inputs))


@EVERY_OP
def test_third_derivatives_against_finite_differences(op, device):
    function, inputs = calls(device)[op]

    def gradient(*xs):
        return torch.autograd.grad(function(*xs).pow(3).sum(), xs, create_graph=True)

    assert gradgradcheck(gradient, leaves(inputs), raise_exception=True, fast_mode=True)


@EVERY_OP
def test_transforms_equal_autograd(op, device):
    function, inputs = calls(device)[op]

    def loss(*xs):
        return function(*xs).pow(2).sum()

    arguments = tuple(range(len(inputs)))
    ours = torch.func.grad(loss, arguments)(*inputs)
    xs = leaves(inputs)
    for got, expected in zip(ours, torch.autograd.grad(loss(*xs), xs), strict=True):
        torch.testing.assert_close(got, expected)
    directions = tuple(torch.cos(9 * x) for x in inputs)
    value, moved = torch.func.jvp(loss, tuple(inputs), directions)
    torch.testing.assert_close(value, loss(*inputs))
    torch.testing.assert_close(moved, sum((g * d).sum() for g, d in zip(ours, directions, strict=True)))
    _, pull = torch.func.vjp(loss, *inputs)
    for got, expected in zip(pull(torch.ones_like(value)), ours, strict=True):
        torch.testing.assert_close(got, expected)
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(x, d) for x, d in zip(inputs, directions, strict=True)]
        torch.testing.assert_close(forward_ad.unpack_dual(loss(*duals)).tangent, moved)


@EVERY_OP
@pytest.mark.parametrize("of_all", [True, False], ids=["all batched", "first batched"])
def test_vmap_equals_a_loop(op, device, of_all):
    function, inputs = calls(device)[op]
    batch = [torch.stack([x, torch.sin(5 * x), x + 1]) for x in inputs]
    dims = tuple(0 if of_all or i == 0 else None for i in range(len(inputs)))
    arguments = [b if dim == 0 else x for b, x, dim in zip(batch, inputs, dims, strict=True)]
    entries = [[x[b] if dim == 0 else x for x, dim in zip(arguments, dims, strict=True)] for b in range(3)]

    def gradients(*xs):
        return torch.func.grad(lambda *ys: function(*ys).pow(2).sum(), tuple(range(len(xs))))(*xs)

    torch.testing.assert_close(torch.vmap(function, dims)(*arguments), torch.stack([function(*e) for e in entries]))
    ours = torch.vmap(gradients, dims)(*arguments)
    for got, *expected in zip(ours, *(gradients(*e) for e in entries), strict=True):
        torch.testing.assert_close(got, torch.stack(expected))


@EVERY_OP
@pytest.mark.parametrize("outer", [torch.func.jacrev, torch.func.jacfwd])
@pytest.mark.parametrize("inner", [torch.func.jacrev, torch.func.jacfwd])
def test_hessian_by_any_two_modes(op, device, outer, inner):
    function, inputs = calls(device)[op]

    def loss(steps):  # along one direction for each input, and one for all
        return function(*(x + (s + steps[-1]) * torch.cos(9 * x) for x, s in zip(inputs, steps))).pow(3).sum()

    steps = torch.zeros(len(inputs) + 1, dtype=torch.float64, device=device)
    ours, expected = outer(inner(loss))(steps), torch.autograd.functional.hessian(loss, steps)
    assert expected.abs().min() > 0
    torch.testing.assert_close(ours, expected)


@EVERY_OP
def test_vmap_of_no_entries(op, device):
    function, inputs = calls(device)[op]
    none, shape = [x[None][:0] for x in inputs], function(*inputs).shape
    assert torch.vmap(function)(*none).shape == (0, *shape)
    gradient = torch.func.grad(lambda *xs: function(*xs).sum())
    assert torch.vmap(gradient)(*none).shape == (0, *inputs[0].shape)


@EVERY_OP
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_transforms_under_autocast(op, dtype):
    function, inputs = calls(CPU)[op]

    def loss(*xs):
        return function(*xs).float().pow(2).sum()

    inputs = [x.to(dtype) for x in inputs]
    arguments, directions = tuple(range(len(inputs))), tuple(torch.cos(9 * x) for x in inputs)
    wide = [[x.float() for x in group] for group in (inputs, directions)]
    expected, moved = torch.func.jvp(loss, *map(tuple, wide))
    with torch.autocast("cpu", torch.bfloat16):
        xs = leaves(inputs)
        eager = torch.autograd.grad(loss(*xs), xs)
        ours = torch.func.grad(loss, arguments)(*inputs)
        each = torch.func.vmap(torch.func.grad(loss, arguments))(*(x[None] for x in inputs))
        results = torch.func.jvp(loss, tuple(inputs), directions)
    for got, batched, e in zip(ours, each, eager, strict=True):
        torch.testing.assert_close(got, e)
        torch.testing.assert_close(batched[0], e)
    torch.testing.assert_close(results, (expected, moved))  # computed in float32


def test_second_derivatives_of_attention_under_autocast_are_computed_in_float32():
    function, inputs = calls(CPU)["patch_attention"]

    def second():
        xs = leaves([x.float() for x in inputs])
        grads = torch.autograd.grad(function(*xs).pow(2).sum(), xs, create_graph=True)
        return torch.autograd.grad(sum(g.sum() for g in grads), xs)

    expected = second()
    with torch.autocast("cpu", torch.bfloat16):
        for got, e in zip(second(), expected, strict=True):
            torch.testing.assert_close(got, e)
