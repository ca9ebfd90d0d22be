"""Hard cases of serialisation, voxels and sparse convolution."""

import dataclasses
import itertools

import pytest
import torch

from gsim3d import ops
from gsim3d.numerics.report import StabilityReport
from gsim3d.ops import PyramidSpec, curve_encode, sparse_conv
from gsim3d.simulator import Simulator
from gsim3d.train.losses import image_errors
from tests.asserts import gradients
from tests.dynamics.scenes import TINY, batch, float_fields, make_history, permute_rows
from tests.ops.test_plane_sweep import make as make_sweep
from tests.ops.test_pyramid import assert_matches_oracle
from tests.ops.test_sparse_conv import geometry, parameters, random_cells
from tests.oracle import curve as curve_oracle, sparse_conv as conv_oracle
from tests.stability.rollouts import make_simulator, ordinary, raised
from tests.stability.setting import NAMES
from tests.stability.steps import check_same_rows, check_step, simulate
from tests.test_simulator import CONFIG, make_frames, target_cameras

CELLS = 2**16
NAN, INF = float("nan"), float("inf")
ON_CPU = pytest.mark.parametrize("setting", NAMES[:2], indirect=True)
ON_CUDA = pytest.mark.parametrize("setting", NAMES[2:], indirect=True)


def displaced(history, rows, value):
    """``history`` with the x of some rows replaced."""
    means = history.means.clone()
    means[rows, 0] = value
    return dataclasses.replace(history, means=means)


@ON_CPU
@pytest.mark.parametrize("cell", [-1, CELLS, 2**40])
def test_s16_cells_beyond_16_bits_are_named(setting, measured, cell):
    grid = torch.tensor([[0, 0, 0], [1, cell, 2]], device=setting.device)
    with pytest.raises(ValueError, match=f"curve_encode: .*{cell}.* row 1"):
        curve_encode(grid, None, "hilbert")
    measured.outcome("op: refused, row named")


@ON_CUDA
@pytest.mark.parametrize("cell", [-1, CELLS, 2**40])
def test_s16_cells_beyond_16_bits_have_code_zero(setting, measured, cell):
    grid = torch.tensor([[0, 0, 1], [1, cell, 2]], device=setting.device)
    assert curve_encode(grid, None, "z").tolist() == [1, 0]
    measured.outcome("op: code 0")


@pytest.mark.parametrize("value", [CELLS * TINY.grid_size, 1e6, 3e38, -1e-3])
def test_s16_particles_outside_the_grid_sleep(setting, measured, value):
    history = make_history((25, 30))
    odd = torch.zeros(55, dtype=torch.bool)
    odd[[3, 30, 54]] = True
    hard = displaced(history, odd, value)
    step, absent = check_step(setting, measured, hard), check_step(setting, measured, history.select_rows(~odd))
    check_same_rows(setting, measured, step, absent, ~odd[25:], ~odd)
    for name, before in (("means", hard.means), ("dynamic_latents", hard.dynamic_latents)):
        measured.same_bits(step.fields[name][odd[25:].to(setting.device)], setting.to(before[25:][odd[25:]]), name)
    measured.outcome("model: asleep, the others as without them")


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_s17_places_that_are_none_are_dropped(setting, measured, value):
    """As if the particles were not there; counted."""
    history = make_history((25, 30))
    odd = torch.zeros(55, dtype=torch.bool)
    odd[[3, 30, 54]] = True
    simulator, report = make_simulator(setting), StabilityReport()
    states = [setting.to(batch([h, ordinary()])) for h in (displaced(history, odd, value), history.select_rows(~odd))]
    means = states[0].means.clone().requires_grad_()
    step = simulator.rollout(dataclasses.replace(states[0], means=means), 1, on_invalid="drop", report=report)[0]
    (grad,) = torch.autograd.grad(step.means.sum() + step.dynamic_latents.sum(), means)
    measured.finite(*float_fields(step).values(), grad)
    absent = simulator.rollout(states[1], 1, report=StabilityReport())[0]
    rows = torch.cat([~odd[25:], torch.ones(9, dtype=torch.bool)]).to(setting.device)
    for name, expected in float_fields(absent).items():
        measured.unchanged(setting, float_fields(step)[name][rows], expected, name)
    assert not grad[setting.to(odd.nonzero()[:, 0])].any()
    assert [(f.tensor, f.scene, f.step, f.row, f.count) for f in report.findings] == [
        ("particles.means", 0, 0, 3, 1),
        ("particles.means", 0, 1, 30, 2),
    ]
    measured.outcome("dropped, counted")


