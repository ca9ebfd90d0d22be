"""rasterize_gaussians against images and gradients of the published model's renderer (golden file j_raster)."""

import pytest
import torch

from gsim3d.ops import rasterize_gaussians
from gsim3d.types import Cameras
from tests.asserts import assert_close_relative_to_max
from tests.golden_files import golden
from tests.oracle.raster import legendre_basis, rotation_matrix

pytestmark = pytest.mark.golden
SIZE = 48
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


def camera(file, view: int) -> Cameras:
    """The published renderer knows fields of view only: the principal point is the image centre."""
    settings = file / f"view{view}" / "raster_settings"
    K = torch.eye(3, dtype=torch.float64)
    K[0, 0], K[1, 1] = (0.5 * SIZE / settings[f"tanfov{axis}"].double() for axis in "xy")
    K[:2, 2] = SIZE / 2
    viewmat = torch.linalg.inv(file["in/extrinsics"][view].double())
    near, far = file["in/near"][view : view + 1].double(), file["in/far"][view : view + 1].double()
    return Cameras(viewmat[None], K[None], near, far, torch.tensor([0]), SIZE, SIZE)


def inputs(file):
    """quats, scales and the published covariances, which they give; means, opacities, harmonics [N, 3, 16]."""
    given = file / "f64" / "in"
    x, y, z, w = file["in/quats_xyzw_unnormalised"].double().unbind(-1)
    quats, scales = torch.stack([w, x, y, z], -1), file["in/scales"].double()
    assert_close_relative_to_max(covariance(quats, scales), given["covariances"], 1e-6)
    return given["means"], quats, scales, given["opacities"][:, 0], given["harmonics"]


def render(file, view, means, quats, scales, opacities, harmonics, cutoff):
    sh = torch.einsum("kj,nck->njc", basis_change().to(harmonics), harmonics)
    cameras = camera(file, view)
    background = file["in/background"][view].to(means)
    near_plane = 0.2 * float(cameras.near)
    return rasterize_gaussians(
        means, quats, scales, opacities, cameras, sh=sh, background=background, near_plane=near_plane, cutoff=cutoff
    )


@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize("mode", CUTOFFS)
def test_images_and_gradients(view, mode):
    file = golden("j_raster")
    expected = file / "f64" / f"view{view}_{mode}"
    leaves = [x.requires_grad_() for x in inputs(file)]
    # Without the cut to tiles, the published images still lack Gaussians whose square of tiles is off the image.
    kept = file[f"view{view}/inter/visible"] if mode == "notilecull" else torch.ones(300, dtype=torch.bool)
    image = render(file, view, *(x[kept] for x in leaves), CUTOFFS[mode]).color[0].permute(2, 0, 1)
    assert_close_relative_to_max(image, expected["image"], "raster_golden")

    grads = torch.autograd.grad(image, leaves, file[f"f64/view{view}/cotangent"])
    # The published gradient is one of the covariance (upper triangle); scales and quaternions follow from it.
    quats, scales = (leaves[i].detach().requires_grad_() for i in (1, 2))
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
        assert_close_relative_to_max(actual, wanted, "raster_golden_grad", name)


@pytest.mark.parametrize("view", [0, 1])
def test_float32_image_and_depth(view):
    file = golden("j_raster")
    out = render(file, view, *(x.float() for x in inputs(file)), "tile3sigma")
    expected = file / f"view{view}"
    assert_close_relative_to_max(out.color[0].permute(2, 0, 1), expected["image_float32"], "raster_golden_float32")
    assert_close_relative_to_max(out.depth[0], expected["depth_image_float32"], "raster_golden_float32")


def test_masked_rows_are_absent():
    file = golden("j_raster")
    kept = file["masked/mask"][:, 0]
    out = render(file, 0, *(x[kept] for x in inputs(file)), "tile3sigma")
    assert_close_relative_to_max(out.color[0].permute(2, 0, 1), file["f64/masked/view0_image"], "raster_golden")
