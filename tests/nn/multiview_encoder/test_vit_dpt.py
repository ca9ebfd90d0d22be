"""The encoder with a vision transformer: against formulas and torch, frozen parts, cameras, units, ragged clouds."""

import dataclasses

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from gsim3d.cameras import Frames
from gsim3d.errors import InputError
from gsim3d.nn.dpt import DPTHead
from gsim3d.nn.multiview_encoder import Encoder, EncoderConfig, pixel_rows
from gsim3d.nn.multiview_encoder.config import BACKBONES, ViTConfig
from gsim3d.nn.multiview_encoder.depth import Views
from gsim3d.nn.multiview_encoder.vit_depth import pose_code, relative_poses
from gsim3d.nn.resize import resize
from gsim3d.nn.vision_transformer import CameraEncoder, ViT
from tests import tiny_scenes
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.nn.multiview_encoder.scenes import CONFIG, ROW_FIELDS, SIZE, make_frames, select
from tests.oracle.vision_transformer import tokens_of

TINY = BACKBONES["tiny"]
ALONE = dataclasses.replace(TINY, mixes_from=None)
VIT = ViTConfig("tiny", image_size=28, feature_dim=5)


def randomized(module: torch.nn.Module) -> torch.nn.Module:
    """Random biases, norms and scales, so that all count."""
    generator = torch.Generator().manual_seed(1)
    for parameter in module.parameters():
        if parameter.dim() == 1:
            parameter.data.add_(torch.rand(parameter.shape, generator=generator).to(parameter) - 0.5)
    return module


def make_encoder(vit: ViTConfig = VIT, **changes) -> Encoder:
    torch.manual_seed(0)
    vit = dataclasses.replace(vit, **changes)
    return randomized(Encoder(dataclasses.replace(CONFIG, backbone="vit_dpt", vit=vit)))


def scaled(frames: Frames, factor: float) -> Frames:
    """The rig and its depth range, larger."""
    viewmats = frames.cameras.viewmats.clone()
    viewmats[:, :3, 3] *= factor
    bounds = {name: factor * getattr(frames.cameras, name) for name in ("near", "far")}
    cameras = dataclasses.replace(frames.cameras, viewmats=viewmats, **bounds)
    return dataclasses.replace(frames, cameras=cameras, origin=factor * frames.origin)


@pytest.mark.parametrize("config", [TINY, dataclasses.replace(TINY, mixes_from=2), ALONE], ids=["0", "2", "never"])
def test_tokens_are_those_of_the_formulas(config):
    torch.manual_seed(0)
    vit = randomized(ViT(config)).double()
    images, cameras = torch.randn(6, 3, 42, 28).double(), torch.randn(6, config.dim).double()
    cameras = None if config.mixes_from is None else cameras
    found = vit(images, 3, cameras)
    expected = tokens_of(vit.state_dict(), images, 3, cameras, config)
    assert_close_relative_to_max(found, expected, 1e-12)


def test_views_permute():
    torch.manual_seed(0)
    vit, images, cameras = (
        randomized(ViT(TINY)).double(),
        torch.randn(3, 3, 28, 28).double(),
        torch.randn(3, 64).double(),
    )
    order = torch.tensor([2, 0, 1])
    assert_close_relative_to_max(vit(images[order], 3, cameras[order]), vit(images, 3, cameras)[order], 1e-12)


@pytest.mark.parametrize("sizes", [((5, 4), (9, 13)), ((7, 6), (3, 6)), ((1, 2), (4, 8))])
def test_resized_as_torch_does(sizes):
    x = torch.rand(2, 3, *sizes[0], generator=torch.Generator().manual_seed(0)).double()
    for kind, options in {
        "corners": {"mode": "bilinear", "align_corners": True},
        "linear": {"mode": "bilinear", "antialias": True},
        "cubic": {"mode": "bicubic"},
    }.items():
        assert_close_relative_to_max(resize(x, sizes[1], kind), F.interpolate(x, sizes[1], **options), 1e-12, kind)


