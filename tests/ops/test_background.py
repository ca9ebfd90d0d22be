"""Where rows meet a background, against plain Python, in the eight sections that every op has."""

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import Segments, add_cells, find_cells, overlapping_patches, row_scenes
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads, gradients

NOWHERE = torch.iinfo(torch.int64).max
SCENE = 48  # bits below the scene in a key


def offsets(counts):
    return torch.tensor([0, *counts]).cumsum(0)


def chain(n_scenes=3, seed=0):
    """Clouds of several scenes, one of them empty, whose rows are pooled twice; the last rows pool none."""
    g = torch.Generator().manual_seed(seed)
    counts, scenes = [7, 0, 40, 13, 1], torch.randint(0, n_scenes, (5,), generator=g)
    first = Segments(torch.randperm(61, generator=g), torch.arange(62))
    cuts = torch.randint(0, 56, (19,), generator=g).sort().values
    second = Segments(
        torch.randperm(61, generator=g)[:55], torch.cat([torch.tensor([0]), cuts, torch.tensor([55, 55])])
    )
    return scenes, offsets(counts), [first, second]


def scenes_by_loops(cloud_scene, cu_input, stages):
    rows = [cloud_scene[q].item() for q, n in enumerate(cu_input.diff().tolist()) for _ in range(n)]
    results = []
    for stage in stages:
        cu = stage.cu_rows.tolist()
        rows = [rows[stage.rows[a]] if a < b else None for a, b in zip(cu, cu[1:])]
        results.append(torch.tensor([row or 0 for row in rows]))
    return results


def cells_and_rows(n_cells=200, n_rows=500, seed=0):
    g = torch.Generator().manual_seed(seed)
    scene, grid = torch.randint(0, 2, (n_rows,), generator=g), torch.randint(0, 8, (n_rows, 3), generator=g)
    grid[0] = 65535
    keys = torch.randint(0, 2, (n_cells,), generator=g) << SCENE
    for axis in range(3):
        keys |= torch.randint(0, 8, (n_cells,), generator=g) << 16 * axis
    return torch.cat([keys.unique(), torch.tensor([NOWHERE])]), scene, grid


def cells_by_loops(cells, scene, grid):
    places = {key: i for i, key in enumerate(cells.tolist())}
    keys = [s << 48 | x << 32 | y << 16 | z for s, (x, y, z) in zip(scene.tolist(), grid.tolist())]
    return torch.tensor([places.get(key, len(cells) - 1) for key in keys])


def overlap(
    counts=(90, 0, 70, 120), scenes=(0, 0, 1, 3), n_patches=9, curves=4, patch_size=16, spare=5, span=50, seed=0
):
    """Scene 3 has no background; ``spare`` rows are none; begins and codes repeat. Arguments of overlapping_patches."""
    g = torch.Generator().manual_seed(seed)
    sizes = torch.randint(0, patch_size + 1, (n_patches,), generator=g)
    cu_k = torch.cat([torch.tensor([0]), sizes.cumsum(0)])
    kv_rows = torch.randint(0, 1000, (curves, int(cu_k[-1]) + 2), generator=g)
    half = n_patches - n_patches // 2
    first = torch.randint(0, span, (curves, n_patches), generator=g)
    first[:, :1] = first[:, half : half + 1] = 0
    first = torch.cat([first[:, :half].sort().values, first[:, half:].sort().values | 1 << SCENE], 1)
    n = sum(counts)
    of_scene = torch.tensor(scenes, dtype=torch.int64).repeat_interleave(torch.tensor(counts, dtype=torch.int64))
    shuffled = torch.stack([torch.randperm(n, generator=g) for _ in range(curves)])
    codes = torch.randint(0, span, (curves, n + spare), generator=g)
    order, begin = torch.arange(n + spare).repeat(curves, 1), 0
    for c in range(curves):
        codes[c, shuffled[c]] = codes[c, :n] | of_scene << SCENE
    for count in counts:
        for c in range(curves):
            rows = shuffled[c, begin : begin + count]
            order[c, begin : begin + count] = rows[codes[c, rows].argsort(stable=True)]
        begin += count
    return [first, kv_rows, cu_k, codes, order, offsets(counts)], patch_size


