"""plane_sweep against features warped with grid_sample."""

import math

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import plane_sweep, sweep_geometry
from tests.asserts import (
    assert_close_relative_to_max,
    assert_same_bits,
    assert_same_bits_for_any_threads,
    gradients,
)
from tests.oracle import plane_sweep as oracle

DTYPES = {torch.float32: "float32", torch.float64: "float64"}
# Sources of each image: none, one, several, the image itself.
RAGGED = ((1, 2), (), (3, 1, 0), (3,))


def rotation(axis: int, angle: float) -> torch.Tensor:
    i, j = [a for a in range(3) if a != axis]
    R = torch.eye(3, dtype=torch.float64)
    R[i, i] = R[j, j] = math.cos(angle)
    R[i, j], R[j, i] = -math.sin(angle), math.sin(angle)
    return R


def make(sources=RAGGED, *, channels=5, depths=11, size=(7, 9), dtype=torch.float64, seed=0):
    """(features, homographies, translations, inverse_depths, src_images, cu_src), cameras around a point 3 m ahead."""
    generator = torch.Generator().manual_seed(seed)
    n, (height, width) = len(sources), size
    Ks = torch.tensor([[1.1 * width, 0, 0.5 * width + 0.7], [0, 1.2 * width, 0.5 * height - 0.4], [0, 0, 1]]).double()
    Ks = Ks.repeat(n, 1, 1) * (1 + 0.1 * torch.rand(n, 1, 1, generator=generator).double())
    Ks[:, 2] = torch.tensor([0, 0, 1.0])
    viewmats = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    for i in range(n):
        viewmats[i, :3, :3] = rotation(1, 0.5 * i) @ rotation(2, 0.2 * i)
        viewmats[i, :3, 3] = torch.tensor([0.1 * i, 0.05 * i, 3])
    cu_src = torch.tensor([0, *(len(s) for s in sources)]).cumsum(0)
    src_images = torch.tensor([j for s in sources for j in s], dtype=torch.int64)
    geometry = sweep_geometry(Ks, viewmats, src_images, cu_src)
    features = torch.randn(n, channels, height, width, dtype=torch.float64, generator=generator)
    near = 1 / (1.2 + 0.2 * torch.arange(n).double())
    inverse_depths = 0.15 + torch.linspace(0, 1, depths, dtype=torch.float64) * (near[:, None] - 0.15)
    return [t.to(dtype) for t in (features, *geometry, inverse_depths)] + [src_images, cu_src]


def cotangent_of(arguments) -> torch.Tensor:
    features, inverse_depths = arguments[0], arguments[3]
    shape = (features.shape[0], inverse_depths.shape[1], *features.shape[2:])
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(7)).to(features.dtype)


def in_double(arguments):
    return [t.double() if t.is_floating_point() else t for t in arguments]


CASES = {
    "ragged": dict(),
    "one channel": dict(channels=1),
    "channels of whole vectors": dict(channels=64),
    "channels of a block and a bit": dict(channels=70),
    "one depth": dict(depths=1),
    "many depths": dict(depths=70),
    "one pixel": dict(size=(1, 1)),
    "one row": dict(size=(1, 6)),
    "more pixels than a chunk": dict(size=(17, 13)),
    "one image on itself": dict(sources=((0,),)),
    "the same source twice": dict(sources=((1, 1), (0,))),
}


# 1 forward against the oracle
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES)
def test_forward(case, dtype, device):
    arguments = make(**CASES[case], dtype=dtype)
    ours = plane_sweep(*(t.to(device) for t in arguments))
    expected = oracle.plane_sweep(*in_double(arguments))
    assert ours.dtype == dtype
    assert_close_relative_to_max(ours, expected, f"plane_sweep_{DTYPES[dtype]}", case)


