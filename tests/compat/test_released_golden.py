"""The published model's own weights, in a published file: imported, they predict what it predicted."""

import functools
import json

import pytest
import torch

from gsim3d import ops
from gsim3d.cameras import Cameras, Frames
from gsim3d.cli.main import main
from gsim3d.compat.released import dynamics_weights, encoder_weights, to_published
from gsim3d.compat.released_config import read_config
from gsim3d.compat.released_import import published_shapes
from gsim3d.compat.released_model import ReleasedAttention, as_released
from gsim3d.dynamics import Dynamics
from gsim3d.effects.spec import EffectsSpec
from gsim3d.nn.multiview_encoder import Encoder
from gsim3d.nn.point_transformer import Attention
from gsim3d.state import DYNAMIC, FROZEN, Particles
from gsim3d.train.restore import restore
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.compat.release import changed, write_release
from tests.golden.published import NOT_IN_GOLDEN
from tests.golden_files import golden, golden_path

pytestmark = pytest.mark.golden

FIELDS = {
    "means": "means", "opacities": "opacities", "dynamic_latents": "dynamic_latent_features",
    "static_latents": "static_latent_features",
}  # fmt: skip


def part(file, prefix):
    weights = golden(file) / "w"
    return {prefix + name: weights[name] for name in weights.keys()}


@pytest.fixture(scope="module")
def import_model(tmp_path_factory):
    """Encoder and head of their golden files and the dynamics of another, as one published checkpoint -> imported."""
    return functools.cache(lambda *arguments: _import(tmp_path_factory.mktemp("release"), *arguments))


def _import(folder, dynamics, metric=None):
    settings = json.loads(golden_path("params_full.json").read_text())["small"]["resolved_config"]
    settings = changed(settings, "model.dynamic_model.model.grid_size", float(golden(dynamics)["grid_size"]))
    if metric is not None:
        settings = changed(settings, "model.state_adapter.metric", metric)
    prefix = "dynamic_model." if dynamics.startswith("k") else "dynamic_model.net."
    weights = {
        **part("h_encoder", "encoder."),
        **part(dynamics, prefix),
        **part("j_missing_gaussian_params", "decoder."),
    }
    checkpoint, config = write_release(folder, weights, settings)
    assert main(["import", str(checkpoint), "--config", str(config), "-o", str(folder / "model")]) == 0
    simulator = restore(folder / "model").simulator
    for module in simulator.modules():
        if isinstance(module, ReleasedAttention):
            module.__class__ = Attention  # the tensors were made in full precision
    return simulator, weights


def offsets(mask):
    return torch.cat([torch.zeros(1, dtype=torch.int64), mask.sum(2).flatten().cumsum(0)])


def test_whole_model_is_named(import_model):
    simulator, weights = import_model("f_dynamics_small_nodup")
    listed = json.loads(golden_path("params_full.json").read_text())["small"]
    back = to_published(simulator.state_dict(), simulator.config)
    assert {name: tuple(value.shape) for name, value in back.items()} == {
        entry["name"]: tuple(entry["shape"]) for entry in listed["entries"]
    }
    for name, value in weights.items():
        if not name.endswith("num_batches_tracked"):
            assert torch.equal(back[name], value), name


VARIANTS = ["full_latent_4_1_12_intended", "full_latent_4_1_12_literal_yaml", "small", "small_deep_dynamics"]


@pytest.mark.parametrize("variant", VARIANTS)
def test_resolved_settings_make_the_listed_tensors(variant):
    listed = json.loads(golden_path("params_full.json").read_text())[variant]
    shapes = {entry["name"]: tuple(entry["shape"]) for entry in listed["entries"]}
    read = read_config(listed["resolved_config"], shapes)
    assert published_shapes(read.model) == shapes
    assert not any("but the weights have" in note for note in read.notes)
    net = listed["resolved_config"]["model"]["dynamic_model"]["model"]
    dynamics = read.model.dynamics
    assert (dynamics.grid_size, list(dynamics.strides)) == (net["grid_size"], net["stride"])
    assert list(dynamics.merge_windows) == net["merge_window_size"]
    assert dynamics.history_bits == 2 and read.data["near_far"] == [1.0, 8.0]


