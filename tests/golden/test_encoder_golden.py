"""The encoder with published weights against tensors of the published model (h_encoder, i_film)."""

import pytest
import torch

from gsim3d.cameras import Cameras, Frames
from gsim3d.compat.released import encoder_weights
from gsim3d.compat.released_model import (
    ReleasedCostVolume,
    ReleasedDepthPredictor,
    ReleasedHeads,
    ReleasedTransformer,
    as_released,
)
from gsim3d.nn.multiview_encoder import Encoder
from gsim3d.nn.multiview_encoder.depth import Views
from gsim3d.nn.multiview_encoder.heads import Conditioning, PixelRays, pluecker
from tests.asserts import assert_close_relative_to_max, relative_to_max
from tests.golden.published import encoder_config
from tests.golden_files import golden
from tests.tolerances import tolerance

pytestmark = pytest.mark.golden
OUTPUTS = {
    "means": "means",
    "opacities": "opacities",
    "dynamic_latents": "dynamic_latent_features",
    "static_latents": "static_latent_features",
}


def load_encoder(file) -> Encoder:
    encoder = as_released(Encoder(encoder_config("small")))
    encoder.load_state_dict(encoder_weights((file / "w").dict()))
    return encoder


def load_frames(file, masks: torch.Tensor | None = None) -> Frames:
    """One cloud a scene and step, with all its views."""
    inputs = file / "in"
    n_scenes, n_steps, n_views, _, height, width = inputs["image"].shape
    Ks = inputs["intrinsics"].flatten(0, 2).double() * torch.tensor([width, height, 1.0]).double()[:, None]
    viewmats = torch.linalg.inv(inputs["extrinsics"].flatten(0, 2).double())
    near, far = inputs["near"].flatten(), inputs["far"].flatten()
    cameras = Cameras(viewmats, Ks, near, far, torch.arange(len(near)) // n_views, width, height)
    scene, step = torch.arange(n_scenes).repeat_interleave(n_steps), torch.arange(n_steps).repeat(n_scenes)
    return Frames(
        inputs["image"].flatten(0, 2), cameras, scene, step, torch.zeros(n_scenes, 3, dtype=torch.float64), masks
    )


def column(value: torch.Tensor) -> torch.Tensor:
    return value[:, None] if value.dim() == 1 else value


def by_cloud(rows: torch.Tensor, n_views: int) -> torch.Tensor:
    """Published rows are ordered view by view, ours cloud by cloud."""
    return rows.unflatten(0, (n_views, -1)).transpose(0, 1).flatten(0, 1)


def outputs_of(encoder: Encoder, modules: dict[str, torch.nn.Module], frames: Frames) -> dict:
    """Inputs and output of modules, and the particles."""
    seen = {}
    for name, module in modules.items():
        module.register_forward_hook(lambda _m, inputs, output, name=name: seen.update({name: (inputs, output)}))
    return seen | {"particles": encoder(frames)}


def test_output_and_image_gradient(device):
    file = golden("h_encoder")
    frames = load_frames(file).to(device)
    frames.images.requires_grad_()
    particles = load_encoder(file).to(device)(frames)
    loss = 0
    for ours, theirs in OUTPUTS.items():
        value = column(getattr(particles, ours))
        assert_close_relative_to_max(value, file[f"out/{theirs}"].flatten(0, 2), "encoder_golden", ours)
        loss = loss + (value * file[f"cotangent/{theirs}"].flatten(0, 2).to(device)).sum()
    (gradient,) = torch.autograd.grad(loss, frames.images)
    assert_close_relative_to_max(gradient, file["grad/image"].reshape(gradient.shape), "encoder_golden", "gradient")
    n_scenes, n_steps, n = file["out/means"].shape[:3]
    assert particles.cu_rows.tolist() == [n * i for i in range(n_scenes * n_steps + 1)]


def test_features_of_all_views():
    file = golden("h_encoder")
    encoder = load_encoder(file)
    seen = outputs_of(encoder, {"cnn": encoder.cnn, "transformer": encoder.transformer}, load_frames(file))
    expected = file["backbone/trans_features"]
    assert_close_relative_to_max(seen["transformer"][1], expected, "encoder_golden", "transformer")
    cnn = seen["cnn"][1].reshape(expected.shape)
    assert_close_relative_to_max(cnn, file["backbone/cnn_features"], "encoder_golden", "CNN")


def test_depth_and_heads():
    file = golden("h_encoder")
    encoder, frames = load_encoder(file), load_frames(file)
    n_views, factor = file["in/image"].shape[2], encoder.config.downscale_factor
    volume = encoder.depth.cost_volume
    modules = {
        "refine_in": volume.refine_in,
        "cost_unet": volume.unet,
        "head": volume.head,
        "volume": volume,
        "proj_feature": encoder.depth.proj_feature,
        "depth_in": encoder.depth.refine_in,
        "refine_unet": encoder.depth.refine_unet,
        "correction": encoder.depth.to_disparity,
        "depth": encoder.depth,
        "raw": encoder.heads.to_gaussians,
        "latents": encoder.heads.to_latents,
    }
    seen = outputs_of(encoder, modules, frames)
    views, depth = seen["volume"][0][1], seen["depth"][1]
    depth_in = seen["depth_in"][0][0]  # image, projected features, coarse disparity, largest probability
    expected = {
        "costvolume/disp_candidates": volume.disparities(views, frames.images)[:, :, None, None],
        "costvolume/raw_correlation_in": seen["refine_in"][0][0],
        "costvolume/unet_in": seen["cost_unet"][0][0],
        "costvolume/unet_out": seen["cost_unet"][1],
        "costvolume/refined_correlation": seen["head"][0][0],
        "costvolume/pdf_logits": seen["head"][1],
        "costvolume/coarse_disps": seen["volume"][1][0],
        "refine/fullres_disps": depth_in[:, -2:-1],
        "refine/pdf_max_fullres": depth_in[:, -1:],
        "refine/unet_in__subsampled_4x": depth_in[:, :, ::4, ::4],
        "refine/proj_feat_in_fullres__subsampled_4x": seen["proj_feature"][0][0][:, :, ::4, ::4],
        "refine/unet_out": seen["refine_unet"][1],
        "refine/delta_disps_density": seen["correction"][1],
        "heads/raw_gaussians": seen["raw"][1],
        "heads/film_conditioned_features__subsampled_4x": seen["latents"][0][0][:, :, ::4, ::4],
    }
    assert factor == frames.images.shape[-1] // file["costvolume/coarse_disps"].shape[-1]
    for name, ours in expected.items():
        assert_close_relative_to_max(ours, by_cloud(file[name], n_views), "encoder_golden", name)
    expected = {
        "depths": depth.depth,
        "densities": depth.opacity_logit.sigmoid(),
        "xy_offsets": seen["raw"][1][:, :2],
    }
    for name, ours in expected.items():
        published = file[f"depth_predictor/{name}"]  # [clouds, views, pixels, 1, channels]
        pixels = ours.flatten(2).mT.reshape(published.shape)
        assert_close_relative_to_max(pixels, published, "encoder_golden", name)


def test_masked_pixels_leave_no_particles():
    file = golden("h_encoder")
    frames = load_frames(file, file["masked/in/state_mask"].flatten(0, 2)[:, 0])
    particles = load_encoder(file)(frames)
    kept = file["masked/out/state_mask"][..., 0]
    assert particles.cu_rows.diff().tolist() == kept.sum(2).flatten().tolist()
    for ours, theirs in OUTPUTS.items():
        expected = file[f"masked/out/{theirs}"][kept]
        assert_close_relative_to_max(column(getattr(particles, ours)), expected, "encoder_golden", ours)
        assert not file[f"masked/out/{theirs}"][~kept].any()  # padding there, nothing here


@pytest.mark.parametrize(
    ("override", "name"),
    [
        (ReleasedTransformer, "cross_mask"),
        (ReleasedCostVolume, "feature_intrinsics"),
        (ReleasedCostVolume, "source_intrinsics"),
        (ReleasedHeads, "_rays"),
        (ReleasedDepthPredictor, "upsampling_stride"),
    ],
)
def test_each_override_is_what_the_published_model_does(override, name, monkeypatch):
    """Without any one of them the published numbers are missed."""
    file = golden("h_encoder")
    monkeypatch.delattr(override, name)
    particles = load_encoder(file)(load_frames(file))
    errors = [
        relative_to_max(column(getattr(particles, ours)), file[f"out/{theirs}"].flatten(0, 2))
        for ours, theirs in OUTPUTS.items()
    ]
    assert max(errors) > 10 * tolerance("encoder_golden")


def test_view_conditioning():
    file = golden("i_film")
    n_views = file["in/intrinsics_bv"].shape[1]
    weights = {name.removeprefix("global_cond."): value for name, value in (file / "w").dict().items()}
    net = Conditioning(weights["0.weight"].shape[0], weights["2.weight"].shape[0] // 2)
    net.net.load_state_dict(weights)
    names = ("mono_features", "depths", "raw_densities", "xy_offsets")
    inputs = [file[f"in/{name}"].requires_grad_() for name in names]
    height, width = inputs[0].shape[-2:]

    def view_major(t: torch.Tensor) -> torch.Tensor:
        return t.transpose(0, 1).flatten(0, 1).double()

    Ks, poses = view_major(file["in/intrinsics_bv"]), view_major(file["in/extrinsics_bv"])
    Ks = Ks * torch.tensor([width, height, 1.0], dtype=torch.float64)[:, None]
    bounds = torch.ones(len(Ks))
    rays = PixelRays.of(Views(inputs[0], Ks, torch.linalg.inv(poses), bounds, bounds, n_views))
    embedding = pluecker(rays.centers, rays.directions(height, width, torch.zeros(1, 2, height, width)))
    assert_close_relative_to_max(embedding, file["plucker"], "film_golden", "Pluecker coordinates")
    out = net(*inputs, embedding)
    assert_close_relative_to_max(out, file["out"], "film_golden")
    gradients = torch.autograd.grad(out, inputs, file["cotangent"])
    for gradient, name in zip(gradients, names, strict=True):
        assert_close_relative_to_max(gradient, file[f"grad/{name}"], "film_golden", name)