# 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES)
def test_backward(case, dtype, device):
    arguments = make(**CASES[case], dtype=dtype)
    geometry = [t.to(device) for t in arguments[1:]]
    cotangent = cotangent_of(arguments)
    _, ours = gradients(lambda f: plane_sweep(f, *geometry), [arguments[0].to(device)], cotangent.to(device))
    double = in_double(arguments)
    _, expected = gradients(lambda f: oracle.plane_sweep(f, *double[1:]), [double[0]], cotangent.double())
    assert_close_relative_to_max(ours, expected, f"plane_sweep_grad_{DTYPES[dtype]}", case)


def test_cost_of_a_constant_volume_is_its_squared_norm():
    """Features equal to v everywhere, seen inside the source: <v, v> / sqrt(C), whatever the depth."""
    arguments = make(((0,),), channels=4, dtype=torch.float64)
    arguments[0] = torch.ones_like(arguments[0]) * 3
    cost = plane_sweep(*arguments)
    assert torch.allclose(cost, torch.full_like(cost, 9 * 4 / 2))


def test_geometry_maps_world_points_between_images():
    """A point seen by image i at index (u, v) and depth d appears in its source where q points."""
    generator = torch.Generator().manual_seed(0)
    Ks = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    for row, col, value in ((0, 0, 8), (1, 1, 9), (0, 2, 3), (1, 2, 4)):
        Ks[:, row, col] = torch.rand(2, generator=generator).double() + value
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    viewmats[:, :3, :3] = torch.stack([rotation(0, 0.3), rotation(1, -0.4)])
    viewmats[:, :3, 3] = torch.randn(2, 3, generator=generator).double() * 0.3
    point = torch.tensor([0.2, -0.1, 4.0, 1.0], dtype=torch.float64)
    in_camera = (viewmats @ point)[:, :3]
    projected = (Ks @ in_camera[..., None])[..., 0]
    index = projected[:, :2] / projected[:, 2:] - 0.5  # the first pixel's centre, 0.5, is index 0
    sources, cu_src = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    for targets, expected in ((None, index.flip(0)), (Ks, None)):
        A, b = sweep_geometry(Ks, viewmats, sources, cu_src, Ks_target=targets)
        homogeneous = torch.cat([index, torch.ones(2, 1, dtype=torch.float64)], 1)
        q = (A @ homogeneous[..., None])[..., 0] * in_camera[:, 2:] + b
        if expected is None:  # projected with the intrinsics of the reference
            other = (Ks @ in_camera.flip(0)[..., None])[..., 0]
            expected = other[:, :2] / other[:, 2:] - 0.5
        assert torch.allclose(q[:, :2] / q[:, 2:], expected)


# 3 gradcheck in float64 (the cost is bilinear in the features, so it has no jumps in them)
def test_gradcheck():
    features, *geometry = make(((1,), (0, 1)), channels=2, depths=4, size=(3, 4))
    assert torch.autograd.gradcheck(lambda f: plane_sweep(f, *geometry), features.requires_grad_())


# 4 CPU against CUDA
@pytest.mark.parametrize("case", CASES)
def test_cpu_and_cuda_agree(case, devices):
    results = []
    for device in devices:
        features, *geometry = (t.to(device) for t in make(**CASES[case], dtype=torch.float32))
        cotangent = cotangent_of([features.cpu(), None, None, geometry[2]])
        results.append(gradients(lambda f: plane_sweep(f, *geometry), [features], cotangent.to(device)))
    for cpu, cuda, name in zip(*results, ("cost", "gradient"), strict=True):
        assert_close_relative_to_max(cuda, cpu, "plane_sweep_grad_float32", name)


def run(arguments, device):
    """Cost and gradient of the features on a device."""
    features, *geometry = (t.to(device) for t in arguments)
    cotangent = cotangent_of([arguments[0], None, None, arguments[3]]).to(device)
    return gradients(lambda f: plane_sweep(f, *geometry), [features], cotangent)


