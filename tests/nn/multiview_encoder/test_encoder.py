"""The encoder on ragged clouds, masks and odd cameras; its independence of neighbours and order; its errors."""

import dataclasses
import math

import pytest
import torch
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from gsim3d.cameras import Frames
from gsim3d.compat.released_model import as_released
from gsim3d.errors import InputError, NumericalError
from gsim3d.math.rotations import quat_product, rotation_matrices, rotation_to_quat, unit_quats
from gsim3d.math.spherical_harmonics import rotate_harmonics
from gsim3d.nn.multiview_encoder import Encoder, EncoderConfig, pixel_rows
from gsim3d.nn.multiview_encoder.crops import Crops
from gsim3d.nn.multiview_encoder.depth import CostVolume, DepthPredictor, Views, upsampling_matrix
from gsim3d.nn.multiview_encoder.heads import ParticleHeads, PixelRays
from gsim3d.nn.multiview_encoder.transformer import MultiViewTransformer
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.nn.multiview_encoder.scenes import CONFIG, ROW_FIELDS, SIZE, image_rows, make_encoder, make_frames, select

PUBLISHED_COUNTS = [11_226_070, 11_132_118, 11_197_285]


@pytest.mark.parametrize("n_views", [1, 2, 3, 5])
def test_any_number_of_views(n_views):
    particles = make_encoder()(make_frames([0] * n_views))
    n = n_views * SIZE**2
    assert particles.means.shape == (n, 3) and particles.opacities.shape == (n,)
    assert particles.dynamic_latents.shape == (n, 3) and particles.static_latents.shape == (n, 2)
    assert particles.cu_rows.tolist() == [0, n] and particles.activity.dtype == torch.uint8
    assert all(getattr(particles, name).isfinite().all() for name in ROW_FIELDS)


def test_latents_within_a_limit():
    """Longer ones keep their direction; the others keep their bits; zeros have a gradient."""
    free, limited = make_encoder(), make_encoder(latent_limit=0.4)
    limited.load_state_dict(free.state_dict())
    latents, scaled = free(make_frames([0, 0])).latents, limited(make_frames([0, 0])).latents
    size = latents.square().mean(1).sqrt()
    assert 0.05 < (size > 0.4).float().mean() < 0.95
    assert_same_bits(scaled[size < 0.4], latents[size < 0.4])
    assert_close_relative_to_max(scaled, latents * (0.4 / size).clamp_max(1)[:, None], 1e-6)
    for module in (limited.heads.to_latents.weight, limited.heads.to_latents.bias):
        torch.nn.init.zeros_(module)
    limited(make_frames([0, 0])).latents.sum().backward()
    assert limited.heads.to_latents.bias.grad.abs().min() > 0
    with pytest.raises(InputError, match="latent_limit must be at least"):
        EncoderConfig(latent_limit=0.0)


def test_particles_lie_on_the_rays_of_their_pixels_between_near_and_far():
    """The principal point is far from the centre, so an encoder that ignores it fails."""
    frames = make_frames([0, 0, 0])
    frames = dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, Ks=frames.cameras.Ks.clone()))
    frames.cameras.Ks[:, 0, 2] += 5
    particles = make_encoder()(frames)
    means = particles.means.double().unflatten(0, (3, -1))
    cameras = frames.cameras
    in_camera = means @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
    pixels = in_camera @ cameras.Ks.mT
    pixels = pixels[..., :2] / pixels[..., 2:]
    v, u = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    assert (pixels - torch.stack([u, v], -1).flatten(0, 1)).abs().max() <= 0.5 + 1e-4
    assert in_camera[..., 2].min() >= 1.5 - 1e-4 and in_camera[..., 2].max() <= 6 + 1e-4


def test_shifted_crop_is_a_shifted_principal_point():
    """Cropping a feature map by whole feature pixels and shifting the principal point sees the same world."""
    K = make_frames([0]).cameras.Ks
    cropped = K.clone()
    cropped[:, 0, 2] -= 8
    point = torch.tensor([0.3, 0.2, 2.0], dtype=torch.float64)
    full, crop = (CostVolume(EncoderConfig()).feature_intrinsics(k)[0] @ point for k in (K, cropped))
    assert torch.allclose(full[:2] / full[2] - crop[:2] / crop[2], torch.tensor([2.0, 0.0], dtype=torch.float64))


