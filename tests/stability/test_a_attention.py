"""Hard cases of attention and of precision."""

import dataclasses

import pytest
import torch

from gsim3d import ops
from gsim3d.compat.released_model import ReleasedAttention, as_released
from gsim3d.errors import NumericalError
from gsim3d.nn.layers import RowBatchNorm, RowLayerNorm
from gsim3d.nn.multiview_encoder.heads import PixelRays
from gsim3d.nn.point_transformer import Attention
from gsim3d.ops._arguments import LARGEST
from tests.asserts import gradients
from tests.dynamics.scenes import TINY, batch, make_history
from tests.nn.multiview_encoder.scenes import SIZE, make_encoder, make_frames
from tests.ops.raster_scene import random_scene
from tests.ops.test_patch_attn import RAGGED, Case, cotangent_of, offsets, random_case
from tests.oracle import row_norm as norm_oracle
from tests.stability.setting import NAMES, Setting
from tests.stability.steps import check_step, ordinary, simulate

MANY = 100_000


def check_attention(setting, measured, case: Case, bound: str = "attention") -> None:
    """Forward and backward against a dense softmax in float64; ``case`` is float32."""
    here = case.to(setting.dtype).to(setting.device)
    cotangent = cotangent_of(case).float()
    actual = gradients(here.attend, here.inputs, cotangent)
    expected = gradients(case.attend_oracle, [x.double() for x in case.inputs], cotangent)
    measured.finite(*actual)
    for name, a, e in zip(("result", "grad q", "grad k", "grad v"), actual, expected, strict=True):
        measured.close(a, e, f"{bound}_{setting.precision}", name)


@pytest.mark.parametrize("scale", [None, 1.0])
def test_a25_logits_beyond_half_precision(setting, measured, scale):
    """Dot products up to a million: whole numbers of few bits, so that every precision has the same ones."""
    case = random_case(dtype=torch.float32, scale=scale)
    g = torch.Generator().manual_seed(2)
    q, k = (32.0 * torch.randint(-8, 9, x.shape, generator=g) for x in (case.q, case.k))
    assert (q.flatten(1) @ k.flatten(1).T).abs().max() > 65504
    check_attention(setting, measured, dataclasses.replace(case, q=q, k=k), "attention_huge")


def large_queries(dynamics):
    for name, parameter in dynamics.named_parameters():
        if "qkv" in name:
            parameter.data.mul_(1e6)


@pytest.mark.parametrize("setting", NAMES[:2], indirect=True)
@pytest.mark.parametrize("name", ["q", "k", "v"])
def test_a25_numbers_beyond_the_range_are_refused(setting, measured, name):
    """On the CPU; on a GPU nothing waits for a look at numbers."""
    case = random_case(dtype=setting.dtype)
    values = getattr(case, name).clone()
    values[5] = 2 * LARGEST[setting.dtype]
    with pytest.raises(NumericalError, match="must be finite and at most") as caught:
        dataclasses.replace(case, **{name: values}).attend()
    assert (caught.value.tensor, caught.value.row) == (name, 5)
    measured.outcome("NumericalError names tensor and row")


ROUNDED = pytest.mark.parametrize("rounded", [False, True], ids=["", "half"])


def check_huge_network(setting, measured, rounded) -> None:
    def prepare(dynamics):
        large_queries(dynamics)
        for module in dynamics.modules():
            if rounded and isinstance(module, Attention):
                as_released(module)

    histories = make_history((30, 20)), ordinary(TINY)
    step = simulate(setting, batch(histories), prepare=prepare)
    measured.finite(*step.tensors)
    alone = simulate(setting, histories[1], prepare=prepare)
    measured.finite(*alone.tensors)
    for name, value in alone.fields.items():
        measured.unchanged(setting, step.fields[name][20:], value, name)


@ROUNDED
def test_a25_a_network_with_such_logits(setting, measured, rounded):
    check_huge_network(setting, measured, rounded)


@ROUNDED
@pytest.mark.parametrize("setting", NAMES[1:2], indirect=True)
def test_a25_a_network_with_such_logits_under_autocast_on_the_cpu(setting, measured, rounded):
    half = Setting(setting.device, "bf16")
    with half.computing():
        check_huge_network(half, measured, rounded)