@pytest.mark.parametrize("case", ["ragged", "many depths", "channels of a block and a bit"])
def test_cuda_gives_the_same_bits_every_time(case, devices):
    arguments = make(**CASES[case] | {"size": (24, 32)}, dtype=torch.float32)
    first = run(arguments, devices[1])
    for _ in range(3):
        for actual, expected in zip(run(arguments, devices[1]), first, strict=True):
            assert_same_bits(actual, expected)


LARGE = {
    "pairs in pieces": dict(sources=((1,) * 6, (0,) * 6), channels=3, depths=8, size=(128, 128)),
    "pixels in pieces": dict(sources=((), (0,)), channels=1, depths=2, size=(256, 256)),
    "tiles in pieces": dict(sources=((1,), (0,)), channels=2, depths=8, size=(400, 400)),
    "channels in blocks": dict(channels=260, size=(9, 16)),
}


@pytest.mark.unraced("launches the kernels of other tests several times")
@pytest.mark.parametrize("case", LARGE)
def test_large_sweeps_on_cuda(case, devices):
    arguments = make(**LARGE[case], dtype=torch.float32)
    for cpu, cuda, name in zip(*(run(arguments, device) for device in devices), ("cost", "gradient"), strict=True):
        limit = "plane_sweep_tiles_in_pieces" if case == "tiles in pieces" else "plane_sweep_large"
        assert_close_relative_to_max(cuda, cpu, limit, name)


def scene_of(arguments, first, last):
    """Images first .. last - 1 alone; their sources lie among them."""
    features, A, b, inverse_depths, src_images, cu_src = arguments
    begin, end = int(cu_src[first]), int(cu_src[last])
    alone = [features[first:last], A[begin:end], b[begin:end], inverse_depths[first:last]]
    return [*alone, src_images[begin:end] - first, cu_src[first : last + 1] - begin]


def scaled_scenes(n_scenes, scales, **options):
    """Scenes of four images that all see each other; scene i has features times the i-th of the scales, in turn."""
    sources = [[4 * s + (v + k) % 4 for k in (1, 2, 3)] for s in range(n_scenes) for v in range(4)]
    features, *geometry = make(sources, dtype=torch.float32, **options)
    scale = torch.tensor(scales, dtype=torch.float32)[torch.arange(n_scenes) % len(scales)]
    return [features * scale.repeat_interleave(4)[:, None, None, None], *geometry]


def with_cotangent(arguments, cotangent, device):
    features, *geometry = (t.to(device) for t in arguments)
    return gradients(lambda f: plane_sweep(f, *geometry, check=False), [features], cotangent.to(device))


@pytest.mark.parametrize("scales", [(1.0,), (1.0, 1e9, 1e-9)])
def test_scene_has_the_same_bits_alone_and_beside_others(scales, device):
    arguments = scaled_scenes(3, scales)
    cotangent = cotangent_of([arguments[0], None, None, arguments[3]])
    cotangent[4:8] *= 1e9
    together = with_cotangent(arguments, cotangent, device)
    for first in (0, 4, 8):
        images = slice(first, first + 4)
        alone = with_cotangent(scene_of(arguments, first, first + 4), cotangent[images], device)
        for x, expected, name in zip(together, alone, ("cost", "gradient"), strict=True):
            assert_same_bits(x[images], expected, name)


@pytest.mark.unraced("launches the kernels of other tests several times")
def test_scene_has_the_same_bits_in_a_batch_that_takes_several_launches(devices):
    """More pairs than are kept at once, and tiles that see more source pixels than one launch keeps of them."""
    arguments = scaled_scenes(8, (1.0, 30.0), channels=4, depths=64, size=(48, 64))
    zoom = torch.tensor([[3.0, 0, -2 * 32], [0, 3, -2 * 24], [0, 0, 1]])
    arguments[1], arguments[2] = zoom @ arguments[1], (zoom @ arguments[2][..., None])[..., 0]
    cotangent = cotangent_of([arguments[0], None, None, arguments[3]])
    together = with_cotangent(arguments, cotangent, devices[1])
    for first in range(0, 32, 4):
        images = slice(first, first + 4)
        part = scene_of(arguments, first, first + 4), cotangent[images]
        for x, expected, name in zip(together, with_cotangent(*part, devices[1]), ("cost", "gradient"), strict=True):
            assert_same_bits(x[images], expected, name)
    for actual, expected in zip(with_cotangent(*part, devices[1]), with_cotangent(*part, devices[0]), strict=True):
        assert_close_relative_to_max(actual, expected, "plane_sweep_large")


