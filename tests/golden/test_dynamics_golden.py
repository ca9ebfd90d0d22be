"""The dynamics model and the Gaussian head against tensors of the published ones."""

import dataclasses

import pytest
import torch

from gsim3d import ops
from gsim3d.dynamics import Dynamics, DynamicsConfig, rollout
from gsim3d.dynamics.point_transformer import Block, EncoderStage, PointTransformer
from gsim3d.dynamics.state import StateLayout, rotate_left
from gsim3d.harmonics import rotate_harmonics, rotate_unpaired_harmonics
from gsim3d.interop.released import dynamics_weights, head_weights
from gsim3d.quirks import Quirks
from gsim3d.renderer import GaussianHead, RendererConfig, rotation_matrices, unit_quats
from gsim3d.types import DYNAMIC, FROZEN, Particles
from tests.asserts import assert_close_relative_to_max
from tests.golden_files import golden

pytestmark = pytest.mark.golden

COMMON = dict(
    dynamic_latents=8, static_latents=8, grid_size=0.05, history_bits=2, patch_sizes=(32,) * 3, quirks=Quirks.release()
)
CONFIGS = {
    "small": DynamicsConfig(
        strides=(4, 2), merge_windows=(2, 2),
        encoder_depths=(1, 1, 1), encoder_channels=(16, 32, 32), encoder_heads=(2, 4, 4),
        decoder_depths=(1, 1), decoder_channels=(16, 32), decoder_heads=(2, 4), **COMMON,
    ),
    "deep": DynamicsConfig(
        strides=(2, 2), merge_windows=(1, 8),
        encoder_depths=(2, 4, 4), encoder_channels=(8, 16, 16), encoder_heads=(2, 2, 4),
        decoder_depths=(4, 2), decoder_channels=(8, 16), decoder_heads=(1, 2), **COMMON,
    ),
}  # fmt: skip


def weights(g, names=dynamics_weights):
    return names({key: (g / "w")[key] for key in (g / "w").keys()})


def cloud_table(n_scenes, n_steps):
    return torch.arange(n_scenes).repeat_interleave(n_steps), torch.arange(n_steps).repeat(n_scenes)


def offsets(mask):
    """mask [B, T, N] -> cu_rows of the clouds (b, t)."""
    return torch.cat([torch.zeros(1, dtype=torch.int64), mask.sum(2).flatten().cumsum(0)])


def pyramid_of(xyz, mask, config):
    n_scenes, n_steps = xyz.shape[:2]
    scene, step = cloud_table(n_scenes, n_steps)
    spec = config.pyramid_spec((n_steps - 1).bit_length())
    origin = torch.zeros(n_scenes, 3, dtype=torch.float64)
    return ops.build_pyramid(xyz[mask], offsets(mask), scene, step, origin, spec)


def close(actual, expected, what, tolerance="dynamics_golden"):
    assert_close_relative_to_max(actual, expected, tolerance, what)


@pytest.mark.parametrize("file", ["e_block_nodup", "e_block_dup"])
@pytest.mark.parametrize("order", range(4))
def test_block(file, order):
    g = golden(file)
    xyz = g["in/xyz"]
    config = dataclasses.replace(
        CONFIGS["small"], grid_size=float(g["grid_size"]), strides=(), merge_windows=(), patch_sizes=(32,),
        encoder_depths=(1,), encoder_channels=(16,), encoder_heads=(2,),
        decoder_depths=(), decoder_channels=(), decoder_heads=(),
    )  # fmt: skip
    pyramid = pyramid_of(xyz, torch.ones(xyz.shape[:3], dtype=torch.bool), config)
    block = Block(16, 2, 0.0, config).eval()
    published = g / f"order{order}" / "w"
    named = dynamics_weights({f"enc.enc0.block0.{key}": published[key] for key in published.keys()})
    block.load_state_dict({key.removeprefix("encoder.0.blocks.0."): value for key, value in named.items()})
    x = g["in/features"].reshape(-1, 16).requires_grad_()
    out = block(x, pyramid.stages[0], order)
    close(out, g[f"order{order}/out"], "out")
    (grad,) = torch.autograd.grad(out, x, g["cotangent"])
    close(grad, g[f"order{order}/grad_features"].reshape(-1, 16), "gradient")