@pytest.mark.parametrize("config", [TINY, ALONE], ids=["mixed", "alone"])
def test_gradients_of_a_head(config):
    config = dataclasses.replace(config, dim=4, head_dim=8, head_channels=(4, 4, 4, 4))
    torch.manual_seed(0)
    head = DPTHead(config, 2).double()
    tokens = torch.randn(1, 4, 4, config.token_dim).double().requires_grad_()
    assert head(tokens, (2, 2), (20, 28)).shape == (1, 2, 20, 28)
    assert torch.autograd.gradcheck(lambda x: head(x, (2, 2), (4, 4)), tokens)


def test_gradients_of_a_backbone():
    config = dataclasses.replace(TINY, dim=16, heads=2, mlp_ratio=1)
    torch.manual_seed(0)
    vit, encoder = randomized(ViT(config)).double(), CameraEncoder(16, 1).double()
    images, code = torch.randn(2, 3, 14, 28).double(), torch.randn(1, 2, 9).double()
    leaves = [vit.pos_embed, vit.blocks[1].attn.qkv.weight, encoder.pose_branch.fc1.bias]
    direction = [torch.randn_like(leaf) for leaf in leaves]
    loss = lambda: vit(images, 2, encoder(code)[0]).sin().sum()  # noqa: E731
    found = sum((g * d).sum() for g, d in zip(torch.autograd.grad(loss(), leaves), direction, strict=True))
    values = []
    with torch.no_grad():
        for step in (1e-5, -2e-5):
            for leaf, d in zip(leaves, direction, strict=True):
                leaf += step * d
            values.append(loss())
    assert (values[0] - values[1]) / 2e-5 == pytest.approx(found.item(), rel=1e-6)


def test_compiles():
    torch.manual_seed(0)
    vit, head = ViT(TINY), DPTHead(TINY, 2)
    images = torch.randn(2, 3, 28, 28)

    def f(images):
        return head(vit(images, 2), (2, 2), (28, 28))

    assert_close_relative_to_max(torch.compile(f, fullgraph=True, backend="eager")(images), f(images), 1e-6)


def test_poses_do_not_depend_on_the_world():
    frames = make_frames([0, 0, 0])
    Ks, viewmats = frames.cameras.Ks, frames.cameras.viewmats
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3] = torch.tensor([[0.0, -1, 0, 2], [1, 0, 0, -3], [0, 0, 1, 4]])
    relative, unit = relative_poses(viewmats, 3)
    moved, same = relative_poses(viewmats @ turn, 3)
    assert torch.allclose(relative[0], torch.eye(4, dtype=torch.float64)) and torch.allclose(relative, moved)
    centers = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
    assert torch.allclose(unit, (centers - centers[0]).norm(dim=1).sort().values[1]) and torch.allclose(unit, same)
    assert relative_poses(viewmats[:2], 2)[1].tolist() == [0.1, 0.1]
    code = pose_code(relative, Ks, (SIZE, SIZE))
    assert torch.allclose(code[0, :7], torch.tensor([0, 0, 0, 0, 0, 0, 1.0]).double())
    assert torch.allclose(code[:, 8], 2 * torch.atan(SIZE / 2 / Ks[:, 0, 0]))


def test_views_of_one_count_or_another_in_one_call():
    frames = make_frames([2, 0, 2, 3, 2, 0], n_clouds=4)
    encoder = make_encoder(frozen="none")
    particles, pixels = encoder(frames), SIZE**2
    assert particles.cu_rows.tolist() == [0, 2 * pixels, 2 * pixels, 5 * pixels, 6 * pixels]
    for images, first in (([1, 5], 0), ([0, 2, 4], 2), ([3], 5)):
        alone = encoder(select(frames, images, [0] * len(images)))
        for name in ROW_FIELDS:
            rows = getattr(particles, name)[first * pixels : (first + len(images)) * pixels]
            assert_close_relative_to_max(rows, getattr(alone, name), "encoder_order", name)


