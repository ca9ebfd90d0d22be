"""Codes along space-filling curves and their stable sort. The op has no gradients: sections 2 and 3 do not apply."""

import pytest
import torch

from gsim3d.ops import CURVES, curve_encode, curve_sort
from tests.asserts import assert_same_bits_for_any_threads
from tests.oracle import curve as oracle


def random_cells(n, depth, seed=0):
    generator = torch.Generator().manual_seed(seed)
    grid = torch.randint(0, 2**depth, (n, 3), generator=generator)
    grid[: min(n, 1)] = 0
    grid[1 : min(n, 2)] = 2**depth - 1
    return grid


# 1 forward against the oracle


@pytest.mark.parametrize("depth", [1, 2, 5, 11, 15, 16])
@pytest.mark.parametrize("curve", CURVES)
def test_codes(curve, depth):
    grid = random_cells(100, depth)
    expected = [oracle.code(*cell, curve, depth) for cell in grid.tolist()]
    assert curve_encode(grid, None, curve, depth=depth).tolist() == expected


def test_several_curves_at_once(device):
    grid, cloud = random_cells(70, 11).to(device), (torch.arange(70) % 3).to(device)
    names = ("hilbert", "z", "hilbert", "z-trans", "hilbert-trans")
    codes = curve_encode(grid, cloud, names, depth=11)
    assert codes.shape == (5, 70)
    for row, name in zip(codes, names):
        assert torch.equal(row, curve_encode(grid, cloud, name, depth=11))
    assert curve_encode(grid, cloud, ()).shape == (0, 70)
    with pytest.raises(ValueError, match="curve must be one of .* got 'peano'"):
        curve_encode(grid, cloud, ("z", "peano"))


def test_cloud_bits_lie_above_the_shift():
    grid, cloud = random_cells(50, 16), torch.arange(50) % 7
    space = curve_encode(grid, None, "hilbert")
    assert torch.equal(curve_encode(grid, cloud, "hilbert"), (cloud << 48) | space)
    assert torch.equal(curve_encode(grid, cloud, "hilbert", shift=58), (cloud << 58) | space)


@pytest.mark.parametrize("curve", CURVES)
def test_codes_have_the_prefix_property(curve):
    grid = random_cells(200, 16)
    for bits in (1, 2, 7):
        parent = curve_encode(grid >> bits, None, curve, depth=16 - bits)
        assert torch.equal(curve_encode(grid, None, curve) >> (3 * bits), parent)


@pytest.mark.parametrize("n", [1, 2, 300, 131072, 131073, 200001])
@pytest.mark.parametrize("values", ["any", "few", "sorted", "equal"])
def test_sort(n, values):
    generator = torch.Generator().manual_seed(n)
    high = 2**63 - 1
    codes = {
        "any": torch.randint(-high, high, (3, n), generator=generator),
        "few": torch.randint(-3, 3, (3, n), generator=generator) << 40,
        "sorted": torch.arange(3 * n).reshape(3, n),
        "equal": torch.full((3, n), -5),
    }[values]
    order, inverse = curve_sort(codes)
    assert torch.equal(order, torch.argsort(codes, dim=1, stable=True))
    assert torch.equal(inverse.gather(1, order), torch.arange(n).expand(3, n))


def test_sort_of_every_digit():
    codes = torch.tensor([[sign * (1 << bit) for bit in range(63) for sign in (1, -1)] + [0, -(2**63)]])
    assert torch.equal(curve_sort(codes)[0], torch.argsort(codes, dim=1, stable=True))


# 4 CPU against CUDA


def test_devices_agree(devices):
    cpu, cuda = devices
    grid = random_cells(5000, 16)
    for curve in CURVES:
        codes = curve_encode(grid.to(cuda), None, curve)
        assert torch.equal(codes.cpu(), curve_encode(grid.to(cpu), None, curve))
        for on_cuda, on_cpu in zip(curve_sort(codes[None]), curve_sort(codes[None].cpu())):
            assert torch.equal(on_cuda.cpu(), on_cpu)


@pytest.mark.parametrize("n", [1, 2, 33, 4095, 4097, 300001])
@pytest.mark.parametrize("values", ["any", "few", "sorted", "equal", "extremes", "crowds"])
def test_sort_on_cuda(n, values, devices):
    generator = torch.Generator().manual_seed(n)
    high = 2**63 - 1
    codes = {
        "any": torch.randint(-high, high, (5, n), generator=generator),
        "few": torch.randint(-3, 3, (5, n), generator=generator) << torch.arange(0, 60, 12)[:, None],
        "sorted": torch.arange(5 * n).reshape(5, n),
        "equal": torch.full((5, n), -5),
        "extremes": torch.where(torch.rand(5, n, generator=generator) < 0.5, -(2**63), high),
        # Most keys differ in their high digits; two in a thousand differ in low ones only and stand together.
        "crowds": torch.where(
            torch.rand(5, n, generator=generator) < 0.002,
            torch.randint(0, 90, (5, n), generator=generator) << torch.arange(0, 10, 2)[:, None],
            torch.randint(-high, high, (5, n), generator=generator),
        ),
    }[values]
    order, inverse = curve_sort(codes.to(devices[1]))
    assert torch.equal(order.cpu(), torch.argsort(codes, dim=1, stable=True))
    assert torch.equal(inverse.cpu().gather(1, order.cpu()), torch.arange(n).expand(5, n))


