"""The encoder with published weights against tensors of the published model (h_encoder, i_film, j_sh_rotation)."""

import dataclasses

import pytest
import torch

from gsim3d.encoder import Encoder, EncoderConfig
from gsim3d.encoder.depth import Views
from gsim3d.encoder.heads import Conditioning, PixelRays, pluecker
from gsim3d.encoder.camera_frame import rotation_of_harmonics
from gsim3d.harmonics import sh_basis
from gsim3d.interop.released import encoder_weights
from gsim3d.quirks import Quirks
from gsim3d.types import Cameras, Frames
from tests.asserts import assert_close_relative_to_max, relative_to_max
from tests.golden_files import golden

pytestmark = pytest.mark.golden
STEPS, VIEWS, SIZE = 2, 4, 32
CONFIG = EncoderConfig(
    feature_dim=32,
    n_depths=16,
    cost_unet_dim=32,
    refine_unet_dim=32,
    dynamic_dim=8,
    static_dim=8,
    quirks=Quirks.release(),
)
OUTPUTS = {
    "means": "means",
    "opacities": "opacities",
    "dynamic_latents": "dynamic_latent_features",
    "static_latents": "static_latent_features",
}


def load_encoder(file, config: EncoderConfig = CONFIG) -> Encoder:
    encoder = Encoder(config)
    weights = file / "w"
    encoder.load_state_dict(encoder_weights({name: weights[name] for name in weights.keys()}))
    return encoder