@pytest.mark.parametrize("unit", ["range", "cameras"])
def test_a_larger_rig_gives_larger_depth(unit, monkeypatch):
    monkeypatch.setitem(BACKBONES, "tiny", dataclasses.replace(TINY, unit=unit))
    frames, encoder = make_frames([0, 0, 0]), make_encoder()
    before, after = encoder(frames), encoder(scaled(frames, 2.0))
    assert_close_relative_to_max(after.means, 2 * before.means, 1e-5)
    if unit == "range":  # near the middle before training
        depth = frames.cameras.viewmats[0, 2, :3].float() @ before.means[: SIZE**2].T + frames.cameras.viewmats[0, 2, 3]
        assert 1.5 - 1e-4 <= depth.min() and depth.max() <= 6 + 1e-4


def test_depth_comes_back_into_range():
    """An output beyond far has a gradient that brings it back, and none that takes it away."""
    encoder, frames = make_encoder(), make_frames([0])
    encoder.depth.log_scale.data.fill_(5.0)
    particles = encoder(frames)
    distance = (particles.means - frames.origin[0].float()).square().sum()
    back, away = (torch.autograd.grad(s * distance, encoder.depth.log_scale, retain_graph=True)[0] for s in (1, -1))
    assert back > 0 and away == 0 and particles.means.isfinite().all()


@pytest.mark.parametrize("frozen", ["none", "backbone", "depth"])
def test_frozen_parts_keep_their_weights(frozen):
    encoder, frames = make_encoder(frozen=frozen), make_frames([0, 0, 1])
    before = {name: value.clone() for name, value in encoder.state_dict().items()}
    optimizer = torch.optim.AdamW(encoder.parameters(), 1e-3, weight_decay=0.1)
    for _ in range(5):
        optimizer.zero_grad()
        particles = encoder(frames)
        sum(getattr(particles, name).square().mean() for name in ROW_FIELDS).backward()
        optimizer.step()
    kept = {name for name, value in encoder.state_dict().items() if torch.equal(value, before[name])}
    unused = {"depth.backbone.camera_token"}  # cameras are known
    parts = {"none": (), "backbone": ("depth.backbone.", "depth.camera_encoder.")}
    parts["depth"] = (*parts["backbone"], "depth.depth_head.")
    assert kept == unused | {name for name in before if name.startswith(parts[frozen])}


def test_features_of_a_frozen_backbone_can_be_kept():
    encoder, frames = make_encoder(), make_frames([1, 0, 1, 2, 2])
    features = torch.empty(5, 4, 4, TINY.token_dim)
    for rows in ([1], [0, 2], [3, 4]):
        features[rows] = encoder.backbone_features(select(frames, rows, [0] * len(rows)))
    computed = []
    encoder.depth.backbone.register_forward_hook(lambda *_: computed.append(1))
    with_kept = encoder(dataclasses.replace(frames, backbone_features=features))
    assert not computed
    for name in ROW_FIELDS:
        assert_same_bits(getattr(with_kept, name), getattr(encoder(frames), name), name)
    with pytest.raises(InputError, match=r"backbone_features must be \[1, 4, 4, 128\] on cpu .*got \[1, 4, 3"):
        encoder(dataclasses.replace(frames, backbone_features=features[:, :, :3]))
    with pytest.raises(InputError, match="needs backbone .vit_dpt. with vit.frozen"):
        make_encoder(frozen="none").backbone_features(frames)


