"""Edge cases and error messages of rasterize_gaussians."""

import itertools
from functools import partial

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.numerics.report import StabilityReport
from gsim3d.ops import rasterize_gaussians
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.ops.raster_scene import Scene, facing, gradients, random_scene


def assert_finite(scene, **options):
    out = scene.render(**options)
    grads = gradients(scene.render, scene, **options)
    for tensor in (*out, *grads):
        assert torch.isfinite(tensor).all()
    return out, dict(zip(Scene.NAMES, grads, strict=True))


# ---- 7 edges -------------------------------------------------------------------------------------------------------


def spoil_free_memory(device):
    """What the op takes next on a GPU is full of ones, so that nothing it forgets to set reads as 0."""
    if device.type == "cuda":
        torch.cuda.empty_cache()
        _ = [torch.full((2**20,), 255, dtype=torch.uint8, device=device) for _ in range(2)]


def test_empty_gaussians(device):
    spoil_free_memory(device)
    scene = facing(torch.zeros(0, 3), background=torch.tensor([[0.1, 0.2, 0.3]])).to(device)
    (color, alpha, depth, _), grads = assert_finite(scene)
    assert_same_bits(color, scene.background.expand(1, 16, 16, 3))
    assert alpha.abs().max() == 0 and depth.abs().max() == 0
    assert_close_relative_to_max(grads["background"], scene.cotangents()[0].sum((1, 2)), 1e-6)


def test_empty_images(device):
    scene = random_scene(n=5)
    none = {name: getattr(scene, name)[:0] for name in ("background", "viewmats", "Ks", "image_cloud")}
    out, grads = assert_finite(scene.replace(**none).to(device))
    assert out[0].shape == (0, 37, 45, 3)
    assert grads["means"].abs().max() == 0


def test_empty_clouds_and_unseen_clouds(device):
    scene = random_scene(n=12, clouds=4, images=3, sh_terms=0)
    scene = scene.replace(cu_rows=torch.tensor([0, 0, 5, 5, 12]), image_cloud=torch.tensor([1, 0, 1])).to(device)
    (color, alpha, _, _), grads = assert_finite(scene)
    assert alpha[1].abs().max() == 0 and alpha[0].max() > 0
    assert grads["means"][5:].abs().max() == 0 and grads["means"][:5].abs().max() > 0