def load_frames(file, masks: torch.Tensor | None = None) -> Frames:
    n_images = STEPS * VIEWS
    inputs = file / "in"
    Ks = inputs["intrinsics"].reshape(n_images, 3, 3).double()
    Ks[:, :2] *= SIZE
    viewmats = torch.linalg.inv(inputs["extrinsics"].reshape(n_images, 4, 4).double())
    near, far = inputs["near"].flatten(), inputs["far"].flatten()
    cameras = Cameras(viewmats, Ks, near, far, torch.arange(n_images) // VIEWS, SIZE, SIZE)
    images = inputs["image"].reshape(n_images, 3, SIZE, SIZE)
    scene, step = torch.zeros(STEPS, dtype=torch.int64), torch.arange(STEPS)
    return Frames(images, cameras, scene, step, torch.zeros(1, 3, dtype=torch.float64), masks)


def column(value: torch.Tensor) -> torch.Tensor:
    return value[:, None] if value.dim() == 1 else value


def by_step(rows: torch.Tensor) -> torch.Tensor:
    """Published rows are ordered view by view, ours step by step."""
    return rows.unflatten(0, (VIEWS, STEPS)).transpose(0, 1).flatten(0, 1)


def outputs_of(encoder: Encoder, modules: dict[str, torch.nn.Module], frames: Frames) -> dict:
    seen = {}
    handles = [
        module.register_forward_hook(lambda _m, inputs, output, name=name: seen.update({name: (inputs, output)}))
        for name, module in modules.items()
    ]
    encoder(frames)
    for handle in handles:
        handle.remove()
    return seen


def test_output_and_image_gradient():
    file = golden("h_encoder")
    frames = load_frames(file)
    frames.images.requires_grad_()
    particles = load_encoder(file)(frames)
    loss = 0
    for ours, theirs in OUTPUTS.items():
        value = column(getattr(particles, ours))
        assert_close_relative_to_max(value, file[f"out/{theirs}"].flatten(0, 2), "encoder_golden", ours)
        loss = loss + (value * file[f"cotangent/{theirs}"].flatten(0, 2)).sum()
    (gradient,) = torch.autograd.grad(loss, frames.images)
    assert_close_relative_to_max(gradient, file["grad/image"].reshape(gradient.shape), "encoder_golden", "gradient")
    assert particles.cu_rows.tolist() == [0, VIEWS * SIZE**2, STEPS * VIEWS * SIZE**2]


def test_intermediate_results():
    file = golden("h_encoder")
    encoder = load_encoder(file)
    volume = encoder.depth.cost_volume
    modules = {
        "cnn": encoder.cnn,
        "transformer": encoder.transformer,
        "refine_in": volume.refine_in,
        "cost_unet": volume.unet,
        "head": volume.head,
        "volume": volume,
        "refine_unet": encoder.depth.refine_unet,
        "correction": encoder.depth.to_disparity,
        "depth": encoder.depth,
    }
    seen = outputs_of(encoder, modules, load_frames(file))
    depth = seen["depth"][1]
    expected = {
        "backbone/cnn_features": seen["cnn"][1].unflatten(0, (STEPS, VIEWS)),
        "backbone/trans_features": seen["transformer"][1],
        "depth_predictor/depths": depth.depth.reshape(STEPS, VIEWS, -1, 1, 1),
        "depth_predictor/densities": depth.opacity_logit.sigmoid().reshape(STEPS, VIEWS, -1, 1, 1),
    }
    for name, ours in expected.items():
        assert_close_relative_to_max(ours, file[name], "encoder_golden", name)
    expected = {
        "costvolume/raw_correlation_in": seen["refine_in"][0][0],
        "costvolume/unet_in": seen["cost_unet"][0][0],
        "costvolume/unet_out": seen["cost_unet"][1],
        "costvolume/refined_correlation": seen["head"][0][0],
        "costvolume/pdf_logits": seen["head"][1],
        "costvolume/coarse_disps": seen["volume"][1][0],
        "refine/unet_out": seen["refine_unet"][1],
        "refine/delta_disps_density": seen["correction"][1],
    }
    for name, ours in expected.items():
        assert_close_relative_to_max(ours, by_step(file[name]), "encoder_golden", name)


def test_masked_pixels_leave_no_particles():
    file = golden("h_encoder")
    masks = file["masked/in/state_mask"].reshape(STEPS * VIEWS, SIZE, SIZE)
    particles = load_encoder(file)(load_frames(file, masks))
    kept = file["masked/out/state_mask"][0, ..., 0]
    assert (particles.cu_rows[1:] - particles.cu_rows[:-1]).tolist() == kept.sum(1).tolist()
    for ours, theirs in OUTPUTS.items():
        expected = file[f"masked/out/{theirs}"][0][kept]
        assert_close_relative_to_max(column(getattr(particles, ours)), expected, "encoder_golden", ours)


@pytest.mark.parametrize(
    "quirk",
    ["tiled_shift_mask", "integer_pixel_centers", "reference_intrinsics", "ray_depth", "corner_aligned_upsampling"],
)
def test_each_quirk_is_what_the_published_model_does(quirk):
    """Without any one of them the published numbers are missed by far."""
    file = golden("h_encoder")
    quirks = dataclasses.replace(Quirks.release(), **{quirk: False})
    particles = load_encoder(file, dataclasses.replace(CONFIG, quirks=quirks))(load_frames(file))
    assert relative_to_max(particles.means, file["out/means"].flatten(0, 2)) > 1e-3


def test_view_conditioning():
    file = golden("i_film")
    n_views = 3
    net = Conditioning(20, 67)
    net.net.load_state_dict({name: file[f"w/global_cond.{name}"] for name in net.net.state_dict()})
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


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_released_rotation_of_harmonics(degree):
    """Coefficients in the published basis, turned as published, then read in the standard basis."""
    file = golden("j_sh_rotation")
    turn = rotation_of_harmonics(file["rotmat"].double(), degree, released=True)
    ours = torch.einsum("ikl,icl->ick", turn, file[f"deg{degree}/sh"].double())
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(100, 3, generator=generator).double(), dim=-1)
    colors = ours @ sh_basis(directions, degree).T
    published = file[f"f64/deg{degree}/out_float64"] @ sh_basis(directions[:, [2, 0, 1]], degree).T
    assert_close_relative_to_max(colors, published, "sh_golden")