def test_depth_is_learned():
    """Of a ground seen by three cameras: below an untrained plane sweep's error, and falling."""
    size, drawn, depths = 32, [], []
    views = [tiny_scenes.camera(cam, size) for cam in (0, 1, 3)]
    viewmats, Ks = (torch.tensor(np.stack(values)) for values in zip(*views, strict=True))
    for viewmat, K in views:
        rgb, labels = tiny_scenes.draw(viewmat, K, size, np.array([0, 0, 0.5]), 0.3, np.array([0.9, 0.2, 0.3]))
        drawn.append(torch.from_numpy(rgb).permute(2, 0, 1).float() / 255)
        y, x = np.mgrid[:size, :size] + 0.5
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ viewmat[:3, :3]
        height = -(viewmat[:3, :3].T @ viewmat[:3, 3])[2]
        depths.append(torch.from_numpy(np.where(labels == 1, -height / rays[..., 2], 0)))
    depth, images = torch.stack(depths)[:, None].float(), torch.stack(drawn)
    seen = depth > 0
    views = Views(images, Ks, viewmats, torch.full((3,), 1.2), torch.full((3,), 4.0), 3)

    def error(encoder: Encoder) -> torch.Tensor:
        return (encoder._depth(views).depth.log() - depth.clamp(min=0.1).log()).abs()[seen].mean()

    torch.manual_seed(0)
    start, encoder = error(Encoder(EncoderConfig.tiny())).item(), make_encoder(image_size=56, frozen="none")
    optimizer, errors = torch.optim.AdamW(encoder.parameters(), 2e-3), []
    for _ in range(40):
        optimizer.zero_grad()
        value = error(encoder)
        value.backward()
        optimizer.step()
        errors.append(value.item())
    assert errors[-1] < 0.5 * errors[0] and errors[-1] < 0.5 * start


def test_masks_strides_and_static_shapes():
    frames, encoder = make_frames([0, 0, 1, 1]), make_encoder()
    masks = torch.ones(4, SIZE, SIZE, dtype=torch.bool)
    masks[:, :3] = False
    frames = dataclasses.replace(frames, masks=masks, dynamic=~masks).subsample(2, 1)
    particles = encoder(frames)
    n = int(frames.masks[:2].sum())
    assert particles.cu_rows.tolist() == [0, n, 2 * n] and 0 < n < masks[:2].sum()
    shapes = encoder.static_shapes(frames, n + 3)
    padded = encoder(frames, shapes)
    rows = torch.cat([torch.arange(n), torch.arange(n) + n + 3])
    for name in ROW_FIELDS:
        assert_close_relative_to_max(getattr(padded, name)[rows], getattr(particles, name), 1e-5, name)
    assert pixel_rows(frames, frames.images[:, 0]).shape == (2 * n,)
    other = encoder.static_shapes(dataclasses.replace(scaled(frames, 2.0)), n + 3)
    shapes.copy_(other)
    assert all(torch.equal(a, b) for a, b in zip(shapes.geometry.tensors(), other.geometry.tensors(), strict=True))


def test_pixels_of_low_confidence_are_transparent():
    frames = make_frames([0, 0])
    encoder, seen = make_encoder(), []
    encoder.depth.depth_head.register_forward_hook(lambda _m, _i, output: seen.append(output[:, 1]))
    every = encoder(frames).opacities
    some = make_encoder(min_confidence=1 + seen[0].median().exp().item())(frames).opacities
    hidden = some < 1e-6
    assert 0 < hidden.sum() < hidden.numel() and every.min() > 1e-3
    assert torch.equal(some[~hidden], every[~hidden])


def test_bits_repeat_under_deterministic_algorithms():
    def train() -> list[torch.Tensor]:
        encoder, frames = make_encoder(frozen="none", image_size=42), make_frames([0, 0])
        particles = encoder(frames)
        (particles.means.square().mean() + particles.dynamic_latents.square().mean()).backward()
        return [parameter.grad for parameter in encoder.parameters() if parameter.grad is not None]

    torch.use_deterministic_algorithms(True)
    try:
        for a, b in zip(train(), train(), strict=True):
            assert_same_bits(a, b)
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"model": "dinov2_smal"}, "model must be one of .*did you mean dinov2_small"),
        ({"image_size": 0}, "image_size must be at least 1"),
        ({"model": "dinov2_small", "min_confidence": 2.0}, "min_confidence must be 1: dinov2_small predicts no"),
    ],
)
def test_wrong_settings_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(VIT, **changes)


def test_timm_is_asked_for():
    try:
        import timm  # noqa: F401
    except (ImportError, RuntimeError):
        with pytest.raises(InputError, match=r"vit_small_patch16_dinov3: needs timm .*pip install 'gsim3d\[timm\]'"):
            make_encoder(model="dinov3_small")
    else:
        particles = make_encoder(model="dinov3_small", image_size=32)(make_frames([0, 0]))
        assert particles.means.isfinite().all()
