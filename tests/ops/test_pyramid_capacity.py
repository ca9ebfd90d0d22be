"""Pyramids of given sizes: the data of those that fit, and behind it rows that nothing reads."""

import dataclasses
import itertools
import math

import pytest
import torch

from gsim3d.ops import PyramidCapacity, build_pyramid
from tests.cuda_graph import captured
from tests.ops.test_pyramid import AT_ONCE, LARGE, ONE_CELL, SHUFFLED, SPEC, flat, large_scene, on, scene

# 1 forward against pyramids that fit


def counts_of(pyramid):
    """In the order of PyramidCapacity.sizes."""
    per_stage = [(s.n_rows, s.n_clouds, len(s.patches[0].cu_q) - 1, len(s.patches[0].kv_rows)) for s in pyramid.stages]
    return [*itertools.chain(*per_stage), *(len(m.tap_in) for s in pyramid.stages for m in s.kernel_maps.values())]


def assert_begins_with(given, exact, filler):
    """The values of ``exact`` [..., n] with ``filler`` [..., rest] behind them."""
    n = exact.shape[-1]
    assert torch.equal(given[..., :n], exact)
    assert torch.equal(given[..., n:], filler.expand_as(given)[..., n:])


def assert_holds(given, exact, n_rows):
    """``given`` has the data of ``exact``, and behind it rows that are in no patch, pair or cluster."""
    n0 = exact.stages[0].n_rows
    sleeping = sorted(set(range(n_rows)) - set(exact.rows.tolist()))
    assert given.rows.tolist() == exact.rows.tolist() + sleeping
    assert_begins_with(given.cu_rows, exact.cu_rows, given.cu_rows.new_tensor(n0))
    for stage, expected in zip(given.stages, exact.stages, strict=True):
        zero, place = stage.order.new_tensor(0), torch.arange(stage.n_rows, device=stage.order.device)
        n, n_voxels = expected.n_rows, len(expected.voxels.cu_rows) - 1
        assert_begins_with(stage.grid.mT, expected.grid.mT, zero)
        assert_begins_with(stage.cloud, expected.cloud, zero)
        assert_begins_with(stage.cu_clouds, expected.cu_clouds, zero + n)
        assert_begins_with(stage.order, expected.order, place)
        for table, patches in zip(stage.patches, expected.patches, strict=True):
            assert_begins_with(table.q_rows, patches.q_rows, place)
            assert_begins_with(table.cu_q, patches.cu_q, zero + n)
            assert_begins_with(table.cu_k, patches.cu_k, zero + len(patches.kv_rows))
            assert_begins_with(table.kv_rows, patches.kv_rows, zero)
        own_voxels = (torch.arange(stage.n_rows + 2, device=place.device) - n_voxels + n).clamp(max=stage.n_rows)
        assert_begins_with(stage.voxels.row_voxel, expected.voxels.row_voxel, place - n + n_voxels)
        assert_begins_with(stage.voxels.rows, expected.voxels.rows, place)
        assert_begins_with(stage.voxels.cu_rows, expected.voxels.cu_rows, own_voxels)
        for size, taps in expected.kernel_maps.items():
            m = stage.kernel_maps[size]
            assert_begins_with(m.tap_in, taps.tap_in, zero)
            assert_begins_with(m.tap_out, taps.tap_out, zero)
            assert torch.equal(m.cu_taps, taps.cu_taps)
        if expected.cluster is not None:
            assert_begins_with(stage.cluster.cu_rows, expected.cluster.cu_rows, expected.cluster.cu_rows[-1])
        if expected.time_index is not None:
            assert_begins_with(stage.time_index, expected.time_index, zero)


