"""Index lists that the CPU would refuse, on CUDA, where they are not checked.

Whatever they hold, results are finite, and 0 where a row of the result has no valid source. All memory that an op takes
is filled with NaN before.
"""

import dataclasses

import pytest
import torch

from gsim3d.ops import (
    KernelMap,
    PatchTable,
    Segments,
    Voxels,
    find_cells,
    overlapping_patches,
    patch_attention,
    plane_sweep,
    pool_max,
    pool_mean,
    row_scenes,
    sweep_geometry,
    unpool,
)
from tests.asserts import gradients
from tests.ops import raster_scene
from tests.ops.test_background import cells_and_rows, chain, overlap
from tests.ops.test_joint_attention import joint_case, results_of
from tests.ops.test_patch_attn import cotangent_of, lists, random_case
from tests.ops.test_plane_sweep import make, run
from tests.ops.test_sparse_conv import RULES, convolution, geometry, parameters, random_cells, with_plan
from tests.ops.test_validate_state import look, state


def every_third(wrong):
    """A list of which every third entry is wrong(n, where), n being one more than the largest."""

    def broken(x):
        where = torch.arange(len(x), device=x.device)
        return torch.where(where % 3 == 1, wrong(int(x.max()) + 1, where), x)

    return broken


# What may stand in a list of rows or voxels.
INDICES = {
    "beyond the end": every_third(lambda n, where: n + 100 + where),
    "negative": every_third(lambda n, where: -1 - where),
    "far": every_third(lambda n, where: (where % 2 * 2 - 1) * 2**62),
    "none in range": lambda x: torch.full_like(x, 2**40),
    "one for all": torch.zeros_like,
}
# What may stand in a list of offsets.
OFFSETS = {
    "backwards": lambda cu: cu.flip(0),
    "beyond the end": lambda cu: cu * 5 + 3,
    "negative": lambda cu: cu - 9,
    "far": lambda cu: (torch.arange(len(cu), device=cu.device) % 2 * 2 - 1) * 2**62,
    "all nothing": torch.zeros_like,
    "up and down": lambda cu: torch.where(torch.arange(len(cu), device=cu.device) % 2 == 1, cu // 2, cu),
}


@pytest.fixture(autouse=True)
def poisoned_memory():
    """torch fills what is allocated with NaN, or the largest integer, while its algorithms are deterministic."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    assert torch.utils.deterministic.fill_uninitialized_memory
    yield
    torch.use_deterministic_algorithms(before)


def assert_finite(results):
    for i, x in enumerate(results):
        assert torch.isfinite(x).all(), f"result {i}: {int((~torch.isfinite(x)).sum())} numbers are not finite"


def is_named(rows: torch.Tensor, n_rows: int) -> torch.Tensor:
    """bool [n_rows], whether the list has the row."""
    named = torch.zeros(n_rows, dtype=torch.bool, device=rows.device)
    named[rows[(rows >= 0) & (rows < n_rows)]] = True
    return named


def listed(rows: torch.Tensor, cu: torch.Tensor) -> list[torch.Tensor]:
    """What segment i has: the entries of ``rows`` from cu[i] to cu[i + 1], as far as there are any."""
    cu = cu.clamp(0, len(rows)).tolist()
    return [rows[begin : max(begin, end)] for begin, end in zip(cu, cu[1:])]


def broken_lists():
    """(wrong entries of rows, wrong entries of offsets), one of them at a time."""
    return [(name, None) for name in INDICES] + [(None, name) for name in OFFSETS]


def broken(rows, cu, indices, offsets):
    return (INDICES[indices](rows) if indices else rows), (OFFSETS[offsets](cu) if offsets else cu)


N_ROWS, N_SEGMENTS = 90, 31


@pytest.mark.parametrize("channels", [8, 5, 33])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("indices, offsets", broken_lists())
def test_pool(indices, offsets, dtype, channels, devices):
    generator = torch.Generator().manual_seed(0)
    cuts = torch.randint(0, N_ROWS + 1, (N_SEGMENTS - 1,), generator=generator).sort().values
    cu = torch.cat([torch.tensor([0]), cuts, torch.tensor([N_ROWS])])
    rows, cu = (t.to(devices[1]) for t in broken(torch.randperm(N_ROWS, generator=generator), cu, indices, offsets))
    segments = listed(rows, cu)
    of_rows = is_named(torch.cat(segments), N_ROWS)
    of_segments = torch.tensor([bool(is_named(s, N_ROWS).any()) for s in segments], device=rows.device)
    x = torch.randn(N_ROWS, channels, generator=generator).to(devices[1], dtype)
    small = torch.randn(N_SEGMENTS, channels, generator=generator).to(devices[1], dtype)
    ops = {
        "max": (lambda x: pool_max(x, rows, cu), x, small, of_segments, of_rows),
        "mean": (lambda x: pool_mean(x, rows, cu), x, small, of_segments, of_rows),
        "unpool": (lambda x: unpool(x, rows, cu, N_ROWS), small, x, of_rows, of_segments),
    }
    for op, inputs, cotangent, has_result, has_gradient in ops.values():
        out, grad = gradients(op, [inputs], cotangent)
        assert_finite([out, grad])
        assert not out[~has_result].any() and not grad[~has_gradient].any()
        assert out[has_result].any() or not has_result.any()


def broken_maps():
    """(which list of a convolution, what is wrong with it)."""
    lists = [(name, wrong) for name in ("row_voxel", "rows", "tap_in", "tap_out") for wrong in INDICES]
    return lists + [(name, wrong) for name in ("cu_rows", "cu_taps") for wrong in OFFSETS]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("which, wrong", broken_maps())
def test_sparse_conv(which, wrong, dtype, devices):
    for n_rows, side, (c_in, c_out) in ((200, 5, (16, 24)), (1500, 40, (9, 5))):  # many rows a voxel, and one each
        voxels, kernel_map = geometry(random_cells(n_rows, side), 3, devices[1])
        spoil = (OFFSETS if which.startswith("cu") else INDICES)[wrong]
        part = voxels if hasattr(voxels, which) else kernel_map
        part = dataclasses.replace(part, **{which: spoil(getattr(part, which))})
        voxels, kernel_map = (part, kernel_map) if isinstance(part, Voxels) else (voxels, part)
        x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(n_rows, c_in, c_out, 3, dtype))
        named = is_named(voxels.rows, n_rows)
        for tables in ((voxels, kernel_map), with_plan(voxels, kernel_map)):
            for rule in RULES:
                out, grad_x, *others = gradients(convolution(*tables, rule), [x, weight, bias], cotangent)
                assert_finite([out, grad_x, *others])
                assert not out[~named].any() and not grad_x[~named].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_sparse_conv_without_voxels(dtype, devices):
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(40, 8, 16, 3, dtype))
    none = torch.full((40,), -1, device=devices[1])
    nothing = torch.zeros(0, dtype=torch.int64, device=devices[1])
    voxels = Voxels(none, none, torch.zeros(1, dtype=torch.int64, device=devices[1]))
    kernel_map = KernelMap(3, nothing, nothing, torch.zeros(28, dtype=torch.int64, device=devices[1]))
    out, grad_x, grad_weight, grad_bias = gradients(convolution(voxels, kernel_map), [x, weight, bias], cotangent)
    assert not out.any() and not grad_x.any() and not grad_weight.any() and grad_bias.isfinite().all()


def broken_tables():
    lists = [(name, wrong) for name in ("q_rows", "kv_rows") for wrong in INDICES]
    return lists + [(name, wrong) for name in ("cu_q", "cu_k") for wrong in OFFSETS]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("which, wrong", broken_tables())
def test_patch_attention(which, wrong, dtype, devices):
    for dim, heads in ((16, 2), (16, 96), (32, 2), (64, 2), (48, 2)):
        check_patch_attention(which, wrong, dim, heads, dtype, devices[1])


def check_patch_attention(which, wrong, dim, heads, dtype, device):
    case = random_case(((70, 90), (20, 33), (5, 0), (0, 7), (9, 40)), heads=heads, dim=dim, n_keys=100, dtype=dtype)
    spoil = (OFFSETS if which.startswith("cu") else INDICES)[wrong]
    table = dataclasses.replace(case.table, **{which: spoil(getattr(case.table, which))})
    case = dataclasses.replace(case, table=table).to(device)
    out, grad_q, grad_k, grad_v = gradients(case.attend, case.inputs, cotangent_of(case))
    assert_finite([out, grad_q, grad_k, grad_v])
    q_rows, kv_rows, cu_q, cu_k = lists(case.table)
    queries, keys = listed(q_rows, cu_q), listed(kv_rows, cu_k)
    n_q, n_k = len(case.q), len(case.k)
    asks = [q for q, k in zip(queries, keys) if is_named(k, n_k).any()]
    has_queries = is_named(torch.cat(asks), n_q) if asks else torch.zeros(n_q, dtype=torch.bool, device=out.device)
    answers = [k for q, k in zip(queries, keys) if is_named(q, n_q).any()]
    has_keys = is_named(torch.cat(answers), n_k) if answers else torch.zeros(n_k, dtype=torch.bool, device=out.device)
    assert not out[~has_queries].any() and not grad_q[~has_queries].any()
    assert not grad_k[~has_keys].any() and not grad_v[~has_keys].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("which, wrong", broken_tables())
def test_joint_attention(which, wrong, dtype, devices):
    """Of the table that joins; queries that it does not name have the bits of the other alone."""
    for dim in (16, 32, 64, 48):
        case = joint_case(dim=dim, dtype=dtype).to(devices[1])
        own, other = case.tables
        other = dataclasses.replace(
            other, **{which: (OFFSETS if which.startswith("cu") else INDICES)[wrong](getattr(other, which))}
        )
        case = dataclasses.replace(case, tables=(own, other))
        results = results_of(case)
        assert_finite(results)
        asks = is_named(torch.cat(listed(other.q_rows, other.cu_q)), len(case.q))
        alone = patch_attention(*case.inputs[:3], own, scale=case.scale)
        assert torch.equal(results[0][~asks], alone[~asks])


OVERLAP = ("first", "kv_rows", "cu_k", "codes", "order", "cu_clouds")


@pytest.mark.parametrize(
    "which, wrong",
    [(i, w) for i in (0, 1, 3, 4) for w in INDICES] + [(i, w) for i in (2, 5) for w in OFFSETS],
    ids=lambda x: OVERLAP[x] if isinstance(x, int) else x,
)
def test_overlapping_patches(which, wrong, devices):
    """Whatever the tables hold, attention can be given them."""
    arguments, size = overlap()
    spoil = (OFFSETS if which in (2, 5) else INDICES)[wrong]
    arguments[which] = (
        torch.stack([spoil(x) for x in arguments[which]]) if arguments[which].dim() > 1 else spoil(arguments[which])
    )
    case = random_case(((285, 150),), n_keys=1000, spare=0, dtype=torch.bfloat16).to(devices[1])
    for table in overlapping_patches(*(x.to(devices[1]) for x in arguments), patch_size=size):
        assert_finite(gradients(lambda *x: patch_attention(*x, table), case.inputs, cotangent_of(case)))


@pytest.mark.parametrize("indices, offsets", broken_lists())
def test_row_scenes_and_cells(indices, offsets, devices):
    scenes, cu, stages = chain()
    stages = [Segments(*(x.to(devices[1]) for x in broken(s.rows, s.cu_rows, indices, offsets))) for s in stages]
    known = {0, *scenes.tolist()}
    for found in row_scenes(scenes.to(devices[1]), cu.to(devices[1]), stages):
        assert set(found.tolist()) <= known
    cells, scene, grid = cells_and_rows()
    spoil = INDICES[indices or "far"]
    places = find_cells(*(x.to(devices[1]) for x in (spoil(cells), spoil(scene), grid)))
    assert ((places >= 0) & (places < len(cells))).all()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("heads", [2, 96])
def test_patch_without_a_valid_key_has_no_gradient(heads, dtype, devices):
    """Nor has it a part in the gradients of the other patches."""
    case = random_case(((70, 90), (20, 33)), heads=heads, dim=16, n_keys=100, dtype=dtype)
    q_rows, kv_rows, cu_q, cu_k = lists(case.table)
    kv_rows = torch.cat([kv_rows[:90], torch.full((33,), 10**6)])
    case = dataclasses.replace(case, table=PatchTable(q_rows, kv_rows, cu_q, cu_k)).to(devices[1])
    out, *grads = gradients(case.attend, case.inputs, cotangent_of(case))
    assert_finite([out, *grads])
    blind = case.table.q_rows[70:]
    assert not out[blind].any() and not grads[0][blind].any()
    alone = dataclasses.replace(case, table=PatchTable(*(t[:n] for t, n in zip(lists(case.table), (70, 90, 2, 2)))))
    for a, b in zip([out, *grads], gradients(alone.attend, alone.inputs, cotangent_of(alone)), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("indices, offsets", broken_lists())
def test_plane_sweep(indices, offsets, dtype, devices):
    arguments = make(((1, 2), (), (3, 1, 0), (3,), (5,), (4,)), channels=9, depths=7, dtype=dtype)
    arguments[4:] = broken(*arguments[4:], indices, offsets)
    features, *geometry = (t.to(devices[1]) for t in arguments)
    cost, grad = run(arguments, devices[1])
    assert_finite([cost, grad])
    sources = listed(geometry[3], geometry[4])
    blind = torch.tensor([not is_named(s, 6).any() for s in sources], device=cost.device)
    unseen = blind & ~is_named(torch.cat(sources), 6)
    assert not cost[blind].any() and not grad[unseen].any()
    assert torch.equal(cost, plane_sweep(features, *geometry))


@pytest.mark.parametrize("offsets", OFFSETS)
@pytest.mark.parametrize("indices", INDICES)
def test_sweep_geometry(indices, offsets, devices):
    Ks, viewmats = torch.eye(3).expand(3, 3, 3), torch.eye(4).expand(3, 4, 4)
    sources, cu = torch.tensor([1, 2, 0, 2, 1]), torch.tensor([0, 2, 4, 5])
    rows = [x.to(devices[1]) for x in (Ks, viewmats, INDICES[indices](sources), OFFSETS[offsets](cu))]
    homographies, translations = sweep_geometry(*rows)
    assert torch.equal(homographies.cpu(), torch.eye(3).expand(5, 3, 3)) and not translations.any()


def test_patch_attention_without_patches(devices):
    case = random_case(((70, 90),), n_keys=100, dtype=torch.bfloat16).to(devices[1])
    nothing = torch.zeros(1, dtype=torch.int64, device=devices[1])
    table = PatchTable(case.table.q_rows, case.table.kv_rows, nothing, nothing)
    results = gradients(lambda *x: patch_attention(*x, table, scale=case.scale), case.inputs, cotangent_of(case))
    assert not any(x.any() for x in results)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("which, wrong", [("image_cloud", w) for w in INDICES] + [("cu_rows", w) for w in OFFSETS])
def test_rasterizer(which, wrong, dtype, devices):
    """An image of no cloud, and all images where offsets do not ascend from 0 to the number of rows: the background."""
    scene = raster_scene.random_scene(n=80, clouds=4, dtype=dtype)
    spoil = (OFFSETS if which == "cu_rows" else INDICES)[wrong]
    scene = scene.replace(**{which: spoil(getattr(scene, which))}).to(devices[1])
    color, alpha, depth, features = scene.render()
    grads = raster_scene.gradients(scene.render, scene)
    assert_finite([color, alpha, depth, features, *grads])
    offsets = [0, *scene.cu_rows.tolist(), 80]
    empty = (scene.image_cloud < 0) | (scene.image_cloud >= 4)
    if offsets != sorted(offsets) or offsets[1] != 0 or offsets[-2] != 80:
        empty = torch.ones_like(empty)
    assert empty.any() or wrong == "one for all" or which == "cu_rows"  # halved offsets may ascend all the same
    assert not alpha[empty].any() and not depth[empty].any() and not features[empty].any()
    assert torch.equal(color[empty], scene.background[empty][:, None, None].expand_as(color[empty]))
    if empty.all():
        of_background = scene.NAMES.index("background")
        assert not any(grad.any() for i, grad in enumerate(grads) if i != of_background)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("offsets", OFFSETS)
def test_watched_rows(offsets, dtype, devices):
    fields, bounds, cu_rows, options = state(dtype=dtype, device=devices[1])
    cu_rows = OFFSETS[offsets](cu_rows)
    status, record, activity, *mended = look((fields, bounds, cu_rows, options))
    rows = torch.arange(len(status), device=status.device)
    watched = is_named(torch.cat(listed(rows, cu_rows)), len(rows))
    assert not status[~watched].any() and not (status == torch.iinfo(status.dtype).max).any()
    assert not record.isnan().any()
    assert torch.equal(activity[~watched], options["activity"][~watched])
    for field, own in zip(mended, fields, strict=True):
        assert torch.equal(field[~watched].nan_to_num(), own[~watched].nan_to_num())
