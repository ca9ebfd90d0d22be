"""The whole dynamics network, its inside and its gradients, against the published one (f_*)."""

import dataclasses

import pytest
import torch

from gsim3d import ops
from gsim3d.compat.released_model import ReleasedDecoderStage, ReleasedDynamicsConfig, ReleasedSparseConv, as_released
from gsim3d.dynamics import DynamicsConfig
from gsim3d.nn import point_transformer
from gsim3d.nn.point_transformer import PointTransformer
from tests.asserts import relative_to_max
from tests.golden.published import (
    NOT_IN_GOLDEN,
    assert_published_stage,
    assert_rounded_to_half,
    close,
    dynamics_config,
    everywhere,
    mask_of,
    members,
    pyramid_of,
    renamed,
)
from tests.golden_files import golden
from tests.oracle.sparse_conv import racing_conv
from tests.tolerances import tolerance

pytestmark = pytest.mark.golden

FILES = ["small_nodup", "small_dup", "deep_nodup", "deep_dup"]
CASES = ["T4_nomask", "T4_mask", "T2_nomask", "T2_mask"]


def load(file, without=NOT_IN_GOLDEN):
    """The file, and its network with published weights."""
    g = golden(f"f_dynamics_{file}")
    name = {"small": "small", "deep": "small_deep_dynamics"}[file.split("_")[0]]
    config = dataclasses.replace(dynamics_config(name), grid_size=float(g["grid_size"]))
    weights = renamed(g / "w")
    in_channels, out_channels = weights["stem.conv.weight"].shape[-1], weights["head.fc2.bias"].shape[0]
    net = as_released(PointTransformer(in_channels, out_channels, config), without).eval()
    net.load_state_dict(weights)
    return g, net, config


def run(net, config, case, features=None, origin=None):
    """[B, T, N, out] of a case of the file."""
    device = net.head.fc2.weight.device
    features = (case["features"] if features is None else features).to(device)
    xyz = case["xyz"].to(device)
    mask = mask_of(case, xyz)
    out = net.head(net(features[mask], pyramid_of(xyz, mask, config, origin)))
    return out.new_zeros(*mask.shape, out.shape[-1]).masked_scatter(mask[..., None], out)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("file", FILES)
def test_network(file, case, device):
    g, net, config = load(file)
    c = g / case
    features = c["features"].requires_grad_()
    out = run(net.to(device), config, c, features)
    close(out, c["out"], "out")
    (grad,) = torch.autograd.grad(out, features, c["cotangent"].to(device))
    close(grad, c["grad_features"], "gradient of the features")


@pytest.mark.parametrize(
    ("override", "file", "case"),
    [
        (ReleasedDecoderStage, "small_nodup", "T4_nomask"),
        (ReleasedSparseConv, "small_dup", "T4_nomask"),
        (ReleasedDynamicsConfig, "small_nodup", "T4_mask"),
    ],
)
def test_each_override_is_what_the_published_model_does(override, file, case):
    """Without any one of them the published numbers are missed."""
    g, net, config = load(file, (*NOT_IN_GOLDEN, override))
    if override is ReleasedDynamicsConfig:
        config = DynamicsConfig(**vars(config))
    c = g / case
    with torch.no_grad():
        out = run(net, config, c, origin=c["xyz"].amin((1, 2)) - 0.05)
    assert relative_to_max(out, c["out"]) > 10 * tolerance("dynamics_golden")


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("file", FILES)
def test_network_with_attention_rounded_to_half(file, case):
    (g, net, config), (_, exact, _) = load(file, ()), load(file)
    c = g / case
    with torch.no_grad():
        assert_rounded_to_half(run(net, config, c), run(exact, config, c), c["out_fp16qkv"])


def test_gradients_of_all_weights(device):
    g, net, config = load("small_nodup")
    c = g / "T4_nomask"
    run(net.to(device), config, c).backward(c["cotangent"].to(device))
    expected = renamed(c / "grad_w")
    assert set(expected) == {name for name, _ in net.named_parameters()}
    for name, parameter in net.named_parameters():
        close(parameter.grad, expected[name], name)


@pytest.mark.parametrize("file", ["small_nodup", "deep_nodup"])
def test_batch_norm_in_training(file, device):
    g, net, config = load(file)
    c = g / "T4_nomask"
    close(run(net.to(device).train(), config, c), c["out_trainBN_nodroppath"], "out")
    after = renamed(c / "trainBN_after")
    assert set(after) == {name for name, _ in net.named_buffers()}
    for name, buffer in net.named_buffers():
        close(buffer, after[name], name)