@pytest.mark.parametrize("width, height", [(1, 1), (1, 4096), (4096, 1), (17, 33), (16, 16), (15, 31)])
def test_image_sizes(device, width, height):
    scene = random_scene(n=25, clouds=1, images=1, width=width, height=height, sh_terms=0, seed=4)
    K = scene.Ks.clone()
    K[:, 0, 0] = K[:, 1, 1] = 1.2 * max(width, height)
    K[:, 0, 1] = 0
    scene = scene.replace(Ks=K)
    for a, e in zip(scene.to(device).render(), scene.render_oracle(), strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")


def test_crop_equals_crop_of_padded(device):
    small = random_scene(n=40, clouds=1, images=1, width=17, height=33, sh_terms=4, seed=6)
    # Wide enough that no Gaussian's Jacobian is clamped in either image.
    small = small.replace(means=0.1 * small.means)
    K = small.Ks.clone()
    K[:, 0, 2] += 20
    K[:, 1, 2] += 11
    padded = small.replace(width=48, height=64, Ks=K)
    for a, e in zip(padded.to(device).render(), small.to(device).render(), strict=True):
        assert_close_relative_to_max(a[:, 11:44, 20:37], e, "raster_float64")


def test_non_contiguous_inputs(device):
    scene = random_scene(n=20, dtype=torch.float32).to(device)
    strided = [torch.stack([x, x], -1)[..., 0] for x in scene.inputs]
    assert not strided[0].is_contiguous()
    for a, e in zip(scene.render(*strided), scene.render(), strict=True):
        assert_same_bits(a, e)


def test_one_opaque_gaussian_writes_its_color(device):
    # Pixel (8, 8) lies on the mean: alpha is cut at 0.99, and one hundredth of the background shines through.
    scene = facing([1 / 16, 1 / 16, 2.0], opacities=1.0, background=torch.tensor([[0.5, 0.5, 0.5]])).to(device)
    color, alpha, depth, _ = scene.render()
    assert abs(alpha[0, 8, 8].item() - 0.99) < 1e-6
    assert abs(color[0, 8, 8, 0].item() - (0.99 + 0.005)) < 1e-6
    assert abs(depth[0, 8, 8].item() - 0.99 * 2) < 1e-5


@pytest.mark.parametrize("opacity", [0.0, 0.5 / 255, 0.999 / 255])
def test_faint_gaussians_are_left_out(device, opacity):
    out, grads = assert_finite(facing([0, 0, 2.0], opacities=opacity).to(device))
    assert out[1].abs().max() == 0
    assert all(grads[name].abs().max() == 0 for name in ("means", "quats", "scales", "opacities", "color"))


def test_faintest_gaussian_is_kept(device):
    # Its alpha is above 1/255 in one pixel only, so bounds that are too tight would lose it.
    scene = facing([1 / 16, 1 / 16, 2.0], scales=0.01, opacities=1.001 / 255).to(device)
    alpha = scene.render()[1]
    assert (alpha > 0).sum() == 1 and alpha[0, 8, 8] > 0


def test_visible_gaussians_are_all_drawn(device):
    # Slanted needles across many tiles, against the oracle that looks at every pixel.
    g = torch.Generator().manual_seed(0)
    n = 40
    scene = random_scene(n=n, clouds=1, images=1, width=80, height=70, sh_terms=0, n_features=0, seed=9)
    scales = torch.tensor([0.5, 0.004, 0.004], dtype=torch.float64) * (0.5 + torch.rand(n, 1, generator=g))
    scene = scene.replace(scales=scales, opacities=0.3 * scene.opacities)
    assert_close_relative_to_max(scene.to(device).render()[1], scene.render_oracle()[1], "raster_float64")


def test_thousands_of_coincident_opaque_gaussians(device):
    scene = facing(torch.tensor([[1 / 16, 1 / 16, 2.0]]).repeat(3000, 1), opacities=0.98).to(device)
    (color, alpha, _, _), grads = assert_finite(scene)
    # After two of them the third would bring the centre's transmittance from 4e-4 below 1e-4: equal depths, order of
    # rows.
    assert abs(alpha[0, 8, 8].item() - (1 - 0.02**2)) < 1e-6
    assert grads["color"][:2].abs().min() > 0
    assert grads["opacities"].abs().max() < 1e4
    behind_all = grads["color"][2000:]
    assert behind_all.abs().max() == 0


@pytest.mark.parametrize(
    "scales",
    [(0.0, 0.0, 0.0), (1e-12, 1e-12, 1e-12), (1.0, 0.0, 0.0), (1.0, 1.0, 1e-12), (30.0, 1e-6, 1e-6)],
)
def test_degenerate_shapes(device, scales):
    means = torch.tensor([[0.0, 0.1, 2.0], [0.2, -0.1, 2.5]])
    quats = torch.tensor([[0.9, 0.1, 0.3, 0.2], [0.2, 0.5, -0.4, 0.3]])
    scene = facing(means, scales=torch.tensor(scales), quats=quats)
    (_, alpha, _, _), _ = assert_finite(scene.to(device))
    assert alpha.max() > 0.3
    assert_close_relative_to_max(alpha, scene.to(torch.float64).render_oracle()[1], "raster_needle_float32")


def test_gaussians_larger_than_the_screen(device):
    means = torch.tensor([0.0, 0.0, 3.0]).repeat(200, 1)
    scene = facing(means, scales=1e4, opacities=0.01, width=70, height=50).to(device)
    (_, alpha, _, _), _ = assert_finite(scene)
    assert_close_relative_to_max(alpha, torch.full_like(alpha, 1 - 0.99**200), 1e-4)


def test_near_plane(device):
    # At the camera's centre, on the plane, behind, just beyond, and straddling it: only what lies beyond is drawn.
    z = torch.tensor([0.0, 0.01, -1.0, 0.0101, 0.02])
    means = torch.stack([torch.zeros(5), torch.zeros(5), z], -1)
    scene = facing(means, scales=0.001).to(device)
    _, grads = assert_finite(scene)
    assert grads["color"][:3].abs().max() == 0
    assert (grads["color"][3:].abs().amax(1) > 0).all()
    closer = facing(means, scales=0.001).to(device).render(near_plane=0.015)[2]
    only_last = facing(means[4:], scales=0.001).to(device).render()[2]
    assert_same_bits(closer, only_last)


def test_camera_inside_an_object(device):
    g = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(500, 3, generator=g), dim=-1)
    sh = 0.3 * torch.randn(500, 4, 3, generator=g)
    scene = facing(means, scales=0.1, focal=8.0, color=sh).to(device)
    (_, alpha, _, _), _ = assert_finite(scene)
    assert alpha.min() > 0.3


