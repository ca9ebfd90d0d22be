"""rasterize_gaussians in float64 against images, gradients and projections of the published renderer (j_raster).

The scene is scaled by 1 / near, as the published renderer scales it, and seen by the very cameras that it was given, so
both sides start from the same numbers.
"""

import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.math.spherical_harmonics import sh_basis
from gsim3d.ops import rasterize_gaussians
from tests.asserts import assert_close_relative_to_max
from tests.golden_files import golden
from tests.oracle.raster import MIN_ALPHA, MIN_TRANSMITTANCE, legendre_basis, project, rotation_matrix, tiles_touched

pytestmark = pytest.mark.golden
NEAR_PLANE = 0.2  # of the scaled scene
CUTOFFS = {"tilecull": "tile3sigma", "notilecull": "exact"}


def basis_change() -> torch.Tensor:
    """M [16, 16] with published basis(d) = M standard basis(d): the published one reads (z, x, y) for (x, y, z)."""
    directions = torch.nn.functional.normalize(
        torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    published = legendre_basis(directions[:, [2, 0, 1]], 3)
    return torch.linalg.lstsq(legendre_basis(directions, 3), published).solution.T


def covariance(quats: torch.Tensor, scales: torch.Tensor) -> torch.Tensor:
    axes = rotation_matrix(quats) @ torch.diag_embed(scales)
    return axes @ axes.mT


def image_size(file) -> int:
    height, width = file["view0/image_float32"].shape[1:]
    assert height == width
    return width


def camera(file, view: int) -> Cameras:
    """Of the scaled scene; the published renderer's principal point is the image's centre."""
    settings, size = file / f"view{view}" / "raster_settings", image_size(file)
    K = torch.eye(3, dtype=torch.float64)
    K[0, 0], K[1, 1] = (0.5 * size / settings[f"tanfov{axis}"].double() for axis in "xy")
    K[:2, 2] = size / 2
    viewmat = settings["viewmatrix"].double().mT
    near, far = torch.ones(1), file["in/far"][view : view + 1] / file["in/near"][view : view + 1]
    return Cameras(viewmat[None], K[None], near, far, torch.tensor([0]), size, size)


def inputs(file):
    """means, quats, scales, opacities, published harmonics [N, 3, 16]; quats and scales give the covariances."""
    given = file / "f64" / "in"
    quats, scales = file["in/quats_xyzw_unnormalised"].roll(1, 1).double(), file["in/scales"].double()
    assert_close_relative_to_max(covariance(quats, scales), given["covariances"], "golden_float32")
    values, axes = torch.linalg.eigh(given["covariances"])  # of the covariances themselves, which are float64
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]
    return given["means"], quats_of(axes), values.sqrt(), given["opacities"][:, 0], given["harmonics"]


def quats_of(rotations: torch.Tensor) -> torch.Tensor:
    """Unit quaternions [N, 4] (w, x, y, z): the eigenvector of Bar-Itzhack's symmetric matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotations.unbind(-2))
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, yx + xy, xz + zx],
        [xz - zx, yx + xy, yy - xx - zz, zy + yz],
        [yx - xy, xz + zx, zy + yz, zz - xx - yy],
    ]
    return torch.linalg.eigh(torch.stack([torch.stack(row, -1) for row in rows], -2))[1][..., -1]


def render(file, view, means, quats, scales, opacities, harmonics, cutoff):
    near = file["in/near"][view].to(means)
    sh = torch.einsum("kj,nck->njc", basis_change().to(harmonics), harmonics)
    background = file["in/background"][view].to(means)
    scene = means / near, quats, scales / near, opacities, camera(file, view).to(means.device)
    options = {"background": background, "near_plane": NEAR_PLANE, "cutoff": cutoff, "jacobian": "clamped"}
    return rasterize_gaussians(*scene, sh=sh, **options)


@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize("mode", CUTOFFS)
def test_images_and_gradients(view, mode, device):
    file = golden("j_raster")
    expected = file / "f64" / f"view{view}_{mode}"
    leaves = [x.to(device).requires_grad_() for x in inputs(file)]
    # Without the cut to tiles, the published images still lack Gaussians whose square of tiles is off the image.
    visible = file[f"view{view}/inter/visible"]
    kept = (visible if mode == "notilecull" else torch.ones_like(visible)).to(device)
    image = render(file, view, *(x[kept] for x in leaves), CUTOFFS[mode]).color[0].permute(2, 0, 1)
    assert_close_relative_to_max(image, expected["image"], "raster_golden", "image")

    grads = torch.autograd.grad(image, leaves, file[f"f64/view{view}/cotangent"].to(device))
    # The published gradient is one of the covariance (upper triangle); scales and quaternions follow from it.
    quats, scales = (leaves[i].detach().cpu().requires_grad_() for i in (1, 2))
    upper = torch.triu(expected["grad/covariances"])
    grad_quats, grad_scales = torch.autograd.grad(covariance(quats, scales), (quats, scales), upper)
    checks = {
        "means": (grads[0], expected["grad/means"]),
        "quats": (grads[1], grad_quats),
        "scales": (grads[2], grad_scales),
        "opacities": (grads[3], expected["grad/opacities"][:, 0]),
        "harmonics": (grads[4], expected["grad/harmonics"]),
    }
    for name, (actual, wanted) in checks.items():
        assert_close_relative_to_max(actual, wanted, "raster_golden", name)


def test_masked_rows_are_absent():
    file = golden("j_raster")
    kept = file["masked/mask"][:, 0]
    out = render(file, 0, *(x[kept] for x in inputs(file)), "tile3sigma")
    assert_close_relative_to_max(out.color[0].permute(2, 0, 1), file["f64/masked/view0_image"], "raster_golden")


@pytest.mark.parametrize("view", [0, 1])
def test_transmittance(view):
    file = golden("j_raster")
    out = render(file, view, *inputs(file), "tile3sigma")
    assert_close_relative_to_max(1 - out.alpha[0], file[f"f64/view{view}/inter/final_T"], "raster_golden")


def projected_by_oracle(file, view):
    """Pixels, covariances and camera points of the scaled scene, and its camera's intrinsics."""
    means, quats, scales, *_ = inputs(file)
    near = file["in/near"][view].double()
    cameras = camera(file, view)
    K, size = cameras.Ks[0], image_size(file)
    return *project(means / near, quats, scales / near, cameras.viewmats[0], K, size, size, "clamped"), K


