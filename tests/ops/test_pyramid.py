"""All geometry of a network call. The op has no gradients: sections 2 and 3 do not apply."""

import dataclasses
import itertools
import math

import pytest
import torch

from gsim3d.ops import PyramidSpec, build_pyramid
from tests.asserts import assert_same_bits_for_any_threads
from tests.oracle import pyramid as oracle

SPEC = PyramidSpec(
    grid_size=0.1,
    slot_bits=2,
    strides=(4, 2, 2),
    merge_windows=(2, 1, 8),
    patch_sizes=(16, 8, 8, 4),
    kernel_sizes=((5, 3), (3,), (3, 1), ()),
)
SHUFFLED = ((2, 0, 3, 1), (3, 2, 1, 0), (1, 0, 3, 2), (0, 0, 2, 2))


def scene(sizes=(40, 25, 30, 35, 1, 0, 20), seed=0, dtype=torch.float32, extent=1.2):
    """Seven clouds of three scenes with 4, 2 and 1 steps; rows of neighbouring steps share voxels."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(sum(sizes), 3, generator=generator, dtype=torch.float64) * extent
    positions[::7] = positions[:1].clone()
    return {
        "positions": positions.to(dtype),
        "cu_rows": torch.tensor([0, *itertools.accumulate(sizes)]),
        "cloud_scene": torch.tensor([0, 0, 0, 0, 1, 1, 2]),
        "cloud_slot": torch.tensor([0, 1, 2, 3, 2, 3, 3]),
        "origin": torch.tensor([[0.0, 0.0, 0.0], [-0.3, 0.01, -5.0], [0.5, -0.2, 0.0]], dtype=torch.float64),
    }


def flat(pyramid):
    """Every tensor of a pyramid."""
    result = [pyramid.rows, pyramid.cu_rows]
    for stage in pyramid.stages:
        result += [stage.grid, stage.cloud, stage.cu_clouds, stage.order]
        result += [t for table in stage.patches for t in (table.q_rows, table.kv_rows, table.cu_q, table.cu_k)]
        result += [stage.voxels.row_voxel, stage.voxels.rows, stage.voxels.cu_rows]
        result += [t for m in stage.kernel_maps.values() for t in (m.tap_in, m.tap_out, m.cu_taps)]
        result += [stage.cluster.rows, stage.cluster.cu_rows] if stage.cluster else []
        result += [stage.time_index] if stage.time_index is not None else []
    return result + ([] if pyramid.found is None else [pyramid.found])


def split(values, offsets):
    values, offsets = values.tolist(), offsets.tolist()
    assert offsets[0] == 0 and offsets[-1] == len(values)
    return [values[a:b] for a, b in itertools.pairwise(offsets)]


def on(device, arguments):
    return {name: tensor.to(device) for name, tensor in arguments.items()}


def assert_matches_oracle(arguments, spec, curves=None, device="cpu"):
    pyramid = build_pyramid(**on(device, arguments), spec=spec, curves=curves)
    lists = [t.tolist() for t in arguments.values()]
    rows, stages = oracle.build_pyramid(*lists, spec, curves or ((0, 1, 2, 3),) * spec.n_stages)
    assert pyramid.rows.tolist() == rows and pyramid.cu_rows.tolist() == list(range(len(rows) + 1))
    assert len(pyramid.stages) == len(stages)
    for stage, expected in zip(pyramid.stages, stages):
        assert [tuple(cell) for cell in stage.grid.tolist()] == expected["grid"]
        assert stage.cloud.tolist() == expected["cloud"]
        assert stage.cu_clouds.diff().tolist() == expected["cloud_sizes"]
        assert stage.n_clouds == len(expected["cloud_sizes"])
        assert stage.order.tolist() == expected["order"]
        for table, patches in zip(stage.patches, expected["patches"]):
            got = list(zip(split(table.q_rows, table.cu_q), split(table.kv_rows, table.cu_k)))
            assert got == patches
        assert split(stage.voxels.rows, stage.voxels.cu_rows) == expected["voxels"]
        for voxel, members in enumerate(expected["voxels"]):
            assert stage.voxels.row_voxel[members].eq(voxel).all()
        assert list(stage.kernel_maps) == list(expected["kernel_maps"])
        for size, taps in expected["kernel_maps"].items():
            m = stage.kernel_maps[size]
            assert m.kernel_size == size
            got = [list(zip(a, b)) for a, b in zip(split(m.tap_in, m.cu_taps), split(m.tap_out, m.cu_taps))]
            assert got == taps
        assert (split(stage.cluster.rows, stage.cluster.cu_rows) if stage.cluster else None) == expected["cluster"]
        assert (None if stage.time_index is None else stage.time_index.tolist()) == expected["time_index"]
    return pyramid


# 1 forward against the oracle


@pytest.mark.parametrize("curves", [None, SHUFFLED])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pyramid(dtype, curves, device):
    pyramid = assert_matches_oracle(scene(dtype=dtype), SPEC, curves, device)
    assert len(pyramid.rows) < 151  # scene 2 has rows below its origin
    assert [stage.time_index is not None for stage in pyramid.stages] == [False, True, False, True]


OTHER_NETWORKS = [
    PyramidSpec(0.05, 0, (), (), (1,), ((7, 1),)),
    PyramidSpec(0.3, 3, (1,), (2,), (1000, 7), ((3,), (5,))),
    PyramidSpec(2.0, 2, (2, 16), (4, 4), (5, 5, 5), ((3,), (3,), (3,))),
]


@pytest.mark.parametrize("spec", OTHER_NETWORKS)
def test_other_networks(spec, device):
    arguments = scene()
    if spec.slot_bits == 0:
        arguments |= {"cloud_scene": torch.arange(7), "cloud_slot": torch.zeros(7, dtype=torch.int64)}
        arguments["origin"] = torch.zeros(7, 3, dtype=torch.float64)
    assert_matches_oracle(arguments, spec, device=device)


def test_clouds_in_any_order(device):
    arguments = scene()
    arguments |= {"cloud_scene": torch.tensor([2, 0, 1, 0, 0, 1, 0]), "cloud_slot": torch.tensor([1, 3, 0, 0, 2, 3, 1])}
    assert_matches_oracle(arguments, SPEC, device=device)


@pytest.mark.parametrize("size", [2, 3, 16, 17, 31, 32, 33, 48, 50])
def test_last_patch_reads_a_whole_patch(size, device):
    arguments = scene((size, 0, 0, 0, 0, 0, 0))
    table = assert_matches_oracle(arguments, SPEC, device=device).stages[0].patches[1]
    assert table.cu_k.diff().tolist() == [min(size, 16)] * math.ceil(size / 16)


# 4 CPU against CUDA


def large_scene(n_scenes=3, steps=4, rows=4000, extent=1.0, seed=0, dtype=torch.float32):
    """Wavy sheets that move a little from step to step; some rows sleep, some share a place."""
    generator = torch.Generator().manual_seed(seed)
    n_clouds = n_scenes * steps
    sizes = [int(n) for n in torch.randint(rows // 2, rows, (n_clouds,), generator=generator)]
    sizes[1] = 0
    xy = torch.rand(sum(sizes), 2, generator=generator, dtype=torch.float64)
    positions = torch.cat([xy, 0.3 + 0.1 * torch.sin(6 * xy.sum(1, keepdim=True))], 1) * extent
    positions[5::97] = positions[:1].clone()
    positions[3::101, 1] = torch.tensor(-1e-3)
    positions[11::211, 2] = torch.nan
    order = torch.randperm(n_clouds, generator=generator)
    return {
        "positions": positions.to(dtype),
        "cu_rows": torch.tensor([0, *itertools.accumulate(sizes)]),
        "cloud_scene": order // steps,
        "cloud_slot": order % steps,
        "origin": torch.rand(n_scenes, 3, generator=generator, dtype=torch.float64) * -0.01,
    }


LARGE = PyramidSpec(0.01, 2, (4, 2, 2, 2), (2, 1, 2, 1), (1024, 64, 64, 64, 16), ((5, 3), (3,), (3,), (3,), (7,)))
ONE_CELL = dataclasses.replace(LARGE, grid_size=4.0)
NO_MERGE = dataclasses.replace(LARGE, merge_windows=(1, 1, 1, 1))
AT_ONCE = dataclasses.replace(LARGE, merge_windows=(64, 1, 1, 1), strides=(1, 16, 2, 1))


@pytest.mark.parametrize("curves", [None, (*SHUFFLED, (1, 1, 0, 3))], ids=["in order", "shuffled"])
@pytest.mark.parametrize("release", [False, True], ids=["ours", "release"])
@pytest.mark.parametrize("spec", [LARGE, ONE_CELL, NO_MERGE, AT_ONCE], ids=["large", "one cell", "no merge", "at once"])
def test_devices_agree(spec, release, curves, devices):
    spec = dataclasses.replace(spec, release=release)
    arguments = large_scene()
    on_cpu, on_cuda = (flat(build_pyramid(**on(device, arguments), spec=spec, curves=curves)) for device in devices)
    for expected, actual in zip(on_cpu, on_cuda, strict=True):
        assert actual.device.type == "cuda" and torch.equal(actual.cpu(), expected)


@pytest.mark.parametrize("n_scenes, steps, rows", [(1, 1, 200000), (300, 3, 8), (2, 2, 3)])
def test_devices_agree_at_any_size(n_scenes, steps, rows, devices):
    arguments = large_scene(n_scenes, max(steps, 2), rows, dtype=torch.float64)
    on_cpu, on_cuda = (flat(build_pyramid(**on(device, arguments), spec=LARGE)) for device in devices)
    for expected, actual in zip(on_cpu, on_cuda, strict=True):
        assert torch.equal(actual.cpu(), expected)


@pytest.mark.unsanitized("runs the kernels of test_devices_agree five times")
def test_cuda_gives_the_same_bits_every_time(devices):
    arguments = on(devices[1], large_scene())
    first = flat(build_pyramid(**arguments, spec=LARGE))
    for _ in range(3):
        for actual, expected in zip(flat(build_pyramid(**arguments, spec=LARGE)), first, strict=True):
            assert torch.equal(actual, expected)


@pytest.mark.unsanitized("runs the kernels of test_devices_agree twice")
def test_other_streams(devices):
    arguments = on(devices[1], large_scene())
    first = flat(build_pyramid(**arguments, spec=LARGE))
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        other = flat(build_pyramid(**arguments, spec=LARGE))
    torch.cuda.synchronize()
    for actual, expected in zip(other, first, strict=True):
        assert torch.equal(actual, expected)


# 5 opcheck


@pytest.mark.filterwarnings("error")
def test_opcheck(device):
    arguments = (*on(device, scene()).values(), 0.1, 2, [2], [2], [8, 8], [0, 1, 2, 3] * 2, [5, 3, 3], [0, 2, 3], False)
    for capacity in ([], [151, 9, 99, 999, 160, 9, 99, 999, 5000, 3000, 2000]):
        torch.library.opcheck(torch.ops.gsim3d.build_pyramid, (*arguments, capacity))


# 6 compile


def test_compile():
    def f(arguments, features):
        pyramid = build_pyramid(**arguments, spec=SPEC, curves=SHUFFLED)
        last = pyramid.stages[-1]
        return features[pyramid.rows].sum() + last.n_rows + last.n_clouds, flat(pyramid)

    compiled = torch.compile(f, fullgraph=True, backend="aot_eager")
    for sizes in ((40, 25, 30, 35, 1, 0, 20), (3, 0, 0, 9, 0, 0, 0)):
        arguments = scene(sizes)
        features = torch.arange(float(sum(sizes)))
        (total, tensors), (expected_total, expected) = compiled(arguments, features), f(arguments, features)
        assert torch.equal(total, expected_total)
        for a, b in zip(tensors, expected, strict=True):
            assert torch.equal(a, b)


# 7 edges


def test_empty_rows_and_clouds(device):
    empty = scene((0,) * 7)
    assert_matches_oracle(empty, SPEC, device=device)
    none = torch.zeros(0, dtype=torch.int64, device=device)
    origin = torch.zeros(0, 3, dtype=torch.float64, device=device)
    pyramid = build_pyramid(origin.float(), torch.tensor([0], device=device), none, none, origin, SPEC)
    assert [t.shape for t in flat(pyramid)] == [t.shape for t in flat(build_pyramid(**empty, spec=SPEC))]


def test_one_row(device):
    for cloud in range(7):
        sizes = [0] * 7
        sizes[cloud] = 1
        arguments = scene(sizes)
        arguments["positions"][:] = 1.0
        assert_matches_oracle(arguments, SPEC, device=device)


def test_all_rows_in_one_voxel(device):
    arguments = scene(extent=1e-3)
    arguments["origin"][:] = -0.05
    pyramid = assert_matches_oracle(arguments, SPEC, device=device)
    assert [stage.n_rows for stage in pyramid.stages] == [151, 6, 4, 4]
    assert pyramid.stages[3].n_clouds == 3


def test_sleeping_rows_leave_the_others_alone():
    arguments = scene((40, 25, 30, 35, 1, 0, 0))
    expected = build_pyramid(**arguments, spec=SPEC)
    far = SPEC.grid_size * 65536
    poison = torch.zeros(6, 3)
    poison[range(6), [0, 1, 2, 0, 1, 2]] = torch.tensor([math.nan, math.inf, -math.inf, far + 0.1, -1e-6, 3e38])
    positions = torch.cat([poison, arguments["positions"][:40], poison, arguments["positions"][40:]])
    cu_rows = arguments["cu_rows"] + 12
    cu_rows[0] = 0
    pyramid = build_pyramid(**(arguments | {"positions": positions, "cu_rows": cu_rows}), spec=SPEC)
    awake = torch.cat([torch.arange(6, 46), torch.arange(52, 52 + 91)])
    assert torch.equal(pyramid.rows, awake[expected.rows])
    for a, b in zip(flat(pyramid)[1:], flat(expected)[1:], strict=True):
        assert torch.equal(a, b)


def test_last_cell_takes_part(device):
    top = 65535.5 * 0.1
    arguments = scene((4, 0, 0, 0, 0, 0, 0), dtype=torch.float64)
    corners = [[top, top, top], [0.0, 0.0, 0.0], [top, 0.0, top], [top - 0.1, top, top]]
    arguments["positions"] = torch.tensor(corners, dtype=torch.float64)
    pyramid = assert_matches_oracle(arguments, SPEC, device=device)
    assert pyramid.stages[0].grid[0].tolist() == [65535] * 3 and len(pyramid.rows) == 4
    assert len(pyramid.stages[0].kernel_maps[3].tap_in) == 2  # nothing wraps around to the next column


def test_scenes_do_not_change_each_other():
    arguments = scene()
    whole = build_pyramid(**arguments, spec=SPEC)
    cu_rows = arguments["cu_rows"]
    starts, voxel_starts = [0] * SPEC.n_stages, [0] * SPEC.n_stages
    for b, (first, last) in enumerate([(0, 4), (4, 6), (6, 7)]):
        rows = slice(int(cu_rows[first]), int(cu_rows[last]))
        alone = build_pyramid(
            arguments["positions"][rows],
            cu_rows[first : last + 1] - cu_rows[first],
            torch.zeros(last - first, dtype=torch.int64),
            arguments["cloud_slot"][first:last],
            arguments["origin"][b : b + 1],
            SPEC,
        )
        for s, (stage, expected) in enumerate(zip(whole.stages, alone.stages)):
            here = slice(starts[s], starts[s] + expected.n_rows)
            assert torch.equal(stage.grid[here], expected.grid)
            assert torch.equal(stage.order[:, here] - starts[s], expected.order)
            if expected.time_index is not None:
                assert torch.equal(stage.time_index[here], expected.time_index)
            n_voxels = len(expected.voxels.cu_rows) - 1
            assert torch.equal(stage.voxels.row_voxel[here] - voxel_starts[s], expected.voxels.row_voxel)
            for size, taps in expected.kernel_maps.items():
                out = stage.kernel_maps[size].tap_out - voxel_starts[s]
                mine = (out >= 0) & (out < n_voxels)
                assert torch.equal(out[mine], taps.tap_out)
                assert torch.equal(stage.kernel_maps[size].tap_in[mine] - voxel_starts[s], taps.tap_in)
            starts[s] += expected.n_rows
            voxel_starts[s] += n_voxels
    assert starts == [stage.n_rows for stage in whole.stages]


def test_order_of_input_rows_permutes_the_results_only():
    arguments = scene()
    arguments["positions"] = torch.rand(151, 3, generator=torch.Generator().manual_seed(5))
    spec = dataclasses.replace(SPEC, grid_size=0.25)
    expected = build_pyramid(**arguments, spec=spec, curves=SHUFFLED)
    assert len(expected.stages[0].voxels.cu_rows) - 1 < expected.stages[0].n_rows  # some rows share a voxel
    generator = torch.Generator().manual_seed(6)
    offsets = arguments["cu_rows"].tolist()
    order = torch.cat([a + torch.randperm(b - a, generator=generator) for a, b in itertools.pairwise(offsets)])
    moved = build_pyramid(**(arguments | {"positions": arguments["positions"][order]}), spec=spec, curves=SHUFFLED)
    was = order[moved.rows]  # input row, before the permutation, of each row of stage 0
    assert torch.equal(was[moved.stages[0].order], expected.rows[expected.stages[0].order])
    assert torch.equal(was[moved.stages[1].cluster.rows], expected.rows[expected.stages[1].cluster.rows])
    for a, b in zip(moved.stages[1:], expected.stages[1:]):
        assert torch.equal(a.grid, b.grid) and torch.equal(a.cloud, b.cloud) and torch.equal(a.order, b.order)
        assert torch.equal(a.cluster.cu_rows, b.cluster.cu_rows)


def test_moving_scene_and_origin_changes_nothing():
    arguments = scene(dtype=torch.float64)
    step = torch.tensor([[512.0, -1024.0, 256.0]], dtype=torch.float64)
    arguments["positions"] = (arguments["positions"] * 2**20).round() / 2**20
    arguments["origin"] = (arguments["origin"] * 2**20).round() / 2**20
    moved = arguments | {"positions": arguments["positions"] + step, "origin": arguments["origin"] + step}
    for a, b in zip(flat(build_pyramid(**arguments, spec=SPEC)), flat(build_pyramid(**moved, spec=SPEC)), strict=True):
        assert torch.equal(a, b)


def test_non_contiguous_and_gradients():
    arguments = scene()
    expected = flat(build_pyramid(**arguments, spec=SPEC))
    arguments["positions"] = arguments["positions"].t().contiguous().t().requires_grad_()
    arguments["cu_rows"] = arguments["cu_rows"].repeat_interleave(2)[::2]
    for a, b in zip(flat(build_pyramid(**arguments, spec=SPEC)), expected, strict=True):
        assert torch.equal(a, b) and not a.requires_grad


def test_more_clouds_than_the_published_codes_hold(device):
    arguments = {
        "positions": torch.rand(400, 3, generator=torch.Generator().manual_seed(0)),
        "cu_rows": torch.arange(0, 401, 4),
        "cloud_scene": torch.arange(100),
        "cloud_slot": torch.zeros(100, dtype=torch.int64),
        "origin": torch.zeros(100, 3, dtype=torch.float64),
    }
    assert assert_matches_oracle(arguments, SPEC, device=device).stages[0].n_clouds == 100


def test_any_number_of_threads():
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(50000, 3, generator=generator)
    zero = torch.zeros(1, dtype=torch.int64)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    spec = dataclasses.replace(SPEC, grid_size=0.03, patch_sizes=(1024,) * 4)
    arguments = (positions, torch.tensor([0, 50000]), zero, zero, origin, spec)
    assert_same_bits_for_any_threads(lambda: flat(build_pyramid(*arguments)))


# The published model's geometry; the golden tests compare the rest of it


def test_release_couples_clouds_and_orders_ties_by_row(device):
    spec = dataclasses.replace(SPEC, release=True)
    arguments = scene()
    arguments["positions"][100] = float("nan")
    pyramid = build_pyramid(**on(device, arguments), spec=spec)
    assert pyramid.rows.tolist() == [i for i in range(151) if i != 100]
    kept = arguments["positions"][pyramid.rows.cpu()]
    grid = ((kept - kept.amin(0)) / 0.1).trunc().long()
    assert torch.equal(pyramid.stages[0].grid.cpu(), grid)
    for order in pyramid.stages[0].order:
        for voxel in split(pyramid.stages[0].voxels.rows, pyramid.stages[0].voxels.cu_rows):
            assert [i for i in order.tolist() if i in voxel] == voxel


def test_release_does_not_pool_below_one_level(device):
    spec = PyramidSpec(1.0, 2, (4,), (1,), (8, 8), ((3,), (3,)), release=True)
    pyramid = build_pyramid(**on(device, scene(extent=0.9)), spec=spec)  # one cell: one level, the stride takes two
    assert pyramid.stages[1].n_rows == 6


def test_release_extent(device):
    arguments = scene()
    arguments["positions"][0] = 3277.5
    with pytest.raises(ValueError, match=r"with release, positions must span fewer than 2\^15 cells .* on axis 0"):
        build_pyramid(**on(device, arguments), spec=dataclasses.replace(SPEC, release=True))


# 8 errors


@pytest.mark.parametrize(
    "change, message",
    [
        ({"positions": torch.zeros(151, 2)}, r"positions must be \[N, 3\]"),
        ({"positions": torch.zeros(151, 3).half()}, "positions must be float32 or float64; got float16"),
        ({"cu_rows": torch.tensor([0, 9, 9, 9, 9, 9, 9, 150])}, "cu_rows must run from 0 to N=151; got 0 .. 150"),
        ({"cu_rows": torch.tensor([0, 40, 65, 60, 70, 70, 70, 151])}, "cu_rows must not descend; got 65 then 60 at 2"),
        ({"cu_rows": torch.tensor([0, 400, 9, 9, 9, 9, 9, 151])}, "cu_rows must not descend; got 400 then 9 at 1"),
        ({"cu_rows": torch.zeros(8)}, "cu_rows must be int64; got float32"),
        ({"cu_rows": torch.zeros(0, dtype=torch.int64)}, r"cu_rows must be \[Q \+ 1\]; got \[0\]"),
        ({"cloud_scene": torch.tensor([0, 0, 0, 0, 1, 1, 3])}, r"cloud_scene must be in \[0, B\) .* got 3 at 6"),
        ({"cloud_scene": torch.tensor([0])}, r"cloud_scene must be \[Q\]"),
        ({"cloud_slot": torch.tensor([0, 1, 2, 4, 2, 3, 3])}, r"cloud_slot must be in \[0, 4\); got 4 at 3"),
        ({"cloud_slot": torch.tensor([0, 1, 2, 3, 2, 2, 3])}, "cloud_slot must differ .* got slot 2 twice in scene 1"),
        ({"origin": torch.zeros(3, 3)}, "origin must be float64; got float32"),
        ({"origin": torch.full((3, 3), math.inf, dtype=torch.float64)}, "origin must be finite; got inf in scene 0"),
    ],
)
def test_errors(change, message, device):
    with pytest.raises(ValueError, match="build_pyramid: .*" + message):
        build_pyramid(**on(device, scene() | change), spec=SPEC)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"grid_size": 0.0}, "grid_size must be positive; got 0"),
        ({"grid_size": math.nan}, "grid_size must be positive; got nan"),
        ({"slot_bits": 33}, r"slot_bits must be in \[0, 32\]; got 33"),
        ({"strides": (3, 2, 2)}, "strides must be powers of two; got 3"),
        ({"strides": (2, 2)}, "strides must have 3 entries for 4 stages; got 2"),
        ({"strides": (256, 256, 2)}, r"strides must multiply to at most 2\^15; got 2\^17"),
        ({"merge_windows": (0, 1, 1)}, "merge_windows must be powers of two; got 0"),
        ({"patch_sizes": (0, 8, 8, 8)}, "patch_sizes must be positive; got 0"),
        ({"kernel_sizes": ((2,), (), (), ())}, r"kernel_sizes must be odd and in \[1, 15\]; got 2"),
    ],
)
def test_spec_errors(change, message):
    with pytest.raises(ValueError, match="build_pyramid: " + message):
        build_pyramid(**scene(), spec=dataclasses.replace(SPEC, **change))


def test_curve_errors():
    with pytest.raises(ValueError, match=r"curves must be in \[0, 4\); got 4"):
        build_pyramid(**scene(), spec=SPEC, curves=((0, 1, 2, 4),) * 4)
    with pytest.raises(ValueError, match="curves must have 16 entries for 4 stages; got 12"):
        build_pyramid(**scene(), spec=SPEC, curves=((0, 1, 2),) * 4)