def test_zero_quaternion_is_the_identity(device):
    scene = facing([0.1, 0, 2.0], scales=(0.3, 0.1, 0.2)).to(device)
    zero = scene.replace(quats=torch.zeros_like(scene.quats))
    for a, e in zip(zero.render(), scene.render(), strict=True):
        assert_same_bits(a, e)
    _, grads = assert_finite(zero)
    assert grads["quats"].abs().max() == 0


@pytest.mark.parametrize("length", [2e-6, 1e-3, 1e18])
def test_quaternions_of_any_length(device, length):
    scene = facing([0.1, 0, 2.0], scales=(0.3, 0.1, 0.2), quats=torch.tensor([[0.8, 0.2, -0.4, 0.4]]))
    stretched = scene.replace(quats=length * scene.quats).to(device)
    assert_close_relative_to_max(stretched.render()[1], scene.render()[1], 1e-5)
    _, grads = assert_finite(stretched)
    assert_close_relative_to_max(grads["quats"] * length, gradients(scene.render, scene)[1], 1e-4)


def test_equal_depths_are_drawn_in_order_of_rows(device):
    colors = torch.eye(3)
    means = torch.tensor([1 / 16, 1 / 16, 2.0]).repeat(3, 1)
    for order in itertools.permutations(range(3)):
        scene = facing(means, opacities=0.9, color=colors[list(order)]).to(device)
        pixel = scene.render()[0][0, 8, 8]
        assert pixel.argsort(descending=True).tolist() == list(order)


def test_depth_order_beats_order_of_rows(device):
    means = torch.tensor([[1 / 16, 1 / 16, 2.0], [1 / 32, 1 / 32, 1.0]])
    pixel = facing(means, opacities=0.9, color=torch.eye(3)[:2]).to(device).render()[0][0, 8, 8]
    assert pixel[1] > 0.8 > 0.2 > pixel[0]


def test_gaussian_far_outside_the_view(device):
    # Its Jacobian is taken at the edge of the clamped field, so its covariance stays bounded.
    scene = facing([[50.0, 0, 0.5], [0, 0, 2.0]], scales=0.05)
    _, grads = assert_finite(scene.to(device))
    assert_close_relative_to_max(scene.to(device).render()[1], scene.to(torch.float64).render_oracle()[1], 1e-5)


NAN, INF = float("nan"), float("inf")
POISON = (0.0, -0.0, 1e-45, 1e-38, 1e-20, 1e-6, 1.0, 1e6, 1e20, 3e38, -1e-20, -1e20, INF, -INF, NAN)