@pytest.mark.parametrize("rule", ["native", "implicit"])
@pytest.mark.parametrize("file", ["small_dup", "deep_dup"])
def test_network_with_the_duplicate_rules_of_spconv(file, rule, monkeypatch):
    """Everything around the convolutions is right for any rule; these two are races in the release, so not imitated."""

    def conv(x, weight, bias, voxels, kernel_map, *, duplicates, check):
        return racing_conv(x, weight, bias, voxels, kernel_map, rule)

    g, net, config = load(file)
    monkeypatch.setattr(point_transformer.ops, "sparse_conv", conv)
    with torch.no_grad():
        close(run(net, config, g / "T4_nomask"), g[f"T4_nomask/out_dupmode_{rule}"], "out")


def features_inside(net, config, case):
    """What the parts of the network compute, by the names of the published ones; and the geometry."""
    seen = {}

    def note(name, module, value):
        module.register_forward_hook(lambda _module, inputs, out: seen.update({name: value(inputs, out)}))

    def output(_inputs, out):
        return out

    note("embedding/feat", net.stem, output)
    for s, stage in enumerate(net.encoder):
        if s > 0:
            note(f"enc{s}.down/feat", stage.pool, output)
            note(f"enc{s}.merger/feat", stage.merge or stage.pool, output)
        for i, block in enumerate(stage.blocks):
            note(f"enc{s}.block{i}/feat", block, output)
    for s, stage in enumerate(net.decoder):
        note(f"dec{s}.unmerger/feat", stage.unpool, lambda inputs, _out: inputs[0])
        note(f"dec{s}.up/feat", stage.unpool, output)
        note(f"dec{s}.up.proj_skip/feat", stage.unpool, lambda inputs, _out: inputs[1])
        first = stage.blocks[0].position.conv
        note(f"dec{s}.block0.cpe_conv/input_features", first, lambda inputs, _out: inputs[0])
        for i, block in enumerate(stage.blocks):
            note(f"dec{s}.block{i}/feat", block, output)
    xyz = case["xyz"]
    pyramid = pyramid_of(xyz, everywhere(xyz), config)
    with torch.no_grad():
        net(case["features"].flatten(0, 2), pyramid)
    return seen, pyramid


@pytest.mark.parametrize("file", ["small_nodup", "deep_nodup"])
def test_features_inside(file):
    g, net, config = load(file)
    inter = g / "T4_nomask" / "inter"
    seen, _ = features_inside(net, config, g / "T4_nomask")
    assert set(seen) == {key for key in inter.keys() if key.endswith("feat") or key.endswith("input_features")}
    for name, value in seen.items():
        close(value, inter[name], name)


@pytest.mark.parametrize("file", FILES)
def test_geometry_inside(file):
    """Before merging, clouds of the first stages are one (scene, step) each: those of a pyramid that never merges."""
    g, _, config = load(file)
    case, inter = g / "T4_nomask", g / "T4_nomask" / "inter"
    xyz = case["xyz"]
    mask = everywhere(xyz)
    stages = pyramid_of(xyz, mask, config).stages
    assert_published_stage(stages[0], inter, "embedding/")
    positions = xyz.reshape(-1, 3)
    key = "embedding/serialized_depth"
    depth = inter[key] if key in inter else None  # noqa: SIM401
    for s in range(1, len(stages)):
        unmerged = (*config.merge_windows[: s - 1], *(1,) * (len(stages) - s))
        before = pyramid_of(xyz, mask, dataclasses.replace(config, merge_windows=unmerged)).stages[s]
        assert_published_stage(before, inter, f"enc{s}.down/")
        assert_published_stage(stages[s], inter, f"enc{s}.merger/")
        if depth is None:
            continue
        assert torch.equal(members(stages[s]), inter[f"enc{s}.down/pooling_inverse"])
        depth = depth - (config.strides[s - 1].bit_length() - 1)
        positions = ops.pool_mean(positions, stages[s].cluster.rows, stages[s].cluster.cu_rows)
        for part in ("down", "merger"):
            assert torch.equal(inter[f"enc{s}.{part}/serialized_depth"], depth)
            close(positions, inter[f"enc{s}.{part}/coord"], "positions", "golden_float32")
    if depth is not None:
        close(xyz.reshape(-1, 3), inter["embedding/coord"], "positions of the rows")
