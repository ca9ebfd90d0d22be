"""project_gaussians and sh_to_color against plain torch in float64."""

import dataclasses
import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from gsim3d.cameras import Cameras
from gsim3d.errors import GradientError, NumericalError
from gsim3d.ops import project_gaussians, rasterize_gaussians, rasterize_projected, sh_to_color
from gsim3d.ops._arguments import constant, offsets
from gsim3d.ops.projection import lens_limits
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.effects.counting import counted
from tests.ops.raster_scene import random_scene
from tests.oracle import projection as oracle
from tests.oracle.raster import legendre_basis

DTYPES = {torch.float32: "float32", torch.float64: "float64"}
PAIRS = ("means2d", "conics", "depths", "compensations")
DISTORTION = {
    "opencv": [0.12, -0.05, 0.01, -0.02, 0.03, 0.05, 0.02, -0.01],
    "fisheye": [0.05, -0.02, 0.01, 0.003],
}
LENSES = ["pinhole", "orthographic", "opencv", "fisheye"]


class Case:
    """Inputs of one call: two clouds of another size, the second shown twice."""

    def __init__(self, lens="pinhole", *, covars=False, n=40, seed=0, dtype=torch.float64, device="cpu"):
        scene = random_scene(n=n, clouds=2, images=3, width=45, height=37, seed=seed).replace(
            image_cloud=torch.tensor([1, 0, 1])
        )
        Ks = scene.Ks.clone()
        Ks[1:, 0, 0] *= 0.8
        self.lens, self.dtype = lens, dtype
        self.names = ["means", "covars"] if covars else ["means", "quats", "scales"]
        shapes = [oracle.covariances(scene.quats, scene.scales)] if covars else [scene.quats, scene.scales]
        self.leaves = [scene.means, *shapes, scene.viewmats, Ks]
        if lens in DISTORTION:
            self.leaves.append(
                torch.tensor([DISTORTION[lens]], dtype=torch.float64) * torch.tensor([[1.0], [0.5], [2]])
            )
        self.names += ["viewmats", "Ks", "distortion"]
        self.image_cloud, self.cu_rows, self.opacities = scene.image_cloud, scene.cu_rows, scene.opacities
        self.n_pairs = int((self.cu_rows[1:] - self.cu_rows[:-1])[self.image_cloud].sum())
        self.leaves = [x.to(dtype).to(device) for x in self.leaves]
        self.device = torch.device(device)

    def cameras(self, viewmats, Ks):
        zeros = torch.zeros(3, device=self.device)
        return Cameras(viewmats, Ks, zeros, zeros, self.image_cloud.to(self.device), 45, 37)

    def project(self, *leaves, **options):
        given = dict(zip(self.names, leaves or self.leaves))
        cameras = self.cameras(given.pop("viewmats"), given.pop("Ks"))
        options = {"lens": self.lens, "cu_rows": self.cu_rows.to(self.device), "n_pairs": self.n_pairs} | options
        means, quats, scales = given.pop("means"), given.pop("quats", None), given.pop("scales", None)
        return project_gaussians(means, quats, scales, cameras, **given, **options)

    def expected(self, *leaves, clamped=False, dilation=0.3):
        """The oracle's pairs and radii."""
        given = dict(zip(self.names, [x.double().cpu() for x in leaves or self.leaves]))
        shapes = given["covars"] if "covars" in given else oracle.covariances(given["quats"], given["scales"])
        if "covars" in given:
            shapes = shapes.triu() + shapes.triu(1).mT
        parts = []
        for i, cloud in enumerate(self.image_cloud.tolist()):
            rows = slice(int(self.cu_rows[cloud]), int(self.cu_rows[cloud + 1]))
            k = given["distortion"][i] if "distortion" in given else torch.zeros(8)
            seen = oracle.project(
                given["means"][rows], shapes[rows], given["viewmats"][i], given["Ks"][i], 45, 37,
                lens=self.lens, distortion=k, dilation=dilation, clamped=clamped,
            )  # fmt: skip
            radii = oracle.radii(seen[0], seen[4], seen[2], 45, 37, near=0.01, far=1e10, clip=0)
            parts.append((*seen[:4], radii))
        return [torch.cat(part) for part in zip(*parts)]


def pairs_of(projection):
    return projection.means2d, projection.conics, projection.depths, projection.compensations