def poisoned(name, device):
    """(what was changed, scene) with every number of POISON in three places of an input."""
    scene = random_scene(n=6, clouds=1, images=1, width=20, height=18, sh_terms=4, dtype=torch.float32).to(device)
    for value, place in itertools.product(POISON, (0, 1, -1)):
        tensor = getattr(scene, name).clone()
        tensor.view(-1)[place] = value
        yield value, f"{name} = {value} at {place}", scene.replace(**{name: tensor})


def assert_no_silent_nan(value, what, scene):
    out = scene.render()
    if abs(value) <= 1e6:
        assert all(torch.isfinite(x).all() for x in (*out, *gradients(scene.render, scene))), what
    else:
        assert not any(torch.isnan(x).any() for x in out), what


@pytest.mark.parametrize("name", Scene.NAMES)
def test_poison_is_rendered_or_refused(name):
    """Any number in any place: a finite result with finite gradients, or a ValueError; never a silent NaN."""
    refused = 0
    for value, what, scene in poisoned(name, torch.device("cpu")):
        try:
            assert_no_silent_nan(value, what, scene)
        except ValueError as error:
            refused += 1
            assert str(error).startswith("rasterize_gaussians: ")
    assert refused >= 6  # inf, -inf and NaN in the first two places at least


@pytest.mark.parametrize("name", Scene.NAMES)
def test_poison_is_left_out_on_cuda(devices, name):
    for value, what, scene in poisoned(name, devices[1]):
        assert_no_silent_nan(value, what, scene)


BAD_ROWS = [
    ("means", NAN, "means: not finite or beyond 1e15"),
    ("quats", NAN, "quats: not finite"),
    ("scales", INF, "scales: negative, not finite or beyond 1e15"),
    ("scales", -1.0, "scales: negative, not finite or beyond 1e15"),
    ("scales", 1e12, "scales: too large, the projection overflows"),
    ("opacities", 1.5, r"opacities: outside \[0, 1\]"),
    ("opacities", NAN, r"opacities: outside \[0, 1\]"),
    ("color", NAN, "colors: not finite or beyond 1e15"),
    ("features", NAN, "features: not finite or beyond 1e15"),
]


def four_rows():
    return facing([[0, 0, 2.0]] * 4, features=torch.ones(4, 2))


def change(scene, name, index, value):
    tensor = getattr(scene, name).clone()
    tensor[index] = value
    return scene.replace(**{name: tensor})


@pytest.mark.parametrize("name, value, message", BAD_ROWS)
def test_bad_rows_are_left_out_and_counted(device, name, value, message):
    scene = change(four_rows(), name, 2, value).to(device)
    kept = torch.tensor([0, 1, 3])
    rows = {field: getattr(four_rows(), field)[kept] for field in Scene.NAMES[:6]}
    rest = four_rows().replace(**rows, cu_rows=torch.tensor([0, 3])).to(device)
    report = StabilityReport()
    for a, e in zip(scene.render(on_invalid="drop", report=report), rest.render(), strict=True):
        assert_same_bits(a, e)
    render = partial(scene.render, on_invalid="drop")
    for field, a, e in zip(Scene.NAMES, gradients(render, scene), gradients(rest.render, rest), strict=True):
        if field in rows:
            assert a[2].abs().max() == 0, field
            a = a[kept.to(a.device)]
        assert_close_relative_to_max(a, e, 1e-6, field)  # viewmats: a sum over rows, of which one is gone
    (finding,) = report.findings
    assert (f"{finding.tensor}: {finding.what}", finding.count, finding.row) == (message.replace("\\", ""), 1, 2)
    assert (finding.camera, finding.action) == (0, "dropped")
    report.check()  # nothing to raise


@pytest.mark.parametrize("name, value, message", BAD_ROWS)
def test_bad_rows_are_bounded(device, name, value, message):
    scene, report = change(four_rows(), name, 2, value).to(device), StabilityReport()
    render = partial(scene.render, on_invalid="clamp")
    for x in (*render(report=report), *gradients(render, scene)):
        assert torch.isfinite(x).all()
    assert {finding.tensor for finding in report.findings} == {message.split(":")[0]}


