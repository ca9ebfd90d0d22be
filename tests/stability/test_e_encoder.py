"""Hard cases of the encoder and of data."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
import torch

from gsim3d import ops
from gsim3d.data import Scene
from gsim3d.errors import InputError, NumericalError
from gsim3d.io.ply import read_ply, write_ply
from gsim3d.state import Gaussians
from tests.asserts import gradients
from tests.data.made_scenes import WRITERS, edit_json, make_scene
from tests.nn.multiview_encoder.scenes import SIZE, make_encoder
from tests.ops.test_plane_sweep import make as make_sweep
from tests.oracle import plane_sweep as sweep_oracle
from tests.stability.encodings import check_encoding, encode, ordinary, with_cameras

NAN, INF = float("nan"), float("inf")
TURNED = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))  # half a turn about the camera's y


def first_cloud(frames, viewmats):
    """``frames`` whose first two cameras are others."""
    return with_cameras(frames, viewmats=torch.cat([viewmats, frames.cameras.viewmats[2:]]))


def correlation(setting, viewmats, depths=8):
    """Cost volume of two views with random features, and of the second one's."""
    g = torch.Generator().manual_seed(0)
    features = torch.randn(1, 5, SIZE, SIZE, generator=g).expand(2, -1, -1, -1)
    Ks = ordinary().cameras.Ks[:2]
    sources, cu = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    inverse_depths = torch.linspace(1 / 6, 1 / 1.5, depths).expand(2, depths)
    geometry = ops.sweep_geometry(Ks, viewmats, sources, cu)
    arguments = [features, *geometry, inverse_depths, sources, cu]
    return features, ops.plane_sweep(*(setting.to(t) for t in arguments))


@pytest.mark.parametrize("same_image", [True, False])
def test_e34_duplicated_cameras(setting, measured, same_image):
    frames = ordinary()
    if same_image:
        images = frames.images.clone()
        images[1] = images[0]
        frames = dataclasses.replace(frames, images=images)
    check_encoding(setting, measured, first_cloud(frames, frames.cameras.viewmats[:1].expand(2, 4, 4)))


def test_e34_without_a_baseline_every_depth_is_as_likely(setting, measured):
    features, cost = correlation(setting, ordinary().cameras.viewmats[:1].expand(2, 4, 4))
    expected = features.double().square().sum(1, keepdim=True) / 5**0.5
    measured.close(cost, expected.expand(2, 8, SIZE, SIZE), f"plane_sweep_{setting.exact}", "cost")
    measured.outcome("equal at all depths")


@pytest.mark.parametrize("distance", [0.5, 100.0])
def test_e35_parallel_rays(setting, measured, distance):
    """Two cameras side by side that look the same way: with and without overlap."""
    frames = ordinary()
    viewmats = frames.cameras.viewmats[:1].repeat(2, 1, 1)
    viewmats[1, 0, 3] += distance
    check_encoding(setting, measured, first_cloud(frames, viewmats))


def test_e35_no_overlap_costs_nothing(setting, measured):
    viewmats = ordinary().cameras.viewmats[:1].repeat(2, 1, 1)
    viewmats[1, 0, 3] += 100.0
    _, cost = correlation(setting, viewmats)
    assert not cost.any()
    measured.outcome("cost 0")


def test_e36_cameras_that_look_away(setting, measured):
    frames = ordinary()
    viewmats = frames.cameras.viewmats[:1].repeat(2, 1, 1)
    viewmats[1] = TURNED @ viewmats[1]
    check_encoding(setting, measured, first_cloud(frames, viewmats))
    _, cost = correlation(setting, viewmats)
    assert not cost.any()
    measured.outcome("cost 0")


def test_e36_points_behind_another_view(setting, measured):
    """The sources stand in front of the scene, beside it and behind it."""
    arguments = [t.float() if t.is_floating_point() else t for t in make_sweep()]
    translations = arguments[2].clone()
    translations[:, 2] -= torch.linspace(0, 6, len(translations))
    arguments[2] = translations
    rest = [setting.to(t) for t in arguments[1:]]
    cotangent = torch.randn(4, 11, 7, 9, generator=torch.Generator().manual_seed(1))
    actual = gradients(lambda f: ops.plane_sweep(f, *rest), [setting.to(arguments[0])], cotangent)
    exact = [t.double() if t.is_floating_point() else t for t in arguments]
    expected = gradients(lambda f: sweep_oracle.plane_sweep(f, *exact[1:]), [exact[0]], cotangent)
    measured.finite(*actual)
    for name, a, e in zip(("cost", "gradient"), actual, expected, strict=True):
        measured.close(a, e, f"plane_sweep_behind_{setting.exact}", name)