def test_feature_pixels_are_where_strided_convolutions_look():
    """Image index 4 i and feature index i are the same direction."""
    K = make_frames([0]).cameras.Ks
    ray = torch.linalg.inv(K[0]) @ torch.tensor([4 * 2 + 0.5, 4 * 3 + 0.5, 1], dtype=torch.float64)
    pixel = CostVolume(EncoderConfig()).feature_intrinsics(K)[0] @ ray
    assert torch.allclose(pixel[:2] / pixel[2], torch.tensor([2.5, 3.5], dtype=torch.float64))
    encoder = make_encoder(transformer_layers=0)
    image = torch.zeros(1, 3, SIZE, SIZE)
    weight = torch.zeros_like(encoder.cnn.conv1.weight)
    weight[:, :, 3, 3] = 1
    image[0, :, 8, 4] = 1  # row 8, column 4
    seen = torch.nn.functional.conv2d(image, weight, stride=2, padding=3)[0, 0]
    assert seen[4, 2] == 3 and seen.sum() == 3


def test_views_of_one_count_or_another_in_one_call():
    """Ragged clouds, interleaved images and a cloud without any: each cloud as if encoded alone."""
    frames = make_frames([2, 0, 2, 3, 2, 0], n_clouds=4)
    encoder = make_encoder()
    particles = encoder(frames)
    pixels = SIZE**2
    assert particles.cu_rows.tolist() == [0, 2 * pixels, 2 * pixels, 5 * pixels, 6 * pixels]
    for images, first in (([1, 5], 0), ([0, 2, 4], 2), ([3], 5)):
        alone = encoder(select(frames, images, [0] * len(images)))
        for name in ROW_FIELDS:
            rows = getattr(particles, name)[first * pixels : (first + len(images)) * pixels]
            assert_close_relative_to_max(rows, getattr(alone, name), "encoder_order", name)


def test_cloud_does_not_change_its_neighbours():
    frames = make_frames([0, 0, 1, 1, 2])
    encoder = make_encoder()
    before = encoder(frames)
    other = frames.images.clone()
    other[2:4] = torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(9))
    after = encoder(dataclasses.replace(frames, images=other))
    for image in (0, 1, 4):
        for a, b in zip(image_rows(before, image), image_rows(after, image), strict=True):
            assert_same_bits(a, b)
    assert not torch.equal(before.means, after.means)


def test_permuted_views_permute_particles():
    frames = make_frames([0, 0, 0])
    encoder = make_encoder()
    before, after = encoder(frames), encoder(select(frames, [2, 0, 1], [0, 0, 0]))
    for new, old in enumerate([2, 0, 1]):
        for a, b in zip(image_rows(after, new), image_rows(before, old), strict=True):
            assert_close_relative_to_max(a, b, "encoder_order")


def test_moved_scene_gives_moved_particles():
    """Cameras and origin move along; features do not notice."""
    frames = make_frames([0, 0, 0])
    shift = torch.tensor([4.0, -3.0, 2.0], dtype=torch.float64)
    moved = frames.cameras.viewmats.clone()
    moved[:, :3, 3] -= moved[:, :3, :3] @ shift
    there = dataclasses.replace(
        frames, cameras=dataclasses.replace(frames.cameras, viewmats=moved), origin=frames.origin + shift
    )
    encoder = make_encoder()
    before, after = encoder(frames), encoder(there)
    assert_close_relative_to_max(after.means - shift.float(), before.means, "encoder_order")
    for name in ROW_FIELDS[1:]:
        assert_close_relative_to_max(getattr(after, name), getattr(before, name), "encoder_order", name)


def test_masks_drop_pixels_and_dynamic_sets_activity():
    frames = make_frames([0, 1, 0])
    generator = torch.Generator().manual_seed(3)
    masks = torch.rand(3, SIZE, SIZE, generator=generator) > 0.5
    masks[1] = False
    dynamic = torch.rand(3, SIZE, SIZE, generator=generator) > 0.5
    encoder = make_encoder()
    everything = encoder(frames)
    particles = encoder(dataclasses.replace(frames, masks=masks, dynamic=dynamic))
    order = [0, 2, 1]
    kept = masks[order].flatten()
    n = int(kept.sum())
    assert particles.cu_rows.tolist() == [0, n, n]
    for name in ROW_FIELDS:
        assert_same_bits(getattr(particles, name), getattr(everything, name)[kept])
    expected = torch.where(dynamic[order].flatten()[kept], DYNAMIC, FROZEN)
    assert torch.equal(particles.activity.long(), expected)
    assert everything.activity.eq(DYNAMIC).all()