@pytest.mark.parametrize("factor", [1.0, 1.25, 3.0])
@pytest.mark.parametrize("curves", [None, SHUFFLED])
def test_given_sizes_hold_the_same_data(curves, factor, device):
    arguments = on(device, scene())
    exact = build_pyramid(**arguments, spec=SPEC, curves=curves)
    capacity = PyramidCapacity.of(exact, 151, factor)
    assert capacity.sizes[0] == 151 and all(a >= b for a, b in zip(capacity.sizes, counts_of(exact), strict=True))
    given = build_pyramid(**arguments, spec=SPEC, curves=curves, capacity=capacity)
    assert [s.n_rows for s in given.stages] == list(capacity.sizes[0 : 4 * SPEC.n_stages : 4])
    assert given.found.tolist() == [0, *counts_of(exact)] and capacity.fits(given.found.tolist())
    assert_holds(given, exact, 151)


@pytest.mark.unsanitized("runs the kernels of test_devices_agree_on_given_sizes many times")
def test_misfitting_checkpoint_writes_nothing(device):
    arguments = on(device, scene())
    exact = build_pyramid(**arguments, spec=SPEC)
    capacity = PyramidCapacity.of(exact, 151, 1.0)
    asleep = arguments | {"positions": torch.full_like(arguments["positions"], math.nan)}
    empty = build_pyramid(**asleep, spec=SPEC)
    for i in (i for i, size in enumerate(capacity.sizes) if i > 0 and size > 0):
        sizes = list(capacity.sizes)
        sizes[i] -= 1
        small = PyramidCapacity(SPEC.n_stages, tuple(sizes))
        given = build_pyramid(**arguments, spec=SPEC, capacity=small)
        found = given.found.tolist()
        assert found == [PyramidCapacity.TOO_LARGE, *counts_of(exact)] and not small.fits(found)
        assert_holds(given, empty, 151)
        assert small.grown(found, 1.0) == capacity
    rows, *others = counts_of(exact)
    grown = capacity.grown([PyramidCapacity.TOO_LARGE, rows, *(2 * count for count in others)])
    assert grown.sizes[0] == 151 and grown.sizes[1] == math.ceil(2.5 * exact.stages[0].n_clouds)


def test_malformed_clouds_of_given_sizes_are_reported_later(devices):
    arguments = scene() | {"cloud_slot": torch.tensor([0, 1, 2, 3, 2, 2, 3])}
    capacity = PyramidCapacity.of(build_pyramid(**scene(), spec=SPEC), 151)
    with pytest.raises(ValueError, match="cloud_slot must differ"):
        build_pyramid(**arguments, spec=SPEC, capacity=capacity)
    given = build_pyramid(**on(devices[1], arguments), spec=SPEC, capacity=capacity)
    assert not given.stages[0].patches[0].cu_q.any()
    with pytest.raises(ValueError, match="cu_rows, cloud_scene, cloud_slot or origin is malformed"):
        capacity.fits(given.found.tolist())


def check_rounded(arguments, spec):
    exact, given = (build_pyramid(**arguments, spec=spec, rounded=rounded) for rounded in (False, True))
    n_rows = len(arguments["positions"])
    assert given.found.tolist() == [0, *counts_of(exact)]
    assert [s.n_data for s in given.stages] == [s.n_data for s in exact.stages] == [s.n_rows for s in exact.stages]
    per_stage = 4 * spec.n_stages
    for i, (size, count) in enumerate(zip(counts_of(given), counts_of(exact), strict=True)):
        is_cloud, is_rows = i < per_stage and i % 4 == 1, i < per_stage and i % 4 == 0
        assert count <= size <= (n_rows if i == 0 else count if is_cloud else count * 33 / 32)
        assert i == 0 or is_cloud or size == n_rows * is_rows or size % max(1, 2 ** (size.bit_length() - 6)) == 0
    assert_holds(given, exact, n_rows)


def test_rounded_sizes_hold_the_same_data(device):
    check_rounded(on(device, scene()), SPEC)


def test_rounded_sizes_are_no_given_ones():
    capacity = PyramidCapacity.of(build_pyramid(**scene(), spec=SPEC), 151)
    with pytest.raises(ValueError, match="rounded must be false where a capacity is given"):
        build_pyramid(**scene(), spec=SPEC, capacity=capacity, rounded=True)
    with pytest.raises(TypeError, match="rounded must be true or false; got 1"):
        build_pyramid(**scene(), spec=SPEC, rounded=1)


