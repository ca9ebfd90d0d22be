"""Hard cases of the rasterizer. Beside each hard scene an ordinary one is rendered, whose bits must not change."""

import dataclasses
import itertools

import pytest
import torch

from gsim3d.numerics.report import StabilityReport
from gsim3d.ops import rasterize_gaussians
from tests.ops.raster_scene import Scene, facing
from tests.stability.packed import (
    check_against_oracle,
    check_left_out,
    pack,
    render_beside_another,
    without_rows,
)
from tests.stability.rollouts import raised
from tests.stability.setting import NAMES

NAN, INF = float("nan"), float("inf")
CENTRE = (1 / 16, 1 / 16, 2.0)  # projects onto the centre of pixel (8, 8) of facing(...)


def three(**fields) -> Scene:
    """Three ordinary Gaussians in front of each other."""
    means = torch.tensor([[0.1, 0.0, 2.0], [-0.1, 0.1, 2.5], [0.0, -0.1, 3.0]])
    colors = torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.8, 0.3], [0.2, 0.3, 0.7]])
    quats = torch.tensor([[0.9, 0.1, 0.3, 0.2], [0.2, 0.5, -0.4, 0.3], [0.7, -0.1, 0.2, 0.4]])
    scales = torch.tensor([[0.1, 0.2, 0.05], [0.2, 0.1, 0.1], [0.15, 0.1, 0.3]])
    return facing(means, **{"scales": scales, "color": colors, "quats": quats, **fields})


def change(scene: Scene, name: str, row: int, value) -> Scene:
    tensor = getattr(scene, name).clone()
    tensor[row] = value
    return scene.replace(**{name: tensor})


def test_r01_zero_gaussians(setting, measured):
    background = torch.tensor([[0.1, 0.2, 0.3]])
    scene = facing(torch.zeros(0, 3), background=background)
    result = check_against_oracle(setting, measured, scene)
    measured.same_bits(result.color, setting.to(background).expand(1, 16, 16, 3))
    assert not result.alpha.any() and not result.depth.any() and not result.grads["viewmats"].any()


@pytest.mark.parametrize("n", [1, 3])
def test_r02_few_gaussians_on_a_big_image(setting, measured, n):
    scene = without_rows(three(width=317, height=241), list(range(n, 3)))
    scene = scene.replace(Ks=torch.tensor([[[300.0, 0, 158.5], [0, 300.0, 120.5], [0, 0, 1]]]))
    check_against_oracle(setting, measured, scene)


def test_r02_one_gaussian_is_the_formula(setting, measured):
    """A round Gaussian on the axis: alpha = opacity exp(-r^2 / 2 s^2), s^2 = (focal scale / z)^2 + 0.3 pixels^2."""
    result = render_beside_another(setting, measured, facing([0, 0, 2.0], scales=0.4, opacities=0.6))
    y, x = torch.meshgrid(torch.arange(16.0) - 7.5, torch.arange(16.0) - 7.5, indexing="ij")
    scale, opacity = torch.tensor([0.4, 0.6]).tolist()
    alpha = opacity * torch.exp(-(x * x + y * y).double() / (2 * ((16 * scale / 2) ** 2 + 0.3)))
    measured.close(result.alpha[0], torch.where(alpha >= 1 / 255, alpha, 0), f"raster_{setting.exact}")


def test_r03_one_opaque_gaussian_writes_its_colour(setting, measured):
    color = torch.tensor([[0.9, 0.5, 0.1]])
    scene = facing(CENTRE, opacities=1.0, color=color, background=torch.tensor([[0.5, 0.5, 0.5]]))
    result = check_against_oracle(setting, measured, scene)
    measured.close(result.color[0, 8, 8], 0.99 * color[0] + 0.01 * 0.5, 1e-6)
    assert not result.grads["opacities"].isnan().any()
    measured.outcome("0.99 of the colour, 0.01 of the background")


@pytest.mark.parametrize("opacity", [0.0, 1e-30, 0.999 / 255])
def test_r04_invisible_opacities(setting, measured, opacity):
    check_left_out(setting, measured, change(three(), "opacities", 1, opacity), [1])


def test_r05_thousands_of_coincident_opaque_gaussians(setting, measured):
    means = torch.tensor([CENTRE]).repeat(3000, 1)
    scene = facing(means, opacities=0.98, color=torch.linspace(0, 1, 9000).reshape(3000, 3))
    result = check_against_oracle(setting, measured, scene, bounds=("raster_many", "raster_many_grad"))
    assert result.grads["opacities"].abs().max() < 1e4
    assert not result.grads["color"][2000:].any()
    measured.outcome("pixels end early")


@pytest.mark.parametrize(
    "scales",
    [(0.0, 0.0, 0.0), (1e-12, 1e-12, 1e-12), (1.0, 0.0, 0.0), (0.5, 0.5, 1e-12), (30.0, 1e-6, 1e-6)],
    ids=["point", "speck", "line", "pancake", "needle"],
)
def test_r06_degenerate_scales(setting, measured, scales):
    scene = three(scales=torch.tensor([scales, (0.1, 0.1, 0.1), scales]))
    result = check_against_oracle(setting, measured, scene, bounds=("raster_needle", "raster_needle_grad"))
    assert 0.3 < result.alpha.max() < 1