@pytest.mark.parametrize("logit", [-1000.0, 1000.0])
def test_e37_opacities_of_exactly_zero_and_one(setting, measured, logit):
    """No power of a probability stands between depth and opacity; a saturated sigmoid has gradient 0."""

    def saturate(encoder):
        encoder.depth.to_disparity[2].bias.data[1] = logit

    result = check_encoding(setting, measured, ordinary(), prepare=saturate)
    assert result.fields["opacities"].unique().tolist() == [float(logit > 0)]


def test_e37_probabilities_of_exactly_zero(setting, measured):
    """A depth that is certain: all other probabilities underflow."""

    def be_sure(encoder):
        last = encoder.depth.cost_volume.head[2]
        last.weight.data.zero_()
        last.bias.data.copy_(torch.tensor([0.0, 0.0, 5e3, 0.0, 0.0, 0.0]))

    check_encoding(setting, measured, ordinary(), prepare=be_sure)


@pytest.mark.parametrize("correction", [-1e4, 1e4])
def test_e37_depths_stay_between_their_bounds(setting, measured, correction):
    """Whatever is added to the disparity."""

    def overshoot(encoder):
        encoder.depth.to_disparity[2].bias.data[0] = correction

    result = check_encoding(setting, measured, ordinary(), prepare=overshoot)
    cameras = ordinary().cameras
    points = result.fields["means"].double().cpu().reshape(len(cameras), -1, 3)
    depth = (points @ cameras.viewmats[:, 2, :3, None])[..., 0] + cameras.viewmats[:, 2, 3, None]
    bound = cameras.far if correction < 0 else cameras.near
    measured.close(depth, bound.double()[:, None].expand_as(depth), f"geometry_{setting.exact}", "depth")


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_e38_constant_images(setting, measured, value):
    images = ordinary().images.clone()
    images[:2] = value
    check_encoding(setting, measured, ordinary(images=images), bound="encoder_constant")


def test_e38_saturated_images(setting, measured):
    """Black and white only, half and half."""
    images = ordinary().images.clone()
    images[:2] = (images[:2] > 0.5).float()
    check_encoding(setting, measured, ordinary(images=images))


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    WRITERS["genesis"](folder, make_scene())
    return folder


def converted(folder, target, pattern, convert):
    """A copy of a scene folder with its images that match ``pattern`` converted."""
    shutil.copytree(folder, target)
    files = sorted(target.rglob(pattern))
    assert files
    for file in files:
        assert cv2.imwrite(str(file), convert(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))
    return target


def pixels_of(folder):
    scene = Scene.open(folder)
    cams, steps = range(scene.n_cams), range(scene.n_steps)
    return scene.images(cams, steps), scene.segmentation(cams, steps)


def test_e39_an_alpha_channel_changes_nothing(scene_folder, tmp_path, measured):
    rgba = converted(scene_folder, tmp_path / "rgba", "rgb*.png", lambda x: cv2.cvtColor(x, cv2.COLOR_BGR2BGRA))
    for a, e in zip(pixels_of(rgba), pixels_of(scene_folder), strict=True):
        assert torch.equal(a, e)
    measured.outcome("RGBA: same pixels")


def test_e39_one_channel_is_grey(scene_folder, tmp_path, measured):
    one = converted(scene_folder, tmp_path / "one", "rgb*.png", lambda x: x[..., 1])
    three = converted(scene_folder, tmp_path / "three", "rgb*.png", lambda x: np.repeat(x[..., 1:2], 3, 2))
    for a, e in zip(pixels_of(one), pixels_of(three), strict=True):
        assert torch.equal(a, e)
    measured.outcome("grey: same pixels")


def test_e39_sixteen_bits_are_rounded_to_eight(scene_folder, tmp_path, measured):
    deep = converted(scene_folder, tmp_path / "deep", "rgb_0002.png", lambda x: x.astype(np.uint16) * 257)
    for a, e in zip(pixels_of(deep), pixels_of(scene_folder), strict=True):
        assert torch.equal(a, e)
    measured.outcome("16 bits: same pixels")


def test_e39_values_keep_their_meaning_without_a_zero(scene_folder, tmp_path, measured):
    """Images without black and labels without background: nothing is stretched or shifted."""
    bright = converted(scene_folder, tmp_path / "bright", "rgb*.png", lambda x: np.maximum(x, 7))
    images, labels = pixels_of(scene_folder)
    assert torch.equal(pixels_of(bright)[0], images.clamp(min=7))
    filled = converted(scene_folder, tmp_path / "filled", "seg*.png", lambda x: np.maximum(x, 1))
    assert torch.equal(pixels_of(filled)[1], labels.clamp(min=1))
    measured.outcome("no zero: same values")


FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CONVENTIONS = {
    "OpenGL axes": ("extrinsics", lambda m: FLIP @ m, "OpenGL"),
    "camera-to-world": ("extrinsics", np.linalg.inv, "camera-to-world"),
    "mirrored": ("extrinsics", lambda m: np.diag([-1.0, 1, 1, 1]) @ m, "left-handed"),
    "scaled": ("extrinsics", lambda m: np.diag([2.0, 2, 2, 1]) @ m, "not orthonormal"),
    "divided by the image size": ("intrinsics", lambda K: np.diag([1 / 48, 1 / 32, 1]) @ K, "in pixels"),
    "degenerate": ("intrinsics", lambda K: np.diag([0.0, 1, 1]) @ K, "must be positive"),
}


