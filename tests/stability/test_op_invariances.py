"""Invariances of the ops, forward and backward: equal bits where the same sums are formed, else to a bound."""

import dataclasses

import pytest
import torch

from gsim3d.math.spherical_harmonics import rotate_harmonics
from gsim3d.ops import (
    PatchTable,
    build_pyramid,
    curve_encode,
    curve_sort,
    patch_attention,
    plane_sweep,
    pool_max,
    pool_mean,
    residual_norm,
    row_norm,
    sparse_conv,
    sweep_geometry,
    unpool,
)
from gsim3d.testing.invariances import random_motion
from tests.asserts import assert_close_relative_to_max, assert_same_bits, gradients
from tests.ops.raster_scene import Scene, gradients as raster_gradients, random_scene
from tests.ops.test_patch_attn import random_case
from tests.ops.test_pyramid import SPEC, flat, on, scene as pyramid_scene
from tests.ops.test_sparse_conv import geometry, parameters, random_cells

pytestmark = pytest.mark.usefixtures("one_thread")

BOUNDS = {torch.float32: "law_float32", torch.float64: "law_float64"}
DTYPES = pytest.mark.parametrize("dtype", BOUNDS, ids=["float32", "float64"])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def normal(*shape, dtype=torch.float64, seed=0):
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64).to(dtype)


def to(device, *tensors):
    return [t.to(device) for t in tensors]


# curves
@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_curve_axis_exchange(curve, device):
    grid = torch.randint(0, 1 << 16, (300, 3), generator=generator()).to(device)
    assert torch.equal(curve_encode(grid[:, [1, 0, 2]], None, curve), curve_encode(grid, None, f"{curve}-trans"))


@pytest.mark.parametrize("curve", ["z", "z-trans", "hilbert", "hilbert-trans"])
def test_curve_codes_are_independent(curve, device):
    grid = torch.randint(0, 1 << 16, (300, 3), generator=generator()).to(device)
    cloud = (torch.arange(300) % 5).to(device)
    codes, order = curve_encode(grid, cloud, curve), torch.randperm(300, generator=generator(1)).to(device)
    assert torch.equal(curve_encode(grid[order], cloud[order], curve), codes[order])
    halves = [curve_encode(grid[part], cloud[part], curve) for part in (slice(0, 117), slice(117, None))]
    assert torch.equal(torch.cat(halves), codes)
    assert torch.equal(curve_encode(grid, cloud + 3, curve) - codes, torch.full_like(codes, 3 << 48))


def test_z_codes_translate(device):
    grid = torch.randint(0, 1 << 8, (200, 3), generator=generator()).to(device)
    block = torch.tensor([[3, 5, 200]], device=device) << 8
    moved = curve_encode(grid + block, None, "z")
    assert torch.equal(moved, curve_encode(grid, None, "z") + curve_encode(block, None, "z"))


def test_curve_sort_permutation_invariance(device):
    codes = torch.randint(0, 1 << 62, (3, 200), generator=generator()).to(device)
    order, _ = curve_sort(codes)
    shuffle = torch.randperm(200, generator=generator(1)).to(device)
    shuffled, _ = curve_sort(codes[:, shuffle].contiguous())
    assert torch.equal(shuffle[shuffled], order)
    for row in range(3):
        assert torch.equal(curve_sort(codes[row : row + 1])[0][0], order[row])
    assert torch.equal(curve_sort(torch.cat([codes, codes]))[0], torch.cat([order, order]))


# build_pyramid
def grained(dtype):
    """The scene of the pyramid's tests on a grain of 2^-12 m, so that it can be moved without rounding."""
    arguments = pyramid_scene(dtype=torch.float64)
    arguments["positions"] = ((arguments["positions"] * 4096).round() / 4096).to(dtype)
    arguments["origin"] = (arguments["origin"] * 4096).round() / 4096
    return arguments


def assert_same_pyramid(actual, expected):
    for a, b in zip(flat(actual), flat(expected), strict=True):
        assert torch.equal(a, b)