def test_r07_gaussians_larger_than_the_screen(setting, measured):
    means = torch.tensor([0.0, 0.0, 3.0]).repeat(200, 1)
    scene = facing(means, scales=1e4, opacities=0.01, width=70, height=50)
    result = check_against_oracle(setting, measured, scene, bounds=("raster_many", "raster_many_grad"))
    assert result.alpha.min() > 0.8


def check_refused(setting, measured, name: str, value: float) -> None:
    """A value at the fourth row of two scenes: an error that names it, or a row that is left out and counted."""
    scene, report = setting.to(pack([three(), three()]).to(setting.dtype)), StabilityReport()
    error = raised(lambda: change(scene, name, 4, value).render(report=report), report)
    assert (error.tensor, error.row, error.camera) == (name, 4, 1)
    measured.outcome("NumericalError names tensor, row and camera")
    report = StabilityReport()
    check_left_out(
        setting, measured, change(three().to(setting.dtype), name, 1, value), [1], on_invalid="drop", report=report
    )
    assert {(f.tensor, f.action, f.row, f.camera) for f in report.findings} == {(name, "dropped", 1, 0)}


@pytest.mark.parametrize("scale", [2e15, 3e38])
def test_r07_a_scale_beyond_the_numbers(setting, measured, scale):
    check_refused(setting, measured, "scales", scale)


@pytest.mark.parametrize("setting", NAMES[1:], indirect=True)
def test_r07_an_image_beyond_the_numbers(setting, measured):
    """The scale can be used, its projection overflows in float32."""
    check_refused(setting, measured, "scales", 9e14)


PLACES = {
    "at the camera": (0.0, 0.0, 0.0),
    "on its plane": (0.3, -0.2, 0.0),
    "on the near plane": (0.0, 0.0, 0.01),
    "behind": (0.0, 0.1, -1.0),
}


@pytest.mark.parametrize("sh_terms", [0, 16])
@pytest.mark.parametrize("place", ["at the camera", "on its plane"])
def test_r08_centre_on_the_camera_plane(setting, measured, place, sh_terms):
    g = torch.Generator().manual_seed(0)
    color = 0.3 * torch.randn(3, sh_terms, 3, generator=g) if sh_terms else three().color
    check_left_out(setting, measured, change(three(color=color), "means", 1, torch.tensor(PLACES[place])), [1])


@pytest.mark.parametrize("place", ["on the near plane", "behind"])
def test_r09_behind_the_near_plane(setting, measured, place):
    check_left_out(setting, measured, change(three(), "means", 1, torch.tensor(PLACES[place])), [1])


@pytest.mark.parametrize("z", [0.0101, 0.05])
def test_r09_straddling_the_near_plane(setting, measured, z):
    """The centre is beyond the plane, half of the Gaussian is not."""
    scene = change(three(), "means", 1, torch.tensor([0.001, 0.002, z]))
    result = check_against_oracle(setting, measured, scene)
    assert result.grads["color"][1].abs().max() > 0


@pytest.mark.parametrize("jacobian", ["exact", "clamped"])
def test_r09_far_beside_the_image(setting, measured, jacobian):
    """A centre outside of the camera's field whose Gaussian reaches into it; clamped, the Jacobian is that at the
    margin."""
    scene = change(change(three(), "means", 1, torch.tensor([3.0, -2.0, 1.0])), "scales", 1, 1.5)
    result = check_against_oracle(setting, measured, scene, jacobian=jacobian)
    assert result.grads["color"][1].abs().max() > 0


def test_r10_camera_inside_an_object(setting, measured):
    g = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(300, 3, generator=g), dim=-1)
    sh = 0.3 * torch.randn(300, 4, 3, generator=g)
    scene = facing(means, scales=0.1, focal=8.0, color=sh)
    result = check_against_oracle(setting, measured, scene)
    again = render_beside_another(setting, measured, scene)
    measured.same_bits(again.color, result.color, "a second run")
    assert result.alpha.min() > 0.1


def test_r11_zero_quaternion_is_the_identity(setting, measured):
    zero, identity = (change(three(), "quats", 1, torch.tensor([w, 0, 0, 0])) for w in (0.0, 1.0))
    result, expected = (
        f(setting, measured, s) for f, s in ((render_beside_another, zero), (check_against_oracle, identity))
    )
    measured.same_bits(result.color, expected.color)
    assert not result.grads["quats"][1].any() and result.grads["scales"][1].any()
    measured.outcome("identity, no gradient")