@pytest.mark.parametrize("value", [NAN, INF])
def test_s17_places_that_are_none_are_an_error(setting, measured, value):
    simulator, report = make_simulator(setting), StabilityReport()
    state = setting.to(batch([ordinary(), displaced(make_history((25, 30)), 30, value)]))
    error = raised(lambda: simulator.rollout(state, 1, report=report), report)
    assert (error.tensor, error.scene, error.step, error.row) == ("particles.means", 1, 1, 21 + 30)
    measured.outcome("NumericalError names scene, step, row, tensor")


@pytest.mark.parametrize("value", [NAN, INF])
def test_s17_places_that_are_none_are_clamped(setting, measured, value):
    simulator, report = make_simulator(setting), StabilityReport()
    state = setting.to(batch([displaced(make_history((25, 30)), 30, value), ordinary()]))
    step = simulator.rollout(state, 1, on_invalid="clamp", report=report)[0]
    measured.finite(*float_fields(step).values())
    assert [(f.tensor, f.action, f.row) for f in report.findings if f.step == 1][:1] == [
        ("particles.means", "clamped", 30)
    ]
    measured.outcome("clamped, counted")


def test_s18_negative_coordinates(setting, measured):
    """A scene around its origin is the same scene as one far from zero: whole cells are exact in float32."""
    history = make_history((20, 25))
    exact = dataclasses.replace(history, means=(history.means * 2**16).round() / 2**16)
    shift = torch.tensor([-16.0, -48.0, 32.0]) * TINY.grid_size
    moved = dataclasses.replace(exact, means=exact.means + shift, origin=exact.origin + shift)
    assert (moved.means < 0).any()
    step, expected = check_step(setting, measured, moved), check_step(setting, measured, exact)
    measured.same_bits(step.fields["dynamic_latents"], expected.fields["dynamic_latents"])
    both = simulate(setting, batch([exact, moved]))
    expected = expected.fields["dynamic_latents"]
    measured.unchanged(setting, both.fields["dynamic_latents"][25:], expected, "the second scene")


def test_s19_more_than_32_clouds_at_16_levels(setting, measured):
    """Codes of 2^15 clouds keep their order above 48 bits of space; one more would not fit and is refused."""
    cells = torch.tensor([[65535, 65535, 65535], [1, 2, 3]])
    clouds = torch.tensor([0, 1, 31, 32, 33, 200, 2**15 - 1])
    grid, cloud = cells.repeat(len(clouds), 1).to(setting.device), clouds.repeat_interleave(2).to(setting.device)
    for name in ops.curve.CURVES:
        codes = curve_encode(grid, cloud, name).tolist()
        space = [curve_oracle.code(*cell, name, 16) for cell in cells.tolist()]
        assert codes == [(c << 48) + s for c in clouds.tolist() for s in space]
    measured.outcome("separate codes")


def test_s19_forty_scenes_of_four_steps(setting, measured):
    histories = [make_history((3, 2, 2, 3), seed=i) for i in range(40)]
    together = simulate(setting, batch(histories))
    measured.finite(*together.tensors)
    for i in (0, 7, 8, 31, 32, 39):  # 160 clouds: the 32nd, the 128th ...
        alone = simulate(setting, histories[i])
        for name, value in alone.fields.items():
            measured.unchanged(setting, together.fields[name][3 * i : 3 * i + 3], value, f"scene {i} {name}")


@pytest.mark.parametrize("n_rows", [(1,), (1, 1), (0, 1)])
def test_s20_one_point(setting, measured, n_rows):
    check_step(setting, measured, make_history(n_rows))


def test_s20_all_points_in_one_voxel(setting, measured):
    history = make_history((9, 14))
    means = 0.25 + 0.2 * TINY.grid_size * history.means
    check_step(setting, measured, dataclasses.replace(history, means=means))


