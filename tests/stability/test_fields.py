"""Every field of Frames, Cameras and Particles is looked at: dtype, shape, range, finite, index in range."""

import dataclasses
import math

import pytest
import torch

from gsim3d.errors import InputError, NumericalError
from gsim3d.numerics.report import StabilityReport
from tests.test_simulator import make_frames, make_simulator

NAN, INF = float("nan"), float("inf")
POLICIES = ("raise", "drop", "clamp")
SCENES = (1, 2)


@pytest.fixture(scope="module")
def simulator(one_thread):
    return make_simulator()


@pytest.fixture(scope="module")
def state(simulator):
    with torch.no_grad():
        return simulator.encode(make_frames(SCENES))


def with_entry(tensor, index, value, dtype=None):
    changed = tensor.clone() if dtype is None else tensor.to(dtype)
    changed[index] = value
    return changed


def changed_frames(field, change):
    """Frames with one field replaced by ``change`` of it."""
    frames = make_frames(SCENES)
    if not field.startswith("cameras."):
        return dataclasses.replace(frames, **{field: change(getattr(frames, field))})
    name = field.removeprefix("cameras.")
    cameras = dataclasses.replace(frames.cameras, **{name: change(getattr(frames.cameras, name))})
    return dataclasses.replace(frames, cameras=cameras)


def entry(index, value, dtype=None):
    return lambda tensor: with_entry(tensor, index, value, dtype)


FRAMES = [
    ("images", lambda x: x.half(), InputError, "images must be torch.float32 .* got torch.float16"),
    ("images", lambda x: x.double(), InputError, "images must be torch.float32 .* got torch.float64"),
    ("images", lambda x: (x * 255).byte(), InputError, "got torch.uint8; divide by the largest value"),
    ("images", lambda x: x.numpy(), InputError, "images must be .* got ndarray"),
    ("masks", lambda x: x.float(), InputError, "masks must be bool"),
    ("dynamic", lambda x: torch.ones(2, 2, dtype=torch.bool), InputError, "dynamic must be bool"),
    ("valid", lambda x: torch.ones(1, 4, 4, dtype=torch.bool), InputError, "valid must be bool"),
    ("origin", entry((1, 0), 1e39), NumericalError, "origin must be finite .* scene 1"),
    ("origin", entry((0, 2), NAN), NumericalError, "origin must be finite .* scene 0"),
    ("origin", entry((0, 2), -1e10), NumericalError, "origin .* at most 1e.09 m"),
    ("origin", lambda x: x[:, :2], InputError, "origin must be"),
    ("origin", lambda x: x.long(), InputError, "origin must be"),
    ("cloud_scene", entry(0, 7), InputError, r"cloud_scene must be in \[0, 2\)"),
    ("cloud_scene", entry(2, -1), InputError, r"cloud_scene must be in \[0, 2\)"),
    ("cloud_scene", lambda x: x.int(), InputError, "cloud_scene must be .* int64"),
    ("cloud_step", entry(1, -3), InputError, "cloud_step must not be negative"),
    ("cloud_step", lambda x: x.float(), InputError, "cloud_step must be .* int64"),
    ("cloud_step", lambda x: x[:1], InputError, "cloud_step must be"),
    ("cameras.image_cloud", entry(0, 99), InputError, "image_cloud must be in"),
    ("cameras.image_cloud", entry(0, -1), InputError, "image_cloud must be in"),
    ("cameras.near", entry(1, 1e-30), NumericalError, "near must be from 1e-06"),
    ("cameras.far", entry(1, 1e30), NumericalError, "far must be from 1e-06"),
    ("cameras.near", lambda x: x.long(), InputError, "near must be"),
    ("cameras.Ks", entry((1, 0, 0), 0.0), NumericalError, "cameras.Ks must be"),
    ("cameras.Ks", entry((1, 1, 1), -20.0), NumericalError, "cameras.Ks must be"),
    ("cameras.Ks", entry((1, 0, 2), 1e20), NumericalError, "cameras.Ks must be"),
    ("cameras.Ks", entry((1, 2, 2), 0.5), NumericalError, "cameras.Ks must be"),
    ("cameras.Ks", lambda x: x.half(), InputError, "cameras.Ks must be"),
    ("cameras.viewmats", entry((1, 0, 3), 1e12), NumericalError, "viewmats must be at most"),
    ("cameras.viewmats", entry((1, slice(0, 3), slice(0, 3)), 0.0), NumericalError, "viewmats must be a rotation"),
    ("cameras.viewmats", lambda x: 2 * x, NumericalError, "viewmats must be a rotation"),
    ("cameras.viewmats", lambda x: x * torch.tensor([[-1.0], [1], [1], [1]]), NumericalError, "right-handed"),
    ("cameras.viewmats", lambda x: x[:, [1, 0, 2, 3]], NumericalError, "right-handed"),
    ("cameras.viewmats", entry((1, 3, 0), 1.0), NumericalError, "viewmats must be a rotation"),
]