@pytest.mark.parametrize("length", [2e-6, 1e18])
def test_r11_quaternions_of_any_length(setting, measured, length):
    """The gradient is that of a unit quaternion over the length."""
    scene = three().to(setting.dtype)
    unit = scene.quats / scene.quats.norm(dim=1, keepdim=True)
    expected = check_against_oracle(setting, measured, scene.replace(quats=unit))
    result = render_beside_another(setting, measured, scene.replace(quats=length * unit))
    measured.close(result.color, expected.color, f"raster_{setting.exact}")
    name = f"raster_grad_{setting.exact}"
    measured.close(result.grads["quats"] * length, expected.grads["quats"], name, "gradient of quats")


@pytest.mark.parametrize("value", [NAN, INF])
def test_r11_a_quaternion_that_is_no_number(setting, measured, value):
    check_refused(setting, measured, "quats", value)


def test_r12_equal_depths(setting, measured):
    """Drawn in the order of rows, whatever it is."""
    means = torch.tensor(CENTRE).repeat(3, 1)
    for order in itertools.permutations(range(3)):
        scene = facing(means, opacities=0.9, color=torch.eye(3)[list(order)])
        result = check_against_oracle(setting, measured, scene)
        assert result.color[0, 8, 8].argsort(descending=True).tolist() == list(order)
    measured.outcome("order of rows")


@pytest.mark.parametrize("width, height", [(1, 1), (1, 500), (500, 1), (17, 33), (15, 31)])
def test_r13_image_sizes(setting, measured, width, height):
    scene = three(width=width, height=height, focal=1.2 * max(width, height))
    of_gradient = "raster_pixel_grad" if width == height == 1 else "raster_many_grad"
    check_against_oracle(setting, measured, scene, bounds=("raster", of_gradient))


def test_r13_an_image_is_a_crop_of_a_padded_one(setting, measured):
    small = three(width=17, height=33, focal=20.0)
    K = small.Ks.clone()
    K[:, 0, 2] += 20
    K[:, 1, 2] += 11
    padded = render_beside_another(setting, measured, small.replace(width=48, height=64, Ks=K))
    expected = render_beside_another(setting, measured, small)
    measured.close(padded.color[:, 11:44, 20:37], expected.color, f"raster_{setting.exact}")


OUTSIDE = {  # centres beside a crop, and most beside the padded image; shapes of Gaussians that reach into both
    "a needle": ([[2.6, 1.9, 1.0]], [[2.5, 0.02, 0.02]], [[0.5628, 0.0, -0.8408, -0.3195]]),
    "a pancake": ([[-1.5, 0.3, 1.5]], [[1.2, 1.2, 0.01]], [[0.92, 0.0, -0.38, 0.1]]),
    "round": ([[0.5, -3.0, 2.0], [4.0, 0.0, 1.0]], [[1.5, 1.5, 1.5], [2.0, 2.0, 2.0]], [[1.0, 0, 0, 0]] * 2),
}


@pytest.mark.parametrize("shape", OUTSIDE)
def test_r13_a_crop_of_gaussians_centred_outside(setting, measured, shape):
    """Exactly linearised, they are drawn into a crop as into the image that it is of; clamped, they are not."""
    means, scales, quats = (torch.tensor(x) for x in OUTSIDE[shape])
    small = facing(means, scales=scales, quats=quats, opacities=0.8, width=20, height=20, focal=20.0)
    K = small.Ks.clone()
    K[:, :2, 2] += 40
    for jacobian in ("exact", "clamped"):
        wide = render_beside_another(setting, measured, small.replace(width=100, height=100, Ks=K), jacobian=jacobian)
        crop, expected = wide.alpha[:, 40:60, 40:60], render_beside_another(setting, measured, small, jacobian=jacobian)
        assert expected.alpha.max() > 0.05
        if jacobian == "exact":
            measured.close(crop, expected.alpha, f"raster_{setting.exact}")
        else:
            assert (crop - expected.alpha).abs().max() > 0.01


def test_r14_off_centre_and_skewed_cameras(setting, measured):
    K = torch.tensor([[[14.0, 3.0, 3.3], [0, 21.0, 12.6], [0, 0, 1]]])
    check_against_oracle(setting, measured, three(Ks=K))


@pytest.mark.parametrize("near_plane", [0.0, -1.0, NAN])
def test_r15_a_near_plane_of_zero(setting, measured, near_plane):
    with pytest.raises(ValueError, match="near_plane must be positive"):
        setting.to(three().to(setting.dtype)).render(near_plane=near_plane)
    measured.outcome("refused")


@pytest.mark.parametrize("near, far", [(0.0, 10.0), (2.0, 2.0), (NAN, 10.0), (1.0, INF)])
def test_r15_near_and_far_are_not_read(setting, measured, near, far):
    """The rasterizer needs neither; the encoder, which does, names the camera (see E34)."""
    scene = setting.to(three().to(setting.dtype))
    bounds = [torch.full_like(scene.cameras().near, bound) for bound in (near, far)]
    cameras = dataclasses.replace(scene.cameras(), near=bounds[0], far=bounds[1])
    arguments = scene.means, scene.quats, scene.scales, scene.opacities
    image = rasterize_gaussians(*arguments, cameras, colors=scene.color, background=scene.background)
    measured.same_bits(image.color, scene.render()[0])