def test_a25_gradients_beyond_half_precision(setting, measured):
    """Where attention imitates half precision: its gradients keep their range, and digits."""
    torch.manual_seed(0)
    attention = setting.to(ReleasedAttention(32, 2))
    x, cotangent = setting.to(torch.randn(16, 32)), setting.to(torch.randn(16, 32))
    rows, whole = (torch.tensor(values, device=setting.device) for values in (range(16), (0, 16)))
    table = ops.PatchTable(rows, rows, whole, whole)
    grads, small = (
        torch.autograd.grad((f * cotangent * attention(x, table)).sum(), attention.qkv.weight)[0] for f in (2.0**30, 1)
    )
    measured.finite(grads)
    measured.same_bits(grads, 2.0**30 * small, "gradient of the weights")


@pytest.mark.parametrize("sizes", [RAGGED, ((0, 0),), ((0, 3), (3, 0), (1, 1)), ((5, 16), (16, 16), (16, 16))])
def test_a26_empty_short_and_borrowing_patches(setting, measured, sizes):
    check_attention(setting, measured, random_case(sizes, dtype=torch.float32))


@pytest.mark.parametrize("n_rows", [1, 15, 16, 17, 37])
def test_a26_the_last_patch_borrows_rows_and_counts_each_once(setting, measured, n_rows):
    """The tables of a cloud: every row asks once, the last patch reads the last 16 rows."""
    history = make_history((n_rows,))
    origin, zero = history.origin.to(setting.device), torch.zeros(1, dtype=torch.int64, device=setting.device)
    spec = TINY.pyramid_spec(2)
    arguments = setting.to(history.means), history.cu_rows.to(setting.device), zero, zero, origin, spec
    table = ops.build_pyramid(*arguments).stages[0].patches[2]
    assert table.q_rows.sort().values.tolist() == list(range(n_rows))
    assert table.cu_k.diff().tolist() == [min(16, n_rows)] * (-(-n_rows // 16))
    last = table.kv_rows[int(table.cu_k[-2]) :].tolist()
    assert last == table.q_rows[-min(16, n_rows) :].tolist() and len(set(last)) == len(last)
    case = random_case(((n_rows, n_rows),), n_keys=n_rows, spare=0, dtype=torch.float32)
    check_attention(setting, measured, dataclasses.replace(case, table=dataclasses.replace(table, **on_cpu(table))))


def on_cpu(table) -> dict:
    return {name: value.cpu() for name, value in vars(table).items()}


def test_a27_means_of_100_000_rows(setting, measured):
    """Values around 1: sums that are kept in 16 bits stand still at 256, in 24 bits they lose three digits."""
    x = 1 + 0.1 * torch.randn(MANY, 8, generator=torch.Generator().manual_seed(0))
    rows, cu_rows = (t.to(setting.device) for t in (torch.arange(MANY), torch.tensor([0, MANY])))
    mean, grad = gradients(lambda t: ops.pool_mean(t, rows, cu_rows), [setting.to(x)], torch.ones(1, 8))
    measured.finite(mean, grad)
    measured.close(mean, x.double().mean(0, keepdim=True), f"many_rows_{setting.exact}")
    measured.close(grad, torch.full_like(x, 1 / MANY, dtype=torch.float64), f"many_rows_{setting.exact}", "gradient")


def test_a27_weight_gradients_over_100_000_rows(setting, measured):
    """The sums over rows of sparse_conv's and row_norm's gradients; nothing cancels."""
    g = torch.Generator().manual_seed(0)
    x = 1 + 0.1 * torch.rand(MANY, 16, generator=g)
    rows, none = torch.arange(MANY, device=setting.device), torch.zeros(0, dtype=torch.int64, device=setting.device)
    voxels = ops.Voxels(rows, rows, torch.arange(MANY + 1, device=setting.device))
    kernel_map = ops.KernelMap(1, none, none, torch.zeros(2, dtype=torch.int64, device=setting.device))
    weight, bias = torch.eye(16).reshape(16, 1, 1, 1, 16), torch.zeros(16)
    cotangent = torch.ones(MANY, 16)
    inputs = [setting.to(t) for t in (x, weight, bias)]
    _, _, *grads = gradients(lambda *t: ops.sparse_conv(*t, voxels, kernel_map), inputs, cotangent)
    sums = x.double().sum(0)
    measured.finite(*grads)
    measured.close(grads[0].reshape(16, 16), sums.expand(16, 16), f"many_rows_{setting.precision}", "grad weight")
    measured.close(
        grads[1], torch.full((16,), float(MANY), dtype=torch.float64), f"many_rows_{setting.precision}", "bias"
    )
    scale, shift = torch.ones(16), torch.zeros(16)
    few = x[:1000]
    ours = gradients(ops.row_norm, [setting.to(t) for t in (few.repeat(100, 1), scale, shift)], few.repeat(100, 1))
    theirs = gradients(norm_oracle.row_norm, [t.double() for t in (few, scale, shift)], few)
    for name, a, e in zip(("weight", "bias"), ours[2:], theirs[2:], strict=True):
        measured.close(a, 100 * e, f"norm_many_rows_{setting.precision}", f"row_norm grad {name}")


def test_a27_attention_over_100_000_keys(setting, measured):
    g = torch.Generator().manual_seed(0)
    q, k = (torch.randn(n, 1, 16, generator=g) for n in (8, MANY))
    table = ops.PatchTable(torch.arange(8), torch.arange(MANY), offsets([8]), offsets([MANY]))
    check_attention(setting, measured, Case(q, k, 1 + k, table, 0.25), "attention_many")


def test_a28_geometry_is_never_shortened(setting, measured):
    """Inverses, projections and the Gaussians' image are float32 or wider under TF32 and autocast."""
    frames = make_frames([0, 0])
    cameras = frames.cameras
    sources, cu = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    exact = ops.sweep_geometry(cameras.Ks, cameras.viewmats, sources, cu)
    arguments = setting.to(cameras.Ks), setting.to(cameras.viewmats), sources.to(setting.device), cu.to(setting.device)
    for a, e in zip(ops.sweep_geometry(*arguments), exact, strict=True):
        measured.close(a, e, f"geometry_{setting.exact}", "sweep_geometry")
    scene = random_scene(n=20, clouds=1, images=1, width=20, height=18, dtype=torch.float32)
    expected = scene.to(torch.float64).render_oracle()
    for a, e in zip(setting.to(scene).render(), expected, strict=True):
        measured.close(a, e, f"raster_{setting.exact}", "image")


def narrow_frames(views: list[int]):
    """Cameras whose 16 pixels see a few centimetres: a place that is rounded to 16 bits lies in another pixel."""
    frames = make_frames(views)
    Ks = frames.cameras.Ks.clone()
    Ks[:, 0, 0] = Ks[:, 1, 1] = 900.0
    return dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, Ks=Ks))


