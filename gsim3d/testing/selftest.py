"""Known answers of every op, for ``gsim3d doctor``: small inputs, forward and backward.

``tests/testing/plain_torch.py`` compares the same ops with plain torch.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from gsim3d import ops
from gsim3d.cameras import Cameras

TOLERANCE = 1e-4  # of float32, relative to the sum of absolute values


def check(name: str, device: str) -> float:
    """Worst relative error of the op ``name`` (a key of CHECKS); raises AssertionError above TOLERANCE."""
    worst = 0.0
    for number, (tensor, known) in enumerate(zip(CHECKS[name](device), ANSWERS[name], strict=True)):
        value, size = weighted_sums(tensor)
        error = abs(value - known) / size
        if not error <= (TOLERANCE if tensor.is_floating_point() else 0):
            raise AssertionError(f"result {number} has the weighted sum {value}; it must be {known}")
        worst = max(worst, error)
    return worst


def weighted_sums(tensor: Tensor) -> tuple[float, float]:
    """Sum of the entries times 1, 2, ..., 7, 1, ..., and the sum of their absolute values."""
    flat = tensor.detach().cpu().reshape(-1)
    weighted = (flat.double() if flat.is_floating_point() else flat.long()) * (1 + torch.arange(len(flat)) % 7)
    return weighted.sum().item(), max(1e-12, weighted.abs().double().sum().item())


def _uniform(*shape: int, seed: int = 0) -> Tensor:
    """Numbers in [0, 1), the same on every machine."""
    index = torch.arange(torch.Size(shape).numel(), dtype=torch.float64).reshape(shape)
    return ((12.9898 * index + 78.233 * (seed + 1)).sin() * 43758.5453).remainder(1).float()


def _centered(*shape: int, seed: int = 0) -> Tensor:
    return 3 * _uniform(*shape, seed=seed) - 1.5


def _run(device: str, function: Callable[..., Tensor], *inputs: Tensor) -> list[Tensor]:
    """The output of ``function`` and the gradients of its inputs."""
    leaves = [x.to(device).requires_grad_() for x in inputs]
    out = function(*leaves)
    weights = torch.linspace(-1, 1, out.numel(), device=device).reshape(out.shape)
    return [out, *torch.autograd.grad((out * weights).sum(), leaves)]


def _on(device: str, *values) -> list[Tensor]:
    return [torch.as_tensor(value).to(device) for value in values]


def _cloud(device: str) -> ops.Pyramid:
    """The geometry of two small scenes with two time steps each; some points share a voxel."""
    spec = ops.PyramidSpec(
        grid_size=0.05, slot_bits=1, strides=(2,), merge_windows=(2,), patch_sizes=(16, 16), kernel_sizes=((5, 3), (3,))
    )
    clouds = [0, 20, 60, 61, 120], [0, 0, 1, 1], [0, 1, 0, 1], torch.zeros(2, 3, dtype=torch.float64)
    return ops.build_pyramid(*_on(device, 0.4 * _uniform(120, 3), *clouds), spec)


def _curve(device: str) -> list[Tensor]:
    grid, cloud = (65536 * _uniform(200, 3)).long(), torch.arange(200) // 50
    codes = ops.curve_encode(*_on(device, grid, cloud), "z")
    stages = _cloud(device).stages
    return [codes, *ops.curve_sort(codes[None]), *(t for s in stages for t in (s.grid, s.voxels.rows, s.order))]


def _sparse_conv(device: str) -> list[Tensor]:
    stage = _cloud(device).stages[0]
    inputs = _centered(len(stage.grid), 4), _centered(6, 3, 3, 3, 4, seed=1), _centered(6, seed=2)
    return _run(device, lambda x, w, b: ops.sparse_conv(x, w, b, stage.voxels, stage.kernel_maps[3]), *inputs)


def _patch_attn(device: str) -> list[Tensor]:
    stage = _cloud(device).stages[1]
    table, n = stage.patches[2], len(stage.grid)
    every = ops.PatchTable(*_on(device, torch.arange(n), torch.arange(n), [0, n], [0, n]))
    inputs = [_centered(n, 2, 8, seed=seed) for seed in range(5)]

    def with_sums(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        out, lse = ops.patch_attention(q, k, v, table, return_lse=True)
        return torch.cat([out.flatten(), lse.flatten()])

    return _run(device, with_sums, *inputs[:3]) + _run(
        device, lambda *x: ops.joint_attention(*x, every, every), *inputs
    )


def _row_norm(device: str) -> list[Tensor]:
    def stream(x: Tensor, branch: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return torch.cat(ops.residual_norm(x, branch, branch_norm=(weight, bias), norm=(bias, weight)))

    rows, (weight, bias, mean), more = _centered(30, 20), _centered(3, 20, seed=1), _centered(30, 20, seed=3)
    return [
        torch.ops.gsim3d.linear_grad_bias(rows.to(device)),
        *_run(device, ops.row_norm, rows, weight, bias, more),
        *_run(device, stream, rows, more, weight, bias),
        *_run(device, ops.norm_gelu, rows, mean, weight, bias),
    ]


def _pool(device: str) -> list[Tensor]:
    args = _on(device, _uniform(40, seed=1).argsort(), [0, 7, 8, 30, 40])
    pooled = lambda x: ops.pool_max(x, *args) + ops.pool_mean(x, *args)  # noqa: E731
    return _run(device, lambda x: ops.unpool(pooled(x), *args, 40), _centered(40, 5))


def _plane_sweep(device: str) -> list[Tensor]:
    K = torch.tensor([[8.0, 0, 3.5], [0, 8, 2.5], [0, 0, 1]]).expand(2, 3, 3)
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, 0, 3] = 0.2
    sources = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    depths = [[1.0, 0.8, 0.5], [0.9, 0.7, 0.4]]
    geometry = _on(device, *ops.sweep_geometry(K, viewmats, *sources), depths, *sources)
    return _run(device, lambda f: ops.plane_sweep(f, *geometry), _centered(2, 4, 6, 8))


def _gaussians(n: int) -> tuple[Tensor, ...]:
    """Means and scales [n, 3], opacities [n] and colours [n, 3]."""
    means = torch.cat([_uniform(n, 2) - 0.5, torch.linspace(2, 3, n)[:, None]], 1)
    return means, 0.05 + 0.1 * _uniform(n, 3, seed=1), 0.2 + 0.5 * _uniform(n, seed=2), _uniform(n, 3, seed=3)


def _camera(device: str) -> Cameras:
    K, one = torch.tensor([[[16.0, 0, 7], [0, 16, 9], [0, 0, 1]]]), torch.ones(1)
    return Cameras(torch.eye(4)[None], K, 0.1 * one, 10 * one, torch.zeros(1, dtype=torch.int64), 16, 16).to(device)


def _quats(means: Tensor) -> Tensor:
    return torch.tensor([[0.8, 0.4, 0.4, 0.2]], device=means.device).expand(len(means), 4)


def _raster(device: str) -> list[Tensor]:
    def image(means: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        return ops.rasterize_gaussians(means, _quats(means), scales, opacities, _camera(device), colors=colors).color

    return _run(device, image, *_gaussians(12))


def _projection(device: str) -> list[Tensor]:
    def rows(means: Tensor, scales: Tensor, sh: Tensor) -> Tensor:
        pairs = ops.project_gaussians(means, _quats(means), scales, _camera(device))
        return torch.cat([pairs.means2d, pairs.conics, pairs.depths[:, None], ops.sh_to_color(means, sh)], 1)

    return _run(device, rows, *_gaussians(5)[:2], 0.2 * _centered(5, 4, 3))


def _raster_projected(device: str) -> list[Tensor]:
    depths = torch.linspace(1, 2, 4).to(device)

    def image(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        return ops.rasterize_projected(means2d, conics, depths, opacities, colors, width=12, height=12).color

    conics = torch.tensor([[0.2, 0.05, 0.3], [0.1, -0.05, 0.1], [0.5, 0.0, 0.2], [0.3, 0.1, 0.3]])
    return _run(device, image, 12 * _uniform(4, 2), conics, 0.3 + 0.4 * _uniform(4), _centered(4, 4, seed=1))


def _decode(device: str) -> list[Tensor]:
    def parts(raw: Tensor) -> Tensor:
        table = torch.zeros(128, device=raw.device)  # harmonics of degree 0 do not turn
        quats, scales, sh = ops.decode_gaussians(raw, table, degree=0, scale_min=0.01, scale_max=0.1)
        return torch.cat([quats, scales, sh[:, 0]], 1)

    return _run(device, parts, _centered(30, 10))


def _background(device: str) -> list[Tensor]:
    grid, scene = (3 * _uniform(40, 3)).long(), torch.arange(40) // 20
    keys = scene << 48 | grid[:, 0] << 32 | grid[:, 1] << 16 | grid[:, 2]
    cells = torch.cat([keys[::2].unique(), torch.tensor([torch.iinfo(torch.int64).max])])
    places = ops.find_cells(*_on(device, cells, scene, grid))
    one_by_one = ops.Segments(*_on(device, torch.arange(40), torch.arange(41)))
    codes = _uniform(1, 40, seed=1).argsort(1)
    lists = [[0, 20]], torch.arange(9)[None], [0, 5, 9], codes, codes.argsort(1), [0, 40]
    table = ops.overlapping_patches(*_on(device, *lists), patch_size=20)[0]
    scenes = ops.row_scenes(*_on(device, [0, 1], [0, 20, 40]), [one_by_one])[0]
    sums = _run(device, lambda x, f: ops.add_cells(x, f, places), _centered(40, 6), _centered(len(cells), 6, seed=1))
    return [places, scenes, table.q_rows, table.cu_q[:3], *sums]


def _springs(device: str) -> list[Tensor]:
    ends, rest = torch.arange(1, 31) % 30, torch.arange(90.0).reshape(30, 3).sin()
    lists = ops.SpringLists.from_neighbors(*_on(device, ends, torch.arange(31)))
    lengths, damping, external = _on(device, (rest[ends] - rest).norm(dim=1), torch.ones(30), torch.zeros(30, 3))
    options = {"seconds": 0.1, "substeps": 2, "ground": -0.9, "power": 0.0}
    options |= {"lengths": lengths, "damping": damping, "external": external}

    def moved(x: Tensor, stiffness: Tensor, grip: Tensor) -> Tensor:
        return torch.cat(ops.advance_springs(1.1 * x, x, lists, stiffness=stiffness, grip=grip, **options))

    return _run(device, moved, rest, torch.ones(30), torch.full((30,), 0.5))


def _validate_state(device: str) -> list[Tensor]:
    means, opacities = _centered(50, 3), torch.linspace(0, 1, 50)
    means[7, 1], opacities[30] = torch.nan, 2.0
    clouds = {"cloud_scene": [0, 1], "origin": torch.full((2, 3), -9.0, dtype=torch.float64)}
    clouds |= {"activity": torch.zeros(50, dtype=torch.uint8)}
    options = dict(zip(clouds, _on(device, *clouds.values())))
    means, opacities, cu_rows = _on(device, means, opacities, [0, 20, 50])
    arguments = [means, opacities], [(-9, 9), (0, 1)], cu_rows
    found, parts = ops.validate_state(*arguments, **options), ops.validate_state(*arguments, **options, join=False)
    return [found.status, found.record.nan_to_num(-7), ops.join_records([parts.record]).nan_to_num(-7)]


CHECKS: dict[str, Callable[[str], list[Tensor]]] = {
    "curve": _curve,
    "sparse_conv": _sparse_conv,
    "patch_attn": _patch_attn,
    "pool": _pool,
    "row_norm": _row_norm,
    "plane_sweep": _plane_sweep,
    "decode": _decode,
    "background": _background,
    "springs": _springs,
    "validate_state": _validate_state,
    "raster": _raster,
    "projection": _projection,
    "raster_projected": _raster_projected,
}
ANSWERS: dict[str, tuple[float, ...]] = {  # of an x86-64 CPU
    "curve": (452885149626612329, 79462, 79616, 5113, 28753, 113902, 1624, 17135, 67743),
    "sparse_conv": (354.8482, 75.20978, -88.20632, 5.84147),
    "patch_attn": (
        2238.21, -3.270779, 25.89182, -664.1808, 37.35709,
        2.50832, -4.442113, -7.279105, -2.164184, 6.668865,
    ),
    "pool": (1026.793, 7.092018),
    "row_norm": (
        93.58552, -197.9542, 11.84752, 5.441725, 5.258766, 3.013356, 1269.262, -1198.297,
        -0.3944557, 1115.669, -1121.917, 614.0932, 6.357274, -6.254789, -8.374216, 1.294641,
    ),
    "plane_sweep": (-1.469193, -1.336736),
    "decode": (45.89585, 5.010462),
    "background": (1858, 78, 2975, 160, -1.159315, 2.991631, 8.744771),
    "springs": (30.38683, -38.30097, -0.05088178, -1.50888),
    "validate_state": (7, 548.9391, 548.9391),
    "raster": (116.2006, 89.32082, 126.4435, 28.64837, 31.92378),
    "projection": (436.5954, -24.19262, 5.323035, 5.050335),
    "raster_projected": (200.457, 20.71062, 267.98, -25.56418, 30.05635),
}  # fmt: skip