@pytest.mark.parametrize("case", ["T4_nomask", "T2_mask"])
@pytest.mark.parametrize("file", ["f_dynamics_small_nodup", "f_dynamics_small_dup"])
def test_network(import_model, file, case):
    simulator, _ = import_model(file)
    dynamics, c = simulator.dynamics, golden(file) / case
    xyz, expected = c["xyz"], c["out"]
    mask = c["state_mask"][..., 0] if "state_mask" in c else torch.ones(xyz.shape[:3], dtype=torch.bool)
    n_scenes, n_steps = xyz.shape[:2]
    pyramid = ops.build_pyramid(
        xyz[mask],
        offsets(mask),
        torch.arange(n_scenes).repeat_interleave(n_steps),
        torch.arange(n_steps).repeat(n_scenes),
        torch.zeros(n_scenes, 3, dtype=torch.float64),
        dynamics.config.pyramid_spec((n_steps - 1).bit_length()),
    )
    direct = as_released(Dynamics(dynamics.config), without=NOT_IN_GOLDEN).eval()
    direct.net.load_state_dict(dynamics_weights(part(file, "")))
    out = torch.zeros_like(expected)
    with torch.no_grad():
        out[mask] = dynamics.net.head(dynamics.net(c["features"][mask], pyramid))
        assert_same_bits(out[mask], direct.net.head(direct.net(c["features"][mask], pyramid)))
    assert_close_relative_to_max(out, expected, "dynamics_golden")


@pytest.mark.parametrize("case", ["scene0_plain", "scene0_mask_static"])
@pytest.mark.parametrize("file", ["k_rollout_nodup", "k_rollout_dup"])
def test_rollout(import_model, file, case):
    g = golden(file)
    simulator, _ = import_model(file, float(g["metric"]))
    c = g / case
    xyz = c["in/means"]
    mask = c["in/state_mask"][..., 0] if "in/state_mask" in c else torch.ones(xyz.shape[:3], dtype=torch.bool)
    moves = c["in/static_float"][..., 0] > 0 if "in/static_float" in c else torch.ones_like(mask)
    history = Particles(
        **{ours: c[f"in/{theirs}"][mask].squeeze(1) for ours, theirs in FIELDS.items()},
        cu_rows=offsets(mask),
        cloud_scene=torch.zeros(xyz.shape[1], dtype=torch.int64),
        cloud_step=torch.arange(xyz.shape[1]),
        activity=torch.where(moves[mask], DYNAMIC, FROZEN).to(torch.uint8),
        origin=torch.zeros(1, 3, dtype=torch.float64),
    )
    kept = mask[0, -1]
    with torch.no_grad():
        steps = simulator.rollout(history, 3, simulator.plan(EffectsSpec()))  # frozen particles stay
    for i, step in enumerate(steps):
        for ours, theirs in FIELDS.items():
            expected = c[f"out/{theirs}"][0, i][kept].squeeze(1)
            assert_close_relative_to_max(getattr(step, ours), expected, "dynamics_golden", f"{ours} of step {i}")


def test_encoder(import_model):
    simulator, _ = import_model("f_dynamics_small_nodup")
    file = golden("h_encoder")
    images = file["in/image"]
    n_steps, n_views, size = images.shape[1], images.shape[2], images.shape[-1]
    n_images = n_steps * n_views
    Ks = file["in/intrinsics"].reshape(n_images, 3, 3).double()
    Ks[:, :2] *= size
    cameras = Cameras(
        torch.linalg.inv(file["in/extrinsics"].reshape(n_images, 4, 4).double()),
        Ks,
        file["in/near"].flatten(),
        file["in/far"].flatten(),
        torch.arange(n_images) // n_views,
        size,
        size,
    )
    scene, step = torch.zeros(n_steps, dtype=torch.int64), torch.arange(n_steps)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    frames = Frames(images.reshape(n_images, 3, size, size), cameras, scene, step, origin)
    direct = as_released(Encoder(simulator.config.encoder))
    direct.load_state_dict(encoder_weights(part("h_encoder", "")))
    with torch.no_grad():
        particles, same = simulator.encode(frames), direct(frames)
    for ours, theirs in FIELDS.items():
        value = getattr(particles, ours)
        assert_same_bits(value, getattr(same, ours), ours)
        expected = file[f"out/{theirs}"].flatten(0, 2).reshape(value.shape)
        assert_close_relative_to_max(value, expected, "encoder_golden", ours)


def test_head(import_model):
    simulator, _ = import_model("f_dynamics_small_nodup")
    g = golden("j_missing_gaussian_params")
    n = g["in/means"].numel() // 3
    dynamic, static = (g[f"in/{kind}_latent_features"].reshape(n, 8) for kind in ("dynamic", "static"))
    one = torch.zeros(1, dtype=torch.int64)
    particles = Particles(
        g["in/means"].reshape(n, 3), torch.zeros(n), dynamic, static, torch.tensor([0, n]), one, one,
        torch.zeros(n, dtype=torch.uint8), torch.zeros(1, 3, dtype=torch.float64),
    )  # fmt: skip
    assert simulator.config.renderer.latents == 16
    with torch.no_grad():
        gaussians = simulator.renderer(particles)
    assert_close_relative_to_max(gaussians.quats.roll(-1, 1), g["out/rotations"].reshape(n, 4), "dynamics_golden")
    assert_close_relative_to_max(gaussians.scales, g["out/scales"].reshape(n, 3), "dynamics_golden")