def test_images_of_other_magnitudes_in_one_scene(device):
    """Each image's cost and gradient is as precise as it would be without its neighbours' sizes."""
    arguments = make(((1, 2), (2, 0, 3), (3,), (0, 1)), channels=40, depths=16, size=(12, 17))
    arguments[0] *= torch.tensor([1.0, 1e8, 1e-8, 1e3])[:, None, None, None]
    cotangent = cotangent_of([arguments[0], None, None, arguments[3]])
    cotangent *= torch.tensor([1e3, 1e-9, 1e5, 1.0])[:, None, None, None]
    expected = with_cotangent(arguments, cotangent, torch.device("cpu"))
    single = [t.float() if t.is_floating_point() else t for t in arguments]
    for actual, exact, name in zip(with_cotangent(single, cotangent.float(), device), expected, ("cost", "gradient")):
        for i in range(4):
            assert_close_relative_to_max(actual[i], exact[i], "plane_sweep_grad_float32", f"{name} of image {i}")


def test_features_at_the_ends_of_the_number_range(device):
    """One image's smallness makes up for another's size."""
    arguments = make(((1,), (0,)), channels=6, dtype=torch.float32)
    arguments[0] *= torch.tensor([1e-30, 1e32])[:, None, None, None]
    cotangent = cotangent_of([arguments[0], None, None, arguments[3]])
    expected = with_cotangent(in_double(arguments), cotangent.double(), torch.device("cpu"))
    features, *geometry = (t.to(device) for t in arguments)
    actual = gradients(lambda f: plane_sweep(f, *geometry, check=False), [features], cotangent)
    for x, exact in zip(actual, expected, strict=True):
        for i in range(2):
            assert_close_relative_to_max(x[i], exact[i], "plane_sweep_grad_float32")


def test_cuda_skips_what_is_out_of_range(devices):
    """Unknown sources count as seeing nothing; whatever the offsets hold, nothing else is read."""
    arguments = make(((1, 0), (0, 1)), dtype=torch.float32)
    features, *geometry, src_images, cu_src = (t.to(devices[1]) for t in arguments)
    cost = plane_sweep(features, *geometry, src_images, cu_src)
    unknown = src_images.clone()
    unknown[0] = 7
    changed = plane_sweep(features, *geometry, unknown, cu_src)
    assert_same_bits(changed[1], cost[1])
    only = plane_sweep(features, *(t[1:] for t in geometry[:2]), geometry[2], src_images[1:], (cu_src - 1).clamp(min=0))
    assert torch.allclose(changed[0] * 2, only[0])
    for offsets in ([5, -9, 2**40], [0, 4, 2], [2**62, 0, 1]):
        features.requires_grad_()
        out = plane_sweep(features, *geometry, src_images - 1, torch.tensor(offsets, device=devices[1]))
        out.sum().backward()
        assert out.shape == cost.shape and features.grad.isfinite().all()


def test_cuda_rejects_lines_beyond_shared_memory(devices):
    features = torch.zeros(1, 1, 1, 1 << 22, device=devices[1])
    geometry = torch.eye(3)[None], torch.zeros(1, 3), torch.ones(1, 1), torch.tensor([0]), torch.tensor([0, 1])
    with pytest.raises(ValueError, match="small enough for one pixel's line .* got 1 x 4194304 pixels and 1 depths"):
        plane_sweep(features, *(t.to(devices[1]) for t in geometry))