def test_gpu_raises_where_the_report_is_read(devices):
    report = StabilityReport()
    change(four_rows(), "means", 2, NAN).to(devices[1]).render(report=report)
    with pytest.raises(
        NumericalError, match=r"rasterize_gaussians: means: not finite or beyond 1e15 at row 2 \(camera 0\)"
    ):
        report.check()


def test_rows_are_counted_in_every_image(device):
    """Row 1 is in two images, row 3 in another."""
    scene = facing([[0, 0, 2.0]] * 4)
    cameras = {name: getattr(scene, name) for name in ("viewmats", "Ks", "background")}
    cameras = {name: value.repeat(3, *[1] * (value.dim() - 1)) for name, value in cameras.items()}
    scene = scene.replace(cu_rows=torch.tensor([0, 3, 4]), image_cloud=torch.tensor([0, 1, 0]), **cameras)
    scene = change(change(scene, "opacities", 1, 2.0), "scales", 3, 1e30).to(device)
    report = StabilityReport()
    scene.render(on_invalid="drop", report=report)
    assert [(f.camera, f.tensor, f.row, f.count) for f in report.findings] == [
        (0, "opacities", 1, 1),
        (1, "scales", 3, 1),
        (2, "opacities", 1, 1),
    ]


BAD_DATA = [
    (lambda s: s.replace(image_cloud=torch.tensor([1])), r"image_cloud must be in \[0, Q\) with Q=1; got 1 for"),
    (lambda s: s.replace(image_cloud=torch.tensor([-1])), r"image_cloud must be in \[0, Q\) with Q=1; got -1"),
    (lambda s: s.replace(cu_rows=torch.tensor([0, 3])), "cu_rows must run from 0 to N=4; got 0 .. 3"),
    (lambda s: s.replace(cu_rows=torch.tensor([0, 5, 4])), "cu_rows must not descend; got 5 then 4 at 1"),
    (lambda s: change(s, "Ks", (0, 0, 0), 0.0), "focal lengths in Ks must be positive; got 0 and 16 for image 0"),
    (lambda s: change(s, "Ks", (0, 1, 0), 1.0), r"Ks must be \[\[fx, skew, cx\]"),
    (lambda s: change(s, "Ks", (0, 0, 2), NAN), "Ks must be finite and at most 1e15; got nan for image 0"),
    (lambda s: change(s, "viewmats", (0, 1, 1), NAN), "viewmats must be finite and at most 1e15; got nan for image 0"),
    (lambda s: change(s, "background", (0, 1), NAN), "background must be finite and at most 1e15; got nan for image 0"),
]


@pytest.mark.parametrize("broken", [broken for broken, _ in BAD_DATA[:-1]])
def test_images_of_bad_cameras_and_clouds_are_empty_on_cuda(devices, broken):
    scene = broken(four_rows().replace(background=torch.tensor([[0.1, 0.2, 0.3]]))).to(devices[1])
    color, alpha, _, _ = scene.render()
    assert alpha.abs().max() == 0
    assert_same_bits(color, scene.background.expand(1, 16, 16, 3))
    for name, grad in zip(Scene.NAMES, gradients(scene.render, scene), strict=True):
        assert torch.isfinite(grad).all() and (name == "background" or grad.abs().max() == 0), name


# ---- 8 error messages ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name, value, message", BAD_ROWS)
def test_bad_rows_are_named(name, value, message):
    with pytest.raises(NumericalError, match="rasterize_gaussians: " + message + r" at row 2 \(camera 0\)") as caught:
        change(four_rows(), name, 2, value).render()
    assert (caught.value.tensor, caught.value.row, caught.value.camera) == (message.split(":")[0], 2, 0)


