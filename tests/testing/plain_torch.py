"""Every op against plain torch: small inputs, forward and backward."""

from collections.abc import Callable

import torch
from torch import Tensor

from gsim3d import ops
from gsim3d.cameras import Cameras
from gsim3d.testing import selftest

TOLERANCE = 1e-4  # float32, relative to the largest value of the expected tensor


def _require_equal(got: Tensor, expected: Tensor, otherwise: str) -> None:
    if not torch.equal(got.cpu(), expected):
        raise AssertionError(otherwise)


def _compare(device: str, function: Callable[..., Tensor], reference: Callable[..., Tensor], *inputs: Tensor) -> float:
    """Worst error of output and gradients relative to the largest expected value; raises above TOLERANCE."""
    results = []
    for f, target in ((function, device), (reference, "cpu")):
        leaves = [x.detach().to(target).requires_grad_() for x in inputs]
        out = f(*leaves)
        weights = torch.linspace(-1, 1, out.numel(), device=target).reshape(out.shape)
        gradients = torch.autograd.grad((out * weights).sum(), leaves)
        results.append([tensor.detach().cpu() for tensor in (out, *gradients)])
    worst = 0.0
    for name, got, expected in zip(["output", *(f"gradient {i}" for i in range(len(inputs)))], *results):
        error = float((got - expected).abs().max() / expected.abs().max().clamp_min(1e-12))
        if not error <= TOLERANCE:
            raise AssertionError(f"{name} differs from plain torch by {error:.1e} of its largest value")
        worst = max(worst, error)
    return worst


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _cloud(device: str) -> ops.Pyramid:
    """The geometry of two small scenes with two time steps each; some points share a voxel."""
    positions = torch.rand(120, 3, generator=torch.Generator().manual_seed(0)) * 0.4
    spec = ops.PyramidSpec(
        grid_size=0.05, slot_bits=1, strides=(2,), merge_windows=(2,), patch_sizes=(16, 16), kernel_sizes=((5, 3), (3,))
    )
    ids = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1])
    cu_rows, origin = torch.tensor([0, 20, 60, 61, 120]), torch.zeros(2, 3, dtype=torch.float64)
    return ops.build_pyramid(*(t.to(device) for t in (positions, cu_rows, *ids, origin)), spec)


def _curve(device: str) -> float:
    grid = torch.randint(0, 1 << 16, (200, 3), generator=torch.Generator().manual_seed(0))
    cloud = torch.arange(200) // 50
    expected = cloud << 48
    for bit in range(16):
        for axis in range(3):
            expected |= ((grid[:, axis] >> bit) & 1) << (3 * bit + 2 - axis)
    codes = ops.curve_encode(grid.to(device), cloud.to(device), "z")
    _require_equal(codes, expected, "z codes differ from bit interleaving")
    order, inverse = ops.curve_sort(codes[None])
    _require_equal(order[0], torch.argsort(expected, stable=True), "the order is not that of a stable sort")
    _require_equal(order[0][inverse[0]], torch.arange(200), "inverse is not the inverse of order")
    stages = _cloud(device).stages
    if sum(len(stage.voxels.rows) for stage in stages) != sum(len(stage.grid) for stage in stages):
        raise AssertionError("the voxels of a stage do not hold each row once")
    return 0.0