# 5 opcheck
def test_opcheck(device):
    features, *geometry = (t.to(device) for t in make(channels=3, depths=4, size=(4, 5)))
    torch.library.opcheck(torch.ops.gsim3d.plane_sweep.default, (features.requires_grad_(), *geometry))
    grad = torch.ones(4, 4, 4, 5, dtype=features.dtype, device=device)
    torch.library.opcheck(torch.ops.gsim3d.plane_sweep_backward.default, (grad, features.detach(), *geometry))


# 6 torch.compile
def test_compiled_equals_eager(device):
    features, *geometry = (t.to(device) for t in make(dtype=torch.float32))
    cotangent = cotangent_of([features.cpu(), None, None, geometry[2]]).to(device)

    def f(x):
        return plane_sweep(x * 2, *geometry) + 1

    eager = gradients(f, [features], cotangent)
    compiled = gradients(torch.compile(f, fullgraph=True), [features], cotangent)
    for a, b in zip(compiled, eager, strict=True):
        assert_same_bits(a, b)


# 7 edges
@pytest.mark.parametrize("case", ["ragged", "more pixels than a chunk"])
def test_same_bits_for_any_number_of_threads(case):
    features, *geometry = make(**CASES[case], channels=70, dtype=torch.float32)
    cotangent = cotangent_of([features, None, None, geometry[2]])
    assert_same_bits_for_any_threads(lambda: gradients(lambda f: plane_sweep(f, *geometry), [features], cotangent))


@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (1, 3, 0, 4), (1, 3, 4, 0)])
def test_empty(shape, device):
    n = shape[0]
    features = torch.zeros(shape, requires_grad=True, device=device)
    geometry = torch.zeros(0, 3, 3), torch.zeros(0, 3), torch.ones(n, 2)
    indices = torch.zeros(0, dtype=torch.int64), torch.zeros(n + 1, dtype=torch.int64)
    cost = plane_sweep(features, *(t.to(device) for t in (*geometry, *indices)))
    assert cost.shape == (n, 2, *shape[2:])
    cost.sum().backward()
    assert features.grad.shape == shape


def test_empty_depths_and_sources(device):
    arguments = [t.to(device) for t in make(depths=4)]
    arguments[3] = arguments[3][:, :0]
    assert plane_sweep(*arguments).shape == (4, 0, 7, 9)
    arguments = [t.to(device) for t in make(((), ()))]
    arguments[0].requires_grad_()
    cost = plane_sweep(*arguments)
    cost.sum().backward()
    assert not cost.any() and not arguments[0].grad.any()


def test_non_contiguous_inputs():
    arguments = make()
    strided = [t.mT.contiguous().mT if t.dim() > 1 else t.repeat_interleave(2)[::2] for t in arguments]
    assert not strided[0].is_contiguous()
    assert_same_bits(plane_sweep(*strided), plane_sweep(*arguments))
    last = arguments[0].contiguous(memory_format=torch.channels_last)
    assert_same_bits(plane_sweep(last, *arguments[1:]), plane_sweep(*arguments))


def test_images_of_other_clouds_do_not_matter(device):
    """Images 2 and 3 see each other only; changing them leaves 0 and 1 alone, bit for bit."""
    features, *geometry = (t.to(device) for t in make(((1,), (0,), (3,), (2,))))
    before = plane_sweep(features, *geometry)
    changed = features.clone()
    changed[2:] = torch.nan
    assert_same_bits(plane_sweep(changed, *geometry, check=False)[:2], before[:2])


def test_features_that_are_no_numbers_are_refused_on_the_cpu():
    features, *geometry = make()
    features[2, 1, 3, 4] = math.nan
    with pytest.raises(NumericalError, match="plane_sweep: features must be finite .* got nan in row 2"):
        plane_sweep(features, *geometry)