# 4 CPU against CUDA


@pytest.mark.parametrize("spec", [LARGE, ONE_CELL, AT_ONCE], ids=["large", "one cell", "at once"])
def test_devices_agree_on_rounded_sizes(spec, devices):
    arguments = large_scene()
    on_cpu, on_cuda = (flat(build_pyramid(**on(d, arguments), spec=spec, rounded=True)) for d in devices)
    for expected, actual in zip(on_cpu, on_cuda, strict=True):
        assert actual.device.type == "cuda" and torch.equal(actual.cpu(), expected)
    check_rounded(on(devices[1], arguments), spec)


@pytest.mark.parametrize("release", [False, True], ids=["ours", "release"])
@pytest.mark.parametrize("spec", [LARGE, ONE_CELL, AT_ONCE], ids=["large", "one cell", "at once"])
def test_devices_agree_on_given_sizes(spec, release, devices):
    spec = dataclasses.replace(spec, release=release)
    arguments = large_scene()
    n_rows = len(arguments["positions"])
    capacity = PyramidCapacity.of(build_pyramid(**arguments, spec=spec), n_rows)
    small = dataclasses.replace(capacity, sizes=(n_rows, *(size // 2 for size in capacity.sizes[1:])))
    for sizes in (capacity, small):
        on_cpu, on_cuda = (flat(build_pyramid(**on(d, arguments), spec=spec, capacity=sizes)) for d in devices)
        for expected, actual in zip(on_cpu, on_cuda, strict=True):
            assert actual.device.type == "cuda" and torch.equal(actual.cpu(), expected)


def test_graph_makes_the_pyramid_of_other_positions(devices):
    arguments = on(devices[1], large_scene())
    capacity = PyramidCapacity.of(build_pyramid(**arguments, spec=LARGE), len(arguments["positions"]))
    graph, given = captured(lambda: flat(build_pyramid(**arguments, spec=LARGE, capacity=capacity)))
    for seed in (1, 2):
        moved = large_scene(seed=seed)["positions"][: len(arguments["positions"])]
        arguments["positions"][: len(moved)] = moved.cuda()
        graph.replay()
        expected = flat(build_pyramid(**arguments, spec=LARGE, capacity=capacity))
        for a, b in zip(given, expected, strict=True):
            assert torch.equal(a, b)


# 6 compile


def test_compile_of_given_sizes():
    capacity = PyramidCapacity.of(build_pyramid(**scene(), spec=SPEC), 151)
    compiled = torch.compile(
        lambda arguments: flat(build_pyramid(**arguments, spec=SPEC, capacity=capacity)),
        fullgraph=True,
        backend="aot_eager",
    )
    expected = flat(build_pyramid(**scene(), spec=SPEC, capacity=capacity))
    for a, b in zip(compiled(scene()), expected, strict=True):
        assert torch.equal(a, b)


# 7 edges


def test_given_sizes_without_rows(device):
    empty = on(device, scene((0,) * 7))
    exact = build_pyramid(**empty, spec=SPEC)
    given = build_pyramid(**empty, spec=SPEC, capacity=PyramidCapacity.of(exact, 0))
    assert given.found[0] == 0
    assert_holds(given, exact, 0)


# 8 errors


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda sizes: sizes[:-1], "capacity must have 21 entries for 4 stages; got 20"),
        (lambda sizes: (150, *sizes[1:]), "capacity must be made for the N=151 rows of positions; got 150"),
        (lambda sizes: (*sizes[:5], -1, *sizes[6:]), "capacity must not be negative; got -1 at 5"),
    ],
)
def test_capacity_errors(change, message, device):
    arguments = on(device, scene())
    sizes = PyramidCapacity.of(build_pyramid(**arguments, spec=SPEC), 151).sizes
    with pytest.raises(ValueError, match=f"build_pyramid: {message}"):
        build_pyramid(**arguments, spec=SPEC, capacity=PyramidCapacity(4, change(sizes)))