def test_particles_of_small_masks_have_the_bits_of_whole_images():
    frames, masks = make_frames([0, 0, 1], size=40), torch.zeros(3, 40, 40, dtype=torch.bool)
    masks[0, 20, 3], masks[1, :9, -7:], masks[1, 11, 32] = True, True, True
    encoder = make_encoder()
    everything, particles = encoder(frames), encoder(dataclasses.replace(frames, masks=masks))
    for name in ROW_FIELDS:
        assert_same_bits(getattr(particles, name), getattr(everything, name)[masks.flatten()])
    crops = Crops.around(masks)
    assert crops.size == (24, 24) and torch.equal(crops.cut(masks).sum((1, 2)), masks.sum((1, 2)))


@pytest.mark.parametrize("n_views", [1, 2, 3])
def test_patches_on_the_cpu_are_windows_with_masks(n_views, monkeypatch):
    torch.manual_seed(0)
    transformer, results = MultiViewTransformer(CONFIG).double(), []
    x = torch.randn(2, n_views, CONFIG.feature_dim, 8, 12, dtype=torch.float64, requires_grad=True)
    for by_label in (False, True):
        monkeypatch.setattr(MultiViewTransformer, "masks_by_label", by_label)
        y = transformer(x)
        results.append((y, torch.autograd.grad(y.square().sum(), x)[0]))
    for masked, patched in zip(*results, strict=True):
        assert_close_relative_to_max(patched, masked, 1e-9)


def test_gradients_are_finite_and_reach_every_parameter():
    frames = make_frames([0, 0, 1])
    frames.images.requires_grad_()
    encoder = make_encoder()
    particles = encoder(frames)
    generator = torch.Generator().manual_seed(0)
    fields = [getattr(particles, name) for name in ROW_FIELDS]
    sum((x * torch.randn(x.shape, generator=generator)).sum() for x in fields).backward()
    assert frames.images.grad.isfinite().all() and frames.images.grad.abs().max() > 0
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_training_twice_gives_the_same_bits():
    def train() -> list[torch.Tensor]:
        encoder, frames = make_encoder(), make_frames([0, 0, 0])
        optimizer = torch.optim.Adam(encoder.parameters(), 1e-3)
        for _ in range(3):
            optimizer.zero_grad()
            particles = encoder(frames)
            (particles.means.square().mean() + particles.dynamic_latents.square().mean()).backward()
            optimizer.step()
        return list(encoder.parameters())

    for a, b in zip(train(), train(), strict=True):
        assert_same_bits(a, b)


@pytest.mark.parametrize("asked", [False, True])
def test_tf32_is_used_only_where_matrix_products_use_it(asked):
    products, convolutions = torch.backends.cuda.matmul, torch.backends.cudnn.conv
    encoder, seen = make_encoder(), []
    encoder.cnn.conv1.register_forward_pre_hook(lambda *_: seen.append(convolutions.fp32_precision))
    before = products.allow_tf32
    products.allow_tf32 = asked
    try:
        encoder(make_frames([0, 0]))
    finally:
        products.allow_tf32 = before
    assert [precision == "tf32" for precision in seen] == [asked]
    assert convolutions.fp32_precision == "tf32" and torch.backends.cudnn.allow_tf32


def test_untrained_depth_is_near_the_middle_of_disparity_with_translucent_particles():
    torch.manual_seed(0)
    frames = make_frames([0, 0, 0])
    particles = Encoder(EncoderConfig.tiny())(frames)
    viewmats = frames.cameras.viewmats.float()
    depth = torch.einsum("ib,inb->in", viewmats[:, 2, :3], particles.means.unflatten(0, (3, -1))) + viewmats[:, 2, 3:]
    disparity = 1 / depth
    middle, span = (1 / 1.5 + 1 / 6) / 2, 1 / 1.5 - 1 / 6
    assert (disparity - middle).abs().mean() < 0.2 * span
    assert (particles.opacities - 0.5).abs().max() < 0.1


