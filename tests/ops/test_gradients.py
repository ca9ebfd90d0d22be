"""Derivatives that ops do not have end with a GradientError that names op, argument and order; never None or 0."""

import dataclasses

import pytest
import torch
from torch.autograd import forward_ad

from gsim3d import GradientError, ops
from gsim3d.cameras import Cameras
from gsim3d.math.spherical_harmonics import readings

ROWS, CU = torch.arange(6), torch.tensor([0, 2, 6])
READINGS = readings(torch.float32, torch.device("cpu"))
RING = ops.SpringLists.from_neighbors((ROWS + 1) % 6, torch.arange(7))
SPRING_NUMBERS = ("lengths", "stiffness", "damping", "grip", "external")
TABLE = ops.PatchTable(ROWS, ROWS, CU, CU)


def values(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def pyramid():
    spec = ops.PyramidSpec(
        grid_size=0.1, slot_bits=0, strides=(2,), merge_windows=(1,), patch_sizes=(4, 4), kernel_sizes=((3,), (3,))
    )
    zero = torch.zeros(1, dtype=torch.int64)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    return ops.build_pyramid(values(6, 3), torch.tensor([0, 6]), zero, zero, origin, spec)


def cameras():
    K = torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]])
    one = torch.ones(1)
    return Cameras(torch.eye(4)[None], K, 0.1 * one, 9 * one, torch.zeros(1, dtype=torch.int64), width=8, height=8)


def sweep(features):
    K, viewmats = 4 * torch.eye(3).expand(2, 3, 3), torch.eye(4).repeat(2, 1, 1)
    sources = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    return ops.plane_sweep(features, *ops.sweep_geometry(K, viewmats, *sources), torch.ones(2, 1), *sources)


def draw(means, quats, scales, opacities, colors, viewmats):
    one = dataclasses.replace(cameras(), viewmats=viewmats)
    return ops.rasterize_gaussians(means, quats, scales, opacities, one, colors=colors).color


def project(means, quats, scales, viewmats):
    pairs = ops.project_gaussians(means, quats, scales, dataclasses.replace(cameras(), viewmats=viewmats))
    return torch.cat([pairs.means2d, pairs.conics], 1)


STAGE = pyramid().stages[0]
MEANS = values(6, 3) + torch.tensor([-0.5, -0.5, 2.0])
CONICS = values(6, 3) + torch.tensor([1.0, 0.0, 1.0])
# op -> (function of tensors, all of which have gradients; those tensors)
CALLS = {
    "pool_max": (lambda x: ops.pool_max(x, ROWS, CU), [values(6, 3)]),
    "pool_mean": (lambda x: ops.pool_mean(x, ROWS, CU), [values(6, 3)]),
    "unpool": (lambda x: ops.unpool(x, ROWS, CU, 6), [values(2, 3)]),
    "sparse_conv": (
        lambda x, w, b: ops.sparse_conv(x, w, b, STAGE.voxels, STAGE.kernel_maps[3]),
        [values(6, 4), values(4, 3, 3, 3, 4), values(4)],
    ),
    "patch_attention": (
        lambda q, k, v: ops.patch_attention(q, k, v, TABLE),
        [values(6, 1, 4, seed=s) for s in range(3)],
    ),
    "attention_log_sum_exp": (
        lambda q, k: ops.patch_attention(q, k, k, TABLE, return_lse=True)[1],
        [values(6, 1, 4, seed=s) for s in range(2)],
    ),
    "joint_attention": (
        lambda *x: ops.joint_attention(*x, TABLE, TABLE),
        [values(6, 1, 4, seed=s) for s in range(5)],
    ),
    "row_norm": (ops.row_norm, [values(6, 4), values(4), values(4)]),
    "residual_norm": (
        lambda x, branch, w, b: ops.residual_norm(x, branch, norm=(w, b))[1],
        [values(6, 4), values(6, 4, seed=1), values(4), values(4)],
    ),
    "norm_gelu": (ops.norm_gelu, [values(6, 4), values(4), values(4), values(4)]),
    "decode_gaussians": (
        lambda raw: ops.decode_gaussians(raw, READINGS, degree=1, scale_min=0.1, scale_max=1.0)[2],
        [values(6, 19)],
    ),
    "advance_springs": (
        lambda x, v, *numbers: ops.advance_springs(
            x, v, RING, **dict(zip(SPRING_NUMBERS, numbers, strict=True)), seconds=0.1, substeps=3, ground=-9.0
        )[0],
        [MEANS, values(6, 3), 1 + values(6) ** 2, values(6), values(6), values(6), values(6, 3)],
    ),
    "add_cells": (lambda x, field: ops.add_cells(x, field, ROWS % 2), [values(6, 3), values(2, 3)]),
    "plane_sweep": (sweep, [values(2, 4, 3, 3)]),
    "rasterize_gaussians": (draw, [MEANS, values(6, 4), values(6, 3), values(6), values(6, 3), torch.eye(4)[None]]),
    "project_gaussians": (project, [MEANS, values(6, 4), values(6, 3), torch.eye(4)[None]]),
    "sh_to_color": (ops.sh_to_color, [MEANS, values(6, 4, 3)]),
    "rasterize_projected": (
        lambda *x: ops.rasterize_projected(*x, width=8, height=8).color,
        [8 * values(6, 2), CONICS, MEANS[:, 2], values(6), values(6, 3)],
    ),
}