@pytest.mark.parametrize("view", [0, 1])
def test_projections_of_the_oracle(view):
    """The oracle of tests/ops, which has seen neither side, projects to the same pixels, sizes and visibility."""
    file = golden("j_raster")
    pixels, covariances, points, K = projected_by_oracle(file, view)
    f64, inter = file / "f64" / f"view{view}" / "inter", file / f"view{view}" / "inter"
    upper = (slice(None), [0, 0, 1], [0, 1, 1])
    visible = inter["visible"]
    assert not points[visible, 2].le(NEAR_PLANE).any()
    assert_close_relative_to_max(points[:, 2], f64["depth"], "raster_golden", "depth")
    for name, ours in {
        "means2D": pixels - 0.5,  # published pixel centres are whole numbers
        "cov2D": covariances[upper],
        "conic": torch.linalg.inv(covariances)[upper],
    }.items():
        assert_close_relative_to_max(ours[visible], f64[name][visible], "raster_golden", name)

    middle = covariances.diagonal(dim1=1, dim2=2).mean(1)
    largest = middle + (middle**2 - torch.linalg.det(covariances)).clamp(min=0.1).sqrt()
    radii = (3 * largest.sqrt()).ceil().int()
    assert torch.equal(radii[visible], inter["radii"][visible]) and not inter["radii"][~visible].any()
    offset = (points[:, :2] / points[:, 2:]).abs() * K.diagonal()[:2] / (image_size(file) / 2)  # in half opening angles
    assert torch.equal((offset > 1.3).any(1)[visible], inter["clamped_uv"][visible])


@pytest.mark.parametrize("view", [0, 1])
def test_number_of_gaussians_in_each_pixel(view):
    """Counted with the oracle's projections: the published renderer's rules of who adds to a pixel."""
    file = golden("j_raster")
    pixels, covariances, points, _ = projected_by_oracle(file, view)
    y, x = torch.meshgrid(*[torch.arange(image_size(file))] * 2, indexing="ij")
    touched = tiles_touched(pixels, covariances, x, y) & (points[:, 2] > NEAR_PLANE)[:, None, None]
    offset = torch.stack([x, y], -1) + 0.5 - pixels[:, None, None]
    distance = torch.einsum("nhwi,nij,nhwj->nhw", offset, torch.linalg.inv(covariances), offset)
    alpha = file["f64/in/opacities"][:, :, None] * torch.exp(-distance / 2)
    alpha = torch.where(touched & (alpha >= MIN_ALPHA), alpha, 0)[torch.argsort(points[:, 2])]
    light = torch.cumprod(1 - alpha, 0)
    counted = ((alpha > 0) & (light >= MIN_TRANSMITTANCE)).sum(0)
    clear = ((light / MIN_TRANSMITTANCE - 1).abs() > 1e-4).all(0)  # where it ends is not a matter of rounding
    assert clear.float().mean() > 0.99
    assert torch.equal(counted[clear], file[f"view{view}/inter/ncontrib"][clear])


@pytest.mark.parametrize("view", [0, 1])
def test_colors_by_direction(view):
    file = golden("j_raster")
    means, *_, harmonics = inputs(file)
    near = file["in/near"][view].double()
    sh = torch.einsum("kj,nck->njc", basis_change(), harmonics)
    cameras = camera(file, view)
    directions = torch.nn.functional.normalize(means / near - torch.linalg.inv(cameras.viewmats[0])[:3, 3], dim=1)
    colors = (torch.einsum("nk,nkc->nc", sh_basis(directions, 3), sh) + 0.5).clamp(min=0)
    expected, visible = file[f"f64/view{view}/inter/color"], file[f"view{view}/inter/visible"]
    assert_close_relative_to_max(colors[visible], expected[visible], "raster_golden", "colours")