def gradients_of(pairs, seen, leaves):
    """Gradients of a random mixture of what is seen."""
    g = torch.Generator().manual_seed(3)
    total = 0
    for pair in pairs:
        mix = torch.randn(pair.shape, generator=g, dtype=torch.float64).to(pair)
        total = total + (mix * pair)[seen].sum()
    return torch.autograd.grad(total, leaves)


def with_upper(name, grad):
    """The oracle reads the upper half of covars: of a symmetric gradient both halves together."""
    return grad.triu() + grad.mT.triu(1) if name == "covars" else grad


# ---- 1 forward against the oracle ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("covars", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_forward(device, lens, covars, dtype):
    case = Case(lens, covars=covars)
    *expected, radii = case.expected()
    seen = (radii > 0).all(1)
    actual = Case(lens, covars=covars, dtype=dtype, device=device).project()
    assert 10 < seen.sum() < len(seen)
    assert (actual.radii.cpu() != radii).double().mean() <= (0 if dtype == torch.float64 else 0.02)
    assert actual.cu_pairs.tolist()[-1] == case.n_pairs == len(actual.depths)
    for name, a, e in zip(PAIRS, pairs_of(actual), expected, strict=True):
        assert a.dtype == dtype
        assert_close_relative_to_max(a.cpu()[seen], e[seen], f"projection_{DTYPES[dtype]}", name)


def test_the_lower_half_of_covars_is_not_read(device):
    case = Case(covars=True, device=device)
    means, covars, *cameras = case.leaves
    other = covars.triu() + torch.full_like(covars, 7.0).tril(-1)
    for a, e in zip(pairs_of(case.project(means, other, *cameras)), pairs_of(case.project()), strict=True):
        assert_same_bits(a, e)