@pytest.mark.parametrize("poses", ["equal", "apart"])
def test_degenerate_cameras(poses):
    """Zero baseline and views without overlap: finite values and gradients."""
    frames = make_frames([0, 0])
    viewmats = frames.cameras.viewmats.clone()
    viewmats[1] = viewmats[0]
    if poses == "apart":
        viewmats[1, :3] *= torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)[:, None]  # looks the other way
    frames = dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, viewmats=viewmats))
    frames.images.requires_grad_()
    encoder = make_encoder()
    particles = encoder(frames)
    particles.means.sum().backward()
    assert particles.means.isfinite().all() and frames.images.grad.isfinite().all()


def test_constant_images():
    frames = make_frames([0, 0])
    frames = dataclasses.replace(frames, images=torch.ones_like(frames.images).requires_grad_())
    particles = make_encoder()(frames)
    (particles.means.sum() + particles.dynamic_latents.sum()).backward()
    assert particles.means.isfinite().all() and frames.images.grad.isfinite().all()


@pytest.mark.parametrize("factor, aligned", [(2, False), (4, False), (4, True)])
def test_upsampling(factor, aligned):
    x = torch.rand(2, 3, 5, 7, generator=torch.Generator().manual_seed(0))
    depth = DepthPredictor(EncoderConfig(downscale_factor=factor))
    depth = as_released(depth) if aligned else depth
    ours = depth.upsample(x)
    if aligned:
        expected = torch.nn.functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=True)
        assert_close_relative_to_max(ours, expected, 1e-5)
    else:
        assert torch.allclose(ours[..., ::factor, ::factor], x)
    assert torch.allclose(upsampling_matrix(5, factor, depth.upsampling_stride(5), x).sum(1), torch.ones(5 * factor))


def test_sizes_of_the_paper():
    """Parameters of the published encoders: latents of 64 and 64, of 32 and 32 channels, and the explicit variant."""
    with torch.device("meta"):
        sizes = [
            EncoderConfig(dynamic_dim=64, static_dim=64),
            EncoderConfig(),
            EncoderConfig(explicit=True, dynamic_dim=0, static_dim=0),
        ]
        counts = [sum(p.numel() for p in Encoder(size).parameters()) for size in sizes]
    assert counts == PUBLISHED_COUNTS


@pytest.mark.parametrize("prepare", [lambda encoder: encoder, as_released], ids=["", "released"])
def test_explicit_variant(prepare):
    frames = make_frames([0, 0])
    particles = prepare(make_encoder(explicit=True, dynamic_dim=0, static_dim=0))(frames)
    n = 2 * SIZE**2
    assert particles.quats.shape == (n, 4) and particles.scales.shape == (n, 3) and particles.sh.shape == (n, 16, 3)
    assert particles.dynamic_latents.shape == (n, 0)
    assert torch.allclose(particles.quats.norm(dim=-1), torch.ones(n), atol=1e-5) and particles.scales.min() > 0


def test_explicit_particles_are_float32_under_autocast():
    encoder = make_encoder(explicit=True, dynamic_dim=0, static_dim=0)
    with torch.autocast("cpu", torch.bfloat16):
        particles = encoder(make_frames([0, 0]))
    assert {value.dtype for value in (particles.quats, particles.scales, particles.sh)} == {torch.float32}


def rotations(n: int) -> torch.Tensor:
    q, _ = torch.linalg.qr(torch.randn(n, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    return q * torch.linalg.det(q)[:, None, None]


def test_explicit_particles_turn_with_the_scene():
    """Cameras turn with the scene about the world's origin: so do places, orientations and colours."""
    frames, turn = make_frames([0, 0]), rotations(1)[0]
    viewmats = frames.cameras.viewmats.clone()
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ turn.T
    turned = dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, viewmats=viewmats))
    encoder = make_encoder(explicit=True, dynamic_dim=0, static_dim=0)
    here, there = encoder(frames), encoder(turned)
    turn = turn.float()
    assert_close_relative_to_max(there.means, here.means @ turn.T, "encoder_order")
    assert_close_relative_to_max(there.scales, here.scales, "encoder_order")
    axes = [rotation_matrices(unit_quats(particles.quats)) for particles in (here, there)]
    assert_close_relative_to_max(axes[1], turn @ axes[0], "encoder_order")
    colors = rotate_harmonics(here.sh, turn.expand(len(here.sh), 3, 3))
    assert_close_relative_to_max(there.sh[:, 1:], colors[:, 1:], "encoder_order")