@pytest.mark.parametrize("what", CONVENTIONS)
def test_e40_wrong_conventions(scene_folder, tmp_path, measured, what):
    """Every camera stored so; the message names file and cause."""
    key, change, expected = CONVENTIONS[what]
    folder = shutil.copytree(scene_folder, tmp_path / "scene")

    def edit(content):
        for name in [name for name in content if name.startswith("cam_")]:
            content[name][key] = np.apply_over_axes(lambda a, _: a, change(np.array(content[name][key])), 0).tolist()
        content.pop("bounds", None)

    edit_json(folder / "metadata.json", edit)
    with pytest.raises(InputError, match=f"metadata.json.*{expected}"):
        Scene.open(folder)
    measured.outcome("refused, cause named")


def test_e41_calibration_in_float64(setting, measured):
    """Cameras and origin 10 km from zero: latents and opacities do not notice, places are rounded once."""
    frames, shift = ordinary(), torch.tensor([1e4, -1e4, 5e3], dtype=torch.float64)
    viewmats = frames.cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ shift
    moved = dataclasses.replace(with_cameras(frames, viewmats=viewmats), origin=frames.origin + shift)
    here, there = (encode(setting, f) for f in (frames, moved))
    measured.finite(*there.fields.values(), *there.grads.values())
    for name in ("opacities", "dynamic_latents", "static_latents"):
        measured.close(there.fields[name], here.fields[name], f"encoder_moved_{setting.precision}", name)
    measured.close(
        there.fields["means"], here.fields["means"].double().cpu() + shift, f"geometry_{setting.exact}", "means"
    )


BAD_CAMERAS = {
    "near of 0": ("near", 0.0, "cameras.near must be positive"),
    "near behind": ("near", -1.0, "cameras.near must be positive"),
    "near no number": ("near", NAN, "cameras.near must be positive"),
    "far at near": ("far", 1.5, "cameras.far must be finite and larger than near"),
    "far infinite": ("far", INF, "cameras.far must be finite and larger than near"),
}


@pytest.mark.parametrize("what", BAD_CAMERAS)
def test_r15_near_and_far_of_the_encoder(setting, measured, what):
    name, value, message = BAD_CAMERAS[what]
    frames = ordinary()
    bound = getattr(frames.cameras, name).clone()
    bound[3] = value
    with pytest.raises(NumericalError, match=f"{message}; image 3 .scene 0, step 1. is not"):
        setting.to(make_encoder())(setting.to(with_cameras(frames, **{name: bound})))
    measured.outcome("NumericalError names the camera")


@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("what", ["images", "viewmats", "Ks"])
def test_e51_images_and_cameras_that_are_no_numbers(setting, measured, what, value):
    frames = ordinary()
    owner = frames if what == "images" else frames.cameras
    tensor = getattr(owner, what).clone()
    tensor[2].view(-1)[1] = value
    frames = dataclasses.replace(frames, images=tensor) if what == "images" else with_cameras(frames, **{what: tensor})
    with pytest.raises(NumericalError, match=f"{what} must be finite; image 2 .scene 0, step 1. is not"):
        setting.to(make_encoder())(setting.to(frames))
    measured.outcome("NumericalError names the image")


def test_e52_ply_of_extreme_gaussians(tmp_path, measured):
    """Opacities 0 and 1, scales of 0, a rotation without a direction: written as numbers, read as what they were."""
    quats = torch.tensor([[0.0, 0, 0, 0], [1, 0, 0, 0], [0, 3, 0, 0]])
    scales, opacities = torch.tensor([[0.0, 1e-9, 1e3]]).repeat(3, 1), torch.tensor([0.0, 1.0, 0.5])
    means, sh = torch.tensor([[0.0, 1e6, -1e-30]]).repeat(3, 1), torch.full((3, 4, 3), -1e4)
    write_ply(tmp_path / "scene.ply", Gaussians(means, quats, scales, opacities, sh, torch.tensor([0, 3])))
    body = (tmp_path / "scene.ply").read_bytes().partition(b"end_header\n")[2]
    assert np.isfinite(np.frombuffer(body, "<f4")).all()
    read = read_ply(tmp_path / "scene.ply")
    measured.finite(read.means, read.quats, read.scales, read.opacities, read.sh)
    measured.close(read.opacities, opacities, 1e-4, "opacities")
    measured.close(read.scales, scales, 1e-5, "scales")
    assert torch.equal((read.means + read.world_offset).float(), means) and torch.equal(read.sh, sh)
    assert read.quats.tolist() == [[1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]]