def _sparse_conv(device: str) -> float:
    stage = _cloud(device).stages[0]
    grid, cloud, voxel = stage.grid.cpu(), stage.cloud.cpu(), stage.voxels.row_voxel.cpu()
    n = len(grid)

    def reference(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ones = torch.nn.functional.one_hot(voxel).to(x.dtype)  # [N, voxels]
        means = (ones.T @ x / ones.sum(0)[:, None])[voxel]
        first = torch.stack([torch.arange(n)[voxel == v][0] for v in range(ones.shape[1])])
        out = x @ weight[:, 1, 1, 1].T + bias
        step = grid[first][None] - grid[:, None] + 1  # [N, voxels, 3]: tap that reads this voxel
        near = ((step >= 0) & (step < 3)).all(-1) & (cloud[first][None] == cloud[:, None])
        near &= ~(step == 1).all(-1)
        for p, v in near.nonzero().tolist():
            kx, ky, kz = step[p, v].tolist()
            out = out.index_add(0, torch.tensor([p]), (means[first[v]] @ weight[:, kx, ky, kz].T)[None])
        return out

    return _compare(
        device,
        lambda x, w, b: ops.sparse_conv(x, w, b, stage.voxels, stage.kernel_maps[3]),
        reference,
        _random(n, 4),
        _random(6, 3, 3, 3, 4, seed=1),
        _random(6, seed=2),
    )


def _patch_attn(device: str) -> float:
    stage = _cloud(device).stages[1]
    table, n = stage.patches[2], len(stage.grid)
    q_rows, kv_rows, cu_q, cu_k = (t.cpu() for t in (table.q_rows, table.kv_rows, table.cu_q, table.cu_k))
    reads = torch.zeros(n, n, dtype=torch.bool)
    for p in range(len(cu_q) - 1):
        reads[q_rows[cu_q[p] : cu_q[p + 1], None], kv_rows[cu_k[p] : cu_k[p + 1]]] = True

    def scores(q: Tensor, k: Tensor) -> Tensor:
        return torch.einsum("ihd,jhd->hij", q, k) * q.shape[-1] ** -0.5

    def reference(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        return torch.einsum("hij,jhd->ihd", scores(q, k).masked_fill(~reads, -torch.inf).softmax(-1), v)

    def lse_reference(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        return scores(q, k).masked_fill(~reads, -torch.inf).logsumexp(-1).T + 0 * v.sum()

    def joint_reference(q: Tensor, *keys: Tensor) -> Tensor:
        k, v = torch.cat(keys[::2]), torch.cat(keys[1::2])
        return torch.einsum("hij,jhd->ihd", scores(q, k).softmax(-1), v)

    def lse(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        out, found = ops.patch_attention(q, k, v, table, return_lse=True)
        return found + 0 * out.sum()

    inputs = [_random(n, 2, 8, seed=seed) for seed in range(5)]
    every = ops.PatchTable(*(t.to(device) for t in (*[torch.arange(n)] * 2, *[torch.tensor([0, n])] * 2)))
    return max(
        _compare(device, lambda q, k, v: ops.patch_attention(q, k, v, table), reference, *inputs[:3]),
        _compare(device, lse, lse_reference, *inputs[:3]),
        _compare(device, lambda *x: ops.joint_attention(*x, every, every), joint_reference, *inputs),
    )


def _row_norm(device: str) -> float:
    def norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return torch.nn.functional.layer_norm(x, weight.shape, weight, bias)

    def stream(x: Tensor, branch: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return torch.cat(ops.residual_norm(x, branch, branch_norm=(weight, bias), norm=(bias, weight)))

    def stream_reference(x: Tensor, branch: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        x = x + norm(branch, weight, bias)
        return torch.cat([x, norm(x, bias, weight)])

    def gelu_reference(x: Tensor, mean: Tensor, scale: Tensor, bias: Tensor) -> Tensor:
        return torch.nn.functional.gelu((x - mean) * scale + bias)

    rows, (weight, bias, mean), more = _random(30, 20), _random(3, 20, seed=1), _random(30, 20, seed=3)
    summed = torch.ops.gsim3d.linear_grad_bias(rows.to(device)).cpu()
    if not torch.allclose(summed, rows.sum(0), atol=TOLERANCE):
        raise AssertionError("the gradient of a bias is not the sum over rows")
    return max(
        _compare(device, ops.row_norm, lambda x, w, b, y: norm(x, w, b) + y, rows, weight, bias, more),
        _compare(device, stream, stream_reference, rows, more, weight, bias),
        _compare(device, ops.norm_gelu, gelu_reference, rows, mean, weight, bias),
    )


def _pool(device: str) -> float:
    rows = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    cu_rows = torch.tensor([0, 7, 8, 30, 40])
    segments = [rows[a:b] for a, b in zip(cu_rows[:-1], cu_rows[1:])]
    segment_of_row = torch.repeat_interleave(torch.arange(4), cu_rows.diff())[torch.argsort(rows)]
    args = rows.to(device), cu_rows.to(device)
    return _compare(
        device,
        lambda x: ops.unpool(ops.pool_max(x, *args) + ops.pool_mean(x, *args), *args, 40),
        lambda x: torch.stack([x[s].amax(0) + x[s].mean(0) for s in segments])[segment_of_row],
        _random(40, 5),
    )


def _plane_sweep(device: str) -> float:
    height, width, depths = 6, 8, torch.tensor([[1.0, 0.8, 0.5], [0.9, 0.7, 0.4]])
    K = torch.tensor([[8.0, 0, 3.5], [0, 8, 2.5], [0, 0, 1]]).expand(2, 3, 3)
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, 0, 3] = 0.2
    sources = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    A, b = ops.sweep_geometry(K, viewmats, *sources)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1).float()

    def reference(features: Tensor) -> Tensor:
        costs = []
        for image, source in ((0, 1), (1, 0)):
            rays = torch.einsum("ij,hwj->hwi", A[image].float(), pixels)
            q = rays / depths[image, :, None, None, None] + b[image].float()
            xy = q[..., :2] / q[..., 2:].clamp_min(1e-3)
            xy = 2 * xy / torch.tensor([width - 1, height - 1]) - 1
            other = features[source].expand(len(depths[image]), -1, -1, -1)
            warped = torch.nn.functional.grid_sample(other, xy, align_corners=True)
            costs.append((features[image][None] * warped).sum(1) / features.shape[1] ** 0.5)
        return torch.stack(costs)

    geometry = [t.to(device) for t in (A, b, depths, *sources)]
    return _compare(device, lambda f: ops.plane_sweep(f, *geometry), reference, _random(2, 4, height, width))


def _projected(means: Tensor, scales: Tensor, focal: float, center: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [N, 2] and entries [N, 3] of the inverse covariances of Gaussians along the axes."""
    x, y, z = means.unbind(1)
    zero = torch.zeros_like(z)
    slopes = torch.stack([focal / z, zero, -focal * x / z**2, zero, focal / z, -focal * y / z**2], 1)
    J = slopes.reshape(-1, 2, 3)
    conics = torch.linalg.inv(J @ torch.diag_embed(scales**2) @ J.mT + 0.3 * torch.eye(2)).reshape(-1, 4)
    return focal * means[:, :2] / means[:, 2:] + center, conics[:, [0, 1, 3]]


def _blended(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, size: int) -> Tensor:
    """An image [1, size, size, D] of Gaussians, the nearest first."""
    pixel = torch.arange(size) + 0.5
    image, transmittance = torch.zeros(size, size, colors.shape[1]), torch.ones(size, size)
    for mean, (a, b, c), opacity, color in zip(means2d, conics, opacities, colors):
        dx, dy = (torch.stack(torch.meshgrid(pixel, pixel, indexing="xy"), -1) - mean).unbind(-1)
        alpha = (opacity * torch.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)).clamp_max(0.99)
        alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
        image = image + (transmittance * alpha)[..., None] * color
        transmittance = transmittance * (1 - alpha)
    return image[None]


def _raster(device: str) -> float:
    n, size, focal = 12, 16, 16.0
    K = torch.tensor([[[focal, 0, 7.0], [0, focal, 9.0], [0, 0, 1]]])
    one, first = torch.ones(1), torch.zeros(1, dtype=torch.int64)
    cameras = Cameras(torch.eye(4)[None], K, 0.1 * one, 10 * one, first, size, size).to(device)

    def reference(means: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        return _blended(*_projected(means, scales, focal, K[0, :2, 2]), opacities, colors, size)

    def function(means: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        quats = torch.tensor([[1.0, 0, 0, 0]], device=means.device).expand(n, 4)
        return ops.rasterize_gaussians(means, quats, scales, opacities, cameras, colors=colors).color

    generator = torch.Generator().manual_seed(4)
    means = torch.cat([torch.rand(n, 2, generator=generator) - 0.5, torch.linspace(2, 3, n)[:, None]], 1)
    scales = 0.05 + 0.1 * torch.rand(n, 3, generator=generator)
    opacities, colors = 0.2 + 0.5 * torch.rand(n, generator=generator), torch.rand(n, 3, generator=generator)
    return _compare(device, function, reference, means, scales, opacities, colors)


def _projection(device: str) -> float:
    n, focal, half = 5, 16.0, 8.0
    K = torch.tensor([[[focal, 0, half], [0, focal, half], [0, 0, 1]]])
    one, first = torch.ones(1), torch.zeros(1, dtype=torch.int64)
    cameras = Cameras(torch.eye(4)[None], K, one, one, first, 16, 16).to(device)

    def reference(means: Tensor, scales: Tensor, sh: Tensor) -> Tensor:
        means2d, conics = _projected(means, scales, focal, K[0, :2, 2])
        x, y, z = torch.nn.functional.normalize(means, dim=1).unbind(1)
        basis = torch.stack([0.28209479 + 0 * x, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x], 1)
        colors = (0.5 + torch.einsum("nk,nkc->nc", basis, sh)).clamp_min(0)
        return torch.cat([means2d, conics, means[:, 2:], colors], 1)

    def function(means: Tensor, scales: Tensor, sh: Tensor) -> Tensor:
        quats = torch.tensor([[1.0, 0, 0, 0]], device=means.device).expand(n, 4)
        pairs = ops.project_gaussians(means, quats, scales, cameras)
        colors = ops.sh_to_color(means, sh)
        return torch.cat([pairs.means2d, pairs.conics, pairs.depths[:, None], colors], 1)

    means = 0.2 * _random(n, 3) + torch.tensor([0.0, 0.0, 2.0])
    return _compare(device, function, reference, means, 0.1 + 0.1 * _random(n, 3).abs(), 0.2 * _random(n, 4, 3, seed=1))


def _raster_projected(device: str) -> float:
    size, depths = 12, torch.linspace(1, 2, 4)

    def reference(*rows: Tensor) -> Tensor:
        return _blended(*rows, size)

    def function(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        rows = (means2d, conics, depths.to(means2d.device), opacities, colors)
        return ops.rasterize_projected(*rows, width=size, height=size).color

    conics = torch.tensor([[0.2, 0.05, 0.3], [0.1, -0.05, 0.1], [0.5, 0.0, 0.2], [0.3, 0.1, 0.3]])
    means2d, colors = size * (0.5 + 0.2 * _random(4, 2)), _random(4, 4, seed=1)
    return _compare(device, function, reference, means2d, conics, torch.tensor([0.3, 0.5, 0.7, 0.4]), colors)


def _decode(device: str) -> float:
    def reference(raw: Tensor) -> Tensor:
        quats = torch.nn.functional.normalize(raw[:, 3:7].roll(1, 1), dim=1)
        return torch.cat([quats, 0.01 + 0.09 * raw[:, 7:].sigmoid(), raw[:, :3]], 1)

    def function(raw: Tensor) -> Tensor:
        table = torch.zeros(128, device=raw.device)  # harmonics of degree 0 do not turn
        quats, scales, sh = ops.decode_gaussians(raw, table, degree=0, scale_min=0.01, scale_max=0.1)
        return torch.cat([quats, scales, sh[:, 0]], 1)

    return _compare(device, function, reference, _random(30, 10))


def _background(device: str) -> float:
    grid = torch.randint(0, 3, (40, 3), generator=torch.Generator().manual_seed(0))
    scene = torch.arange(40) // 20
    keys = scene << 48 | grid[:, 0] << 32 | grid[:, 1] << 16 | grid[:, 2]
    cells = torch.cat([keys[::2].unique(), torch.tensor([torch.iinfo(torch.int64).max])])
    places = ops.find_cells(*(t.to(device) for t in (cells, scene, grid)))
    equal = keys[:, None] == cells
    expected = torch.where(equal.any(1), equal.int().argmax(1), len(cells) - 1)
    _require_equal(places, expected, "cells are found in other places than by comparing all")
    one_by_one = ops.Segments(torch.arange(40, device=device), torch.arange(41, device=device))
    clouds = torch.tensor([0, 1], device=device), torch.tensor([0, 20, 40], device=device)
    _require_equal(ops.row_scenes(*clouds, [one_by_one])[0], scene, "rows are in other scenes than their clouds")
    codes, cu = torch.stack([torch.randperm(40, generator=torch.Generator().manual_seed(1))]), torch.tensor([0, 5, 9])
    first, order = torch.tensor([[0, 20]]), codes.argsort(1)
    lists = (first, torch.arange(9)[None], cu, codes, order, torch.tensor([0, 40]))
    table = ops.overlapping_patches(*(t.to(device) for t in lists), patch_size=20)[0]
    wrong = "rows are in other patches than those in whose intervals they lie"
    _require_equal(table.q_rows, order[0], wrong)
    _require_equal(table.cu_q[:3], torch.tensor([0, 20, 40]), wrong)
    x, field = _random(40, 6), _random(len(cells), 6, seed=1)
    return _compare(device, lambda x, f: ops.add_cells(x, f, places), lambda x, f: x + f[places.cpu()], x, field)


def _springs(device: str) -> float:
    ends, of_rows = torch.arange(1, 31) % 30, torch.arange(31)
    lists = ops.SpringLists.from_neighbors(ends.to(device), of_rows.to(device))
    rest = torch.arange(90.0).reshape(30, 3).sin()
    numbers = {"lengths": (rest[ends] - rest).norm(dim=1), "damping": torch.ones(30), "external": torch.zeros(30, 3)}
    options = {"seconds": 0.1, "substeps": 2, "ground": -0.9, "power": 0.0}

    def function(x: Tensor, stiffness: Tensor, grip: Tensor) -> Tensor:
        of = {name: value.to(device) for name, value in numbers.items()}
        return torch.cat(ops.advance_springs(1.1 * x, x, lists, stiffness=stiffness, grip=grip, **of, **options))

    def reference(x: Tensor, stiffness: Tensor, grip: Tensor) -> Tensor:
        x, v = 1.1 * x, x
        for _ in range(2):
            apart, faster = x[ends] - x, v[ends] - v
            distance = apart.norm(dim=1, keepdim=True)
            pull = stiffness[:, None] * (distance - numbers["lengths"][:, None]) * apart / distance
            v = v + 0.05 * (pull + (faster * apart).sum(1, keepdim=True) * apart / distance**2)
            x = x + 0.05 * v
            touching, slowed = x[:, 2:] <= -0.9, torch.cat([grip[:, None] * v[:, :2], 0 * v[:, 2:]], 1)
            x, v = torch.cat([x[:, :2], x[:, 2:].clamp_min(-0.9)], 1), torch.where(touching, slowed, v)
        return torch.cat([x, v])

    return _compare(device, function, reference, rest, torch.ones(30), torch.full((30,), 0.5))


def _validate_state(device: str) -> float:
    means, opacities, cu_rows = _random(50, 3), torch.linspace(0, 1, 50), torch.tensor([0, 20, 50])
    means[7, 1], opacities[30] = torch.nan, 2.0
    clouds = {"cloud_scene": torch.tensor([0, 1]), "origin": torch.full((2, 3), -9.0, dtype=torch.float64)}
    clouds |= {"activity": torch.zeros(50, dtype=torch.uint8)}
    arguments = [means.to(device), opacities.to(device)], [(-9, 9), (0, 1)], cu_rows.to(device)
    options = {name: value.to(device) for name, value in clouds.items()}
    found, parts = ops.validate_state(*arguments, **options), ops.validate_state(*arguments, **options, join=False)
    record = found.record.cpu()
    joined = ops.join_records([parts.record]).reshape(record.shape)
    _require_equal(joined, record, "the parts of a record do not join")
    bad = (~(means.abs() <= 9).all(1)).int() | (opacities > 1).int() << 1
    wrong = "rows that cannot be used are not those that are out of bounds"
    _require_equal(found.status, bad, wrong)
    _require_equal(record[:, :4], record.new_tensor([[1, 7, 0, -1], [0, -1, 1, 30]]), wrong)
    awake = torch.stack([(bad == 0)[:20].sum(), (bad == 0)[20:].sum()]).double()
    _require_equal(record[:, 8], awake, "rows that are awake are counted wrongly")
    opacity = torch.stack([opacities[:20].double().sum(), opacities[20:][opacities[20:] <= 1].double().sum()])
    return float(((record[:, 10] - opacity) / opacity).abs().max())


CHECKS: dict[str, Callable[[str], float]] = {name: globals()[f"_{name}"] for name in selftest.CHECKS}