@pytest.mark.parametrize("dilation", [0.0, 0.3, 2.0])
def test_clamped_jacobian_and_any_dilation(device, dilation):
    case = Case()
    *expected, _ = case.expected(clamped=True, dilation=dilation)
    actual = Case(device=device).project(jacobian="clamped", dilation=dilation)
    seen = (actual.radii > 0).all(1).cpu()
    for name, a, e in zip(PAIRS, pairs_of(actual), expected, strict=True):
        assert_close_relative_to_max(a.cpu()[seen], e[seen], "projection_float64", name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_radii_follow_opacity_planes_and_clip(device, antialiased):
    case, options = Case(), {"near_plane": 2.5, "far_plane": 3.5, "radius_clip": 3.0, "antialiased": antialiased}
    means2d, _, depths, compensations, _ = case.expected()
    faint = 0.2 * case.opacities**4
    expected, before = [], 0
    for i, cloud in enumerate(case.image_cloud.tolist()):
        rows = slice(int(case.cu_rows[cloud]), int(case.cu_rows[cloud + 1]))
        pairs = slice(before, before := before + rows.stop - rows.start)
        shapes = oracle.covariances(*case.leaves[1:3])[rows]
        *_, covariance = oracle.project(
            case.leaves[0][rows], shapes, case.leaves[3][i], case.leaves[4][i], 45, 37,
            lens="pinhole", distortion=None, dilation=0.3, clamped=False,
        )  # fmt: skip
        alphas = faint[rows] * (compensations[pairs] if antialiased else 1)
        options_of = {"near": 2.5, "far": 3.5, "clip": 3.0, "alphas": alphas}
        expected.append(oracle.radii(means2d[pairs], covariance, depths[pairs], 45, 37, **options_of))
    actual = Case(device=device).project(opacities=faint.to(device), **options).radii.cpu()
    assert torch.equal(actual, torch.cat(expected)) and 0 < (actual > 0).sum() < 100


# ---- 2 backward against autograd of the oracle ---------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("covars", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_backward(device, lens, covars, dtype):
    case = Case(lens, covars=covars)
    leaves = [x.clone().requires_grad_() for x in case.leaves]
    *pairs, radii = case.expected(*leaves)
    moved = Case(lens, covars=covars, dtype=dtype, device=device)
    actual_leaves = [x.clone().requires_grad_() for x in moved.leaves]
    actual = moved.project(*actual_leaves)
    seen = (radii > 0).all(1) & (actual.radii > 0).all(1).cpu()
    expected = gradients_of(pairs, seen, leaves)
    grads = gradients_of([p.cpu() for p in pairs_of(actual)], seen, actual_leaves)
    for name, a, e in zip(case.names, grads, expected, strict=False):
        assert e.abs().max() > 0
        a, e = with_upper(name, a.cpu()) if name == "covars" else a.cpu(), e
        assert_close_relative_to_max(a, e, f"projection_grad_{DTYPES[dtype]}", name)


def test_what_is_not_seen_has_no_gradient(device):
    case = Case(device=device)
    leaves = [x.clone().requires_grad_() for x in case.leaves]
    seen = case.project(*leaves, near_plane=1e3, far_plane=1e4)
    assert seen.radii.abs().max() == 0 and all(pair.abs().max() == 0 for pair in pairs_of(seen))
    for grad in torch.autograd.grad(sum(pair.sum() for pair in pairs_of(seen)), leaves):
        assert grad.abs().max() == 0


# ---- 3 gradcheck in float64, all inputs together -------------------------------------------------------------------


@pytest.mark.unsanitized("runs the kernels of test_backward hundreds of times")
@pytest.mark.parametrize(("lens", "jacobian"), [(lens, "exact") for lens in LENSES] + [("pinhole", "clamped")])
def test_gradcheck(device, lens, jacobian):
    case = Case(lens, n=5, device=device)
    case.leaves[0] = 0.3 * case.leaves[0]
    if jacobian == "clamped":  # far outside of the image, and wide enough to reach into it
        case.leaves[0][0], case.leaves[2][0] = torch.tensor([2.5, 0.3, -1.0]), 1.0
    seen = (case.project(jacobian=jacobian).radii > 0).all(1)

    def pairs(*leaves):
        leaves = list(leaves)
        leaves[4] = torch.where(KEPT.to(leaves[4]) > 0, leaves[4], case.leaves[4])
        return tuple(pair[seen] for pair in pairs_of(case.project(*leaves, jacobian=jacobian)))

    assert seen.sum() >= 4
    leaves = [x.clone().requires_grad_() for x in case.leaves]
    assert torch.autograd.gradcheck(pairs, leaves, atol=1e-6, nondet_tol=0.0)


KEPT = torch.tensor([[1.0, 1, 1], [0, 1, 1], [0, 0, 0]])  # entries of K that are free


# ---- 4 CPU against CUDA --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", LENSES)
def test_devices_agree(devices, lens):
    both = []
    for device in devices:
        case = Case(lens, n=400, device=device, dtype=torch.float32)
        leaves = [x.clone().requires_grad_() for x in case.leaves]
        seen = case.project(*leaves)
        mask = (seen.radii > 0).all(1)
        both.append((mask.cpu(), [p.cpu() for p in pairs_of(seen)], gradients_of(pairs_of(seen), mask, leaves)))
    (mask, pairs, grads), (other_mask, other_pairs, other_grads) = both
    assert (mask != other_mask).double().mean() < 0.01
    for name, a, e in zip(PAIRS, other_pairs, pairs, strict=True):
        assert_close_relative_to_max(a[mask & other_mask], e[mask & other_mask], "projection_float32", name)
    if torch.equal(mask, other_mask):
        for a, e in zip(other_grads, grads, strict=True):
            assert_close_relative_to_max(a.cpu(), e, "projection_grad_float32")


def test_same_bits_every_time_on_cuda(devices):
    case = Case("opencv", n=20_000, device=devices[1], dtype=torch.float32)

    def run():
        leaves = [x.clone().requires_grad_() for x in case.leaves]
        seen = case.project(*leaves)
        return (*seen, *torch.autograd.grad(sum(p.sum() for p in pairs_of(seen)), leaves))

    for a, e in zip(run(), run(), strict=True):
        assert_same_bits(a, e)


# ---- 5 opcheck -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("covars", [False, True])
def test_opcheck(device, covars):
    case = Case("opencv", n=8, covars=covars, device=device)
    leaves = [x.clone().requires_grad_() for x in case.leaves]
    shapes = (None, None, leaves[1]) if covars else (*leaves[1:3], None)
    lists = [x.to(device) for x in (case.image_cloud, case.cu_rows, case.project().cu_pairs)]
    args = (
        leaves[0], *shapes, None, *leaves[-3:], torch.full((3,), 9.0, dtype=torch.float64, device=device), *lists,
        case.n_pairs, 45, 37, 0.01, 1e10, 0.0, 0.3, 2, False, False,
    )  # fmt: skip
    torch.library.opcheck(torch.ops.gsim3d.project_gaussians, args)


@pytest.mark.parametrize("wanted", [(False, False), (True, False), (False, True)], ids=str)
def test_opcheck_of_the_gradient(device, wanted):
    case = Case("opencv", n=8, device=device)
    seen = case.project()
    means, quats, scales, viewmats, Ks, distortion = case.leaves
    lists = [x.to(device) for x in (case.image_cloud, case.cu_rows)]
    scene = (seen.radii, means, quats, scales, None, viewmats, Ks, distortion, *lists, seen.cu_pairs)
    args = (*pairs_of(seen), *scene, case.n_pairs, 45, 37, 0.3, 2, False, *wanted)
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.project_gaussians_backward, args, test_utils=checks)