@pytest.mark.parametrize("case", ["T4_nomask", "T4_mask", "T2_nomask", "T2_mask"])
@pytest.mark.parametrize("file", ["small_nodup", "small_dup", "deep_nodup", "deep_dup"])
def test_network(file, case):
    g = golden(f"f_dynamics_{file}")
    config = dataclasses.replace(CONFIGS[file.split("_")[0]], grid_size=float(g["grid_size"]))
    net = PointTransformer(17, 11, config).eval()
    net.load_state_dict(weights(g))
    c = g / case
    xyz, features = c["xyz"], c["features"].requires_grad_()
    mask = c["state_mask"][..., 0] if "state_mask" in c else torch.ones(xyz.shape[:3], dtype=torch.bool)
    pyramid = pyramid_of(xyz, mask, config)
    out = torch.zeros_like(c["out"])
    out[mask] = net.head(net(features[mask], pyramid))
    close(out, c["out"], "out")
    (grad,) = torch.autograd.grad(out, features, c["cotangent"])
    close(grad, c["grad_features"], "gradient of the features")


def test_gradients_of_all_weights():
    g = golden("f_dynamics_small_nodup")
    c = g / "T4_nomask"
    published = {key: (c / "grad_w")[key] for key in (c / "grad_w").keys()}
    config = dataclasses.replace(CONFIGS["small"], grid_size=float(g["grid_size"]))
    net = PointTransformer(17, 11, config).eval()
    net.load_state_dict(weights(g))
    xyz = c["xyz"]
    mask = torch.ones(xyz.shape[:3], dtype=torch.bool)
    out = net.head(net(c["features"].flatten(0, 2), pyramid_of(xyz, mask, config)))
    out.backward(c["cotangent"].flatten(0, 2))
    expected = dynamics_weights(published)
    for name, parameter in net.named_parameters():
        close(parameter.grad, expected[name], name)


@pytest.mark.parametrize("file", ["small_nodup", "deep_nodup"])
def test_batch_norm_in_training(file):
    g = golden(f"f_dynamics_{file}")
    config = dataclasses.replace(CONFIGS[file.split("_")[0]], grid_size=float(g["grid_size"]))
    net = PointTransformer(17, 11, config).train()
    net.load_state_dict(weights(g))
    c = g / "T4_nomask"
    mask = torch.ones(c["xyz"].shape[:3], dtype=torch.bool)
    out = net.head(net(c["features"].flatten(0, 2), pyramid_of(c["xyz"], mask, config)))
    close(out.reshape(c["out"].shape), c["out_trainBN_nodroppath"], "out")
    after = dynamics_weights({key: (c / "trainBN_after")[key] for key in (c / "trainBN_after").keys()})
    assert after
    for name, buffer in net.named_buffers():
        close(buffer, after[name], name)


@pytest.mark.parametrize("window", [1, 2, 4, 8])
@pytest.mark.parametrize("stride", [2, 4])
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_pooling_and_merging(file, stride, window):
    g = golden(f"d_pooling_merger_{file}")
    config = dataclasses.replace(
        CONFIGS["small"], grid_size=float(g["grid_size"]), strides=(stride,), merge_windows=(window,),
        patch_sizes=(32, 32), encoder_depths=(0, 0), encoder_channels=(6, 8), encoder_heads=(1, 1),
        decoder_depths=(0,), decoder_channels=(6,), decoder_heads=(1,),
    )  # fmt: skip
    xyz = g["in/xyz"]
    pyramid = pyramid_of(xyz, torch.ones(xyz.shape[:3], dtype=torch.bool), config)
    case = g / f"pool{stride}"
    stage = EncoderStage(1, [], config).eval()
    published = {f"enc.enc1.down.{key}": (case / "w")[key] for key in (case / "w").keys()}
    if window > 1:
        published["enc.enc1.merger.pos_emb"] = case[f"merge{window}/pos_emb"]
    stage.load_state_dict({k.removeprefix("encoder.1."): v for k, v in dynamics_weights(published).items()})
    out = stage(g["in/features"].reshape(-1, 6), pyramid.stages[1], None)
    close(out, case[f"merge{window}/out/feat"], "features")
    if window == 1:
        stage.train()
        out = stage(g["in/features"].reshape(-1, 6), pyramid.stages[1], None)
        close(out, case["train/feat"], "features in training")
        close(stage.pool.norm.running_mean, case["train/running_mean_after"], "running mean")
        close(stage.pool.norm.running_var, case["train/running_var_after"], "running variance")