def check_pixels(setting, measured, frames) -> None:
    """Every particle of an encoder lies in the pixel that it came from, and everything is as wide as the images."""
    encoder = setting.to(make_encoder())
    state = encoder(setting.to(frames))
    fields = [value for value in state.row_fields().values() if value.is_floating_point()]
    assert all(value.dtype == setting.dtype for value in fields)
    cameras = frames.cameras
    points = state.means.detach().double().cpu().reshape(len(cameras), -1, 3)
    rotation, translation = cameras.viewmats[:, :3, :3], cameras.viewmats[:, :3, 3]
    pixels = (points @ rotation.mT + translation[:, None]) @ cameras.Ks.mT
    v, u = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    centres = torch.stack([u, v], -1).reshape(-1, 2) + 0.5
    assert (pixels[..., :2] / pixels[..., 2:] - centres).abs().max() < 0.5
    torch.autograd.grad(state.means.sum(), list(encoder.parameters()), allow_unused=True)
    measured.finite(*fields)
    measured.outcome("particles in their pixels")


def test_a28_particles_lie_in_their_pixels(setting, measured):
    check_pixels(setting, measured, narrow_frames([0, 0]))


@pytest.mark.parametrize("setting", NAMES[1:2], indirect=True)
def test_a28_particles_lie_in_their_pixels_under_autocast_on_the_cpu(setting, measured):
    half = Setting(setting.device, "bf16")
    with half.computing():
        check_pixels(half, measured, narrow_frames([0, 0]))