@DTYPES
def test_pyramid_translation_with_origin(dtype, device):
    arguments = on(device, grained(dtype))
    shift = torch.tensor([12.5, -3.25, 7.0], dtype=torch.float64, device=device)
    moved = arguments | {"positions": arguments["positions"] + shift.to(dtype), "origin": arguments["origin"] + shift}
    assert_same_pyramid(build_pyramid(**moved, spec=SPEC), build_pyramid(**arguments, spec=SPEC))


@DTYPES
def test_pyramid_translation_by_cells(dtype, device):
    spec = dataclasses.replace(SPEC, grid_size=0.125)
    arguments = on(device, grained(dtype))
    arguments["origin"][:] = -4.0
    cells = torch.tensor([16, 32, 48], device=device)  # whole cells of every stage
    moved = arguments | {"positions": arguments["positions"] + 0.125 * cells.to(dtype)}
    stages, others = (build_pyramid(**a, spec=spec).stages for a in (arguments, moved))
    total = 1
    for s, (stage, other) in enumerate(zip(stages, others, strict=True)):
        total *= spec.strides[s - 1] if s else 1
        # Rows of later stages are numbered along a curve, which is another one at another place.
        keys = [sorted(map(tuple, torch.cat([g.cloud[:, None], grid], 1).tolist()))
                for g, grid in ((stage, stage.grid + cells // total), (other, other.grid))]  # fmt: skip
        assert keys[0] == keys[1]
        for size in stage.kernel_maps:
            assert torch.equal(stage.kernel_maps[size].cu_taps, other.kernel_maps[size].cu_taps)


@DTYPES
def test_pyramid_rotation(dtype, device):
    """Exchanging x and y, and each curve with its transpose, exchanges the coordinates of the cells and no more."""
    arguments = on(device, pyramid_scene(dtype=dtype))
    axes = [1, 0, 2]
    turned = arguments | {"positions": arguments["positions"][:, axes], "origin": arguments["origin"][:, axes]}
    curves = ((1, 0, 3, 2),) * SPEC.n_stages
    stages = build_pyramid(**arguments, spec=SPEC).stages
    for stage, other in zip(stages, build_pyramid(**turned, spec=SPEC, curves=curves).stages, strict=True):
        assert torch.equal(other.cloud, stage.cloud) and torch.equal(other.cu_clouds, stage.cu_clouds)
        if stage is stages[0]:
            assert torch.equal(other.grid, stage.grid[:, axes])
        # Rows of one cell are ordered by position, x first: compare cells.
        for row in range(4):
            assert torch.equal(other.grid[other.order[row]], stage.grid[stage.order[row]][:, axes])


@DTYPES
def test_pyramid_permutation_invariance(dtype, device):
    arguments = pyramid_scene(dtype=dtype)
    arguments["positions"] += 1e-3 * normal(*arguments["positions"].shape, dtype=dtype).abs()  # no two at one place
    arguments["origin"][:] = -0.5  # no row sleeps
    cu = arguments["cu_rows"].tolist()
    order = torch.cat([a + torch.randperm(b - a, generator=generator(a)) for a, b in zip(cu, cu[1:])]).to(device)
    arguments = on(device, arguments)
    pyramid = build_pyramid(**arguments, spec=SPEC)
    other = build_pyramid(**arguments | {"positions": arguments["positions"][order]}, spec=SPEC)
    first, second = pyramid.stages[0], other.stages[0]
    assert torch.equal(second.grid, first.grid[order])
    assert torch.equal(order[second.order], first.order)
    for stage, twin in zip(pyramid.stages[1:], other.stages[1:], strict=True):
        assert torch.equal(twin.grid, stage.grid) and torch.equal(twin.order, stage.order)
        assert torch.equal(twin.cluster.cu_rows, stage.cluster.cu_rows)
    assert torch.equal(order[other.stages[1].cluster.rows], pyramid.stages[1].cluster.rows)


@DTYPES
def test_pyramid_keeps_scenes_apart(dtype, device):
    arguments = on(device, pyramid_scene(dtype=dtype))
    pyramid = build_pyramid(**arguments, spec=SPEC)
    cu, scenes = arguments["cu_rows"], arguments["cloud_scene"]
    rows, counts = [0] * SPEC.n_stages, [0] * SPEC.n_stages
    for scene in range(3):
        own = (scenes == scene).nonzero()[:, 0]
        begin, end = int(cu[own[0]]), int(cu[own[-1] + 1])
        alone = build_pyramid(
            arguments["positions"][begin:end],
            cu[own[0] : own[-1] + 2] - begin,
            scenes[own] * 0,
            arguments["cloud_slot"][own],
            arguments["origin"][scene : scene + 1],
            SPEC,
        )
        for s, (stage, part) in enumerate(zip(pyramid.stages, alone.stages, strict=True)):
            mine = slice(rows[s], rows[s] + part.n_rows)
            assert torch.equal(stage.grid[mine], part.grid)
            assert torch.equal(stage.cloud[mine] - counts[s], part.cloud)
            assert torch.equal(stage.order[:, mine] - rows[s], part.order)
            rows[s] += part.n_rows
            counts[s] += part.n_clouds
    assert rows == [stage.n_rows for stage in pyramid.stages]


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e6, 1e6])
def test_pyramid_ignores_sleeping_rows(bad, device):
    arguments = on(device, pyramid_scene())
    pyramid = build_pyramid(**arguments, spec=SPEC)
    n = int(arguments["cu_rows"][-1])
    cu_rows = arguments["cu_rows"].clone()
    cu_rows[-1] += 1
    far = torch.cat([arguments["positions"], torch.full((1, 3), bad, device=device)])
    assert_same_pyramid(build_pyramid(**arguments | {"positions": far, "cu_rows": cu_rows}, spec=SPEC), pyramid)
    assert n not in pyramid.rows


# sparse_conv
def convolve(cells, x, weight, bias, cotangent, device):
    voxels, kernel_map = geometry(cells, weight.shape[1], device)
    inputs = to(device, x, weight, bias)
    return gradients(lambda *args: sparse_conv(*args, voxels, kernel_map), inputs, cotangent)


@DTYPES
@pytest.mark.parametrize("axes", [(0, 1), (1, 2), (0, 2)])
def test_sparse_conv_rotation(axes, dtype, device):
    """A turn by 90 degrees of cells and weights: the same rows."""
    cells, (x, weight, bias, cotangent) = random_cells(60, 4), parameters(60, 5, 7, 3, dtype)
    turned = cells.clone()
    turned[:, 1 + axes[0]], turned[:, 1 + axes[1]] = -cells[:, 1 + axes[1]], cells[:, 1 + axes[0]]
    rotated = torch.rot90(weight, -1, (1 + axes[1], 1 + axes[0]))
    expected = convolve(cells, x, weight, bias, cotangent, device)
    actual = convolve(turned, x, rotated, bias, cotangent, device)
    back = torch.rot90(actual[2], 1, (1 + axes[1], 1 + axes[0]))
    for a, b in zip((actual[0], actual[1], back, actual[3]), expected, strict=True):
        assert_close_relative_to_max(a, b, BOUNDS[dtype])


@DTYPES
def test_sparse_conv_translation(dtype, device):
    cells, arguments = random_cells(60, 3, clouds=3), parameters(60, 5, 7, 3, dtype)
    expected = convolve(cells, *arguments, device)
    shift = torch.tensor([0, 1000, -7, 40])
    for actual, value in zip(convolve(cells + shift, *arguments, device), expected, strict=True):
        assert_same_bits(actual, value)
    x, weight, bias, cotangent = arguments
    for cloud in range(3):
        own = cells[:, 0] == cloud
        alone = convolve(cells[own], x[own], weight, bias, cotangent[own], device)
        assert_same_bits(alone[0], expected[0][own.to(device)])
        assert_same_bits(alone[1], expected[1][own.to(device)])


@DTYPES
def test_sparse_conv_permutation_invariance(dtype, device):
    cells, (x, weight, bias, cotangent) = random_cells(60, 3), parameters(60, 5, 7, 3, dtype)
    order = torch.randperm(60, generator=generator(3))
    out, grad_x, grad_weight, _ = convolve(cells, x, weight, bias, cotangent, device)
    other = convolve(cells[order], x[order], weight, bias, cotangent[order], device)
    for actual, expected in zip(other, (out[order.to(device)], grad_x[order.to(device)], grad_weight), strict=False):
        assert_close_relative_to_max(actual, expected, BOUNDS[dtype])


# patch_attention
@DTYPES
def test_attention_permutation_invariance(dtype, device):
    case = random_case(dtype=dtype).to(device)
    n_q, n_k, cotangent = len(case.q), len(case.k), normal(*case.q.shape, dtype=dtype).to(device)
    queries, keys = torch.randperm(n_q, generator=generator(1)), torch.randperm(n_k, generator=generator(2))
    queries, keys = queries.to(device), keys.to(device)
    new_q, new_k = torch.argsort(queries), torch.argsort(keys)
    table = case.table
    renamed = PatchTable(new_q[table.q_rows], new_k[table.kv_rows], table.cu_q, table.cu_k)
    expected = gradients(case.attend, case.inputs, cotangent)
    inputs = case.q[queries], case.k[keys], case.v[keys]
    actual = gradients(lambda q, k, v: patch_attention(q, k, v, renamed, scale=case.scale), inputs, cotangent[queries])
    for a, b in zip(actual, (expected[0][queries], expected[1][queries], expected[2][keys]), strict=False):
        assert_close_relative_to_max(a, b, BOUNDS[dtype])
    assert_same_bits(actual[0], expected[0][queries])


@DTYPES
def test_attention_patches_are_independent(dtype, device):
    case = random_case(dtype=dtype).to(device)
    table, together = case.table, case.attend()
    for p in range(len(table.cu_q) - 1):
        q_rows = table.q_rows[table.cu_q[p] : table.cu_q[p + 1]]
        kv_rows = table.kv_rows[table.cu_k[p] : table.cu_k[p + 1]]
        cu = [torch.tensor([0, len(rows)], device=device) for rows in (q_rows, kv_rows)]
        alone = patch_attention(*case.inputs, PatchTable(q_rows, kv_rows, *cu), scale=case.scale)
        assert_same_bits(alone[q_rows], together[q_rows])


@DTYPES
def test_attention_shift_and_rotation(dtype, device):
    case = random_case(dtype=dtype).to(device)
    expected, bound = case.attend(), BOUNDS[dtype]
    shift = 0.3 * normal(1, *case.k.shape[1:], dtype=dtype).to(device)
    assert_close_relative_to_max(case.attend(case.q, case.k + shift, case.v), expected, bound)
    listed = torch.isin(torch.arange(len(case.q), device=device), case.table.q_rows) & (expected != 0).any(-1).any(-1)
    moved = case.attend(case.q, case.k, case.v + shift)
    assert_close_relative_to_max(moved[listed], (expected + shift)[listed], bound)
    turn = torch.linalg.qr(normal(case.q.shape[-1], case.q.shape[-1], seed=4))[0].to(case.q)
    assert_close_relative_to_max(case.attend(case.q @ turn, case.k @ turn, case.v), expected, bound)


# pool and row_norm
def segments(device):
    rows = torch.randperm(40, generator=generator(1))[:36]
    return to(device, rows, torch.tensor([0, 7, 7, 8, 30, 36]))


@DTYPES
@pytest.mark.parametrize("pool", [pool_max, pool_mean])
def test_pool_permutation_invariance(pool, dtype, device):
    x, cotangent = to(device, normal(40, 5, dtype=dtype), normal(5, 5, dtype=dtype, seed=2))
    rows, cu_rows = segments(device)
    out, grad = gradients(lambda x: pool(x, rows, cu_rows), [x], cotangent)
    order = torch.randperm(40, generator=generator(3)).to(device)
    renamed = torch.argsort(order)[rows]
    other, other_grad = gradients(lambda x: pool(x, renamed, cu_rows), [x[order]], cotangent)
    assert_same_bits(other, out)
    assert_same_bits(other_grad, grad[order])
    grown = torch.cat([x, torch.full((1, 5), 1e10, dtype=dtype, device=device)])
    other, other_grad = gradients(lambda x: pool(x, rows, cu_rows), [grown], cotangent)
    assert_same_bits(other, out)
    assert_same_bits(other_grad, torch.cat([grad, torch.zeros_like(grad[:1])]))
    for s in range(5):
        mine = rows[cu_rows[s] : cu_rows[s + 1]]
        assert_same_bits(pool(x, mine, torch.tensor([0, len(mine)], device=device)), out[s : s + 1])
    twice = pool(x, torch.cat([rows]), cu_rows) + 0
    assert_same_bits(twice, out)


@DTYPES
def test_unpool_split_and_renumbering(dtype, device):
    x, cotangent = to(device, normal(5, 6, dtype=dtype), normal(40, 6, dtype=dtype, seed=2))
    rows, cu_rows = segments(device)
    out, grad = gradients(lambda x: unpool(x, rows, cu_rows, 40), [x], cotangent)
    order = torch.randperm(40, generator=generator(3)).to(device)
    other, other_grad = gradients(lambda x: unpool(x, torch.argsort(order)[rows], cu_rows, 40), [x], cotangent[order])
    assert_same_bits(other, out[order])
    assert_same_bits(other_grad, grad)
    assert_same_bits(unpool(x, rows, cu_rows, 43), torch.cat([out, torch.zeros_like(out[:3])]))


@DTYPES
def test_row_norm_shift_and_scale_invariance(dtype, device):
    x, weight, bias, residual, cotangent = to(
        device,
        *(normal(*shape, dtype=dtype, seed=i) for i, shape in enumerate([(50, 24), (24,), (24,), (50, 24), (50, 24)])),
    )
    out, grad_x, *_, grad_residual = gradients(row_norm, [x, weight, bias, residual], cotangent)
    order = torch.randperm(50, generator=generator(3)).to(device)
    other = gradients(row_norm, [x[order], weight, bias, residual[order]], cotangent[order])
    for actual, expected in zip((other[0], other[1], other[4]), (out, grad_x, grad_residual), strict=True):
        assert_same_bits(actual, expected[order])
    assert_same_bits(torch.cat([row_norm(x[p], weight, bias, residual[p]) for p in (slice(0, 1), slice(1, None))]), out)
    channels = torch.randperm(24, generator=generator(4)).to(device)
    permuted = row_norm(x[:, channels], weight[channels], bias[channels], residual[:, channels])
    assert_close_relative_to_max(permuted, out[:, channels], BOUNDS[dtype])
    assert_close_relative_to_max(row_norm(3 * x + 5, weight, bias, residual, eps=9e-5), out, BOUNDS[dtype])


@DTYPES
def test_residual_norm_rows_are_independent(dtype, device):
    shapes = [(50, 24), (50, 24), (24,), (24,), (24,), (24,)]
    x, branch, *weights = to(device, *(normal(*shape, dtype=dtype, seed=i) for i, shape in enumerate(shapes)))

    def both(x, branch):
        return torch.cat(residual_norm(x, branch, branch_norm=tuple(weights[:2]), norm=tuple(weights[2:])), 1)

    cotangent = normal(50, 48, dtype=dtype, seed=7).to(device)
    expected = gradients(both, [x, branch], cotangent)
    order = torch.randperm(50, generator=generator(3)).to(device)
    for actual, value in zip(gradients(both, [x[order], branch[order]], cotangent[order]), expected, strict=True):
        assert_same_bits(actual, value[order])
    assert_same_bits(torch.cat([both(x[p], branch[p]) for p in (slice(0, 1), slice(1, None))]), expected[0])


# plane_sweep
def rig(seed=0):
    """Three cameras in a ring: Ks, viewmats (float64), sources, inverse depths, features."""
    g = generator(seed)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    for i in range(3):
        rotation, _ = random_motion(i, viewmats)
        viewmats[i, :3, :3] = torch.linalg.matrix_exp(0.15 * (rotation - rotation.T))
        viewmats[i, :3, 3] = torch.tensor([0.3 * i, 0.1, 3.0])
    Ks = torch.tensor([[10.0, 0.3, 4.7], [0, 11.0, 3.6], [0, 0, 1]], dtype=torch.float64).repeat(3, 1, 1)
    depths = 1 / (2 + torch.rand(3, 6, generator=g, dtype=torch.float64) * 2)
    features = torch.randn(3, 5, 7, 9, generator=g, dtype=torch.float64)
    return Ks, viewmats, torch.tensor([1, 2, 0, 2, 1]), torch.tensor([0, 2, 4, 5]), depths, features


def sweep(Ks, viewmats, src, cu, depths, features, dtype, device):
    homographies, translations = sweep_geometry(Ks, viewmats, src, cu)
    args = [t.to(device, dtype) for t in (homographies, translations, depths)]
    cotangent = normal(3, depths.shape[1], *features.shape[2:], dtype=dtype).to(device)
    lists = to(device, src, cu)
    return gradients(lambda f: plane_sweep(f, *args, *lists), [features.to(device, dtype)], cotangent)


@DTYPES
@pytest.mark.parametrize("seed", range(4))
def test_plane_sweep_rigid_motion_invariance(seed, dtype, device):
    Ks, viewmats, *rest = rig()
    rotation, translation = random_motion(seed, viewmats)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotation, 10 * translation
    expected = sweep(Ks, viewmats, *rest, dtype, device)
    for actual, value in zip(sweep(Ks, viewmats @ motion, *rest, dtype, device), expected, strict=True):
        assert_close_relative_to_max(actual, value, BOUNDS[dtype])


@DTYPES
def test_plane_sweep_scale_and_view_order(dtype, device):
    Ks, viewmats, src, cu, depths, features = rig()
    expected = sweep(Ks, viewmats, src, cu, depths, features, dtype, device)
    longer = viewmats.clone()
    longer[:, :3, 3] *= 4
    for actual, value in zip(sweep(Ks, longer, src, cu, depths / 4, features, dtype, device), expected, strict=True):
        assert_same_bits(actual, value)
    swapped = torch.tensor([2, 1, 2, 0, 1])  # the sources of images 0 and 1 in another order
    for actual, value in zip(sweep(Ks, viewmats, swapped, cu, depths, features, dtype, device), expected, strict=True):
        assert_close_relative_to_max(actual, value, BOUNDS[dtype])


@DTYPES
def test_plane_sweep_keeps_clouds_apart(dtype, device):
    Ks, viewmats, src, cu, depths, features = rig()
    out, _ = sweep(Ks, viewmats, src, cu, depths, features, dtype, device)
    A, b = (t.to(device, dtype) for t in sweep_geometry(Ks, viewmats, src, cu))
    double = [torch.cat([t, t]).to(device) for t in (A, b, depths.to(dtype))]
    lists = to(device, torch.cat([src, src + 3]), torch.cat([cu, cu[1:] + 5]))
    f = features.to(device, dtype)
    both = plane_sweep(torch.cat([f, f]), *double, *lists)
    assert_same_bits(both[:3], out)
    assert_same_bits(both[3:], out)


# rasterize_gaussians
def moved(scene: Scene, rotation, translation) -> Scene:
    """Gaussians and cameras in a world moved by ``x -> rotation x + translation``, in float64."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotation.T, -rotation.T @ translation
    turn = torch.zeros(4, dtype=torch.float64)
    turn[0] = (1 + rotation.trace()).clamp(min=0).sqrt() / 2
    turn[1:] = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    turn[1:] /= 4 * turn[0]
    w, v, qw, qv = turn[0], turn[1:].expand_as(scene.quats[:, 1:]), scene.quats[:, :1], scene.quats[:, 1:]
    quats = torch.cat([w * qw - (v * qv).sum(1, keepdim=True), w * qv + qw * v + torch.linalg.cross(v, qv)], 1)
    sh = rotate_harmonics(scene.color, rotation.expand(len(quats), 3, 3))
    means = scene.means @ rotation.T + translation
    return scene.replace(means=means, quats=quats, color=sh, viewmats=scene.viewmats @ motion)


@DTYPES
@pytest.mark.parametrize("seed", range(4))
def test_raster_rigid_motion_invariance(seed, dtype, device):
    """Any rigid motion of Gaussians and cameras together; the smooth cutoff, so that no alpha jumps at 1/255."""
    scene = random_scene(images=3)
    rotation, translation = random_motion(seed, scene.means)
    expected = scene.to(dtype).to(device).render(cutoff="smooth")
    actual = moved(scene, rotation, translation).to(dtype).to(device).render(cutoff="smooth")
    for a, b in zip(actual, expected, strict=True):
        assert_close_relative_to_max(a, b, BOUNDS[dtype])


@DTYPES
def test_raster_scale_invariance(dtype, device):
    scene = random_scene(dtype=dtype).to(device)
    viewmats = scene.viewmats.clone()
    viewmats[:, :3, 3] *= 4
    larger = scene.replace(means=4 * scene.means, scales=4 * scene.scales, viewmats=viewmats)
    color, alpha, depth, features = scene.render(near_plane=0.125)
    for a, b in zip(larger.render(near_plane=0.5), (color, alpha, 4 * depth, features), strict=True):
        assert_same_bits(a, b)


@DTYPES
def test_raster_permutation_invariance(dtype, device):
    scene = random_scene(dtype=dtype)
    cu = scene.cu_rows.tolist()
    order = torch.cat([a + torch.randperm(b - a, generator=generator(a)) for a, b in zip(cu, cu[1:])])
    shuffled = scene.replace(**{n: getattr(scene, n)[order] for n in Scene.NAMES[:6]}).to(device)
    scene, order = scene.to(device), order.to(device)
    for a, b in zip(shuffled.render(), scene.render(), strict=True):
        assert_same_bits(a, b)
    for name, a, b in zip(
        Scene.NAMES, raster_gradients(shuffled.render, shuffled), raster_gradients(scene.render, scene)
    ):
        assert_close_relative_to_max(a, b[order] if name in Scene.NAMES[:6] else b, BOUNDS[dtype], name)


@DTYPES
def test_raster_images_are_independent(dtype, device):
    scene = random_scene(dtype=dtype).to(device)
    together = scene.render()
    reverse = torch.arange(len(scene.viewmats) - 1, -1, -1, device=device)
    names = ("background", "viewmats", "Ks", "image_cloud")
    turned = scene.replace(**{name: getattr(scene, name)[reverse] for name in names}).render()
    for a, b in zip(turned, together, strict=True):
        assert_same_bits(a[reverse], b)
    for i in range(len(scene.viewmats)):
        one = scene.replace(**{name: getattr(scene, name)[i : i + 1] for name in names}).render()
        for a, b in zip(one, together, strict=True):
            assert_same_bits(a[0], b[i])


@DTYPES
def test_raster_ignores_invisible_gaussians(dtype, device):
    """One behind all cameras, one of opacity 0, one far beside the images; and they get no gradient."""
    scene = random_scene(clouds=1, dtype=dtype)
    names = Scene.NAMES[:6]
    extra = {name: getattr(scene, name)[:3].clone() for name in names}
    extra["means"] = torch.tensor([[0, 0, -50.0], [0, 0, 0], [900.0, 0, 0]], dtype=dtype)
    extra["opacities"] = torch.tensor([0.9, 0.0, 0.9], dtype=dtype)
    grown = scene.replace(**{name: torch.cat([getattr(scene, name), extra[name]]) for name in names})
    grown = grown.replace(cu_rows=scene.cu_rows + torch.tensor([0, 3])).to(device)
    scene = scene.to(device)
    for a, b in zip(grown.render(), scene.render(), strict=True):
        assert_same_bits(a, b)
    pairs = zip(Scene.NAMES, raster_gradients(grown.render, grown), raster_gradients(scene.render, scene), strict=True)
    for name, a, b in pairs:
        assert_same_bits(a[: len(b)], b, name)
        assert name not in names or not a[len(b) :].any(), name


@DTYPES
def test_raster_crop(dtype, device):
    """The principal point moved by a tile shows another part of the same picture."""
    scene = random_scene(clouds=1, images=1, width=48, height=48, dtype=dtype, spread=0.15).to(device)
    Ks = scene.Ks.clone()
    Ks[:, :2, 2] -= 16
    for a, b in zip(scene.replace(Ks=Ks, width=32, height=32).render(), scene.render(), strict=True):
        assert_close_relative_to_max(a, b[:, 16:, 16:], BOUNDS[dtype])