def test_quaternions_of_rotations():
    R = torch.cat([rotations(30), torch.diag_embed(torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1]]).double())])
    q = rotation_to_quat(R)
    x = torch.randn(3, dtype=torch.float64)
    pure = torch.cat([x.new_zeros(1), x]).expand(len(q), 4)
    conjugate = q * torch.tensor([1.0, -1, -1, -1], dtype=torch.float64)
    assert torch.allclose(quat_product(quat_product(q, pure), conjugate)[:, 1:], R @ x)


def test_explicit_quaternions_are_those_that_a_matrix_gives():
    """Published: (x, y, z, w) -> matrix, turned into the world, -> quaternion from its largest component, positive."""
    config = EncoderConfig(explicit=True, dynamic_dim=0, static_dim=0, sh_degree=0)
    generator = torch.Generator().manual_seed(0)
    raw = torch.randn(3, 10, 5, 4, generator=generator, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, :3, :3] = rotations(3)
    Ks = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
    rays = PixelRays.of(Views(raw, Ks, torch.linalg.inv(poses), torch.ones(3), torch.ones(3), 3))
    quats = ParticleHeads(config).explicit_gaussians(raw, torch.ones(3, 1, 5, 4).double(), rays)["quats"]
    x, y, z, w = F.normalize(raw[:, 3:7].flatten(2).transpose(1, 2), dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    in_camera = torch.stack([torch.stack(row, -1) for row in rows], -2)
    expected = rotation_to_quat(poses[:, None, :3, :3] @ in_camera)
    largest = expected.gather(-1, expected.abs().argmax(-1, keepdim=True))
    assert (largest > 0).all() and (expected[..., 0] < 0).any()
    torch.testing.assert_close(quats, expected, rtol=0, atol=1e-12)


def replace_cameras(frames: Frames, **changes) -> Frames:
    return dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, **changes))


def broken(frames: Frames, name: str) -> Frames:
    """Frames with one fault."""
    poses, Ks = frames.cameras.viewmats.clone(), frames.cameras.Ks
    poses[1, 0, 0] = math.nan
    images = frames.images.clone()
    images[1, 0, 2, 3] = math.inf
    faults = {
        "channels": lambda: dataclasses.replace(frames, images=frames.images[:, :2]),
        "size": lambda: dataclasses.replace(frames, images=frames.images[..., :12]),
        "camera size": lambda: replace_cameras(frames, width=SIZE * 2),
        "cameras": lambda: replace_cameras(frames, Ks=Ks[:1]),
        "cloud": lambda: replace_cameras(frames, image_cloud=torch.tensor([0, 5])),
        "mask": lambda: dataclasses.replace(frames, masks=torch.ones(2, SIZE, SIZE)),
        "pose": lambda: replace_cameras(frames, viewmats=poses),
        "image": lambda: dataclasses.replace(frames, images=images),
        "near": lambda: replace_cameras(frames, near=torch.tensor([1.0, 0.0])),
        "far": lambda: replace_cameras(frames, far=torch.tensor([6.0, 1.0])),
    }
    return faults[name]()


@pytest.mark.parametrize(
    "fault, error, message",
    [
        ("channels", InputError, r"images must be \[I, 3, H, W\]"),
        ("size", InputError, "multiples of 8"),
        ("camera size", InputError, "cameras are 16 x 32 pixels, images 16 x 16"),
        ("cameras", InputError, r"cameras.Ks must be \[2, 3, 3\]"),
        ("cloud", InputError, r"image_cloud must be in \[0, 1\)"),
        ("mask", InputError, "masks must be bool"),
        ("pose", NumericalError, r"cameras.viewmats must be finite; image 1 \(scene 0, step 0\)"),
        ("image", NumericalError, r"images must be finite; image 1"),
        ("near", NumericalError, "cameras.near must be positive; image 1"),
        ("far", NumericalError, "cameras.far must be finite and larger than near; image 1"),
    ],
)
def test_errors_name_what_is_wrong(fault, error, message):
    with pytest.raises(error, match=message):
        make_encoder()(broken(make_frames([0, 0]), fault))


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"downscale_factor": 3}, "downscale_factor"),
        ({"feature_dim": 6}, "feature_dim"),
        ({"n_depths": 1}, "n_depths"),
        ({"cost_unet_dim": 12}, "cost_unet_dim"),
        ({"refine_unet_dim": 48}, "refine_unet_dim"),
    ],
)
def test_config_errors(changes, message):
    with pytest.raises(InputError, match=message):
        EncoderConfig(**changes)