def tables_by_loops(first, kv_rows, cu_k, codes, order, cu_clouds, patch_size):
    results, n_parts, n_real = [], first.shape[1] + codes.shape[1] // patch_size, cu_clouds[-1]
    for begins, keys, code, rows in zip(first.tolist(), kv_rows.tolist(), codes.tolist(), order.tolist()):
        asking, nobody = {}, []
        for row in rows[:n_real]:
            around = [p for p, b in enumerate(begins) if b <= code[row] and b >> SCENE == code[row] >> SCENE]
            (asking.setdefault(around[-1], []) if around else nobody).append(row)
        queries, listed, counts_q, counts_k = [], [], [], []
        for p in sorted(asking):
            for i in range(0, len(asking[p]), patch_size):
                part, its_keys = asking[p][i : i + patch_size], keys[cu_k[p] : cu_k[p + 1]]
                queries, listed = queries + part, listed + its_keys
                counts_q, counts_k = counts_q + [len(part)], counts_k + [len(its_keys)]
        more = [0] * (n_parts - len(counts_q))
        listed += [0] * (kv_rows.shape[1] + codes.shape[1] - len(listed))
        lists = [queries + nobody + rows[n_real:], listed]
        results.append((*map(torch.tensor, lists), offsets(counts_q + more), offsets(counts_k + more)))
    return results


def lists(tables):
    return [x for t in tables for x in (t.q_rows, t.kv_rows, t.cu_q, t.cu_k)]


def assert_equal(actual, expected):
    for i, (a, b) in enumerate(zip(actual, expected, strict=True)):
        assert a.dtype == torch.int64 and torch.equal(a.cpu(), b), f"list {i}"


def rows_and_field(n_rows=70, n_cells=9, channels=16, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    x, field, cotangent = (torch.randn(n, channels, generator=g).to(dtype) for n in (n_rows, n_cells, n_rows))
    return x, field, torch.randint(0, n_cells, (n_rows,), generator=g), cotangent


# 1 against plain Python
@pytest.mark.parametrize("seed", range(3))
def test_scenes(seed, device):
    scenes, cu, stages = chain(seed=seed)
    moved = [Segments(s.rows.to(device), s.cu_rows.to(device)) for s in stages]
    assert_equal(row_scenes(scenes.to(device), cu.to(device), moved), scenes_by_loops(scenes, cu, stages))


@pytest.mark.parametrize("n_cells", [0, 1, 200, 3000])
def test_cells(n_cells, device):
    arguments = cells_and_rows(n_cells)
    places = find_cells(*(x.to(device) for x in arguments))
    assert_equal([places], [cells_by_loops(*arguments)])
    assert n_cells < 200 or len(places.unique()) > 50


SHAPES = {
    "several scenes": {},
    "few rows": {"counts": (3, 2), "scenes": (0, 1)},
    "one patch has all": {"counts": (500,), "scenes": (0,), "n_patches": 2, "patch_size": 7},
    "many patches and clouds": {"counts": (9,) * 70, "scenes": (0,) * 35 + (1,) * 35, "n_patches": 1500, "span": 9000},
    "one curve": {"curves": 1},
    "no background near": {"counts": (40,), "scenes": (3,)},
    "no keys": {"n_patches": 2, "patch_size": 1, "seed": 3},
    "no rows but spare ones": {"counts": (0,), "scenes": (0,)},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_patches(shape, device):
    arguments, size = overlap(**SHAPES[shape])
    tables = overlapping_patches(*(x.to(device) for x in arguments), patch_size=size)
    expected = [x for table in tables_by_loops(*arguments, size) for x in table]
    assert_equal(lists(tables), expected)
    for table in tables:
        assert sorted(table.q_rows.tolist()) == list(range(arguments[3].shape[1]))
        assert table.cu_q.diff().max() <= size


# 1, 2 forward and gradient of what is added
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.float16])
@pytest.mark.parametrize(
    "n_rows, n_cells, channels", [(70, 9, 16), (5000, 40, 24), (33, 50, 5), (3, 1, 1), (0, 4, 3), (200, 1, 33)]
)
def test_cells_are_added(n_rows, n_cells, channels, dtype, device):
    if device.type == "cpu" and dtype.itemsize == 2:
        pytest.skip("the CPU computes in float32 and float64")
    x, field, places, cotangent = rows_and_field(n_rows, n_cells, channels, dtype)
    moved = places.to(device)
    out, grad_x, grad_field = gradients(
        lambda x, field: add_cells(x, field, moved), [x.to(device), field.to(device)], cotangent
    )
    assert out.dtype == dtype
    assert_same_bits(out.cpu(), x + field[places])
    assert_same_bits(grad_x.cpu(), cotangent)
    expected = torch.zeros(n_cells, channels, dtype=torch.float64).index_add_(0, places, cotangent.double())
    limit = {torch.float64: 1e-14, torch.float32: 1e-5}.get(dtype, 1e-2)
    assert_close_relative_to_max(grad_field, expected, limit)