# What these have beyond the first order is in test_transforms.py and test_raster_transforms.py.
HIGHER = {"pool_max", "pool_mean", "unpool", "sparse_conv", "patch_attention", "attention_log_sum_exp"}
HIGHER |= {"rasterize_gaussians"}
FIRST_ORDER = sorted(CALLS.keys() - HIGHER)
ONCE = [op for op in FIRST_ORDER if op != "add_cells"]  # its gradient is a sum, which has one


def test_every_op_with_gradients_is_here():
    names = {name.split(".")[0] for name in torch._C._dispatch_get_all_op_names() if name.startswith("gsim3d::")}
    rules = {name for name in names if torch._C._dispatch_has_kernel_for_dispatch_key(name, "Autograd")}
    first = {name for name in rules if not any(part in name for part in ("_backward", "_grad_", "_tangent"))}
    assert first == {f"gsim3d::{name}" for name in CALLS}


@pytest.mark.parametrize("op", CALLS)
def test_first_gradients_are_there(op):
    function, inputs = CALLS[op]
    leaves = [x.clone().requires_grad_() for x in inputs]
    out = function(*leaves)
    for create_graph in (True, False):
        grads = torch.autograd.grad(out.square().sum(), leaves, create_graph=create_graph, retain_graph=True)
        assert all(bool(grad.isfinite().all()) for grad in grads)


@pytest.mark.parametrize("op", FIRST_ORDER)
def test_forward_mode_is_refused(op):
    function, inputs = CALLS[op]
    for i, x in enumerate(inputs):

        def of_one(value):
            return function(*inputs[:i], value, *inputs[i + 1 :])

        with pytest.raises(GradientError, match=rf"^{op}: \w+ has no derivative in forward mode") as caught:
            torch.func.jvp(of_one, (x,), (torch.ones_like(x),))
        assert caught.value.op == op and caught.value.order == 1
        with forward_ad.dual_level(), pytest.raises(GradientError, match="forward mode"):
            of_one(forward_ad.make_dual(x, torch.ones_like(x)))


@pytest.mark.parametrize("op", FIRST_ORDER)
def test_transforms_are_refused(op):
    function, inputs = CALLS[op]
    with pytest.raises(GradientError, match="has no transforms of torch.func") as caught:
        torch.func.grad(lambda x: function(x, *inputs[1:]).sum())(inputs[0])
    assert caught.value.order == 1


@pytest.mark.parametrize("op", ONCE)
def test_second_derivatives_are_refused(op):
    function, inputs = CALLS[op]
    leaves = [x.clone().requires_grad_() for x in inputs]
    grads = torch.autograd.grad(function(*leaves).square().sum(), leaves, create_graph=True)
    with pytest.raises(GradientError, match="no second derivative") as caught:
        torch.autograd.grad(sum(grad.square().sum() for grad in grads), leaves, allow_unused=True)
    assert caught.value.order == 2


def refused():
    gaussians = [MEANS, values(6, 4), values(6, 3), values(6)]
    geometry = torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3), torch.ones(2, 1)
    sources = torch.tensor([1, 0]), torch.tensor([0, 1, 2])

    def raster(Ks):
        one = dataclasses.replace(cameras(), Ks=Ks)
        return ops.rasterize_gaussians(*gaussians, one, colors=values(6, 3)).color

    def swept(i):
        return lambda x: ops.plane_sweep(values(2, 4, 3, 3), *geometry[:i], x, *geometry[i + 1 :], *sources)

    def watched(x):
        zero, origin = torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.float64)
        activity = torch.zeros(6, dtype=torch.uint8)
        fields, bounds, cu_rows = [MEANS, x], [(-9, 9), (0, 1)], torch.tensor([0, 6])
        options = {"cloud_scene": zero, "origin": origin, "activity": activity}
        return ops.validate_state(fields, bounds, cu_rows, neutral=[0, 0], **options).fields[1]

    return {
        "Ks": (raster, cameras().Ks),
        "homographies": (swept(0), geometry[0]),
        "translations": (swept(1), geometry[1]),
        "inverse_depths": (swept(2), geometry[2]),
        "readings": (
            lambda r: ops.decode_gaussians(values(6, 19), r, degree=1, scale_min=0.1, scale_max=1.0)[2],
            READINGS,
        ),
        "fields[1]": (watched, values(6)),
    }


@pytest.mark.parametrize("name", refused())
def test_arguments_without_gradient_are_refused(name):
    function, x = refused()[name]
    expected = function(x)
    with pytest.raises(GradientError, match="has no gradient") as caught:
        function(x.clone().requires_grad_())
    assert caught.value.argument == name
    with pytest.raises(GradientError):
        torch.func.jvp(function, (x,), (torch.ones_like(x),))
    with torch.no_grad():
        assert torch.equal(function(x.clone().requires_grad_()), expected)


def test_geometry_has_gradients_that_sweeps_refuse():
    K = torch.tensor([[8.0, 0.1, 4], [0, 9, 3], [0, 0, 1]], dtype=torch.float64).repeat(2, 1, 1).requires_grad_()
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    viewmats[1, :3, 3] = torch.tensor([0.3, -0.2, 0.1])
    sources = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    geometry = lambda K, viewmats: ops.sweep_geometry(K, viewmats, *sources)  # noqa: E731
    assert torch.autograd.gradcheck(geometry, (K, viewmats.requires_grad_()))
    with pytest.raises(GradientError, match="homographies has no gradient"):
        ops.plane_sweep(values(2, 4, 3, 3).double(), *geometry(K, viewmats), torch.ones(2, 1).double(), *sources)