def test_static_shapes_hold_the_particles_of_their_clouds():
    """Other images and cameras than those that the shapes was made of; two clouds of two views."""
    encoder, frames = make_encoder(), make_frames([0, 0, 1, 1])
    chance = torch.rand(frames.images[:, :2].shape, generator=torch.Generator().manual_seed(3))
    share = torch.tensor([0.3, 0.3, 0.5, 0.5])[:, None, None]
    frames = dataclasses.replace(frames, masks=chance[:, 0] < share, dynamic=chance[:, 1] < 0.5)
    shapes = encoder.static_shapes(make_frames([0, 0, 1, 1], seed=5), 300)
    cameras = dataclasses.replace(frames.cameras, near=frames.cameras.near * 1.1)
    frames = dataclasses.replace(frames, cameras=cameras)
    shapes.copy_(encoder.static_shapes(frames, 300))
    whole, placed = encoder(frames), encoder(frames, shapes)
    counts = whole.cu_rows.diff().tolist()
    assert placed.clouds.starts == (0, 300, 600) and 0 < min(counts) < max(counts) < 300
    rows = torch.cat([torch.arange(counts[0]), 300 + torch.arange(counts[1])])
    others = torch.ones(600, dtype=torch.bool).index_fill(0, rows, False)
    for name in (*ROW_FIELDS, "activity"):
        assert torch.equal(getattr(placed, name)[rows], getattr(whole, name)), name
    assert placed.activity[others].eq(ASLEEP).all() and placed.opacities[others].eq(0).all()
    assert torch.equal(pixel_rows(frames, frames.dynamic, shapes)[rows], pixel_rows(frames, frames.dynamic))
    weight = torch.randn(whole.means.shape, generator=torch.Generator().manual_seed(4))
    parameters = list(encoder.parameters())
    expected = torch.autograd.grad((whole.means * weight).sum(), parameters, allow_unused=True)
    actual = torch.autograd.grad((placed.means[rows] * weight).sum(), parameters, allow_unused=True)
    for a, b in zip(actual, expected, strict=True):
        assert (a is None) == (b is None)
        assert a is None or torch.equal(a, b)
    few = encoder(frames, encoder.static_shapes(frames, 100))  # what has no room is left out
    assert torch.equal(few.means[:100], whole.means[:100]) and few.activity.ne(ASLEEP).all()


def test_static_shapes_need_equal_views_in_order():
    for clouds in ([0, 0, 1], [1, 0]):
        with pytest.raises(InputError, match="image_cloud"):
            make_encoder().static_shapes(make_frames(clouds), 100)


class Calls(TorchDispatchMode):
    """Names of all operators that are called, of backward passes too."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        self.names.add(function.overloadpacket.__name__)
        return function(*arguments, **(options or {}))


@pytest.mark.parametrize("by_label", [False, True])
@pytest.mark.parametrize("explicit", [False, True])
def test_static_shapes_do_not_wait_for_the_device(explicit, by_label, monkeypatch):
    """Nor is anything sent there: operators that read numbers or make tensors of them are not called."""
    monkeypatch.setattr(MultiViewTransformer, "masks_by_label", by_label)  # False: as on a GPU
    encoder, frames = make_encoder(explicit=explicit), make_frames([0, 0, 1, 1])
    frames = dataclasses.replace(frames, masks=frames.images[:, 0] < 0.4, dynamic=frames.images[:, 1] < 0.5)
    shapes = encoder.static_shapes(frames, 250)
    encoder(frames, shapes)  # makes constants
    waiting = {"_local_scalar_dense", "item", "equal", "nonzero", "_unique2", "masked_select", "lift_fresh"}
    waiting |= {"linalg_inv_ex", "_linalg_check_errors", "is_nonzero", "repeat_interleave"}
    waiting -= {"lift_fresh"} if explicit else set()  # a number written into a slice, which a GPU fills

    def names(*arguments):
        with Calls() as calls:
            particles = encoder(frames, *arguments)
            loss = sum(getattr(particles, name).square().sum() for name in ROW_FIELDS)
            torch.autograd.grad(loss, list(encoder.parameters()), allow_unused=True)
        return calls.names & waiting

    assert not names(shapes)
    assert {"_local_scalar_dense", "nonzero", "linalg_inv_ex"} <= names()