@pytest.mark.parametrize("case", ["scene0_plain", "scene1_plain", "scene0_mask_static"])
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_rollout(file, case):
    g = golden(f"k_rollout_{file}")
    config = dataclasses.replace(
        CONFIGS["small"], grid_size=float(g["grid_size"]), max_step=float(g["metric"]) / 2
    )
    dynamics = Dynamics(config).eval()
    published = {key.removeprefix("net."): (g / "w")[key] for key in (g / "w").keys()}
    dynamics.net.load_state_dict(dynamics_weights(published))
    c = g / case
    xyz = c["in/means"]
    mask = c["in/state_mask"][..., 0] if "in/state_mask" in c else torch.ones(xyz.shape[:3], dtype=torch.bool)
    moves = c["in/static_float"][..., 0] > 0 if "in/static_float" in c else torch.ones_like(mask)
    scene, step = cloud_table(*xyz.shape[:2])
    history = Particles(
        means=xyz[mask],
        opacities=c["in/opacities"][mask][:, 0],
        dynamic_latents=c["in/dynamic_latent_features"][mask],
        static_latents=c["in/static_latent_features"][mask],
        cu_rows=offsets(mask),
        cloud_scene=scene,
        cloud_step=step,
        activity=torch.where(moves[mask], DYNAMIC, FROZEN).to(torch.uint8),
        origin=torch.zeros(1, 3, dtype=torch.float64),
    )
    kept = mask[0, -1]
    for i, particles in enumerate(rollout(dynamics, history, 3, 4)):
        close(particles.means, c["out/means"][0, i][kept], f"means of step {i}")
        close(particles.dynamic_latents, c["out/dynamic_latent_features"][0, i][kept], f"latents of step {i}")
        close(particles.opacities, c["out/opacities"][0, i, :, 0][kept], f"opacities of step {i}")
        close(particles.static_latents, c["out/static_latent_features"][0, i][kept], f"static latents of step {i}")


FIELDS = {
    "means": "means",
    "scales": "scales",
    "opacities": "opacities",
    "harmonics": "sh",
    "rotations": "quats",
    "dynamic_latent_features": "dynamic_latents",
}

# Scale increments are always bounded here, as in every published configuration.
UPDATES = [(key, bias) for key in FIELDS for bias in (0, 1) if (key, bias) != ("scales", 0)]


@pytest.mark.parametrize("modality", ["cx_x", "cx_dx"])
@pytest.mark.parametrize(("key", "bias"), UPDATES)
def test_state_updates(key, bias, modality):
    g = golden("g_state_updates") / f"bias{bias}" / key / modality / "npred1"
    config = DynamicsConfig(
        dynamic_latents=8, static_latents=0, explicit=True, max_step=0.35 if bias else None, quirks=Quirks.release()
    )
    low, high = scale_limits(golden("g_state_updates"))
    layout = StateLayout.of(dataclasses.replace(config, scale_min=low, scale_max=high))
    c = g / "static0"
    past, prediction = c["past"][0].flatten(0, 1), c["pred"][0, 0].flatten(0, 1).flatten(1)
    before = particles_with(FIELDS[key], past, torch.zeros(past.shape[0], dtype=torch.uint8))
    raw = torch.zeros(past.shape[0], layout.out_channels)
    start = 0
    for name, width in layout.outputs:
        if name == FIELDS[key]:
            raw[:, start : start + width] = prediction
        start += width
    after = getattr(layout.advance(before, raw), FIELDS[key])
    close(as_published(key, after), c["out"][0].flatten(0, 1), key)


def scale_limits(g):
    out = torch.cat([g[k].flatten() for k in g.keys() if "/scales/" in k and k.endswith("/out")])
    return out.min().item(), out.max().item()