# 3 gradcheck
def test_gradcheck():
    x, field, places, _ = rows_and_field(7, 3, 2)
    torch.autograd.gradcheck(lambda x, field: add_cells(x, field, places), [x.requires_grad_(), field.requires_grad_()])


# 4 CPU against CUDA
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("n_rows", [2000, 9000])
def test_gradients_have_the_same_bits_in_every_run(n_rows, dtype, devices):
    x, field, places, cotangent = (t.to(devices[1]) for t in rows_and_field(n_rows, 30, 64, dtype))
    runs = [gradients(lambda x, field: add_cells(x, field, places), [x, field], cotangent) for _ in range(4)]
    for run in runs[1:]:
        for a, b in zip(run, runs[0], strict=True):
            assert_same_bits(a, b)


def test_autocast(device):
    x, field, places, _ = (t.to(device) for t in rows_and_field(dtype=torch.float32))
    with torch.autocast(device.type, torch.bfloat16):
        out = add_cells(x.bfloat16(), field, places)
    assert out.dtype == (torch.bfloat16 if device.type == "cuda" else torch.float32)
    assert_same_bits(out, x.bfloat16().to(out.dtype) + field.to(out.dtype)[places])


def test_row_of_cell_out_of_range_is_copied(devices):
    x, field, places, _ = (t.to(devices[1]) for t in rows_and_field(dtype=torch.float32))
    wrong = torch.where(torch.arange(70, device=devices[1]) % 2 == 0, places, 2**40 * places - 1)
    out = add_cells(x, field, wrong)
    assert_same_bits(out[1::2], x[1::2])
    assert_same_bits(out[::2], add_cells(x, field, places)[::2])


@pytest.mark.parametrize("far", [lambda i: 9 + i, lambda i: -1 - i, lambda i: 2**31 - 1 + i, lambda i: -(2**62) + i])
def test_row_of_cell_out_of_range_has_no_gradient(far, devices):
    x, field, places, cotangent = (t.to(devices[1]) for t in rows_and_field(700, dtype=torch.float64))
    i = torch.arange(700, device=devices[1])
    actual = gradients(lambda *y: add_cells(*y, torch.where(i % 2 == 0, places, far(i))), [x, field], cotangent)
    expected = gradients(lambda *y: add_cells(*y, places[::2]), [x[::2], field], cotangent[::2])
    assert_same_bits(actual[1], cotangent)
    assert_close_relative_to_max(actual[2], expected[2], 1e-14)


@pytest.mark.parametrize(
    "shape", [{"counts": (9000, 8000), "scenes": (0, 0), "n_patches": 40, "patch_size": 1024, "span": 2**40}]
)
def test_devices_agree_on_many_rows(shape, devices):
    arguments, size = overlap(**shape)
    on_cpu, on_cuda = (lists(overlapping_patches(*(x.to(d) for x in arguments), patch_size=size)) for d in devices)
    assert_equal(on_cuda, on_cpu)
    again = lists(overlapping_patches(*(x.to(devices[1]) for x in arguments), patch_size=size))
    assert_equal([x.cpu() for x in again], on_cpu)


# 5 opcheck
def test_opcheck(device):
    scenes, cu, stages = chain()
    arguments, size = overlap()
    calls = {
        "row_scenes": (scenes, cu, [s.rows for s in stages], [s.cu_rows for s in stages]),
        "find_cells": cells_and_rows(),
        "overlapping_patches": (*arguments, size),
    }
    x, field, places, _ = rows_and_field(12, 4, 3)
    calls["add_cells"] = (x.requires_grad_(), field.requires_grad_(), places)
    for name, given in calls.items():
        given = [
            [y.to(device) for y in x] if isinstance(x, list) else x.to(device) if x is not size else x for x in given
        ]
        torch.library.opcheck(getattr(torch.ops.gsim3d, name).default, tuple(given))


