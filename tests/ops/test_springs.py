"""Anchors on springs, in the eight sections that every op has."""

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import SpringLists, advance_springs
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.oracle import springs as oracle

FLOATS = ("positions", "velocities", "lengths", "stiffness", "damping", "grip", "external")
FALLING = {"seconds": 0.1, "substeps": 17, "ground": 0.45}


def scene(counts=(40,), most=12, dtype=torch.float64, device="cpu", seed=0):
    """Ragged lists of bodies of ``counts`` anchors, stretched, moving and partly on the ground: tensors, lists."""
    g = torch.Generator().manual_seed(seed)
    n, first, neighbors, sizes = sum(counts), 0, [], []
    for count in counts:
        for i in range(count):
            others = torch.randperm(count - 1, generator=g)[: int(torch.randint(0, most + 1, (), generator=g))]
            neighbors.append(first + others + (others >= i))
            sizes.append(len(others))
        first += count
    neighbors, cu = torch.cat(neighbors), torch.tensor([0, *sizes]).cumsum(0)
    rest = torch.rand(n, 3, generator=g, dtype=torch.float64)
    owners = torch.arange(n).repeat_interleave(cu.diff())

    def random(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    s = len(neighbors)
    tensors = {
        "positions": rest * torch.tensor([1.05, 0.9, 1.1]),
        "velocities": random(n, 3) - 0.5,
        "lengths": (rest[neighbors] - rest[owners]).norm(dim=1),
        "stiffness": 20 + 50 * random(s),
        "damping": random(s),
        "grip": random(n),
        "external": random(n, 3) - torch.tensor([0, 0, 9.8]),
    }
    lists = SpringLists.from_neighbors(neighbors.to(device), cu.to(device))
    return {name: value.to(device, dtype) for name, value in tensors.items()}, lists


def ours(tensors, lists, options):
    given = dict(tensors)
    return advance_springs(given.pop("positions"), given.pop("velocities"), lists, **given, **options)


def expected(tensors, lists, options):
    given = {name: value.cpu().double() for name, value in tensors.items()}
    x, v = given.pop("positions"), given.pop("velocities")
    return oracle.advance(x, v, lists.neighbors.cpu(), lists.cu_springs.cpu(), **given, **options)


def run(f, tensors, lists, options=FALLING):
    """Results, and the gradients of FLOATS for seeded cotangents."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in tensors.items()}
    out, g = f(leaves, lists, options), torch.Generator().manual_seed(1)
    cotangents = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in out]
    return [t.detach() for t in out], list(torch.autograd.grad(out, [leaves[name] for name in FLOATS], cotangents))


def assert_same(actual, expected, tolerance):
    for kind, names in enumerate((("positions", "velocities"), FLOATS)):
        for name, a, b in zip(names, actual[kind], expected[kind], strict=True):
            assert_close_relative_to_max(a, b, f"springs{('', '_grad')[kind]}_{tolerance}", name)


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "options", [{}, {"substeps": 1}, {"substeps": 16, "power": 0.0}, {"ground": None, "power": 0.7}]
)
def test_forward_and_gradients_equal_the_oracle(options, dtype, device):
    tensors, lists = scene((40, 3, 1, 9), dtype=dtype, device=device)
    actual, reference = (run(f, tensors, lists, FALLING | options) for f in (ours, expected))
    assert_same(actual, reference, "float32" if dtype == torch.float32 else "float64")
    if options.get("ground", 0) is not None:
        assert actual[0][0][:, 2].min().item() == pytest.approx(0.45) and actual[1][5].any()


# 3 gradcheck
def test_gradcheck():
    tensors, lists = scene((6,), most=4)

    def f(*values):
        return ours(dict(zip(FLOATS, values, strict=True)), lists, FALLING | {"substeps": 5})

    torch.autograd.gradcheck(f, [tensors[name].requires_grad_() for name in FLOATS])


# 4 CPU against CUDA
@pytest.mark.parametrize("counts", [(1,), (33, 2), (700, 400)])
def test_cuda_equals_cpu(counts, devices):
    cpu, cuda = (run(ours, *scene(counts, most=90, dtype=torch.float32, device=device)) for device in devices)
    assert_same(cuda, cpu, "float32")


def test_runs_in_a_cuda_graph(devices):
    tensors, lists = scene(dtype=torch.float32, device=devices[1])
    before, graph = ours(tensors, lists, FALLING), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        out = ours(tensors, lists, FALLING)
    graph.replay()
    for a, b in zip(out, before, strict=True):
        assert_same_bits(a, b)


def test_cuda_leaves_out_springs_that_are_none(devices):
    tensors, lists = scene(dtype=torch.float64, device=devices[1])
    wrong = lists._replace(neighbors=lists.neighbors.clone())
    wrong.neighbors[3], wrong.neighbors[7] = -1, 10**12
    without = tensors | {name: tensors[name].clone() for name in ("stiffness", "damping")}
    for name in ("stiffness", "damping"):
        without[name][[3, 7]] = 0
    for a, b in zip(ours(tensors, wrong, FALLING), ours(without, lists, FALLING), strict=True):
        assert_same_bits(a, b)


def test_two_runs_have_the_same_bits(device):
    tensors, lists = scene((300,), dtype=torch.float32, device=device)
    first, second = (run(ours, tensors, lists) for _ in range(2))
    for a, b in zip([*first[0], *first[1]], [*second[0], *second[1]], strict=True):
        assert_same_bits(a, b)


def test_same_bits_for_any_number_of_threads():
    tensors, lists = scene((300,), dtype=torch.float32)
    assert_same_bits_for_any_threads(lambda: sum(run(ours, tensors, lists), []))


# 5 opcheck
def test_opcheck():
    tensors, lists = scene((6,), dtype=torch.float32)
    state = torch.stack([tensors["positions"], tensors["velocities"]])
    numbers = [tensors[name] for name in FLOATS[2:]]
    for substeps in (1, 5):
        arguments = (state, *lists, *numbers, 0.1, substeps, 0.45, 0.5)
        op = torch.ops.gsim3d.advance_springs.default
        torch.library.opcheck(op, (state.clone().requires_grad_(), *arguments[1:]))
        torch.library.opcheck(
            torch.ops.gsim3d.advance_springs_backward.default,
            (torch.ones_like(state), *op(*arguments), *arguments),
            test_utils=("test_schema", "test_faketensor"),
        )


# 6 torch.compile
def test_compiled_equals_eager():
    tensors, lists = scene(dtype=torch.float32)
    compiled = torch.compile(ours, fullgraph=True, backend="aot_eager")
    assert_same(run(compiled, tensors, lists), run(ours, tensors, lists), "float32")


# 7 edges
@pytest.mark.parametrize("counts", [(), (1,)])
def test_no_springs(counts, device):
    n, empty = sum(counts), torch.zeros(0, device=device, dtype=torch.float64)
    zeros = torch.zeros(n, 3, device=device, dtype=torch.float64)
    lists = SpringLists.from_neighbors(empty.long(), torch.zeros(n + 1, dtype=torch.int64, device=device))
    tensors = {"positions": zeros, "velocities": zeros + 2, "grip": zeros[:, 0] + 0.5, "external": zeros}
    tensors |= dict.fromkeys(("lengths", "stiffness", "damping"), empty)
    (x, v), grads = run(ours, tensors, lists, {"seconds": 1.0, "substeps": 4, "ground": -1.0})
    assert torch.equal(v, zeros + 2) and torch.allclose(x, zeros + 2) and grads[0].shape == (n, 3)


def test_anchors_in_one_place_feel_nothing(device):
    tensors, lists = scene((5,), most=4, device=device)
    tensors["positions"] = torch.zeros_like(tensors["positions"])
    tensors["velocities"] = tensors["external"] = torch.zeros_like(tensors["positions"])
    out, grads = run(ours, tensors, lists, FALLING | {"ground": None})
    assert not out[0].any() and not out[1].any() and all(grad.isfinite().all() for grad in grads)


# 8 errors
def test_malformed_arguments_raise():
    tensors, lists = scene((6,))
    for wrong, named in (
        ({"lengths": -tensors["lengths"]}, "lengths must be positive"),
        ({"stiffness": tensors["stiffness"][1:]}, "stiffness"),
        ({"grip": tensors["grip"].float()}, "grip"),
        ({"velocities": tensors["velocities"][1:]}, "velocities"),
    ):
        with pytest.raises(ValueError, match=named):
            ours(tensors | wrong, lists, FALLING)
    for option, named in (
        ({"seconds": 0.0}, "seconds must be positive"),
        ({"substeps": 0}, "substeps must be 1"),
        ({"power": -1.0}, "power must be"),
        ({"ground": float("inf")}, "ground must be"),
    ):
        with pytest.raises(ValueError, match=named):
            ours(tensors, lists, FALLING | option)
    for change, named in (
        ({"neighbors": lists.neighbors + 5}, r"neighbors must be in \[0, N\)"),
        ({"cu_springs": lists.cu_springs + 1}, "cu_springs must ascend"),
        ({"sources": lists.sources.flip(0)}, "sources must list"),
    ):
        with pytest.raises(ValueError, match=named):
            ours(tensors, lists._replace(**change), FALLING)
    tensors["external"][2, 1] = torch.nan
    with pytest.raises(NumericalError, match="external must be finite .* row 2"):
        ours(tensors, lists, FALLING)