def particles_with(name, value, activity):
    n = value.shape[0]
    fields = dict(
        means=torch.zeros(n, 3), opacities=torch.zeros(n), dynamic_latents=torch.zeros(n, 8),
        static_latents=torch.zeros(n, 0), quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.01), sh=torch.zeros(n, 16, 3),
    )  # fmt: skip
    fields[name] = {"opacities": lambda v: v[:, 0], "quats": lambda v: v.roll(1, 1), "sh": lambda v: v.mT}.get(
        name, lambda v: v
    )(value)
    one = torch.zeros(1, dtype=torch.int64)
    return Particles(
        **fields, activity=activity, cu_rows=torch.tensor([0, n]), cloud_scene=one, cloud_step=one,
        origin=torch.zeros(1, 3, dtype=torch.float64),
    )  # fmt: skip


def as_published(key, value):
    if key == "opacities":
        return value[:, None]
    if key == "harmonics":
        return value.mT
    return value.roll(-1, 1) if key == "rotations" else value


def test_head_predicts_missing_gaussian_parameters():
    g = golden("j_missing_gaussian_params")
    config = RendererConfig(latents=16, quirks=Quirks.release())
    head = GaussianHead(config)
    head.load_state_dict(weights(g, head_weights))
    n = 160
    latents = [g[f"in/{name}_latent_features"].reshape(n, 8).requires_grad_() for name in ("dynamic", "static")]
    particles = dataclasses.replace(
        particles_with("means", g["in/means"].reshape(n, 3), torch.zeros(n, dtype=torch.uint8)),
        dynamic_latents=latents[0],
        static_latents=latents[1],
    )
    gaussians = head(particles)
    close(gaussians.quats.roll(-1, 1), g["out/rotations"].reshape(n, 4), "rotations")
    close(gaussians.scales, g["out/scales"].reshape(n, 3), "scales")
    rotations = rotation_matrices(gaussians.quats)
    covariances = rotations @ torch.diag_embed(gaussians.scales**2) @ rotations.mT
    close(covariances, g["out/covariances"].reshape(n, 3, 3), "covariances")
    harmonics = in_published_basis(gaussians.sh)
    close(harmonics, g["out/harmonics"].reshape(n, 3, 16), "harmonics")
    outputs = {"rotations": gaussians.quats.roll(-1, 1), "scales": gaussians.scales, "harmonics": harmonics}
    loss = sum((g[f"cotangent/{key}"].reshape(value.shape) * value).sum() for key, value in outputs.items())
    loss = loss + 1e4 * (g["cotangent/covariances"].reshape(covariances.shape) * covariances).sum()
    grads = torch.autograd.grad(loss, latents)
    for name, grad in zip(("dynamic", "static"), grads, strict=True):
        close(grad, g[f"grad/{name}_latent_features"].reshape(n, 8), f"gradient of {name} latents")


def in_published_basis(sh):
    """Standard coefficients [N, K, 3] -> those of the standard basis of (z, x, y), [N, 3, K]."""
    permute = torch.eye(3)[[2, 0, 1]].to(sh).expand(sh.shape[0], 3, 3)
    return rotate_harmonics(sh, permute).mT


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_turn(degree):
    g = golden("j_sh_rotation")
    sh, rotations = g[f"deg{degree}/sh"].double().mT, g["rotmat"].double()
    turned = in_published_basis(rotate_unpaired_harmonics(sh, rotations))
    # The published rotation goes through angles that are clamped away from turns about y, like those of rows 0 and 1.
    expected = g[f"f64/deg{degree}/out_float64"]
    close(turned[2:], expected[2:], "harmonics")
    close(turned[:2], expected[:2], "harmonics where the published angles are clamped", 2e-2)


def test_covariances_and_increments_of_rotation():
    g = golden("j_sh_rotation")
    quats = g["quat_xyzw"].roll(1, 1)
    close(rotation_matrices(unit_quats(quats)), g["rotmat"], "rotation matrices")
    turned = rotate_left(quats, g["rotvec"])
    close(rotation_matrices(turned), rotation_matrices(g["increment_rot"].roll(1, 1)), "turned rotations")
