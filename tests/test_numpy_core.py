"""gsim3d._core gives on numpy arrays what the ops give on tensors, bit for bit, and names bad arguments."""

import numpy as np
import pytest
import torch

from gsim3d import _core, ops
from gsim3d.cameras import Cameras

DTYPES = [np.float32, np.float64]


def random(*shape, dtype, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(dtype)


def same(array, tensor):
    assert array.dtype == tensor.numpy().dtype
    np.testing.assert_array_equal(array, tensor.numpy())


@pytest.mark.parametrize("dtype", DTYPES)
def test_pool(dtype):
    x, rows, cu_rows = random(6, 3, dtype=dtype), np.array([5, 0, 2, 1]), np.array([0, 3, 3, 4])
    args = torch.from_numpy(x), torch.from_numpy(rows), torch.from_numpy(cu_rows)
    same(_core.pool_max(x, rows, cu_rows)[0], ops.pool_max(*args))
    same(_core.pool_mean(x, rows, cu_rows), ops.pool_mean(*args))


def test_curve():
    grid = np.random.default_rng(0).integers(0, 1 << 16, (50, 3))
    cloud = np.arange(50) // 10
    codes = []
    for index, curve in enumerate(ops.CURVES):
        codes.append(_core.curve_encode(grid, cloud, index))
        same(codes[-1], ops.curve_encode(torch.from_numpy(grid), torch.from_numpy(cloud), curve))
    order, inverse = _core.curve_sort(np.stack(codes))
    expected = ops.curve_sort(torch.from_numpy(np.stack(codes)))
    same(order, expected[0])
    same(inverse, expected[1])


@pytest.mark.parametrize("dtype", DTYPES)
def test_plane_sweep(dtype):
    features, sources, offsets = random(2, 4, 5, 6, dtype=dtype), np.array([1, 0]), np.array([0, 1, 2])
    A = np.stack([np.eye(3)] * 2).astype(dtype)
    b = np.array([[0.3, 0, 0], [-0.3, 0, 0]], dtype)
    inverse_depths = np.array([[1, 0.5], [1, 0.25]], dtype)
    args = features, A, b, inverse_depths, sources, offsets
    same(_core.plane_sweep(*args), ops.plane_sweep(*map(torch.from_numpy, args)))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("first", [False, True])
def test_sparse_conv(first, dtype):
    x, weight, bias = random(3, 4, dtype=dtype), random(5, 3, 3, 3, 4, dtype=dtype, seed=1), random(5, dtype=dtype)
    voxels = np.array([0, 0, 1]), np.array([0, 1, 2]), np.array([0, 2, 3])
    taps = np.array([0, 1]), np.array([1, 0]), np.array([0] * 13 + [1] * 2 + [2] * 13)  # two neighbours along z
    geometry = ops.Voxels(*map(torch.from_numpy, voxels)), ops.KernelMap(3, *map(torch.from_numpy, taps))
    for b in (bias, None):
        tensors = [None if t is None else torch.from_numpy(t) for t in (x, weight, b)]
        expected = ops.sparse_conv(*tensors, *geometry, duplicates="first" if first else "mean")
        same(_core.sparse_conv(x, weight, b, *voxels, *taps, first), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_patch_attention(dtype):
    q, k, v = (random(5, 2, 8, dtype=dtype, seed=seed) for seed in range(3))
    tables = np.array([0, 4, 2, 1, 3]), np.array([0, 4, 2, 4, 2, 1, 3]), np.array([0, 3, 5]), np.array([0, 3, 7])
    expected = ops.patch_attention(*map(torch.from_numpy, (q, k, v)), ops.PatchTable(*map(torch.from_numpy, tables)))
    same(_core.patch_attention(q, k, v, *tables, 8**-0.5), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_rasterize_gaussians(dtype):
    rng = np.random.default_rng(0)
    means = (rng.random((20, 3)) - [0.5, 0.5, -2]).astype(dtype)
    quats = rng.standard_normal((20, 4)).astype(dtype)
    scales, opacities = (0.1 * rng.random((20, 3))).astype(dtype), rng.random(20).astype(dtype)
    colors, background = rng.random((20, 3)).astype(dtype), np.array([0.1, 0.2, 0.3], dtype)
    viewmats, Ks = np.eye(4, dtype=dtype)[None], np.array([[[20, 0, 9], [0, 20, 7], [0, 0, 1]]], dtype)
    images = _core.rasterize_gaussians(means, quats, scales, opacities, colors, viewmats, Ks, 18, 15, background)
    tensors = [torch.from_numpy(x) for x in (means, quats, scales, opacities)]
    one = torch.ones(1)
    cameras = Cameras(
        torch.from_numpy(viewmats), torch.from_numpy(Ks), one, one, torch.zeros(1, dtype=torch.int64), 18, 15
    )
    expected = ops.rasterize_gaussians(
        *tensors, cameras, colors=torch.from_numpy(colors), background=torch.from_numpy(background)
    )
    assert images["alpha"].max() > 0.5
    for name in ("color", "alpha", "depth"):
        same(images[name], getattr(expected, name))


def test_constants_say_what_the_kernels_do():
    assert _core.constants["raster_max_alpha"] == 0.99
    with pytest.raises(ValueError, match=str(_core.constants["patch_attn_max_head_dim"])):
        ops.patch_attention(*[torch.zeros(1, 1, 260)] * 3, ops.PatchTable(*[torch.zeros(1, dtype=torch.int64)] * 4))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: _core.pool_mean(np.zeros((2, 1)), [0, 0], [0, 2]), "pool_mean: rows must list a row at most once"),
        (
            lambda: _core.sparse_conv(np.zeros((0, 2)), np.zeros((1, 2, 2, 2, 2)), None, [], [], [0], [], [], [0]),
            "sparse_conv: kernel_size must be odd",
        ),
        (lambda: _core.curve_encode(np.zeros((2, 2), int), [0, 0], 0), r"grid must be \[\*, 3\]; got \[2, 2\]"),
        (lambda: _core.curve_encode([[1 << 17, 0, 0]], [0], 0), "curve_encode: grid"),
        (
            lambda: _core.plane_sweep(
                np.zeros((1, 1, 2, 2)), np.zeros((1, 3, 3)), np.zeros((1, 3)), [[1.0]], [4], [0, 1]
            ),
            "plane_sweep: src_images",
        ),
        (
            lambda: _core.rasterize_gaussians(*[np.zeros((1, 3))] * 2, *[np.zeros((1, 3))] * 5, 4, 4, np.zeros(3)),
            "rasterize_gaussians: quats",
        ),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