def test_opcheck_sh(device):
    args = [torch.randn(2, 3, 4, size, dtype=torch.float64, device=device) for size in (3, 5)]
    args[1] = args[1].movedim(1, 2)[:, :, :1].repeat(1, 1, 9, 1).contiguous()
    torch.library.opcheck(torch.ops.gsim3d.sh_to_color, [x.requires_grad_() for x in args])


# ---- 6 torch.compile -----------------------------------------------------------------------------------------------


def test_compile_equals_eager(device):
    case = Case(n=20, dtype=torch.float32, device=device)
    leaves = [x.clone().requires_grad_() for x in case.leaves]

    def loss(*leaves):
        seen = case.project(*leaves)
        color = sh_to_color(leaves[0], leaves[0][:, None, :].expand(-1, 4, -1))
        return (seen.means2d**2).mean() + seen.conics.sum() + seen.depths.mean() + color.sum()

    expected = loss(*leaves)
    value = torch.compile(loss, fullgraph=True)(*leaves)
    assert_close_relative_to_max(value, expected, 1e-5)
    for a, e in zip(torch.autograd.grad(value, leaves), torch.autograd.grad(expected, leaves), strict=True):
        assert_close_relative_to_max(a, e, 1e-5)


# ---- 7 edges -------------------------------------------------------------------------------------------------------


def test_same_bits_for_any_threads():
    case = Case("fisheye", n=5000, dtype=torch.float32)

    def run():
        leaves = [x.clone().requires_grad_() for x in case.leaves]
        seen = case.project(*leaves)
        return (*seen, *torch.autograd.grad(sum(p.sum() for p in pairs_of(seen)), leaves))

    assert_same_bits_for_any_threads(run)


def test_no_rows_and_no_images(device):
    case = Case(device=device)
    means, quats, scales, viewmats, Ks = case.leaves
    none = project_gaussians(means[:0], quats[:0], scales[:0], case.cameras(viewmats, Ks).select(torch.tensor([1])))
    assert none.means2d.shape == (0, 2) and none.cu_pairs.tolist() == [0, 0]
    no_image = case.cameras(viewmats, Ks).select(torch.zeros(0, dtype=torch.int64))
    assert project_gaussians(means, quats, scales, no_image).radii.shape == (0, 2)


@pytest.mark.parametrize(("lens", "k"), [("opencv", [-0.3, 0.0, 0.0, 0.0]), ("fisheye", [-0.2, 0.0, 0.0, 0.0])])
def test_points_beyond_the_monotone_radius_are_left_out(device, lens, k):
    # r + k r^3 rises up to r = sqrt(-1 / (3 k)).
    limit = math.sqrt(1 / (3 * -k[0]))
    k = torch.tensor([k], device=device, dtype=torch.float64)
    assert_close_relative_to_max(lens_limits(lens, k).cpu(), torch.tensor([limit], dtype=torch.float64), 1e-9)
    tangents = torch.tensor([0.99, 1.01], dtype=torch.float64) * limit
    tangents = tangents if lens == "opencv" else tangents.tan()
    means = torch.stack([tangents, 0 * tangents, 0 * tangents + 1], 1).to(device)
    K = torch.tensor([[[100.0, 0, 200], [0, 100, 200], [0, 0, 1]]], dtype=torch.float64, device=device)
    zero = torch.zeros(1, dtype=torch.int64, device=device)
    cameras = Cameras(torch.eye(4, device=device)[None].double(), K, zero, zero, zero, 400, 400)
    covars = 0.01 * torch.eye(3, device=device, dtype=torch.float64).repeat(2, 1, 1)
    seen = project_gaussians(means, None, None, cameras, covars=covars, lens=lens, distortion=k)
    assert (seen.radii > 0).all(1).tolist() == [True, False]