@pytest.mark.parametrize("name, place", [("viewmats", (0, 3, 0)), ("Ks", (0, 2, 1))])
def test_transposed_matrices_are_named_on_a_cpu(name, place):
    with pytest.raises(NumericalError, match=rf"rasterize_gaussians: {name}\[.*\] \(0 unless transposed\) .* got 3"):
        change(four_rows(), name, place, 3.0).render()


@pytest.mark.parametrize("broken, message", BAD_DATA)
def test_bad_data_is_named(broken, message):
    with pytest.raises(ValueError, match="rasterize_gaussians: " + message):
        broken(four_rows()).render()


@pytest.mark.parametrize(
    "broken, message",
    [
        (lambda s: s.replace(means=s.means[:, :2]), r"means must be \[N, 3\]"),
        (lambda s: s.replace(quats=s.quats[:3]), r"quats must be \[N, 4\] = \[4, 4\]; got \[3, 4\]"),
        (lambda s: s.replace(scales=s.scales[:, :1]), r"scales must be \[N, 3\]"),
        (lambda s: s.replace(opacities=s.opacities[:, None]), r"opacities must be \[N\]"),
        (lambda s: s.replace(color=s.color[:2]), r"colors must be \[N, 3\]"),
        (lambda s: s.replace(color=torch.zeros(4, 5, 3)), "sh must have 1, 4, 9 or 16 coefficients .*; got 5"),
        (lambda s: s.replace(color=torch.zeros(4, 0, 3)), "sh must have 1, 4, 9 or 16 coefficients .*; got 0"),
        (lambda s: s.replace(features=torch.zeros(3, 1)), r"features must be \[N, F\]"),
        (lambda s: s.replace(background=torch.zeros(2, 3)), r"background must be \[I, 3\]"),
        (lambda s: s.replace(viewmats=s.viewmats[:, :3]), r"viewmats must be \[I, 4, 4\]"),
        (lambda s: s.replace(Ks=s.Ks[:, :2]), r"Ks must be \[I, 3, 3\]"),
        (lambda s: s.replace(quats=s.quats.double()), "quats must be float32; got float64"),
        (lambda s: s.replace(image_cloud=s.image_cloud.int()), "image_cloud must be int64; got int32"),
        (lambda s: s.replace(width=0), r"width and height must be in \[1, 65535\]; got 0 and 16"),
        (lambda s: s.replace(height=-2), "width and height must be positive; got 16 and -2"),
    ],
)
def test_messages(device, broken, message):
    scene = broken(facing([[0, 0, 2.0]] * 4)).to(device)
    with pytest.raises(ValueError, match="rasterize_gaussians: " + message):
        scene.render()


@pytest.mark.parametrize("near_plane", [0.0, -1.0, NAN])
def test_near_plane_must_be_positive(device, near_plane):
    with pytest.raises(ValueError, match="near_plane must be positive"):
        facing([0, 0, 2.0]).to(device).render(near_plane=near_plane)


def test_options_are_checked(device):
    scene = facing([0, 0, 2.0]).to(device)
    with pytest.raises(ValueError, match="cutoff must be one of exact, tile3sigma, smooth; got 'soft'"):
        scene.render(cutoff="soft")
    with pytest.raises(ValueError, match="jacobian must be one of exact, clamped; got 'free'"):
        scene.render(jacobian="free")
    with pytest.raises(ValueError, match="give one of sh and colors"):
        rasterize_gaussians(*scene.inputs[:4], scene.cameras())
    with pytest.raises(ValueError, match=r"sh must be \[N, K, 3\]; got \[1, 3\]"):
        rasterize_gaussians(*scene.inputs[:4], scene.cameras(), sh=scene.color)
    with pytest.raises(ValueError, match=r"colors must be \[N, 3\]; got \[1, 1, 3\]"):
        rasterize_gaussians(*scene.inputs[:4], scene.cameras(), colors=scene.color[:, None])