# 6 torch.compile
def test_compiled_equals_eager():
    arguments, size = overlap()
    scenes, cu, stages = chain()
    cells = cells_and_rows()

    def places(arguments, scenes, cu, stages, cells):
        return [
            *lists(overlapping_patches(*arguments, patch_size=size)),
            *row_scenes(scenes, cu, stages),
            find_cells(*cells),
        ]

    compiled = torch.compile(places, fullgraph=True, backend="aot_eager")
    given = (arguments, scenes, cu, stages, cells)
    assert_equal(compiled(*given), places(*given))


def test_compiled_gradients():
    x, field, places, cotangent = rows_and_field()
    compiled = torch.compile(lambda x, field: add_cells(x.sin(), field, places), fullgraph=True, backend="aot_eager")
    expected = gradients(lambda x, field: add_cells(x.sin(), field, places), [x, field], cotangent)
    for a, b in zip(gradients(compiled, [x, field], cotangent), expected, strict=True):
        assert_close_relative_to_max(a, b, 1e-14)


# 7 edges
def test_nothing(device):
    none, zero = torch.zeros(0, dtype=torch.int64, device=device), torch.zeros(1, dtype=torch.int64, device=device)
    assert row_scenes(none, zero, []) == []
    assert [len(x) for x in row_scenes(none, zero, [Segments(none, zero)])] == [0]
    assert find_cells(zero, none, none.view(0, 3)).shape == (0,)
    arguments = [none.view(4, 0), none.view(4, 0), zero, none.view(4, 0), none.view(4, 0), zero]
    for table in overlapping_patches(*arguments, patch_size=8):
        assert [len(x) for x in lists([table])] == [0, 0, 1, 1] and table.cu_q.tolist() == table.cu_k.tolist() == [0]


def test_rows_without_any_patch(device):
    arguments, size = overlap()
    arguments[:3] = arguments[0][:, :0], arguments[1][:, :0], arguments[2][:1]
    for table, order in zip(overlapping_patches(*(x.to(device) for x in arguments), patch_size=size), arguments[4]):
        assert torch.equal(table.q_rows.cpu(), order) and not table.cu_q.any() and not table.cu_k.any()
        assert not table.kv_rows.any()


def test_rows_chain_that_ends_early_has_scene_0(device):
    """A row of a given capacity that is none: its segment is empty, or lies behind the list."""
    rows, cu = torch.tensor([1, 0], device=device), torch.tensor([0, 1, 2, 2, 2], device=device)
    scenes = torch.tensor([6], device=device)
    assert row_scenes(scenes, torch.tensor([0, 2], device=device), [Segments(rows, cu)])[0].tolist() == [6, 6, 0, 0]


def test_non_contiguous(device):
    arguments, size = overlap()
    strided = [torch.stack([x, x], -1)[..., 0].to(device) for x in arguments]
    plain = [x.to(device) for x in arguments]
    for a, b in zip(*(lists(overlapping_patches(*x, patch_size=size)) for x in (strided, plain)), strict=True):
        assert torch.equal(a, b)


def test_same_results_for_any_threads():
    arguments, size = overlap(counts=(20000,), scenes=(0,), patch_size=100)
    scenes, cu, stages = chain()
    assert_same_bits_for_any_threads(lambda: (*lists(overlapping_patches(*arguments, patch_size=size)),))
    x, field, places, cotangent = rows_and_field(9000, 50, 32, torch.float32)
    assert_same_bits_for_any_threads(lambda: gradients(lambda *y: add_cells(*y, places), [x, field], cotangent))
    assert_same_bits_for_any_threads(
        lambda: (*row_scenes(scenes, cu, stages), find_cells(*cells_and_rows(n_rows=9000)))
    )