@pytest.mark.parametrize(("lens", "n"), [("opencv", 4), ("opencv", 5), ("opencv", 8), ("fisheye", 4)])
def test_limits_against_a_fine_scan(lens, n):
    k = torch.randn(30, n, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    angles = torch.linspace(0, math.pi if lens == "fisheye" else math.pi / 2 - 1e-2, 100_001, dtype=torch.float64)
    r = angles if lens == "fisheye" else angles.tan()
    c = torch.nn.functional.pad(k, (0, 8 - n))[..., None].unbind(1)
    up, down = (c[:4], ()) if lens == "fisheye" else ((c[0], c[1], c[4]), c[5:])
    above, below = (1 + sum(c[i] * r ** (2 * i + 2) for i in range(len(c))) for c in (up, down))
    falls = torch.nn.functional.pad((r * above / below).diff(dim=1) <= 0, (0, 1)) | torch.as_tensor(below <= 0)
    expected = torch.where(falls.any(1), angles[falls.int().argmax(1)], math.inf)
    limits = lens_limits(lens, k)
    assert 5 < falls.any(1).sum() and torch.equal(limits.isinf(), expected.isinf())
    found = limits if lens == "fisheye" else limits.atan()
    assert (found - expected)[limits.isfinite()].abs().max() < 1e-4


def test_lenses_without_a_fold_have_no_limit():
    assert lens_limits("opencv", torch.tensor([[0.1, 0.01, 0.0, 0.0]])).item() == math.inf
    assert lens_limits("fisheye", torch.tensor([[0.1, 0.01, 0.0, 0.0]])).item() == math.inf


@pytest.mark.parametrize("lens", DISTORTION)
def test_limits_take_few_operations(lens):
    # Each is a launch on a GPU, in every call with a distortion.
    with counted() as operations:
        lens_limits(lens, torch.tensor([DISTORTION[lens]]))
    assert operations.calls.total() < 300


def test_on_the_axis_of_a_fisheye(device):
    # theta / r is 0 / 0 there; its derivatives are those of the pinhole.
    case = Case(device=device)
    K, zero = case.leaves[4][:1], torch.zeros(1, dtype=torch.int64, device=device)
    cameras = Cameras(torch.eye(4, device=device)[None].double(), K, zero, zero, zero, 45, 37)
    mean = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64, device=device, requires_grad=True)
    covars = 0.01 * torch.eye(3, device=device, dtype=torch.float64)[None]
    both = []
    for lens in ("fisheye", "pinhole"):
        seen = project_gaussians(mean, None, None, cameras, covars=covars, lens=lens)
        both.append((*pairs_of(seen), torch.autograd.grad(seen.means2d[0, 0] + seen.conics[0, 0], mean)[0]))
    for a, e in zip(*both, strict=True):
        assert_close_relative_to_max(a, e, 1e-12)