def test_cameras_that_cannot_be_inverted_are_named():
    Ks, viewmats = torch.eye(3).repeat(2, 1, 1), torch.eye(4).repeat(2, 1, 1)
    sources = torch.tensor([1, 0]), torch.tensor([0, 1, 2])
    Ks[1, 0, 0] = 0
    with pytest.raises(NumericalError, match="sweep_geometry: Ks cannot be inverted for image 1"):
        sweep_geometry(Ks, viewmats, *sources)
    viewmats[0, 2, 3] = math.inf
    with pytest.raises(NumericalError, match="sweep_geometry: viewmats must be finite .* row 0"):
        sweep_geometry(torch.eye(3).repeat(2, 1, 1), viewmats, *sources)


@pytest.mark.parametrize("where", ["behind", "on the camera plane", "far outside", "overflow"])
def test_points_that_no_source_sees_cost_nothing(where, device):
    arguments = [t.to(device) for t in make(((1,), (0,)), dtype=torch.float32)]
    A, b = arguments[1], arguments[2]
    if where == "behind":
        A[:, 2], b[:, 2] = -A[:, 2].abs(), -10.0
    elif where == "on the camera plane":
        A[:, 2], b[:, 2], b[:, :2] = 0.0, 0.0, 50.0
    elif where == "far outside":
        b[:, 0] = 1e9
    else:
        A[:, :2] = 3e38  # infinite, or infinity minus infinity
        b[:, :2] = -3e38
    features = arguments[0].requires_grad_()
    cost = plane_sweep(*arguments)
    cost.sum().backward()
    assert not cost.any() and not features.grad.any()


def test_border_fades_to_zero():
    """Half a pixel outside, a sample is half the border pixel; a whole pixel outside it is 0."""
    features = torch.ones(1, 1, 1, 3)
    A, inverse_depths = torch.eye(3)[None], torch.ones(1, 1)
    sources, cu_src = torch.tensor([0]), torch.tensor([0, 1])
    for shift, expected in ((0.5, [1, 1, 0.5]), (1.0, [1, 1, 0]), (-0.25, [0.75, 1, 1]), (-3.0, [0, 0, 0])):
        b = torch.tensor([[shift, 0, 0]])
        cost = plane_sweep(features, A, b, inverse_depths, sources, cu_src)
        assert cost.flatten().tolist() == expected


# 8 error messages
@pytest.mark.parametrize(
    "index, value, message",
    [
        (0, torch.zeros(4, 5, 7), r"plane_sweep: features must be \[I, C, h, w\]"),
        (0, torch.zeros(4, 0, 7, 9).double(), "features must have at least one channel"),
        (0, torch.zeros(4, 5, 7, 9, dtype=torch.int64), "must be"),
        (0, torch.zeros(4, 5, 7, 9), "homographies must be float32; got float64"),
        (1, torch.zeros(2, 3, 3).double(), r"homographies must be \[P, 3, 3\]"),
        (1, torch.full((6, 3, 3), math.nan).double(), "homographies must be finite; got nan in pair 0"),
        (2, torch.zeros(6, 2).double(), r"translations must be \[P, 3\]"),
        (2, torch.full((6, 3), math.inf).double(), "translations must be finite; got inf"),
        (3, torch.ones(3, 11).double(), r"inverse_depths must be \[I, D\]"),
        (3, torch.zeros(4, 11).double(), "inverse_depths must be positive and finite; got 0 in image 0"),
        (4, torch.tensor([1, 2, 3, 1, 0, 4]), r"src_images must be in \[0, I\) with I=4; got 4 at 5"),
        (4, torch.tensor([1, 2, 3, 1, 0, -1]), "got -1 at 5"),
        (4, torch.zeros(6, dtype=torch.int32), "src_images must be int64; got int32"),
        (5, torch.tensor([0, 2, 2, 5, 5]), r"cu_src must run from 0 to len\(src_images\)=6; got 0 .. 5"),
        (5, torch.tensor([0, 4, 2, 5, 6]), "cu_src must not descend; got 4 then 2 at 1"),
        (5, torch.tensor([0, 6]), r"cu_src must be \[I \+ 1\]"),
    ],
)
def test_errors(index, value, message):
    arguments = make()
    arguments[index] = value
    with pytest.raises(ValueError, match=message):
        plane_sweep(*arguments)