@pytest.mark.parametrize("n_rows", [(1,), (1, 1), (14,)])
def test_s20_batch_norm_trains_on_one_voxel(setting, measured, n_rows):
    history = make_history(n_rows)
    history = dataclasses.replace(history, means=0.25 + 0.2 * TINY.grid_size * history.means)
    config = dataclasses.replace(TINY, norm="batch")
    measured.finite(*simulate(setting, history, config, training=True).tensors)


@pytest.mark.parametrize("n_rows", [(0,), (0, 0), (12, 0)])
def test_s21_empty_clouds(setting, measured, n_rows):
    step = check_step(setting, measured, make_history(n_rows))
    assert step.fields["means"].shape == (n_rows[-1], 3)
    measured.outcome("zero rows")


def test_s21_all_pixels_masked(setting, measured):
    """Encoder, rollout, renderer and loss of a scene that no pixel shows, beside one that has some."""
    frames = make_frames((2, 2))
    masks = frames.masks.clone()
    masks[:4] = False
    torch.manual_seed(0)
    simulator = setting.to(Simulator(CONFIG))
    frames = setting.to(dataclasses.replace(frames, masks=masks))
    state = simulator.encode(frames)
    assert state.cu_rows.tolist()[:3] == [0, 0, 0] and state.n_rows > 0
    steps = simulator.rollout(state, 2)
    background = torch.tensor([0.2, 0.3, 0.4], device=setting.device, dtype=state.means.dtype)
    image = simulator.render(steps[-1], target_cameras(frames, 2), background)
    measured.same_bits(image.color[0], background.expand(16, 16, 3), "image of the empty scene")
    errors = image_errors(image.color, torch.zeros_like(image.color), torch.zeros_like(image.alpha))
    assert errors.tolist() == [0, 0]
    image.color.square().sum().backward()
    measured.finite(image.color, *(p.grad for p in simulator.parameters()))
    measured.outcome("background, loss 0")


def conv_inputs(setting, n, side):
    cells = random_cells(n, side)
    x, weight, bias, cotangent = parameters(n, 16, 16, 3, torch.float32)
    voxels, kernel_map = geometry(cells, 3, setting.device)
    ours = lambda *t: sparse_conv(*t, voxels, kernel_map)  # noqa: E731
    return cells, ours, [x, weight, bias], cotangent


@pytest.mark.parametrize("side", [1, 2, 4])
def test_s22_duplicate_voxels(setting, measured, side):
    """A tap reads the mean of a voxel's rows: 60 rows in 1, 8 or 64 cells of two clouds."""
    cells, ours, inputs, cotangent = conv_inputs(setting, 60, side)
    actual = gradients(ours, [setting.to(t) for t in inputs], cotangent)
    oracle = lambda x, w, b: conv_oracle.sparse_conv(x, w, b, cells, "mean")  # noqa: E731
    expected = gradients(oracle, [t.double() for t in inputs], cotangent)
    measured.finite(*actual)
    for what, a, e in zip(("result", "grad x", "grad weight", "grad bias"), actual, expected, strict=True):
        measured.close(a, e, f"sparse_conv_{setting.precision}", what)


def test_s22_order_of_duplicates_does_not_matter(setting, measured):
    history = make_history((40, 40))
    history = dataclasses.replace(history, means=0.25 + 0.3 * history.means)  # about 20 rows a cell
    permuted, order = permute_rows(history)
    step, other = (check_step(setting, measured, h) for h in (history, permuted))
    rows = (order[40:] - 40).to(setting.device)
    for name, value in step.fields.items():
        measured.close(other.fields[name], value[rows], f"network_{setting.precision}", name)