# 8 error messages
WRONG = {
    r"first must be \[R, P\]": {0: torch.zeros(3, dtype=torch.int64)},
    "kv_rows must be int64; got float32": {1: torch.zeros(4, 8)},
    r"cu_k must be \[P \+ 1\] = \[10\]; got \[2\]": {2: torch.tensor([0, 1])},
    "cu_k must run from 0 to at most M=": {2: torch.arange(10) * 100},
    "cu_k must give each patch 0 to patch_size=16 keys; got 17 at 1": {2: torch.tensor([0, 0] + [17] * 8)},
    "cu_k must give each patch 0 to patch_size=16 keys; got -3 at 1": {2: torch.tensor([0, 3] + [0] * 8)},
    r"codes must be \[R, N\]": {3: torch.zeros(3, 285, dtype=torch.int64)},
    r"order must be \[R, N\] = \[4, 285\]; got \[4, 9\]": {4: torch.zeros(4, 9, dtype=torch.int64)},
    r"order must be in \[0, N\) with N=285; got 285 at 0": {4: torch.full((4, 285), 285)},
    "order must be by ascending code inside a cloud": {4: torch.arange(285).repeat(4, 1)},
    r"cu_clouds must be \[C \+ 1\]; got \[0\]": {5: torch.zeros(0, dtype=torch.int64)},
    "cu_clouds must run from 0 to at most N=285; got 0 .. 286": {5: torch.tensor([0, 286])},
    "cu_clouds must not descend; got 90 then 80 at 1": {5: torch.tensor([0, 90, 80])},
}


@pytest.mark.parametrize("message", WRONG)
def test_malformed_patches_raise(message):
    arguments, size = overlap()
    for i, value in WRONG[message].items():
        arguments[i] = value
    with pytest.raises(ValueError, match=f"overlapping_patches: {message}"):
        overlapping_patches(*arguments, patch_size=size)


@pytest.mark.parametrize(
    "i, value, message",
    [
        (0, torch.zeros(3), r"x must be \[N, C\]"),
        (1, torch.zeros(9, 16), "field must be float64; got float32"),
        (1, torch.zeros(9, 5).double(), r"field must be \[D, C\] = \[\*, 16\]; got \[9, 5\]"),
        (2, torch.zeros(9, dtype=torch.int64), r"places must be \[N\] = \[70\]; got \[9\]"),
        (2, torch.full((70,), 9), r"places must be in \[0, D\) with D=9; got 9 at 0"),
        (2, torch.zeros(70), "places must be int64; got float32"),
    ],
)
def test_malformed_additions_raise(i, value, message):
    arguments = list(rows_and_field()[:3])
    arguments[i] = value
    with pytest.raises(ValueError, match=f"add_cells: {message}"):
        add_cells(*arguments)


@pytest.mark.parametrize("which, name", [(0, "x"), (1, "field")])
def test_poison_is_refused_on_the_cpu(which, name):
    arguments = list(rows_and_field()[:3])
    arguments[which][3, 2] = float("nan")
    with pytest.raises(NumericalError, match=f"add_cells: {name} must be finite"):
        add_cells(*arguments)
    assert add_cells(*arguments, check=False).isnan().any()


def test_other_malformed_arguments_raise():
    arguments, _ = overlap()
    with pytest.raises(ValueError, match="overlapping_patches: patch_size must be at least 1; got 0"):
        overlapping_patches(*arguments, patch_size=0)
    with pytest.raises(TypeError, match="patch_size must be a whole number"):
        overlapping_patches(*arguments, patch_size="8")
    cells, scene, grid = cells_and_rows()
    with pytest.raises(ValueError, match=r"find_cells: cells must be \[D\], D at least 1; got \[0\]"):
        find_cells(cells[:0], scene, grid)
    with pytest.raises(ValueError, match=r"find_cells: grid must be \[N, 3\] = \[500, 3\]; got \[499, 3\]"):
        find_cells(cells, scene, grid[1:])
    with pytest.raises(TypeError, match="find_cells: scene must be a tensor"):
        find_cells(cells, [0], grid)
    scenes, cu, stages = chain()
    with pytest.raises(ValueError, match=r"row_scenes: cu_input must be \[Q \+ 1\] = \[6\]; got \[5\]"):
        row_scenes(scenes, cu[1:], stages)
    with pytest.raises(ValueError, match="row_scenes: stages must be at most 8; got 9"):
        row_scenes(scenes, cu, stages[:1] * 9)
    with pytest.raises(ValueError, match=r"row_scenes: stages\[0\].rows must be int64; got int32"):
        row_scenes(scenes, cu, [Segments(stages[0].rows.int(), stages[0].cu_rows)])