def certain_depth(encoder):
    """Every depth as likely, nothing corrected: the mean disparity of the sweep, whatever the weights before it."""
    head, last = encoder.depth.cost_volume.head[2], encoder.depth.to_disparity[2]
    for parameter in (head.weight, head.bias, last.weight, last.bias):
        parameter.data.zero_()


def check_depth(setting, measured) -> None:
    frames = make_frames([0, 0])
    encoder = make_encoder()
    certain_depth(encoder)
    state = setting.to(encoder)(setting.to(frames))
    points = state.means.detach().double().cpu().reshape(2, -1, 3)
    depth = (points @ frames.cameras.viewmats[:, 2, :3, None])[..., 0] + frames.cameras.viewmats[:, 2, 3, None]
    mean = (1 / frames.cameras.near.double() + 1 / frames.cameras.far.double()) / 2
    measured.close(depth, (1 / mean)[:, None].expand_as(depth), f"geometry_{setting.exact}", "depth")


def test_a28_depth_keeps_its_digits(setting, measured):
    check_depth(setting, measured)


@pytest.mark.parametrize("setting", NAMES[1:2], indirect=True)
def test_a28_depth_keeps_its_digits_under_autocast_on_the_cpu(setting, measured):
    half = Setting(setting.device, "bf16")
    with half.computing():
        check_depth(half, measured)


def test_a28_inverse_calibration_is_float64(setting, measured):
    """A camera 10 km from zero is where it is to float64's digits, whatever the network computes in."""
    frames = make_frames([0, 0])
    viewmats = frames.cameras.viewmats.clone()
    viewmats[:, :3, 3] -= (viewmats[:, :3, :3] @ torch.full((3, 1), 1e4, dtype=torch.float64))[..., 0]
    moved = setting.to(dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, viewmats=viewmats)))
    rays = PixelRays.of(moved.cameras)
    expected = torch.linalg.inv(frames.cameras.viewmats)[:, :3, 3] + 1e4
    measured.close(rays.centers, expected, 1e-14, "centers")


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_a29_evaluation_ignores_batch_mates(setting, measured, norm):
    config = dataclasses.replace(TINY, norm=norm)
    histories = [make_history((20, 15)), make_history((1,), seed=4), ordinary()]
    large = dataclasses.replace(histories[1], dynamic_latents=1e4 * histories[1].dynamic_latents)

    def settle(dynamics):
        """Running statistics that differ from those of any batch."""
        for i, buffer in enumerate(dynamics.buffers()):
            buffer.data.copy_(0.5 + 0.1 * torch.arange(buffer.numel()) / buffer.numel() + 0.01 * i)

    check_step(setting, measured, histories[0], config, prepare=settle)
    together = simulate(setting, batch([histories[0], large, histories[2]]), config, prepare=settle)
    alone = simulate(setting, histories[0], config, prepare=settle)
    for name, value in alone.fields.items():
        measured.unchanged(setting, together.fields[name][: len(value)], value, name)


@pytest.mark.parametrize("make", [RowBatchNorm, RowLayerNorm], ids=["batch", "layer"])
@pytest.mark.parametrize("value, n_rows", [(0.0, 20), (1e4, 20), (1e-30, 20), (3.0, 1)])
def test_a29_rows_of_equal_values(setting, measured, make, value, n_rows):
    """No variance, in training too: the smallest denominator is a constant."""
    norm = setting.to(make(8)).train()
    x = torch.full((n_rows, 8), value, device=setting.device, dtype=setting.dtype, requires_grad=True)
    out = norm(x)
    (out * torch.linspace(-1, 1, 8, device=out.device)).sum().backward()
    measured.finite(out, x.grad, *norm.buffers())