def test_together_with_blending_equals_the_fused_op(device):
    scene = random_scene(n=80, seed=4).to(device)
    fused = scene.render(jacobian="clamped")
    rows = (scene.means, scene.quats, scene.scales)
    seen = project_gaussians(
        *rows,
        scene.cameras(),
        cu_rows=scene.cu_rows,
        n_pairs=None if device.type == "cpu" else 1000,
        jacobian="clamped",
    )
    cu_rows, image_cloud = scene.cu_rows.tolist(), scene.image_cloud.tolist()
    of_pairs = torch.cat([torch.arange(cu_rows[c], cu_rows[c + 1]) for c in image_cloud]).to(device)
    points = torch.cat(
        [
            (scene.means[cu_rows[c] : cu_rows[c + 1]] @ V[:3, :3].T + V[:3, 3]) @ V[:3, :3]
            for c, V in zip(image_cloud, scene.viewmats)
        ]
    )
    color = sh_to_color(points, scene.color[of_pairs])
    n = len(of_pairs)
    image = rasterize_projected(
        *(x[:n] for x in seen[:3]), scene.opacities[of_pairs], torch.cat([color, scene.features[of_pairs]], 1),
        width=scene.width, height=scene.height, cu_pairs=seen.cu_pairs,
        background=torch.cat([scene.background, torch.zeros(4, 3, device=device)], 1).double(),
    )  # fmt: skip
    parts = (image.color[..., :3], image.alpha, image.depth, image.color[..., 3:])
    for a, e in zip(parts, fused, strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")


# ---- colours -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("n_channels", [1, 3, 5])
def test_colors_of_harmonics(device, degree, n_channels, dtype):
    g = torch.Generator().manual_seed(degree)
    directions = torch.randn(2, 3, 7, 3, generator=g, dtype=torch.float64).requires_grad_()
    sh = 0.4 * torch.randn(2, 7, (degree + 1) ** 2, n_channels, generator=g, dtype=torch.float64)
    sh.requires_grad_()
    basis = legendre_basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    basis = basis.reshape(2, 3, 7, -1)
    expected = (torch.einsum("bvnk,bnkd->bvnd", basis, sh) + 0.5).clamp_min(0)
    leaves = [x.detach().to(device, dtype).requires_grad_() for x in (directions, sh)]
    actual = sh_to_color(*leaves)
    assert_close_relative_to_max(actual, expected, f"projection_{DTYPES[dtype]}")
    mix = torch.randn(expected.shape, generator=g, dtype=torch.float64)
    grads = torch.autograd.grad((actual * mix.to(actual)).sum(), leaves)
    for a, e in zip(grads, torch.autograd.grad((expected * mix).sum(), (directions, sh)), strict=True):
        assert_close_relative_to_max(a, e, f"projection_grad_{DTYPES[dtype]}")


def test_half_precision_coefficients(device):
    directions, sh = torch.randn(6, 3, device=device), torch.randn(6, 4, 3, device=device).half().requires_grad_()
    color = sh_to_color(directions, sh)
    color.sum().backward()
    assert color.dtype == torch.float32 and sh.grad.dtype == torch.float16
    assert_same_bits(color, sh_to_color(directions, sh.float()))


# ---- 8 errors ------------------------------------------------------------------------------------------------------


def test_errors_name_the_argument():
    case = Case()
    means, quats, scales, viewmats, Ks = case.leaves
    cameras = case.cameras(viewmats, Ks)

    def call(means=means, quats=quats, scales=scales, cameras=cameras, **options):
        return project_gaussians(means, quats, scales, cameras, **{"cu_rows": case.cu_rows} | options)

    with pytest.raises(TypeError, match="cameras must be"):
        call(cameras=viewmats)
    with pytest.raises(ValueError, match="quats must be"):
        call(quats=quats[:, :3])
    with pytest.raises(ValueError, match="give quats and scales, or covars"):
        call(covars=torch.eye(3).repeat(40, 1, 1).double())
    with pytest.raises(ValueError, match="give quats and scales, or covars"):
        call(scales=None)
    with pytest.raises(ValueError, match="give quats and scales, or covars"):
        call(scales=None, covars=torch.eye(3).repeat(40, 1, 1).double())
    with pytest.raises(ValueError, match="image_cloud must be int64"):
        call(cameras=dataclasses.replace(cameras, image_cloud=cameras.image_cloud.int()))
    with pytest.raises(ValueError, match="lens must be one of pinhole"):
        call(lens="ftheta")
    with pytest.raises(ValueError, match="distortion is of the lenses"):
        call(distortion=torch.zeros(3, 4).double())
    with pytest.raises(ValueError, match=r"distortion must be \[I=3, 4 or 5 or 8\]"):
        call(lens="opencv", distortion=torch.zeros(3, 3).double())
    with pytest.raises(ValueError, match="far_plane"):
        call(near_plane=2.0, far_plane=1.0)
    with pytest.raises(ValueError, match="n_pairs must be"):
        call(n_pairs=3)
    with pytest.raises(ValueError, match="n_pairs must be"):
        call(n_pairs=3, cu_rows=None, cameras=cameras.select(torch.tensor([1])))
    with pytest.raises(ValueError, match="image_cloud must be in"):
        call(cameras=dataclasses.replace(cameras, image_cloud=torch.tensor([0, 1, 2])))
    with pytest.raises(NumericalError, match="means must be finite"):
        call(means=torch.full_like(means, math.nan))
    with pytest.raises(NumericalError, match="scales must be finite, not negative and at most"):
        project_gaussians(means, quats, -scales - 1, cameras, cu_rows=case.cu_rows)
    for opacity in (-0.1, 1.1):
        with pytest.raises(NumericalError, match="opacities must be finite, not negative and at most 1; got"):
            call(opacities=torch.full_like(case.opacities, opacity))
    with pytest.raises(ValueError, match="cu_rows must ascend from 0"):
        call(cu_rows=case.cu_rows.flip(0))
    with pytest.raises(ValueError, match="sh must be float32, as directions, or of 16 bits; got torch.float64"):
        sh_to_color(torch.zeros(2, 3), torch.zeros(2, 4, 3).double())
    with pytest.raises(ValueError, match="float32 or float64"):
        call(means=means.half())
    with pytest.raises(ValueError, match=r"1, 4, 9, 16 or 25 coefficients"):
        sh_to_color(torch.zeros(2, 3), torch.zeros(2, 5, 3))
    with pytest.raises(ValueError, match="directions must be"):
        sh_to_color(torch.zeros(2, 3), torch.zeros(1, 2, 4, 3))


def test_second_derivatives_are_refused_by_name():
    case = Case()
    leaves = [x.clone().requires_grad_() for x in case.leaves]
    grad = torch.autograd.grad(case.project(*leaves).depths.sum(), leaves[0], create_graph=True)[0]
    with pytest.raises(GradientError, match="project_gaussians"):
        grad.sum().backward()
    with pytest.raises(GradientError, match="Ks"):
        rasterize_gaussians(*leaves[:3], case.opacities, case.cameras(*leaves[3:]), colors=leaves[0])


@pytest.mark.parametrize("n_clouds, n_images", [(2, 4), (3, 3), (1, 2)])
def test_clouds_of_one_size_equal_lists(n_clouds, n_images, device):
    case = Case(n=12, device=device)
    means, quats, scales, *_ = case.leaves
    n = len(means) // n_clouds * n_clouds
    rows = means[:n], quats[:n], scales[:n]
    viewmats, Ks = (x[torch.arange(n_images, device=x.device) % 3] for x in case.leaves[3:5])
    owners = torch.arange(n_clouds, device=device).repeat_interleave(n_images // n_clouds)
    zeros = torch.zeros(n_images, device=device)
    cameras = Cameras(viewmats, Ks, zeros, zeros, owners, 45, 37)
    cu_rows = torch.arange(n_clouds + 1, device=device) * (n // n_clouds)
    expected = project_gaussians(*rows, cameras, cu_rows=cu_rows, n_pairs=n_images * n // n_clouds)
    unknown = dataclasses.replace(cameras, image_cloud=torch.full_like(owners, 7))
    for _ in range(2):
        for actual, wanted in zip(project_gaussians(*rows, unknown, n_clouds=n_clouds), expected, strict=True):
            assert_same_bits(actual, wanted)


def test_clouds_that_are_not_of_one_size_raise():
    case = Case(n=40)
    means, quats, scales, viewmats, Ks = case.leaves
    cameras, lists = case.cameras(viewmats, Ks), case.cu_rows
    for n_clouds, cu_rows in ((2, None), (3, None), (0, None), (-1, None), (1, lists)):
        with pytest.raises(ValueError, match=r"n_clouds must divide N=\d+ rows and I=3 images, and stand in place"):
            project_gaussians(means, quats, scales, cameras, cu_rows=cu_rows, n_clouds=n_clouds)


def test_kept_lists_are_those_of_their_sizes():
    device = torch.device("cpu")
    assert constant(offsets, 3, 5, device=device).tolist() == [0, 5, 10, 15]
    assert constant(offsets, 3, 5, device=device) is constant(offsets, 3, 5, device=device)
    assert constant(offsets, 3, 4, device=device).tolist() == [0, 4, 8, 12]
    with torch.inference_mode():
        assert not constant(offsets, 2, 9, device=device).is_inference()
    with FakeTensorMode():
        assert isinstance(constant(offsets, 6, 7, device=device), FakeTensor)
    assert not isinstance(constant(offsets, 6, 7, device=device), FakeTensor)