def test_rows_out_of_range_on_cuda_have_code_zero(devices):
    bad = torch.tensor([[70000, 0, 0], [0, -1, 0], [0, 0, 2**40], [1, 2, 3], [1, 2, 3], [1, 2, 3]])
    cloud = torch.tensor([0, 0, 0, -1, 2**15, 1])
    codes = curve_encode(bad.to(devices[1]), cloud.to(devices[1]), "hilbert").tolist()
    assert codes[:5] == [0] * 5 and codes[5:] == curve_encode(bad[5:], cloud[5:], "hilbert").tolist()


def test_devices_raise_alike(devices):
    grid, cloud = torch.zeros(2, 3, dtype=torch.int64), torch.zeros(2, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"depth must be in \[1, 16\]; got 17"):
        curve_encode(grid.to(devices[1]), None, "z", depth=17)
    with pytest.raises(TypeError, match="cloud is on cpu, but grid on cuda:0"):
        curve_encode(grid.to(devices[1]), cloud, "z")


# 5 opcheck


@pytest.mark.filterwarnings("error")
def test_opcheck(device):
    grid = random_cells(10, 16).to(device)
    torch.library.opcheck(torch.ops.gsim3d.curve_encode, (grid, torch.arange(10, device=device), [2, 0], 16, 48))
    torch.library.opcheck(torch.ops.gsim3d.curve_sort, (torch.stack([grid[:, 0], grid[:, 1]]),))


# 6 compile


def test_compile():
    def f(grid, cloud):
        return curve_sort(torch.stack([curve_encode(grid, cloud, curve) for curve in CURVES]))

    grid, cloud = random_cells(40, 16), torch.arange(40) // 10
    for compiled, eager in zip(torch.compile(f, fullgraph=True, backend="aot_eager")(grid, cloud), f(grid, cloud)):
        assert torch.equal(compiled, eager)


# 7 edges


def test_empty(device):
    def zeros(*shape):
        return torch.zeros(shape, dtype=torch.int64, device=device)

    assert curve_encode(zeros(0, 3), None, "hilbert").shape == (0,)
    assert [t.shape for t in curve_sort(zeros(4, 0))] == [(4, 0), (4, 0)]
    assert [t.shape for t in curve_sort(zeros(0, 4))] == [(0, 4), (0, 4)]


def test_non_contiguous():
    grid = random_cells(60, 16)
    strided = grid.t().contiguous().t()
    assert not strided.is_contiguous()
    codes = curve_encode(strided, None, "hilbert-trans")
    assert torch.equal(codes, curve_encode(grid, None, "hilbert-trans"))
    pair = torch.stack([codes, codes.flip(0)], 1).t()
    assert torch.equal(curve_sort(pair)[0], torch.argsort(pair, dim=1, stable=True))


def test_any_number_of_threads():
    grid = random_cells(300000, 9)

    def run():
        codes = torch.stack([curve_encode(grid, None, curve, depth=9) for curve in CURVES])
        return [codes, *curve_sort(codes)]

    assert_same_bits_for_any_threads(run)


# 8 errors


@pytest.mark.parametrize(
    "change, message",
    [
        ({"curve": "peano"}, "curve must be one of z, z-trans, hilbert, hilbert-trans; got 'peano'"),
        (
            {"grid": torch.tensor([[0, 0, 0], [0, 70000, 0]])},
            r"grid must be in \[0, 65536\) at depth 16; got 70000 at row 1, axis 1",
        ),
        ({"grid": torch.tensor([[0, 0, -1], [0, 0, 0]])}, r"got -1 at row 0, axis 2"),
        ({"grid": torch.tensor([[2**40, 0, 0], [0, 0, 0]])}, r"got 1099511627776 at row 0, axis 0"),
        ({"grid": torch.zeros(2, 2, dtype=torch.int64)}, r"grid must be \[N, 3\]"),
        ({"grid": torch.zeros(2, 3)}, "grid must be int64; got float32"),
        ({"cloud": torch.tensor([0, 2**15])}, r"cloud must be in \[0, 32768\) at shift 48; got 32768 at row 1"),
        ({"cloud": torch.tensor([-1, 0])}, "got -1 at row 0"),
        ({"cloud": torch.tensor([0])}, r"cloud must be \[N\]"),
        ({"depth": 17}, r"depth must be in \[1, 16\]; got 17"),
        ({"depth": 0}, r"depth must be in \[1, 16\]; got 0"),
        ({"shift": 47}, r"shift must be in \[3 depth, 62\] = \[48, 62\]; got 47"),
        ({"shift": 63}, "got 63"),
    ],
)
def test_errors(change, message):
    arguments = {"grid": torch.zeros(2, 3, dtype=torch.int64), "cloud": None, "curve": "z"} | change
    with pytest.raises(ValueError, match="curve_encode: .*" + message):
        curve_encode(**arguments)


def test_sort_errors():
    with pytest.raises(ValueError, match=r"curve_sort: codes must be \[R, N\]"):
        curve_sort(torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match="curve_sort: codes must be int64; got int32"):
        curve_sort(torch.zeros(1, 3, dtype=torch.int32))