def test_s23_corners_of_many_clouds(setting, measured):
    """Cells at all corners of 2^16 cells an axis in seven clouds: 2^51 places, counted and found in 64 bits."""
    grid_size = 0.0625
    corners = torch.tensor(list(itertools.product([0, 1, CELLS - 2, CELLS - 1], repeat=3)))
    positions = ((corners + 0.5) * grid_size).repeat(7, 1)
    arguments = {
        "positions": setting.to(positions),
        "cu_rows": torch.arange(8) * len(corners),
        "cloud_scene": torch.tensor([0, 0, 0, 0, 1, 1, 2]),
        "cloud_slot": torch.tensor([0, 1, 2, 3, 2, 3, 3]),
        "origin": torch.zeros(3, 3, dtype=torch.float64),
    }
    spec = PyramidSpec(grid_size, 2, (2,), (2,), (16, 16), ((3,), (3,)))
    pyramid = assert_matches_oracle(arguments, spec, device=setting.device)
    stage = pyramid.stages[0]
    x, weight, bias, cotangent = parameters(stage.n_rows, 16, 16, 3, torch.float32)
    convolve = lambda *t: sparse_conv(*t, stage.voxels, stage.kernel_maps[3])  # noqa: E731
    actual = gradients(convolve, [setting.to(t) for t in (x, weight, bias)], cotangent)
    cells = torch.cat([stage.cloud[:, None], stage.grid], 1).cpu()
    oracle = lambda x, w, b: conv_oracle.sparse_conv(x, w, b, cells, "mean")  # noqa: E731
    expected = gradients(oracle, [t.double() for t in (x, weight, bias)], cotangent)
    measured.finite(*actual)
    for what, a, e in zip(("result", "grad x", "grad weight", "grad bias"), actual, expected, strict=True):
        measured.close(a, e, f"sparse_conv_{setting.precision}", what)


def strided(tensor):
    """The same numbers, every other one of a larger tensor."""
    return torch.stack([tensor, tensor], -1)[..., 0]


def test_s24_strided_inputs(setting, measured):
    """Every op reads views in place or copies them: the bits do not change, forward and backward."""
    voxels, kernel_map = geometry(random_cells(30, 3), 3, setting.device)
    x, weight, bias, _ = (setting.to(t) for t in parameters(30, 8, 8, 3))
    rows, cu_rows = torch.arange(30, device=setting.device), torch.tensor([0, 3, 3, 30], device=setting.device)
    table = ops.PatchTable(rows, rows, cu_rows, cu_rows)
    sweep = [setting.to(t) for t in make_sweep()]
    q = setting.to(parameters(30, 8, 8, 3)[0].reshape(30, 2, 4))
    scale, shift = setting.to(torch.ones(8, dtype=torch.float64)), setting.to(torch.zeros(8, dtype=torch.float64))
    calls = {
        "sparse_conv": (lambda *t: sparse_conv(*t, voxels, kernel_map), (x, weight, bias)),
        "patch_attention": (lambda *t: ops.patch_attention(*t, table), (q, q + 1, q - 1)),
        "pool_max": (lambda t: ops.pool_max(t, rows, cu_rows), (x,)),
        "pool_mean": (lambda t: ops.pool_mean(t, rows, cu_rows), (x,)),
        "unpool": (lambda t: ops.unpool(t, rows, cu_rows, 30), (x[:3],)),
        "row_norm": (ops.row_norm, (x, scale, shift, x + 1)),
        "plane_sweep": (lambda t: ops.plane_sweep(t, *(strided(s) for s in sweep[1:])), (sweep[0],)),
    }
    for name, (call, inputs) in calls.items():
        views = [strided(t.detach()).requires_grad_() for t in inputs]
        plain = [t.detach().clone().requires_grad_() for t in inputs]
        assert not views[0].is_contiguous()
        results = []
        for leaves in (views, plain):
            out = call(*leaves)
            results.append((out, *torch.autograd.grad(out, leaves, strided(torch.ones_like(out)))))
        for a, e in zip(*results, strict=True):
            measured.same_bits(a, e, name)
        measured.finite(*results[0])
    grid = torch.arange(90, device=setting.device).reshape(30, 3)
    assert torch.equal(curve_encode(strided(grid), strided(rows), "hilbert"), curve_encode(grid, rows, "hilbert"))


def test_s24_strided_particles(setting, measured):
    history = make_history((20, 25))
    fields = {name: strided(value) for name, value in history.row_fields().items() if value.is_floating_point()}
    step = check_step(setting, measured, dataclasses.replace(history, **fields))
    expected = check_step(setting, measured, history)
    everything = torch.ones(25, dtype=torch.bool), torch.ones(45, dtype=torch.bool)
    check_same_rows(setting, measured, step, expected, *everything)