@pytest.mark.parametrize("on_invalid", POLICIES)
@pytest.mark.parametrize(("field", "change", "error", "message"), FRAMES)
def test_frames_are_refused_by_name(field, change, error, message, on_invalid, simulator):
    frames = changed_frames(field, change)
    with torch.no_grad(), pytest.raises(error, match=message) as caught:
        simulator.encode(frames, on_invalid=on_invalid, report=StabilityReport())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [NAN, INF, -INF, 255.0, -4.0, 1e30])
def test_pixels_out_of_range_follow_the_policy(value, simulator):
    frames = make_frames(SCENES)
    image, y, x = (int(i) for i in frames.masks.nonzero()[3])
    bad = dataclasses.replace(frames, images=with_entry(frames.images, (image, 1, y, x), value))
    instead = {"drop": 0.0, "clamp": 1.0 if value > 1 else 0.0}
    with torch.no_grad():
        with pytest.raises(NumericalError, match="images must be"):
            simulator.encode(bad, on_invalid="raise", report=StabilityReport())
        for on_invalid, pixel in instead.items():
            report = StabilityReport()
            actual = simulator.encode(bad, on_invalid=on_invalid, report=report)
            replaced = with_entry(frames.images, (image, 1, y, x), pixel)
            expected = simulator.encode(dataclasses.replace(frames, images=replaced))
            assert torch.equal(actual.means, expected.means) and report.total == 1
            assert int((actual.activity == 2).sum()) == (on_invalid == "drop")


def test_pixels_that_resampling_rounded_are_colours(simulator):
    frames = make_frames(SCENES)
    images = with_entry(frames.images, (0, 0, 0, 0), 1 + 1e-6)
    with torch.no_grad():
        simulator.encode(dataclasses.replace(frames, images=images), on_invalid="raise", report=StabilityReport())


PARTICLES = [
    ("means", lambda x: x.double(), InputError, "means must be torch.float32"),
    ("means", lambda x: x[:, :2], InputError, "means must be"),
    ("opacities", lambda x: x[:-1], InputError, "opacities must be"),
    ("dynamic_latents", lambda x: x[:, :1], InputError, "dynamic_latents must be"),
    ("static_latents", lambda x: x.half(), InputError, "static_latents must be"),
    ("activity", lambda x: x.long(), InputError, "activity must be torch.uint8"),
    ("activity", entry(5, 3), InputError, "activity must be 0"),
    ("cu_rows", entry(-1, 7), InputError, "cu_rows must ascend"),
    ("cu_rows", entry(0, 1), InputError, "cu_rows must ascend"),
    ("cu_rows", entry(1, 10**6), InputError, "cu_rows must ascend"),
    ("cu_rows", lambda x: x.int(), InputError, "cu_rows must be torch.int64"),
    ("cloud_scene", entry(-1, 2), InputError, "cloud_scene must be in"),
    ("cloud_scene", entry(0, -1), InputError, "cloud_scene must be in"),
    ("cloud_step", lambda x: x[:1], InputError, "cloud_step"),
    ("origin", entry((0, 0), INF), NumericalError, "origin must be finite"),
    ("origin", entry((1, 0), 1e39), NumericalError, "origin must be finite"),
    ("origin", lambda x: x.float()[:, :1], InputError, "origin must be"),
]


@pytest.mark.parametrize(("field", "change", "error", "message"), PARTICLES)
@pytest.mark.parametrize("call", ["step", "rollout", "render"])
def test_particles_are_refused_by_name(call, field, change, error, message, simulator, state):
    bad = dataclasses.replace(state, **{field: change(getattr(state, field))})
    frames = make_frames(SCENES)
    arguments = {"step": (), "rollout": (1,), "render": (frames.cameras,)}[call]
    with torch.no_grad(), pytest.raises(error, match=f"{call}: particles.*{message}") as caught:
        getattr(simulator, call)(bad, *arguments, report=StabilityReport())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("field", ["body", "rest_positions", "initial_latents", "light_occlusion", "frozen_appearance"])
def test_unvalidated_attributes_are_checked(field, simulator, state):
    values = torch.zeros(state.n_rows, 3)
    values[7, 1] = math.nan
    bad = dataclasses.replace(state, **{field: values})
    with pytest.raises(ValueError, match=f"step: particles.{field} must be") as caught:
        simulator.step(bad)
    assert isinstance(caught.value, (NumericalError, InputError))
    assert field in ("frozen_appearance", "initial_latents") or caught.value.row == 7
